"""Depth cameras: one ray per pixel, for all worlds in one call."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.arguments import check_flag, require_memory
from crazysim.core.data import SimData, require_states
from crazysim.core.random import episode_keys, uniform
from crazysim.core.settings import check_settings, setting
from crazysim.errors import ConfigError, UnknownNameError, require
from crazysim.scene.appearance import Appearance
from crazysim.scene.collision import CollisionModel, body_name
from crazysim.scene.first_hit import IGNORES_NONE
from crazysim.scene.hit_color import unpack_color
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

FAR_AWAY = 1e6
"""Distance of the sky, m, for its motion between two images: so far that only rotations move it."""

HIDDEN_TOLERANCE = 1e-3
"""Part of the distance by which a surface must be nearer to hide another: more than rounding, less than objects."""

Along = Literal["axis", "ray"]
"""Direction of distances: along the axis of the camera, or along the ray."""

BYTES_PER_RAY = 16
"""Lower bound of the memory of a ray, bytes: distance and index of the geom, once per ray and once in the image, four
bytes each."""


@dataclasses.dataclass(frozen=True)
class RandomPose:
    """Mounting of a camera or lidar that differs on every drone, in every world and episode."""

    pos: float = setting(default=0.005, low=0.0, high=1.0)
    """Largest change of the position along each axis of the body frame, m."""
    angle: float = setting(default=3.0, low=0.0, high=90.0)
    """Largest change of roll, pitch and yaw of the sensor about the axes of the body frame, degrees."""

    def __post_init__(self) -> None:
        check_settings(self)

    def draw(self, data: SimData, name: str) -> tuple[Array, Array]:
        """Return changes of positions, body frame, m (n_worlds, n_drones, 3), and turns, xyzw (n_worlds, n_drones, 4).

        Args:
            data: Data of all worlds, for their random keys.
            name: Name of the sensor.
        """
        n_drones, dtype = data.states.pos.shape[1], data.states.pos.dtype
        draw = jax.vmap(lambda key: 2 * uniform(key, (n_drones, 6), dtype) - 1)
        numbers = draw(episode_keys(data, f"pose of {name}"))
        return self.pos * numbers[..., :3], rotation.from_rpy(np.radians(self.angle) * numbers[..., 3:])


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
    row_times: np.ndarray | None = None
    """Time at which each row is read, from the time of the image, s; None for all rows at once. (height,)"""
    random_pose: RandomPose | None = None
    """Changes of the mounting in every world and episode; None for none."""
    name: str = "camera"
    """Name of the sensor, on which its random numbers depend."""

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
"""``depth(data, mocap=None, before=None) -> Hits``."""


def build_depth_fn(
    model: CollisionModel,
    cameras: Sequence[CarriedCamera],
    rays: Sequence[np.ndarray],
    drones: bool,
    hide_own: bool,
    along: Along,
    plugins: ListPlugins,
    kernels: RayKernels,
    drone_camera: DroneCamera | None = None,
    appearance: Appearance | None = None,
) -> DepthFn:
    """Return ``depth(data, mocap=None, before=None) -> Hits``; see ``Scene.depth_fn``.

    The images have shape (n_worlds, n_cameras, height, width), or without n_worlds in a function of one world.

    Args:
        model: Geoms of the scene that cameras see.
        rays: Unit directions of the pixels of each camera, as from ``pixel_directions``. (height, width, 3) each
        drones: Whether drones are visible.
        hide_own: Whether a drone is invisible to its own camera.
        along: Direction of distances; see ``Along``.
        plugins: Function that returns the plugins of the simulation.
        kernels: Kernels that cast the rays if possible.
        drone_camera: The camera, if all drones carry it.
        appearance: The scene's materials and lights, for ``Hits.color``; None for no colours.
    """
    baseline, row_times, random_pose = 0.0, None, None
    if drone_camera is not None:
        baseline, row_times, random_pose = drone_camera.baseline, drone_camera.row_times, drone_camera.random_pose
    require(
        isinstance(along, str) and along in ("axis", "ray"),
        f"expected along='axis' of the camera or along='ray', got {along!r}",
    )
    drones, hide_own = check_flag("drones", drones), check_flag("hide_own", hide_own)
    # Pixels in square tiles: neighbouring rays meet the same geoms.
    height, width = rays[0].shape[:2]
    tile_height, tile_width = (math.gcd(n, TILE_SIDE if row_times is None else 1) for n in (height, width))
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
    # Rows that are read one after the other are views of their own.
    n_rows = 1 if row_times is None else height
    n_pixels = height * width // n_rows
    directions = directions.reshape(-1, n_pixels, 4)

    def views(data: SimData) -> Array:
        # Position and axes of each view, as in ``Tables.camera_poses``. (..., n_views, 12)
        change = None
        if random_pose is not None:
            require(
                data.states.pos.ndim == 3,
                "expected data of all worlds for random poses, got data of one world. Call it outside of stages.",
            )
            change = random_pose.draw(data, drone_camera.name)  # type: ignore[union-attr]
        if row_times is None:
            return views_at_once(data, change)
        poses = jax.vmap(lambda t: views_at_once(extrapolate(data, t), change), out_axes=-2)(jnp.asarray(row_times))
        return poses.reshape(*poses.shape[:-3], -1, 12)

    def views_at_once(data: SimData, change: tuple[Array, Array] | None) -> Array:
        poses = []
        for camera in cameras:
            pos, rot = camera_pose(camera, data, None if change is None else [x[:, camera.row] for x in change])
            pos = pos if camera.carrier == "world" else raise_to_floor(model, pos)
            poses.append(jnp.concatenate([pos, rot.reshape(*rot.shape[:-2], 9)], axis=-1))
        return jnp.stack(poses, axis=-2)

    def rays_of(poses: Array, shift: float = 0.0) -> tuple[Array, Array]:
        # Origins and directions, world frame, of views that are shifted to the right, m. (..., n_rays, 3) each
        right = poses[..., 3::3]
        origin = poses[..., :3] + shift * right if shift else poses[..., :3]
        return jnp.repeat(origin, n_pixels, axis=-2), _rotate_directions(poses, directions)

    def cast_in_worlds(data: SimData, kernels: RayKernels, before: SimData | None = None) -> Hits:
        poses = views(data)
        if data.states.pos.ndim == 2:
            require(
                appearance is None,
                "expected data of all worlds for colours, got data of one world. Call it outside of stages.",
            )
            hits = cast_rays(model_without_mocap, data, *rays_of(poses), ignored_drones, drones)
        else:
            hits = cast_rays_in_worlds(
                model_without_mocap, data, poses, directions, drones, kernels, appearance, pixel_angle
            )
        if baseline:
            is_hidden = find_hidden(data, kernels, rays_of(poses, baseline)[0], hits.point)
            hits = hits.replace(is_hidden=is_hidden & jnp.isfinite(hits.distance))
        if before is not None:
            hits = trace_back(data, before, kernels, rays_of(poses)[1], hits)
        axes = poses[..., 3:].reshape(*poses.shape[:-2], len(cameras), n_rows, 1, 3, 3)
        return untile_results(hits).replace(camera_axes=axes)

    def find_hidden(data: SimData, kernels: RayKernels, origin: Array, point: Array) -> Array:
        origin, point = jax.lax.stop_gradient((origin, point))
        distance = rotation.safe_norm(point - origin)
        direction = rotation.safe_normalize(point - origin, jnp.asarray([1.0, 0.0, 0.0], point.dtype))
        second = cast_rays(model_without_mocap, data, origin, direction, ignored_drones, drones, kernels=kernels)
        return second.distance < (1 - HIDDEN_TOLERANCE) * distance[..., 0]

    def trace_back(data: SimData, before: SimData, kernels: RayKernels, direction: Array, hits: Hits) -> Hits:
        # A point moves with its body; the sky stays in its direction.
        index = jnp.maximum(hits.body_index, 0)[..., None]
        (earlier_pos, earlier_quat), (pos, quat) = (
            [jnp.take_along_axis(x, index, axis=-2) for x in body_poses(model_without_mocap, x)] for x in (before, data)
        )
        point = rotation.rotate(earlier_quat, rotation.rotate_inverse(quat, hits.point - pos), earlier_pos)
        earlier_views = views(before)
        origin = rays_of(earlier_views)[0]
        point = jnp.where(jnp.isfinite(hits.distance)[..., None], point, origin + FAR_AWAY * direction)
        axes = jnp.repeat(earlier_views[..., 3:], n_pixels, axis=-2)
        return hits.replace(
            earlier_point=jnp.concatenate([rotation.dot(axes[..., k::3], point - origin) for k in range(3)], axis=-1),
            was_hidden=find_hidden(before, kernels, origin, point),
        )

    def untile_results(hits: Hits) -> Hits:
        cosine = jnp.asarray(-directions[..., 2].reshape(-1), hits.distance.dtype) if along == "axis" else 1.0

        def untile(x: Array, n_trailing: int) -> Array:
            leading, trailing = x.shape[: x.ndim - n_trailing - 1], x.shape[x.ndim - n_trailing :]
            n_rows, n_columns = height // tile_height, width // tile_width
            x = x.reshape(*leading, len(cameras), n_rows, n_columns, tile_height, tile_width, *trailing)
            x = jnp.swapaxes(x, -3 - n_trailing, -2 - n_trailing)
            return x.reshape(*leading, len(cameras), height, width, *trailing)

        def untile_color(color: Array) -> Array:
            return unpack_color(untile(color[..., 0], 0)) if color.dtype == np.int32 else untile(color, 1)

        return hits.replace(
            distance=untile(hits.distance * cosine, 0),
            normal=untile(hits.normal, 1),
            point=untile(hits.point, 1),
            body_index=untile(hits.body_index, 0),
            color=None if hits.color is None else untile_color(hits.color),
            is_hidden=None if hits.is_hidden is None else untile(hits.is_hidden, 0),
            earlier_point=None if hits.earlier_point is None else untile(hits.earlier_point, 1),
            was_hidden=None if hits.was_hidden is None else untile(hits.was_hidden, 0),
        )

    state_names = ("pos", "quat") if row_times is None else ("pos", "quat", "vel", "ang_vel")
    # Poses of mocap bodies become part of the data before the rays are cast.
    model_without_mocap = model.without_mocap_bodies()

    def depth(data: SimData, mocap: MocapPoses = None, before: SimData | None = None) -> Hits:
        bodies = [*(body.name for body in model.objects), *(c.body for c in cameras)]

        def with_all_poses(data: SimData) -> SimData:
            require_states(data, state_names, batched=False)
            require(
                data.states.pos.ndim != 1,
                "expected data of all worlds or of one world for images, got data of one drone",
            )
            require_poses(model, bodies, mocap)
            return with_mocap_bodies(model, with_moved_objects(data, moving_plugins(plugins(), bodies)), mocap)

        data = with_all_poses(data)
        if before is None:
            in_one_world = data.states.pos.ndim == 2
            return cast_in_worlds(data, kernels) if in_one_world else kernels.run_on_each_device(cast_in_parts, data)
        require(kernels.mesh is None, "expected worlds on one device for an earlier time, got a mesh. Leave out mesh=.")
        before = with_all_poses(before)
        return (cast_in_worlds if data.states.pos.ndim == 2 else cast_in_parts)(data, kernels, before)

    def cast_in_parts(data: SimData, kernels: RayKernels, before: SimData | None = None) -> Hits:
        # Batches of worlds that fit into memory.
        max_rays = MAX_RAYS if kernels.platform is None else MAX_RAYS_OF_KERNEL
        n_worlds, worlds_per_batch = data.states.pos.shape[0], max(1, max_rays // n_rays)
        if n_worlds <= worlds_per_batch:
            return cast_in_worlds(data, kernels, before)
        core = data.core
        # Colours and mountings may differ by world and episode.
        keyed_fields = (
            ()
            if appearance is None and random_pose is None
            else ("world_id", "episode", "steps", "drone_id", "rng_key")
        )
        keys = {name: getattr(core, name) for name in keyed_fields if name != "rng_key" or core.rng_key.ndim}

        def poses_of(data: SimData) -> tuple[Any, ...]:
            objects = None if data.objects is None else data.objects.replace(mocap_ids=None, map_ids=None)
            return {name: getattr(data.states, name) for name in state_names}, objects

        def cast_in_world(parts: Any) -> Hits:
            keys, *poses = jax.tree.map(lambda x: x[None], parts)
            world_data = [
                data.replace(states=data.states.replace(**states), objects=objects, core=core.replace(**keys))
                for states, objects in poses
            ]
            return jax.tree.map(lambda x: x[0], cast_in_worlds(world_data[0], kernels, *world_data[1:]))

        parts = keys, poses_of(data), *([] if before is None else [poses_of(before)])
        return jax.lax.map(cast_in_world, parts, batch_size=worlds_per_batch)

    return depth


def _pixel_angle(rays: np.ndarray) -> float:
    # Between a ray in the middle of the image and its nearest neighbour.
    middle = rays[rays.shape[0] // 2, rays.shape[1] // 2]
    cosines = rays.reshape(-1, 3) @ middle
    return float(np.arccos(np.sort(cosines)[-2])) if len(cosines) > 1 else 0.0


def _rotate_directions(poses: Array, rays: np.ndarray) -> Array:
    # By components: a GPU may round matrix products to 10 bits.
    x, y, z = (poses[..., None, 3 + k :: 3] * jnp.asarray(rays[..., k, None], poses.dtype) for k in range(3))
    return (x + y + z).reshape(*poses.shape[:-2], -1, 3)


def extrapolate(data: SimData, time: Array | float) -> SimData:
    """Return the data with poses at another time, by constant velocities of drones and objects.

    Args:
        time: Time from now, s; drones turn by at most half a turn in it. ()
    """
    states, objects = data.states, data.objects
    quat = rotation.integrate_attitude(states.quat, time * states.ang_vel, 1.0)
    states = states.replace(pos=states.pos + time * states.vel, quat=quat)
    if objects is not None and objects.vel is not None:
        objects = objects.replace(pos=objects.pos + time * objects.vel)
    return data.replace(states=states, objects=objects)


def body_poses(model: CollisionModel, data: SimData) -> tuple[Array, Array]:
    """Return positions, m (..., n, 3), and attitudes, xyzw (..., n, 4), of floor, objects and drones.

    Bodies are in the order of ``Hits.body_index``. Those that do not move are at the origin.
    """
    drones = data.states.pos, data.states.quat
    world = jnp.zeros_like(drones[0][..., :1, :]), jnp.zeros_like(drones[1][..., :1, :]).at[..., 3].set(1)
    carriers, n_objects = [world, drones], 0
    if data.objects is not None:
        objects = [x[:, 0] if drones[0].ndim == 3 else x for x in (data.objects.pos, data.objects.quat)]
        carriers, n_objects = [world, objects, drones], objects[0].shape[-2]
    rows = [0, *(0 if body.row is None else 1 + body.row for body in model.objects)]
    rows += [1 + n_objects + k for k in range(drones[0].shape[-2])]
    pos, quat = (jnp.concatenate(x, axis=-2)[..., np.array(rows), :] for x in zip(*carriers, strict=True))
    return pos, quat


def camera_pose(camera: CarriedCamera, data: SimData, change: Sequence[Array] | None = None) -> tuple[Array, Array]:
    """Return the camera's position, m (..., 3), and axes as columns (..., 3, 3), world frame, in all worlds or one.

    Args:
        change: Change of its position, m (..., 3), and turn, xyzw (..., 4), in the frame of the body; None for none.
    """
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
    if change is not None:
        pos = pos + change[0]
    camera_pos = camera_pos + rotation.rotate(quat, pos)
    quat = quat if change is None else rotation.multiply(quat, change[1])
    # By components: a GPU may round matrix products to 10 bits.
    return camera_pos, jnp.stack([rotation.rotate(quat, rot[:, k]) for k in range(3)], axis=-1)
