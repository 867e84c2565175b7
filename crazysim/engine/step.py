"""The step of a simulation as a pure function, which runs a pipeline on the chosen or the fastest engine."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from crazysim.engine import jaxcompat
from crazysim.engine.backends import fused
from crazysim.engine.cache import keep_programs
from crazysim.engine.flat import PackCache, ZerosCache
from crazysim.engine.host_call import HostLeaves
from crazysim.engine.ir.program import Program, Zeros
from crazysim.engine.lowering.relative import view_leaves
from crazysim.engine.plan import ENGINES, Plan, Planner, SeparateLeaves
from crazysim.engine.pytree import lazy_record, leaf_flags, replace_leaves
from crazysim.engine.record import MAX_STEPS, Record, Roles
from crazysim.engine.sharding import WORLD_AXIS, Location, find_location
from crazysim.engine.stage import Axes, Stage, as_stages
from crazysim.errors import ConfigError, short_repr

T = TypeVar("T", bound=Record)


class FlatData:
    """A record as a list of arrays, with the plan that steps it. No record is made between successive steps."""

    __slots__ = ("_record", "leaves", "plan")

    def __init__(self, leaves: list[Any] | HostLeaves, plan: Plan):
        self.leaves: Any = leaves
        self.plan = plan
        self._record: Any = None

    def is_record(self, data: object) -> bool:
        return data is self._record

    def data(self) -> Any:
        """Return the data as a record, always the same one. Its fields are computed when they are read."""
        record = self._record
        if record is None:
            # ``partial`` holds no reference to this object, because the cycle would keep arrays in memory.
            read_leaf = functools.partial(_read_leaf, self.leaves, self.plan)
            record = self._record = lazy_record(self.plan.leaf_indices, read_leaf)
        return record

    def replace(self, indices: Sequence[int], values: Sequence[Any]) -> FlatData:
        if any(i in rows.source_leaves for rows in self.plan.rows for i in indices):
            raise ValueError(
                "expected leaves that are not in rows, got one that is. Name it in separate= of Step.flatten."
            )
        if isinstance(self.leaves, HostLeaves):
            return FlatData(self.leaves.replace(indices, values), self.plan)
        return FlatData(replace_leaves(self.leaves, indices, values), self.plan)

    def inputs(self) -> list[Any]:
        """Return the arguments of the compiled step other than the number of steps."""
        return [self.leaves[i] for i in self.plan.inputs]


def scan(
    fn: Callable[[FlatData, Any, Any], tuple[FlatData, Any, Any]],
    flat: FlatData,
    carry: Any = (),
    xs: Any = None,
    length: int | None = None,
    also_changed: Collection[int] = (),
) -> tuple[FlatData, Any, Any]:
    """Scan ``flat, carry, output = fn(flat, carry, x)``; leaves that no step writes are constants of the loop.

    Args:
        fn: Function of the data, the carry and an element of ``xs``.
        carry: Any tree of arrays.
        xs: As for ``jax.lax.scan``.
        length: As for ``jax.lax.scan``.
        also_changed: Leaves that ``fn`` changes besides those that steps write.
    """
    changed = sorted({*flat.plan.written_leaves, *also_changed})

    def body(carried: tuple[list[Any], Any], x: Any) -> Any:
        flat_after, carry, output = fn(flat.replace(changed, carried[0]), carried[1], x)
        return ([flat_after.leaves[i] for i in changed], carry), output

    (leaves, carry), outputs = jax.lax.scan(body, ([flat.leaves[i] for i in changed], carry), xs, length)
    return flat.replace(changed, leaves), carry, outputs


def _read_leaf(leaves: Any, plan: Plan, i: int) -> Any:
    x = leaves[i]
    if x is not None or not plan.rows:
        return x
    rows = next(rows for rows in plan.rows if i in rows.source_leaves)
    x = rows.unpack(leaves[rows.leaf], i)
    return x.reshape(x.shape[0], *x.shape[2:]) if i in rows.program.views else x


jax.tree_util.register_pytree_node(
    FlatData, lambda flat: (tuple(flat.leaves), flat.plan), lambda plan, leaves: FlatData(list(leaves), plan)
)


class _Structure(NamedTuple):
    """Facts about records of one structure, with the same shapes and types, and their plans."""

    treedef: Any
    roles: Roles
    located: int
    """Leaf whose devices are those of the data."""
    parameters: tuple[int, ...]
    """Shared leaves in which zeros remove terms."""
    plans: dict[Any, Plan]
    """Plans by zeros, devices, and leaves that stay separate."""


class Step:
    """``step(data, n_steps=1) -> data``, pure: usable inside jit, vmap, grad and scan.

    If ``n_steps`` is an array, one compilation serves every number of steps. If it is a Python integer, the loop can be
    differentiated in reverse mode.

    Data is stepped on the devices that hold it. Under a trace its devices are unknown, and the step runs on the devices
    that it was built for.

    Terms that shared parameters multiply by zero are left out. Under a trace the values are unknown, and all terms are
    computed; ``step.with_zeros_of(data)`` leaves out those that vanish for the parameters of ``data``.
    """

    def __init__(
        self,
        pipeline: Mapping[str, Callable[..., Any]],
        engine: str = "auto",
        platform: str = "cpu",
        mesh: Mesh | None = None,
        *,
        device: jax.Device | None = None,
        strict: bool = False,
        check_data: Callable[[Any], None] | None = None,
    ):
        if not isinstance(engine, str) or engine not in ENGINES:
            raise ConfigError(f"expected an engine of {', '.join(ENGINES)}, got {engine!r}. Use 'auto'.")
        if engine == "fused" and (reason := fused.unavailable_reason(platform)):
            raise ConfigError(f"engine 'fused' cannot run here: {reason}. Use engine='lanes', or 'auto'.")
        self.engine, self.platform, self.mesh, self.strict = engine, platform, mesh, strict
        self._check_data = check_data
        devices = tuple(mesh.devices.flat) if mesh is not None else None if device is None else (device,)
        self.location = Location(platform, devices, mesh, WORLD_AXIS)
        self.stages = as_stages(pipeline)
        self._structures: dict[Any, _Structure] = {}
        self._zeros: Zeros | None = None
        """Zeros from ``with_zeros_of``; None to look for them in the data."""
        self._reported: set[str] = set()
        self._called: set[tuple[int, int | None]] = set()
        """Calls so far: id of the plan, and the number of steps, or None for an array."""
        self._zeros_cache = ZerosCache()
        self._pack_cache = PackCache()
        self._home_sharding: Any = None
        """Last sharding that was found to be at ``location``."""
        self._false_flag: Any = None
        """Value of ``Roles.cleared`` in the data of the last call."""

    def without_stages(self, names: Collection[str]) -> Step:
        """Return a step without the stages of some names."""
        return self.with_stages([stage for stage in self.stages if stage.__name__ not in names])

    def with_stages(self, stages: Sequence[Stage]) -> Step:
        """Return a step of other stages, with the engine and the devices of this step."""
        names = [stage.__name__ for stage in stages]
        if repeated := sorted({name for name in names if names.count(name) > 1}):
            raise ConfigError(f"expected stages of different names, got {', '.join(repeated)} twice. Rename yours.")
        devices = self.location.devices
        device = devices[0] if self.mesh is None and devices is not None else None
        pipeline = {stage.__name__: stage for stage in stages}
        return Step(
            pipeline, self.engine, self.platform, self.mesh, device=device, strict=self.strict,
            check_data=self._check_data,
        )  # fmt: skip

    def with_zeros_of(self, data: Record | None) -> Step:
        """Return this step for data with the zeros that shared parameters have in ``data``, traced or not.

        Args:
            data: The data, not traced; None for data in which no number is known to be zero.
        """
        step = copy.copy(self)  # both share their plans
        step._zeros = ()
        if data is not None:
            structure, leaves = self._flat_structure(data)
            step._zeros = self._zeros_cache(structure.parameters, leaves)
        return step

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Step) and (self._structures is other._structures and self._zeros == other._zeros)

    def __hash__(self) -> int:
        return hash((id(self._structures), self._zeros))

    def __call__(self, data: T, n_steps: int | Array = 1) -> T:
        _check_steps(n_steps)
        structure, leaves = self._flat_structure(data)
        plan = self._plan(data, structure, leaves, n_steps)
        leaves_after = self.advance(FlatData(self._all_leaves(plan, leaves), plan), n_steps).leaves[: len(leaves)]
        if (cleared := structure.roles.cleared) is not None:
            leaves_after[cleared] = self._make_false_flag(leaves_after[cleared])
        return structure.treedef.unflatten(leaves_after)

    def flatten(self, data: Record, n_steps: int | Array | None = None, separate: SeparateLeaves = None) -> FlatData:
        """Flatten the data for ``advance``.

        Args:
            n_steps: Number of steps of the type that will be passed to ``advance``, of any value; None means an array.
            separate: Leaves that stay separate arrays. If one kernel runs the whole step, the other leaves that it
                writes, except random keys, are stored as rows of a few arrays, one for each scope and type. This makes
                loops over calls faster. None to store no leaf as rows.
        """
        structure, leaves = self._flat_structure(data)
        plan = self._plan(data, structure, leaves, n_steps, separate)
        return FlatData(self._all_leaves(plan, leaves), plan)

    def require_own(self, flat: object) -> None:
        """Check that flat data is the result of ``flatten`` or ``advance`` of this step."""
        if not isinstance(flat, FlatData) or flat.plan not in self._plans:
            raise ConfigError(
                f"expected flat data of this step, got "
                f"{'that of another' if isinstance(flat, FlatData) else short_repr(flat)}. Use the result of flatten "
                f"or advance of the same environment or step."
            )

    def advance(self, flat: FlatData, n_steps: int | Array) -> FlatData:
        """Advance the data by some steps, still flattened."""
        plan = flat.plan
        step, inputs = plan.static_count_step if isinstance(n_steps, int) else plan.traced_count_step, flat.inputs()
        if plan.numpy_step is not None and not any(isinstance(x, jax.core.Tracer) for x in (*inputs, n_steps)):
            step = plan.numpy_step  # the step of engine 'interpret', written in NumPy
        call_key = id(plan), n_steps if isinstance(n_steps, int) else None
        with keep_programs(enabled=call_key not in self._called):
            outputs = step(inputs, n_steps)
        self._called.add(call_key)
        leaves = replace_leaves(flat.leaves, plan.written_leaves, outputs)  # type: ignore[arg-type]  # a list, except for a host call
        return FlatData(leaves, plan)

    def advance_on_host(self, flat: FlatData, n_steps: int) -> FlatData:
        """Advance the data by some steps without XLA; the plan must have a ``host_call``."""
        plan, leaves = flat.plan, flat.leaves
        host_call: Any = plan.host_call
        if not isinstance(leaves, HostLeaves):
            leaves = host_call.make_host_leaves(leaves, leaves[plan.roles.nonfinite].sharding)
        return FlatData(host_call(leaves, n_steps), plan)

    def plan(self, data: Record) -> Plan:
        """Return the plan that steps this data."""
        return self._plan(data, *self._flat_structure(data))

    def lower(self, data: Record, n_steps: int | Array = 1) -> Any:
        """Lower the step for this data, as ``jax.jit(...).lower`` does, to inspect or to compile it."""
        _check_steps(n_steps)
        flat = self.flatten(data, n_steps)
        step = flat.plan.static_count_step if isinstance(n_steps, int) else flat.plan.traced_count_step
        return step.lower(flat.inputs(), n_steps)

    @property
    def _plans(self) -> list[Plan]:
        return [plan for structure in self._structures.values() for plan in structure.plans.values()]

    @property
    def programs(self) -> list[Program]:
        """Programs of all plans so far, for data of any structure."""
        return [program for plan in self._plans for program in plan.programs]

    @property
    def engines(self) -> list[str]:
        """Engines of all plans so far, sorted and without repetition."""
        return sorted({plan.engine for plan in self._plans})

    def _cache_size(self) -> int:
        count = jaxcompat.n_compilations
        called = [plan.host_call is not None and plan.host_call.was_called for plan in self._plans]
        steps = [step for plan in self._plans for step in (plan.traced_count_step, plan.static_count_step)]
        return sum(called) + sum(map(count, steps))

    def _all_leaves(self, plan: Plan, leaves: list[Any]) -> list[Any]:
        packed = [self._pack_cache([leaves[i] for i in plan.packed])] if plan.packed else []
        rows = [rows.pack(view_leaves(rows.program.views, leaves)) for rows in plan.rows]
        in_rows = [i for rows in plan.rows for i in rows.source_leaves]
        return [*replace_leaves(leaves, in_rows, [None] * len(in_rows)), *packed, *rows]

    def _make_false_flag(self, old_flag: Any) -> Any:
        if old_flag is self._false_flag:
            return old_flag
        traced = isinstance(old_flag, jax.core.Tracer)
        flag = jnp.asarray(False) if traced else jax.device_put(np.False_, getattr(old_flag, "sharding", None))
        if not isinstance(flag, jax.core.Tracer):
            self._false_flag = flag
        return flag

    def _flat_structure(self, data: Record) -> tuple[_Structure, list[Any]]:
        if not isinstance(data, Record):
            raise ConfigError(f"expected the data of a simulation, got {short_repr(data)}. Use sim.data.")
        leaves, treedef = jax.tree.flatten(data)
        try:
            key = (treedef, tuple([(x.shape, x.dtype) for x in leaves]))
        except AttributeError:
            data.check()
            raise
        structure = self._structures.get(key)
        if structure is None:
            data.check()
            axes, roles = Axes(data), data.roles()
            for stage in self.stages:
                axes.writable_scopes(stage)  # raises ConfigError for a population that does not exist
            is_sparse = jax.tree.leaves(leaf_flags(data, "sparse"))
            parameters = [
                i for i, x in enumerate(leaves)
                if axes.scopes[i] == "shared" and (is_sparse[i] or i in roles.parameters)
                and jnp.issubdtype(x.dtype, jnp.floating)
            ]  # fmt: skip
            located = axes.scopes.index(roles.population)
            structure = self._structures[key] = _Structure(treedef, roles, located, tuple(parameters), {})
        return structure, leaves

    def _plan(
        self,
        data: Record,
        structure: _Structure,
        leaves: list[Any],
        n_steps: int | Array | None = None,
        separate: SeparateLeaves = None,
    ) -> Plan:
        zeros = self._zeros_cache(structure.parameters, leaves) if self._zeros is None else self._zeros
        other_location = self._find_other_location(leaves[structure.located])
        key = (zeros, other_location, separate)
        if self._check_data is not None:
            self._check_data(data)
        plan = structure.plans.get(key)
        if plan is None:
            location = self.location if other_location is None else other_location
            planner = Planner(self.stages, self.engine, self.strict, location, self._reported, zeros, separate)

            def trace(plan: Plan) -> None:
                flat = FlatData(jax.eval_shape(lambda leaves: self._all_leaves(plan, leaves), leaves), plan)
                is_static = isinstance(n_steps, int)
                step = plan.static_count_step if is_static else plan.traced_count_step
                step.trace(flat.inputs(), n_steps if is_static else jnp.int32(1))

            plan = structure.plans[key] = planner.plan(data, trace)
        return plan

    def _find_other_location(self, x: Any) -> Location | None:
        sharding = None if isinstance(x, jax.core.Tracer) else getattr(x, "sharding", None)
        if sharding is None or sharding is self._home_sharding:
            return None
        location, home = find_location(x), self.location
        if location.is_distributed:
            is_home = home.mesh is not None and (location.mesh, location.axis) == (home.mesh, home.axis)
        elif home.devices is None or home.mesh is not None:
            is_home = True
        else:  # one host kernel serves all devices of the host
            is_home = location.devices == home.devices or location.platform == home.platform == "cpu"
        if is_home:
            self._home_sharding = sharding
        return None if is_home else location


def _check_steps(n_steps: Any) -> None:
    is_array = isinstance(n_steps, (jax.Array, np.ndarray, np.generic))
    is_integer = jnp.issubdtype(n_steps.dtype, jnp.integer) if is_array else isinstance(n_steps, int)
    if not is_integer or isinstance(n_steps, bool) or np.shape(n_steps):
        raise ConfigError(
            f"expected a number of steps as one integer, got {short_repr(n_steps)}. Use 5, or jnp.int32(5)."
        )
    if isinstance(n_steps, jax.core.Tracer):
        return
    if int(n_steps) < 0:
        raise ConfigError(f"expected a number of steps of at least 0, got {n_steps}. To go back, keep earlier data.")
    if int(n_steps) > MAX_STEPS:
        raise ConfigError(f"expected at most {MAX_STEPS} steps in a call, got {n_steps}. Use several calls.")
