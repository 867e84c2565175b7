"""Time and memory of an exported policy on a microcontroller, from a count of its operations.

The cycles are upper bounds. They were counted with the instructions that exported headers execute when
arm-none-eabi-gcc 12.2 compiles them with -Os and newlib, at the timings of the Cortex-M4 (ARM DDI 0439): loads and
stores 2 cycles, fused multiply-add 3, division 14, branches 4, without overlap. Waits for flash memory come on top.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from crazysim.lab.export.policies import policy_numbers
from crazysim.lab.export.rl_tools import N_MEMORY, SHAPES
from crazysim.train.networks import Policy

CLOCK_RATE = 168e6
"""Clock of the Cortex-M4 in a Crazyflie, Hz."""
SIGMOID_CYCLES, TANH_CYCLES = 150, 200
"""Cycles of a sigmoid and a tanh."""
MULTIPLY_ADD_CYCLES, RAPTOR_MULTIPLY_ADD_CYCLES = 17, 10
"""Cycles of a multiplication and an addition in the loops of ``to_c`` and of ``weights_to_c``."""


def cost_text(policy: Policy | Mapping[str, np.ndarray], meta: Mapping[str, Any] | None = None) -> str:
    """Describe time and memory of a policy in C on a Cortex-M4 at 168 MHz.

    Args:
        policy: A trained policy, or weights of RAPTOR's shape.
        meta: Description of its inputs and outputs; None for weights.
    """
    if not isinstance(policy, Policy):
        shapes = list(SHAPES.values())
        n_weights = sum(math.prod(shape) for shape in shapes)
        n_multiply_adds = sum(math.prod(shape) for shape in shapes if len(shape) > 1)
        return _describe(n_weights, n_multiply_adds, RAPTOR_MULTIPLY_ADD_CYCLES, 2 * N_MEMORY, N_MEMORY, 3 * N_MEMORY)
    numbers = policy_numbers(policy, {} if meta is None else meta)
    dense = [*(x for gate in numbers.gru for x in gate), *(x for layer in numbers.layers for x in layer)]
    kernels = [layer for layers in numbers.convolutions for layer in layers]
    sizes = [[len(bias) for _, bias in layers] for layers in numbers.convolutions]
    images = [list(image.shapes(n)) for image, n in zip(numbers.images, sizes, strict=True)]
    n_pixels = [math.prod(shape) for shapes in images for shape in shapes[1:]]
    n_multiply_adds = sum(x.size for x in dense if x.ndim > 1)
    n_multiply_adds += sum(n * len(weight) for n, (weight, _) in zip(n_pixels, kernels, strict=True))
    n_weights = sum(x.size for x in [*dense, *(x for kernel in kernels for x in kernel)]) + 2 * len(numbers.mean)
    n_memory, widths = numbers.n_memory, [len(bias) for _, bias in numbers.layers]
    n_floats = numbers.n_inputs + 2 * n_memory + sum(widths) + sum(math.prod(x) for shapes in images for x in shapes)
    return _describe(n_weights, n_multiply_adds, MULTIPLY_ADD_CYCLES, 2 * n_memory, n_memory + sum(widths), n_floats)


def _describe(n_weights: int, n_multiply_adds: int, cycles: int, n_sigmoids: int, n_tanhs: int, n_floats: int) -> str:
    seconds = (cycles * n_multiply_adds + SIGMOID_CYCLES * n_sigmoids + TANH_CYCLES * n_tanhs) / CLOCK_RATE
    return (
        f"{n_multiply_adds:,} multiply-adds, {n_sigmoids} sigmoids and {n_tanhs} tanh: at most {1e6 * seconds:,.0f} us "
        f"on a Cortex-M4 at 168 MHz, with {4 * n_weights:,} bytes of flash and {4 * n_floats:,} of memory"
    )
