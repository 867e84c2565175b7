"""Checks that the columns of a log obey mechanics, which reveals wrong units, axes, signs and orders."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import permutations, product
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.errors import ConfigError, require
from crazysim.lab.identify.columns import Columns
from crazysim.lab.identify.motion import body_rates, integrate
from crazysim.lab.live.attitude import rotate

if TYPE_CHECKING:
    from crazysim.lab.identify.logs import Log

PLAUSIBLE_RATIOS = (0.5, 2.0)
"""Ratios of measured to expected motion that count as agreement, on each axis that moves. In the logs of
IDSIA's benchmark and NanoBench, delays between streams, drag and noise give 0.6 to 1.3."""
LENGTH_UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "feet": 0.3048}
"""Units of positions, in m. Velocities have these units per second."""
DIVERGED_ERROR = 10.0
"""Ratio of error to motion above which a measured velocity or angular velocity counts as diverged. In the logs of those
benchmarks the ratio is below 4 or above 30."""
MIN_TURN_RATE = 0.01
"""Standard deviation of roll and pitch rates below which nothing can be fitted, rad/s: the noise of a gyroscope
(BMI088, 0.014 degrees/s/sqrt(Hz)) gives 0.003 rad/s at 250 Hz."""
MIN_SPAN = 0.3
"""Span of the position below which the drone counts as resting, m. The estimator of a resting drone drifts."""
PIECE_DURATION = 2.0
"""Duration of the pieces that are left out where a rate has diverged, s."""
Z_AXIS = np.array([0.0, 0.0, 1.0])
"""Direction of the thrust, body frame. (3,)"""


class Pair(NamedTuple):
    """Measured and expected changes over windows of equal duration, which must agree."""

    requirement: str
    """Property of the columns that makes them agree."""
    measured: NDArray
    """Measured changes. (n, 3)"""
    expected: NDArray
    """Changes that follow from other columns. (n, 3)"""
    floor: float
    """Change below which an axis counts as not moving, in the unit of the changes."""

    def sizes(self) -> NDArray:
        """Return the medians of measured and expected changes on each axis, zero for axes that do not move. (3, 2)

        Only the quarter of the windows with the largest expected changes is used. Both changes of a window are
        multiplied by the sign of the expected change.
        """
        sizes = np.zeros((3, 2))
        for k, (x, y) in enumerate(zip(self.measured.T, self.expected.T, strict=True)):
            is_large = np.abs(y) >= np.quantile(np.abs(y), 0.75)
            measured_size, size = np.median(x[is_large] * np.sign(y[is_large])), np.median(np.abs(y[is_large]))
            if max(size, np.median(np.abs(x[is_large]))) > self.floor:
                sizes[k] = (measured_size, size) if size > 0 else (np.inf, 1.0)
        return sizes

    def ratios(self) -> NDArray:
        """Return the ratio of measured to expected changes on each axis, NaN for axes that do not move. (3,)"""
        measured_size, size = self.sizes().T
        return np.divide(measured_size, size, out=np.full(3, np.nan), where=size > 0)

    def agrees(self) -> bool:
        """Whether measured and expected motion agree on every axis that moves, within half of the floor."""
        measured_size, size = self.sizes().T
        slack = self.floor / 2
        return bool(
            np.all(
                (measured_size >= PLAUSIBLE_RATIOS[0] * size - slack)
                & (measured_size <= PLAUSIBLE_RATIOS[1] * size + slack)
            )
        )


def check_motion(
    name: str, t: NDArray, data: Mapping[str, NDArray], derived_keys: tuple[str, ...], repairs: list[str]
) -> NDArray:
    """Return True for the samples whose columns describe one motion. (n,)

    The velocity must move the position, the angular velocity must turn the attitude, the thrust must point up on
    average, and thrust and gravity must accelerate the drone. Pieces in which a measured rate has diverged, such as
    where a gyroscope failed, are left out.

    Args:
        t: Time, s. (n,)
        data: Columns by field of ``Columns``, in the units of a log.
        derived_keys: Fields that were differentiated, not measured; also ``quat`` if the attitude was given as angles.
        repairs: List that descriptions of repairs are appended to.
    """
    is_kept = np.ones(len(t), bool)
    for pair, width in _rate_pairs(t, data, derived_keys):
        is_diverged = _diverged_windows(pair, round(PIECE_DURATION / float(np.median(np.diff(t)))))
        if 0 < np.sum(is_diverged) <= len(is_diverged) / 2:
            is_kept[np.flatnonzero(is_diverged)[:, None] + np.arange(width + 1)] = False
            repairs.append(f"dropped {np.sum(~is_kept)} samples without {pair.requirement}, which the others have")
    t, data = t[is_kept], {key: x[is_kept] for key, x in data.items()}
    laws = _check_laws(t, data, derived_keys)
    broken = [k for k, law in enumerate(laws) if law.fault]
    if not broken:
        return is_kept
    fault = laws[broken[0]].fault
    span = float(np.max(np.ptp(data["pos"], axis=0)))
    require(
        span >= MIN_SPAN,
        f"{name}: expected {fault}. The position spans {span:.2g} m: take a log of a flight that moves by "
        f"{MIN_SPAN:g} m or more, or give metres_per_unit.",
    )
    remedy, n_faults = "", len(broken)
    for remedy_text, changed_data in _propose_remedies(data, derived_keys):
        new_laws = _check_laws(t, changed_data, derived_keys)
        # Another law may be broken by another mistake. A factor that makes a motion vanish explains nothing.
        breaks_another = any(
            (y.fault and not x.fault) or (x.has_motion and not y.has_motion)
            for x, y in zip(laws, new_laws, strict=True)
        )
        n_left = sum(bool(law.fault) for law in new_laws)
        if n_left < n_faults and not breaks_another and not new_laws[broken[0]].fault:
            remedy, n_faults = remedy_text, n_left
            if not n_left:
                break
    advice = (
        "Check units, signs and order of the columns: z up, quaternions xyzw and body to world, angular velocities in "
        "the body frame, rad/s"
    )
    raise ConfigError(f"{name}: expected {fault}. {remedy or advice}.")


def check_turning(logs: Sequence[Log]) -> None:
    """Check that the logs turn enough about the x and y axes for a fit of the rotation."""
    rates = np.max([np.std(log.ang_vel[:, :2], axis=0) for log in logs], axis=0, initial=0.0)
    require(
        np.all(rates >= MIN_TURN_RATE),
        f"expected a flight that turns about x and y, got body rates whose standard deviations are "
        f"{rates[0]:.2g} and {rates[1]:.2g} rad/s. Take a log of a flight with changes of direction.",
    )


class Law(NamedTuple):
    """Result of checking a law of mechanics in a log."""

    fault: str
    """Description of the violation; empty for none."""
    has_motion: bool
    """Whether the log contains the motion that the law describes."""


def _check_laws(t: NDArray, data: Mapping[str, NDArray], derived_keys: tuple[str, ...]) -> list[Law]:
    upward = float(np.median(rotate(data["quat"], Z_AXIS)[:, 2]))
    fault = f"a thrust that points up in most samples, got {upward:.2f} as the median of its z component"
    laws = [Law("" if upward > 0 else fault, True)]
    for pair in (*(pair for pair, _ in _rate_pairs(t, data, derived_keys)), _thrust_pair(t, data)):
        ratios = pair.ratios()
        ratio_list = ", ".join("no motion" if np.isnan(x) else f"{x:.3g}" for x in ratios)
        fault = (
            f"{pair.requirement}, got ratios of measured to expected changes of {ratio_list} on x, y, z, where 1 is "
            "right"
        )
        laws.append(Law("" if pair.agrees() else fault, not np.all(np.isnan(ratios))))
    return laws


def _rate_pairs(t: NDArray, data: Mapping[str, NDArray], derived_keys: tuple[str, ...]) -> Iterator[tuple[Pair, int]]:
    if "vel" not in derived_keys:
        width, (change, expected) = _window_changes(t, 0.2, data["pos"], integrate(data["vel"], t))
        yield Pair("a velocity that moves the position", change, expected, 0.01), width
    if "ang_vel" not in derived_keys:
        angles = np.cumsum(body_rates(t, data["quat"]) * np.diff(t)[:, None], axis=0)
        angles = np.concatenate([np.zeros((1, 3)), angles])
        width, (change, expected) = _window_changes(t, 0.1, angles, integrate(data["ang_vel"], t))
        yield Pair("an angular velocity that turns the attitude", change, expected, 0.01), width


def _thrust_pair(t: NDArray, data: Mapping[str, NDArray]) -> Pair:
    # The thrust is proportional to the sum of the squared rotor speeds, scaled so that the median of its vertical
    # component is the weight. Without rotor speeds, its vertical component is the weight, unless the tilt is large.
    # Constant accelerations, such as from drag in cruise, cancel in the difference between consecutive windows.
    axis = rotate(data["quat"], Z_AXIS)
    if data["rotor_vel"].shape[1]:
        squares = np.sum(data["rotor_vel"] ** 2, axis=1)
        median_lift = float(np.median(squares * axis[:, 2]))
        thrust = GRAVITY_MAGNITUDE * squares / median_lift if median_lift > 0 else np.zeros(len(t))
        is_flying = squares > np.median(squares) / 2
    else:
        thrust, is_flying = GRAVITY_MAGNITUDE / np.maximum(axis[:, 2], 0.3), np.ones(len(t), bool)
    expected = integrate(thrust[:, None] * axis - [0, 0, GRAVITY_MAGNITUDE], t)
    n_on_ground = np.cumsum(~is_flying)[:, None] * np.ones(3)
    width, (measured, expected, n_on_ground) = _window_changes(t, 0.25, data["vel"], expected, n_on_ground)
    is_airborne = (n_on_ground[width:, 0] == 0) & (n_on_ground[:-width, 0] == 0)
    if not np.any(is_airborne):
        return Pair("", np.zeros((1, 3)), np.zeros((1, 3)), 0.1)
    measured, expected = ((x[width:] - x[:-width])[is_airborne] for x in (measured, expected))
    if not data["rotor_vel"].shape[1]:
        measured = measured * [1, 1, 0]  # Without speeds, changes along z are not predicted.
    return Pair("accelerations that follow from thrust and gravity", measured, expected, 0.1)


def _window_changes(t: NDArray, duration: float, *series: NDArray) -> tuple[int, list[NDArray]]:
    dt = float(np.median(np.diff(t)))
    width = min(max(1, round(duration / dt)), len(t) - 1)
    has_no_gap = t[width:] - t[:-width] < 1.5 * width * dt
    return width, [(x[width:] - x[:-width]) * has_no_gap[:, None] for x in series]


def _diverged_windows(pair: Pair, size: int) -> NDArray:
    motion, error = (np.linalg.norm(x, axis=-1) for x in (pair.measured, pair.expected - pair.measured))
    typical_motion, is_diverged = max(float(np.median(motion)), pair.floor / 2), np.zeros(len(motion), bool)
    for k in range(0, len(motion), size):
        part = slice(k, k + size)
        is_diverged[part] = np.median(error[part]) > DIVERGED_ERROR * max(
            typical_motion, float(np.median(motion[part]))
        )
    return is_diverged


def _propose_remedies(
    data: Mapping[str, NDArray], derived_keys: tuple[str, ...]
) -> Iterator[tuple[str, Mapping[str, NDArray]]]:
    def scale_columns(**factors: float | Sequence[float]) -> Mapping[str, NDArray]:
        return {**data, **{key: data[key] * np.asarray(x) for key, x in factors.items()}}

    # Units of position and velocity.
    for (unit, x), (speed_unit, y) in product(LENGTH_UNITS.items(), repeat=2):
        if "vel" in derived_keys and x != y:
            continue
        if y == 1 or "vel" in derived_keys:
            remedy_text = f"The position seems to be in {unit}: give metres_per_unit={x:g}"
        elif x == 1:
            remedy_text = f"The velocity seems to be in {speed_unit}/s: give speed_per_unit={y:g}"
        else:
            factors = f"metres_per_unit={x:g} and speed_per_unit={y:g}"
            remedy_text = f"Position and velocity seem to be in {unit} and {speed_unit}/s: give {factors}"
        if (x, y) != (1, 1):
            yield remedy_text, scale_columns(pos=x, vel=y)
    # Unit of the angular velocity.
    degrees = math.pi / 180
    yield (
        f"The angular velocity seems to be in degrees per second: give rad_per_unit={degrees:.6g}",
        scale_columns(ang_vel=degrees),
    )
    # Signs of the angles, or order and sense of the quaternions.
    if "quat" in derived_keys:
        angles = np.asarray(rotation.to_rpy(jnp.asarray(data["quat"])))
        for signs, x in product(product((1, -1), repeat=3), (1.0, degrees)):
            names = ",".join(
                ("-" if s < 0 else "") + key for s, key in zip(signs, ("roll", "pitch", "yaw"), strict=True)
            )
            turned_quat = np.asarray(rotation.from_rpy(jnp.asarray(angles * np.array(signs))), np.float64)
            remark = "" if x == 1 else f", and the angular velocity in degrees per second: give rad_per_unit={x:.6g}"
            yield (
                f"The angles seem to be rpy={names}, with names of your columns{remark}",
                {**scale_columns(ang_vel=x), "quat": turned_quat},
            )
    else:
        xyzw_quat, inverse = data["quat"][:, [1, 2, 3, 0]], (-1, -1, -1, 1)
        yield (
            "The quaternions seem to be in the order w, x, y, z: name them in the order x, y, z, w",
            {**data, "quat": xyzw_quat},
        )
        yield (
            "The quaternions seem to be world to body: give the signs quat=-qx,-qy,-qz,qw",
            scale_columns(quat=inverse),
        )
        yield (
            "The quaternions seem to be in the order w, x, y, z and world to body: give quat=-qx,-qy,-qz,qw",
            {**data, "quat": xyzw_quat * np.array(inverse)},
        )
    # Axes that point down.
    down_axes = (1, -1, -1)
    yield (
        "z seems to point down, in world and body: give the signs pos=x,-y,-z vel=vx,-vy,-vz quat=qx,-qy,-qz,qw "
        "ang_vel=wx,-wy,-wz",
        scale_columns(pos=down_axes, vel=down_axes, quat=(*down_axes, 1), ang_vel=down_axes),
    )
    yield (
        "z seems to point down: give the signs pos=x,y,-z vel=vx,vy,-vz",
        scale_columns(pos=(1, 1, -1), vel=(1, 1, -1)),
    )
    # Order and signs of the axes of one quantity.
    for key, noun, factor, factor_advice in (
        ("vel", "velocity", 1.0, ""),
        ("ang_vel", "angular velocity", 1.0, ""),
        ("ang_vel", "angular velocity", degrees, f" and rad_per_unit={degrees:.6g}"),
        ("pos", "position", 1.0, ""),
    ):
        if key in derived_keys:
            continue
        for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
            fields = getattr(Columns(), key)
            names = ",".join(("-" if sign < 0 else "") + fields[k] for k, sign in zip(order, signs, strict=True))
            yield (
                f"The {noun} fits as {key}={names}{factor_advice}, with names of your columns",
                {**data, key: data[key][:, order] * signs * factor},
            )
