"""Consistency of filters: errors of estimates, and whether they are distributed as a filter expects."""

import math

import jax.numpy as jnp
import numpy as np

from crazysim import rotation


def errors(sim, name):
    """Return the errors of position, velocity and attitude of a filter, body frame for the last two. (n_worlds, 9)"""
    e, s = sim.data.plugins[name].estimate, sim.data.states
    vel = rotation.rotate_inverse(s.quat, s.vel) - e.vel
    turn = 2 * rotation.multiply(rotation.conjugate(e.quat), s.quat)
    turn = turn[..., :3] * jnp.sign(turn[..., 3:])
    return np.asarray(jnp.concatenate([s.pos - e.pos, vel, turn], axis=-1))[:, 0]


def assert_chi_squared(values, k):
    """Check that values have the mean of a chi-square distribution with k degrees of freedom.

    The mean of n has the standard deviation sqrt(2 k / n); beyond 3.3 of them it is once in a thousand seeds.
    """
    assert abs(np.mean(values) - k) < 3.3 * math.sqrt(2 * k / len(values))


def normalised(error, cov):
    return np.einsum("wi,wij,wj->w", error, np.linalg.inv(cov), error)
