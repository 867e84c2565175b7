"""AIMotionLab's gain-scheduled path controller, with gains that are polynomials of the speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine.pytree import PyTree, as_parameter, leaf
from crazysim.errors import ConfigError
from crazysim.lab.vehicles.car_params import CarParams
from crazysim.lab.vehicles.car_state import CarState
from crazysim.lab.vehicles.following import PathController, PathState
from crazysim.lab.vehicles.model import VehicleModel
from crazysim.rotation import clip, safe_arctan2

LATERAL_GAINS = {
    "aiml_apr24": ((0.00127, -0.00864, 0.0192, 0.0159), (0.172, -1.17, 2.59, 2.14), (0.00423, 0.0948, 0.463, 0.00936)),
    "aiml_head": ((0.00127, -0.00864, 0.0192, 0.0159), (0.172, -1.17, 2.59, 5.14), (0.00423, 0.0948, 0.463, 0.00936)),
}
"""Gains of integral, offset and its rate as polynomials of the speed, highest power first. Sources:
AIMotionLab-Virtual, commit ea392436, aiml_virtual/controller/car_controller.py, and commit fc1bc3e0,
aiml_virtual/controller/car_lpv_controller.py."""
LONGITUDINAL_GAINS = ((0.0010, -0.0132, 0.4243), (-0.0044, 0.0563, 0.0959))
"""Gains of lag and speed error as polynomials of p (see ``LPV``), highest power first. Sources as above."""
INTEGRAL_FREQ, INTEGRAL_MAX, RATE_WEIGHT = 40, 0.1, 0.5
"""Rate of the controller to which the integral's gain refers, Hz; limit of the integral, m; weight of the newest
difference in the smoothed rate of the offset. Sources as above."""


class LPVGains(PyTree):
    """Gains of ``LPV``."""

    feedforward: Array = leaf("parameter", 1, (1,))
    """Steering angle per signed curvature, rad m. (1,)"""
    period: Array = leaf("parameter", 1, (1,))
    """Period of the controller, s. (1,)"""


class LPVMemory(PyTree):
    """Memory of ``LPV``, whose docstring defines the offset e."""

    integral: Array = leaf("member", 1)
    """Sum of e at the ticks, scaled to ``INTEGRAL_FREQ``, m. (n_worlds, n_members, 1)"""
    offset: Array = leaf("member", 1)
    """e at the last tick, m. (n_worlds, n_members, 1)"""
    offset_rate: Array = leaf("member", 1)
    """Smoothed rate of e, m/s. (n_worlds, n_members, 1)"""
    started: Array = leaf("member", 1)
    """One after the first tick, zero before. (n_worlds, n_members, 1)"""


class LPV(PathController):
    """Linear parameter-varying control of AIMotionLab's cars: gains that are polynomials of the speed.

    With the distance e of the path from the car, positive if the path is to the left, the sum q of e, the smoothed rate
    e' of e, and the forward speed v:

        steer = -heading_error + k1(v) q + k2(v) e + k3(v) e' + f curvature

    Let p be ``|cos(heading_error + slip) / cos(slip) / (1 - curvature offset)|``, and l the lag behind a reference by
    time. The motor reference is the value that holds the speed ``v_ref / p``, plus ``kl1(p) l + kl2(p) (v_ref / p -
    v)``.

    Gains and feed-forward f are published (``LATERAL_GAINS``, ``LONGITUDINAL_GAINS``). The lab uses the absolute value
    of the curvature, which steers the wrong way in curves to one side; here the curvature is signed. Forwards only, for
    the F1TENTH cars.
    """

    can_reverse: ClassVar[bool] = False
    lateral: Sequence[Sequence[float]] = LATERAL_GAINS["aiml_head"]
    """Gains k1, k2, k3 as polynomials of the speed, highest power first."""
    longitudinal: Sequence[Sequence[float]] = LONGITUDINAL_GAINS
    """Gains kl1, kl2 as polynomials of p, highest power first; in place of ``position_gain`` and ``speed_gain``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("position_gain", "speed_gain"):
            if getattr(self, name) != getattr(PathController, name):
                raise ConfigError(f"expected no {name} of LPV, got {getattr(self, name)}. Use longitudinal=.")

    def gains(self, vehicle: VehicleModel, car: CarParams, freq: int) -> LPVGains:
        """Return the gains; the feed-forward is ``(m / C_f) (1 - (l_r C_r - l_f C_f) / m)``.

        m is the mass, C the cornering stiffness of an axle, and l its distance from the centre of mass.
        """
        m, front, rear = (float(np.asarray(x)[0]) for x in (car.mass, car.front, car.rear))
        stiffness_front, stiffness_rear = (float(x) for x in np.asarray(car.stiffness))
        feedforward = (
            m / stiffness_front * (1 - (rear * stiffness_rear - front * stiffness_front) / m)
            if stiffness_front
            else 0.0
        )
        return LPVGains(as_parameter(feedforward), as_parameter(1 / freq))

    def memory(self) -> LPVMemory:
        return LPVMemory(*[as_parameter(0.0) for _ in range(4)])

    def steering(
        self, state: CarState, tracking: PathState, memory: LPVMemory, gains: LPVGains, car: CarParams
    ) -> tuple[Array, LPVMemory]:
        right_offset, speed = -tracking.offset, state.body_vel[:1]
        integral = clip(memory.integral + INTEGRAL_FREQ * gains.period * right_offset, -INTEGRAL_MAX, INTEGRAL_MAX)
        raw_offset_rate = (right_offset - memory.offset) / gains.period
        offset_rate = memory.started * (memory.offset_rate + RATE_WEIGHT * (raw_offset_rate - memory.offset_rate))
        terms = (integral, right_offset, offset_rate)
        feedback = sum(polynomial(c, speed) * x for c, x in zip(self.lateral, terms, strict=True))
        steer = -tracking.heading_error + feedback + gains.feedforward * tracking.curvature
        return steer, LPVMemory(integral, right_offset, offset_rate, jnp.ones_like(memory.started))

    def driving(self, state: CarState, tracking: PathState, gains: LPVGains, car: CarParams) -> Array:
        vx, vy = state.body_vel[:1], state.body_vel[1:]
        slip = safe_arctan2(vy, jnp.abs(vx))
        curvature_factor = jnp.maximum(1 - tracking.curvature * tracking.offset, 0.2)
        p = jnp.maximum(jnp.abs(jnp.cos(tracking.heading_error + slip)) / (jnp.cos(slip) * curvature_factor), 0.2)
        speed = tracking.speed / p
        sign = speed / jnp.sqrt(speed * speed + car.slip_speed * car.slip_speed)
        holding_reference = (car.drive[1:2] * speed + car.drive[2:] * sign) / car.drive[:1]
        lag_gain, speed_gain = (polynomial(c, p) for c in self.longitudinal)
        return holding_reference + lag_gain * tracking.lag + speed_gain * (speed - vx)


def polynomial(coefficients: Sequence[float], x: Array) -> Array:
    """Return a polynomial, highest power first, at x. (...)"""
    value = jnp.full_like(x, coefficients[0])
    for c in coefficients[1:]:
        value = value * x + c
    return value
