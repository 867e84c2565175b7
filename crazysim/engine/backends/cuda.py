"""Kernels on NVIDIA GPUs: CUDA source compiled by NVRTC, launched by XLA itself.

NVRTC comes with JAX's CUDA packages. Its PTX is part of the compiled step, in a custom call (``PTX_TARGET``) by which
XLA passes it to the driver. JAX's compilation cache therefore never returns a kernel for another GPU. Kernels need no
other package, no compiler on the machine, and no Python at run time. With ``CRAZYSIM_JAX_FALLBACKS=1`` a handler in
Python (``ffi_handlers``) launches kernels instead.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import importlib.util
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from crazysim.engine import jaxcompat
from crazysim.engine.backends import ffi_handlers, kernel_cache
from crazysim.engine.backends.exchange import WARP_THREADS
from crazysim.engine.backends.ffi_handlers import check_driver
from crazysim.engine.backends.frame import MIN_BLOCKS_PLACEHOLDER, Kernel, steps_per_interval
from crazysim.engine.backends.native import Launch
from crazysim.engine.errors import KernelError
from crazysim.engine.ir import dump

PTX_TARGET = "__gpu$xla.gpu.ptx"
"""XLA's name for a kernel that is passed to it as PTX."""

NVRTC_OPTIONS = ("--std=c++17", "--fmad=true", "--prec-div=false", "--prec-sqrt=false",
                 "--device-as-default-execution-space")  # fmt: skip
"""Options of NVRTC. Division is accurate to 2 units in the last place and the square root to 1, as in XLA; nothing else
is approximated."""

THREADS_TO_TRY = (512, 384)
"""Numbers of threads on a multiprocessor to try, in this order; each thread gets 128 or 168 registers."""

LARGE_KERNEL_THREADS = 256
"""Threads per block for kernels larger than the instruction cache, from ``RESIDENT_LANES`` lanes on. The threads of a
block execute the same code, so in a larger block more threads share each fetched instruction."""

INSTRUCTION_CACHE_BYTES = 96 * 2**10
"""Size of a compiled kernel from which it exceeds the instruction cache of a multiprocessor; measured on an H100."""

MAX_GRADIENT_MEMORY_BYTES = 2**30
"""Maximum memory for the states that the kernel of a gradient stores, bytes."""

RESIDENT_LANES = 2**16
"""Number of lanes that run at once on a GPU with 132 multiprocessors, about 500 on each. Gradients get memory for this
number of lanes."""

DEFAULT_ARCHITECTURE = "compute_90"
"""Architecture to compile for on a machine without a GPU."""


@dataclasses.dataclass(frozen=True)
class Resources:
    """Registers and memory of one thread of a compiled kernel."""

    registers: int
    """Number of registers."""
    spilled_bytes: int
    """Local memory, bytes: variables that did not fit into registers."""
    code_bytes: int
    """Size of the compiled kernel, bytes."""


def compile_kernel(kernel: Kernel, devices: Sequence[jax.Device] | None = None) -> Launch:
    """Compile a kernel for some GPUs, and return the function that launches it.

    Args:
        devices: GPUs that will run it; None for the GPUs of this machine.

    Raises:
        KernelError: If NVRTC is missing, or refuses the source, with its message.
    """
    device = weakest_device(devices)
    small_kernel = kernel if device is None else fit_registers(kernel, device)
    large_kernel = small_kernel if device is None else widen_blocks(small_kernel, device)
    ptx(small_kernel, architecture(device))  # raises its errors now instead of at the first launch

    def launch(n_lanes: int, count: Any, inputs: Sequence[Array], outputs: Sequence[Any]) -> list[Array]:
        sized_kernel = small_kernel if n_lanes < RESIDENT_LANES else large_kernel
        n_blocks, memory = -(-n_lanes // sized_kernel.lanes), []
        if sized_kernel.state_bytes:
            n_blocks, count, memory = _plan_memory(sized_kernel, n_lanes, int(count[0]))
        grid = {"grid_x": n_blocks, "grid_y": 1, "grid_z": 1}
        block = {"block_x": sized_kernel.threads, "block_y": 1, "block_z": 1}
        code = ptx(sized_kernel, architecture(device))
        target = _launching_handler() if jaxcompat.FALLBACKS else PTX_TARGET
        digest_attribute = {"digest": hashlib.sha256(code.encode()).hexdigest()} if jaxcompat.FALLBACKS else {}
        run = jax.ffi.ffi_call(target, [*outputs, *memory], input_output_aliases=sized_kernel.aliases())
        written = list(
            run(
                np.asarray([n_lanes], np.int32),
                count,
                *inputs,
                name="advance",
                kernel_type="ptx",
                kernel_data=code,
                shared_mem_bytes=np.int32(0),
                **digest_attribute,
                **{name: np.int32(size) for name, size in (grid | block).items()},
            )
        )
        return written[: len(outputs)]

    return launch


@functools.cache
def _launching_handler() -> str:
    ffi_handlers.register("crazysim_launch", "CUDA", ffi_handlers.launch_kernel)
    return "crazysim_launch"


def _plan_memory(kernel: Kernel, n_lanes: int, n_steps: int) -> tuple[int, np.ndarray, list[jax.ShapeDtypeStruct]]:
    # The numbers of steps are the number of all steps and the number of steps of an interval. If the memory would
    # exceed ``MAX_GRADIENT_MEMORY_BYTES``, there are fewer blocks, and each block processes several groups of lanes in
    # turn.
    interval = steps_per_interval(n_steps, min(n_lanes, RESIDENT_LANES) * kernel.state_bytes, MAX_GRADIENT_MEMORY_BYTES)
    n_states = interval + max(-(-n_steps // interval), 1)
    size = n_states * kernel.state_bytes * kernel.threads
    n_blocks = -(-n_lanes // kernel.lanes)
    n_rounds = -(-n_blocks // max(MAX_GRADIENT_MEMORY_BYTES // size, 1))
    n_blocks = -(-n_blocks // n_rounds)
    return n_blocks, np.asarray([n_steps, interval], np.int32), [jax.ShapeDtypeStruct((n_blocks, size // 4), np.uint32)]


def weakest_device(devices: Sequence[jax.Device] | None = None) -> jax.Device | None:
    """Return the GPU with the lowest compute capability, because its code runs on all GPUs; None without a GPU.

    Args:
        devices: GPUs to choose from; None for the GPUs of this machine.
    """
    if devices is None:
        try:
            devices = jax.local_devices(backend="gpu")
        except RuntimeError:
            return None
    gpus = [d for d in devices if d.platform == "gpu"]
    return min(gpus, key=jaxcompat.compute_capability) if gpus else None


def architecture(device: jax.Device | None) -> str:
    """Return the virtual architecture of a GPU; ``DEFAULT_ARCHITECTURE`` without a GPU."""
    return DEFAULT_ARCHITECTURE if device is None else f"compute_{jaxcompat.compute_capability(device)}"


@functools.cache
def fit_registers(kernel: Kernel, device: jax.Device) -> Kernel:
    """Return a kernel for the largest number of blocks on a multiprocessor at which hardly any register is spilled.

    More blocks hide more latency, but leave fewer registers to each thread. Spilled variables soon cost more time.
    """
    block_counts = dict.fromkeys(n // kernel.threads for n in THREADS_TO_TRY if n > kernel.threads)
    candidates = [kernel, *(kernel.with_blocks(n) for n in block_counts)]
    with ThreadPoolExecutor(len(candidates)) as pool:  # the compiler takes a second for each, on one core
        original, *others = pool.map(lambda c: resources(c, device), candidates)
    # Measured on an H200: docs/concepts/engine.md. Gradients with 168 registers and 248 spilled bytes are slower than
    # with 255 registers.
    spill_margin = 16 if original.registers <= 224 or kernel.state_bytes else 256
    suitable = (
        c
        for c, r in zip(candidates[1:], others, strict=True)
        if r.spilled_bytes <= original.spilled_bytes + spill_margin
    )
    return next(suitable, kernel)


def widen_blocks(kernel: Kernel, device: jax.Device) -> Kernel:
    """Return a kernel for many lanes: with larger blocks if its code exceeds the instruction cache.

    Kernels of gradients, of large worlds, and with few registers for each thread stay as they are.
    """
    keeps_size = kernel.state_bytes or kernel.group_size > WARP_THREADS or MIN_BLOCKS_PLACEHOLDER not in kernel.text
    return (
        kernel
        if keeps_size or resources(kernel, device).code_bytes <= INSTRUCTION_CACHE_BYTES
        else kernel.with_threads(LARGE_KERNEL_THREADS)
    )


@functools.cache
def ptx(kernel: Kernel, arch: str) -> str:
    if dump.is_enabled():
        dump.write(f"kernel.{arch}.cu", f"// NVRTC --gpu-architecture={arch} {' '.join(NVRTC_OPTIONS)}\n{kernel.text}")
    return compile_source(kernel.text, arch, "PTX").decode()


@functools.cache
def resources(kernel: Kernel, device: jax.Device) -> Resources:
    """Return the registers and memory that a kernel takes on a GPU, as its driver reports them."""
    image = compile_source(kernel.text, architecture(device).replace("compute", "sm"), "CUBIN")
    try:
        driver, ordinal = ctypes.CDLL("libcuda.so.1"), device.local_hardware_id
    except OSError as error:
        raise KernelError(f"the CUDA driver was not found: {error}") from error
    module, function, value = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_int()
    jax.block_until_ready(jax.device_put(np.zeros(1), device))  # the driver's context exists from here on
    handle, context = ctypes.c_int(), ctypes.c_void_p()
    check_driver(driver.cuDeviceGet(ctypes.byref(handle), ordinal))
    check_driver(driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), handle))
    check_driver(driver.cuCtxPushCurrent_v2(context))
    try:
        check_driver(driver.cuModuleLoadData(ctypes.byref(module), image))
        check_driver(driver.cuModuleGetFunction(ctypes.byref(function), module, b"advance"))
        values = []
        for attribute in (4, 3):  # CU_FUNC_ATTRIBUTE_NUM_REGS, CU_FUNC_ATTRIBUTE_LOCAL_SIZE_BYTES
            check_driver(driver.cuFuncGetAttribute(ctypes.byref(value), attribute, function))
            values.append(value.value)
        check_driver(driver.cuModuleUnload(module))
    finally:
        driver.cuCtxPopCurrent_v2(ctypes.byref(context))
        driver.cuDevicePrimaryCtxRelease(handle)
    registers, spilled_bytes = values
    return Resources(registers, spilled_bytes, code_bytes=len(image))


@functools.cache
def nvrtc() -> ctypes.CDLL | None:
    """Return NVIDIA's run-time compiler, from JAX's CUDA packages or the system; None if it is missing."""
    library_paths: list[str] = []
    for package in ("nvidia.cu13", "nvidia.cuda_nvrtc"):
        try:
            spec = importlib.util.find_spec(package)
        except ModuleNotFoundError:
            continue
        for folder in (spec.submodule_search_locations or []) if spec else []:
            library_paths += sorted(map(str, Path(folder).glob("lib/libnvrtc.so.*")))
    for name in [*library_paths, "libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so"]:
        if "builtins" in name or ".alt." in name:
            continue
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None


def compile_source(source: str, arch: str, kind: str) -> bytes:
    """Return the compiled image of a source, from the cache of kernels or from NVRTC.

    Args:
        kind: ``"PTX"`` or ``"CUBIN"``.
    """
    library = nvrtc()
    if library is None:
        raise KernelError("NVRTC was not found; it comes with pip install 'jax[cuda13]' or 'jax[cuda12]'")
    major, minor = ctypes.c_int(), ctypes.c_int()
    library.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    key = kernel_cache.digest(source, arch, kind, *NVRTC_OPTIONS, f"{major.value}.{minor.value}")
    cache_folder = kernel_cache.folder()
    for path in kernel_cache.find_files(cache_folder, key):
        with contextlib.suppress(OSError):  # another process has removed it
            return path.read_bytes()
    image = _compile_with_nvrtc(library, source, arch, kind)
    if cache_folder != kernel_cache.temporary_folder():
        with contextlib.suppress(OSError):  # its disk is full
            kernel_cache.store_file(cache_folder, key, image, f".{kind.lower()}")
    return image


def _compile_with_nvrtc(library: ctypes.CDLL, source: str, arch: str, kind: str) -> bytes:
    program = ctypes.c_void_p()
    library.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"advance.cu", 0, None, None)
    try:
        options = [f"--gpu-architecture={arch}", *NVRTC_OPTIONS]
        result = library.nvrtcCompileProgram(
            program, len(options), (ctypes.c_char_p * len(options))(*(o.encode() for o in options))
        )
        size = ctypes.c_size_t()
        if result:
            library.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            library.nvrtcGetProgramLog(program, log)
            raise KernelError(f"NVRTC refused the kernel:\n{log.value.decode()[:2000]}")
        getattr(library, f"nvrtcGet{kind}Size")(program, ctypes.byref(size))
        out = ctypes.create_string_buffer(size.value)
        getattr(library, f"nvrtcGet{kind}")(program, out)
        return out.raw if kind == "CUBIN" else out.value
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))
