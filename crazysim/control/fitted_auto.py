"""The default controller for fitted dynamics: only a position loop, because fitted models include the attitude loop."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.control.levels import Control
from crazysim.control.position import PositionMemory, PositionParams, keep_upright, position_params, specific_force
from crazysim.control.protocol import Controller, DroneData
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics import Dynamics
from crazysim.dynamics.fitted import Params
from crazysim.dynamics.models import AirframeParams
from crazysim.engine.pytree import leaf
from crazysim.rotation import dot, matvec


class FittedParams(AirframeParams):
    """Gains of the position loop, and the attitude response that it assumes, each shared or one per drone."""

    model: Params
    """Parameters of the fitted model that the controller assumes."""
    angle_ratio: Array = leaf("parameter", 1, (3,))
    """Ratio of commanded roll, pitch and yaw to the angles at which the model settles, dimensionless. (3,)"""
    lead: Array = leaf("parameter", 1, (2,))
    """Factors on jerk (s) and on snap (s^2). They advance the attitude command by the delay of the response. (2,)"""
    position: PositionParams
    """Gains and limits of the position loop."""


class FittedAuto(Controller, memory=PositionMemory):
    """Position loop of ``Auto`` above the attitude response of a fitted model."""

    name: ClassVar[str] = "auto"
    levels: ClassVar[tuple[Control, ...]] = (Control.state,)
    output: ClassVar[Control] = Control.attitude
    dynamics: Dynamics
    """Fitted model."""
    freq: int = 100
    """Rate of the controller, Hz."""

    def params(self, airframe: Airframe) -> FittedParams:
        # The delay below the position loop is that of the attitude (damping over stiffness) or of the thrust, whichever
        # is larger, plus 1.5 periods of the controller.
        model = Params.create(airframe, self.dynamics)
        attitude_delay = float(np.max(np.asarray(model.rpy_rates_coef / model.rpy_coef)[:2]))
        delay = attitude_delay
        if model.thrust_dyn_coef is not None:
            delay = max(delay, 1 / float(np.max(model.thrust_dyn_coef)))
        return FittedParams.create(
            airframe,
            model=model,
            angle_ratio=-model.rpy_coef / model.cmd_rpy_coef,
            lead=[attitude_delay + 0.5 / self.freq, float(np.max(-1 / np.asarray(model.rpy_coef)[:2]))],
            position=position_params(airframe, delay + 1.5 / self.freq, self.freq),
        )

    def update(
        self, data: DroneData, command: Setpoint | Array, memory: PositionMemory, params: FittedParams
    ) -> tuple[Array, PositionMemory]:
        s, p, model = data.states, params, params.model
        # Fitted models with a lag of the thrust store the thrust, N, in ``rotor_vel``; ``acc_coef`` is a thrust too.
        thrust_state = data.controls.attitude.cmd[..., 3:] if model.thrust_dyn_coef is None else s.rotor_vel[..., :1]
        matrix = rotation.matrix(s.quat)
        force = rotation.along_z((model.acc_coef + model.cmd_f_coef * thrust_state)[..., 0])
        drag = jnp.zeros_like(s.vel)
        if model.drag_matrix is not None:
            drag = matvec(model.drag_matrix, matvec(jnp.swapaxes(matrix, -1, -2), s.vel))
        known_acc = matvec(matrix, force + drag) / model.mass
        specific_thrust, memory = specific_force(s.pos, s.vel, known_acc, command, memory, self.freq, p.position)  # type: ignore
        specific_thrust = keep_upright(specific_thrust - matvec(matrix, drag) / model.mass, command, p.position)  # type: ignore

        forward, left = rotation.heading(data.controls.state.cmd[..., 9:13])  # of the commanded quaternion
        advanced_thrust = specific_thrust + p.lead[..., :1] * command.jerk + p.lead[..., 1:] * command.snap
        angles = p.angle_ratio * rotation.rpy_from_axes(*rotation.axes_from_z(advanced_thrust, forward, left))
        thrust = (model.mass * dot(specific_thrust, matrix[..., 2]) - model.acc_coef) / model.cmd_f_coef
        return jnp.concatenate([angles, jnp.maximum(thrust, model.thrust_min)], axis=-1), memory
