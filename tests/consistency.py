"""Consistency of filters: errors of estimates, and a check of their distribution."""

import math

import jax.numpy as jnp
import numpy as np

from crazysim import rotation


def errors(sim, name, drones=0):
    """Return a filter's errors of position (world frame), velocity and attitude (body frame). (n_worlds, 9)"""
    e, s = sim.data.plugins[name].estimate, sim.data.states
    vel = rotation.rotate_inverse(s.quat, s.vel) - e.vel
    att_error = 2 * rotation.multiply(rotation.conjugate(e.quat), s.quat)
    att_error = att_error[..., :3] * jnp.sign(att_error[..., 3:])
    return np.asarray(jnp.concatenate([s.pos - e.pos, vel, att_error], axis=-1))[:, drones]


def assert_chi_squared(values, k):
    """Check that values have the mean of a chi-square distribution with k degrees of freedom.

    The mean of n values has the standard deviation sqrt(2 k / n). The mean is off by more than 3.3 standard deviations
    for one seed in a thousand.
    """
    assert abs(np.mean(values) - k) < 3.3 * math.sqrt(2 * k / len(values))


def normalised_square(error, cov):
    """Return squared errors, (n, k), normalised by covariances, (n, k, k). (n,)"""
    return np.einsum("wi,wij,wj->w", error, np.linalg.inv(cov), error)
