"""The drone's body as a list of MJCF primitives: what is seen and touched, never what flies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from crazysim.drones.airframe import Airframe

LED_MATERIALS = ("led_top", "led_bot")
"""Materials of which every drone has its own, so that its colour can be changed alone."""

MATERIALS = {
    "drone_carbon": (0.10, 0.10, 0.11, 1.0),
    "drone_metal": (0.75, 0.76, 0.78, 1.0),
    "drone_plate": (0.16, 0.30, 0.24, 1.0),
    "drone_battery": (0.55, 0.57, 0.62, 1.0),
    "drone_propeller": (0.12, 0.12, 0.14, 0.45),
    "drone_nose": (0.90, 0.45, 0.10, 1.0),
}
"""Colours that all drones share, rgba."""


@dataclass(frozen=True, eq=False)
class Part:
    """One geom of a drone, in its body frame."""

    kind: str
    """Type of the geom: box, sphere, capsule, cylinder or ellipsoid."""
    size: NDArray
    """Half sizes or radii, m, as MJCF has them."""
    pos: NDArray
    """Centre, m. (3,)"""
    material: str = ""
    """Name of its material; an LED's is the drone's own."""
    end: NDArray | None = None
    """Far end of a capsule that begins at ``pos``, m. (3,)"""
    name: str = ""
    """Name, which the drone's number is added to; empty for parts that nothing asks for."""
    touches: bool = False
    """Whether it is for contacts only, and not part of what is seen."""


@dataclass(frozen=True, eq=False)
class BodyCamera:
    """One camera that a drone carries, in its body frame."""

    name: str
    """Name, which the drone's number is added to."""
    pos: NDArray
    """Place, m. (3,)"""
    xyaxes: NDArray
    """The picture's right and up. (6,)"""
    fovy: float = 45.0
    """Vertical field of view, degrees."""
    tracks: bool = False
    """Whether it follows the drone's place but not its attitude."""


def body_parts(airframe: Airframe) -> list[Part]:
    """Return arms, motors, propeller discs, plate, battery, two LEDs, and the two collision shapes.

    ``col_sphere`` and ``col_box`` are the shapes that touch; all others are seen only.
    """
    shape = partial(_outline, airframe)
    plate, battery, led = shape("plate") / 2, shape("battery") / 2, float(shape("led_radius"))
    parts = [
        Part("box", plate, np.zeros(3), "drone_plate"),
        Part("box", battery, np.array([0, 0, float(shape("battery_height"))]), "drone_battery"),
        # A coloured bar over the leading edge: a drone seen from afar must show where it looks.
        Part("box", plate * [0.1, 0.7, 1.6], np.array([0.95 * plate[0], 0, 0]), "drone_nose"),
    ]
    motor, height = float(shape("motor_radius")), float(shape("motor_height"))
    disc = np.array([float(shape("propeller_radius")), 0.03 * motor + 5e-4, 0])
    for rotor in airframe.value("rotors.position"):
        arm = np.array([float(shape("arm_radius")), 0, 0])
        hub = rotor + [0, 0, float(shape("propeller_height"))]
        parts += [
            Part("capsule", arm, np.zeros(3), "drone_carbon", end=rotor),
            Part("cylinder", np.array([motor, height / 2, 0]), rotor + [0, 0, 0.3 * height], "drone_metal"),
            Part("cylinder", disc, hub, "drone_propeller"),
        ]
    for material, z in zip(LED_MATERIALS, shape("led_heights"), strict=True):
        parts.append(Part("ellipsoid", np.array([led, led, led / 2]), np.array([0, 0, z]), material))
    sphere, box = shape("collision_sphere"), shape("collision_box")
    return [
        *parts,
        Part("sphere", np.array([sphere[3], 0, 0]), sphere[:3], name="col_sphere", touches=True),
        Part("box", box[3:], box[:3], name="col_box", touches=True),
    ]


def body_cameras(airframe: Airframe) -> list[BodyCamera]:
    """Return ``fpv_cam``, which looks ahead from the drone, and ``track_cam``, which follows and looks at it."""
    shape = partial(_outline, airframe)
    back = shape("track_camera")
    # Looking from behind with z up: right is body -y, up leans over by as much as the camera looks down.
    up = np.array([-back[2] * np.sign(back[0]), 0, abs(back[0])]) / np.hypot(back[0], back[2])
    right = np.array([0.0, -1.0, 0.0])
    return [
        BodyCamera("track_cam", back, np.concatenate([right, up]), tracks=True),
        BodyCamera("fpv_cam", shape("fpv_camera"), np.concatenate([right, [0, 0, 1]]), fovy=70.0),
    ]


def _outline(airframe: Airframe, key: str) -> NDArray[np.float64]:
    return airframe.value(f"shape.{key}")
