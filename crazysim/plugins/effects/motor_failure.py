"""Motor failure: rotors that are weaker than the airframe's, or fail in flight."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from crazysim.core.data import SimData, controls_of
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, param
from crazysim.core.random import drone_key, uniform
from crazysim.core.settings import as_mask
from crazysim.engine.pytree import select_worlds
from crazysim.errors import ConfigError
from crazysim.plugins.effects.moving_air import needs_rotors


class MotorFailure(Plugin, requires=needs_rotors):
    """Rotors that are weaker than the airframe's, or fail; needs rotors.

    A rotor of effectiveness e gives e times the airframe's thrust and drag torque at the same speed. A failed rotor
    gives no thrust and no drag torque, ignores its commands and runs down. Controllers use the airframe's parameters.
    """

    effectiveness: Param = param(default=1.0, core=("rotors",), scope="drone", low=0.0, high=1.0)
    """Fraction of thrust and drag torque left to a rotor, 0 to 1; of the plugin that is added, at the beginning of an
    episode. (n_worlds, n_drones, n_rotors)"""
    fail_step: Param = param(default=None, core=("rotors",), dtype=np.int32)
    """Step of the episode in which a rotor fails, a whole number, negative for never; None if no step is set.
    (n_rotors,)"""
    rate: Param = param(default=None, core=("rotors",), low=0.0)
    """Random failures per second of a working rotor, 1/s; None for no random failures. (n_rotors,)"""
    name: str = "motors"

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        can_fail = self.fail_step is not None or self.rate is not None
        return [StagePlacement(self.stage(self.fail_in_flight))] if can_fail else []

    def influence(self, data: SimData) -> SimData:
        p, scale, controls = data.params, self.effectiveness[..., None], controls_of(data)
        params = p.replace(rpm2thrust=scale * p.rpm2thrust, rpm2torque=scale * p.rpm2torque)
        rotor_vel = jnp.where(self.effectiveness > 0, controls.rotor_vel, 0.0)
        return data.replace(params=params, controls=controls.replace(rotor_vel=rotor_vel))

    def fail_in_flight(self, data: SimData) -> SimData:
        """Make rotors of one drone fail, in their step or at random with probability ``1 - exp(-rate dt)`` per step."""
        effectiveness = self.effectiveness
        if self.fail_step is not None:
            is_due = (self.fail_step >= 0) & (data.core.steps >= self.fail_step)
            effectiveness = jnp.where(is_due, 0.0, effectiveness)
        if self.rate is not None:
            random_numbers = uniform(drone_key(data, self.name), effectiveness.shape, effectiveness.dtype)
            effectiveness = jnp.where(random_numbers < jnp.exp(-self.rate / data.core.freq), effectiveness, 0.0)
        return self.write(data, self.replace(effectiveness=effectiveness))

    def fail(self, data: SimData, mask: ArrayLike | None) -> SimData:
        """Return the data with failed rotors; a reset of their world restores them.

        Args:
            data: Data of all worlds.
            mask: True for rotors that fail; None for all. (n_worlds, n_drones, n_rotors)
        """
        if self.name not in data.plugins:
            raise ConfigError(f"{self.name} is not enabled. Use sim.add(MotorFailure(...)) first.")
        motors = self.read(data)
        effectiveness = motors.effectiveness
        mask = as_mask(mask, effectiveness.shape, item="rotor (n_worlds, n_drones, n_rotors)")
        effectiveness = select_worlds(mask, jnp.zeros_like(effectiveness), effectiveness)
        return self.write(data, motors.replace(effectiveness=effectiveness))
