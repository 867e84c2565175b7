"""A race in sixteen worlds with four gates and four poles each; hits and passed gates are counted in the step.

Gates and poles have handles, so their poses are data: a reset stage draws them at random, and the policy and the stages
of the step read them. Run as a script it also films the first four worlds.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import ContactLog, Plugin, PyTree, Sim, StagePlacement, leaf, rotation, stage
from crazysim.core import world_keys
from crazysim.media import Film, View

N_WORLDS, N_GATES, SECONDS = 16, 4, 16
OPENING = 0.45  # width and height of a gate's opening, m
START = np.array([1.5, -0.5, 1.0])  # m
LEG, SPEED = 1.2, 2.0  # time from gate to gate, s, and speed in a gate, m/s


class ProgressData(PyTree):
    """Progress of the drones."""

    passed: Array = leaf("drone", 0)
    """Number of gates passed, in their order. (n_worlds, n_drones)"""
    before: Array = leaf("drone", 1)
    """Position one step ago, in the frame of the next gate, m. (n_worlds, n_drones, 3)"""


class Progress(Plugin):
    """Count of the gates that are passed forwards, within the opening."""

    gates: object
    name: str = "race"

    def record(self, sim):
        return ProgressData(jnp.zeros((N_WORLDS, 1), jnp.int32), jnp.zeros((N_WORLDS, 1, 3)))

    def stages(self, sim):
        return [StagePlacement(stage("drone")(self.count), before="increment_steps")]

    def count(self, data):
        """Count the next gate if its plane was crossed in this step."""
        race = self.read(data)
        gate_pos = self.in_gate(data, race.passed % N_GATES)
        passed = race.passed + (
            (race.before[0] < 0) & (gate_pos[0] >= 0) & jnp.all(jnp.abs(gate_pos[1:]) < OPENING / 2)
        )
        return self.write(data, race.replace(passed=passed, before=self.in_gate(data, passed % N_GATES)))

    def in_gate(self, data, number):
        """Return the position of a drone in the frame of a gate, m. (3,)"""
        pos, quat = (x[number] for x in self.gates.pose(data))
        return rotation.rotate_inverse(quat, data.states.pos - pos)


def build() -> Sim:
    """Return the simulation with gates, poles and the stages of the race."""
    sim = Sim(n_worlds=N_WORLDS, control="state", rng_key=3)
    gates = sim.scene.add("gate", count=N_GATES, width=OPENING, height=OPENING)
    poles = sim.scene.add("pole", count=N_GATES, height=2.0)

    def place_gates(data, _default_data, mask=None):
        """Place the gates on a circle, each turned and moved a little, and a pole on the inside of the way to each."""
        noise = jax.vmap(lambda key: jax.random.uniform(key, (N_GATES, 5), minval=-1.0))(world_keys(data, "course"))
        angle = 2 * jnp.pi * (jnp.arange(N_GATES) + 0.5) / N_GATES + 0.2 * noise[..., 0]
        yaw = angle + jnp.pi / 2 + 0.3 * noise[..., 1]
        pos = jnp.stack([1.6 * jnp.cos(angle), 1.6 * jnp.sin(angle), 0 * angle + 1], axis=-1) + 0.15 * noise[..., 2:]
        quat = jnp.stack([0 * yaw, 0 * yaw, jnp.sin(yaw / 2), jnp.cos(yaw / 2)], axis=-1)
        data = gates.set_pose(data, pos, quat, mask=mask)
        return poles.set_pose(data, (pos + jnp.roll(pos, 1, axis=1)) * jnp.array([0.46, 0.46, 0]), mask=mask)

    sim.data = sim.data.replace(states=sim.data.states.replace(pos=jnp.tile(START, (N_WORLDS, 1, 1))))
    sim.build_default_data()
    sim.add(ContactLog([gates, poles], drones=False))
    sim.add(Progress(gates))
    sim.reset_pipeline["place"] = place_gates
    sim.reset()
    return sim


def policy(_, data) -> Array:
    """Return setpoints along a curve through the centre of every gate, after a second of hovering. (n_worlds, 1, 16)"""
    pos, quat = data.objects.pos[:, 0, :N_GATES], data.objects.quat[:, 0, :N_GATES]
    gate_vel = SPEED * LEG * rotation.rotate(quat, jnp.array([1.0, 0, 0]))

    def curve_pos(time):
        """Return positions on a cubic Hermite curve between two gates, tangent to their axes, m. (n_worlds, 1, 3)"""
        number = jnp.floor(time / LEG)
        u, k = (time / LEG - number)[..., None], number.astype(int)[..., None]
        take_last, target = (lambda x, i=i: jnp.take_along_axis(x, i % N_GATES, axis=1) for i in (k - 1, k))
        leg_start, leg_vel = jnp.where(k == 0, START, take_last(pos)), jnp.where(k == 0, 0.0, take_last(gate_vel))
        bend = u * (1 - u) * ((1 - u) * leg_vel - u * target(gate_vel))
        return leg_start + (3 - 2 * u) * u**2 * (target(pos) - leg_start) + bend

    time = jnp.maximum(data.core.steps / data.core.freq - 1.0, 0.0)
    unit_rate = jnp.ones_like(time)
    (setpoint_pos, vel), (_, acc) = jax.jvp(lambda t: jax.jvp(curve_pos, (t,), (unit_rate,)), (time,), (unit_rate,))
    yaw = jnp.broadcast_to(jnp.array([0.0, 0, 0, 1, 0, 0, 0]), (*vel.shape[:-1], 7))
    return jnp.concatenate([setpoint_pos, vel, acc, yaw], axis=-1)


def main(film: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Race, print the progress of each world, and return gates passed and hits of each."""
    sim = build()
    if film is None:
        sim.rollout(policy, None, SECONDS * sim.control_freq)
    else:
        camera = {"lookat": [0, 0, 0.75], "distance": 4.3, "azimuth": 120, "elevation": -38}
        view = View(range(4), 1280, 960, cam_config=camera, trail=1.2, rgba=[0.1, 0.4, 0.9, 1], text="{time:.1f} s")
        with Film(film, view, fps=25) as recording:
            for _ in range(SECONDS * sim.control_freq // 4):
                sim.rollout(policy, None, 4)
                recording.add(sim)
    race, hits = sim.data.plugins["race"], sim.data.plugins["contacts"]
    for world in range(N_WORLDS):
        hit_names = np.array(hits.object_names)[np.asarray(hits.objects[world, 0])]
        print(f"world {world}: passed {int(race.passed[world, 0])} gates, hit {', '.join(hit_names) or 'nothing'}")
    return np.asarray(race.passed[:, 0]), np.asarray(hits.any[:, 0])


if __name__ == "__main__":
    main(*sys.argv[1:2] or ["race.mp4"])
