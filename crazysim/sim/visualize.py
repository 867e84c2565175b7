"""Draw into the next picture, where depth does not see it, and change the colours of drones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from crazysim.errors import ConfigError, UnknownNameError
from crazysim.scene.overlays import RED

if TYPE_CHECKING:
    from crazysim.sim.sim import Sim


def draw_line(
    sim: Sim, points: ArrayLike, rgba: ArrayLike | None = None, start_size: float = 3.0, end_size: float = 3.0
) -> None:
    """Draw a line through points into the next picture.

    Args:
        sim: The simulation.
        points: World frame, m. (n, 3)
        rgba: Colour, 0 to 1, one or one per piece between two points; red if left out. (4,) or (n - 1, 4)
        start_size: Width at the first point, pixels.
        end_size: Width at the last point, pixels.

    Raises:
        ValueError: If the points have another shape.
    """
    sim.overlays.line(_points(points), RED if rgba is None else rgba, start_size, end_size)


def draw_points(sim: Sim, points: ArrayLike, rgba: ArrayLike | None = None, size: float = 0.01) -> None:
    """Draw points into the next picture, as spheres.

    Args:
        sim: The simulation.
        points: World frame, m. (n, 3)
        rgba: Colour, 0 to 1; red if left out. (4,)
        size: Radius, m.

    Raises:
        ValueError: If the points have another shape.
    """
    sim.overlays.points(_points(points), RED if rgba is None else rgba, size)


def draw_capsule(
    sim: Sim,
    p1: ArrayLike,
    p2: ArrayLike,
    radius: float = 0.05,
    rgba: ArrayLike | None = None,
    cylinder: bool = False,
) -> None:
    """Draw a capsule, or a cylinder, between two points into the next picture.

    Args:
        sim: The simulation.
        p1: One end, world frame, m. (3,)
        p2: The other end, world frame, m. (3,)
        radius: Radius, m.
        rgba: Colour, 0 to 1; red if left out. (4,)
        cylinder: Whether its ends are flat.

    Raises:
        ValueError: If an end has another shape.
    """
    first, last = np.asarray(p1, dtype=float), np.asarray(p2, dtype=float)
    if first.shape != (3,) or last.shape != (3,):
        raise ValueError(f"the ends of a capsule must have shape (3,), got {first.shape} and {last.shape}")
    sim.overlays.capsule(first, last, radius, RED if rgba is None else rgba, cylinder)


def draw_label(sim: Sim, point: ArrayLike, text: str) -> None:
    """Write one line of text at a point into the next picture, in front of everything.

    Args:
        sim: The simulation.
        point: Where its left end is, world frame, m. (3,)
        text: ASCII, 99 letters at most.

    Raises:
        ValueError: If the point has another shape, or the text cannot be written.
    """
    at = np.asarray(point, dtype=float)
    if at.shape != (3,):
        raise ValueError(f"the point of a label must have shape (3,), got {at.shape}")
    sim.overlays.label(text, at)


def draw_text(sim: Sim, text: str, corner: str = "top left") -> None:
    """Write text into a corner of the next picture, below what was written there before.

    Args:
        sim: The simulation.
        text: ASCII; may have several lines.
        corner: ``"top left"``, ``"top right"``, ``"bottom left"`` or ``"bottom right"``.

    Raises:
        ValueError: If there is no such corner, or the text cannot be written.
    """
    sim.overlays.text(text, corner)


def draw_setpoints(sim: Sim, world: int = 0, rgba: ArrayLike | None = None, size: float = 0.02) -> None:
    """Draw where the last state command wants each drone of a world, as a sphere, into the next picture.

    Args:
        sim: The simulation; its command level is ``state``.
        world: Which world.
        rgba: Colour, 0 to 1, one or one per drone; red if left out. (4,) or (n_drones, 4)
        size: Radius, m.

    Raises:
        ValueError: If the simulation has another command level, or no such world.
    """
    if sim.data.controls.state is None:
        raise ConfigError(
            f"setpoints are the positions of state commands; this simulation has control={str(sim.control)!r}"
        )
    if not 0 <= world < sim.n_worlds:
        raise ConfigError(f"world {world} does not exist; worlds go from 0 to {sim.n_worlds - 1}")
    wanted = np.asarray(sim.data.controls.state.staged_cmd[world, :, :3], float)
    sim.overlays.points(wanted, RED if rgba is None else rgba, size)


def change_material(
    sim: Sim,
    mat_name: str,
    drone_ids: ArrayLike,
    rgba: ArrayLike | None = None,
    emission: ArrayLike | None = None,
) -> None:
    """Change the colour or glow of a material that every drone has for itself: ``led_top`` or ``led_bot``.

    Args:
        sim: The simulation.
        mat_name: Name of the material without the drone's number.
        drone_ids: Which drones. (n,)
        rgba: Colour, 0 to 1, one or one per drone. (4,) or (n, 4)
        emission: Glow, 0 to 1, one or one per drone. () or (n,)

    Raises:
        ValueError: If a drone or a material of that name does not exist, or a shape does not fit.
    """
    ids = np.asarray(drone_ids)
    if ids.ndim != 1 or not np.issubdtype(ids.dtype, np.integer):
        raise ValueError(f"drone_ids must be 1D arrays or lists of integers, got {drone_ids!r}")
    if ids.size and not (ids.min() >= 0 and ids.max() < sim.n_drones):
        raise ValueError(f"drone_ids must be in range [0, {sim.n_drones - 1}], got {ids.tolist()}")
    materials = [mujoco.mj_name2id(sim.mj_model, mujoco.mjtObj.mjOBJ_MATERIAL, f"{mat_name}:{drone}") for drone in ids]
    if any(material < 0 for material in materials):
        raise UnknownNameError(f"drones have no material {mat_name!r} of their own; they have led_top and led_bot")
    if rgba is not None:
        sim.mj_model.mat_rgba[materials] = np.broadcast_to(np.asarray(rgba, float), (len(ids), 4))
    if emission is not None:
        sim.mj_model.mat_emission[materials] = np.broadcast_to(np.asarray(emission, float), (len(ids),))


def _points(points: ArrayLike) -> np.ndarray:
    array = np.atleast_2d(np.asarray(points, dtype=float))
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points must have shape (n, 3), got {array.shape}")
    return array
