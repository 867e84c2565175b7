"""A race in sixteen worlds: four gates and four poles that stand elsewhere in each, hits and passed gates in the step.

Gates and poles have handles, so their poses are data: drawn at random by a reset stage, seen by the policy and by the
stages of the step. Run as a script it also films the first four worlds.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import PyTree, Sim, leaf
from crazysim.pictures import Film, View
from crazysim.rotation import rotate, rotate_inverse
from crazysim.scene.latch import latch_contacts
from crazysim.sim.random import world_keys
from crazysim.sim.stage import stage

N_WORLDS, N_GATES, SECONDS = 16, 4, 16.0
OPENING = 0.45
"""Width and height of a gate's opening, m."""


class Race(PyTree):
    """How far a drone has come."""

    passed: Array = leaf("drone", 0)
    """Gates passed, in their order. (n_worlds, n_drones)"""
    before: Array = leaf("drone", 1)
    """Where it was a step ago, in the frame of its next gate, m. (n_worlds, n_drones, 3)"""


def build() -> Sim:
    """Return the course, with everything that the race is made of."""
    sim = Sim(n_worlds=N_WORLDS, control="state", rng_key=3)
    gates = sim.scene.add("gate", count=N_GATES, width=OPENING, height=OPENING)
    poles = sim.scene.add("pole", count=N_GATES, height=2.0)

    def place(data, _default_data, mask=None):
        """Stand the gates around a circle, each turned and moved a little, and a pole beside the way to each."""
        keys = jax.vmap(lambda key: jax.random.split(key, 3))(world_keys(data, "course"))
        draw = lambda k, low, high, *shape: jax.vmap(  # noqa: E731
            lambda key: jax.random.uniform(key, (N_GATES, *shape), minval=low, maxval=high)
        )(keys[:, k])
        angle = 2 * jnp.pi * (jnp.arange(N_GATES) + 0.5) / N_GATES + draw(0, -0.2, 0.2)
        out = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=-1)
        yaw = angle + jnp.pi / 2 + draw(1, -0.3, 0.3)
        pos = 1.6 * out + jnp.array([0, 0, 1.0]) + draw(2, -0.15, 0.15, 3)
        quat = jnp.stack([0 * yaw, 0 * yaw, jnp.sin(yaw / 2), jnp.cos(yaw / 2)], axis=-1)
        data = gates.set_pose(data, pos, quat, mask=mask)
        return poles.set_pose(data, pos + 0.55 * out - jnp.array([0, 0, 1]) * pos[..., 2:], mask=mask)

    def in_gate(data, number):
        """Return a drone's place in the frame of a gate."""
        pos, quat = data.objects.pos[jnp.array(gates.places)], data.objects.quat[jnp.array(gates.places)]
        return rotate_inverse(quat[number], data.states.pos - pos[number])

    @stage("drone")
    def progress(data):
        """Count a gate as passed when its plane is crossed forwards within the opening."""
        race = data.plugins["race"]
        now = in_gate(data, race.passed % N_GATES)
        inside = jnp.all(jnp.abs(now[1:]) < OPENING / 2)
        passed = race.passed + ((race.before[0] < 0) & (now[0] >= 0) & inside)
        race = race.replace(passed=passed, before=in_gate(data, passed % N_GATES))
        return data.replace(plugins=data.plugins | {"race": race})

    race = Race(jnp.zeros((N_WORLDS, 1), jnp.int32), jnp.zeros((N_WORLDS, 1, 3)))
    states = sim.data.states
    sim.data = sim.data.replace(
        plugins={"race": race}, states=states.replace(pos=states.pos.at[..., :].set([0, -1, 1]))
    )
    sim.build_default_data()
    latch_contacts(sim, [gates, poles], drones=False)
    sim.step_pipeline["progress"] = progress
    sim.build_step_fn()
    sim.reset_pipeline["place"] = place
    sim.build_reset_fn()
    sim.reset()
    return sim


def policy(_, data) -> Array:
    """Fly to a place before the next gate, then through it: setpoints half a metre ahead. (n_worlds, 1, 16)"""
    number = (data.plugins["race"].passed % N_GATES)[..., None]
    pos, quat = (jnp.take_along_axis(x[:, 0, :N_GATES], number, axis=1) for x in (data.objects.pos, data.objects.quat))
    here = rotate_inverse(quat, data.states.pos - pos)
    aligned = (here[..., :1] > -0.8) & (here[..., :1] < 0.0) & (jnp.abs(here[..., 1:2]) < 0.12)
    goal = jnp.where(aligned, jnp.array([0.5, 0, 0]), jnp.array([-0.6, 0, 0]))
    way = pos + rotate(quat, goal) - data.states.pos
    ahead = way * jnp.minimum(1.0, 0.45 / jnp.linalg.norm(way, axis=-1, keepdims=True))
    rest = jnp.zeros((*ahead.shape[:-1], 13)).at[..., 9].set(1.0)
    return jnp.concatenate([data.states.pos + ahead, rest], axis=-1)


def main(film: str | None = None) -> np.ndarray:
    """Race, print how far each world came, and return the gates passed."""
    sim = build()
    n = int(SECONDS * sim.control_freq)
    if film is None:
        sim.rollout(policy, None, n)
    else:
        with Film(film, View(worlds=range(4), width=960, height=720, trail=2.0), fps=25) as recording:
            for _ in range(n // 4):
                sim.rollout(policy, None, 4)
                recording.add(sim)
    race, hits = sim.data.plugins["race"], sim.data.plugins["contacts"]
    for world in range(N_WORLDS):
        hit = np.array(hits.object_names)[np.asarray(hits.objects[world, 0])]
        when = f" first after {int(hits.first[world, 0]) / sim.freq:.2f} s" if len(hit) else ""
        print(f"world {world}: passed {int(race.passed[world, 0])} gates, hit {', '.join(hit) or 'nothing'}{when}")
    return np.asarray(race.passed)


if __name__ == "__main__":
    main(*sys.argv[1:2] or ["race.mp4"])
