"""Depth cameras: a ray for each pixel, for all worlds in one call."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.scene.collision import CollisionModel
from crazysim.scene.rays import Hits, cast

RAYS_AT_ONCE = 1 << 22
"""Rays whose numbers are held at once; more worlds go one piece after the other."""

Along = Literal["axis", "ray"]


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera of the scene, by what it hangs on."""

    on: Literal["world", "drone", "object"]
    """What it hangs on."""
    place: int
    """Which drone, or which of ``data.objects``."""
    pos: tuple[float, ...]
    """Where it is on that, m."""
    rot: tuple[tuple[float, ...], ...]
    """Its axes there, as columns: right, up, back."""
    turns: bool
    """Whether it turns with what it hangs on."""
    fovy: float
    """What it sees from top to bottom, degrees."""


def find_cameras(model: mujoco.MjModel, name: str | int, movable: Sequence[str]) -> list[Camera]:
    """Return the camera of a name or id, or, for a name without number such as ``fpv_cam``, every drone's.

    Raises:
        UnknownNameError: If there is none.
        ConfigError: If it hangs on a body that only ``mjx_data`` knows the place of, or aims at another body.
    """
    known = [model.camera(i).name for i in range(model.ncam)]
    if isinstance(name, (int, np.integer)) and 0 <= name < model.ncam:
        ids = [int(name)]
    elif name in known:
        ids = [known.index(name)]  # type: ignore[arg-type]
    else:
        ids = [i for i, camera in enumerate(known) if isinstance(name, str) and camera.rpartition(":")[0] == name]
    if not ids:
        shown = ", ".join(dict.fromkeys(camera.rpartition(":")[0] or camera for camera in known))
        raise UnknownNameError(f"the scene has no camera {name!r}; it has {shown or 'none'}")
    return [_camera(model, i, movable) for i in ids]


def _camera(model: mujoco.MjModel, i: int, movable: Sequence[str]) -> Camera:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    fixed, track = int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED), int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK)
    mode, body = int(model.cam_mode[i]), int(model.cam_bodyid[i])
    root = int(model.body_rootid[body])
    name = model.body(root).name
    if mode not in (fixed, track):
        raise ConfigError(f"camera {model.camera(i).name!r} aims at a body; depth is there for fixed and track cameras")
    place, rot = data.cam_xpos[i], data.cam_xmat[i].reshape(3, 3)
    on, number = "world", 0
    if name.startswith("drone:") or name in movable:
        on = "drone" if name.startswith("drone:") else "object"
        number = int(name.split(":")[1]) if on == "drone" else list(movable).index(name)
        place = place - data.xpos[root]
        if mode == fixed:
            turned = data.xmat[root].reshape(3, 3).T
            place, rot = turned @ place, turned @ rot
    elif model.body_mocapid[root] >= 0:
        raise ConfigError(
            f"camera {model.camera(i).name!r} hangs on {name!r}, which is moved by hand through sim.mjx_data; add the "
            f"body with sim.scene.add"
        )
    rows = tuple(tuple(map(float, row)) for row in rot)
    return Camera(on, number, tuple(map(float, place)), rows, mode == fixed, float(model.cam_fovy[i]))  # type: ignore[arg-type]


def pixel_directions(fovy: float, width: int, height: int) -> np.ndarray:
    """Return where each pixel's middle looks, camera frame (x right, y up, z back), unit. (height, width, 3)

    Args:
        fovy: Field of view from top to bottom, degrees.
        width: Pixels.
        height: Pixels.
    """
    half = np.tan(np.deg2rad(fovy) / 2)
    y = half * (1 - (2 * np.arange(height) + 1) / height)
    x = half * width / height * ((2 * np.arange(width) + 1) / width - 1)
    d = np.stack(np.broadcast_arrays(x[None, :], y[:, None], -1.0), axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def build(
    solids: CollisionModel,
    cameras: Sequence[Camera],
    width: int,
    height: int,
    drones: bool,
    hide_own: bool,
    along: Along,
) -> Callable[[SimData], Hits]:
    """Return ``depth(data) -> Hits`` of pictures (n_worlds, n_cameras, height, width); see ``Scene.depth_fn``."""
    if along not in ("axis", "ray"):
        raise ConfigError(f"depth is measured along='axis' of the camera or along='ray', not {along!r}")
    for name, n in (("width", width), ("height", height)):
        if type(n) is not int or n < 1:
            raise ConfigError(f"a picture of {width} x {height} pixels cannot be; {name} must be a positive int")
    looks = np.stack([pixel_directions(c.fovy, width, height).reshape(-1, 3) for c in cameras])
    own = np.repeat([c.place if c.on == "drone" and hide_own else -1 for c in cameras], width * height)
    rays = len(cameras) * width * height

    def of_worlds(data: SimData) -> Hits:
        poses = [_pose(camera, data) for camera in cameras]
        eye = jnp.stack([pos for pos, _ in poses], axis=1)  # (n_worlds, n_cameras, 3)
        axes = jnp.stack([rot for _, rot in poses], axis=1)
        pixels = jnp.asarray(looks, eye.dtype)
        direction = sum(axes[:, :, None, :, k] * pixels[..., None, k] for k in range(3))
        origin = jnp.broadcast_to(eye[:, :, None], direction.shape)
        flat = (direction.shape[0], rays, 3)
        hits = cast(solids, data, origin.reshape(flat), direction.reshape(flat), own, drones)
        ahead = jnp.asarray(-looks[..., 2].reshape(-1), eye.dtype) if along == "axis" else 1.0
        hits = hits.replace(distance=hits.distance * ahead)
        shape = (flat[0], len(cameras), height, width)
        return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[2:]), hits)

    def depth(data: SimData) -> Hits:
        n = data.core.n_worlds
        piece = max(1, RAYS_AT_ONCE // rays)
        if n <= piece:
            return of_worlds(data)
        needed = (
            data.states.pos,
            data.states.quat,
            None if data.objects is None else data.objects.replace(mocap_ids=None),
        )

        def of_one(some: Any) -> Hits:
            pos, quat, objects = jax.tree.map(lambda x: x[None], some)
            states = data.states.replace(pos=pos, quat=quat)
            return jax.tree.map(lambda x: x[0], of_worlds(data.replace(states=states, objects=objects)))

        return jax.lax.map(of_one, needed, batch_size=piece)

    return depth


def _pose(camera: Camera, data: SimData) -> tuple[Array, Array]:
    """Return where a camera is in every world, m (n_worlds, 3), and its axes as columns (n_worlds, 3, 3)."""
    states, n = data.states, data.states.pos.shape[0]
    pos, rot = (jnp.asarray(x, states.pos.dtype) for x in (camera.pos, camera.rot))
    if camera.on == "world":
        return jnp.broadcast_to(pos, (n, 3)), jnp.broadcast_to(rot, (n, 3, 3))
    held = (states.pos, states.quat) if camera.on == "drone" else (data.objects.pos[:, 0], data.objects.quat[:, 0])
    at, quat = (x[:, camera.place] for x in held)
    if not camera.turns:
        return at + pos, jnp.broadcast_to(rot, (n, 3, 3))
    # Written out: a matrix product may be rounded to 10 bits on a GPU.
    return at + rotation.rotate(quat, pos), jnp.stack([rotation.rotate(quat, rot[:, k]) for k in range(3)], axis=-1)
