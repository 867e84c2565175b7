"""Motors that have lost strength, and rotors that fail in flight."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.random import drone_key
from crazysim.core.stage import stage
from crazysim.effects.core import Simulation, as_setting, controls_of, install, per_drone, require_rotors
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf


class Motors(PyTree):
    """What is left of every rotor."""

    effectiveness: Array = leaf("drone", 1)
    """Fraction of its thrust and drag torque that a rotor still has, 1. (n_worlds, n_drones, n_rotors)"""
    fail_step: Array | None = leaf("parameter", 1)
    """Step of the episode in which a rotor fails, negative for never; None if none is set. (n_rotors,)"""
    rate: Array | None = leaf("parameter", 1)
    """Failures per second of a rotor that works, 1/s; None if none fails by chance. (n_rotors,)"""


def add(sim: Simulation, effectiveness: Any = 1.0, fail_step: Any = None, rate: Any = None) -> None:
    """Let rotors be weaker than the airframe's, and fail.

    A rotor of effectiveness e gives e times the thrust and the drag torque of its speed. One that has failed gives
    none, and runs down. What the controllers believe stays as it was.

    Args:
        sim: The simulation, with first-principles dynamics.
        effectiveness: Fraction of thrust and drag torque at the beginning of an episode, 0 to 1.
            (), (n_rotors,) or (n_worlds, n_drones, n_rotors)
        fail_step: Step of the episode in which a rotor fails, a whole number, negative for never; None if no rotor
            does. (), (n_rotors,) or (n_worlds, n_drones, n_rotors)
        rate: Failures per second of a rotor that works, 1/s, by chance; None for no such failures.
            (), (n_rotors,) or (n_worlds, n_drones, n_rotors)

    Raises:
        ConfigError: If a setting cannot be, the dynamics have no rotors, or the effect is on already.
    """
    require_rotors(sim, "motor failure")
    core = (sim.airframe.n_rotors,)
    record = Motors(
        effectiveness=per_drone(sim, as_setting(sim, "effectiveness", effectiveness, core, 0.0, 1.0)),
        fail_step=None if fail_step is None else as_setting(sim, "fail_step", fail_step, core, dtype=jnp.int32),
        rate=None if rate is None else as_setting(sim, "rate", rate, core, 0.0),
    )
    can_fail = fail_step is not None or rate is not None
    install(sim, "motors", record, failures if can_fail else None, weaken)


def fail(sim: Simulation, mask: Any) -> None:
    """Let rotors fail now; a reset of their world restores them.

    Args:
        sim: The simulation, with this effect.
        mask: Which, of type bool. (n_worlds, n_drones, n_rotors)

    Raises:
        ConfigError: If the effect is off, or the mask has another shape or type.
    """
    if "motors" not in sim.data.plugins:
        raise ConfigError("rotors can fail once effects.motors.add(sim) has been called")
    motors, mask = sim.data.plugins["motors"], np.asarray(mask)
    if mask.shape != motors.effectiveness.shape or mask.dtype != bool:
        raise ConfigError(
            f"the mask has shape {mask.shape} and type {mask.dtype}; needed are {motors.effectiveness.shape} = "
            f"(n_worlds, n_drones, n_rotors) and bool"
        )
    motors = motors.replace(effectiveness=jnp.where(mask, 0.0, motors.effectiveness))
    sim.data = sim.data.replace(plugins=sim.data.plugins | {"motors": motors})


def weaken(data: SimData) -> SimData:
    """Return the data with the curves and commands that weak and failed rotors have."""
    effectiveness = data.plugins["motors"].effectiveness
    p, scale, controls = data.params, effectiveness[..., None], controls_of(data)
    params = p.replace(rpm2thrust=scale * p.rpm2thrust, rpm2torque=scale * p.rpm2torque)
    rotor_vel = jnp.where(effectiveness > 0, controls.rotor_vel, 0.0)
    return data.replace(params=params, controls=controls.replace(rotor_vel=rotor_vel))


@stage("drone")
def failures(data: SimData) -> SimData:
    """Let the rotors of one drone fail whose step has come, or whom chance hits: ``1 - exp(-rate dt)`` a step."""
    motors = data.plugins["motors"]
    effectiveness = motors.effectiveness
    if motors.fail_step is not None:
        due = (motors.fail_step >= 0) & (data.core.steps >= motors.fail_step)
        effectiveness = jnp.where(due, 0.0, effectiveness)
    if motors.rate is not None:
        luck = jax.random.uniform(drone_key(data, "motors"), effectiveness.shape, effectiveness.dtype)
        effectiveness = jnp.where(luck < jnp.exp(-motors.rate / data.core.freq), effectiveness, 0.0)
    return data.replace(plugins=data.plugins | {"motors": motors.replace(effectiveness=effectiveness)})
