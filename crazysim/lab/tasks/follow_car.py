"""Follow a car that the drone observes with a camera."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import state
from crazysim.core.settings import setting
from crazysim.envs import terms
from crazysim.envs.random import draw, scale_symmetric, scale_to
from crazysim.envs.spawn import flying
from crazysim.envs.task import Task
from crazysim.envs.tasks.goals import motion_of
from crazysim.lab.tasks.chase import CARS, VEHICLE, rolling_car
from crazysim.lab.tasks.target_camera import TargetCamera
from crazysim.lab.vehicles.cars import Cars
from crazysim.lab.vehicles.model import load_vehicle
from crazysim.sim.sim import Sim

SPACING = 6.0
"""Distance along y between the cars of several drones at the start, m; a drone follows its own car."""
FOLLOW_DISTANCE, FOLLOW_HEIGHT = 0.8, 0.7
"""Point at which the drone should be: distance behind a car's centre of mass, and height above it, m."""
MAX_DISTANCE, MIN_HEIGHT = 2.0, 0.25
"""Largest distance of a drone from this point, and smallest height of a drone, m. Cars are lower than this height."""
SPEED_RANGE = (0.2, 0.8)
"""Smallest and largest mean speed of a car, as fractions of ``speed``."""
SPEED_AMPLITUDE = 0.2
"""Amplitude of a car's speed, as a fraction of ``speed``."""
STEER_RANGE = (0.1, 0.25)
"""Smallest and largest amplitude of a car's steering angle, rad."""
ANG_FREQ_RANGES = ((0.5, 1.5), (1.0, 2.0))
"""Smallest and largest angular frequency of the speed, and of the steering angle, rad/s."""
MAX_YAW = 0.3
"""Largest angle between a car's mean heading at the start and the x axis, rad."""


class FollowCar(Task):
    """Stay behind and above a car that the drone observes with a camera.

    Speed and steering angle of the car oscillate differently in every episode; its mean heading is within 0.3 rad of
    the x axis. A drone starts near the point 0.8 m behind and 0.7 m above the car. It succeeds if its distance from
    this point is below the tolerance during the last second. An episode ends when a drone is lower than 0.25 m, or more
    than 2 m away from its point.

    Policies observe neither the car's position nor the horizontal position of the drone. ``make`` adds a camera with
    two images: ``segmentation`` is 1 where a pixel shows the car's body, and ``depth`` is the depth image.
    """

    name = "follow_car"
    film_view = {"follow": 0, "distance": 3.0, "azimuth": 30.0, "elevation": -25.0}

    speed: float = setting(default=1.2, low=0.0, high=3.0)
    """Largest speed of a car, m/s."""
    seconds: float = 6.0
    """Length of an episode, s."""
    tolerance: float = 0.3
    """Distance from the point behind and above the car below which the drone follows the car, m."""

    car_speed: Array = state()
    """Mean speed of the car, m/s."""
    amplitude: Array = state((2,))
    """Amplitude of its speed, m/s, and steering angle, rad; the steering angle oscillates about zero."""
    ang_freq: Array = state((2,))
    """Angular frequency of speed and steering angle, rad/s."""
    phase: Array = state((2,))
    """Phase of speed and steering angle at the start of the episode, rad."""

    def install(self, sim: Sim) -> None:
        y = SPACING * (np.arange(sim.n_drones) - (sim.n_drones - 1) / 2)
        pos = np.stack([0 * y, y], axis=-1)
        sim.add(Cars(sim.n_drones, vehicle=VEHICLE, pos=pos, level="speed", name=CARS))
        self.add_states(sim)

    def spawn(self, data: SimData, key: Array) -> SimData:
        x = draw(key, data.core.n_drones, start=3, rpy=3, vel=3, yaw=1, speed=1, steer=1, ang_freq=2, phase=2)
        low, high = np.array(ANG_FREQ_RANGES).T
        steer = scale_to(x["steer"], *STEER_RANGE)
        data = self.write(
            data,
            car_speed=self.speed * scale_to(x["speed"], *SPEED_RANGE),
            amplitude=jnp.concatenate([jnp.full_like(steer, self.speed * SPEED_AMPLITUDE), steer], axis=-1),
            ang_freq=scale_to(x["ang_freq"], low, high),
            phase=2 * np.pi * x["phase"],
        )
        speed, steer = jnp.split(self.command(data, jnp.zeros_like(steer)), 2, axis=-1)
        drive = self.read(data)
        # The heading oscillates about its mean with this amplitude, rad.
        yaw_amplitude = drive.car_speed * jnp.tan(drive.amplitude[..., 1:]) / load_vehicle(VEHICLE).wheelbase
        yaw_amplitude = yaw_amplitude / drive.ang_freq[..., 1:]
        yaw = scale_symmetric(x["yaw"], MAX_YAW) - yaw_amplitude * jnp.cos(drive.phase[..., 1:])
        car = rolling_car(data.plugins[CARS], yaw, speed, steer)
        data = data.replace(plugins=data.plugins | {CARS: car})
        pos, vel = self.target_motion(data)
        rpy = scale_symmetric(x["rpy"], 0.2) + jnp.concatenate([0 * yaw, 0 * yaw, yaw], axis=-1)
        return flying(
            data,
            pos + scale_symmetric(x["start"], np.array([0.5, 0.5, 0.3])),
            rotation.from_rpy(rpy),
            vel + scale_symmetric(x["vel"], 0.3),
        )

    def command(self, data: SimData, time: Array) -> Array:
        """Return speed, m/s, and steering angle, rad, of cars at a time since the start of the episode, s. (..., 2)"""
        drive = self.read(data)
        oscillation = drive.amplitude * jnp.sin(drive.ang_freq * time + drive.phase)
        return jnp.concatenate([drive.car_speed + oscillation[..., :1], oscillation[..., 1:]], axis=-1)

    def before_step(self, data: SimData) -> SimData:
        car = data.plugins[CARS]
        command = self.command(data, data.core.steps / data.core.freq)
        return data.replace(plugins=data.plugins | {CARS: car.replace(command=command)})

    def target_motion(self, data: SimData) -> tuple[Array, Array]:
        """Return position, m, and velocity, m/s, of the point behind and above each drone's car. (n_drones, 3) each"""
        car: Cars = data.plugins[CARS]
        arm = jnp.concatenate([jnp.cos(car.yaw), jnp.sin(car.yaw), 0 * car.yaw], axis=-1) * -FOLLOW_DISTANCE
        turning_vel = jnp.concatenate([-arm[..., 1:2], arm[..., :1], 0 * car.yaw], axis=-1) * car.yaw_rate
        return car.pos + arm + np.array([0.0, 0.0, FOLLOW_HEIGHT], car.pos.dtype), car.vel + turning_vel

    def observe(self, data: SimData) -> dict[str, Array]:
        return motion_of(data)

    def privileged(self, data: SimData) -> dict[str, Array]:
        (pos, vel), car = self.target_motion(data), data.plugins[CARS]
        return {
            "difference_to_point": pos - data.states.pos,
            "difference_to_point_vel": vel - data.states.vel,
            "car_heading": jnp.concatenate([jnp.cos(car.yaw), jnp.sin(car.yaw)], axis=-1),
            "car_vel": car.vel,
            "car_yaw_rate": car.yaw_rate,
        }

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        return {
            "proximity": terms.proximity(self.error(data), coarse=2.0, fine=8.0),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "lost": -10.0 * self.is_lost(data),
        }

    def is_lost(self, data: SimData) -> Array:
        """Whether a drone is too low, or too far from its point. (n_drones,)"""
        return (self.error(data) > MAX_DISTANCE) | (data.states.pos[..., 2] < MIN_HEIGHT)

    def terminated(self, data: SimData) -> Array:
        return jnp.any(self.is_lost(data))

    def error(self, data: SimData) -> Array:
        return rotation.safe_norm(self.target(data) - data.states.pos)[..., 0]

    def target(self, data: SimData) -> Array:
        return self.target_motion(data)[0]

    def subjects(self, data: SimData) -> Array:
        return data.plugins[CARS].pos

    def policy_camera(self) -> TargetCamera:
        return TargetCamera(
            24, 18, fovy=80.0, max_depth=4.0, rpy=(0.0, 0.6, 0.0), outputs=("depth", "segmentation"), target=CARS
        )
