"""The race as the drone racing project lsy_drone_racing runs its competition: task, commands and configuration."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.control import Control
from crazysim.core.data import SimData
from crazysim.core.plugin import StagePlacement, state
from crazysim.core.random import drone_key, uniform
from crazysim.drones.loading import load_airframe
from crazysim.engine.stage import stage
from crazysim.envs.actions import Actions
from crazysim.envs.tasks import race
from crazysim.envs.tasks.race_rules import gates_of, obstacles_of
from crazysim.envs.tracks import GATE_COLOR, Track
from crazysim.scene.objects import IDENTITY_QUAT, Handle
from crazysim.sim.sim import Sim
from crazysim.storage import read_toml

# The numbers are those of lsy_drone_racing at commit eb891d0: config/level2.toml, envs/race_core.py, assets/gate.xml.
FREQ, SIM_FREQ = 50, 500
"""Rates of commands and of the physics, Hz."""
LOW, HIGH = (-3.0, -3.0, 0.0), (3.0, 3.0, 2.5)
"""Limits outside of which a drone is disabled, m."""
PAD = 0.02
"""Largest horizontal distance from the start along x and y at which a drone may be on the floor, m."""
START_HEIGHT, START_RISE = 0.01, 0.02
"""Height of the start at level 0, and its largest random increase at higher levels, m."""
FORCE = 0.1
"""Largest random force along each axis, drawn at each physics step, N."""
ACTION_NOISE = 0.001
"""Standard deviation of the noise of every number of a command."""
START_TILT = race.START_JITTER[3:]
"""Largest random roll, pitch and yaw at the start, rad."""
DRONE_NAME = "cf21B_500"
"""Airframe."""
DRONE = (0.07, 0.07, 0.02)
"""Half lengths of the drone's box, m."""
GATE_BOXES = np.array(
    [[(0, 0, 0.28), (0.01, 0.36, 0.08)], [(0, 0, -0.28), (0.01, 0.36, 0.08)], [(0, 0, -0.86), (0.05, 0.05, 0.5)]]
    + [[(0, side * 0.28, 0), (0.01, 0.08, 0.36)] for side in (-1, 1)]
)
"""Middles and half lengths of the boxes of a gate, which has an opening of 0.4 m and a post, m. (5, 2, 3)"""
POLE_BOXES = np.array([[(0, 0, -0.8), (0.015, 0.015, 0.815)]])
"""Middle and half lengths of the box around an obstacle, from its upper end, m. (1, 2, 3)"""


class CompetitionRace(race.Race):
    """The task ``race`` with the rules by which lsy_drone_racing ranks controllers.

    Drones start on the floor, with their rotors at rest. Gates, contacts and limits are checked once in a command, at
    50 Hz. The floor does not disable a drone within 2 cm of its start. Drones are boxes, frames are 0.72 m wide around
    an opening of 0.4 m, and random forces act. Level 0 has no other randomness.
    """

    name = "competition_race"
    check_freq = FREQ

    seconds: float = 30.0
    """Length of an episode, s."""

    pad: Array = state((2,))
    """Horizontal position of the start, m."""

    def add_states(self, sim: Sim, placements: Any = (), **initial: Any) -> None:
        @stage("drone")
        def disturb(data: SimData) -> SimData:
            force = FORCE * (2 * uniform(drone_key(data, self.name), (3,), data.states.force.dtype) - 1)
            return data.replace(states=data.states.replace(force=force))

        super().add_states(sim, [*placements, StagePlacement(disturb, name="disturb")], **initial)

    def spawn(self, data: SimData, key: Array) -> SimData:
        data = super().spawn(data, key)
        data = data.replace(states=data.states.replace(rotor_vel=jnp.zeros_like(data.states.rotor_vel)))
        return self.write(data, pad=data.states.pos[..., :2])

    def place_start(self, start: Array | np.ndarray, x: Array) -> tuple[Array, Array]:
        x = x if self.level else jnp.full_like(x, 0.5).at[..., 2].set(0)
        shift = (2 * x[..., :2] - 1) * np.array(race.START_JITTER[:2], x.dtype)
        height = START_HEIGHT + START_RISE * x[..., 2:3]
        return jnp.concatenate([start[..., :2] + shift, height], axis=-1), (2 * x[..., 3:] - 1) * np.array(
            START_TILT, x.dtype
        )

    def leaves_arena(self, data: SimData) -> Array:
        pos, pad = data.states.pos, self.read(data).pad
        off_pad = jnp.any(jnp.abs(pos[..., :2] - pad) > PAD, axis=-1)
        low, high = np.array(LOW, pos.dtype), np.array(HIGH, pos.dtype)
        return jnp.any(pos > high, axis=-1) | (jnp.any(pos < low, axis=-1) & off_pad)

    def touch_fn(self, sim: Sim, objects: Sequence[Handle], floor: bool) -> Callable[[SimData], Array]:
        names = {handle.name for handle in objects}

        def touches(data: SimData) -> Array:
            s, (gates_pos, gates_quat), poles_pos = data.states, gates_of(data), obstacles_of(data)
            hits = [jnp.zeros(1, bool)]
            if "gate" in names:
                hits.append(touches_boxes(s.pos, s.quat, gates_pos, gates_quat, GATE_BOXES))
            if "obstacle" in names:
                upright = jnp.broadcast_to(jnp.array(IDENTITY_QUAT, s.pos.dtype), (*poles_pos.shape[:-1], 4))
                hits.append(touches_boxes(s.pos, s.quat, poles_pos, upright, POLE_BOXES))
            return jnp.any(jnp.concatenate(hits))

        return touches

    def _add_gates(self, sim: Sim) -> Handle:
        look = f'contype="0" conaffinity="2" rgba="{_text(GATE_COLOR)}"'
        geoms = [f'<geom type="box" pos="{_text(x)}" size="{_text(half)}" {look}/>' for x, half in GATE_BOXES]
        body = f"<mujoco><worldbody><body>{''.join(geoms)}</body></worldbody></mujoco>"
        return sim.scene.add(
            body, "gate", count=self.course.n_gates, pos=self.course.gates_pos, quat=self._gates_quat()
        )


def touches_boxes(pos: Array, quat: Array, objects_pos: Array, objects_quat: Array, boxes: np.ndarray) -> Array:
    """Whether the box of one drone overlaps each object, by the separating axes of its boxes. (n,)

    Args:
        pos: Position of the drone, m. (3,)
        quat: Attitude of the drone, xyzw. (4,)
        objects_pos: Positions of objects, m. (n, 3)
        objects_quat: Attitudes of objects, xyzw. (n, 4)
        boxes: Middles and half lengths of the boxes of every object, m. (n_boxes, 2, 3)
    """
    offset = rotation.rotate_inverse(objects_quat, pos - objects_pos)
    axes = jnp.swapaxes(rotation.matrix(objects_quat), -1, -2) @ rotation.matrix(quat)
    # Normals of faces of both boxes, and products of their edges; axes of the drone are columns.
    faces = jnp.broadcast_to(jnp.eye(3, dtype=pos.dtype), axes.shape)
    drone_faces = jnp.swapaxes(axes, -1, -2)
    edges = jnp.cross(faces[..., :, None, :], drone_faces[..., None, :, :]).reshape(-1, 9, 3)
    normals = jnp.concatenate([faces, drone_faces, edges], axis=-2)
    reach = jnp.abs(normals @ axes) @ jnp.array(DRONE, pos.dtype)
    middles, halves = (boxes[:, k].astype(np.float32).astype(pos.dtype) for k in (0, 1))
    distance = jnp.abs(jnp.einsum("nik,nbk->nbi", normals, offset[:, None] - middles))
    is_apart = distance > reach[:, None] + jnp.einsum("nik,bk->nbi", jnp.abs(normals), halves)
    return jnp.any(~jnp.any(is_apart, axis=-1), axis=-1)


def _text(numbers: Iterable[float]) -> str:
    return " ".join(map(str, numbers))


class Commands(Actions):
    """Actions that are commands of lsy_drone_racing.

    | Level | Command |
    | --- | --- |
    | ``state`` | position, m, velocity, m/s, acceleration, m/s^2, yaw, rad, body rates, rad/s: 13 numbers |
    | ``attitude`` | roll, pitch and yaw within 90 degrees, rad, and collective thrust, N |
    """

    def __init__(self, control: Control):
        thrusts = [4 * float(load_airframe(DRONE_NAME).value(f"rotors.thrust_{end}", ())) for end in ("min", "max")]
        self.low, self.high = np.array([[*[side * np.pi / 2] * 3, x] for side, x in zip((-1, 1), thrusts, strict=True)])
        if control == Control.state:
            self.low, self.high = np.full(13, -np.inf), np.full(13, np.inf)
        super().__init__(np.zeros(len(self.low)), np.ones(len(self.low)), control)

    def command(self, action: Array) -> Array:
        action = jnp.clip(action, self.low.astype(action.dtype), self.high.astype(action.dtype))
        if self.control != Control.state:
            return action
        half_yaw, zero = action[..., 9:10] / 2, jnp.zeros_like(action[..., :1])
        quat = [zero, zero, jnp.sin(half_yaw), jnp.cos(half_yaw)]
        return jnp.concatenate([action[..., :9], *quat, action[..., 10:]], axis=-1)


class Config(dict[str, Any]):
    """A configuration whose entries can be read as attributes."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"expected an entry of {', '.join(self)}, got {name!r}") from None

    def __setattr__(self, name: str, value: Any) -> None:
        self[name] = value


def load_config(path: str | Path) -> Config:
    """Read a configuration from a TOML file of lsy_drone_racing."""
    return json.loads(json.dumps(read_toml(path, "docs/lab/race_controllers.md")), object_hook=Config)


def race_config(level: int, control: str) -> Config:
    """Return the configuration that controllers receive, with the entries of lsy_drone_racing's TOML files."""
    course, drone = Track(), DRONE_NAME
    start = {"pos": [*course.start[:2], START_HEIGHT], "rpy": [0.0] * 3, "vel": [0.0] * 3, "ang_vel": [0.0] * 3}
    gates = zip(course.gates_pos, course.gates_rpy, strict=True)
    track = Config(
        randomize=level == 3,
        gates=[Config(pos=list(pos), rpy=list(rpy)) for pos, rpy in gates],
        obstacles=[Config(pos=list(pos)) for pos in course.obstacles_pos],
        drones=[Config(start)],
        safety_limits=Config(pos_limit_low=list(course.low), pos_limit_high=list(course.high)),
    )
    sim = {"physics": "first_principles", "drone_model": drone, "freq": SIM_FREQ, "attitude_freq": SIM_FREQ}
    env = {"id": "DroneRacing-v0", "seed": -1, "freq": FREQ, "sensor_range": race.SENSOR_RANGE, "control_mode": control}
    return Config(
        controller=Config(file=""),
        deploy=Config(real_track_objects=True, drones=[Config(id=0, channel=0, drone_model=drone)]),
        sim=Config(sim, render=False, camera=-1),
        env=Config(env, track=track, disturbances=Config(), randomizations=Config()),
    )
