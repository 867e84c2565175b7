"""Depth cameras: one ray per pixel, for all worlds in one call."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.arguments import check_flag, require_memory
from crazysim.core.data import SimData, require_states
from crazysim.errors import ConfigError, UnknownNameError, require
from crazysim.scene.appearance import Appearance
from crazysim.scene.collision import CollisionModel, body_name
from crazysim.scene.first_hit import IGNORES_NONE
from crazysim.scene.mocap import MocapPoses, require_poses, with_mocap_bodies
from crazysim.scene.object_poses import ListPlugins, moving_plugins, with_moved_objects
from crazysim.scene.ray_casting import Hits, RayKernels, cast_rays, cast_rays_in_worlds, raise_to_floor
from crazysim.scene.sync import update_poses

MAX_RAYS = 1 << 22
"""Largest number of rays that XLA casts at a time; larger batches of worlds are split."""

MAX_RAYS_OF_KERNEL = 1 << 28
"""Largest number of rays in a kernel, in which indices of rays and of table entries are int32."""

TILE_SIDE = 4
"""Height and width of tiles, pixels. Rays are ordered tile by tile, so that neighbouring lanes of a kernel meet similar
geoms."""

HIDDEN_TOLERANCE = 1e-3
"""Part of the distance by which a surface must be nearer to hide another: more than rounding, less than objects."""

Along = Literal["axis", "ray"]
"""Direction of distances: along the axis of the camera, or along the ray."""

BYTES_PER_RAY = 16
"""Lower bound of the memory of a ray, bytes: distance and index of the geom, once per ray and once in the image, four
bytes each."""


@dataclasses.dataclass(frozen=True, eq=False)
class DroneCamera:
    """A camera that every drone carries: directions of its pixels, and mounting on each drone."""

    rays: np.ndarray
    """Unit directions of the pixels, frame of the camera (x ahead, y left, z up). (height, width, 3)"""
    pos: np.ndarray
    """Position on each drone, body frame, m. (n_drones, 3)"""
    rpy: np.ndarray
    """Roll, pitch and yaw of the frame of the camera in the body frame, rad. (3,)"""
    baseline: float = 0.0
    """Distance to the second imager of a stereo camera, on the right, m; 0 without one."""

    @property
    def rot(self) -> np.ndarray:
        """Rotation matrix from the frame of the camera to the body frame. (3, 3)"""
        quat, rot = np.zeros(4), np.zeros(9)
        mujoco.mju_euler2Quat(quat, np.array(self.rpy, np.float64), "XYZ")  # about fixed axes
        mujoco.mju_quat2Mat(rot, quat)
        return rot.reshape(3, 3)


@dataclasses.dataclass(frozen=True)
class CarriedCamera:
    """A camera and its pose in the frame of the body that carries it."""

    carrier: Literal["world", "drone", "object"]
    """Kind of the carrying body."""
    body: str
    """Name of the carrying body."""
    row: int
    """Index of the drone, or row of the object in ``data.objects``."""
    pos: tuple[float, ...]
    """Position relative to the body, m, in its frame; in the world's axes if ``follows_rotation`` is False. (3,)"""
    rot: tuple[tuple[float, ...], ...]
    """Rotation matrix with the columns right, up and back of the camera, in the axes of ``pos``. (3, 3)"""
    follows_rotation: bool
    """True if the camera turns with the body; False if it only follows the body's position."""
    fovy: float
    """Vertical field of view, degrees; 0 for a ``DroneCamera``, which has its own directions."""

    @classmethod
    def on_drone(cls, camera: DroneCamera, drone: int) -> CarriedCamera:
        forward, left, up = camera.rot.T
        rot_rows = tuple(tuple(map(float, row)) for row in np.stack([-left, up, -forward], axis=-1))
        return cls("drone", f"drone:{drone}", drone, tuple(map(float, camera.pos[drone])), rot_rows, True, 0.0)


def find_cameras(model: mujoco.MjModel, name: str | int, objects: Sequence[str]) -> list[CarriedCamera]:
    """Return the camera with a name or id, or the cameras of all drones for a name without index, such as ``fpv_cam``.

    Args:
        name: Name or id.
        objects: Names of bodies with poses in ``data.objects``, then of bodies that are moved through ``mjx_data``.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    if isinstance(name, (int, np.integer)) and 0 <= name < model.ncam:
        ids = [int(name)]
    elif name in names:
        ids = [names.index(name)]  # type: ignore[arg-type]
    else:
        ids = [i for i, camera in enumerate(names) if isinstance(name, str) and camera.rpartition(":")[0] == name]
    if not ids:
        listed = ", ".join(dict.fromkeys(camera.rpartition(":")[0] or camera for camera in names))
        raise UnknownNameError(f"expected a camera of the scene, {listed or 'which has none'}, got {name!r}")
    return [_read_camera(model, i, objects) for i in ids]


def _read_camera(model: mujoco.MjModel, i: int, objects: Sequence[str]) -> CarriedCamera:
    data = mujoco.MjData(model)
    update_poses(model, data)
    fixed, track = int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED), int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK)
    mode, root = int(model.cam_mode[i]), int(model.body_rootid[model.cam_bodyid[i]])
    name = body_name(model, root)
    if mode not in (fixed, track):
        raise ConfigError(
            f"expected a camera of mode 'fixed' or 'track', got {model.camera(i).name!r}, which aims at a body"
        )
    pos, rot = data.cam_xpos[i], data.cam_xmat[i].reshape(3, 3)
    carrier, row = "world", 0
    if name.startswith("drone:") or name in objects:
        carrier = "drone" if name.startswith("drone:") else "object"
        row = int(name.split(":")[1]) if carrier == "drone" else list(objects).index(name)
        pos = pos - data.xpos[root]
        if mode == fixed:
            to_body = data.xmat[root].reshape(3, 3).T
            pos, rot = to_body @ pos, to_body @ rot
    rot_rows = tuple(tuple(map(float, line)) for line in rot)
    return CarriedCamera(carrier, name, row, tuple(map(float, pos)), rot_rows, mode == fixed, float(model.cam_fovy[i]))  # type: ignore[arg-type]


def pixel_directions(fovy: float, width: int, height: int) -> np.ndarray:
    """Return unit directions of the pixel centres, camera frame (x right, y up, z back). (height, width, 3)

    Args:
        fovy: Vertical field of view, degrees.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
    """
    half_height = np.tan(np.deg2rad(fovy) / 2)
    y = half_height * (1 - (2 * np.arange(height) + 1) / height)
    x = half_height * width / height * ((2 * np.arange(width) + 1) / width - 1)
    d = np.stack(np.broadcast_arrays(x[None, :], y[:, None], -1.0), axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def check_image_memory(
    n_images: int, width: int, height: int, bytes_per_pixel: float, device: jax.Device, n_devices: int = 1
) -> None:
    """Check that images fit into the memory of their devices, before anything is allocated.

    Args:
        n_images: Number of images in all worlds together.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        bytes_per_pixel: Lower bound of the memory of a pixel, bytes.
        device: Device of the images, or one of several.
        n_devices: Number of devices among which the images are divided.
    """
    what = f"{n_images} images of {width} x {height} pixels"
    require_memory(what, n_images * width * height * bytes_per_pixel, "Use fewer worlds or pixels.", device, n_devices)


DepthFn = Callable[..., Hits]
"""``depth(data, mocap=None) -> Hits``."""


def build_depth_fn(
    model: CollisionModel,
    cameras: Sequence[CarriedCamera],
    rays: Sequence[np.ndarray],
    drones: bool,
    hide_own: bool,
    along: Along,
    plugins: ListPlugins,
    kernels: RayKernels,
    baseline: float = 0.0,
    appearance: Appearance | None = None,
) -> DepthFn:
    """Return ``depth(data, mocap=None) -> Hits``; see ``Scene.depth_fn``.

    The images have shape (n_worlds, n_cameras, height, width), or without n_worlds in a function of one world.

    Args:
        model: Geoms of the scene that cameras see.
        rays: Unit directions of the pixels of each camera, as from ``pixel_directions``. (height, width, 3) each
        drones: Whether drones are visible.
        hide_own: Whether a drone is invisible to its own camera.
        along: Direction of distances; see ``Along``.
        plugins: Function that returns the plugins of the simulation.
        kernels: Kernels that cast the rays if possible.
        baseline: Distance to the second imager of each camera, on the right, m; 0 without one.
        appearance: The scene's materials and lights, for ``Hits.color``; None for no colours.
    """
    require(
        isinstance(along, str) and along in ("axis", "ray"),
        f"expected along='axis' of the camera or along='ray', got {along!r}",
    )
    drones, hide_own = check_flag("drones", drones), check_flag("hide_own", hide_own)
    # Pixels in square tiles: neighbouring rays meet the same geoms.
    height, width = rays[0].shape[:2]
    tile_height, tile_width = (math.gcd(n, TILE_SIDE) for n in (height, width))
    tile_shape = height // tile_height, tile_height, width // tile_width, tile_width
    tile_order = np.arange(height * width).reshape(tile_shape).swapaxes(1, 2).reshape(-1)
    # Unit direction of each pixel, tile by tile, and index of the drone that its ray passes through.
    directions = np.zeros((len(cameras), height * width, 4))
    for camera, pixels, pixel_rows in zip(cameras, rays, directions, strict=True):
        pixel_rows[:, :3] = pixels.reshape(-1, 3)[tile_order]
        pixel_rows[:, 3] = camera.row if camera.carrier == "drone" and hide_own else IGNORES_NONE
    n_rays = len(cameras) * width * height
    pixel_angle = _pixel_angle(rays[0])

    ignored_drones = directions[..., 3].reshape(-1).astype(int)

    def cast_in_worlds(data: SimData, kernels: RayKernels) -> Hits:
        poses = []
        for camera in cameras:
            pos, rot = camera_pose(camera, data)
            poses.append((pos if camera.carrier == "world" else raise_to_floor(model, pos), rot))
        if data.states.pos.ndim == 2:
            require(appearance is None, "expected data of all worlds for colours, got data of one world")
            origin = jnp.concatenate([jnp.broadcast_to(pos, (height * width, 3)) for pos, _ in poses])
            direction = jnp.concatenate(
                [_rotate_directions(rot, pixel_rows) for (_, rot), pixel_rows in zip(poses, directions, strict=True)]
            )
            hits = cast_rays(model_without_mocap, data, origin, direction, ignored_drones, drones)
            return untile_results(find_hidden(data, kernels, poses, hits))
        camera_poses = jnp.stack([jnp.concatenate([pos, rot.reshape(-1, 9)], axis=-1) for pos, rot in poses], axis=1)
        hits = cast_rays_in_worlds(
            model_without_mocap, data, camera_poses, directions, drones, kernels, appearance, pixel_angle
        )
        return untile_results(find_hidden(data, kernels, poses, hits))

    def find_hidden(data: SimData, kernels: RayKernels, poses: Sequence[tuple[Array, Array]], hits: Hits) -> Hits:
        if not baseline:
            return hits
        origins = [(pos + baseline * rot[..., 0])[..., None, :] for pos, rot in poses]
        shape = (*hits.point.shape[:-2], height * width, 3)
        origin = jnp.concatenate([jnp.broadcast_to(x, shape) for x in origins], axis=-2)
        origin, point = jax.lax.stop_gradient((origin, hits.point))
        distance = rotation.safe_norm(point - origin)
        direction = rotation.safe_normalize(point - origin, jnp.asarray([1.0, 0.0, 0.0], point.dtype))
        second = cast_rays(model_without_mocap, data, origin, direction, ignored_drones, drones, kernels=kernels)
        is_nearer = second.distance < (1 - HIDDEN_TOLERANCE) * distance[..., 0]
        return hits.replace(is_hidden=is_nearer & jnp.isfinite(hits.distance))

    def untile_results(hits: Hits) -> Hits:
        cosine = jnp.asarray(-directions[..., 2].reshape(-1), hits.distance.dtype) if along == "axis" else 1.0

        def untile(x: Array, n_trailing: int) -> Array:
            leading, trailing = x.shape[: x.ndim - n_trailing - 1], x.shape[x.ndim - n_trailing :]
            n_rows, n_columns = height // tile_height, width // tile_width
            x = x.reshape(*leading, len(cameras), n_rows, n_columns, tile_height, tile_width, *trailing)
            x = jnp.swapaxes(x, -3 - n_trailing, -2 - n_trailing)
            return x.reshape(*leading, len(cameras), height, width, *trailing)

        return hits.replace(
            distance=untile(hits.distance * cosine, 0),
            normal=untile(hits.normal, 1),
            point=untile(hits.point, 1),
            body_index=untile(hits.body_index, 0),
            color=None if hits.color is None else _unpack_color(untile(hits.color, 0)),
            is_hidden=None if hits.is_hidden is None else untile(hits.is_hidden, 0),
        )

    # Poses of mocap bodies become part of the data before the rays are cast.
    model_without_mocap = model.without_mocap_bodies()

    def depth(data: SimData, mocap: MocapPoses = None) -> Hits:
        require_states(data, ("pos", "quat"), batched=False)
        require(
            data.states.pos.ndim != 1, "expected data of all worlds or of one world for images, got data of one drone"
        )
        bodies = [*(body.name for body in model.objects), *(c.body for c in cameras)]
        require_poses(model, bodies, mocap)
        data = with_mocap_bodies(model, with_moved_objects(data, moving_plugins(plugins(), bodies)), mocap)
        if data.states.pos.ndim == 2:
            return cast_in_worlds(data, kernels)
        return kernels.run_on_each_device(cast_in_parts, data)

    def cast_in_parts(data: SimData, kernels: RayKernels) -> Hits:
        # Batches of worlds that fit into memory.
        max_rays = MAX_RAYS if kernels.platform is None else MAX_RAYS_OF_KERNEL
        n_worlds, worlds_per_batch = data.states.pos.shape[0], max(1, max_rays // n_rays)
        if n_worlds <= worlds_per_batch:
            return cast_in_worlds(data, kernels)
        objects, core = None if data.objects is None else data.objects.replace(mocap_ids=None), data.core
        # Colours may differ by world and episode.
        keyed_fields = () if appearance is None else ("world_id", "episode", "steps", "drone_id", "rng_key")
        keys = {name: getattr(core, name) for name in keyed_fields if name != "rng_key" or core.rng_key.ndim}

        def cast_in_world(poses: MocapPoses) -> Hits:
            pos, quat, objects, keys = jax.tree.map(lambda x: x[None], poses)
            states = data.states.replace(pos=pos, quat=quat)
            world_data = data.replace(states=states, objects=objects, core=core.replace(**keys))
            return jax.tree.map(lambda x: x[0], cast_in_worlds(world_data, kernels))

        return jax.lax.map(
            cast_in_world, (data.states.pos, data.states.quat, objects, keys), batch_size=worlds_per_batch
        )

    return depth


def _unpack_color(packed: Array) -> Array:
    return jax.lax.bitcast_convert_type(packed, np.uint8)[..., :3]


def _pixel_angle(rays: np.ndarray) -> float:
    # Between a ray in the middle of the image and its nearest neighbour.
    middle = rays[rays.shape[0] // 2, rays.shape[1] // 2]
    cosines = rays.reshape(-1, 3) @ middle
    return float(np.arccos(np.sort(cosines)[-2])) if len(cosines) > 1 else 0.0


def _rotate_directions(rot: Array, rays: np.ndarray) -> Array:
    # By components: a GPU may round matrix products to 10 bits.
    x, y, z = (rot[:, k] * jnp.asarray(rays[:, k, None], rot.dtype) for k in range(3))
    return x + y + z


def camera_pose(camera: CarriedCamera, data: SimData) -> tuple[Array, Array]:
    """Return the camera's position, m (..., 3), and axes as columns (..., 3, 3), world frame, in all worlds or one."""
    states = data.states
    pos, rot = (jnp.asarray(x, states.pos.dtype) for x in (camera.pos, camera.rot))
    leading = states.pos.shape[:-2]
    if camera.carrier == "world":
        return jnp.broadcast_to(pos, (*leading, 3)), jnp.broadcast_to(rot, (*leading, 3, 3))
    if camera.carrier == "drone":
        poses = states.pos, states.quat
    else:
        poses = data.objects.pos, data.objects.quat
        if leading:
            poses = poses[0][:, 0], poses[1][:, 0]
    camera_pos, quat = (x[..., camera.row, :] for x in poses)
    if not camera.follows_rotation:
        return camera_pos + pos, jnp.broadcast_to(rot, (*leading, 3, 3))
    # By components: a GPU may round matrix products to 10 bits.
    return camera_pos + rotation.rotate(quat, pos), jnp.stack(
        [rotation.rotate(quat, rot[:, k]) for k in range(3)], axis=-1
    )
