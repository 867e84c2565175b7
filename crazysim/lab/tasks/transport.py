"""Carry a swinging load through a gate to a goal."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import StagePlacement
from crazysim.core.settings import setting
from crazysim.engine.pytree import static
from crazysim.engine.stage import stage
from crazysim.envs import terms
from crazysim.envs.random import draw, scale_symmetric, scale_to
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.goals import pick_entry, state_of
from crazysim.errors import require
from crazysim.lab.tasks.bring_load import BringLoad
from crazysim.plugins.payloads import SlungLoad, direction, load_pos, load_vel
from crazysim.scene.objects import Handle
from crazysim.sim.sim import Sim

CORRIDOR_SPACING = 3.0
"""Distance along y between the corridors of several drones, m. Each drone has its own corridor with a gate."""
HALF_SIZE, CEILING = (2.6, 1.4), 2.5
"""Largest distance of a drone from the middle of its corridor along x and y, and largest height, m."""
START_BOX = ((-2.2, -0.5, 1.2), (-1.4, 0.5, 1.7))
"""Lower and upper corner of the box of starts, relative to the middle of the corridor on the floor, m."""
GOAL_BOX = ((1.0, -0.5, 1.0), (1.8, 0.5, 1.5))
"""Lower and upper corner of the box of goals, relative to the middle of the corridor on the floor, m."""
GATE_BOX = ((0.0, -0.3, 1.2), (0.0, 0.3, 1.5))
"""Lower and upper corner of the box of middles of gates, relative to the middle of the corridor on the floor, m."""
MAX_GATE_YAW = 0.3
"""Largest yaw of a gate, rad."""
BAR_THICKNESS = 0.05
"""Thickness of a gate's frame, m."""
LOAD_RADIUS = 0.03
"""Radius of a load, m."""
MIN_OPENING_MARGIN = 0.25
"""Smallest difference between the opening's height and the length of rod or cable, m. Drone and load pass the gate
together."""


class Transport(BringLoad):
    """Carry a load on a rod or cable through a gate, and hold it at a goal behind it.

    A drone starts in flight with a swinging load. Each drone has its own corridor with a gate. Drone and load must pass
    the plane of the gate through the opening. Missing the opening, touching the frame or the floor, or leaving the
    corridor is a crash; crashes are checked at every physics step. A load is delivered when it has been behind the
    gate, within ``tolerance`` of its goal, slower than 0.2 m/s, for ``hold`` seconds. An episode ends when a drone
    crashes.
    """

    name = "transport"
    film_view = {"lookat": (0, 0, 1.1), "distance": 5.0, "azimuth": 60, "elevation": -20}

    mass: float = setting(default=0.01, positive=True)
    """Mass of the load, kg."""
    length: float = setting(default=0.3, positive=True)
    """Length of rod or cable, m."""
    cable: bool = False
    """True for a cable, False for a rigid rod."""
    opening: float = setting(default=1.0, positive=True, high=1.6)
    """Width and height of the gate's opening, m."""
    swing: float = setting(default=0.4, low=0.0, high=1.0)
    """Largest angle of rod or cable from the vertical at the start, towards x and towards y, rad; the largest rate of
    these angles is 1.5 times that, rad/s."""
    seconds: float = 6.0
    """Length of an episode, s."""
    gates: Handle = static()
    """Handle of the gates, one per drone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.length + MIN_OPENING_MARGIN <= self.opening <= 1.6,
            f"expected opening from {self.length + MIN_OPENING_MARGIN:g} m (length of rod or cable + "
            f"{MIN_OPENING_MARGIN} m) to 1.6 m, got {self.opening!r}",
        )

    def install(self, sim: Sim) -> None:
        sim.add(SlungLoad(mass=self.mass, length=self.length, cable=self.cable, size=LOAD_RADIUS))
        middle = corridor_centres(sim.n_drones) + np.mean(GATE_BOX, axis=0)
        gates = sim.scene.add(
            "gate", count=sim.n_drones, pos=middle, width=self.opening, height=self.opening, bar=BAR_THICKNESS
        )
        contacts = sim.scene.contact_fn([gates], drones=False)

        @stage("drone")
        def judge(data: SimData) -> SimData:
            crashed = contacts(data).any | self.misses_gate(data) | is_outside_or_on_floor(data)
            return self.update_outcome(data, crashed)

        self.add_states(sim, [StagePlacement(judge, before="increment_steps")], gates=gates)

    def spawn(self, data: SimData, key: Array) -> SimData:
        n_drones = data.core.n_drones
        x = draw(key, n_drones, start=3, goal=3, gate=3, turn=1, rpy=3, vel=3, swing=2, swing_rate=2)
        centre = jnp.asarray(corridor_centres(n_drones), data.states.pos.dtype)
        quat = rotation.from_rpy(scale_symmetric(x["rpy"], 0.1))
        data = flying(data, centre + scale_to(x["start"], *np.array(START_BOX)), quat, scale_symmetric(x["vel"], 0.3))
        yaw = scale_symmetric(x["turn"], MAX_GATE_YAW)
        gate_quat = rotation.from_rpy(jnp.concatenate([0 * yaw, 0 * yaw, yaw], axis=-1))
        data = self.read(data).gates.set_pose(data, centre + scale_to(x["gate"], *np.array(GATE_BOX)), gate_quat)
        data = self.hang_loads(
            data, scale_symmetric(x["swing"], self.swing), scale_symmetric(x["swing_rate"], 1.5 * self.swing)
        )
        return self.write(data, goal=centre + scale_to(x["goal"], *np.array(GOAL_BOX)))

    def hang_loads(self, data: SimData, angle: Array, rate: Array) -> SimData:
        """Return the data with loads that hang on taut rods or cables.

        Args:
            data: Data of one world.
            angle: Angles a and b of rod or cable: a from the vertical towards x, then b towards y, rad. (n_drones, 2)
            rate: Rates of the angles, rad/s. (n_drones, 2)
        """
        (sin_a, sin_b), (cos_a, cos_b), (da, db) = (
            jnp.moveaxis(x, -1, 0) for x in (jnp.sin(angle), jnp.cos(angle), rate)
        )
        link = jnp.stack([sin_a * cos_b, sin_b, -cos_a * cos_b], axis=-1)
        link_rate = jnp.stack(
            [da * cos_a * cos_b - db * sin_a * sin_b, db * cos_b, da * sin_a * cos_b + db * cos_a * sin_b], axis=-1
        )
        s, load = data.states, data.plugins["load"]
        load = load.replace(pos=s.pos + self.length * link, vel=s.vel + self.length * link_rate)
        return data.replace(plugins=data.plugins | {"load": load})

    def gate(self, data: SimData) -> tuple[Array, Array]:
        """Return position, m (..., 3), and attitude, xyzw (..., 4), of each drone's gate."""
        rows = self.read(data).gates.rows
        gate_rows = slice(rows[0], rows[-1] + 1)
        pos, quat = (x[..., gate_rows, :] for x in (data.objects.pos, data.objects.quat))  # type: ignore[union-attr]
        return pick_entry(pos, data.core.drone_id), pick_entry(quat, data.core.drone_id)

    def remaining_way(self, data: SimData) -> Array:
        """Return the length of the load's way to its goal, m. (...)

        If the load is in front of the gate, its way leads through the opening. There it is half the length of rod or
        cable below the middle, so that drone and load pass with equal margins.
        """
        pos, quat = self.gate(data)
        load, goal = load_pos(data), self.read(data).goal
        passage_point = pos - np.array([0.0, 0.0, self.length / 2], pos.dtype)
        way_through_gate = (
            rotation.safe_norm(passage_point - load)[..., 0] + rotation.safe_norm(goal - passage_point)[..., 0]
        )
        return jnp.where(is_behind(load, pos, quat), self.error(data), way_through_gate)

    def misses_gate(self, data: SimData) -> Array:
        """Whether a drone or its load is between the faces of its gate, but not in the opening. (...)"""
        pos, quat = self.gate(data)
        drone_misses, load_misses = (
            (jnp.abs(local_pos[..., 0]) <= BAR_THICKNESS / 2)
            & (jnp.any(jnp.abs(local_pos[..., 1:]) > self.opening / 2 - radius, axis=-1))
            for local_pos, radius in (
                (rotation.rotate_inverse(quat, data.states.pos - pos), 0.0),
                (rotation.rotate_inverse(quat, load_pos(data) - pos), LOAD_RADIUS),
            )
        )
        return drone_misses | load_misses

    def at_goal(self, data: SimData) -> Array:
        return is_behind(load_pos(data), *self.gate(data)) & super().at_goal(data)

    def observe(self, data: SimData) -> dict[str, Array]:
        """Return the drone's state, the relative motion of its load, and vectors to gate and goal.

        ``load_pos``, m, and ``load_vel``, m/s, are relative to the drone. ``difference_to_gate``, m, is the vector from
        the drone to the middle of the gate. ``gate_axis`` is the unit vector of the direction through the gate.
        ``difference_to_goal``, m, is the vector from the load to its goal.
        """
        s, (pos, quat) = data.states, self.gate(data)
        return state_of(data) | {
            "load_pos": load_pos(data) - s.pos,
            "load_vel": load_vel(data) - s.vel,
            "difference_to_gate": pos - s.pos,
            "gate_axis": gate_axis(quat),
            "difference_to_goal": self.read(data).goal - load_pos(data),
        }

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        """Return progress and proximity of the load, and costs of swinging, turning, changing actions and a crash.

        ``approach`` still has a slope far from the goal, so that waiting in front of the gate gets less reward than
        passing it. ``proximity`` rewards rest at the goal.
        """
        record, way = self.read(data), self.remaining_way(data)
        rate = direction(data)[1]
        return {
            "progress": 5.0 * (record.remaining_way_before - way),
            "approach": 0.5 * jnp.exp(-way),
            "proximity": terms.proximity(self.error(data), coarse=5.0),
            "swing": -0.01 * rotation.dot(rate, rate)[..., 0],
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "crash": -10.0 * record.failure,
        }

    def info(self, data: SimData) -> dict[str, Array]:
        passed = is_behind(load_pos(data), *self.gate(data))
        return {"passed": passed & ~self.read(data).failure} | super().info(data)


def corridor_centres(n_drones: int) -> np.ndarray:
    """Return the middle of each drone's corridor on the floor, m. (n_drones, 3)"""
    y = CORRIDOR_SPACING * (np.arange(n_drones) - (n_drones - 1) / 2)
    return np.stack([0 * y, y, 0 * y], axis=-1)


def gate_axis(quat: Array) -> Array:
    """Return the unit vector of the direction through a gate, its x axis. (..., 3)"""
    return rotation.matrix(quat)[..., 0]


def is_behind(point: Array, pos: Array, quat: Array) -> Array:
    """Whether a point is behind the plane of a gate. (...)

    Args:
        point: Position, m. (..., 3)
        pos: Position of the gate, m. (..., 3)
        quat: Attitude of the gate, xyzw. (..., 4)
    """
    return rotation.dot(point - pos, gate_axis(quat))[..., 0] > 0


def is_outside_or_on_floor(data: SimData) -> Array:
    """Whether a drone is outside of its corridor, or its load is on the floor. (...)"""
    pos = data.states.pos
    middle = pick_entry(jnp.asarray(corridor_centres(data.core.n_drones), pos.dtype), data.core.drone_id)
    is_far = jnp.any(jnp.abs(pos - middle)[..., :2] > np.array(HALF_SIZE, pos.dtype), axis=-1) | (pos[..., 2] > CEILING)
    return is_far | (load_pos(data)[..., 2] <= LOAD_RADIUS)
