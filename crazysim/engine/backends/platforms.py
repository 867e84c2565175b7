"""Compilation of kernels for the platforms that have them: NVIDIA GPUs, and CPUs with a C++ compiler."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
from jax import Array

from crazysim.engine import jaxcompat
from crazysim.engine.backends import cuda, native
from crazysim.engine.backends.frame import Kernel
from crazysim.engine.backends.native import Launch
from crazysim.engine.sharding import Location

TARGETS = {"cpu": "host", "gpu": "cuda"}
"""Targets of kernels by platform."""


def compile_kernel(kernel: Kernel, location: Location) -> Launch:
    """Compile a kernel for some devices, and return the function that calls it.

    Args:
        kernel: The kernel, written for the target of the platform.
    """
    return cuda.compile_kernel(kernel, location.devices) if location.platform == "gpu" else native.HostLaunch(kernel)


def _result_shapes(*args: Any, kernels: Any, n: int) -> list[jax.ShapeDtypeStruct]:
    del args
    return kernels.result_shapes(n)


def _launch(platform: str, count: Array, *inputs: Array, kernels: Any, n: int) -> list[Array]:
    return kernels.get_launch(platform)(kernels.n_lanes(n), count, inputs, kernels.result_shapes(n))


launch_p = jaxcompat.primitive_by_platform(
    "crazysim_kernel", _result_shapes, {"cpu": partial(_launch, "cpu"), "cuda": partial(_launch, "gpu")}
)
"""Primitive that calls a kernel: it takes the number of steps and the inputs, and returns the outputs.

Its parameters are ``kernels``, with the methods ``get_launch(platform)``, ``n_lanes(n)`` and ``result_shapes(n)``, and
``n``, the number of worlds or of whatever else the kernels are called for.
"""


def describe_kernel(kernel: Kernel, platform: str, devices: Sequence[jax.Device] | None) -> str:
    """Return the compiler of a kernel, or for a GPU its threads, registers and spilled bytes."""
    if platform != "gpu":
        return f"compiled by {native.compiler()}"
    device = cuda.weakest_device(devices)
    if device is None:
        return f"compiled for {cuda.DEFAULT_ARCHITECTURE}; this machine has no GPU"
    fitted_kernel = cuda.fit_registers(kernel, device)
    # A kernel with much code has more threads a block if there are more drones than a GPU runs at once.
    widened_kernel, resources = cuda.widen_blocks(fitted_kernel, device), cuda.resources(fitted_kernel, device)
    is_widened = widened_kernel is not fitted_kernel
    widened_text = f", {widened_kernel.threads} from {cuda.RESIDENT_LANES:,} drones on" if is_widened else ""
    return (
        f"{fitted_kernel.threads} threads a block{widened_text}, {resources.registers} registers, "
        f"{resources.spilled_bytes} bytes spilled"
    )
