"""From a pipeline of stages to programs: which stages run together, what they read, and what they write."""

from __future__ import annotations

import copy
import dataclasses
import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, Literal

import jax
import numpy as np
from jax.extend import core

import crazysim.engine.rules  # noqa: F401  (fills the table of rules)
from crazysim.core.stage import Axes, Stage, StageScope
from crazysim.engine.ir import Block, Element, Value, constant
from crazysim.engine.lower import Elements, Lowering, UnsupportedError, as_elements, scalars

Slot = tuple[int, int]
"""A number of the data: which leaf, and which element of what one drone (or one world) has of it."""

Phase = Literal["first", "each", "last"]
"""When a segment runs: once before the first step, at each step, once after the last."""

MAX_UNROLLED_DRONES = 8
"""Most drones of a world for which a stage of one world is written out; its program grows with their square."""


@dataclasses.dataclass
class Segment:
    """Stages that run together: a program on single numbers, or one stage that runs as it is written."""

    scope: StageScope
    """Whose numbers the program computes on; ``batch`` has no program."""
    stages: list[Stage]
    """The stages."""
    phase: Phase = "each"
    """When they run."""
    block: Block = dataclasses.field(default_factory=Block)
    """The program; empty if there is none."""
    reads: list[Slot] = dataclasses.field(default_factory=list)
    """What its inputs are."""
    writes: list[Slot] = dataclasses.field(default_factory=list)
    """What its outputs are."""
    before: Block | None = None
    """What is computed once, before the first step; its inputs are those of ``constants``."""
    constants: list[Slot] = dataclasses.field(default_factory=list)
    """What the inputs of ``before`` are. Its outputs are further inputs of ``block``, behind ``reads``."""
    used: list[int] = dataclasses.field(default_factory=list)
    """Leaves that a stage without a program reads."""
    written: list[int] = dataclasses.field(default_factory=list)
    """Leaves that are written."""
    why: str = ""
    """Why there is no program."""
    fn: Any = None
    """The jaxpr that runs then, from ``used`` to ``written``."""
    first: dict[int, Elements] = dataclasses.field(default_factory=dict)
    """Elements of the leaves it reads, as they come in."""
    now: dict[int, Elements] = dataclasses.field(default_factory=dict)
    """Elements of the leaves, as they are behind the last stage read."""

    @property
    def unfused(self) -> str:
        """What a message says of a segment without a program."""
        return f"{self.stages[0].__name__!r} is not fused: {self.why}"


class Program:
    """What a pipeline does to the data of a simulation, ready for an engine."""

    def __init__(
        self,
        stages: Sequence[Stage],
        data: Any,
        zeros: dict[int, frozenset[int]] | None = None,
        watched: Callable[[Any], list[Any]] | None = None,
        first: Sequence[Stage] = (),
        last: Sequence[Stage] = (),
        scratch: Collection[int] = (),
    ):
        """Read the stages.

        Args:
            stages: The stages of a step, in order.
            data: Data of the simulation, or its shapes and types.
            zeros: Elements of shared leaves that are known to be zero, by leaf: nothing is computed with them.
            watched: Picks the leaves that are watched for NaN and infinity.
            first: Stages that run once, before the first step.
            last: Stages that run once, after the last step.
            scratch: Leaves that are only there for one stage to tell another; what is written there is not kept.
        """
        self.axes, self.leaves = Axes(data), jax.tree.leaves(data)
        self.n_drones = data.core.n_drones
        self.zeros, self.scratch = zeros or {}, frozenset(scratch)
        self.packed: tuple[int, ...] = ()
        self.rows: dict[int, int] = {}
        self.segments: list[Segment] = []
        phases: dict[Phase, Sequence[Stage]] = {"first": first, "each": stages, "last": last}
        for phase, some in phases.items():
            for stage in some:
                self._add(stage, phase)
        for segment in self.segments:
            if segment.scope != "batch":
                _close(segment)
        changing = {slot for s in self.of("each") for slot in self.own(s, s.writes)} | {
            (leaf, k)
            for s in self.of("each")
            if s.scope == "batch"
            for leaf in s.written
            for k in range(self.sizes(leaf))
        }
        for segment in self.of("each"):
            if segment.scope == "drone":
                _hoist(segment, changing)
        self.check = self._watch(data.core.nonfinite, watched(data)) if watched else None

    @property
    def fused(self) -> bool:
        """Whether all of it is written out, so that one kernel can run it."""
        return all(segment.scope != "batch" for segment in self.segments)

    def of(self, phase: Phase) -> list[Segment]:
        """Return the segments that run in a phase."""
        return [segment for segment in self.segments if segment.phase == phase]

    @property
    def group(self) -> int:
        """How many drones look at each other's numbers: those of a world, if some segment is of worlds."""
        return self.n_drones if any(segment.scope == "world" for segment in self.segments) else 1

    @property
    def written(self) -> list[int]:
        """Numbers of the leaves that are written."""
        return sorted({i for s in self.segments for i in s.written} - self.scratch)

    @property
    def read(self) -> list[int]:
        """Numbers of the leaves that are read."""
        return sorted({i for s in self.segments for i in [*s.used, *(leaf for leaf, _ in [*s.reads, *s.constants])]})

    def pack(self) -> None:
        """Lay the numbers that all drones share one behind the other, as one more leaf behind the others.

        A call of a compiled step costs by the number of its arrays. What some stage reads as an array stays one.
        """
        direct = {leaf for s in self.segments for leaf in s.used}
        shared = [i for i in self.read if self.axes.scopes[i] == "shared" and i not in direct]
        shared = [i for i in shared if i not in self.written and self.leaves[i].dtype == self.leaves[0].dtype]
        places, size = {}, 0
        for leaf in shared:
            places[leaf] = size
            size += self.sizes(leaf)
        if not places:
            return

        def moved(slots: list[Slot]) -> list[Slot]:
            return [(len(self.leaves), places[leaf] + k) if leaf in places else (leaf, k) for leaf, k in slots]

        for segment in [*self.segments, *([self.check] if self.check else [])]:
            segment.reads, segment.constants = moved(segment.reads), moved(segment.constants)
        self.packed = tuple(places)
        self.leaves.append(jax.ShapeDtypeStruct((size,), self.leaves[0].dtype))
        self.axes.scopes.append("shared")
        self.axes.names.append("packed")

    def lay(self, leaves: Collection[int]) -> dict[int, list[int]]:
        """Lay leaves of drones and worlds under each other, as rows of one leaf for each type, behind the others.

        A row is one number of all drones, which lie next to each other there, as a kernel's lanes do.

        Returns:
            The leaves that are in each of the new ones, from the first row on.
        """
        scope = self.axes.scopes
        # A single drone is all there is of its world.
        together = {i: ("drone" if self.n_drones == 1 else scope[i], self.leaves[i].dtype) for i in sorted(leaves)}
        groups: dict[int, list[int]] = {}
        rows: dict[int, tuple[int, int]] = {}
        for kind in dict.fromkeys(together.values()):
            new, n_rows = len(self.leaves), 0
            groups[new] = [i for i, k in together.items() if k == kind]
            for leaf in groups[new]:
                rows[leaf] = (new, n_rows)
                n_rows += self.sizes(leaf)
            n_lanes = self.leaves[groups[new][0]].shape[0] * self.n_drones
            self.leaves.append(jax.ShapeDtypeStruct((n_rows, n_lanes), kind[1]))
            self.axes.scopes.append(kind[0])
            self.axes.names.append("rows")
            self.rows[new] = n_rows

        def moved(slots: list[Slot]) -> list[Slot]:
            out = []
            for leaf, k in slots:
                if leaf in rows:
                    drone, k = divmod(k, old_sizes[leaf])
                    new, first = rows[leaf]
                    out.append((new, drone * self.rows[new] + first + k))
                else:
                    out.append((leaf, k))
            return out

        old_sizes = {leaf: self.sizes(leaf) for leaf in rows}
        for segment in self.segments:
            segment.reads, segment.constants = moved(segment.reads), moved(segment.constants)
            segment.writes = moved(segment.writes)
            segment.written = sorted({leaf for leaf, _ in segment.writes})
        return groups

    def parts(self) -> list[Program]:
        """Return programs that run one after the other: segments that one kernel can run, and those that none can."""
        parts = []
        for _, segments in itertools.groupby(self.segments, lambda s: id(s) if s.scope == "batch" else 0):
            part = copy.copy(self)
            part.segments, part.check = list(segments), None
            parts.append(part)
        return parts

    def own(self, segment: Segment, slots: Sequence[Slot]) -> list[Slot]:
        """Return the slots of a segment as a drone counts them, which is how a segment of drones does."""
        return list(slots) if segment.scope == "drone" else [(leaf, k % self.sizes(leaf)) for leaf, k in slots]

    def sizes(self, leaf: int, scope: StageScope = "drone") -> int:
        """Return how many numbers one drone (or world) has of a leaf; a key is two 32-bit integers."""
        if leaf in self.rows:
            return self.rows[leaf] * (self.n_drones if scope == "world" and self.axes.scopes[leaf] == "drone" else 1)
        aval = self.axes.one_of(leaf, self.leaves[leaf], scope)
        return int(np.prod(aval.shape, dtype=int)) * (2 if is_key(aval) else 1)

    def _add(self, stage: Stage, phase: Phase) -> None:
        if stage.scope == "batch":
            self._add_batch(stage, phase, "it is not declared for one drone or one world")
            return
        traced = _Traced(stage, self.axes, self.leaves)
        scope: StageScope = stage.scope
        if scope == "world" and not any(self.axes.scopes[i] == "drone" for i in [*traced.used, *traced.written]):
            scope = "drone"  # nothing of any drone is in it: every drone's lane can do it for its world
        if scope == "world" and self.n_drones > MAX_UNROLLED_DRONES:
            self._add_batch(stage, phase, f"of one world, it is written out for up to {MAX_UNROLLED_DRONES} drones")
            return
        last = self.segments[-1] if self.segments else None
        follows = last is not None and (last.scope, last.phase) == (scope, phase)
        segment = last if last is not None and follows else Segment(scope, [], phase)
        try:
            values = self._lower(segment, traced)
        except UnsupportedError as error:
            self._add_batch(stage, phase, str(error))
            return
        if segment is not last:
            self.segments.append(segment)
        segment.stages.append(stage)
        segment.now.update(values)
        segment.block.barrier()

    def _lower(self, segment: Segment, traced: _Traced) -> dict[int, Elements]:
        """Return what the written leaves of a stage become, as elements of the segment's block."""
        lowering = Lowering(segment.block)
        args = [self._elements(segment, i, traced.avals[i]) for i in traced.used]
        if traced.when is None:
            return dict(zip(traced.written, lowering.lower(traced.fn, args), strict=True))
        mask = lowering.lower(traced.when, args)[0][()]
        inner = lowering.inner()
        new = inner.lower(traced.fn, args)
        old = [self._elements(segment, i, traced.avals[i]) for i in traced.written]
        pairs = [(a, b) for x, y in zip(old, new, strict=True) for a, b in zip(scalars(x), scalars(y), strict=True)]
        changed = [(a, b) for a, b in pairs if a is not b]
        guarded = inner.builder.finish([b for _, b in changed])
        before = tuple(a for a, _ in changed)
        items = iter(segment.block.add_many("when", (mask, *before), [a.dtype for a in before], (), (guarded,)))
        row = iter([a if a is b else next(items) for a, b in pairs])
        return {i: _with_scalars(x, row) for i, x in zip(traced.written, old, strict=True)}

    def _elements(self, segment: Segment, leaf: int, aval: Any) -> Elements:
        """Return a leaf's elements as they are now in a segment; inputs, if no stage of it has written them."""
        if leaf not in segment.now:
            segment.now[leaf] = segment.first[leaf] = input_elements(
                segment.block, aval, self.zeros.get(leaf, frozenset())
            )
        return segment.now[leaf]

    def _add_batch(self, stage: Stage, phase: Phase, why: str) -> None:
        traced = _Traced(Stage(stage, "batch", name=stage.__name__), self.axes, self.leaves)
        segment = Segment("batch", [stage], phase, used=traced.used, written=traced.written, why=why, fn=traced.fn)
        self.segments.append(segment)

    def _watch(self, flag: Any, watched: list[Any]) -> Segment:
        """Return a program that flags a drone: its world was flagged, or a watched number is not finite."""
        ids = {id(x) for x in watched}
        segment = Segment("drone", [])
        avals = self.axes.of_one(self.leaves, "drone")
        finite: Element = constant(True, bool)
        for i, x in enumerate(self.leaves):
            if id(x) in ids and self.axes.scopes[i] == "drone":
                for item in self._elements(segment, i, avals[i]).reshape(-1):
                    finite = segment.block.add("and", (finite, segment.block.add("is_finite", (item,), bool)), bool)
        i = next(i for i, x in enumerate(self.leaves) if x is flag)
        before = self._elements(segment, i, avals[i])[()]
        segment.block.outputs = [segment.block.add("or", (before, segment.block.add("not", (finite,), bool)), bool)]
        _connect(segment)
        return segment


class _Traced:
    """A stage as jaxprs on flat lists of leaves: its function, and its condition if it has one."""

    def __init__(self, stage: Stage, axes: Axes, leaves: Sequence[Any]):
        self.avals = axes.of_one(list(leaves), stage.scope)
        self.written: list[int] = []
        has_mask = False

        def apply(values: list[Any]) -> list[Any]:
            after = stage.fn(axes.treedef.unflatten(values))
            self.written = axes.written(values, after, stage)
            new = jax.tree.leaves(after)
            return [new[i] for i in self.written]

        def condition(values: list[Any]) -> Any:
            nonlocal has_mask
            mask = stage.when(axes.treedef.unflatten(values)) if stage.when is not None else None
            has_mask = mask is not None
            return mask if has_mask else 0

        fn, when = jax.make_jaxpr(apply)(self.avals), jax.make_jaxpr(condition)(self.avals)
        used = _used(fn) | (_used(when) if has_mask else set())
        self.used = sorted(used)
        self.fn = _with_inputs(fn, self.used)
        self.when = _with_inputs(when, self.used) if has_mask else None


def is_key(x: Any) -> bool:
    """Return whether an array holds random keys."""
    return jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)


def _used(jaxpr: core.ClosedJaxpr) -> set[int]:
    inner = jaxpr.jaxpr
    used = {v for eqn in inner.eqns for v in eqn.invars if not isinstance(v, core.Literal)}
    used |= {v for v in inner.outvars if not isinstance(v, core.Literal)}
    return {i for i, v in enumerate(inner.invars) if v in used}


def _with_inputs(jaxpr: core.ClosedJaxpr, inputs: Sequence[int]) -> core.ClosedJaxpr:
    inner = jaxpr.jaxpr
    invars = [inner.invars[i] for i in inputs]
    return core.ClosedJaxpr(
        core.Jaxpr(inner.constvars, invars, inner.outvars, inner.eqns, inner.effects, inner.debug_info), jaxpr.consts
    )


def input_elements(block: Block, aval: Any, zeros: frozenset[int] = frozenset()) -> Elements:
    """Return an array as new inputs of a block, but for elements that are known to be zero."""
    size = int(np.prod(aval.shape, dtype=int))
    if is_key(aval):
        return as_elements([(block.input(np.uint32), block.input(np.uint32)) for _ in range(size)], aval.shape)
    items = [constant(0, aval.dtype) if k in zeros else block.input(aval.dtype) for k in range(size)]
    return as_elements(items, aval.shape)


def _with_scalars(like: Elements, row: Iterator[Element]) -> Elements:
    """Return elements of the same shape; of a key, two integers."""
    items = [(next(row), next(row)) if isinstance(x, tuple) else next(row) for x in like.reshape(-1)]
    return as_elements(items, like.shape)


def _close(segment: Segment) -> None:
    """Fix what a segment writes, and drop what nothing needs."""
    outputs: list[Element] = []
    for leaf, elements in segment.now.items():
        before = scalars(segment.first[leaf]) if leaf in segment.first else [None] * elements.size
        for k, (old, new) in enumerate(zip(before, scalars(elements), strict=True)):
            if old is not new:
                segment.writes.append((leaf, k))
                outputs.append(new)
    segment.written = sorted({leaf for leaf, _ in segment.writes})
    segment.block.outputs = outputs
    _connect(segment)


def _connect(segment: Segment) -> None:
    """Keep the inputs that are used, and note what they are."""
    block = segment.block
    slots = {id(x): (leaf, k) for leaf, elements in segment.first.items() for k, x in enumerate(scalars(elements))}
    segment.reads = [slots[i] for i in _keep_used_inputs(block)]


EXPENSIVE = frozenset(
    "div rem sqrt rsqrt cbrt pow exp exp2 expm1 log log1p sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh "
    "atanh logistic erf erfc erf_inv threefry2x32 loop while".split()
)
"""Operations that are worth a register to be done once instead of at every step."""


def _hoist(segment: Segment, changing: set[Slot]) -> None:
    """Move what no step changes, and is expensive, out of the loop over steps.

    A division by such a number becomes a product with its inverse, which is one rounding less exact.
    """
    block = segment.block
    fixed = {id(x) for x, slot in zip(block.inputs, segment.reads, strict=True) if slot not in changing}
    worth: set[int] = set()
    values: list[Value] = []
    replaced: dict[int, Element] = {}
    before = Block()

    def is_fixed(x: Element) -> bool:
        return not isinstance(x, Value) or id(x) in fixed

    for value in block.values:
        value.args = tuple(replaced.get(id(x), x) for x in value.args)
        if value.op == "div" and value.dtype.kind == "f" and is_fixed(value.args[1]) and not is_fixed(value.args[0]):
            a, b = value.args
            inverse = Value("div", (constant(1, value.dtype), b), value.dtype)
            fixed.add(id(inverse))
            worth.add(id(inverse))
            values += [inverse, product := Value("mul", (a, inverse), value.dtype)]
            replaced[id(value)] = product
            continue
        values.append(value)
        if value.op != "barrier" and not value.blocks and all(map(is_fixed, value.args)):
            fixed.add(id(value))
            if value.op in EXPENSIVE or any(id(x) in worth for x in value.args):
                worth.add(id(value))
    block.values = values
    _replace(block, replaced)
    needed = {id(x) for v in block.walk() if id(v) not in worth for x in v.args}
    needed |= {id(x) for b in _blocks(block) for x in b.outputs}
    moved = [v for v in values if id(v) in worth and id(v) in needed]
    if not moved:
        return
    # What is cheap stays in both blocks: it depends on nothing that has moved.
    before.values = [v for v in values if id(v) in fixed]
    before.outputs = list(moved)
    slots = dict(zip(map(id, block.inputs), segment.reads, strict=True))
    before.inputs = list(block.inputs)
    segment.constants = [slots[i] for i in _keep_used_inputs(before)]
    stand_ins = {id(v): Value("input", (), v.dtype) for v in moved}
    block.values = [v for v in values if id(v) not in worth]
    _replace(block, stand_ins)
    segment.reads = [slots[i] for i in _keep_used_inputs(block)]
    block.inputs += stand_ins.values()
    segment.before = before


def _replace(block: Block, new: dict[int, Any]) -> None:
    for value in block.walk():
        value.args = tuple(new.get(id(x), x) for x in value.args)
    for inner in _blocks(block):
        inner.outputs = [new.get(id(x), x) for x in inner.outputs]


def _keep_used_inputs(block: Block) -> list[int]:
    """Drop what nothing needs, inputs as well; return the ids of the inputs that stay."""
    block.drop_unused()
    used = {id(x) for v in block.walk() for x in v.args} | {id(x) for b in _blocks(block) for x in b.outputs}
    block.inputs = [x for x in block.inputs if id(x) in used]
    return [id(x) for x in block.inputs]


def _blocks(block: Block) -> list[Block]:
    return [block, *(b for v in block.walk() for b in v.blocks)]
