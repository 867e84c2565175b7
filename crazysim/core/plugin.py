"""Plugins: optional parts of a simulation, such as effects, sensors and logs, all added with ``sim.add``.

A plugin is numbers, states and stages. ``data.plugins[plugin.name]`` has the same class with arrays, or the record that
``record`` returns: everything that changes, and every number that may be replaced without compiling the step again.
Most methods are written for one drone.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self, TypeVar, dataclass_transform

import jax
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, DTypeLike

from crazysim.core.data import Objects, SimData, SimStateDeriv
from crazysim.core.pipeline import Pipeline
from crazysim.core.settings import Setting, check_settings, setting
from crazysim.drones import Airframe
from crazysim.engine.pytree import CORE_NDIM_KEY, Members, PyTree, Scope, device_array
from crazysim.engine.stage import Stage
from crazysim.errors import ConfigError, UnknownNameError, expect, require, short_repr
from crazysim.tables import ANY_NUMBER, Range, Shapes, range_between, read_numbers

P = TypeVar("P", bound="Plugin")

Param = Any
"""A number of a plugin: what a user writes, such as 0.1, a list or an array, and an array in ``data.plugins``."""
CoreShape = tuple[int | str, ...]
"""Shape of an array of one drone, with ``"rotors"`` for the number of its rotors, and any other name for a length that
``bind`` decides."""


class Simulation(Protocol):
    """The attributes of ``crazysim.Sim`` that plugins use."""

    data: SimData
    default_data: SimData
    step_pipeline: Pipeline
    reset_pipeline: Pipeline
    airframes: tuple[Airframe, ...]
    integrator: Any
    n_worlds: int
    n_drones: int
    plugins: Mapping[str, Plugin]
    lock: AbstractContextManager[object]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all drones and members of populations."""
        ...

    @property
    def scene(self) -> Any: ...

    @property
    def airframe(self) -> Airframe:
        """Airframe of all drones; raises an error if the drones have different airframes."""
        ...

    def add(self, plugin: P, name: str | None = None) -> P:
        """Add a plugin and return it."""
        ...

    def build_step_fn(self) -> object: ...


@dataclasses.dataclass(frozen=True)
class StagePlacement:
    """A stage of a plugin and its position in the step pipeline."""

    stage: Callable[[SimData], SimData]
    """The stage, declared with ``crazysim.stage``."""
    before: str = "integration"
    """Name of the stage before which it is inserted: ``"increment_steps"`` for a stage that measures or judges what a
    step has done, and ``"measurements"``, the first of these, for one that moves something after the integration."""
    replaces: str | None = None
    """Name of a stage to replace; if the pipeline has none of that name, ``before`` is used. Removing the plugin
    restores the replaced stage."""
    name: str | None = None
    """Name of the stage; None for the name of the plugin."""


def param(
    *,
    default: Any = dataclasses.MISSING,
    core: CoreShape = (1,),
    scope: Scope = "parameter",
    airframe: str | Callable[[Airframe], ArrayLike] | None = None,
    low: float = -np.inf,
    high: float = np.inf,
    positive: bool = False,
    per_axis: bool = False,
    dtype: DTypeLike | None = None,
    whole: bool = False,
    shapes: Shapes | None = None,
    sparse: bool = False,
    keep: bool = True,
    constant: bool = False,
) -> Any:
    """Declare a number of a plugin, which is an array in ``data.plugins``; another value compiles nothing.

    Args:
        default: Default value; None for the airframe's value, or for none.
        core: Shape of the number of one drone.
        scope: ``"parameter"`` for a number for all drones or one per drone, ``"shared"`` for one for all drones, or
            ``"drone"`` for a state that begins an episode with this number; ``"member"`` in a population.
        airframe: Dotted path or function of the airframe that gives the number if it is None.
        positive: Whether to refuse zero and negative values.
        per_axis: Whether to accept one number for all axes of a vector.
        dtype: Type; None for the type of the states.
        whole: Whether it is a whole number, of the type of the states unless ``dtype`` is another.
        shapes: Shapes of a shared number, ``"any"`` for an axis of any length.
        sparse: As in ``crazysim.engine.pytree.leaf``.
        keep: False for a number that only ``bind`` reads, to calculate others; it is None in ``data.plugins``.
        constant: Whether ``sim.replace`` sets a number of each member, as it sets parameters: one that no step changes.
    """
    declaration = Setting(
        range_between(low, high, positive), True, per_axis, np.int32 if whole and dtype is None else dtype, shapes
    )
    metadata: dict[str, Any] = {"setting": declaration}
    if keep:
        metadata |= _leaf_metadata(scope, core, sparse=sparse, dtype=dtype, airframe=airframe, constant=constant)
    return dataclasses.field(default=default, metadata=metadata | {"static": not keep, "keep": keep})


def state(
    core: CoreShape = (1,),
    *,
    scope: Scope = "drone",
    dtype: DTypeLike | None = None,
    optional: bool = False,
    sparse: bool = False,
    scratch: bool = False,
    init: Literal[False] = False,  # noqa: ARG001
) -> Any:
    """Declare a state of a plugin: an array in ``data.plugins`` that the plugin changes, zero at first.

    Args:
        core: Shape of the state of one drone, or of one world.
        scope: ``"drone"`` or ``"world"``; ``"member"`` in a population.
        dtype: Type; None for the type of the states.
        optional: Whether the state is None unless ``bind`` gives it a value.
        sparse: As in ``crazysim.engine.pytree.leaf``.
        scratch: As in ``crazysim.engine.pytree.leaf``.
        init: For type checkers: users do not set states.
    """
    return dataclasses.field(
        default=None,
        kw_only=True,
        repr=False,
        metadata=_leaf_metadata(scope, core, sparse=sparse, scratch=scratch, dtype=dtype, optional=optional),
    )


def derived(
    core: CoreShape = (1,),
    *,
    scope: Scope = "parameter",
    sparse: bool = False,
    init: Literal[False] = False,  # noqa: ARG001
) -> Any:
    """Declare a parameter that ``bind`` calculates from others, None by default; ``init`` as for ``state``."""
    return dataclasses.field(
        default=None,
        kw_only=True,
        repr=False,
        metadata=_leaf_metadata(scope, core, sparse=sparse, scratch=False, dtype=None, optional=True, constant=True),
    )


def nested(*, default: PyTree | None) -> Any:
    """Declare a record with numbers and states of its own, which ``bind`` makes, from what the user wrote if any."""
    return dataclasses.field(
        default=default, repr=default is not None, metadata={"static": False, "setting": Setting(is_parameter=True)}
    )


def _leaf_metadata(scope: Scope, core: CoreShape, **details: Any) -> dict[str, Any]:
    fixed_core = None if any(isinstance(n, str) for n in core) or scope == "shared" else core
    declared = {"scope": scope, CORE_NDIM_KEY: len(core), "core": fixed_core, "shape": core}
    return {"sparse": False, "scratch": False} | declared | details


def _declare_static_fields(cls: type) -> None:
    inherited = {f.name: f for base in reversed(cls.__mro__[1:])
                 for f in vars(base).get("__dataclass_fields__", {}).values()}  # fmt: skip
    for name, hint in inspect.get_annotations(cls).items():
        if "ClassVar" in str(hint) or name == "_":
            continue
        field = vars(cls).get(name, dataclasses.MISSING)
        if not isinstance(field, dataclasses.Field):
            field = dataclasses.field(default=field)
            setattr(cls, name, field)
        # A positional field would stand where the base class has it, in front of the fields of the new class.
        field.kw_only = getattr(inherited.get(name), "kw_only", False) or field.kw_only
        metadata = {**getattr(inherited.get(name), "metadata", {}), **field.metadata}
        if not metadata.keys() & {"scope", "static"}:
            metadata["static"] = True
        field.metadata = MappingProxyType(metadata)


def airframe_numbers(sim: Simulation, get_number: Callable[[Airframe], ArrayLike], core: CoreShape = ()) -> np.ndarray:
    """Return a quantity of the airframes for ``check_parameter``: one value for all drones, or one per drone.

    Args:
        get_number: Function from an airframe to a number or array. (*core)
        core: Shape with ``"rotors"`` to pad the arrays with zeros for rotors that a drone lacks; other shapes change
            nothing.

    Returns:
        (*core), or (n_worlds, n_drones, *core) where the drones have several airframes
    """
    distinct_airframes = {id(airframe): airframe for airframe in sim.airframes}
    values = {key: np.asarray(get_number(airframe)) for key, airframe in distinct_airframes.items()}
    if "rotors" in core:
        n_rotors = sim.data.states.rotor_vel.shape[-1]
        values = {
            key: np.pad(
                x, [(0, n_rotors - n if axis == "rotors" else 0) for n, axis in zip(x.shape, core, strict=True)]
            )
            for key, x in values.items()
        }
    first_value = next(iter(values.values()))
    if len(distinct_airframes) == 1:
        return first_value
    per_drone = np.stack([values[id(airframe)] for airframe in sim.airframes])
    return np.broadcast_to(per_drone, (sim.n_worlds, *per_drone.shape))


def check_parameter(
    sim: Simulation,
    name: str,
    value: ArrayLike,
    core: tuple[int, ...] = (1,),
    allowed: Range = ANY_NUMBER,
    dtype: DTypeLike | None = None,
    per_axis: bool = False,
    n_members: int | None = None,
) -> Array:
    """Return a setting as an array that all drones share, or with one entry per drone.

    Args:
        value: One number for every entry (not for vectors), ``core``, or (n_worlds, n_drones, *core); the last axis
            may be omitted where it has length one.
        core: Shape of the value of one drone.
        allowed: Range of all entries, such as ``crazysim.tables.range_between(low=0.0)``.
        dtype: Type; None for the type of the states.
        per_axis: Whether to accept one number for all axes of a vector.
        n_members: Number of members of a population, for a number of its members instead of the drones; it may also be
            (n_members, *core), the same in all worlds.

    Returns:
        (*core) or (n_worlds, n_drones, *core)
    """
    batch, array, kind = sim.data.states.pos.shape[:2], np.asarray(value), "drone"
    batches = [batch]
    if n_members is not None:
        batch, kind = (sim.n_worlds, n_members), "member"
        batches = [(n_members,), batch]
    if core == (1,) and array.shape in batches and array.shape != core:
        array = array[..., None]
    is_number = array.dtype.kind in ("iu" if dtype is not None and np.issubdtype(dtype, np.integer) else "iuf")
    is_shared = array.shape == core or (array.ndim == 0 and (per_axis or core != (3,)))
    require(
        is_number and (is_shared or array.shape in [(*x, *core) for x in batches]),
        f"expected {name} as {'whole' if dtype is not None else 'real'} numbers of shape {core} for all {kind}s, or "
        f"{(*batch, *core)} = (n_worlds, n_{kind}s, {', '.join(map(str, core))}) for each, got shape "
        f"{array.shape} and type {array.dtype}",
    )
    array = read_numbers(name, array, allowed, whole=array.dtype.kind != "f")
    dtype = sim.data.states.pos.dtype if dtype is None else dtype
    return device_array(np.broadcast_to(array, core if is_shared else (*batch, *core)), dtype)


def drone_array(sim: Simulation, value: ArrayLike, *core: int) -> Array:
    """Return a number for every drone, of the states' type. (n_worlds, n_drones, *core)"""
    shape = (*sim.data.states.pos.shape[:2], *core)
    return device_array(np.broadcast_to(value, shape), sim.data.states.pos.dtype)


def bind_leaf(
    sim: Simulation, name: str, value: Any, metadata: Mapping[str, Any], n_members: int | None = None
) -> Array | None:
    """Return the array of a field for all worlds.

    Args:
        value: The user's number, or None.
        metadata: Declaration of the field.
        n_members: Number of members of the population to which the field belongs; None for a field of drones.
    """
    scope, dtype = metadata["scope"], metadata["dtype"] or sim.data.states.pos.dtype
    core = tuple([sim.data.states.rotor_vel.shape[-1] if n == "rotors" else n for n in metadata["shape"]])
    declaration = metadata.get("setting", Setting())
    if value is None and (source := metadata.get("airframe")) is not None:
        get_number: Any = source if callable(source) else lambda airframe: airframe.value(source)
        value = airframe_numbers(sim, get_number, metadata["shape"])
    if value is None and (metadata.get("optional") or "setting" in metadata):
        return None
    if scope == "shared":
        return device_array(np.array(value, ndmin=len(core)), dtype)
    n_members = None if scope == "drone" else n_members
    batch = sim.n_worlds, 1 if scope == "world" else sim.n_drones if n_members is None else n_members
    if value is None or scope == "world":
        return device_array(np.broadcast_to(value or 0, (*batch, *core)), dtype)
    array = check_parameter(
        sim, name, value, core, declaration.range, metadata["dtype"], declaration.per_axis, n_members
    )
    return array if scope == "parameter" else device_array(np.broadcast_to(array, (*batch, *core)), dtype)


def as_tuples(value: Any, arrays: bool = True) -> Any:
    """Return lists, and arrays if they are allowed, as tuples, which are hashable; other values as they are."""
    value = value.tolist() if arrays and hasattr(value, "tolist") else value
    return tuple([as_tuples(x, arrays) for x in value]) if type(value) in (list, tuple) else value


Requirement = type | Callable[[Simulation, Any], None]
"""A class of plugins, one of which must be added too, or a function that raises an error."""


@dataclass_transform(
    frozen_default=True,
    eq_default=False,
    field_specifiers=(param, state, derived, nested, setting, dataclasses.field),
)
class Plugin(PyTree):
    """Base class of everything that ``sim.add`` adds: an effect, a sensor, a log.

    A plugin is numbers, declared with ``param``, states, declared with ``state``, and stages. Other annotated fields,
    including ``name``, are hashable settings; the class becomes a frozen dataclass. ``sim.add`` binds it:
    ``data.plugins[plugin.name]`` is the same plugin with arrays, and the methods below are called on it. Methods that
    take ``data`` are written for one drone, unless they say otherwise: leaves of drones and worlds have no batch axes,
    so ``data.states.pos`` and ``self.noise`` are (3,).
    """

    if TYPE_CHECKING:  # each class lists it among its own fields, with its default

        @property
        def name(self) -> str:
            """Name of the plugin: its key in ``data.plugins``, and the name of its stage."""
            ...

    is_bound: bool = dataclasses.field(default=False, kw_only=True, repr=False, metadata={"static": True})
    """True for a plugin in ``data.plugins``, with arrays."""
    replaces: ClassVar[tuple[str, ...]] = ()
    """Terms of the dynamics model that the plugin replaces or adds, such as ``"drag"``, declared as
    ``class Plugin(..., replaces=("drag",))``. Two plugins that replace the same term are refused."""
    requires: ClassVar[tuple[Requirement, ...]] = ()
    """Requirements on the simulation, declared as ``class Plugin(..., requires=Rotors)``: classes of other plugins, or
    functions of the simulation and the plugin that raise an error."""
    order: ClassVar[int] = 0
    """Influences are applied in ascending order, and by name within the same order. Plugins that replace commands
    have a negative order, so that other plugins can limit the new commands."""
    coupling: ClassVar[Literal["drone", "world"]] = "drone"
    """Scope that ``constrain`` is written for: the data of one drone, or of one world."""
    reset_before: ClassVar[str | None] = None
    """Name of the stage before which ``reset_episode`` is called in the first step of an episode, because it uses
    results of earlier stages. None to call it at resets, and again in the first step, before all other stages."""

    def __init_subclass__(
        cls,
        replaces: tuple[str, ...] = (),
        requires: Requirement | tuple[Requirement, ...] = (),
        abstract: bool = False,
        **kwargs: Any,
    ) -> None:
        # An abstract class leaves the field ``name`` to its subclasses.
        if replaces:
            cls.replaces = replaces
        cls.requires = (*cls.requires, *(requires if isinstance(requires, tuple) else (requires,)))
        _declare_static_fields(cls)
        super().__init_subclass__(**kwargs)
        require(
            abstract or "name" in {f.name for f in dataclasses.fields(cls)},  # type: ignore[arg-type]
            f"plugin {cls.__name__} has no field 'name'; add one, such as name: str = 'my_plugin'",
            TypeError,
        )

    def __post_init__(self) -> None:
        if self.is_bound is not True:
            self.check_settings()

    def check_settings(self) -> None:
        """Check the settings that do not depend on a simulation."""
        check_settings(self)

    def bind(self, sim: Simulation) -> Self:
        """Return the plugin with arrays, as it will be in ``data.plugins``; check it with the simulation.

        Override it for numbers that follow from others: ``return self.with_arrays(sim, radius=...)``.
        """
        return self.with_arrays(sim)

    def with_arrays(self, sim: Simulation, **values: Any) -> Self:
        """Return the plugin with arrays for its numbers and states: the given values, the user's, the airframe's or 0.

        Args:
            values: Values of fields. If a value is None, the user's number is still checked.
        """
        bound: dict[str, Any] = {**values, "is_bound": True}
        n_members = self.n_members if isinstance(self, Members) else None
        for field in dataclasses.fields(self):
            name, value, metadata = field.name, getattr(self, field.name), field.metadata
            if "scope" in metadata and values.get(name) is None:
                bound.setdefault(name, bind_leaf(sim, name, value, metadata, n_members))
            elif not metadata.get("keep", True):
                bound.setdefault(name, None)
            elif metadata.get("static"):
                bound[name] = value = as_tuples(bound.get(name, value), arrays="setting" in metadata)
                try:
                    hash(value)
                except TypeError:
                    raise ConfigError(
                        f"expected {name} of {type(self).__name__} to be hashable, got {short_repr(value)}. Declare "
                        f"numbers with param(...), or use a tuple."
                    ) from None
        return self.replace(**bound)

    def bound(self, data: SimData) -> Self:
        """Return the plugin with the arrays of data of any scope; the plugin itself if it has none."""
        record = data.plugins.get(self.name)
        return record if isinstance(record, type(self)) else self

    def stage(
        self, method: Callable[[SimData], SimData], scope: str | None = None, when: Any = None, **details: Any
    ) -> Stage:
        """Return a stage that calls a method of this class on the plugin in ``data.plugins``.

        Args:
            scope: Scope that the method is written for; None for ``self.scope``.
            when: As in ``crazysim.stage``.
            details: Further arguments of ``Stage``.
        """
        expect(
            hasattr(method, "__func__"), "a method of the plugin as its stage", method, "Use self.stage(self.act), say."
        )
        return Stage(BoundMethod(self, method.__func__), scope or self.scope, when, **details)  # type: ignore[attr-defined]

    @property
    def is_dynamic(self) -> bool:
        """Whether the integrator must call ``influence``, ``derivative`` or ``constrain``."""
        cls = type(self)
        is_overridden = cls.influence is not Plugin.influence or cls.derivative is not Plugin.derivative
        return is_overridden or self.constrains

    @property
    def constrains(self) -> bool:
        """Whether the plugin overrides ``constrain``, which joins bodies of the plugin to drones."""
        return type(self).constrain is not Plugin.constrain

    @property
    def scope(self) -> str:
        """Scope of the plugin's own states, and of the data that ``derivative`` and ``reset_episode`` take."""
        return "drone"

    @property
    def companions(self) -> Mapping[str, type]:
        """Names and classes of plugins that must be added before, because ``bind`` or ``stages`` read them.

        If one of them is replaced, both are called again.
        """
        return {}

    def with_companions(self, plugins: Mapping[str, Plugin]) -> Self:
        """Return the plugin for the companions of a simulation, by name, if its settings hold any."""
        return self

    @property
    def replaced_terms(self) -> tuple[str, ...]:
        """Terms of the dynamics model that the plugin replaces with its settings; by default those of its class."""
        return self.replaces

    @classmethod
    def has_arrays(cls) -> bool:
        """Whether the class declares numbers, states or records of them."""
        return not all(f.metadata.get("static") for f in dataclasses.fields(cls))

    def record(self, sim: Simulation) -> PyTree | None:
        """Return what ``data.plugins`` has for all worlds: the plugin with arrays, or None if it needs none."""
        if not self.has_arrays():
            return None
        remedy = "Return self.with_arrays(sim, ...) there."
        expect((bound := self.bind(sim)) is not None, f"the plugin from {type(self).__name__}.bind", bound, remedy)
        return bound

    def default_record(self, sim: Simulation) -> PyTree | None:
        """Return the record that resets restore; by default the result of ``record``."""
        return self.record(sim)

    def carry_over(self, record: Any, old_record: Any) -> Any:
        """Return the record after ``sim.replace`` or an edit of the scene, with states of the previous record.

        Override it for states whose shape has changed. All other states are in ``record`` already.
        """
        return record

    def check_plugins(self, sim: Simulation) -> None:
        """Check the simulation with all of its plugins, before its first step; plugins may be added in any order.

        A plugin on which the check depends cannot be removed.
        """
        self._require_plugins(sim, [(None, kind) for kind in self.requires if isinstance(kind, type)])
        self._require_plugins(sim, self.companions.items())

    def _require_plugins(self, sim: Simulation, needed: Iterable[tuple[str | None, type]]) -> None:
        for name, kind in needed:
            require(
                any(isinstance(other, kind) and name in (None, other.name) for other in sim.plugins.values()),
                f"expected a simulation with a {kind.__name__}{f' named {name!r}' if name else ''}, which "
                f"{type(self).__name__} {self.name!r} needs, got {', '.join(map(repr, sim.plugins)) or 'no plugin'}. "
                f"Use sim.add to add it first.",
            )

    def check_simulation(self, sim: Simulation) -> None:
        """Check the requirements of the class on the simulation that the plugin is being added to."""
        for requirement in self.requires:
            if not isinstance(requirement, type):
                requirement(sim, self)
        self._require_plugins(sim, self.companions.items())

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        """Return the stages of the plugin with their positions, in the order in which they are inserted."""
        return ()

    def reset_episode(self, data: SimData) -> SimData:
        """Return the data of one drone, or of ``scope``, at the beginning of an episode.

        It may write leaves of that scope, such as values that are drawn for an episode. It is called at resets. It is
        called again in the first step of every episode, also in worlds that were never reset, before all other stages
        and with the same random numbers. A second call must not change the result of the first call, as adding to a
        leaf would. Environments omit the call in the first step, since all of their episodes begin with a reset. With
        ``reset_before``, it is called only in the first step, before that stage.
        """
        return data

    def with_drawn_numbers(self, data: SimData) -> SimData:
        """Return data of any scope with the numbers that this plugin has drawn, such as ``Randomize``.

        Dynamics, controllers and stages of plugins compute with them; ``sim.data`` keeps the nominal numbers. A plugin
        that overrides it begins episodes before all other plugins. A second call must return the data as it is.
        """
        return data

    def known_data(self, data: SimData) -> SimData:
        """Return the data of any scope that the plugin's stages receive: by default with all numbers as drawn.

        Numbers that differ from those of ``data`` keep their nominal values, whatever a stage returns.
        """
        return drawn_data(data)

    @property
    def resets_episode(self) -> bool:
        """Whether ``reset_episode`` must be called."""
        return type(self).reset_episode is not Plugin.reset_episode

    def influence(self, data: SimData) -> SimData:
        """Return the data of one drone with changed forces, commands or parameters, for the dynamics to use.

        It may write ``states.force``, ``states.torque``, ``controls.rotor_vel`` (``controls.attitude.cmd`` in fitted
        dynamics) and any field of ``params``; all other fields are returned as they are. The integrator evaluates it
        for every time derivative, and discards the changes afterwards: external forces, commands and parameters in
        ``sim.data`` stay as the user set them.
        """
        return data

    def derivative(self, data: SimData) -> Mapping[str, Array]:
        """Return the time derivatives of the plugin's states, per second, by their fields of the record.

        All integrators advance these states together with the drone's states. ``data`` is of one drone, with the
        influences of all plugins applied. A derivative has the shape of its field, which is declared with ``state``.
        """
        return {}

    def constrain(self, data: SimData, deriv: SimStateDeriv, dt: float | None) -> SimStateDeriv:
        """Return the derivative with the reaction of bodies that are joined to the drone, and the rates of the bodies.

        A joint is a constraint: the accelerations of drone and joined body follow from one system of equations.
        ``deriv`` is the derivative of the drone without the joint. The reaction is added to ``acc`` and ``ang_acc``,
        and the rates of fields of the record are put into ``deriv.plugins[self.name]``. A simulation has at most one
        plugin that constrains.

        Args:
            data: Data of one drone with all influences applied. If ``coupling`` is ``"world"``, data of one world
                without influences.
            deriv: Derivative of the free drone or drones.
            dt: Duration of the step, s, in schemes of order 1. An impulse in the step is then returned as its mean
                acceleration, and its change of velocity is also added to ``vel`` and ``ang_vel``, with which the scheme
                moves position and attitude. None for the derivative at an instant.
        """
        return deriv

    def move_objects(self, data: SimData) -> Objects:
        """Return ``data.objects`` of one world with the plugin's objects at their poses.

        It is called when the scene is read, and by queries of the scene within a step.
        """
        return data.objects  # type: ignore[return-value]

    @property
    def moved_kinds(self) -> tuple[str, ...] | None:
        """Names of the objects that ``move_objects`` moves, such as ``"pole"`` for ``pole:0``; None for any object."""
        return None

    @property
    def moves_objects(self) -> bool:
        """Whether the plugin moves objects of the scene by ``move_objects``."""
        return type(self).move_objects is not Plugin.move_objects

    def observations(self, data: SimData) -> dict[str, Array]:
        """Return named measurements of one drone. (k,) each"""
        return {}

    def measured_states(self, data: SimData) -> dict[str, Array]:
        """Return the measured values of some fields of ``data.states`` of one drone, by field."""
        return {}

    def draw(self, sim: Simulation, world: int) -> None:
        """Draw overlays into the next image of a world, on ``sim.scene``."""

    def read(self, data: SimData) -> Any:
        """Return the plugin with the arrays of data of any scope, or its record.

        Raises:
            UnknownNameError: If the data has none: the plugin was not added, or was removed.
        """
        require(
            self.name in data.plugins,
            f"expected data with a record of plugin {self.name!r}, got records of "
            f"{', '.join(map(repr, data.plugins)) or 'none'}. The plugin was not added, was removed, or has no "
            f"record. Use sim.add({type(self).__name__}(...)) first.",
            UnknownNameError,
        )
        return data.plugins[self.name]

    def write(self, data: SimData, record: PyTree | None = None, **changes: Any) -> SimData:
        """Return data of any scope with another record of this plugin, or with other values of some of its fields."""
        record = self.read(data) if record is None else record
        return data.replace(plugins=data.plugins | {self.name: record.replace(**changes)})


@dataclasses.dataclass(frozen=True)
class BoundMethod:
    """Function of a stage: a method that is called on the plugin in ``data.plugins``."""

    plugin: Plugin
    """The plugin that was added."""
    method: Callable[[Any, SimData], Any]
    """The method, a function of the plugin and the data."""

    @property
    def __name__(self) -> str:
        return self.method.__name__

    def __call__(self, data: SimData) -> Any:
        known_data = self.plugin.known_data(data)
        after = self.method(self.plugin.bound(known_data), known_data)
        if known_data is data or not isinstance(after, SimData):
            return after
        leaves, known_leaves, new_leaves = map(jax.tree.leaves, (data, known_data, after))
        if len(new_leaves) != len(leaves):
            return after  # the engine explains it
        nominal = [new if x is y else x for x, y, new in zip(leaves, known_leaves, new_leaves, strict=True)]
        return jax.tree.structure(data).unflatten(nominal)


def drawn_data(data: SimData) -> SimData:
    """Return data of any scope with the numbers that plugins have drawn; the data itself if none have."""
    for record in data.plugins.values():
        if isinstance(record, Plugin):
            data = record.with_drawn_numbers(data)
    return data


def check_plugin_list(name: str, plugins: Sequence[Plugin]) -> Sequence[Plugin]:
    example = {"sensors": "IMU()", "camera": "Camera(16, 12)"}.get(name, "Wind()")
    is_list = isinstance(plugins, (list, tuple)) and all(isinstance(plugin, Plugin) for plugin in plugins)
    expect(is_list, f"{name} as a list of plugins", plugins, f"Use {name}=[{example}], say.")
    return plugins


def with_measured_states(plugins: Sequence[Plugin], data: SimData) -> SimData:
    """Return the data of one drone in which true states are replaced by the values that plugins measure.

    Args:
        plugins: The plugins; if several measure the same state, the last one is used.
    """
    measured = {}
    for plugin in plugins:
        measured |= plugin.bound(data).measured_states(data)
    return data.replace(states=data.states.replace(**measured))


class FunctionPlugin(Plugin):
    """A plugin made of a record and functions, for parts that need no class."""

    name: str
    data: PyTree | None = None
    """The record for all worlds."""
    placements: Sequence[StagePlacement] = ()
    """The stages with their positions."""
    influence_fn: Callable[[SimData], SimData] | None = None
    """The influence on the dynamics, for one drone; None for none."""
    default: PyTree | None = None
    """The record that resets restore; None for ``data``."""

    @property
    def is_dynamic(self) -> bool:
        return self.influence_fn is not None

    def record(self, sim: Simulation) -> PyTree | None:
        return self.data

    def default_record(self, sim: Simulation) -> PyTree | None:
        return self.data if self.default is None else self.default

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        return self.placements

    def influence(self, data: SimData) -> SimData:
        return data if self.influence_fn is None else self.influence_fn(data)
