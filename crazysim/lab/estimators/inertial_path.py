"""Paths of integrated inertial measurements, along which an estimate and its covariance move back in time and forward.

A measurement that arrives late corrects the estimate for the time at which it was taken. The path since then is
integrated without subtracting biases and without the estimate, so that it stays valid when biases and estimate are
corrected. This is the preintegration of C. Forster, L. Carlone, F. Dellaert and D. Scaramuzza, On-manifold
preintegration for real-time visual-inertial odometry, IEEE Transactions on Robotics 33 (2017). The derivatives of a
path with respect to biases are in closed form, for a uniform motion.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.plugins.estimators.error_state import Estimate, bound_covariance, covariance, turn_attitude

IDENTITY_QUAT = np.array([0.0, 0.0, 0.0, 1.0], np.float32)
"""Attitude without a rotation, xyzw."""
EMPTY_PATH_ROW = np.concatenate([IDENTITY_QUAT, np.zeros(6, np.float32)])
"""Row of a path of zero duration. (10,)"""


class InertialPath(NamedTuple):
    """Motion of a body in an interval, in the body frame at the start, without gravity and the initial velocity."""

    quat: Array
    """Attitude at the end, end to start, unit, xyzw. (4,)"""
    vel: Array
    """Velocity at the end, m/s. (3,)"""
    pos: Array
    """Position at the end, m. (3,)"""
    duration: Array
    """Duration, s; negative for a path that goes back in time. ()"""

    @staticmethod
    def from_row(row: Array, duration: Array) -> InertialPath:
        """Return the path of a row that ``to_row`` returned. (10,)"""
        return InertialPath(row[:4], row[4:7], row[7:], duration)

    def to_row(self) -> Array:
        """Return the numbers of the path without its duration. (10,)"""
        return jnp.concatenate([self.quat, self.vel, self.pos])

    def extend(self, accel: Array, gyro: Array, dt: Array | float) -> InertialPath:
        """Return the path after another interval.

        Args:
            accel: Mean specific force as measured, body frame, m/s^2. (3,)
            gyro: Mean angular velocity as measured, body frame, rad/s. (3,)
            dt: Length of the interval, s.
        """
        force = rotation.rotate(turn_attitude(self.quat, 0.5 * dt * gyro), accel)
        pos = self.pos + dt * self.vel + 0.5 * dt**2 * force
        return InertialPath(turn_attitude(self.quat, dt * gyro), self.vel + dt * force, pos, self.duration + dt)

    def reverse(self) -> InertialPath:
        inverse = rotation.conjugate(self.quat)
        pos = rotation.rotate(inverse, self.duration * self.vel - self.pos)
        return InertialPath(inverse, -rotation.rotate(inverse, self.vel), pos, -self.duration)

    def without_biases(self, estimate: Estimate) -> InertialPath:
        """Return the path for measurements without the biases of an estimate, to first order in the biases."""
        half_quat, t = _half_rotation(self.quat), self.duration
        rate, force = (rotation.rotate(half_quat, x) for x in (estimate.gyro_bias, estimate.accel_bias))  # type: ignore[arg-type]
        vel, pos = self.vel - t * force, self.pos - 0.5 * t**2 * force
        vel, pos = vel - rotation.cross(rate, t * vel - pos), pos - t / 3 * rotation.cross(rate, pos)
        return InertialPath(
            rotation.multiply(turn_attitude(jnp.asarray(IDENTITY_QUAT, rate.dtype), -t * rate), self.quat), vel, pos, t
        )


def propagate_along(estimate: Estimate, path: InertialPath, gravity: Array) -> Estimate:
    """Return an estimate with biases at the end of a path, with the covariance of its errors there.

    R and v are attitude and velocity at the start, R' and v' at the end, d, u and E^T are position, velocity and
    attitude of the path, M is its attitude halfway, t its duration, a and w are the errors of the biases:

        d_pos' = d_pos + t R d_vel - R [t v + d]x d_att - R (t^2 / 2 M a - t / 3 [d]x M w)
        d_vel' = E (d_vel - [v + u]x d_att - t M a + [t u - d]x M w) + [v']x d_att'
        d_att' = E (d_att - t M w)

    Noise of the inertial sensors along the path is left out.

    Args:
        estimate: The estimate at the start of the path.
        path: The path, without the biases of the estimate.
        gravity: Acceleration of gravity, world frame, m/s^2. (3,)
    """
    t, rot, half_rot = path.duration, rotation.matrix(estimate.quat), rotation.matrix(_half_rotation(path.quat))
    quat, world_vel = rotation.multiply(estimate.quat, path.quat), rotation.matvec(rot, estimate.vel)
    pos = rotation.matvec(rot, path.pos, estimate.pos + t * world_vel + 0.5 * t**2 * gravity)
    vel = rotation.rotate_inverse(quat, rotation.matvec(rot, path.vel, world_vel + t * gravity))

    inverse_rot, cross_matrix = rotation.matrix(path.quat).T, rotation.cross_matrix
    gyro_to_att = -t * half_rot
    att_to_vel, att_to_pos = -cross_matrix(estimate.vel + path.vel), -rot @ cross_matrix(t * estimate.vel + path.pos)
    gyro_to_vel, gyro_to_pos = (
        cross_matrix(t * path.vel - path.pos) @ half_rot,
        t / 3 * rot @ cross_matrix(path.pos) @ half_rot,
    )
    accel_to_vel, accel_to_pos, vel_cross = -t * half_rot, -0.5 * t**2 * rot @ half_rot, cross_matrix(vel)

    def transform_errors(p: Array) -> Array:
        att = inverse_rot @ (p[6:9] + gyro_to_att @ p[12:])
        vel_error = p[3:6] + att_to_vel @ p[6:9] + accel_to_vel @ p[9:12] + gyro_to_vel @ p[12:]
        pos_rows = p[:3] + t * rot @ p[3:6] + att_to_pos @ p[6:9] + accel_to_pos @ p[9:12] + gyro_to_pos @ p[12:]
        return jnp.concatenate([pos_rows, inverse_rot @ vel_error + vel_cross @ att, att, p[9:]])

    cov = bound_covariance(transform_errors(transform_errors(covariance(estimate.cov)).T))
    return estimate.replace(pos=pos, vel=vel, quat=quat, cov=cov)


def _half_rotation(quat: Array) -> Array:
    identity = jnp.asarray(IDENTITY_QUAT, quat.dtype)
    return rotation.safe_normalize(quat + identity * jnp.where(quat[3] < 0, -1.0, 1.0), identity)
