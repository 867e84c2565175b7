"""Coefficients of a low-pass filter, for the filters of PID loops and of INDI."""

from __future__ import annotations

import math


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
