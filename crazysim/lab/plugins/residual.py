"""Forces and torques that the model lacks, identified from flights: linear terms and a small network."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, airframe_numbers, check_parameter, param
from crazysim.drones import Airframe
from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import quadratic_curve, rotor_torque
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError
from crazysim.plugins.effects.moving_air import needs_rotors

N_INPUTS = 14
"""Number of inputs: see ``residual_inputs``."""


class Residual(Plugin, requires=needs_rotors):
    """Identified force and torque that the model lacks: linear terms and an optional network; needs rotors.

    Force and torque depend on the velocity over ground, so that wind does not change them. Coefficients have the shapes
    below, for all drones, or (n_worlds, n_drones) in front, for each drone. By default they are the coefficients in the
    airframe's table ``[residual]``. These were fitted with the linear drag, and so cannot be combined with
    ``RotorAerodynamics``.
    """

    linear: Param = param(default=None, core=(6, N_INPUTS))
    """Force, N, and torque, N m, in the body frame, per input; None for the airframe's. (6, 14)"""
    hidden: Param = param(default=None, core=("hidden", N_INPUTS))
    """Weights of the network's hidden layer, 1 per input; None for no network if ``linear`` is given, else the
    airframe's. (n_hidden, 14)"""
    output: Param = param(default=None, core=(6, "hidden"))
    """Force, N, and torque, N m, in the body frame, per activation; None as for ``hidden``. (6, n_hidden)"""
    name: str = "residual"

    @staticmethod
    def create(airframe: Airframe) -> Residual:
        """Return the coefficients of an airframe, the same for all drones, as arrays."""
        values = {key: airframe.values.get(f"residual.{key}") for key in ("linear", "hidden", "output")}
        return Residual(is_bound=True).replace(
            **{key: x if x is None else device_array(x) for key, x in values.items()}
        )

    @property
    def replaced_terms(self) -> tuple[str, ...]:
        return ("drag",) if self.linear is None else ()

    def bind(self, sim: Simulation) -> Residual:
        coefficients = {key: getattr(self, key) for key in ("linear", "hidden", "output")}
        if (self.hidden is None) != (self.output is None) or (self.linear is None and self.hidden is not None):
            names = ", ".join(key for key, value in coefficients.items() if value is not None)
            raise ConfigError(
                f"expected hidden and output together, and linear with them, got {names or 'none'}. Give zeros for no "
                f"linear terms."
            )
        if self.linear is None:
            coefficients = _airframe_coefficients(sim)
        n_hidden = 0 if coefficients["hidden"] is None else np.atleast_2d(coefficients["hidden"]).shape[-2]

        shapes = {"linear": (6, N_INPUTS), "hidden": (n_hidden, N_INPUTS), "output": (6, n_hidden)}
        arrays = {
            key: None if coefficients[key] is None else check_parameter(sim, key, coefficients[key], shape)
            for key, shape in shapes.items()
        }
        return self.replace(**arrays, is_bound=True)

    def influence(self, data: SimData) -> SimData:
        s = data.states
        inputs = residual_inputs(s.quat, s.vel, s.ang_vel, s.rotor_vel, data.params)
        force, torque = residual_wrench(inputs, self)
        force = rotation.rotate(s.quat, force, offset=s.force)
        torque = rotation.rotate(s.quat, torque, offset=s.torque)
        return data.replace(states=s.replace(force=force, torque=torque))


def residual_inputs(
    quat: Array, vel: Array, ang_vel: Array, rotor_vel: Array, params: first_principles.Params
) -> Array:
    """Return the inputs of a residual, all in the body frame. (..., 14)

    They are the number 1; velocity, m/s; velocity times speed, m^2/s^2; angular velocity, rad/s; collective thrust
    divided by weight; torque of the rotors divided by weight times arm length.

    Args:
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        rotor_vel: Rotor speeds, rpm. (..., n_rotors)
        params: Parameters of the model.
    """
    p = params
    body_vel = rotation.rotate_inverse(quat, vel)
    thrust = quadratic_curve(rotor_vel, p.rpm2thrust)
    weight = p.mass * rotation.safe_norm(p.gravity_vec)
    torque = rotor_torque(thrust, quadratic_curve(rotor_vel, p.rpm2torque), p.L, p.mixing_matrix)
    collective = jnp.sum(thrust, axis=-1, keepdims=True) / weight
    return jnp.concatenate(
        [
            jnp.ones_like(collective),
            body_vel,
            body_vel * rotation.safe_norm(body_vel),
            ang_vel,
            collective,
            torque / (weight * jnp.max(p.L, axis=-1, keepdims=True)),
        ],
        axis=-1,
    )


def residual_wrench(inputs: Array, residual: Residual) -> tuple[Array, Array]:
    """Return force, N, and torque, N m, of a residual, body frame: linear terms plus the network. (..., 3) each

    Args:
        inputs: Inputs, see ``residual_inputs``. (..., 14)
    """
    wrench = rotation.matvec(residual.linear, inputs)
    if residual.hidden is not None and residual.output is not None:
        wrench = rotation.matvec(residual.output, jnp.tanh(rotation.matvec(residual.hidden, inputs)), wrench)
    return wrench[..., :3], wrench[..., 3:]


def _airframe_coefficients(sim: Simulation) -> dict[str, Any]:
    unfitted_airframe = next((airframe for airframe in sim.airframes if "residual.linear" not in airframe.values), None)
    if unfitted_airframe is not None:
        raise ConfigError(
            f"expected a table [residual] of drone {unfitted_airframe.name!r}, got none. "
            f"{unfitted_airframe.missing_reason('residual.linear')}"
            f"Use 'crazysim identify LOG --airframe {unfitted_airframe.name} --out mine.toml' on flights of it, or "
            f"drone='cf21B_500_idsia'."
        )
    sizes = {len(airframe.values.get("residual.hidden", ())) for airframe in sim.airframes}
    if len(sizes) > 1:
        raise ConfigError(
            f"expected residuals with the same number of hidden units, got {sorted(sizes)}. Use airframes with "
            f"networks of the same size."
        )
    keys = ("linear", "hidden", "output") if max(sizes) else ("linear",)
    coefficients = {key: airframe_numbers(sim, lambda a, key=key: a.value(f"residual.{key}")) for key in keys}
    return {"hidden": None, "output": None} | coefficients
