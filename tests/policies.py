"""A policy for ``hover`` that needs no training: proportional and derivative gains, as a function and as a run."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from crazysim.envs import make
from crazysim.envs.statistics import RunningStats
from crazysim.train import checkpoint
from crazysim.train.config import TrainConfig
from crazysim.train.export import describe
from crazysim.train.networks import Policy
from crazysim.train.training import POLICY_FILE

KP, KD, TILT, LIFT = 4.0, 3.0, 0.13, 0.15
"""Gains of position, 1/s^2, and velocity, 1/s; actions per acceleration, s^2/m."""


def steer(obs):
    """Return the actions that hover at the goal."""
    ax, ay, az = jnp.moveaxis(KP * obs["difference_to_goal"] - KD * obs["vel"], -1, 0)
    return jnp.stack([-TILT * ay, TILT * ax, jnp.zeros_like(ax), LIFT * az], axis=-1)


def save_steering(folder, **options):
    """Write the policy of a run that does what ``steer`` does, by a single layer."""
    weight = np.zeros((21, 4), np.float32)
    for axis, (action, sign) in enumerate([(1, TILT), (0, -TILT), (3, LIFT)]):
        weight[3 + axis, action], weight[18 + axis, action] = sign * KP, -sign * KD  # difference_to_goal, vel
    config = TrainConfig.create("hover", config={"hidden": []}, options=options)
    policy = Policy(RunningStats.create(21), [(jnp.asarray(weight), jnp.zeros(4))])
    meta = describe(make("hover", **options)) | {"settings": dataclasses.asdict(config)}
    checkpoint.save(folder / POLICY_FILE, policy, meta)
    return folder
