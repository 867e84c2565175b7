"""Chase a car and land on its roof."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData, grid_2d
from crazysim.core.plugin import StagePlacement
from crazysim.core.settings import setting
from crazysim.envs.random import draw, scale_symmetric, scale_to
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.goals import pick_entry
from crazysim.envs.tasks.touch_down import TouchDown
from crazysim.lab.vehicles.cars import Cars
from crazysim.lab.vehicles.model import load_vehicle
from crazysim.sim.sim import Sim

CARS, VEHICLE = "cars", "f1tenth_ros"
"""Name of the population of cars, and name of the vehicle model."""
SPACING = 6.0
"""Distance between the initial positions of the cars of several drones, m; a drone observes its own car only."""
MAX_DISTANCE, CEILING = 3.0, 2.5
"""Largest horizontal distance of a drone from the roof of its car, and largest height of a drone, m."""
MIN_SPEED_FRACTION = 0.3
"""Smallest speed of a car, as a fraction of its setting ``speed``."""
MAX_STEER = 0.25
"""Largest steering angle of a car, rad; the car then drives on a circle of 1.3 m radius."""
TOUCH_DOWN_RADIUS = 0.12
"""Largest horizontal distance of a drone from the middle of the roof at touch-down, m."""


class Chase(TouchDown):
    """Chase a car and land on its roof.

    A car drives in circles, or straight ahead. Every episode has a random speed and steering angle. A drone starts in
    flight above or beside the car. It has landed when it touches the car from above, within 12 cm of the middle of the
    roof, at a relative speed of at most 0.5 m/s and a tilt of at most 20 degrees. Contacts are checked at every physics
    step. Any other contact with a car's body or the floor is a crash. Being more than 3 m from the roof horizontally,
    or higher than 2.5 m, is also a crash. An episode ends when every drone has landed or crashed.
    """

    name = "chase"
    target_name = "roof"
    progress_reward = 6.0
    crash_cost = 4.0
    film_view = {"elevation": -25}

    speed: float = setting(default=1.0, low=0.0, high=3.0)
    """Largest speed of a car, m/s; the smallest speed is 0.3 times that."""

    def install(self, sim: Sim) -> None:
        cars = Cars(sim.n_drones, vehicle=VEHICLE, pos=SPACING * grid_2d(sim.n_drones), level="speed", name=CARS)
        sim.add(cars)
        contacts = sim.scene.contact_fn([f"{CARS}:{k}" for k in range(sim.n_drones)], drones=False)
        touch = StagePlacement(self.touch_down_stage(contacts, TOUCH_DOWN_RADIUS, "world"), before="increment_steps")
        self.add_states(sim, [touch])

    def spawn(self, data: SimData, key: Array) -> SimData:
        n, car = data.core.n_drones, data.plugins[CARS]
        x = draw(key, n, start=3, rpy=3, vel=3, yaw=1, speed=1, steer=1)
        speed, steer = (
            self.speed * scale_to(x["speed"], MIN_SPEED_FRACTION, 1.0),
            scale_symmetric(x["steer"], MAX_STEER),
        )
        car = rolling_car(car, scale_symmetric(x["yaw"], np.pi), speed, steer)
        data = data.replace(plugins=data.plugins | {CARS: car})
        pos = car.pos + scale_symmetric(x["start"], np.array([1.0, 1.0, 0.4])) + np.array([0.0, 0.0, 1.1])
        return flying(data, pos, rotation.from_rpy(scale_symmetric(x["rpy"], 0.2)), scale_symmetric(x["vel"], 0.3))

    def target_motion(self, data: SimData, steps_ahead: int = 0) -> tuple[Array, Array]:
        car: Cars = data.plugins[CARS]
        roof_pos = jnp.asarray(roof_centre(), car.pos.dtype)
        arm = rotation.rotate(car.quat, jnp.broadcast_to(roof_pos, car.pos.shape))
        turning = jnp.concatenate([0 * car.yaw_rate, 0 * car.yaw_rate, car.yaw_rate], axis=-1)
        vel = car.vel + rotation.cross(turning, arm)
        return pick_entry(car.pos + arm, data.core.drone_id), pick_entry(vel, data.core.drone_id)

    def has_left_arena(self, data: SimData) -> Array:
        pos = data.states.pos
        offset = (pos - self.target_motion(data)[0])[..., :2]
        return (rotation.dot(offset, offset)[..., 0] > MAX_DISTANCE**2) | (pos[..., 2] > CEILING)

    def observe(self, data: SimData) -> dict[str, Array]:
        """Return the drone's state, the vector to its roof, m, the roof's relative velocity, m/s, and the car's motion.

        ``heading`` is the horizontal unit vector along the car, and ``yaw_rate`` its yaw rate, rad/s.
        """
        car, drone = data.plugins[CARS], data.core.drone_id
        heading = jnp.concatenate([jnp.cos(car.yaw), jnp.sin(car.yaw)], axis=-1)
        return super().observe(data) | {
            "heading": pick_entry(heading, drone),
            "yaw_rate": pick_entry(car.yaw_rate, drone),
        }


def rolling_car(car: Cars, yaw: Array, speed: Array, steer: Array) -> Cars:
    """Return cars that roll without slip, with commands to keep speed and steering angle.

    Args:
        car: Cars of the model ``VEHICLE``.
        yaw: Heading, rad. (n, 1)
        speed: Speed of the rear axle, m/s. (n, 1)
        steer: Steering angle, rad. (n, 1)
    """
    vehicle = load_vehicle(VEHICLE)
    lateral_ratio = jnp.tan(steer) * (vehicle.number("axles.rear") / vehicle.wheelbase)
    return car.replace(
        yaw=yaw,
        body_vel=jnp.concatenate([speed, lateral_ratio * speed], axis=-1),
        yaw_rate=speed * jnp.tan(steer) / vehicle.wheelbase,
        steer=steer,
        command=jnp.concatenate([speed, steer], axis=-1),
    )


def roof_centre() -> np.ndarray:
    """Return the middle of the roof in the frame of a car, m. (3,)"""
    vehicle = load_vehicle(VEHICLE)
    length, height = vehicle.number("shape.length"), vehicle.number("shape.height")
    return np.array([-0.06 * length, 0.0, height])
