"""Cameras: images of depth, colours, normals and bodies, of all drones, with rate and latency.

The same plugin serves simulations and environments::

    Camera(width=64, height=48, fovy=70.0, *, pos=None, rpy=(0, 0, 0), outputs=("depth",), max_depth=10.0,
           noise=None, distortion=None, shadows=True, random_colors=None, color_gradients=False, random_pose=None,
           exposure=0.0, blur_samples=8, readout=0.0, drones=True, freq=None, latency=0.0, name="camera")

    camera = sim.add(Camera(16, 12, freq=60, latency=0.03))      # in the step of a simulation
    camera.read(sim.data).images["depth"]                        # (n_worlds, n_drones, 12, 16), m

    env = make("avoid", 4096, camera=Camera(16, 12, freq=25))    # among the observations of an environment
    state.obs["camera.depth"]                                    # (n_worlds, n_drones, 192), m, row by row

In an environment each output is an observation ``"name.output"``. ``make(..., depth_image=(16, 12))`` is short for a
camera with the output depth at every step, whose observation is ``"depth"``.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.settings import setting
from crazysim.errors import require
from crazysim.plugins.sensors.depth_errors import Distortion, StereoNoise
from crazysim.plugins.sensors.image_sensor import COLORS, ImageSensor
from crazysim.scene.appearance import RandomColors
from crazysim.scene.depth import pixel_directions

MIN_COSINE = 1e-3
"""Cosine of the largest angle to the axis under which a point has a place in the image."""
MAX_EXPOSURE = 0.2
"""Longest exposure and readout, s; poses within are extrapolated, which is meant for less than half a turn."""
FIELD_MARGIN = 1.1
"""Largest squared tangent of this angle with a distorting lens, divided by that of the corners of the image."""


class Camera(ImageSensor):
    """Camera on every drone for depth and colours, with the pinhole model or a distorting lens, and with noise.

    A camera within an object sees its inner side: the surface where a ray leaves the object, as with MuJoCo's rays.
    """

    width: int = setting(default=64, low=1)
    """Width of the image, pixels."""
    height: int = setting(default=48, low=1)
    """Height of the image, pixels."""
    fovy: float = setting(default=70.0, low=1.0, high=179.0)
    """Vertical field of view, degrees; pixels are square."""
    _: dataclasses.KW_ONLY
    max_depth: float = setting(default=10.0, positive=True)
    """Largest depth and distance, m; also the value where nothing is nearer."""
    noise: StereoNoise | None = None
    """Errors of depths and distances, such as ``StereoNoise()`` for a RealSense D435; None for none."""
    distortion: Distortion | None = None
    """Distortion of the lens; ``fovy`` is the field of view without it. None for none."""
    shadows: bool = True
    """Whether lights cast shadows in colours, by a second ray of each pixel."""
    random_colors: RandomColors | None = None
    """Changes of colours and lights in every world and episode, such as ``RandomColors()``; None for none."""
    color_gradients: bool = False
    """Whether colours are numbers from 0 to 1 with derivatives, for gradients through images (``--algorithm apg``),
    instead of uint8; they are not rounded to 8 bits, and take four times the memory."""
    exposure: float = setting(default=0.0, low=0.0, high=MAX_EXPOSURE)
    """Time over which colours are averaged, s, which ends at the time of the image, or with a rolling shutter of the
    row; 0 for sharp images. Meanwhile drones, with their cameras, move by their velocities, and objects by theirs
    (``Handle.set_pose``). Colours have no gamma, so the mean is that of their values, as in MuJoCo's antialiasing."""
    blur_samples: int = setting(default=8, low=1)
    """Number of images that are averaged over the exposure."""
    readout: float = setting(default=0.0, low=0.0, high=MAX_EXPOSURE)
    """Time from the first row to the last one of a rolling shutter, s, which ends at the time of the image; 0 for a
    global shutter. The camera moves by the drone's velocity meanwhile, and other things stay as they are then."""
    name: str = "camera"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            not (self.readout and self.compares_images),
            f"expected flow from a global shutter, got readout={self.readout} of {self.name!r}. Use readout=0.",
        )
        for name in ("random_colors", "color_gradients"):
            require(
                not getattr(self, name) or {*COLORS} & {*self.outputs},
                f"expected a colour among the outputs of {self.name!r} for {name}, got {[*self.outputs]}. Use "
                f'outputs=("rgb",).',
            )

    @property
    def exposure_times(self) -> np.ndarray:
        n = self.blur_samples if self.exposure else 0
        return -self.exposure * (np.arange(n, dtype=np.float32) + 0.5) / max(n, 1)

    @property
    def row_times(self) -> np.ndarray | None:
        return np.linspace(-self.readout, 0, self.height, dtype=np.float32) if self.readout else None

    @property
    def rays(self) -> np.ndarray:
        right, up, back = np.moveaxis(pixel_directions(self.fovy, self.width, self.height), -1, 0)
        if self.distortion is None:
            return np.stack([-back, -right, up], axis=-1)
        x, y = self.distortion.undistort(-right / back, up / back)
        rays = np.stack([np.ones_like(x), -x, -y], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return self.height / 2 / math.tan(math.radians(self.fovy) / 2)

    @property
    def has_errors(self) -> bool:
        return self.noise is not None

    @property
    def color_settings(self) -> dict[str, Any]:
        names = "shadows", "random_colors", "color_gradients"
        return {"color": True} | {name: getattr(self, name) for name in names}

    @property
    def far_ratio(self) -> np.ndarray:
        return 1 / self.rays[..., 0]

    @property
    def baseline(self) -> float:
        return self.noise.baseline if self.noise is not None and self.noise.has_holes else 0.0

    def project(self, points: Array) -> tuple[Array, Array]:
        height, width = self.image_size
        depth = -points[..., 2]
        is_ahead = depth > MIN_COSINE * jnp.linalg.norm(points, axis=-1)
        x, y = (
            jnp.where(is_ahead, p / jnp.where(is_ahead, depth, 1.0), 0.0) for p in (points[..., 0], -points[..., 1])
        )
        if self.distortion is not None:
            # Farther out than every ray of the image, the polynomials of the lens may fold back into it.
            is_ahead &= x * x + y * y < FIELD_MARGIN * float(np.max(1 / self.rays[..., 0] ** 2 - 1))
            x, y = self.distortion.distort(x, y)  # type: ignore[arg-type]
        column, row = self.focal * x + (width - 1) / 2, self.focal * y + (height - 1) / 2
        is_in_image = (abs(column + 0.5 - width / 2) < width / 2) & (abs(row + 0.5 - height / 2) < height / 2)
        return jnp.stack([column, row], axis=-1), is_ahead & is_in_image

    def measure(self, distance: Array, is_hidden: Array | None, key: Array) -> Array:
        if self.noise is None:
            return distance
        cosine = jnp.asarray(self.rays[..., 0], distance.dtype)
        depth = distance * cosine
        measured_depth = self.noise.apply(depth, is_hidden, key)
        return jnp.where(depth < self.far * (1 - 1e-6), measured_depth, self.far) / cosine

    @property
    def optics(self) -> dict[str, Any]:
        distortion = {} if self.distortion is None else {"distortion": dataclasses.asdict(self.distortion)}
        times = {name: float(x) for name in ("exposure", "readout") if (x := getattr(self, name))}
        return {"fovy": float(self.fovy)} | distortion | times

    @property
    def image_size(self) -> tuple[int, int]:
        return int(self.height), int(self.width)

    @property
    def far(self) -> float:
        return float(self.max_depth)
