"""Twelve tasks as users write them: each has a hand-written flight that succeeds; doing nothing, or anything, does not.

Defaults of training are judged by them, so none of them changes for a default's sake.
"""

from pathlib import Path

import jax.numpy as jnp
import pytest

from crazysim import envs, train

FOLDER = Path(__file__).with_name("own_tasks")
TASKS = {
    "hoops": "ThreeHoops",
    "slalom": "Slalom",
    "perch": "Perch",
    "formation": "Formation",
    "slope": "Slope",
    "push": "Push",
    "wall": "FollowWall",
    "load": "WindyLoad",
    "escape": "Escape",
    "visit": "Visit",
    "dock": "Dock",
    "loop": "Loop",
}
QUICK = ("push", "wall", "formation")
"""One with contacts of its own, one with objects and a sensor, and one with two drones; the others are slow tests."""


def hover(obs):
    return jnp.zeros((*obs["vel"].shape[:-1], 4))


def anything(obs):
    """Return actions in [-1, 1] that hardly depend on the state in any way that one could follow."""
    noise = 1e4 * jnp.sum(obs["vel"], axis=-1, keepdims=True) * jnp.array([1.0, 3.3, 7.7, 13.1])
    return 2 * (noise % 1.0) - 1


@pytest.mark.parametrize(
    "name",
    [
        name if name in QUICK else pytest.param(name, marks=pytest.mark.slow("tasks of each kind are flown"))
        for name in TASKS
    ],
)
def test_a_hand_written_flight_succeeds_and_others_do_not(name):
    env = envs.make(f"{FOLDER / name}.py:{TASKS[name]}", n_worlds=200)
    assert env.task.tolerance <= 0.15

    assert train.evaluate(env, env.task.demonstrate)["success"] >= 0.99
    assert train.evaluate(env, lambda obs: jnp.concatenate([hover(obs)[:100], anything(obs)[100:]]))["success"] < 0.05
