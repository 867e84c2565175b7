"""Lowering of the stages of a pipeline to a program, with one segment for each stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import jax
import numpy as np

import crazysim.engine.lowering.rules  # noqa: F401  (fills the table of rules)
from crazysim.engine.errors import LimitError, UnsupportedError
from crazysim.engine.ir.blocks import Builder, Element, Value, constant, prune
from crazysim.engine.ir.program import TABLE_INDEX, Leaf, Program, Segment, Slot, UnfusedStage, Zeros
from crazysim.engine.jaxcompat import equations, is_key
from crazysim.engine.lowering.jaxprs import ElementArray, Lowering, TableEntry, as_elements, inputs, scalars
from crazysim.engine.lowering.relative import RelativeAxes, view_leaves
from crazysim.engine.lowering.tracing import TracedStage, Tracer
from crazysim.engine.pair_reductions import reduce_over_others_p
from crazysim.engine.pytree import leaf_flags
from crazysim.engine.record import Record
from crazysim.engine.stage import PHASES, Axes, Phase, Stage, is_first_step

MAX_UNROLLED_DRONES = 8
"""Maximum number of drones per world for which a stage of scope ``world`` that uses leaves of drones is lowered. It is
also the maximum number of members of other populations that a stage uses. Blocks grow as the square of the number."""


def lower_stages(
    stages: Sequence[Stage],
    data: Record,
    zeros: Zeros = (),
    check: bool = False,
    population: str | None = None,
    tracer: Tracer | None = None,
) -> Program:
    """Return the program of a step, with one segment per stage.

    A stage that cannot be lowered becomes an ``UnfusedStage``, which holds the reason.

    Args:
        stages: Stages of a step, in order within their phases.
        data: Data of the simulation, or its shapes and types.
        zeros: Leaves with the elements that are known to be zero. Terms with them are left out, unless a stage writes
            the leaf.
        check: Whether to check the watched leaves after the last step, unless a stage writes the flag of worlds itself.
        population: Population whose members are the lanes; None for that of the record. They are called drones below.
        tracer: Cache of traced stages; None for a new one.
    """
    tracer, roles = tracer or Tracer(), data.roles()
    population = population or roles.population
    axes = RelativeAxes(data, population)
    leaves = view_leaves(axes.views, [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jax.tree.leaves(data)])
    known_zeros = dict(zeros)
    n_drones = next(x.shape[1] for x, scope in zip(leaves, axes.scopes, strict=True) if scope == "drone")
    segments = []
    for phase in PHASES:
        phase_stages = [stage for stage in stages if stage.phase == phase]
        phase_segments = [
            _lower_stage(axes.stage(x), phase, axes, leaves, known_zeros, n_drones, tracer) for x in phase_stages
        ]
        if phase == "each":
            phase_segments = _move_before_steps(phase_segments, phase_stages, roles.clock)
        segments += phase_segments
    program_leaves = tuple([
        Leaf(name, scope, tuple(x.shape), x.dtype)
        for name, scope, x in zip(axes.names, axes.scopes, leaves, strict=True)
    ])  # fmt: skip
    scratch = frozenset(i for i, x in enumerate(jax.tree.leaves(leaf_flags(data, "scratch"))) if x)
    program = Program(program_leaves, n_drones, tuple(segments), None, scratch, (), population, axes.views)
    changed_leaves = known_zeros.keys() & set(program.written_leaves)
    if changed_leaves:  # an element is only known to be zero while no stage writes it
        zeros = tuple([(i, indices) for i, indices in zeros if i not in changed_leaves])
        return lower_stages(stages, data, zeros, check, population, tracer)
    if not check or roles.nonfinite in program.written_leaves:
        return program
    lane_leaves = {i for i, scope in enumerate(axes.scopes) if scope in ("drone", "world")} - axes.views
    checked_leaves = (lane_leaves | axes.views & set(program.written_leaves)) & roles.watched.keys()
    return dataclasses.replace(
        program,
        check_segment=_make_finite_check(
            axes, leaves, roles.nonfinite, roles.clock, {i: roles.watched[i] for i in sorted(checked_leaves)}
        ),
    )


def _move_before_steps(
    segments: Sequence[Segment | UnfusedStage], stages: Sequence[Stage], step_count_leaf: Any
) -> list[Segment | UnfusedStage]:
    # If at most one stage writes the leaf of step counts, no episode can begin during a call. Numbers that only the
    # moved segments write are then constant during the steps, and can be hoisted.
    if sum(step_count_leaf in s.written_leaves for s in segments) > 1:
        return list(segments)
    acts_at_first_step = [
        stage.when is is_first_step and isinstance(s, Segment) for stage, s in zip(stages, segments, strict=True)
    ]
    n_moved = (*acts_at_first_step, False).index(False)
    moved_segments = [dataclasses.replace(s, phase="before") for s in segments[:n_moved] if isinstance(s, Segment)]
    return [*moved_segments, *segments[n_moved:]]


def _lower_stage(
    stage: Stage,
    phase: Phase,
    axes: RelativeAxes,
    leaves: Sequence[Any],
    zeros: Mapping[int, frozenset[int]],
    n_drones: int,
    tracer: Tracer,
) -> Segment | UnfusedStage:
    try:
        if stage.scope == "batch":
            raise LimitError(stage.unfused_reason)
        traced = tracer(stage, axes, leaves)
        # If a stage of a world uses no leaf of drones, every drone can run it for its world.
        uses_drones = any(axes.scopes[i] == "drone" for i in (*traced.input_leaves, *traced.written_leaves))
        scope: Literal["drone", "world"] = "world" if stage.scope == "world" and uses_drones else "drone"
        if scope == "world" and n_drones > MAX_UNROLLED_DRONES:
            raise LimitError(f"a stage of one world is unrolled for at most {MAX_UNROLLED_DRONES} drones")
        population_sizes = [
            leaves[i].shape[2] for i in (*traced.input_leaves, *traced.written_leaves) if i in axes.views
        ]
        if max(population_sizes, default=0) > MAX_UNROLLED_DRONES:
            raise LimitError(f"other populations are unrolled for at most {MAX_UNROLLED_DRONES} members")
        shared_leaves = [i for i in traced.input_leaves if axes.scopes[i] == "shared" and not is_key(traced.avals[i])]
        known_zeros = {i: zeros[i] for i in traced.input_leaves if i in zeros}
        n_members = n_drones if scope == "drone" else 0
        key = (stage.__name__, scope, phase, n_members, frozenset(known_zeros.items()))
        if key not in traced.segments:
            traced.segments[key] = _make_segment(stage, scope, phase, traced, known_zeros, shared_leaves, n_members)
        return traced.segments[key]
    except UnsupportedError as error:
        traced = TracedStage(Stage(stage, "batch", name=stage.__name__), axes, leaves)
        traced.dump(stage.__name__)
        error = error.with_location(stage=stage.__name__)
        return UnfusedStage(
            stage.__name__, phase, traced.fn, tuple(traced.input_leaves), tuple(traced.written_leaves), error
        )


def _make_segment(
    stage: Stage,
    scope: Literal["drone", "world"],
    phase: Phase,
    traced: TracedStage,
    zeros: Mapping[int, frozenset[int]],
    shared_leaves: Sequence[int],
    n_members: int,
) -> Segment:
    lowering = Lowering(Builder(stage=stage.__name__), n_members=n_members)
    elements_before = {
        i: inputs(lowering.builder, traced.avals[i], zeros.get(i, frozenset())) for i in traced.input_leaves
    }
    tables = {
        _add_table(lowering, elements_before[i]): (i, TABLE_INDEX)
        for i in shared_leaves
        if i in elements_before and elements_before[i].size > 1
    }
    lowering.shared.update(x for i in shared_leaves for x in scalars(elements_before[i]) if isinstance(x, Value))
    args = [elements_before[i] for i in traced.input_leaves]
    if traced.when is None:
        elements_after = lowering.lower(traced.fn, args)
    else:
        mask = lowering.lower(traced.when, args)[0][()]
        for i in traced.written_leaves:
            if i not in elements_before:
                elements_before[i] = inputs(lowering.builder, traced.avals[i])
        elements_after = _lower_guarded(
            lowering, mask, traced, args, [elements_before[i] for i in traced.written_leaves]
        )
    writes: dict[Slot, Element] = {}
    for i, new in zip(traced.written_leaves, elements_after, strict=True):
        old = scalars(elements_before[i]) if i in elements_before else [None] * len(scalars(new))
        writes.update({(i, k): b for k, (a, b) in enumerate(zip(old, scalars(new), strict=True)) if a is not b})
    slots = {x: (i, k) for i, elements in elements_before.items() for k, x in enumerate(scalars(elements))} | tables
    block = prune(lowering.builder.finish(tuple(writes.values())), keep_inputs=False)
    return Segment(scope, (stage.__name__,), phase, block, tuple([slots[x] for x in block.inputs]), tuple(writes))


def _add_table(lowering: Lowering, elements: ElementArray) -> Value:
    items = elements.reshape(-1)
    table = lowering.builder.input(items[0].dtype, len(items))
    zero = constant(0, np.int32)
    lowering.entries.update((x, TableEntry(table, zero, k)) for k, x in enumerate(items) if isinstance(x, Value))
    return table


def _lower_guarded(
    lowering: Lowering, mask: Element, traced: TracedStage, args: list[ElementArray], old_arrays: list[ElementArray]
) -> list[ElementArray]:
    # A stage that reduces over other drones is computed at every step, and the mask selects its results. Drones need
    # each other's values even if their stages act at different steps.
    reads_other_drones = any(eqn.primitive is reduce_over_others_p for eqn in equations(traced.fn))
    inner = lowering if reads_other_drones else lowering.make_inner()
    new_arrays = inner.lower(traced.fn, args)
    pairs = [
        (old, new)
        for old_array, new_array in zip(old_arrays, new_arrays, strict=True)
        for old, new in zip(scalars(old_array), scalars(new_array), strict=True)
    ]
    if reads_other_drones:
        results = iter([old if old is new else lowering.scalar("select_n", mask, old, new) for old, new in pairs])
        return [_replace_scalars(x, [next(results) for _ in scalars(x)]) for x in old_arrays]
    changed_pairs = [(old, new) for old, new in pairs if old is not new]
    block = inner.builder.finish([new for _, new in changed_pairs])
    old_elements = [old for old, _ in changed_pairs]
    results = iter(
        lowering.builder.add_many("when", (mask, *old_elements), [a.dtype for a in old_elements], (), (block,))
    )
    elements = iter([old if old is new else next(results) for old, new in pairs])
    return [_replace_scalars(x, [next(elements) for _ in scalars(x)]) for x in old_arrays]


def _replace_scalars(template: ElementArray, items: Sequence[Element]) -> ElementArray:
    scalar = iter(items)
    elements = [(next(scalar), next(scalar)) if isinstance(x, tuple) else next(scalar) for x in template.reshape(-1)]
    return as_elements(elements, template.shape)


def _make_finite_check(
    axes: Axes, leaves: Sequence[Any], flag: int, steps: int, checked_leaves: Mapping[int, bool]
) -> Segment:
    # A number is valid if it is finite or, where ``checked_leaves`` is False for its leaf, if it is not NaN. It also
    # flags drones of worlds that took more than ``MAX_STEPS`` steps. A call takes at most that many steps, so the count
    # has overflowed and is negative.
    builder = Builder(stage="finite_check")
    reads: list[Slot] = []
    is_valid: Element = constant(True, bool)
    avals = axes.unbatched_shapes(list(leaves), "drone")
    for i, must_be_finite in checked_leaves.items():
        if avals[i].dtype.kind == "f":
            for k, item in enumerate(scalars(inputs(builder, avals[i]))):
                reads.append((i, k))
                infinity = constant(np.inf, avals[i].dtype)
                operation, operands = ("is_finite", (item,)) if must_be_finite else ("le", (item, infinity))
                is_valid = builder.add("and", (is_valid, builder.add(operation, operands, bool)), bool)
    reads += [(steps, 0), (flag, 0)]
    has_overflowed = builder.add("lt", (builder.input(avals[steps].dtype), constant(0, avals[steps].dtype)), bool)
    is_invalid = builder.add("or", (has_overflowed, builder.add("not", (is_valid,), bool)), bool)
    flagged = builder.add("or", (builder.input(bool), is_invalid), bool)
    return Segment("drone", ("finite_check",), "after", builder.finish([flagged]), tuple(reads), ())
