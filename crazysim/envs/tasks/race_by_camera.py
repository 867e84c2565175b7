"""Race through gates that the drone observes in images of depth or of colours."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.settings import setting
from crazysim.envs import terms
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.goals import pick_entry
from crazysim.envs.tasks.race import Race
from crazysim.envs.tasks.race_observations import observe
from crazysim.envs.tasks.race_rules import gate_index, gates_of, next_gate, race_of
from crazysim.plugins.sensors.camera import Camera
from crazysim.scene.appearance import RandomColors

AWAY_COST = 0.03
"""Cost per environment step of looking away: factor of 1 - cos(angle between the camera's axis and the next gate)."""
HASTE_COST = 0.1
"""Cost per environment step and m/s of a speed above the task's. It exceeds the reward of faster progress. Without the
cost, policies with body rate commands reach the side of a gate faster than they can turn, and hit the frame."""
IMAGE_SIZE = (32, 24)
"""Width and height of the images, pixels: the bars of a gate are 5 cm wide."""
SATURATION, BRIGHTNESS = 0.9, 0.9
"""Saturation and value of the gates' colours with ``by_color``; their hues are as far apart as possible."""
CHANGES = RandomColors(surfaces=0.2, lights=0.2, tilt=15.0)
"""Changes of colours and lights with ``by_color``: hues of gates by up to 25 degrees, where those of four gates are 90
degrees apart."""
PRIVILEGED_NAMES = ("gate_corners", "obstacles_near")
"""Observations of the race for a critic, and with ``gates_observed`` also for the policy."""


class RaceByCamera(Race):
    """Race by the rules of ``race`` with a camera on each drone, which ``make`` adds.

    Policies observe gates and obstacles only in images, of depth or with ``by_color`` of colours, and do not observe
    the horizontal position of the drone. The reward has two more terms, costs of looking away from the next gate and of
    flying faster than ``speed``. Drones at the start face the first gate; drones that start behind a gate look along
    its axis. The setting ``sensor_range`` has no effect.
    """

    name = "race_by_camera"
    control = "body_rate"

    speed: float = setting(default=1.5, positive=True)
    """Speed above which flying faster costs reward, m/s."""
    gates_observed: bool = False
    """Whether to add true positions of gates and obstacles to the observations, for a teacher of other policies."""
    by_color: bool = False
    """Whether each gate has a colour of its own and policies observe colours instead of depths. Colours and light
    change a little in every episode."""

    def spawn(self, data: SimData, key: Array) -> SimData:
        data = super().spawn(data, key)
        passed, (gates_pos, gates_quat) = race_of(data).passed, gates_of(data)
        axis = rotation.rotate(gates_quat, jnp.asarray([1.0, 0.0, 0.0], gates_pos.dtype))
        s, last_axis = data.states, pick_entry(axis, jnp.maximum(passed - 1, 0))
        ahead = jnp.where(passed[..., None] > 0, last_axis, gates_pos[0] - s.pos)
        yaw = rotation.safe_arctan2(ahead[..., 1], ahead[..., 0])
        yaw_quat = rotation.from_rpy(rotation.along_z(yaw))
        return flying(data, s.pos, rotation.multiply(yaw_quat, s.quat), s.vel)

    def observe(self, data: SimData) -> dict[str, Array]:
        """Return attitude, velocity and angular velocity in the body frame, height, and the next gate.

        ``next_gate`` has 1 at the index of the next gate and 0 elsewhere; all entries are 0 where all gates are passed.
        """
        s, record = data.states, race_of(data)
        matrix = rotation.matrix(s.quat)
        next_index = jnp.where(record.success, -1, gate_index(data))
        is_next = next_index[..., None] == np.arange(self.course.n_gates, dtype=np.int32)
        obs = {
            "ang_vel": s.ang_vel,
            "height": s.pos[..., 2:],
            "next_gate": is_next.astype(s.pos.dtype),
            "rot": matrix.reshape(*matrix.shape[:-2], 9),
            "vel_body": rotation.rotate_inverse(s.quat, s.vel),
        }
        return obs | (self.privileged(data) if self.gates_observed else {})

    def privileged(self, data: SimData) -> dict[str, Array]:
        obs = observe(data, np.inf)
        return {name: obs[name] for name in PRIVILEGED_NAMES if name in obs}

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        s, (gate_pos, _) = data.states, next_gate(data)
        to_gate = rotation.rotate_inverse(s.quat, gate_pos - s.pos)
        cosine = to_gate[..., 0] / jnp.maximum(rotation.safe_norm(to_gate)[..., 0], 0.1)
        speed = rotation.safe_norm(s.vel)[..., 0]
        costs = {"away": AWAY_COST * (cosine - 1), "haste": -HASTE_COST * jnp.maximum(speed - self.speed, 0)}
        costs = terms.only_where(~race_of(data).flight_over_before, costs)
        return super().rewards(data, action, last_action) | costs

    def gate_colors(self) -> Sequence[Sequence[float]]:
        if not self.by_color:
            return super().gate_colors()
        hues = (np.arange(self.course.n_gates) + 0.5) / self.course.n_gates  # red is the colour of the obstacles
        return [(*colorsys.hsv_to_rgb(hue, SATURATION, BRIGHTNESS), 1.0) for hue in hues.tolist()]

    def policy_camera(self) -> Camera:
        return Camera(*IMAGE_SIZE, outputs=("rgb",), random_colors=CHANGES) if self.by_color else Camera(*IMAGE_SIZE)
