"""Overlays of the next image, and colours of drones' materials; depth images show no overlays."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from crazysim.arguments import check_arguments, check_flag
from crazysim.core.settings import as_rgba
from crazysim.drones.body import MAX_LED_DRONES
from crazysim.errors import UnknownNameError, require
from crazysim.scene.overlays import DEFAULT_COLOR
from crazysim.sim.sim import Sim
from crazysim.tables import read_floats


@check_arguments
def draw_line(
    sim: Sim, points: ArrayLike, rgba: ArrayLike | None = None, start_size: float = 3.0, end_size: float = 3.0
) -> None:
    """Draw a line through points in the next image.

    Args:
        points: World frame, m. (n, 3)
        rgba: Colour, 0 to 1, of all segments or of each; None for red. (4,) or (n - 1, 4)
        start_size: Width at the first point, pixels.
        end_size: Width at the last point, pixels.
    """
    sim.overlays.line(_check_points(points), DEFAULT_COLOR if rgba is None else rgba, start_size, end_size)


@check_arguments
def draw_points(sim: Sim, points: ArrayLike, rgba: ArrayLike | None = None, size: float = 0.01) -> None:
    """Draw points in the next image, as spheres.

    Args:
        points: World frame, m. (n, 3)
        rgba: Colour, 0 to 1; None for red. (4,)
        size: Radius, m.
    """
    sim.overlays.points(_check_points(points), DEFAULT_COLOR if rgba is None else rgba, size)


@check_arguments
def draw_capsule(
    sim: Sim,
    p1: ArrayLike,
    p2: ArrayLike,
    radius: float = 0.05,
    rgba: ArrayLike | None = None,
    cylinder: bool = False,
) -> None:
    """Draw a capsule, or a cylinder, between two points in the next image.

    Args:
        p1: One end, world frame, m. (3,)
        p2: The other end, world frame, m. (3,)
        radius: Radius, m.
        rgba: Colour, 0 to 1; None for red. (4,)
        cylinder: Whether the ends are flat.
    """
    start, end = np.asarray(p1, dtype=float), np.asarray(p2, dtype=float)
    require(
        start.shape == (3,) and end.shape == (3,),
        f"expected ends of shape (3,), got {start.shape} and {end.shape}",
        ValueError,
    )
    sim.overlays.capsule(start, end, radius, DEFAULT_COLOR if rgba is None else rgba, check_flag("cylinder", cylinder))


@check_arguments
def draw_label(sim: Sim, point: ArrayLike, text: str) -> None:
    """Write one line of text at a point in the next image, in front of everything.

    Args:
        point: Left end of the text, world frame, m. (3,)
        text: ASCII text of at most 99 characters.
    """
    pos = np.asarray(point, dtype=float)
    require(pos.shape == (3,), f"expected a point of shape (3,), got {pos.shape}", ValueError)
    sim.overlays.label(text, pos)


@check_arguments
def draw_text(sim: Sim, text: str, corner: str = "top left") -> None:
    """Write text into a corner of the next image, below earlier text.

    Args:
        text: ASCII text of one or several lines.
        corner: ``"top left"``, ``"top right"``, ``"bottom left"`` or ``"bottom right"``.
    """
    sim.overlays.text(text, corner)


@check_arguments
def draw_setpoints(sim: Sim, world: int = 0, rgba: ArrayLike | None = None, size: float = 0.02) -> None:
    """Draw the positions of the last state command of a world in the next image, as spheres.

    Args:
        sim: Simulation with command level ``state``.
        rgba: Colour, 0 to 1, of all drones or of each; None for red. (4,) or (n_drones, 4)
        size: Radius, m.
    """
    require(
        sim.data.controls.state is not None,
        f"expected control='state', whose commands have positions, got control={str(sim.control)!r}",
    )
    require(0 <= world < sim.n_worlds, f"expected a world from 0 to {sim.n_worlds - 1}, got {world}")
    sim.overlays.points(
        np.asarray(sim.data.controls.state.staged_cmd[world, :, :3], float),
        DEFAULT_COLOR if rgba is None else rgba,
        size,
    )


@check_arguments
def change_material(
    sim: Sim,
    mat_name: str,
    drone_ids: ArrayLike,
    rgba: ArrayLike | None = None,
    emission: ArrayLike | None = None,
) -> None:
    """Change the colour or emission of the material ``led_top`` or ``led_bot`` of some drones.

    Args:
        mat_name: Name of the material without the index of the drone.
        drone_ids: Indices of the drones. (n,)
        rgba: Colour, 0 to 1, of all these drones or of each; None for no change. (4,) or (n, 4)
        emission: Emission, 0 to 1, of all these drones or of each; None for no change. () or (n,)
    """
    ids = np.asarray(drone_ids)
    if ids.ndim != 1 or not np.issubdtype(ids.dtype, np.integer):
        raise ValueError(f"drone_ids must be 1D arrays or lists of integers, got {drone_ids!r}")
    if ids.size and not (ids.min() >= 0 and ids.max() < sim.n_drones):
        raise ValueError(f"drone_ids must be in range [0, {sim.n_drones - 1}], got {ids.tolist()}")
    materials = [mujoco.mj_name2id(sim.mj_model, mujoco.mjtObj.mjOBJ_MATERIAL, f"{mat_name}:{drone}") for drone in ids]
    if any(material < 0 for material in materials):
        raise UnknownNameError(
            f"expected material 'led_top' or 'led_bot' of the first {MAX_LED_DRONES} drones, whose LEDs have their own "
            f"colours, got {mat_name!r} of drones up to {ids.max()}"
        )
    if rgba is not None:
        sim.mj_model.mat_rgba[materials] = np.broadcast_to(as_rgba(rgba, len(ids)), (len(ids), 4))
    if emission is not None:
        sim.mj_model.mat_emission[materials] = np.broadcast_to(np.asarray(emission, float), (len(ids),))


def _check_points(points: ArrayLike) -> np.ndarray:
    array = np.atleast_2d(read_floats("points", points))
    require(array.ndim == 2 and array.shape[1] == 3, f"expected points of shape (n, 3), got {array.shape}", ValueError)
    return array
