"""The settings of a simulation, checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import jax
from jax.sharding import Mesh

from crazysim.control import Control, Controller
from crazysim.control.controllers import find_controller
from crazysim.core.controls import require_controller, require_pair
from crazysim.core.integration import Integrator
from crazysim.core.settings import control_freqs, controller_at_rates, find_device, member, physics_freq, positive
from crazysim.drones import Airframe, load_airframe
from crazysim.dynamics import Dynamics
from crazysim.dynamics.core import require_support
from crazysim.errors import ConfigError

AirframeSource = str | Path | Mapping[str, Any] | Airframe
"""Name of a built-in airframe, path of a TOML file, dict, or airframe."""


def load_airframes(drone: AirframeSource | Sequence[AirframeSource], n_drones: int) -> tuple[Airframe, ...]:
    """Return the airframe of each drone; drones of the same source have the same one. (n_drones,)

    Raises:
        UnknownNameError: If an airframe does not exist.
        ConfigError: If an airframe is invalid, or a list has another length than there are drones.
    """
    if not _is_list(drone):
        return (load_airframe(drone),) * n_drones  # type: ignore[arg-type]
    if len(drone) != n_drones:
        raise ConfigError(
            f"expected {n_drones} airframes, one for each drone, got {len(drone)}. Use Sim(n_drones={len(drone)}), or "
            f"one airframe for all."
        )
    loaded: dict[Any, Airframe] = {}
    for source in drone:
        key = str(source) if isinstance(source, (str, Path)) else id(source)
        loaded[key] = loaded[key] if key in loaded else load_airframe(source)
    return tuple([loaded[str(source) if isinstance(source, (str, Path)) else id(source)] for source in drone])


def _is_list(drone: Any) -> TypeGuard[Sequence[AirframeSource]]:
    return isinstance(drone, Sequence) and not isinstance(drone, str)


@dataclasses.dataclass(frozen=True)
class Configuration:
    """Settings that a simulation keeps from its construction on."""

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
    """Rate of the commands of each level, Hz."""
    controller: Controller | None
    """Controller at its rates; None for Crazyflow's cascade."""
    device: jax.Device
    """Device of the data."""
    mesh: Mesh | None
    """Devices that the worlds are spread over at construction; None for the one device."""
    engine: str
    """Engine that executes steps, one of ``crazysim.engine.ENGINES``."""
    strict: bool
    """True to raise an error where a slower engine would be taken with a warning."""

    @staticmethod
    def create(
        n_worlds: Any,
        n_drones: Any,
        drone: AirframeSource | Sequence[AirframeSource],
        dynamics: Any,
        control: Any,
        integrator: Any,
        freq: Any,
        rates: Mapping[Control, int | None],
        device: str | jax.Device,
        mesh: Mesh | None,
        engine: str,
        strict: bool,
        controller: Any,
        switch: Any = None,
    ) -> Configuration:
        """Return the configuration for the arguments of ``Sim``, as users pass them.

        Raises:
            ValueError: For an argument that is invalid or contradicts another, with what was expected.
        """
        n_worlds, n_drones, freq = positive("n_worlds", n_worlds), positive("n_drones", n_drones), physics_freq(freq)
        n_drones = len(drone) if n_drones == 1 and _is_list(drone) and len(drone) else n_drones
        dynamics, control = member(Dynamics, "dynamics", dynamics), member(Control, "control", control)
        integrator = member(Integrator, "integrator", integrator)
        require_pair(dynamics, control)
        airframes = load_airframes(drone, n_drones)
        for airframe in airframes:
            require_support(airframe, dynamics)
        freqs, controller = control_freqs(control, freq, dict(rates)), find_controller(controller, switch)
        if controller is not None:
            require_controller(dynamics, control, controller)
            controller = controller_at_rates(controller, control, freq, dict(rates))
            with_outer = control == Control.state and controller.has_outer
            freqs = {**freqs, control: controller.outer_freq if with_outer else controller.freq}
        return Configuration(
            n_worlds,
            n_drones,
            airframes,
            dynamics,
            control,
            integrator,
            freq,
            freqs,
            controller,
            find_device(device),
            mesh,
            engine,
            strict,
        )
