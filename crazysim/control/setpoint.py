"""Setpoints: the position, yaw and derivatives that a controller follows at one instant."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import PyTree, leaf


class Setpoint(PyTree):
    """Desired motion of one drone at one instant, with any leading axes: position, yaw and derivatives, world frame.

    A setpoint has no body rates, because they follow from its derivatives (``flatness.attitude_of_thrust``). A
    controller that follows the body rates of a state command reads them from ``data.controls.state.cmd[13:16]``.
    """

    pos: Array = leaf("drone", 1)
    """Position, world frame, m. (..., 3)"""
    vel: Array = leaf("drone", 1)
    """Velocity, world frame, m/s. (..., 3)"""
    acc: Array = leaf("drone", 1)
    """Acceleration, world frame, m/s^2. (..., 3)"""
    jerk: Array = leaf("drone", 1)
    """Third derivative of the position, world frame, m/s^3. (..., 3)"""
    snap: Array = leaf("drone", 1)
    """Fourth derivative of the position, world frame, m/s^4. (..., 3)"""
    yaw: Array = leaf("drone", 1)
    """Yaw, rad. (..., 1)"""
    yaw_rate: Array = leaf("drone", 1)
    """Rate of the yaw, rad/s. (..., 1)"""
    yaw_acc: Array = leaf("drone", 1)
    """Second derivative of the yaw, rad/s^2. (..., 1)"""

    @jit_eager_calls()
    def command(self) -> Array:
        """Return the state command: position, velocity, acceleration, quaternion of the yaw, body rates. (..., 16)

        The quaternion is xyzw, and the body rates are (0, 0, yaw rate), which a level drone would have.
        """
        zeros = jnp.zeros_like(self.pos[..., :2])
        quat = [zeros, jnp.sin(self.yaw / 2), jnp.cos(self.yaw / 2)]
        return jnp.concatenate([self.pos, self.vel, self.acc, *quat, zeros, self.yaw_rate], axis=-1)

    @jit_eager_calls()
    def feedforward(self) -> Array:
        """Return the feedforward of the state command: jerk, snap, yaw rate, second derivative of the yaw. (..., 8)"""
        return jnp.concatenate([self.jerk, self.snap, self.yaw_rate, self.yaw_acc], axis=-1)

    @staticmethod
    @jit_eager_calls()
    def of_command(cmd: Array, feedforward: Array | None = None) -> Setpoint:
        """Return the setpoint of a state command.

        Args:
            cmd: Position, velocity, acceleration, quaternion of any length (only its yaw is used), and body
                rates. (..., 16)
            feedforward: Jerk, snap, yaw rate, second derivative of the yaw; None for the yaw rate of the command, and
                zeros for the others. (..., 8)
        """
        if feedforward is None:
            zeros = jnp.zeros_like(cmd[..., :6])
            derivatives = jnp.concatenate([zeros, cmd[..., 15:16], zeros[..., :1]], axis=-1)
        else:
            derivatives = feedforward
        return Setpoint(
            pos=cmd[..., 0:3],
            vel=cmd[..., 3:6],
            acc=cmd[..., 6:9],
            jerk=derivatives[..., 0:3],
            snap=derivatives[..., 3:6],
            yaw=rotation.yaw(cmd[..., 9:13])[..., None],
            yaw_rate=derivatives[..., 6:7],
            yaw_acc=derivatives[..., 7:8],
        )
