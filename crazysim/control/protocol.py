"""The protocol of controllers: settings, parameters and memory, and one function from setpoint to command."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, TypeVar, dataclass_transform

import numpy as np
from jax import Array

from crazysim.control.levels import Control
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics.models import AirframeParams
from crazysim.engine.pytree import PyTree, float_dtype
from crazysim.errors import require

R = TypeVar("R", bound=PyTree)

OUTPUT_LEVELS = (Control.attitude, Control.force_torque, Control.rotor_vel)
"""Levels of the commands that controllers return."""


class FlightState(Protocol):
    """The fields of ``crazysim.core.data.SimState`` that controllers read, of one drone."""

    @property
    def pos(self) -> Array:
        """Position, world frame, m. (3,)"""
        ...

    @property
    def quat(self) -> Array:
        """Attitude, body to world, xyzw. (4,)"""
        ...

    @property
    def vel(self) -> Array:
        """Velocity, world frame, m/s. (3,)"""
        ...

    @property
    def ang_vel(self) -> Array:
        """Angular velocity, body frame, rad/s. (3,)"""
        ...

    @property
    def rotor_vel(self) -> Array:
        """Rotor speeds, rpm; with fitted dynamics the thrust, N. (n_rotors,)"""
        ...


class DroneData(Protocol):
    """The parts of ``crazysim.core.data.SimData`` that controllers read, of one drone."""

    @property
    def states(self) -> FlightState: ...

    @property
    def controls(self) -> Any:
        """Commands, ``SimControls``."""
        ...

    @property
    def core(self) -> Any:
        """Time and rates, ``SimCore``."""
        ...

    @property
    def plugins(self) -> Mapping[str, Any]: ...


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(dataclasses.field,))
class Controller:
    """Base class of controllers, which ``Sim(controller=...)`` uses at one of their command levels.

    A subclass lists its settings as annotated fields with defaults, including ``freq``; it becomes a frozen
    dataclass. It names the classes of its records, as in ``class PI(Controller, params=PIGains, memory=PIMemory)``. Its
    methods are pure and written for one drone. A controller with an outer loop, which runs at a lower rate, has a field
    ``outer_freq`` and overrides ``outer``. At the level ``state``, ``outer`` is then called before ``update``.
    """

    name: ClassVar[str]
    """Name of the controller."""
    levels: ClassVar[tuple[Control, ...]]
    """Command levels that the controller follows."""
    output: ClassVar[Control]
    """Level of the commands that the controller returns: ``force_torque`` or ``rotor_vel``, or ``attitude`` with fitted
    dynamics or an ``inner`` controller."""
    freq: int
    """Rate of ``update``, Hz. A default that does not divide the simulation's rate is lowered to the next divisor."""
    outer_freq: int | None = None
    """Rate of ``outer``, Hz; None for a controller without an outer loop."""
    inner: Controller | None = None
    """Controller that follows the commands of this controller; None if allocation, rotors or fitted dynamics do so."""
    follows_feedforward: ClassVar[bool] = True
    """True if a state command may have a ``feedforward``; ``PID`` and ``Mellinger`` accept it but do not use it. If
    False, a command with feedforward is an error."""
    params_type: ClassVar[type[AirframeParams] | None] = None
    """Class of the parameters, declared as ``class PI(Controller, params=PIGains)``."""
    memory_type: ClassVar[type[PyTree] | None] = None
    """Class of the memory, declared as ``class PI(Controller, memory=PIMemory)``."""
    follows_rates: ClassVar[bool] = False
    """Whether the controller also follows the body rates of an attitude command,
    ``data.controls.attitude.staged_ang_vel_des``."""

    def __init_subclass__(
        cls, params: type[AirframeParams] | None = None, memory: type[PyTree] | None = None, **kwargs: Any
    ) -> None:
        super().__init_subclass__(**kwargs)
        cls.params_type, cls.memory_type = params or cls.params_type, memory or cls.memory_type
        dataclasses.dataclass(frozen=True, eq=False)(cls)
        require(
            "freq" in {f.name for f in dataclasses.fields(cls)},  # type: ignore[arg-type]
            f"controller {cls.__name__} has no field 'freq'; add one, such as freq: int = 500",
            TypeError,
        )
        missing_names = [key for key in ("name", "levels", "output") if not hasattr(cls, key)]
        require(
            not missing_names,
            f"controller {cls.__name__} has no class variables {missing_names}; add them",
            TypeError,
        )
        require(
            cls.output in OUTPUT_LEVELS,
            f"controller {cls.__name__}: expected output as one of {OUTPUT_LEVELS}, got {cls.output!r}",
            TypeError,
        )

    def params(self, airframe: Airframe) -> PyTree | None:
        """Return gains and constants for an airframe, in a record of leaves of scope ``parameter``, or None.

        Override it for parameters that do not follow from the declarations of their class alone.
        """
        return None if self.params_type is None else self.params_type.create(airframe)

    def memory(self, airframe: Airframe) -> PyTree | None:
        """Return the memory of one drone at rest, by default zeros, in leaves of scope ``drone``, or None."""
        return None if self.memory_type is None else zeros(self.memory_type)

    def outer(self, data: DroneData, command: Setpoint, memory: Any, params: Any) -> Any:
        """Return the memory after a tick of the outer loop.

        Args:
            data: ``SimData`` of one drone.
        """
        raise NotImplementedError(f"controller {self.name!r} has an outer_freq, and does not define outer")

    def update(self, data: DroneData, command: Setpoint | Array, memory: Any, params: Any) -> tuple[Array, Any]:
        """Return the command of the level ``output``, and the memory after a tick.

        Args:
            data: ``SimData`` of one drone, with the command in force in ``data.controls``. The body rates of a state
                command, which a ``Setpoint`` lacks, are ``data.controls.state.cmd[13:16]``.
            command: Setpoint at the level ``state``; otherwise the command of the level that the controller follows.
                This is the command in force at the level ``data.controls.mode``, or the command of the controller that
                has this controller as ``inner``. (4,)

        Returns:
            A command of the level ``output``, such as collective thrust, N, and body torque, N m (4,), or rotor
            speeds, rpm (n_rotors,); the memory.
        """
        raise NotImplementedError(f"controller {self.name!r} does not define update")

    def take_over(self, data: DroneData, command: Setpoint | Array, memory: Any, params: Any, rotor_vel: Array) -> Any:
        """Return the memory with which the controller takes over a drone in flight from another controller.

        By default, this is the memory at the time when the controller was last active. Override this method to make the
        first command continue the last command of the other controller.

        Args:
            data: ``SimData`` of one drone.
            command: Setpoint or command, as in ``update``.
            memory: Memory at the time when the controller was last active.
            rotor_vel: Rotor speeds that the other controller commanded last, rpm. (n_rotors,)
        """
        return memory

    def adapt(self, control: Control, fitted_model: str | None) -> Controller | None:
        """Return the controller to use for a command level and dynamics; None if commands need none.

        Args:
            fitted_model: Name of the fitted model; None for dynamics with rotors.
        """
        return self

    @property
    def members(self) -> tuple[Controller, ...]:
        """Controllers that take turns; by default only this controller."""
        return (self,)

    @property
    def has_outer(self) -> bool:
        """Whether the controller has an outer loop."""
        return self.outer_freq is not None


def zeros(record: type[R], **values: Any) -> R:
    """Return a record of one drone with the given values, and zeros of their declared core shape for other leaves."""
    fields: Any = dataclasses.fields(record)  # type: ignore[arg-type]
    cores = {field.name: field.metadata.get("core") for field in fields if field.name not in values}
    without_core = [name for name, core in cores.items() if core is None]
    require(
        not without_core,
        f"expected a core shape for {', '.join(without_core)} of {record.__name__}, got none. Use leaf('drone', 1, "
        f"(3,)) for three numbers, say, or override Controller.memory.",
    )
    return record(**{name: np.zeros(core, float_dtype()) for name, core in cores.items()}, **values)


def controller_chain(
    controller: Controller | None, control: Control
) -> tuple[list[tuple[Control, Controller]], Control]:
    """Return the controllers of a command level and of the levels below, and the level of the last output.

    Args:
        controller: Controller of the command level; None if commands need none.

    Returns:
        Pairs of a command level and the controller that follows it, the highest level first, and the level of the
        commands of the last controller, which is ``control`` without a controller.
    """
    chain = []
    while controller is not None:
        chain.append((control, controller))
        control, controller = controller.output, controller.inner
    return chain, control
