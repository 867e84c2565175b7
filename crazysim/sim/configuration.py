"""The checked settings of a simulation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
from jax import Array
from jax.sharding import Mesh
from numpy.typing import ArrayLike

from crazysim.arguments import check_flag
from crazysim.control import Control, Controller
from crazysim.control.controllers import find_controller
from crazysim.core.airframes import AirframeSource, is_airframe_list, load_airframes
from crazysim.core.controls import check_command_level, check_controller, check_same_controllers
from crazysim.core.data import SimData, SimState
from crazysim.core.integration import Integrator
from crazysim.core.plugin import Plugin, check_plugin_list
from crazysim.core.settings import (
    check_rates,
    check_settings,
    control_freqs,
    controller_at_rates,
    enum_member,
    find_device,
    physics_freq,
    positive_integer,
)
from crazysim.drones import Airframe
from crazysim.dynamics import Dynamics
from crazysim.dynamics.models import require_freq, require_support
from crazysim.errors import ConfigError, expect, short_repr

if TYPE_CHECKING:
    from crazysim.plugins.estimators import Estimator

STATE_FIELDS = tuple(field.name for field in dataclasses.fields(SimState))  # type: ignore[arg-type]
MAX_WORLDS = 2_147_483_647
"""Largest number of worlds; their indices are int32."""
MAX_DRONES = 10_000
"""Largest number of drones in a world; each is a body of the scene."""
COMMAND_LEVELS = ("state", "attitude", "body_rate", "force_torque")
"""Fields of ``SimControls`` with the records of command levels."""
COMMAND_FIELDS = ("cmd", "staged_cmd", "feedforward", "staged_feedforward", "staged_ang_vel_des")
"""Fields with commands in the record of a command level; each level has only some of them."""


@dataclasses.dataclass(frozen=True)
class Configuration:
    """Settings of a simulation that are fixed at its construction."""

    n_worlds: int
    """Number of worlds."""
    n_drones: int
    """Number of drones in each world."""
    airframes: tuple[Airframe, ...]
    """Airframe of each drone. (n_drones,)"""
    dynamics: Dynamics
    """Dynamics model."""
    control: Control
    """Command level."""
    integrator: Integrator
    """Integration scheme."""
    freq: int
    """Physics steps per second, Hz."""
    control_freqs: Mapping[Control, int]
    """Rate at which commands of each level in use take effect, Hz."""
    controller: Controller | None
    """Controller of the command level at its rates; None if commands need none."""
    device: jax.Device
    """Device of the data."""
    mesh: Mesh | None
    """Devices over which the worlds are distributed at construction; None for ``device`` only."""
    engine: str
    """Engine that executes steps, one of ``crazysim.engine.ENGINES``."""
    strict: bool
    """Whether to raise an error instead of using a slower engine with a warning."""

    def check(self, data: Any, reference: SimData) -> None:
        """Check that data belong to a simulation with these settings; takes some tens of microseconds.

        The last axes and the types of states and commands are checked too. The step checks the batch axes of all
        leaves.

        Args:
            reference: Data of the simulation.
        """
        try:
            core, controls = data.core, data.controls
            settings = core.n_worlds, core.n_drones, core.freq, controls.mode, controls.rotor_vel is None
        except AttributeError:
            raise ConfigError(
                f"expected the data of a simulation, got {type(data).__name__}. Use sim.data = sim.data.replace(...)."
            ) from None
        is_fitted = self.dynamics != Dynamics.first_principles
        expected_settings = self.n_worlds, self.n_drones, self.freq, self.control, is_fitted
        if settings != expected_settings:
            raise ConfigError(
                f"expected data of {_describe_settings(*expected_settings)}, got data of "
                f"{_describe_settings(*settings)}. Use data of this simulation, or of one with the same settings."
            )
        check_same_controllers(controls, reference.controls, getattr(self.controller, "name", None))
        _check_fields("data.states", data.states, reference.states, STATE_FIELDS)
        for level in COMMAND_LEVELS:
            record, expected_record = getattr(controls, level), getattr(reference.controls, level)
            if record is not expected_record:
                _check_fields(f"data.controls.{level}", record, expected_record, COMMAND_FIELDS)
        _check_fields("data.controls", controls, reference.controls, ("rotor_vel",))

    @staticmethod
    def create(
        n_worlds: int,
        n_drones: int,
        drone: AirframeSource | Sequence[AirframeSource],
        dynamics: Dynamics | str,
        control: Control | str,
        integrator: Integrator | str,
        freq: int,
        rates: Mapping[Control, int | None],
        device: str | jax.Device,
        mesh: Mesh | None,
        engine: str,
        strict: bool,
        controllers: str | Controller | Sequence[str | Controller],
        switch: Callable[..., Array] | ArrayLike | None = None,
    ) -> Configuration:
        """Return the configuration for the arguments of ``Sim``, as users pass them."""
        n_worlds = positive_integer("n_worlds", n_worlds, MAX_WORLDS)
        n_drones = positive_integer("n_drones", n_drones, MAX_DRONES)
        freq = physics_freq(freq)
        n_drones = len(drone) if n_drones == 1 and is_airframe_list(drone) and len(drone) else n_drones
        dynamics, control = enum_member(Dynamics, "dynamics", dynamics), enum_member(Control, "control", control)
        integrator = enum_member(Integrator, "integrator", integrator)
        check_command_level(dynamics, control)
        airframes = load_airframes(drone, n_drones)
        for airframe in dict.fromkeys(airframes):
            require_support(airframe, dynamics)
        controller = find_controller(controllers, switch)
        for member in controller.members:
            check_settings(member)
        controller = controller.adapt(control, None if dynamics == Dynamics.first_principles else dynamics)
        check_controller(dynamics, control, controller)
        check_rates(control, freq, rates)
        controller = controller and controller_at_rates(controller, control, freq, rates)
        freqs = control_freqs(control, freq, rates, controller)
        for airframe in dict.fromkeys(airframes):
            require_freq(airframe, dynamics, freq)  # after the rates, which need a higher freq
        return Configuration(
            n_worlds, n_drones, airframes, dynamics, control, integrator, freq, freqs, controller, find_device(device),
            mesh, engine, check_flag("strict", strict),
        )  # fmt: skip


def initial_plugins(plugins: Sequence[Plugin], estimator: str | Estimator | None, aero: str | None) -> list[Plugin]:
    """Return the plugins of a new simulation: those for ``estimator`` and ``aero``, then the listed plugins."""
    shorthand_plugins: list[Plugin] = []
    if estimator is not None:
        from crazysim.plugins.estimators import find_estimator

        estimator = find_estimator(estimator)
        shorthand_plugins.extend([*estimator.sensors, estimator])
    if aero is not None:
        expect(
            isinstance(aero, str) and aero == "identified",
            "aero='identified' or None",
            aero,
            "Use plugins=[RotorAerodynamics()] for the other forces of the air on rotors.",
        )
        from crazysim.plugins.effects import Residual

        shorthand_plugins.append(Residual())
    return [*shorthand_plugins, *check_plugin_list("plugins", plugins)]


def _check_fields(name: str, record: Any, reference: Any, fields: Sequence[str]) -> None:
    for field in fields:
        value, expected = getattr(record, field, None), getattr(reference, field, None)
        if value is expected:
            continue
        try:
            is_alike = value.shape[-1:] == expected.shape[-1:] and value.dtype.kind == expected.dtype.kind
        except AttributeError:
            is_alike = False
        if not is_alike:
            expected_text, actual_text = map(_describe_leaf, (expected, value))
            raise ConfigError(
                f"expected {name}.{field} as {expected_text}, got {actual_text}. Use an array like that of "
                f"sim.default_data."
            )


def _describe_leaf(leaf: Any) -> str:
    has_type = hasattr(leaf, "shape") and hasattr(leaf, "dtype")
    return f"an array of shape {leaf.shape} and type {leaf.dtype}" if has_type else short_repr(leaf)


def describe_data(data: SimData) -> str:
    """Return the settings and records of data for a message."""
    core, controls = data.core, data.controls
    records = ", ".join(f"{name} ({type(record).__name__})" for name, record in data.plugins.items())
    is_fitted = controls.rotor_vel is None
    settings = _describe_settings(core.n_worlds, core.n_drones, core.freq, controls.mode, is_fitted)
    return f"{settings}, records {records or 'none'}"


def _describe_settings(n_worlds: int, n_drones: int, freq: int, control: Control, is_fitted: bool) -> str:
    dynamics = "fitted" if is_fitted else "first-principles"
    return (
        f"{n_worlds} worlds of {n_drones} drones at {freq} Hz with {control.value!r} commands and {dynamics} dynamics"
    )
