"""Cars in the scene: bodies, wheels that roll and steer, and trailers, as objects that follow the dynamics."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import Objects
from crazysim.core.plugin import Simulation
from crazysim.core.settings import as_rgba
from crazysim.lab.vehicles.car_state import ackermann, heading_quat, tilted_quat
from crazysim.lab.vehicles.model import VehicleModel, load_vehicle
from crazysim.lab.vehicles.trailer import trailer_axles

BODY_COLOR, DARK, STEEL = (0.1, 0.35, 0.75, 1.0), (0.08, 0.08, 0.08, 1.0), (0.6, 0.6, 0.65, 1.0)
RUBBER, WOOD = (0.16, 0.16, 0.16, 1.0), (0.7, 0.6, 0.35, 1.0)
"""Colours of bodies, of rims, bumpers and axles, of spokes, tyres and decks."""
CONTACT_ATTRIBUTES, NO_CONTACT_ATTRIBUTES = 'contype="0" conaffinity="2"', 'contype="0" conaffinity="0"'
"""Attributes of geoms that drones touch, and of other geoms."""
N_SPOKES = 5
"""Spokes of a wheel, which make its rotation visible."""


def part_names(cars: Any) -> tuple[str, ...]:
    """Return the names of the kinds of objects of cars; a number is added for each object."""
    parts = ("body", "wheel", "drawbar", "trailer", "trailer_wheel") if cars.trailer else ("body", "wheel")
    return tuple(_object_name(cars, part) for part in parts)


def _object_name(cars: Any, part: str) -> str:
    return cars.name if part == "body" else f"{cars.name}_{part}"


def add_to_scene(sim: Simulation, cars: Any, vehicle: VehicleModel) -> None:
    number, n = vehicle.number, cars.n_members
    wheel = _wheel_geoms(number("wheels.radius"), number("wheels.width"))
    parts = {"body": (_body_geoms(vehicle, as_rgba(BODY_COLOR if cars.rgba is None else cars.rgba)), n)}
    parts["wheel"] = (wheel, n * len(wheel_positions(vehicle)))
    if cars.trailer:
        length, trailer_wheel = (
            number("trailer.drawbar"),
            _wheel_geoms(number("trailer.wheel_radius"), number("trailer.wheel_width")),
        )
        parts["drawbar"] = (_drawbar_geoms(length, number("trailer.track")), n)
        parts["trailer"] = (_deck_geoms(vehicle), n)
        parts["trailer_wheel"] = (trailer_wheel, 4 * n)
    for part, (geoms, count) in parts.items():
        sim.scene.add_once(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>", _object_name(cars, part), count)


def wheel_positions(vehicle: VehicleModel) -> np.ndarray:
    """Return the positions of the wheels, body frame, m. (n, 2)

    The order of four wheels is front left, front right, rear left, rear right. Other vehicles have two wheels, front
    and rear.
    """
    front, rear = vehicle.number("axles.front"), -vehicle.number("axles.rear")
    half_track = vehicle.number("axles.track") / 2
    sides = (half_track, -half_track) if vehicle.number("wheels.number") == 4 else (0.0,)
    return np.array([(x, y) for x in (front, rear) for y in sides])


def move_cars(objects: Objects, cars: Any) -> Objects:
    """Return the objects of a world with its cars, whose arrays are (n_members, ...), at their poses."""
    vehicle = load_vehicle(cars.vehicle)
    poses = {"body": (cars.pos, cars.quat), "wheel": _wheel_poses(vehicle, cars)}
    if cars.trailer:
        poses |= _trailer_poses(vehicle, cars)
    return objects.with_poses({_object_name(cars, part): pose for part, pose in poses.items()})


def _wheel_poses(vehicle: VehicleModel, car: Any) -> tuple[Array, Array]:
    positions = wheel_positions(vehicle)
    shape = (car.pos.shape[0], len(positions))
    body_quat = jnp.broadcast_to(car.quat[:, None], (*shape, 4))
    pos = car.pos[:, None] + rotation.rotate(body_quat, jnp.asarray(np.pad(positions, ((0, 0), (0, 1))), car.pos.dtype))
    front_steer = ackermann(car.steer, vehicle.wheelbase, vehicle.number("axles.kingpin_track"))[
        :, : len(positions) // 2
    ]
    steer = jnp.concatenate([front_steer, jnp.zeros_like(front_steer)], axis=-1)[..., None]
    roll_quat = _rolling_quat(jnp.broadcast_to((car.distance / vehicle.number("wheels.radius"))[:, None], steer.shape))
    quat = rotation.multiply(body_quat, rotation.multiply(heading_quat(steer), roll_quat))
    return pos.reshape(-1, 3), quat.reshape(-1, 4)


def _trailer_poses(vehicle: VehicleModel, car: Any) -> dict[str, tuple[Array, Array]]:
    number = vehicle.number
    radius, half_track = number("trailer.wheel_radius"), number("trailer.track") / 2
    bar_quat, deck_quat = (tilted_quat(car.joints[:, k : k + 1], car.normal) for k in range(2))
    front, rear = (_above_plane(x, car, radius - number("wheels.radius")) for x in trailer_axles(car.state, car.params))
    roll_quat = _rolling_quat(car.distance / radius)
    wheels = []
    for origin, attitude in ((front, bar_quat), (rear, deck_quat)):
        for side in (half_track, -half_track):
            offset = rotation.rotate(attitude, jnp.asarray([0.0, side, 0.0], origin.dtype))
            wheels.append((origin + offset, rotation.multiply(attitude, roll_quat)))
    pos, quat = (jnp.stack(x, axis=1) for x in zip(*wheels, strict=True))
    wheel = (pos.reshape(-1, 3), quat.reshape(-1, 4))
    return {"drawbar": (front, bar_quat), "trailer": (front, deck_quat), "trailer_wheel": wheel}


def _above_plane(level_pos: Array, car: Any, height: float) -> Array:
    offset, normal = level_pos - car.pos[:, :2], car.normal
    rise = -(normal[:, :1] * offset[:, :1] + normal[:, 1:2] * offset[:, 1:]) / normal[:, 2:]
    return jnp.concatenate([level_pos, car.pos[:, 2:] + rise + height], axis=-1)


def _rolling_quat(angle: Array) -> Array:
    zero = jnp.zeros_like(angle)
    return jnp.concatenate([zero, jnp.sin(angle / 2), zero, jnp.cos(angle / 2)], axis=-1)


def _geom_xml(
    kind: str,
    size: Iterable[float],
    pos: Iterable[float],
    rgba: Iterable[float],
    contact_attributes: str,
    attributes: str = "",
) -> str:
    text = " ".join(f"{float(x):.6g}" for x in size), " ".join(f"{float(x):.6g}" for x in pos)
    colour = " ".join(f"{float(x):.3g}" for x in rgba)
    return f'<geom type="{kind}" size="{text[0]}" pos="{text[1]}" rgba="{colour}" {contact_attributes} {attributes}/>'


def _body_geoms(vehicle: VehicleModel, rgba: Iterable[float]) -> str:
    # A vehicle with four wheels has a plate, a hood, a cabin with a flat roof, and bumpers. Other vehicles are one box.
    half_length, half_width, half_height = (vehicle.number(f"shape.{x}") / 2 for x in ("length", "width", "height"))
    front, plate = vehicle.number("axles.front"), 0.02  # half the height of the plate
    if vehicle.number("wheels.number") != 4:
        return _geom_xml("box", (half_length, half_width / 2, half_height * 2), (0, 0, 0), rgba, CONTACT_ATTRIBUTES)
    inner_width = min(half_width, vehicle.number("axles.track") / 2 - vehicle.number("wheels.width") / 2 - 0.005)
    cabin_half_height, cabin_x = half_height - plate / 2, -0.12 * half_length
    return (
        _geom_xml("box", (half_length * 0.92, inner_width, plate), (0, 0, 0), rgba, CONTACT_ATTRIBUTES)
        + _geom_xml(
            "box",
            (half_length * 0.45, inner_width * 0.8, cabin_half_height),
            (cabin_x, 0, 2 * half_height - cabin_half_height),
            rgba,
            CONTACT_ATTRIBUTES,
        )
        + _geom_xml(
            "box",
            (half_length * 0.2, inner_width * 0.7, plate / 2),
            (front - half_length * 0.12, 0, 1.5 * plate),
            rgba,
            NO_CONTACT_ATTRIBUTES,
        )
        + _geom_xml("box", (0.008, half_width * 0.85, plate), (half_length - 0.008, 0, 0), DARK, CONTACT_ATTRIBUTES)
        + _geom_xml("box", (0.008, half_width * 0.85, plate), (0.008 - half_length, 0, 0), DARK, CONTACT_ATTRIBUTES)
    )


def _wheel_geoms(radius: float, width: float) -> str:
    axis, half_length = 'zaxis="0 1 0"', 0.29 * radius
    rim = _geom_xml("cylinder", (0.6 * radius, width / 2 + 0.0008), (0, 0, 0), DARK, NO_CONTACT_ATTRIBUTES, axis)
    spokes = ""
    for angle in np.arange(N_SPOKES) * 2 * np.pi / N_SPOKES:
        pos, quat_wy = (
            (half_length * np.cos(angle), 0, -half_length * np.sin(angle)),
            (np.cos(angle / 2), np.sin(angle / 2)),
        )
        quat = f'quat="{quat_wy[0]:.6g} 0 {quat_wy[1]:.6g} 0"'
        spokes += _geom_xml(
            "box", (half_length, width / 2 + 0.0016, 0.06 * radius), pos, STEEL, NO_CONTACT_ATTRIBUTES, quat
        )
    return _geom_xml("cylinder", (radius, width / 2), (0, 0, 0), RUBBER, CONTACT_ATTRIBUTES, axis) + rim + spokes


def _drawbar_geoms(length: float, track: float) -> str:
    bar = _geom_xml("box", (length / 2, 0.004, 0.004), (length / 2, 0, 0), DARK, NO_CONTACT_ATTRIBUTES)
    return bar + _geom_xml("box", (0.0075, track / 2, 0.0075), (0, 0, 0), DARK, CONTACT_ATTRIBUTES)


def _deck_geoms(vehicle: VehicleModel) -> str:
    size, centre = vehicle.value("trailer.deck") / 2, vehicle.value("trailer.deck_centre")
    axles, track = vehicle.number("trailer.axle_distance"), vehicle.number("trailer.track")
    posts = "".join(
        _geom_xml("cylinder", (0.008, centre[2] / 2), (x, 0, centre[2] / 2), DARK, NO_CONTACT_ATTRIBUTES)
        for x in (0.0, -axles)
    )
    return (
        _geom_xml("box", size, centre, WOOD, CONTACT_ATTRIBUTES)
        + _geom_xml(
            "box", (axles / 2 + 0.025, track / 2 - 0.025, 0.0025), (-axles / 2, 0, 0.014), STEEL, NO_CONTACT_ATTRIBUTES
        )
        + _geom_xml("box", (0.0075, track / 2, 0.0075), (-axles, 0, 0), DARK, CONTACT_ATTRIBUTES)
        + posts
    )
