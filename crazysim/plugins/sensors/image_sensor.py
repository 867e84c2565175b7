"""Base class of sensors that take images by rays: mounting, rate, latency and outputs.

In a simulation the plugin takes images in the step, and its record has the last image. An environment takes images at
the end of its steps instead, by the wrapper ``crazysim.envs.CameraImages``. Both call ``image_fn`` and ``update``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin, Simulation, StagePlacement
from crazysim.core.random import drone_keys, episode_keys
from crazysim.core.settings import setting
from crazysim.drones.body import body_shape
from crazysim.engine.pytree import PyTree, device_array, leaf
from crazysim.engine.stage import Stage
from crazysim.errors import ConfigError, require, short_repr
from crazysim.plugins.sensors.sensor import MAX_DELAY, MAX_ROWS, age_at, rate_in
from crazysim.scene.depth import BYTES_PER_RAY, CarriedCamera, DroneCamera, RandomPose, check_image_memory, extrapolate
from crazysim.scene.object_poses import moving_plugins, with_moved_objects
from crazysim.scene.ray_casting import body_names


class Output(NamedTuple):
    """What an output of an image is."""

    shape: tuple[int, ...] = ()
    """Shape of a pixel."""
    unit: str = "m"
    """Its unit, as in ``ImageSensor.describe``."""
    empty: int | None = None
    """Value where a ray meets nothing; None for the largest distance."""
    dtype: DTypeLike | None = None
    """Type of its numbers; None for the type of the states."""


OUTPUTS = {
    "depth": Output(),
    "distance": Output(),
    "normal": Output((3,), "1", 0),
    "segmentation": Output((), "index", -1, np.int32),
    "rgb": Output((3,), "1", 0, np.uint8),
    "gray": Output((), "1", 0, np.uint8),
    "flow": Output((2,), "pixel", 0),
    "flow_valid": Output((), "1", 0, bool),
}
"""Outputs of an image by name."""
COLORS = "rgb", "gray"
"""Outputs that are colours, uint8, or numbers from 0 to 1 with derivatives."""
FLOWS = "flow", "flow_valid"
"""Outputs that compare an image with the image before it."""
LUMA = 0.299, 0.587, 0.114
"""Weights of red, green and blue in grey (ITU-R BT.601)."""
UNFUSED_REASON = "images are taken by kernels with a lane for each ray"

Images = dict[str, Array]
"""Images by output, (n_worlds, n_drones, height, width), with a further axis of length 3 for normals and colours, and 2
for flow."""
ImageFn = Callable[..., Images]
"""``images(data, before=None) -> Images``; ``before`` is the data at the time of the image before, for flow."""
Poses = dict[str, dict[str, Array]]
"""The fields ``drone_poses`` and ``object_poses`` of ``ImageData``."""
CaptureFn = Callable[[SimData, Poses | None], tuple[Images, Poses]]
"""Function of data and of the poses at the image before that returns images, and the poses that the next ones need."""


def as_observation(image: Array, dtype: DTypeLike) -> Array:
    """Return an image as numbers for a policy: colours from 0 to 1, other values unchanged. (n_pixels,)"""
    return (image.astype(dtype) * (1 / 255 if image.dtype == np.uint8 else 1)).reshape(-1)


class ImageData(PyTree):
    """The last delivered images of a camera or lidar, and the images in transit."""

    watched = False  # the check of every number of every pixel takes minutes to compile; states are watched

    images: dict[str, Array] = leaf("drone", None)
    """Last image of each output; nothing within ``far`` before the first image. (n_worlds, n_drones, height, width),
    for normals and colours (n_worlds, n_drones, height, width, 3), for flow (n_worlds, n_drones, height, width, 2)"""
    taken_step: Array = leaf("world")
    """Step in which these images were taken, negative before the first ones. (n_worlds, 1)"""
    transit: dict[str, Array] = leaf("drone", None)
    """The last images of each output that were taken, newest first; empty without latency. (n_worlds, n_drones, n_rows,
    height, width), for normals and colours (n_worlds, n_drones, n_rows, height, width, 3), for flow (..., 2)"""
    drone_poses: dict[str, Array] = leaf("drone", 1)
    """``pos``, m, (n_worlds, n_drones, 3), and ``quat``, xyzw, (..., 4), world frame, of the drones at the last image
    that was taken, zero before; empty without flow."""
    object_poses: dict[str, Array] = leaf("world", 2)
    """The same of the objects, (n_worlds, 1, n_objects, 3 or 4); empty without flow or objects."""


class ImageSensor(Plugin):
    """Base class of sensors that take images by rays, on every drone.

    A subclass defines ``rays``, ``optics``, ``image_size`` and ``far``, and ``measure`` if images have errors.
    Images show the state after a step, and stay in the record until the next image is delivered. The first image of an
    episode is delivered at once.
    """

    _: dataclasses.KW_ONLY
    pos: ArrayLike | None = setting(default=None, shapes=((3,),))
    """Position of the sensor in the body frame, m; None for the position of ``fpv_cam``. (3,)"""
    rpy: ArrayLike = setting(default=(0.0, 0.0, 0.0), shapes=((3,),))
    """Roll, pitch and yaw of the sensor's frame (x ahead, y left, z up) in the body frame, rad. (3,)"""
    outputs: Sequence[str] = ("depth",)
    """Images to take, some of ``"depth"`` (along the axis of the sensor, m), ``"distance"`` (along the ray, m),
    ``"normal"`` (of the surface, unit, sensor frame), ``"segmentation"`` (index in ``segment_names``, -1 for
    nothing), ``"rgb"`` (colour as MuJoCo's renderer draws it), ``"gray"`` (its brightness; both uint8 unless they have
    derivatives), ``"flow"``
    (motion of the surface since the image before, right and down, pixels: the place of its point in this image minus
    its place in the image before, the negative of Kubric's ``backward_flow``) and ``"flow_valid"`` (whether the image
    before shows this point, bool; False in the first image of an episode, whose flow is zero). A lidar has no depths
    along an axis, colours and flow."""
    random_pose: RandomPose | None = None
    """Changes of position and attitude on every drone in every world and episode, such as ``RandomPose()``; None for
    none. ``describe`` gives the mounting without them."""
    drones: bool = True
    """True for other drones to be visible; a drone never sees itself."""
    freq: int | None = None
    """Images per second, Hz, a divisor of ``sim.freq``, or in an environment of ``env.freq``; None for every step."""
    latency: ArrayLike = setting(default=0.0, low=0.0, high=MAX_DELAY, shapes=((), (2,)))
    """Time from image to delivery, s, rounded to steps, or the shortest and longest, between which each world draws
    one in every episode. () or (2,)"""
    name: str = "images"

    def __post_init__(self) -> None:
        super().__post_init__()
        outputs = self.outputs
        is_list = isinstance(outputs, (list, tuple)) and len(outputs) > 0 and all(isinstance(x, str) for x in outputs)
        if not is_list or len({*outputs}) < len(outputs) or not {*outputs} <= {*OUTPUTS}:
            raise ConfigError(
                f"expected outputs of {self.name!r} as a list of {', '.join(map(repr, OUTPUTS))}, got "
                f"{short_repr(outputs)}. Use outputs=('depth',), say."
            )
        require(
            bool(np.all(np.diff(np.atleast_1d(self.latency)) >= 0)),
            f"expected a range of latency of {self.name!r}, the shortest first, got {self.latency!r}. Use "
            f"latency=(0.02, 0.06), for example.",
        )

    @property
    def rays(self) -> np.ndarray:
        """Unit directions of the pixels, frame of the sensor. (height, width, 3)"""
        raise NotImplementedError

    @property
    def far(self) -> float:
        """Largest depth and distance, m; also the value where nothing is nearer."""
        raise NotImplementedError

    @property
    def far_ratio(self) -> np.ndarray | float:
        """Largest distance along each ray divided by ``far``. (height, width) or ()"""
        return 1.0

    @property
    def has_errors(self) -> bool:
        """Whether ``measure`` must be called."""
        return False

    @property
    def color_settings(self) -> dict[str, Any]:
        """Settings of ``Scene.depth_fn`` for colours."""
        return {}

    @property
    def exposure_times(self) -> np.ndarray:
        """Times from the time of the image at which colours are averaged, s; empty for none. (n,)"""
        return np.zeros(0)

    @property
    def row_times(self) -> np.ndarray | None:
        """Time at which each row is read, from the time of the image, s; None for all rows at once. (height,)"""
        return None

    @property
    def compares_images(self) -> bool:
        """Whether images need the poses of the image before."""
        return not {*FLOWS}.isdisjoint(self.outputs)

    @property
    def baseline(self) -> float:
        """Distance to a second imager, on the right, m, whose view ``measure`` needs; 0 for none."""
        return 0.0

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return where an image shows points, columns and rows, pixels (..., 2), and whether it shows them. (...)

        Args:
            points: Points in the frame of the camera: right, up and back, m. (..., 3)
        """
        raise NotImplementedError

    def measure(self, distance: Array, is_hidden: Array | None, key: Array) -> Array:
        """Return the distances of one drone as the sensor measures them, m. (height, width)

        Args:
            distance: True distances, m, at most ``far * far_ratio``. (height, width)
            is_hidden: True where the second imager does not see the surface; None without one. (height, width)
            key: Random key of the drone at this step.
        """
        del is_hidden, key
        return distance

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the images, pixels."""
        raise NotImplementedError

    @property
    def optics(self) -> dict[str, Any]:
        """Numbers that determine ``rays``, by name."""
        raise NotImplementedError

    def describe(self, sim: Simulation) -> dict[str, dict[str, Any]]:
        """Return the format of the images of each output: size, unit and model of the sensor.

        ``pos`` and ``rot`` are in the body frame of the first drone; the columns of ``rot`` are right, up and back.
        """
        (height, width), camera = self.image_size, CarriedCamera.on_drone(self.drone_camera(sim), 0)
        sensor = {"sensor": self.name, **self.optics, "pos": list(camera.pos), "rot": [list(x) for x in camera.rot]}
        sensor |= {"freq": self.freq, "latency": np.asarray(self.latency, np.float64).tolist()}
        formats = {}
        for name in self.outputs:
            output = self._output(name)
            formats[name] = {
                "height": height,
                "width": width,
                "unit": output.unit,
                "far": self.far if output.empty is None else output.empty,
                "output": name,
                "has_gradient": output.dtype is None,
            } | sensor
        return formats

    def segment_names(self, sim: Simulation) -> tuple[str, ...]:
        """Return the names of the floor, the objects and the drones, in the order of the indices in segmentations."""
        return body_names(sim.scene.visual_model, sim.n_drones if self.drones else 0)

    def check(self, sim: Simulation, period: int | None = None) -> None:
        """Check the settings that depend on the simulation, before anything is allocated.

        Args:
            period: Steps between images; None for images without a record.
        """
        if sim.scene.mesh is not None:
            raise ConfigError("expected worlds on one device for images, got a mesh of devices. Leave out mesh=.")
        n_rows, (height, width) = 0 if period is None else self._n_rows(sim.data, period), self.image_size
        if n_rows > MAX_ROWS:
            raise ConfigError(
                f"expected a latency of {self.name!r} of at most {MAX_ROWS - 1} images, got {self.latency} s. Use a "
                f"shorter latency or a lower freq=."
            )
        outputs = [self._output(name) for name in self.outputs]
        number_bytes = [np.dtype(x.dtype or np.float32).itemsize * math.prod(x.shape) for x in outputs]
        bytes_per_pixel = sum(number_bytes) * (1 + n_rows) + BYTES_PER_RAY
        check_image_memory(sim.n_worlds * sim.n_drones, width, height, bytes_per_pixel, sim.scene.device)

    def image_fn(self, sim: Simulation) -> ImageFn:
        """Return a pure function of the data of all worlds that returns their images, without rate and latency.

        The function is for the scene as it is now. For flow, its second argument is the data at the image before.
        """
        self.check(sim)
        rays, far, camera = self.rays, self.far, self.drone_camera(sim)
        color_settings = self.color_settings if {*COLORS} & {*self.outputs} else {}
        color_dtype = self._output("rgb").dtype
        cast_rays: Any = sim.scene.depth_fn(camera, drones=self.drones, along="ray", **color_settings)
        height, width = self.image_size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)

        def mean_color(data: SimData, hits: Any) -> Array:
            if not len(self.exposure_times):
                return hits.color

            def add_color(total: Array, time: Array) -> tuple[Array, None]:
                return total + cast_rays(extrapolate(data, time)).color, None

            start = jnp.zeros(hits.color.shape, jnp.result_type(hits.color, np.float32))
            total, _ = jax.lax.scan(add_color, start, jnp.asarray(self.exposure_times))
            return as_color(total / len(self.exposure_times))

        def as_color(x: Array) -> Array:
            return x if color_dtype is None else jnp.round(x).astype(color_dtype)

        def take_images(data: SimData, before: SimData | None = None) -> Images:
            before = before if self.compares_images else None
            hits = cast_rays(data, before=before)
            cosine = jnp.asarray(rays[..., 0], hits.distance.dtype)
            distance = hits.distance
            if self.has_errors:
                keys = drone_keys(data, self.name)
                distance = jax.vmap(jax.vmap(self.measure))(
                    jnp.minimum(distance, far * self.far_ratio), hits.is_hidden, keys
                )
            images: dict[str, Any] = {}
            color: Any = mean_color(data, hits) if color_settings else None
            for name in self.outputs:
                if name == "depth":
                    # Exactly ``far`` where nothing is nearer.
                    images[name] = jnp.where(distance * cosine < far * (1 - 1e-6), distance * cosine, far)
                elif name == "distance":
                    images[name] = jnp.minimum(distance, far)
                elif name == "normal":
                    right, up, back = jnp.moveaxis(jnp.sum(hits.camera_axes * hits.normal[..., None], axis=-2), -1, 0)
                    images[name] = jnp.stack([-back, -right, up], axis=-1)
                elif name == "rgb":
                    images[name] = color
                elif name == "gray":
                    parts = [weight * color[..., k].astype(distance.dtype) for k, weight in enumerate(LUMA)]
                    images[name] = as_color(sum(parts))  # type: ignore[arg-type]
                elif name in FLOWS and before is None:
                    output = OUTPUTS[name]
                    images[name] = jnp.zeros(distance.shape + output.shape, output.dtype or distance.dtype)
                elif name in FLOWS:
                    place, is_in_view = self.project(hits.earlier_point)
                    images[name] = pixels - place if name == "flow" else is_in_view & ~hits.was_hidden
                else:
                    images[name] = hits.body_index
            return images

        return take_images

    def capture_fn(self, sim: Simulation) -> CaptureFn:
        """Return a function that takes images of all worlds, for ``initial_record`` and ``update``."""
        take_images, names = self.image_fn(sim), [body.name for body in sim.scene.visual_model.objects]

        def capture(data: SimData, poses: Poses | None) -> tuple[Images, Poses]:
            if not self.compares_images:
                return take_images(data), {"drone_poses": {}, "object_poses": {}}
            images = take_images(data) if poses is None else take_images(data, _with_poses(data, poses))
            return images, _poses_of(with_moved_objects(data, moving_plugins(sim.scene.plugins(), names)))

        return capture

    def initial_record(self, capture: CaptureFn, data: SimData, period: int) -> ImageData:
        """Return the record of all worlds with images that are taken and delivered now.

        Args:
            capture: Function that ``capture_fn`` returned.
            data: Data of all worlds.
            period: Steps between images.
        """
        (images, poses), n = capture(data, None), self._n_rows(data, period)
        transit = {k: jnp.repeat(x[:, :, None], n, axis=2) for k, x in images.items()} if n else {}
        return ImageData(images=images, taken_step=data.core.steps, transit=transit, **poses)

    def update(self, capture: CaptureFn, data: SimData, record: ImageData, period: int) -> ImageData:
        """Return the record of all worlds after a step: due images are taken, and images that arrive are delivered.

        Args:
            capture: Function that ``capture_fn`` returned.
            data: Data of all worlds.
            period: Steps between images.
        """
        steps, latency = data.core.steps, self._latency_steps(data)
        is_due = steps % period == 0

        def select_due(new: Array, old: Array) -> Array:
            return jnp.where(_over(is_due, old), new, old)

        def capture_images(record: ImageData) -> ImageData:
            before = {name: getattr(record, name) for name in ("drone_poses", "object_poses")}
            images, poses = capture(data, before)
            # An episode, and a sensor that was added in flight, have no image before their first one.
            for name in {*FLOWS} & {*images}:
                has_before = jnp.any(before["drone_poses"]["quat"] != 0, axis=(1, 2))[:, None] & (steps >= period)
                images[name] = jnp.where(_over(has_before, images[name]), images[name], jnp.zeros_like(images[name]))
            record = record.replace(**jax.tree.map(select_due, poses, before))
            if not record.transit:
                return record.replace(images=jax.tree.map(select_due, images, record.images))
            queues = {k: jnp.concatenate([x[:, :, None], record.transit[k][:, :, :-1]], 2) for k, x in images.items()}
            return record.replace(transit=jax.tree.map(select_due, queues, record.transit))

        record = (
            jax.lax.cond(jnp.any(is_due), capture_images, lambda record: record, record)
            if period > 1
            else capture_images(record)
        )
        # Images are numbered from the beginning of the episode; the first one is delivered at once.
        delivered_index = jnp.maximum((steps - latency) // period, 0)
        if record.transit:
            row = steps // period - delivered_index

            def read_row(queue: Array) -> Array:
                index = row.reshape(-1, *(1,) * (queue.ndim - 1))
                return jnp.take_along_axis(queue, index, axis=2)[:, :, 0]

            record = record.replace(images=jax.tree.map(read_row, record.transit))
        return record.replace(taken_step=delivered_index * period)

    def record(self, sim: Simulation) -> ImageData:
        period = sim.data.core.freq // rate_in(self, sim.data.core.freq)
        self.check(sim, period)
        shape, n = (*sim.data.states.pos.shape[:2], *self.image_size), self._n_rows(sim.data, period)
        images, transit = {}, {}
        for name in self.outputs:
            output = self._output(name)
            dtype = output.dtype or sim.data.states.pos.dtype
            value = self.far if output.empty is None else output.empty
            images[name] = device_array(np.full(shape + output.shape, value), dtype)
            if n:
                transit[name] = device_array(np.full((*shape[:2], n, *shape[2:], *output.shape), value), dtype)
        poses: Poses = {"drone_poses": {}, "object_poses": {}}
        if self.compares_images:
            sim.scene.compile_if_edited()  # this record depends on the objects of the scene
            poses = jax.tree.map(lambda x: device_array(np.zeros(x.shape), x.dtype), _poses_of(sim.data))
        return ImageData(images, device_array(np.full((shape[0], 1), -1), np.int32), transit, **poses)

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        period = sim.data.core.freq // rate_in(self, sim.data.core.freq)
        capture = self.capture_fn(sim)

        def update_record(data: SimData) -> SimData:
            def update(data: SimData) -> SimData:
                return self.write(data, self.update(capture, data, self.read(data), period))

            steps = data.core.steps
            is_due = (steps % period == 0) | ((steps - self._latency_steps(data)) % period == 0)
            return update(data) if period == 1 else jax.lax.cond(jnp.any(is_due), update, lambda data: data, data)

        stage = Stage(update_record, "batch", name=self.name, unfused_reason=UNFUSED_REASON)
        return [StagePlacement(stage, before="increment_steps")]

    def observations(self, data: SimData) -> dict[str, Array]:
        return {name: as_observation(image, data.states.pos.dtype) for name, image in self.read(data).images.items()}

    def age(self, data: SimData) -> Array:
        """Return the time since the last images were taken, s; infinite before the first ones. (n_worlds, 1)"""
        return age_at(data, self.read(data).taken_step)

    def drone_camera(self, sim: Simulation) -> DroneCamera:
        """Return the camera for ``Scene.depth_fn``: directions of its rays, and its mounting on each drone."""
        fpv_pos = [body_shape(airframe)["fpv_camera"] for airframe in sim.airframes]
        pos = np.asarray(fpv_pos if self.pos is None else [self.pos] * sim.n_drones, np.float64)
        rpy, random_pose = np.asarray(self.rpy, np.float64), self.random_pose
        return DroneCamera(self.rays, pos, rpy, self.baseline, self.row_times, random_pose, self.name)

    def _output(self, name: str) -> Output:
        is_float = name in COLORS and self.color_settings.get("color_gradients", False)
        return OUTPUTS[name]._replace(dtype=None) if is_float else OUTPUTS[name]

    def _latency_range(self, freq: int) -> tuple[int, int]:
        low, high = np.broadcast_to(np.asarray(self.latency, np.float64), 2).tolist()
        return math.floor(low * freq + 0.5), math.floor(high * freq + 0.5)

    def _latency_steps(self, data: SimData) -> Array | int:
        low, high = self._latency_range(data.core.freq)
        if low == high:
            return low
        draw = jax.vmap(lambda key: jax.random.randint(key, (1,), low, high + 1))
        return draw(episode_keys(data, f"latency of {self.name}"))

    def _n_rows(self, data: SimData, period: int) -> int:
        _, latency = self._latency_range(data.core.freq)
        return -(-latency // period) + 1 if latency else 0


def _over(flag: Array, x: Array) -> Array:
    # A flag of each world, (n_worlds, 1), for an array with more axes.
    return flag.reshape(-1, *(1,) * (x.ndim - 1))


def _poses_of(data: SimData) -> Poses:
    drones, objects = data.states, data.objects
    return {
        "drone_poses": {"pos": drones.pos, "quat": drones.quat},
        "object_poses": {} if objects is None else {"pos": objects.pos, "quat": objects.quat},
    }


def _with_poses(data: SimData, poses: Poses) -> SimData:
    objects = None if data.objects is None else data.objects.replace(**poses["object_poses"], recorded=True)
    return data.replace(states=data.states.replace(**poses["drone_poses"]), objects=objects)
