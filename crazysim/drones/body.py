"""Drone bodies as lists of MJCF primitives, for rendering and contacts; the dynamics do not depend on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazysim.drones.airframe import Airframe

LED_MATERIALS = ("led_top", "led_bot")
"""Materials that are copied for each drone, so that the LEDs of each drone can have their own colours."""
MAX_LED_DRONES = 450
"""Number of drones whose LEDs have their own colours: MuJoCo draws at most 998 materials (``mjMAXMATERIAL``)."""

MATERIALS = {
    "drone_carbon": (0.10, 0.10, 0.11, 1.0),
    "drone_metal": (0.75, 0.76, 0.78, 1.0),
    "drone_plate": (0.16, 0.30, 0.24, 1.0),
    "drone_battery": (0.55, 0.57, 0.62, 1.0),
    "drone_propeller": (0.12, 0.12, 0.14, 0.45),
    "drone_nose": (0.90, 0.45, 0.10, 1.0),
}
"""Colours that all drones share, rgba."""

BATTERY_VOLUME_PER_MASS = 1.2e-4
"""Default ratio of the battery's volume to the drone's mass, m^3/kg; the built-in airframes have 0.8e-4 to 1.7e-4."""


@dataclass(frozen=True, eq=False)
class BodyGeom:
    """One geom of a drone, in its body frame."""

    kind: str
    """Type of the geom: box, sphere, capsule, cylinder or ellipsoid."""
    size: NDArray
    """Half sizes or radii as in MJCF, m. (3,)"""
    pos: NDArray
    """Centre, or the near end of a capsule with ``end``, m. (3,)"""
    material: str = ""
    """Name of the material; the first ``MAX_LED_DRONES`` drones have their own copies of ``LED_MATERIALS``."""
    end: NDArray | None = None
    """Far end of a capsule that begins at ``pos``, m. (3,)"""
    name: str = ""
    """Name, to which the drone's number is appended; empty for geoms that are not looked up."""
    collides: bool = False
    """True for a geom that is used for contacts and not rendered."""


@dataclass(frozen=True, eq=False)
class BodyCamera:
    """One camera on a drone, in its body frame."""

    name: str
    """Name, to which the drone's number is appended."""
    pos: NDArray
    """Position, m. (3,)"""
    xyaxes: NDArray
    """Directions to the right and up in the image. (6,)"""
    fovy: float = 45.0
    """Vertical field of view, degrees."""
    tracks: bool = False
    """True for a camera that follows the drone's position but not its attitude."""


def body_shape(airframe: Airframe) -> dict[str, NDArray[np.float64]]:
    """Return the table ``[shape]`` of an airframe, with defaults for missing keys.

    The defaults follow from the rotors' positions, and the battery's size from the mass, in the proportions of the
    built-in airframes. docs/guides/airframe-keys.md describes the keys.
    """
    # Sizes follow from the rotors' positions and the mass.
    rotors = airframe.value("rotors.position")
    reach = float(np.max(np.linalg.norm(rotors[:, :2], axis=-1)))
    height = float(np.mean(rotors[:, 2]))
    gaps = np.linalg.norm(rotors[:, None, :2] - rotors[None, :, :2], axis=-1)
    spacing = float(np.min(gaps[gaps > 0], initial=2 * reach))
    battery_thickness = (BATTERY_VOLUME_PER_MASS * float(airframe.value("rigid_body.mass")) / 6) ** (1 / 3)
    shape = {
        "battery": np.array([3, 2, 1]) * battery_thickness,
        "plate": np.array([0.75, 0.55, 0.04]) * reach,
        "arm_radius": 0.04 * reach,
        "motor_radius": 0.08 * reach,
        "motor_height": 0.12 * reach,
        "propeller_radius": 0.37 * spacing,
        "propeller_height": 0.1 * reach,
        "led_radius": 0.06 * reach,
    } | dict(airframe.tables.get("shape", {}))

    # Keys that depend on others, which the file may have set.
    plate, battery, led_radius = shape["plate"], shape["battery"], shape["led_radius"]
    shape = {"battery_height": (plate[2] + battery[2]) / 2} | shape
    battery_top = shape["battery_height"] + battery[2] / 2
    half_height = max(0.5 * shape["motor_height"] + shape["propeller_height"], abs(height) / 2 + battery[2])
    half_sides = np.max(np.abs(rotors[:, :2]), axis=0) + shape["propeller_radius"]
    camera_distance = 0.7 + 7 * reach
    shape = {
        "led_heights": np.array(
            [max(battery_top, plate[2] / 2), min(shape["battery_height"] - battery[2] / 2, -plate[2] / 2)]
        )
        + led_radius / 2 * np.array([1, -1]),
        "collision_sphere": np.array([0, 0, height / 2, reach + shape["propeller_radius"]]),
        "collision_box": np.array([0, 0, height / 2, *half_sides, half_height]),
        "fpv_camera": np.array([0.9 * plate[0], 0, 0]),
        "track_camera": np.array([-camera_distance, 0, camera_distance / 2]),
    } | shape
    return {key: np.asarray(value, np.float64) for key, value in shape.items()}


def body_geoms(airframe: Airframe) -> list[BodyGeom]:
    """Return plate, battery, nose bar, arms, motors, propeller discs, two LEDs, and the two collision geoms.

    Only ``col_sphere`` and ``col_box`` collide; all other geoms are rendered.
    """
    shape = body_shape(airframe)
    plate, battery, led = shape["plate"] / 2, shape["battery"] / 2, float(shape["led_radius"])
    geoms = [
        BodyGeom("box", plate, np.zeros(3), "drone_plate"),
        BodyGeom("box", battery, np.array([0, 0, float(shape["battery_height"])]), "drone_battery"),
        # A coloured bar over the leading edge shows the heading of a drone seen from afar.
        BodyGeom("box", plate * [0.1, 0.7, 1.6], np.array([0.95 * plate[0], 0, 0]), "drone_nose"),
    ]
    motor_radius, motor_height = float(shape["motor_radius"]), float(shape["motor_height"])
    disc_size = np.array([float(shape["propeller_radius"]), 0.03 * motor_radius + 5e-4, 0])
    for rotor in airframe.value("rotors.position"):
        arm_size = np.array([float(shape["arm_radius"]), 0, 0])
        hub = rotor + [0, 0, float(shape["propeller_height"])]
        geoms += [
            BodyGeom("capsule", arm_size, np.zeros(3), "drone_carbon", end=rotor),
            BodyGeom(
                "cylinder",
                np.array([motor_radius, motor_height / 2, 0]),
                rotor + [0, 0, 0.3 * motor_height],
                "drone_metal",
            ),
            BodyGeom("cylinder", disc_size, hub, "drone_propeller"),
        ]
    geoms += [
        BodyGeom("ellipsoid", np.array([led, led, led / 2]), np.array([0, 0, z]), material)
        for material, z in zip(LED_MATERIALS, shape["led_heights"], strict=True)
    ]
    sphere, box = shape["collision_sphere"], shape["collision_box"]
    return [
        *geoms,
        BodyGeom("sphere", np.array([sphere[3], 0, 0]), sphere[:3], name="col_sphere", collides=True),
        BodyGeom("box", box[3:], box[:3], name="col_box", collides=True),
    ]


def body_cameras(airframe: Airframe) -> list[BodyCamera]:
    """Return ``fpv_cam``, which looks ahead from the drone, and ``track_cam``, which follows it from behind."""
    shape = body_shape(airframe)
    camera_pos = shape["track_camera"]
    # The camera looks ahead from behind: its right is body -y, and its up is tilted forward as far as it looks down.
    camera_up = np.array([-camera_pos[2] * np.sign(camera_pos[0]), 0, abs(camera_pos[0])]) / np.hypot(
        camera_pos[0], camera_pos[2]
    )
    camera_right = np.array([0.0, -1.0, 0.0])
    return [
        BodyCamera("track_cam", camera_pos, np.concatenate([camera_right, camera_up]), tracks=True),
        BodyCamera("fpv_cam", shape["fpv_camera"], np.concatenate([camera_right, [0, 0, 1]]), fovy=70.0),
    ]
