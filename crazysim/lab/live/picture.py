"""Pictures of a live simulation: everything that a viewer draws at one moment, as NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim.core.data import SimData
from crazysim.engine.pytree import has_members, scopes
from crazysim.engine.stage import vmap_drones, vmap_worlds
from crazysim.lab.live.loop import Live
from crazysim.lab.live.scene_bodies import SceneBodies
from crazysim.plugins.effects.wind import Wind
from crazysim.plugins.effects.wind_field import WindField
from crazysim.sim.sim import Sim

LIGHT_RADIUS = 0.06
"""Radius of the glow around a lit drone, m."""
WIND_SCALE = 0.1
"""Length of a wind arrow divided by the wind speed, s."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Everything that a viewer draws of the worlds that it shows, at one moment."""

    worlds: NDArray
    """Indices of the worlds that are shown. (n,)"""
    time: float
    """Simulated time since the last reset, s."""
    status: str
    """Time, speed, pause and recording as text."""
    pos: NDArray
    """Positions of all mocap bodies, world frame, m. (n, n_mocap, 3)"""
    quat: NDArray
    """Attitudes of all mocap bodies, body to world, xyzw. (n, n_mocap, 4)"""
    drone_pos: NDArray
    """Positions of the drones, world frame, m. (n, n_drones, 3)"""
    setpoint: NDArray
    """Goals of the loop, or else the positions in the state commands, world frame, m; empty if there is neither.
    (n, n_drones or 0, 3)"""
    has_contact: NDArray
    """True where a drone touches something. (n, n_drones)"""
    wind: NDArray
    """Velocity of the air at every drone, world frame, m/s; empty without wind. (n, n_drones or 0, 3)"""
    lights: NDArray
    """Colours of the drones' LEDs, 0 to 1; zero for off. (n, n_drones, 3)"""
    selected: tuple[int, int] | None
    """World and index of the selected drone; None if no drone is selected."""
    followed: tuple[int, int] | None
    """World and mocap id of the body that the camera follows; None if the camera follows no body."""
    followed_name: str
    """Name of the followed body; empty if there is none."""
    widget_lines: tuple[str, ...]
    """Lines of text that list the buttons and sliders of the loop, for viewers without a panel."""
    plot: NDArray
    """Values of the plotted quantity; empty if nothing is plotted. (k,)"""


class PictureSource:
    """Source of the pictures of one viewer."""

    def __init__(self, sim: Sim, bodies: SceneBodies, worlds: Sequence[int], contacts: bool, wind: bool):
        self._sim, self._worlds = sim, np.asarray(worlds)
        self._bodies = {(body.kind, body.index): body for body in bodies.items}
        self._contacts, self._wind = contacts, wind
        self._wind_fn = jax.jit(vmap_worlds(vmap_drones(_air_velocity)))

    def take_picture(self, live: Live, plot: str = "") -> Picture:
        """Return a picture of the simulation as it is now.

        Args:
            live: Loop of the simulation.
            plot: Quantity to plot, one of ``live.quantities`` or of the paths of ``list_quantities``; empty for none.
        """
        sim, worlds = self._sim, self._worlds
        data = sim.data
        pos, quat = sim.scene.host_poses(sim.plugins.with_moved_objects(sim.data), worlds)
        drone_pos = np.asarray(data.states.pos, float)[worlds]
        empty = np.zeros((len(worlds), 0, 3))
        state, setpoint, wind = data.controls.state, empty, empty
        if live.goals is not None:
            setpoint = live.goals[worlds]
        elif state is not None:
            setpoint = np.asarray(state.staged_cmd, float)[worlds, :, :3]
        if self._wind and _find_winds(data):
            wind = np.asarray(self._wind_fn(data), float)[worlds]
        has_contact = (
            np.asarray(sim.contact_report().any)[worlds] if self._contacts else np.zeros(drone_pos.shape[:2], bool)
        )
        plot_values = np.zeros(0)
        if plot and live.selected is not None:
            quantity_fn = live.quantities.get(plot)
            plot_values = (
                read_quantity(data, plot, *live.selected)
                if quantity_fn is None
                else np.ravel(np.asarray(quantity_fn(live), float))
            )
        followed = live.followed
        body = None if followed is None else self._bodies.get(followed[1:])
        return Picture(
            worlds=worlds,
            time=live.time,
            status=live.status,
            pos=pos,
            quat=quat,
            drone_pos=drone_pos,
            setpoint=setpoint,
            has_contact=has_contact,
            wind=wind,
            lights=np.clip(live.lights[worlds], 0.0, 1.0),
            selected=live.selected,
            followed=None if body is None or followed is None else (followed[0], body.mocap),
            followed_name="" if body is None else body.name,
            widget_lines=live.widget_lines,
            plot=plot_values,
        )


def _find_winds(data: SimData) -> list[Wind | WindField]:
    return [record for record in data.plugins.values() if isinstance(record, (Wind, WindField))]


def _air_velocity(data: SimData) -> jax.Array:
    return sum((record.velocity_at(data.states.pos) for record in _find_winds(data)), jnp.zeros_like(data.states.pos))


def list_quantities(sim: Sim) -> list[str]:
    """Return the paths of all quantities that can be plotted.

    These are leaves with the scope drone or world, such as ``states.vel``, and leaves of each member of another
    population, such as ``plugins.cars.pos[1]``.
    """
    names = []
    for path, scope, x in _numeric_leaves(sim.data):
        if scope in ("drone", "world"):
            names.append(path)
        elif has_members(scope) and scope not in ("shared", "opaque", "batch"):
            names += [f"{path}[{k}]" for k in range(x.shape[1])]
    return names


def read_quantity(data: SimData, path: str, world: int, drone: int) -> NDArray:
    """Return the current values of a quantity in one world. (k,)

    Args:
        data: Data of a simulation.
        path: One of ``list_quantities``.
        world: Index of the world.
        drone: Index of the drone; used only for quantities of drones.
    """
    wanted_path, _, member = path.rstrip("]").partition("[")
    for leaf_path, scope, x in _numeric_leaves(data):
        if leaf_path == wanted_path:
            index = (world,) if scope == "world" else (world, int(member) if member else drone)
            return np.asarray(x)[index].ravel().astype(float)
    raise KeyError(path)


def _numeric_leaves(data: SimData) -> list[tuple[str, str, jax.Array]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(data)
    leaf_scopes = zip(leaves, jax.tree.leaves(scopes(data)), strict=True)
    return [
        (_format_path(path), scope, x) for (path, x), scope in leaf_scopes if getattr(x.dtype, "kind", "O") in "fiub"
    ]


def _format_path(path: jax.tree_util.KeyPath) -> str:
    return ".".join(str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path)
