"""Controller ``"crazyflow"``: the cascade of Crazyflow 0.4.0, to reproduce its flights."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from crazysim.control.attitude_controller import AttitudeParams, attitude2force_torque, body_rate2force_torque
from crazysim.control.gains import require_gains
from crazysim.control.levels import Control
from crazysim.control.protocol import Controller, DroneData
from crazysim.control.setpoint import Setpoint
from crazysim.control.state_controller import StateParams, state2attitude
from crazysim.drones import Airframe
from crazysim.engine.pytree import PyTree, leaf


class StateMemory(PyTree):
    """Memory of the state controller."""

    pos_err_i: Array = leaf("drone", 1, (3,))
    """Integral of the position error, m s. (n_worlds, n_drones, 3)"""


class AttitudeMemory(PyTree):
    """Memory of the attitude and body-rate controller."""

    ang_vel_des: Array = leaf("drone", 1, (3,))
    """Desired body rates at the last tick, rad/s. (n_worlds, n_drones, 3)"""
    r_int_error: Array = leaf("drone", 1, (3,))
    """Integral of the negative rotation error, rad s. (n_worlds, n_drones, 3)"""
    prev_ang_vel: Array = leaf("drone", 1, (3,))
    """Angular velocity at the last tick, body frame, rad/s. (n_worlds, n_drones, 3)"""


class CrazyflowState(Controller, memory=StateMemory):
    """State controller of Crazyflow (``state2attitude``), for the level ``state``."""

    name: ClassVar[str] = "crazyflow"
    levels: ClassVar[tuple[Control, ...]] = (Control.state,)
    output: ClassVar[Control] = Control.attitude
    follows_feedforward: ClassVar[bool] = False
    freq: int = 100
    """Rate of the controller, Hz."""
    inner: Controller | None = None
    """Controller that follows the attitude commands; None with fitted dynamics, which take attitude commands."""

    def params(self, airframe: Airframe) -> StateParams:
        require_gains(airframe, StateParams, *([] if self.inner is None else [AttitudeParams]))
        return StateParams.create(airframe)

    def update(
        self, data: DroneData, command: Setpoint | Array, memory: StateMemory, params: StateParams
    ) -> tuple[Array, StateMemory]:
        s, cmd = data.states, data.controls.state.cmd
        attitude_cmd, pos_err_i = state2attitude(s.pos, s.quat, s.vel, cmd, memory.pos_err_i, self.freq, params=params)
        return attitude_cmd, StateMemory(pos_err_i)


class Crazyflow(Controller, params=AttitudeParams, memory=AttitudeMemory):
    """Cascade of Crazyflow, with gains from the airframe's table ``[controller]``.

    It follows attitudes (``attitude2force_torque``) and body rates (``body_rate2force_torque``). At the level
    ``state``, ``CrazyflowState`` is used, with this controller as ``inner`` unless the dynamics are fitted. Levels
    below ``body_rate``, and attitude commands with fitted dynamics, need no controller.
    """

    name: ClassVar[str] = "crazyflow"
    levels: ClassVar[tuple[Control, ...]] = (Control.attitude, Control.body_rate)
    output: ClassVar[Control] = Control.force_torque
    follows_rates: ClassVar[bool] = True
    freq: int = 500
    """Rate of the controller, Hz."""

    def adapt(self, control: Control, fitted_model: str | None) -> Controller | None:
        if control == Control.state:
            return CrazyflowState(inner=None if fitted_model else self)
        return self if fitted_model is None and control in self.levels else None

    def update(
        self, data: DroneData, command: Setpoint | Array, memory: AttitudeMemory, params: AttitudeParams
    ) -> tuple[Array, AttitudeMemory]:
        s, m = data.states, memory
        cmd: Array = command  # type: ignore[assignment]  # never a Setpoint at these levels
        if data.controls.mode == Control.body_rate:
            ang_vel_des = cmd[..., :3]
            wrench, r_int_error = body_rate2force_torque(
                s.quat, s.ang_vel, cmd, m.prev_ang_vel, m.ang_vel_des, m.r_int_error, self.freq, params=params
            )
        else:
            ang_vel_des = data.controls.attitude.staged_ang_vel_des
            if ang_vel_des is None:  # the controller is a member of a ``Switch``
                ang_vel_des = jnp.zeros_like(s.ang_vel)
            wrench, r_int_error = attitude2force_torque(
                s.quat,
                s.ang_vel,
                cmd,
                ang_vel_des,
                m.prev_ang_vel,
                m.ang_vel_des,
                m.r_int_error,
                self.freq,
                params=params,
            )
        return wrench, AttitudeMemory(ang_vel_des, r_int_error, s.ang_vel)
