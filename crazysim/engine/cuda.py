"""Kernels on NVIDIA GPUs: CUDA source compiled by NVRTC, launched by XLA itself.

This is the one place that knows how a kernel comes to run on a GPU. NVRTC comes with JAX's CUDA packages; the PTX
that it makes goes into the compiled step as a custom call of XLA (``TARGET``), which hands it to the driver. No other
package, no compiler on the machine, and nothing of Python at run time takes part.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import importlib.util
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from crazysim.engine.kernel import BLOCK, Kernel

TARGET = "__gpu$xla.gpu.ptx"
"""What XLA calls a kernel that is given to it as PTX."""

OPTIONS = ("--std=c++17", "--fmad=true", "--prec-div=false", "--prec-sqrt=false", "--device-as-default-execution-space")
"""Division and square root to 2 and 1 units in the last place, as XLA has them; no other shortcut."""

BLOCKS_AT_ONCE = (8, 6)
"""How many blocks of 64 threads are tried to fit: 128 or 168 registers for each thread."""

WARP = 32
"""Threads that can look at each other's registers."""

DEFAULT_ARCHITECTURE = "compute_90"
"""What is compiled for where there is no GPU to ask."""


@dataclasses.dataclass(frozen=True)
class Resources:
    """What one thread of a compiled kernel takes."""

    registers: int
    """Registers."""
    spilled: int
    """Bytes that did not fit into registers."""


def call(kernel: Kernel, n_lanes: int, count: Array, inputs: Sequence[Array], outputs: Sequence[Any]) -> list[Array]:
    """Return what a kernel writes.

    Args:
        kernel: The kernel.
        n_lanes: Drones of all worlds.
        count: Number of steps. (1,)
        inputs: What it reads.
        outputs: Shapes and types of what it writes.
    """
    kernel = fitted(kernel) if architecture() is not DEFAULT_ARCHITECTURE else kernel
    of_block = (
        BLOCK // WARP * (WARP // kernel.group * kernel.group)
    )  # groups that a warp has no room for go to the next
    n_blocks = -(-n_lanes // of_block)
    launch = {"grid_x": n_blocks, "grid_y": 1, "grid_z": 1, "block_x": BLOCK, "block_y": 1, "block_z": 1}
    run = jax.ffi.ffi_call(TARGET, list(outputs), input_output_aliases=kernel.aliases())
    return list(
        run(
            np.asarray([n_lanes], np.int32),
            count,
            *inputs,
            name="advance",
            kernel_type="ptx",
            kernel_data=ptx(kernel, architecture()),
            shared_mem_bytes=np.int32(0),
            **{name: np.int32(size) for name, size in launch.items()},
        )
    )


@functools.cache
def architecture() -> str:
    """Return the virtual architecture of the GPU that is there."""
    try:
        capability = jax.devices("gpu")[0].compute_capability
    except RuntimeError:
        return DEFAULT_ARCHITECTURE
    return f"compute_{str(capability).replace('.', '')}"


@functools.cache
def fitted(kernel: Kernel) -> Kernel:
    """Return a kernel with as many blocks at once on a multiprocessor as its registers allow without spilling.

    More blocks hide more latency, until registers that no longer fit cost more than that.
    """
    candidates = [kernel, *(kernel.with_blocks(n) for n in BLOCKS_AT_ONCE)]
    with ThreadPoolExecutor(len(candidates)) as pool:  # the compiler takes a second for each, on one core
        least, *found = pool.map(resources, candidates)
    bearable = 16 if least.registers <= 224 else 256  # measured on an H200: docs/concepts/engine.md
    fitting = (c for c, r in zip(candidates[1:], found, strict=True) if r.spilled <= least.spilled + bearable)
    return next(fitting, kernel)


@functools.cache
def ptx(kernel: Kernel, arch: str) -> str:
    """Return a kernel's PTX.

    Raises:
        RuntimeError: If NVRTC is not there, or refuses the source, with what it said.
    """
    return _compile(kernel.text, arch, "PTX").decode()


@functools.cache
def resources(kernel: Kernel) -> Resources:
    """Return what a kernel takes on the GPU that is there, as the driver says."""
    image = _compile(kernel.text, architecture().replace("compute", "sm"), "CUBIN")
    driver = ctypes.CDLL("libcuda.so.1")
    module, function, number = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_int()
    jax.block_until_ready(jax.device_put(np.zeros(1), jax.devices("gpu")[0]))
    context = ctypes.c_void_p()
    _check(driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), 0))
    _check(driver.cuCtxPushCurrent_v2(context))
    try:
        _check(driver.cuModuleLoadData(ctypes.byref(module), image))
        _check(driver.cuModuleGetFunction(ctypes.byref(function), module, b"advance"))
        found = []
        for attribute in (4, 3):  # CU_FUNC_ATTRIBUTE_NUM_REGS, CU_FUNC_ATTRIBUTE_LOCAL_SIZE_BYTES
            _check(driver.cuFuncGetAttribute(ctypes.byref(number), attribute, function))
            found.append(number.value)
        _check(driver.cuModuleUnload(module))
    finally:
        driver.cuCtxPopCurrent_v2(ctypes.byref(context))
        driver.cuDevicePrimaryCtxRelease(0)
    return Resources(*found)


def _check(result: int) -> None:
    if result:
        raise RuntimeError(f"the CUDA driver answered error {result}")


@functools.cache
def nvrtc() -> ctypes.CDLL | None:
    """Return NVIDIA's run-time compiler, from JAX's CUDA packages or the system; None if it is not there."""
    found: list[str] = []
    for package in ("nvidia.cu13", "nvidia.cuda_nvrtc"):
        try:
            spec = importlib.util.find_spec(package)
        except ModuleNotFoundError:
            continue
        for folder in (spec.submodule_search_locations or []) if spec else []:
            found += sorted(map(str, Path(folder).glob("lib/libnvrtc.so.*")))
    for name in [*found, "libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so"]:
        if "builtins" in name or ".alt." in name:
            continue
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None


def _compile(source: str, arch: str, kind: str) -> bytes:
    library = nvrtc()
    if library is None:
        raise RuntimeError("NVRTC was not found; it comes with pip install 'jax[cuda13]' or 'jax[cuda12]'")
    program = ctypes.c_void_p()
    library.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"advance.cu", 0, None, None)
    try:
        options = [f"--gpu-architecture={arch}", *OPTIONS]
        result = library.nvrtcCompileProgram(
            program, len(options), (ctypes.c_char_p * len(options))(*(o.encode() for o in options))
        )
        size = ctypes.c_size_t()
        if result:
            library.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            library.nvrtcGetProgramLog(program, log)
            raise RuntimeError(f"NVRTC refused the kernel:\n{log.value.decode()[:2000]}")
        getattr(library, f"nvrtcGet{kind}Size")(program, ctypes.byref(size))
        out = ctypes.create_string_buffer(size.value)
        getattr(library, f"nvrtcGet{kind}")(program, out)
        return out.raw if kind == "CUBIN" else out.value
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))
