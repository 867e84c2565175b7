"""Lights: the colours of the drones' LEDs over time."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.engine.pytree import PyTree, float_dtype, leaf
from crazysim.errors import require


class Lights(PyTree):
    """Colours of one drone's LED as pieces of constant or linearly fading colour; leading axes are for several drones.

    Before its first piece the LED has the first colour; the last piece is constant and has no end.
    """

    times: Array = leaf("shared", 1)
    """Start of each piece, s, ascending. Padding repeats the last piece. (n_pieces,)"""
    starts: Array = leaf("shared", 2)
    """Colour where each piece begins, red, green and blue, 0 to 1. (n_pieces, 3)"""
    ends: Array = leaf("shared", 2)
    """Colour that each piece fades to until the next piece begins; ``starts`` for constant pieces. (n_pieces, 3)"""

    @staticmethod
    def of_pieces(times: ArrayLike, starts: ArrayLike, ends: ArrayLike | None = None) -> Lights:
        """Return the lights of one drone.

        Args:
            times: Start of each piece, s, ascending. (n_pieces,)
            starts: Colour where each piece begins, 0 to 1. (n_pieces, 3)
            ends: Colour that each piece fades to until the next piece begins; None for constant colours. The last piece
                is constant in any case. (n_pieces, 3)
        """
        t, a = np.asarray(times, float), np.asarray(starts, float)
        b = a.copy() if ends is None else np.array(ends, float)
        require(
            t.ndim == 1 and t.size and a.shape == (len(t), 3) and b.shape == a.shape,
            f"expected times (n_pieces,) and colours (n_pieces, 3), got shapes {t.shape}, {a.shape} and "
            f"{b.shape}. Pass one colour per time.",
        )
        require(
            np.all(np.isfinite(t)) and np.all(np.diff(t) >= 0),
            "expected ascending, finite times of lights; sort the pieces by time",
        )
        require(
            np.all((a >= 0) & (a <= 1)) and np.all((b >= 0) & (b <= 1)),
            "expected colours from 0 to 1; divide colours from 0 to 255 by 255",
        )
        b[-1] = a[-1]
        return Lights(*(x.astype(float_dtype()) for x in (t, a, b)))  # type: ignore[arg-type]

    @staticmethod
    def constant(color: ArrayLike = (1.0, 1.0, 1.0)) -> Lights:
        """Return lights of one colour; white by default.

        Args:
            color: Red, green and blue, 0 to 1. (3,)
        """
        return Lights.of_pieces([0.0], np.asarray(color)[None])

    @staticmethod
    def stack(lights: Sequence[Lights]) -> Lights:
        """Return the lights of several drones as one record with a new first axis, padded to a common size."""
        require(lights, "expected the lights of at least one drone, got none. Pass a list with one per drone.")
        n = max(x.times.shape[-1] for x in lights)

        def pad(x: Array) -> np.ndarray:
            return np.concatenate([x, np.repeat(x[-1:], n - len(x), axis=0)])

        return jax.tree.map(lambda *leaves: np.stack([pad(x) for x in leaves]), *lights)

    def evaluate(self, t: ArrayLike) -> Array:
        """Return the colour of one drone at one time, 0 to 1; where two pieces meet, the colour of the later piece.

        Args:
            t: Time, s. ()

        Returns:
            Red, green and blue. (3,)
        """
        times = jnp.asarray(self.times)
        n, t = times.shape[0], jnp.asarray(t, times.dtype)
        i = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, n - 1)
        start, end = times[i], times[jnp.minimum(i + 1, n - 1)]
        length = end - start
        weight = jnp.where(length > 0, jnp.clip((t - start) / jnp.where(length > 0, length, 1.0), 0.0, 1.0), 0.0)
        a, b = jnp.asarray(self.starts)[i], jnp.asarray(self.ends)[i]
        return a + weight * (b - a)

    def colors(self, times: ArrayLike) -> np.ndarray:
        """Return the colours of several drones at several times, 0 to 1. (n, n_drones, 3)

        Args:
            times: Times, s. (n,)
        """
        return np.asarray(_colors(self, jnp.asarray(times, jnp.asarray(self.times).dtype)))


_colors = jax.jit(jax.vmap(jax.vmap(Lights.evaluate, in_axes=(0, None)), in_axes=(None, 0)))
