"""The step of a simulation: a pipeline, run by the engine that was asked for or by the fastest that can."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from crazysim.core.data import SimData
from crazysim.core.pipeline import Pipeline
from crazysim.core.sharding import WORLD_AXIS
from crazysim.core.stage import as_stages, with_leaves
from crazysim.engine import fused, lanes, plain
from crazysim.engine.build import build_program
from crazysim.engine.lower import UnsupportedError
from crazysim.engine.program import Program, UnfusedStage
from crazysim.errors import ConfigError
from crazysim.pytree import check_axes, scopes

ENGINES = ("auto", "plain", "lanes", "fused")
"""What ``engine=`` may be."""

Steps = Callable[[list[Any], int | Array], tuple[list[Any], Array]]
"""Leaves and a number of steps to the written leaves and which worlds are flagged as not finite."""

Zeros = tuple[tuple[int, frozenset[int]], ...]
"""Leaves with the elements of them that are zero."""


class Plan(NamedTuple):
    """How data of one structure is stepped."""

    engine: str
    """Engine that runs."""
    why: str
    """Why it is not a faster one."""
    program: Program | None
    """What it runs; None for ``plain``."""
    read: tuple[int, ...]
    """Leaves that go in."""
    packed: tuple[int, ...]
    """Leaves that go in as one array behind them."""
    written: tuple[int, ...]
    """Leaves that come out."""
    shown: int
    """Leaf that is false after a step: whether the scene shows this data."""
    dynamic: Callable[..., Any]
    """The compiled step, for a number of steps that is an array."""
    static: Callable[..., Any]
    """The same for a number of steps that is known, which can be differentiated."""


class Step:
    """``step(data, n_steps=1) -> data``, pure: usable inside jit, vmap, grad and scan.

    ``n_steps`` as an array: one compilation serves every number. As a Python number: the loop can be differentiated
    in reverse.
    """

    def __init__(self, pipeline: Pipeline, engine: str = "auto", platform: str = "cpu", mesh: Mesh | None = None):
        """Take the stages as they are now.

        Args:
            pipeline: The stages.
            engine: One of ``ENGINES``.
            platform: Where it runs, ``"cpu"`` or ``"gpu"``.
            mesh: Devices that the worlds are spread over.

        Raises:
            ConfigError: If there is no such engine, or it cannot run here.
        """
        if engine not in ENGINES:
            raise ConfigError(f"engine {engine!r} does not exist; choose one of {', '.join(ENGINES)}")
        if engine == "fused" and (missing := fused.missing(platform)):
            raise ConfigError(f"engine 'fused' cannot run here: {missing}. Use engine='lanes', or 'auto'.")
        self.engine, self.platform, self.mesh = engine, platform, mesh
        self.stages = as_stages(pipeline)
        self._plans: dict[Any, Plan] = {}
        self._zeros = _Zeros()
        self._pack = _Pack()
        self._unshown: Any = None

    def __call__(self, data: SimData, n_steps: int | Array = 1, zeros: Zeros | None = None) -> SimData:
        """Return the data some steps later.

        Args:
            data: The simulation.
            n_steps: How many steps.
            zeros: What ``zeros`` returned for this data before it was traced: inside jit, parameters that are zero
                cannot be told from others, and are computed with.
        """
        return self.advance(self.take_apart(data, zeros), n_steps).data()

    def take_apart(self, data: SimData, zeros: Zeros | None = None) -> Apart:
        """Return the data as a step wants it."""
        leaves, treedef = jax.tree.flatten(data)
        plan = self._plan(data, leaves, treedef, zeros)
        packed = self._pack([leaves[i] for i in plan.packed]) if plan.packed else None
        return Apart(leaves, treedef, plan, packed)

    def advance(self, apart: Apart, n_steps: int | Array) -> Apart:
        """Return the data some steps later, still apart."""
        plan = apart.plan
        step = plan.static if isinstance(n_steps, int) else plan.dynamic
        out = step(apart.inputs(), n_steps)
        leaves = with_leaves(apart.leaves, plan.written, out)
        leaves[plan.shown] = self._false(leaves[plan.shown])
        return Apart(leaves, apart.treedef, plan, apart.packed)

    def _false(self, before: Any) -> Any:
        """Return a flag that is false, where the flag before is; the same array again costs no call."""
        if before is self._unshown:
            return before
        traced = isinstance(before, jax.core.Tracer)
        flag = jnp.asarray(False) if traced else jax.device_put(np.False_, getattr(before, "sharding", None))
        if not isinstance(flag, jax.core.Tracer):
            self._unshown = flag
        return flag

    def plan(self, data: SimData, zeros: Zeros | None = None) -> Plan:
        """Return how this data is stepped."""
        leaves, treedef = jax.tree.flatten(data)
        return self._plan(data, leaves, treedef, zeros)

    def zeros(self, data: SimData) -> Zeros:
        """Return which elements of shared parameters are zero, for ``__call__``."""
        return self._zeros(data, jax.tree.leaves(data))

    def lower(self, data: SimData, n_steps: int | Array = 1) -> Any:
        """Return the step lowered for this data, as ``jax.jit(...).lower`` does: to look at, or to compile ahead."""
        apart = self.take_apart(data)
        step = apart.plan.static if isinstance(n_steps, int) else apart.plan.dynamic
        return step.lower(apart.inputs(), n_steps)

    def _cache_size(self) -> int:
        """Return how many compilations there are; the tests of law 6 count them."""
        plans = self._plans.values()
        return sum(p.dynamic._cache_size() + p.static._cache_size() for p in plans)  # type: ignore[attr-defined]

    def _plan(self, data: SimData, leaves: list[Any], treedef: Any, zeros: Zeros | None) -> Plan:
        zeros = self._zeros(data, leaves) if zeros is None else zeros
        key = (treedef, tuple([(x.shape, x.dtype) for x in leaves]), zeros)
        plan = self._plans.get(key)
        if plan is None:
            self._check(data)
            check_axes(data, data.core.n_worlds, data.core.n_drones)
            plan = self._plans[key] = self._make_plan(data, zeros)
        return plan

    def _check(self, data: SimData) -> None:
        pos = data.states.pos
        if self.mesh is None and not isinstance(pos, jax.core.Tracer) and len(pos.sharding.device_set) > 1:
            raise ConfigError(
                f"the data is spread over {len(pos.sharding.device_set)} devices, but the step was built for one; "
                f"build the simulation with Sim(mesh=world_mesh(devices)), or call sim.shard(mesh)"
            )

    def _make_plan(self, data: SimData, zeros: Zeros) -> Plan:
        if self.engine == "plain":
            return self._plain(data, "it was asked for")
        undeclared = [s.__name__ for s in self.stages if s.scope == "batch"]
        if self.mesh is not None and undeclared:
            return self._plain(data, f"with a mesh every stage must be declared, and {undeclared[0]!r} is not")
        kinds = jax.tree.leaves(scopes(data))
        # Zeros that were told may be of data in which a parameter, one per drone by now, was still shared.
        known = {i: some for i, some in zeros if kinds[i] == "shared"}
        program = build_program(self.stages, data, known, _watched)
        if self.mesh is not None and program.unfused_stages:
            return self._plain(data, f"with a mesh every stage must be fused, and {program.unfused_stages[0].unfused}")
        engine, why, run = "lanes", "it was asked for", functools.partial(lanes.steps, program)
        if self.engine in ("auto", "fused"):
            why = fused.missing(self.platform) or ""
            try:
                if not why:
                    engine, run = "fused", fused.build(program, self.platform)
            except UnsupportedError as error:
                why = str(error)
                if self.engine == "fused":
                    raise ConfigError(
                        f"engine 'fused' cannot run this pipeline: {why}. Use 'lanes' or 'auto'."
                    ) from None
        read = (*program.read, *_needed(program))
        return self._wrap(engine, why, data, program, read, tuple(program.written), run, len(program.leaves))

    def _plain(self, data: SimData, why: str) -> Plan:
        run, written = plain.build(self.stages, data, by_component=self.mesh is None)
        everything = tuple(range(len(jax.tree.leaves(data))))
        # XLA spreads what is plain over a mesh by itself.
        return self._wrap("plain", why, data, None, everything, tuple(written), run, len(everything), shard=False)

    def _wrap(
        self,
        engine: str,
        why: str,
        data: SimData,
        program: Program | None,
        read: tuple[int, ...],
        written: tuple[int, ...],
        run: Steps,
        n_leaves: int,
        shard: bool = True,
    ) -> Plan:
        numbers = {id(x): i for i, x in enumerate(jax.tree.leaves(data))}
        nonfinite, shown = numbers[id(data.core.nonfinite)], numbers[id(data.core.mjx_synced)]
        everything = tuple(sorted({*read, *written}))
        written = (*written, nonfinite)
        packed = program.packed if program else ()
        read = everything[:-1] if packed else everything  # what is packed is the last

        def advance(values: list[Any], n_steps: int | Array) -> list[Any]:
            leaves = with_leaves([None] * n_leaves, everything, values)
            out, flagged = run(leaves, n_steps)
            return [*out, flagged]

        if self.mesh is None or not shard or program is None:
            return Plan(engine, why, program, read, packed, written, shown, *_jitted(advance))
        split, whole = PartitionSpec(WORLD_AXIS), PartitionSpec()
        specs = [split if leaf.scope in ("drone", "world") else whole for leaf in program.leaves]
        outs = [specs[i] for i in written]

        def spread(values: list[Any], n_steps: int | Array) -> list[Any]:
            known = isinstance(n_steps, int)
            count = [] if known else [n_steps]
            local = jax.shard_map(
                lambda values, *count: advance(values, *(count or [n_steps])),
                mesh=self.mesh,
                in_specs=([specs[i] for i in everything], *[whole for _ in count]),
                out_specs=outs,
                check_vma=False,
            )
            return local(values, *count)

        return Plan(engine, why, program, read, packed, written, shown, *_jitted(spread))


class Apart:
    """Data taken apart for steps: who only steps on need not put it together in between."""

    __slots__ = ("leaves", "packed", "plan", "treedef")

    def __init__(self, leaves: list[Any], treedef: Any, plan: Plan, packed: Array | None):
        """Hold the leaves, and what of them is packed."""
        self.leaves, self.treedef, self.plan, self.packed = leaves, treedef, plan, packed

    def data(self) -> SimData:
        """Return the data put together."""
        return self.treedef.unflatten(self.leaves)

    def inputs(self) -> list[Any]:
        """Return what the compiled step is given besides the number of steps."""
        values = [self.leaves[i] for i in self.plan.read]
        if self.packed is not None:
            values.append(self.packed)
        return values


class _Pack:
    """Shared numbers one behind the other, made anew only when one of the arrays is another."""

    def __init__(self) -> None:
        self._arrays: Sequence[Any] = ()
        self._packed: Any = None

    def __call__(self, arrays: list[Any]) -> Array:
        if any(isinstance(x, jax.core.Tracer) for x in arrays):
            return _concatenated(arrays)
        if len(arrays) != len(self._arrays) or not all(map(_is, arrays, self._arrays)):
            with jax.ensure_compile_time_eval():  # also within somebody's trace: what is kept must be an array
                self._arrays, self._packed = arrays, jax.jit(_concatenated)(arrays)
        return self._packed


def _concatenated(arrays: list[Any]) -> Array:
    return jnp.concatenate([x.ravel() for x in arrays])


def _jitted(advance: Callable[..., Any]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the function compiled for any number of steps, and for a number that is known."""
    return jax.jit(advance), jax.jit(lambda values, n: advance(values, n), static_argnums=1)


def _watched(data: SimData) -> list[Any]:
    """Return the leaves that a NaN or infinity must not enter unseen: states and commands."""
    return jax.tree.leaves((data.states, data.controls))


def _needed(program: Program) -> list[int]:
    """Return the leaves that are watched, and one by which the number of worlds is told."""
    check = program.check
    watched = [leaf for leaf, _ in check.reads] if check is not None else []
    return [*watched, next(i for i, leaf in enumerate(program.leaves) if leaf.scope == "drone")]


class _Zeros:
    """Which elements of shared parameters are zero: an inertia without products, a force without a component.

    They are looked at once for each array. Inside someone's jit there is nothing to look at, and nothing is assumed.
    """

    def __init__(self) -> None:
        self._arrays: Sequence[Any] = ()
        self._found: Zeros = ()
        self._shared: dict[Any, list[int]] = {}

    def __call__(self, data: SimData, leaves: list[Any]) -> Zeros:
        places = self._places(data, leaves)
        arrays = [leaves[i] for i in places]
        if len(arrays) == len(self._arrays) and all(map(_is, arrays, self._arrays)):
            return self._found
        if any(isinstance(x, jax.core.Tracer) for x in arrays):
            return ()
        found = {i: frozenset(np.flatnonzero(np.asarray(x) == 0).tolist()) for i, x in zip(places, arrays, strict=True)}
        self._arrays, self._found = arrays, tuple((i, zeros) for i, zeros in found.items() if zeros)
        return self._found

    def _places(self, data: SimData, leaves: list[Any]) -> list[int]:
        key = tuple([x.ndim for x in jax.tree.leaves((data.params, data.controls))])
        if key not in self._shared:
            ids = {id(x) for x in jax.tree.leaves((data.params, data.controls))}
            self._shared[key] = [
                i
                for i, (scope, x) in enumerate(zip(jax.tree.leaves(scopes(data)), leaves, strict=True))
                if scope == "shared" and id(x) in ids and jnp.issubdtype(x.dtype, jnp.floating)
            ]
        return self._shared[key]


def _is(a: Any, b: Any) -> bool:
    return a is b


def explain(step: Step, data: SimData) -> str:
    """Return in a few lines which engine runs the step, what it fuses, and what it cannot fuse and why."""
    plan = step.plan(data)
    lines = [f"engine: {plan.engine}" + (f" ({plan.why})" if plan.why else "")]
    if plan.program is None:
        return "\n".join([*lines, f"stages: {', '.join(s.__name__ for s in step.stages)}"])
    for segment in plan.program.segments:
        if isinstance(segment, UnfusedStage):
            lines.append(f"splits the step: {segment.unfused}")
        else:
            names = ", ".join(segment.stages)
            lines.append(f"fused, for one {segment.scope}: {names} ({segment.n_operations} operations)")
    split = [stage.name for stage in plan.program.unfused_stages]
    if split:
        lines.append(_cost_of_split(step, data, split))
    if plan.engine == "fused":
        lines.append(fused.describe(plan.program, step.platform))
    return "\n".join(lines)


def _cost_of_split(step: Step, data: SimData, split: list[str]) -> str:
    """Return what stages that split the step cost, measured against the same step without them."""

    def seconds(step: Step, n: int = 64) -> float:
        jax.block_until_ready(step(data, jnp.int32(n)))  # compiled
        begin = time.perf_counter()
        jax.block_until_ready(step(data, jnp.int32(n)))
        return (time.perf_counter() - begin) / n

    rest = {s.__name__: s for s in step.stages if s.__name__ not in split}
    whole, without = seconds(step), seconds(Step(rest, step.engine, step.platform, step.mesh))
    return (
        f"cost of the split, measured: a step takes {1e6 * whole:.0f} us, and {1e6 * without:.0f} us without "
        f"{', '.join(split)}"
    )
