"""Scenes of Gaussian splats for the tests, as files and as arrays."""

import jax.numpy as jnp
import numpy as np

from crazysim.lab.scene.splats import Gaussians


def write_splats(path, n=30, n_colors=16, seed=0, **changes):
    """Write a scene of random splats around (2, 0, 1), and return its columns.

    ``changes`` replaces columns by name; None removes a column.
    """
    rng = np.random.default_rng(seed)
    columns = {axis: rng.normal(mean, 0.5, n) for axis, mean in (("x", 2), ("y", 0), ("z", 1))}
    columns |= {f"f_dc_{k}": rng.normal(0, 1, n) for k in range(3)}
    columns |= {f"f_rest_{k}": rng.normal(0, 0.2, n) for k in range(3 * (n_colors - 1))}
    columns |= {"opacity": rng.normal(0.5, 1, n)} | {f"scale_{k}": rng.normal(-1.8, 0.4, n) for k in range(3)}
    columns |= {f"rot_{k}": rng.normal(0, 1, n) for k in range(4)} | changes
    columns = {name: x for name, x in columns.items() if x is not None}
    head = "".join(f"property float {name}\n" for name in columns)
    body = np.stack(list(columns.values()), axis=1).astype("<f4").tobytes()
    path.write_bytes(f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{head}end_header\n".encode() + body)
    return columns


def make_splat(pos, deviation, opacity, color):
    return Gaussians(
        jnp.asarray([pos], jnp.float32),
        jnp.array([[0, 0, 0, 1.0]]),
        jnp.full((1, 3), np.log(deviation), jnp.float32),
        jnp.asarray((np.asarray(color) - 0.5)[None, None] * 2 * np.sqrt(np.pi), jnp.float32),
        jnp.asarray([np.log(opacity / (1 - opacity))], jnp.float32),
    )


def spot_alpha(offset, deviation, opacity, focal, n):
    """Return the alpha of ``make_splat``: its linear projection, plus 0.3 pixels^2."""
    ahead, left, up = offset
    u, v = -left / ahead, -up / ahead
    sides = focal * deviation / ahead * np.array([[1, 0, -u], [0, 1, -v]])
    inverse = np.linalg.inv(sides @ sides.T + 0.3 * np.eye(2))
    pixels = np.arange(n) + 0.5 - n / 2
    offsets = np.stack(np.broadcast_arrays(pixels - focal * u, pixels[:, None] - focal * v), axis=-1)
    alpha = opacity * np.exp(-np.einsum("...i,ij,...j", offsets, inverse, offsets) / 2)
    return np.where(alpha < 1 / 255, 0, alpha)
