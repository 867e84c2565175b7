"""Largest speeds, accelerations, thrusts and rates of trajectories, found in float64 on the host."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import numpy as np

from crazysim.control.flatness import attitude_of_thrust
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.lab.planning.piece_table import Floats, Ints, PieceTable

N_INTERVALS = 64
"""Number of sampling intervals per piece."""
REFINED_PART = 0.05
"""Local maxima are refined if they are at most this fraction of the range of a drone's samples below its largest
sample."""
N_SECTIONS = 40
"""Number of golden sections. They shorten two sampling intervals to about 1e-10 of a piece."""
BATCH_SIZES = (64, 4096)
"""Small and large number of body rates that are computed in one call, so that there are only two compilations."""
PIECES_PER_BATCH = 2048
"""Number of pieces that are sampled at once; it bounds the memory."""


@dataclass(frozen=True)
class Quantity:
    """A function of position, yaw and their derivatives that has a limit."""

    unit: str
    """Unit of the values."""
    orders: tuple[int, ...]
    """Orders of the derivatives that ``compute`` takes."""
    compute: Callable[..., Floats]
    """Function from derivatives of x, y, z and yaw in the order of ``orders``, (..., 4) each, to the quantity (...)."""
    sign: int = 1
    """1 if the largest value is limited, -1 if the smallest value is."""


def _specific_thrust(acc: Floats) -> Floats:
    return acc[..., :3] + np.array([0.0, 0.0, GRAVITY_MAGNITUDE])


def _thrust(acc: Floats) -> Floats:
    return np.linalg.norm(_specific_thrust(acc), axis=-1) / GRAVITY_MAGNITUDE


def _body_rate(pos: Floats, vel: Floats, acc: Floats, jerk: Floats) -> Floats:
    columns = (_specific_thrust(acc), jerk[..., :3], pos[..., 3:], vel[..., 3:])
    rows = np.concatenate(columns, axis=-1).reshape(-1, 8)
    small_batch, large_batch = BATCH_SIZES
    batch_size = small_batch if len(rows) <= small_batch else large_batch
    padded_rows = np.zeros((-(-len(rows) // batch_size) * batch_size, 8))
    padded_rows[: len(rows)] = rows
    with jax.enable_x64(True):
        batches = [padded_rows[k : k + batch_size] for k in range(0, len(padded_rows), batch_size)]
        rates = [np.asarray(_compiled_body_rate(batch)) for batch in batches]
    return np.concatenate(rates)[: len(rows)].reshape(acc.shape[:-1])


@jax.jit
def _compiled_body_rate(rows: jax.Array) -> jax.Array:
    f, jerk, yaw, yaw_rate = rows[:, :3], rows[:, 3:6], rows[:, 6:7], rows[:, 7:]
    zero = jax.numpy.zeros_like
    return jax.numpy.linalg.norm(attitude_of_thrust(f, jerk, zero(f), yaw, yaw_rate, zero(yaw)).ang_vel, axis=-1)


QUANTITIES: dict[str, Quantity] = {
    "speed": Quantity("m/s", (1,), lambda vel: np.linalg.norm(vel[..., :3], axis=-1)),
    "horizontal_speed": Quantity("m/s", (1,), lambda vel: np.linalg.norm(vel[..., :2], axis=-1)),
    "vertical_speed": Quantity("m/s", (1,), lambda vel: np.abs(vel[..., 2])),
    "acceleration": Quantity("m/s^2", (2,), lambda acc: np.linalg.norm(acc[..., :3], axis=-1)),
    "jerk": Quantity("m/s^3", (3,), lambda jerk: np.linalg.norm(jerk[..., :3], axis=-1)),
    "thrust": Quantity("weights", (2,), _thrust),
    "min_thrust": Quantity("weights", (2,), _thrust, -1),
    "body_rate": Quantity("rad/s", (0, 1, 2, 3), _body_rate),
    "yaw_rate": Quantity("rad/s", (1,), lambda vel: np.abs(vel[..., 3])),
    "height": Quantity("m", (0,), lambda pos: pos[..., 2]),
    "floor": Quantity("m", (0,), lambda pos: pos[..., 2], -1),
}
"""Quantities by name."""


@dataclass(frozen=True, eq=False)
class Peak:
    """Largest value of a quantity for each drone, or the smallest value if ``Quantity.sign`` is -1."""

    value: Floats
    """Value, in the unit of the quantity. (n_drones,)"""
    time: Floats
    """Time at which it is reached, s. (n_drones,)"""


def find_peaks(table: PieceTable, names: Sequence[str]) -> dict[str, Peak]:
    """Return the peaks of quantities, by name.

    Each piece is sampled at ``N_INTERVALS + 1`` times. Every local maximum of the samples near the largest sample (see
    ``REFINED_PART``) is refined by golden sections. The squares of speed, acceleration and jerk are polynomials of
    degree 12 at most. The samples separate the maxima of such polynomials, so that only rounding errors remain, about
    1e-9 of the value. Body rates can have narrow peaks where the thrust almost vanishes or is almost horizontal; a peak
    narrower than a sampling interval may be missed.

    Args:
        names: Names of quantities, keys of ``QUANTITIES``.
    """
    return {name: _find_peak(table, QUANTITIES[name]) for name in names}


def _find_peak(table: PieceTable, quantity: Quantity) -> Peak:
    u = np.linspace(0.0, 1.0, N_INTERVALS + 1)
    powers = u ** np.arange(table.coefficients.shape[-1])[:, None]

    def sample_pieces(part: slice) -> Floats:
        derivatives = [table.derivative_coefficients(k)[part] for k in quantity.orders]
        values = [np.swapaxes(c @ powers[: c.shape[-1]], 1, 2) for c in derivatives]
        return quantity.sign * quantity.compute(*values)

    samples = np.concatenate(
        [sample_pieces(slice(k, k + PIECES_PER_BATCH)) for k in range(0, len(table.drone), PIECES_PER_BATCH)]
    )
    high = np.maximum.reduceat(samples.max(axis=1), table.first_pieces)
    low = np.minimum.reduceat(samples.min(axis=1), table.first_pieces)
    piece, sample = _find_candidates(samples, (high - REFINED_PART * (high - low))[table.drone])

    def signed_value(u: Floats) -> Floats:
        return quantity.sign * quantity.compute(*(table.evaluate_pieces(piece, u, k) for k in quantity.orders))

    refined_value, best_u = _golden_sections(
        signed_value, np.maximum(u[sample] - u[1], 0.0), np.minimum(u[sample] + u[1], 1.0)
    )
    is_better = refined_value > samples[piece, sample]
    best_value = np.where(is_better, refined_value, samples[piece, sample])
    best_u = np.where(is_better, best_u, u[sample])
    order = np.lexsort((-best_value, table.drone[piece]))
    peak = order[np.searchsorted(table.drone[piece][order], np.arange(table.n_drones))]
    time = table.start[piece] + best_u * table.length[piece]
    return Peak(quantity.sign * best_value[peak], time[peak])


def _find_candidates(samples: Floats, threshold: Floats) -> tuple[Ints, Ints]:
    padded_samples = np.pad(samples, ((0, 0), (1, 1)), constant_values=-np.inf)
    is_maximum = (samples > padded_samples[:, :-2]) & (samples >= padded_samples[:, 2:])
    return np.nonzero(is_maximum & (samples >= threshold[:, None]))  # type: ignore[return-value]


def _golden_sections(function: Callable[[Floats], Floats], low: Floats, high: Floats) -> tuple[Floats, Floats]:
    ratio = (np.sqrt(5) - 1) / 2
    left, right = high - ratio * (high - low), low + ratio * (high - low)
    left_value, right_value = function(left), function(right)
    for _ in range(N_SECTIONS):
        goes_left = left_value > right_value
        low, high = np.where(goes_left, low, left), np.where(goes_left, right, high)
        probe = np.where(goes_left, high - ratio * (high - low), low + ratio * (high - low))
        probe_value = function(probe)
        left, right = np.where(goes_left, probe, right), np.where(goes_left, left, probe)
        left_value, right_value = (
            np.where(goes_left, probe_value, right_value),
            np.where(goes_left, left_value, probe_value),
        )
    return np.where(left_value > right_value, left_value, right_value), np.where(left_value > right_value, left, right)
