"""Pictures of a live simulation, and the quantities that viewers plot."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim.core.data import SimData
from crazysim.engine.pytree import has_members, scopes
from crazysim.engine.stage import vmap_drones, vmap_worlds
from crazysim.lab.live.loop import Live
from crazysim.lab.live.scene_bodies import MARK_RADIUS, SceneBodies
from crazysim.media.picture import Focus, Picture, Spheres, light_spheres, setpoint_spheres
from crazysim.media.trail import choose_drone_colors
from crazysim.plugins.effects.wind import Wind
from crazysim.plugins.effects.wind_field import WindField
from crazysim.scene.visual_geoms import VisualGeom, visual_geoms
from crazysim.sim.sim import Sim

WIND_SCALE = 0.1
"""Length of a wind arrow divided by the wind speed, s."""
TRAIL_PERIOD = 0.05
"""Time between two samples of a trail, s."""
PLOT_PERIOD = 0.02
"""Shortest simulated time between two samples of a plot, s."""
CONTACT_COLOR, FOLLOWED_COLOR = (0.9, 0.15, 0.1, 0.4), (0.25, 0.6, 1.0, 0.25)
"""Colours of marks, rgba."""


class PictureSource:
    """Source of the pictures of one viewer."""

    shapes: list[VisualGeom]
    """Visible geoms of the scene."""
    bodies: SceneBodies
    """Bodies that can be picked and followed."""

    def __init__(
        self,
        sim: Sim,
        worlds: Sequence[int],
        contacts: bool = False,
        wind: bool = True,
        trail: float = 0.0,
        setpoints: bool = True,
    ):
        self._sim, self._worlds = sim, np.asarray(worlds)
        sim.scene.compile_if_edited()
        sim.scene.sync_one(sim.plugins.with_moved_objects(sim.data), worlds[0])
        self.shapes = visual_geoms(sim.mj_model, sim.mj_data)
        self.bodies = SceneBodies(sim, self.shapes)
        self._contacts, self._wind, self._setpoints = contacts, wind, setpoints
        self._wind_fn = jax.jit(vmap_worlds(vmap_drones(_air_velocity)))
        self._colors = choose_drone_colors(sim.n_drones, None)
        self._trail: deque[NDArray] = deque(maxlen=round(trail / TRAIL_PERIOD + 0.5) if trail > 0 else 0)
        self._trail_time = np.inf

    def take_picture(self, live: Live, plot: str = "") -> Picture:
        """Return a picture of the simulation as it is now.

        Args:
            plot: Quantity to plot, one of ``live.quantities`` or of the paths of ``list_quantities``; empty for none.
        """
        sim, worlds = self._sim, self._worlds
        data = sim.data
        pos, quat = sim.scene.host_poses(sim.plugins.with_moved_objects(sim.data), worlds)
        drone_pos = np.asarray(data.states.pos, float)[worlds]
        lights, focus = np.clip(live.lights[worlds], 0.0, 1.0), self._find_focus(live, pos)
        # Marks: lights, setpoints, contacts, the followed body.
        spheres = {"lights": light_spheres(drone_pos, lights)}
        state, goals = data.controls.state, live.goals
        if self._setpoints and (goals is not None or state is not None):
            setpoint = goals[worlds] if goals is not None else np.asarray(state.staged_cmd, float)[worlds, :, :3]
            spheres["setpoints"] = setpoint_spheres(setpoint, self._colors)
        if self._contacts:
            has_contact = np.asarray(sim.contact_report().any)[worlds]
            spheres["contacts"] = _marks(drone_pos, has_contact, CONTACT_COLOR, MARK_RADIUS)
        is_followed = np.arange(len(worlds))[:, None] == (-1 if focus is None else focus.shown_index)
        mark_pos, radius = (np.zeros(3), MARK_RADIUS) if focus is None else (focus.pos, focus.radius)
        spheres["followed"] = _marks(np.tile(mark_pos, (len(worlds), 1, 1)), is_followed, FOLLOWED_COLOR, radius)
        # Wind, and the values that are plotted.
        arrows = np.zeros((len(worlds), 0, 2, 3))
        if self._wind and _find_winds(data):
            wind = np.asarray(self._wind_fn(data), float)[worlds]
            arrows = np.stack([drone_pos, drone_pos + WIND_SCALE * wind], axis=2)
        values = np.zeros(0)
        if plot and live.selected is not None:
            quantity_fn = live.quantities.get(plot)
            values = read_quantity(data, plot, *live.selected) if quantity_fn is None else quantity_fn(live)
        return Picture(
            worlds=worlds,
            time=live.time,
            pos=pos,
            quat=quat,
            spheres=spheres,
            lights=lights,
            wind=arrows,
            trail=self._extend_trail(live.time, pos),
            focus=focus,
            status=live.status,
            selected=live.selected,
            widget_lines=live.widget_lines,
            plot=np.ravel(np.asarray(values, float)),
        )

    def _find_focus(self, live: Live, pos: NDArray) -> Focus | None:
        if live.followed is None:
            return None
        world, kind, index = live.followed
        body = next((body for body in self.bodies.items if (body.kind, body.index) == (kind, index)), None)
        if body is None or world not in self._worlds:
            return None
        k = self._worlds.tolist().index(world)
        return Focus(k, pos[k, body.mocap], self.bodies.mark_radius(body.mocap), body.name)

    def _extend_trail(self, time: float, pos: NDArray) -> NDArray:
        pos, path = pos[:, self.bodies.trail_mocap_ids], self._trail
        if not path.maxlen:
            return pos[None]
        if time < self._trail_time:  # the first picture, or a jump back in time
            path.extend([pos] * path.maxlen)
            self._trail_time = time
        elif time >= self._trail_time + TRAIL_PERIOD:
            path.append(pos)
            self._trail_time = time
        return np.stack([*path, pos])


class PlotSamples:
    """Samples of a plotted quantity, which begin again for another drone or quantity and after a jump back in time."""

    def __init__(self, length: int):
        self._samples: deque[tuple[float, NDArray]] = deque(maxlen=length)
        self._key: tuple[object, ...] = ()

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, picture: Picture, quantity: str, n_lines: int) -> bool:
        """Add the first ``n_lines`` values of a picture, if a sample is due; return whether the samples begin again."""
        samples, key = self._samples, (quantity, picture.selected, len(picture.plot))
        begins_again = key != self._key or bool(samples and picture.time < samples[-1][0])
        if begins_again:
            self._key = key
            samples.clear()
        if len(picture.plot) and (not samples or picture.time - samples[-1][0] >= PLOT_PERIOD):
            samples.append((picture.time, picture.plot[:n_lines]))
        return begins_again

    def arrays(self) -> tuple[NDArray, NDArray]:
        """Return the times, s, (n,), and the values of each line; zero where they are not finite, (k, n)."""
        values = np.stack([values for _, values in self._samples], axis=-1)
        return np.array([time for time, _ in self._samples]), np.where(np.isfinite(values), values, 0.0)


def _marks(pos: NDArray, is_shown: NDArray, rgba: Sequence[float], radius: float) -> Spheres:
    return Spheres(pos, is_shown, np.broadcast_to(np.array(rgba), (*is_shown.shape, 4)), radius)


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
        path: One of ``list_quantities``.
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
