"""Convolutions over the images among the observations of a policy.

A layer multiplies patches of 3 by 3 pixels, two pixels apart, by one matrix. A perceptron layer is the same product, so
convolutions compile as fast, and several seeds form one batched product. XLA's convolution is slower on CPUs for
gradients, and for the weights of several seeds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.envs.env import Env
from crazysim.envs.state import Obs
from crazysim.errors import require

KERNEL_SIZE, STRIDE = 3, 2
"""Side of a patch, and distance between neighbouring patches, pixels. Images are padded by one zero on each side."""


class Image(NamedTuple):
    """Position and format of an image within the concatenated observations."""

    start: int
    """Index of its first pixel."""
    height: int
    """Height, pixels."""
    width: int
    """Width, pixels."""
    channels: int = 1
    """Number of values per pixel."""
    is_depth: bool = True
    """Whether pixels are depths or distances, m."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and channels."""
        return self.height, self.width, self.channels

    @property
    def pixels(self) -> range:
        """Indices of the pixels within the observations, row by row."""
        return range(self.start, self.start + math.prod(self.shape))

    def shapes(self, channels: Sequence[int]) -> Iterator[tuple[int, int, int]]:
        """Yield height, width and channels of the image and after each layer."""
        height, width = self.height, self.width
        yield self.shape
        for n in channels:
            height, width = -(-height // STRIDE), -(-width // STRIDE)
            yield height, width, n


def find_images(sizes: Mapping[str, int], formats: Mapping[str, Mapping[str, Any]]) -> tuple[Image, ...]:
    """Return the images among observations that are concatenated in alphabetical order.

    Args:
        sizes: Sizes of the observations by name.
        formats: Formats of the observations that are images, from ``Env.image_formats``.
    """
    images, start = [], 0
    for name in sorted(sizes):
        if name in formats:
            height, width = formats[name]["height"], formats[name]["width"]
            channels = sizes[name] // (height * width)
            images.append(Image(start, height, width, channels, formats[name]["unit"] == "m"))
        start += sizes[name]
    require(
        images,
        f"expected an image among the observations for a convolution, got {', '.join(sorted(sizes))}. Use "
        f"depth_image=(16, 12), or leave out convolution.",
    )
    return tuple(images)


def images_of(env: Env, obs: Obs) -> tuple[Image, ...]:
    """Return the images among observations of an environment; see ``find_images``."""
    return find_images({name: x.shape[-1] for name, x in obs.items()}, env.image_formats())


def scale_depth(depth: Array) -> Array:
    """Return 1 / (1 + d) for a depth of d metres: 1 at the lens, 1/2 at 1 m, and nearly 0 where nothing is near.

    Normalisation by running statistics would scale every pixel differently, and the depth itself varies most where it
    is large and matters least. The inverse resolves small depths; adding 1 m keeps it and its derivative finite.
    """
    return 1.0 / (1.0 + depth)


def convolve(layers: Sequence[tuple[Array, Array]], image: Array) -> Array:
    """Return the features of one image, with a rectifier (ReLU) after each layer. (n_features,)

    Args:
        layers: Weights (9 n_in, n_out), with rows in the order row, column and channel of a patch, and biases (n_out,).
        image: Scaled image. (height, width, channels)
    """
    for weight, bias in layers:
        image = jax.nn.relu(_patches(image) @ weight + bias)
    return image.reshape(-1)


def _patches(x: Array) -> Array:
    height, width = x.shape[:2]
    padded = jnp.pad(x, ((1, 1), (1, 1), (0, 0)))
    rows, columns = -(-height // STRIDE), -(-width // STRIDE)
    parts = [
        padded[i : i + STRIDE * rows - 1 : STRIDE, j : j + STRIDE * columns - 1 : STRIDE]
        for i in range(KERNEL_SIZE)
        for j in range(KERNEL_SIZE)
    ]
    return jnp.concatenate(parts, axis=-1)
