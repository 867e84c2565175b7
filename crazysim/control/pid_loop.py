"""PID loops of the Crazyflie firmware, computed for three loops at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.drones import Airframe
from crazysim.engine.pytree import PyTree, as_parameter, leaf
from crazysim.rotation import clip

DEFAULT_INTEGRAL_MAX = 5000.0
"""Limit of the integral for loops of airframes that do not set it (``DEFAULT_PID_INTEGRATION_LIMIT``)."""


class PIDLoop(PyTree):
    """Gains and limits of three PID loops, each shared or one per drone.

    Gains ``ki`` or ``kd`` that are zero in all three loops are None; integral or derivative are then not computed.
    """

    kp: Array = leaf("parameter", 1)
    """Gains on the error, output per input. (3,)"""
    ki: Array | None = leaf("parameter", 1)
    """Gains on the integral of the error, output per input and s. (3,)"""
    kd: Array | None = leaf("parameter", 1)
    """Gains on the derivative of the measured values, output s per input. (3,)"""
    integral_max: Array | None = leaf("parameter", 1)
    """Limits of the integrals, input s; None without integrals. (3,)"""
    output_max: Array | None = leaf("parameter", 1)
    """Limits of the output; None for no limits. (3,)"""
    low_pass: Array | None = leaf("parameter", 1)
    """Coefficients b0, a1, a2 of the filter of the derivative, 1; None for no filter. (3,)"""

    @staticmethod
    def create(airframe: Airframe, path: str, freq: float) -> PIDLoop:
        """Return the loops in an airframe's table at ``path``, for loops that run at ``freq`` Hz."""
        table = airframe.table(path)
        gains = {key: airframe.value(f"{path}.{key}", (3,)) for key in ("kp", "ki", "kd")}
        ki, kd = (as_parameter(gains[key]) if np.any(gains[key]) else None for key in ("ki", "kd"))
        limit = airframe.value(f"{path}.integral_max", (3,)) if "integral_max" in table else [DEFAULT_INTEGRAL_MAX] * 3
        has_low_pass = kd is not None and "cutoff" in table
        return PIDLoop(
            kp=as_parameter(gains["kp"]),
            ki=ki,
            kd=kd,
            integral_max=None if ki is None else as_parameter(limit),
            output_max=as_parameter(airframe.value(f"{path}.output_max", (3,))) if "output_max" in table else None,
            low_pass=as_parameter(butterworth(float(airframe.value(f"{path}.cutoff", ())), freq))
            if has_low_pass
            else None,
        )


class PIDLoopMemory(PyTree):
    """Memory of three PID loops. A field is None if the loops have no integral, no derivative or no filter."""

    integral: Any = leaf("drone", 1)
    """Integrals of the error, input s. (n_worlds, n_drones, 3)"""
    measured: Any = leaf("drone", 1)
    """Measured values at the last tick. (n_worlds, n_drones, 3)"""
    delays: Any = leaf("drone", 2)
    """Last two internal values of the filter of the derivative, latest first. (n_worlds, n_drones, 2, 3)"""

    @staticmethod
    def create(loop: PIDLoop) -> PIDLoopMemory:
        """Return the memory of one drone before the first tick."""
        return PIDLoopMemory(
            integral=None if loop.ki is None else np.zeros(3),  # type: ignore[arg-type]
            measured=None if loop.kd is None else np.zeros(3),  # type: ignore[arg-type]
            delays=None if loop.low_pass is None else np.zeros((2, 3)),  # type: ignore[arg-type]
        )

    def with_first_measurement(self, measured: Array, started: Array) -> PIDLoopMemory:
        """Return the memory with ``measured`` (3,) as the last measured values where the loops have not started."""
        if self.measured is None:
            return self
        return self.replace(measured=jnp.where(started, self.measured, measured))

    def reset_where(self, mask: Array, measured: Array, resets_filter: bool = True) -> PIDLoopMemory:
        """Return the memory, with zero integrals and new last measured values where a mask is True.

        Args:
            mask: True where the loops are reset. (1,)
            measured: New last measured values. (3,)
            resets_filter: Whether to reset the filter of the derivative too.
        """
        return PIDLoopMemory(
            integral=None if self.integral is None else jnp.where(mask, 0.0, self.integral),
            measured=None if self.measured is None else jnp.where(mask, measured, self.measured),
            delays=jnp.where(mask, 0.0, self.delays) if resets_filter and self.delays is not None else self.delays,
        )


def pid_step(
    error: Array,
    measured: Array,
    memory: PIDLoopMemory,
    freq: float,
    *,
    loop: PIDLoop,
    is_angle: Sequence[bool] = (False, False, False),
) -> tuple[Array, PIDLoopMemory]:
    """Return the outputs of three PID loops, and their memory after a tick.

    The measured value is differentiated, not the error, so that a step of the setpoint causes no peak of the output.
    Integral and output are limited. Source: ``pidUpdate`` in pid.c of bitcraze/crazyflie-firmware, commit 2a18fc29. Its
    feedforward of the setpoint is left out, because the feedforward gains are zero on every platform.

    Args:
        error: Desired minus measured values. (..., 3)
        measured: Measured values. (..., 3)
        freq: Rate, Hz.
        loop: Gains and limits, shared or with the leading axes of the error.
        is_angle: Whether the loops are of angles in degrees, which wrap around.

    Returns:
        Outputs (..., 3); the memory.
    """
    error = _wrap_angle(error, is_angle)
    output = loop.kp * error
    # Derivative of the measured value, which does not react to jumps of the setpoint.
    if loop.kd is not None:
        derivative = _wrap_angle(memory.measured - measured, is_angle) * freq
        memory = memory.replace(measured=measured)
        if loop.low_pass is not None:
            derivative, delays = _low_pass(derivative, memory.delays, loop.low_pass)
            memory = memory.replace(delays=delays)
        output = output + loop.kd * derivative
    # Integral within its limits.
    if loop.ki is not None:
        integral_max: Any = loop.integral_max
        integral = clip(memory.integral + error / freq, -integral_max, integral_max)
        memory = memory.replace(integral=integral)
        output = output + loop.ki * integral
    return (output if loop.output_max is None else clip(output, -loop.output_max, loop.output_max)), memory


def continue_integral(memory: PIDLoopMemory, output: Array, desired_output: Array, *, loop: PIDLoop) -> PIDLoopMemory:
    """Return the memory with integrals that give desired outputs, as far as the limits of the integrals allow.

    Args:
        output: Outputs with this memory. (3,)
        desired_output: Desired outputs. (3,)
    """
    integral_max: Any = loop.integral_max
    if loop.ki is None:
        return memory
    missing_integral = jnp.where(loop.ki == 0, 0.0, (desired_output - output) / jnp.where(loop.ki == 0, 1.0, loop.ki))
    return memory.replace(integral=clip(memory.integral + missing_integral, -integral_max, integral_max))


def _low_pass(sample: Array, delays: Array, coefficients: Array) -> tuple[Array, Array]:
    b0, a1, a2 = coefficients[..., 0:1], coefficients[..., 1:2], coefficients[..., 2:3]
    delay_1, delay_2 = delays[..., 0, :], delays[..., 1, :]
    new_delay = sample - delay_1 * a1 - delay_2 * a2
    return b0 * (new_delay + 2 * delay_1 + delay_2), jnp.stack([new_delay, delay_1], axis=-2)


def _wrap_angle(x: Array, is_angle: Sequence[bool]) -> Array:
    if not any(is_angle):
        return x
    correction = jnp.where(x > 180, 360.0, jnp.where(x < -180, -360.0, 0.0))
    return jnp.where(jnp.asarray(is_angle), x - correction, x)


def butterworth(cutoff: float, freq: float) -> list[float]:
    """Return the coefficients b0, a1, a2 of a low-pass Butterworth filter of order 2; ``b1 = 2 b0`` and ``b2 = b0``.

    The frequency is prewarped for the bilinear transform, so that the gain at the cutoff is 1/sqrt(2), as in
    ``lpf2pSetCutoffFreq`` in filter.c of bitcraze/crazyflie-firmware.

    Args:
        cutoff: Cutoff frequency, Hz.
        freq: Sampling rate, Hz.
    """
    k = math.tan(math.pi * cutoff / freq)
    scale = 1 / (1 + math.sqrt(2) * k + k * k)
    return [k * k * scale, 2 * (k * k - 1) * scale, (1 - math.sqrt(2) * k + k * k) * scale]
