"""Kernels on the host: source compiled by the C++ compiler that is there, called by XLA."""

from __future__ import annotations

import ctypes
import functools
import os
import platform
import shlex
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from crazysim import jaxcompat
from crazysim.engine import dump, kernel_cache
from crazysim.engine.errors import KernelError
from crazysim.engine.kernel import Kernel
from crazysim.errors import ConfigError
from crazysim.version import __version__

FLAGS = ("-std=c++17", "-O2", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-shared",
         "-fPIC", "-fvisibility=hidden", "-pthread", "-nostdinc++", "-w")  # fmt: skip
"""Options of the compiler, before those of the variable CXXFLAGS. Products and sums may be contracted; no option
assumes that there is no NaN."""

TIMEOUT = 300.0
"""Time that the compiler may take, s, unless the variable CRAZYSIM_COMPILE_TIMEOUT says otherwise."""

CPU_INFO = Path("/proc/cpuinfo")
"""File in which Linux lists the features of the CPU."""

Launch = Callable[[int, Array, Sequence[Array], Sequence[Any]], list[Array]]
"""Number of lanes, number of steps (1,), inputs, and shapes and types of outputs, to outputs."""


def compiled(kernel: Kernel) -> Launch:
    """Compile a kernel, and return the function that calls it.

    Raises:
        KernelError: If the compiler refuses it or takes too long, with its message.
    """
    name = target(kernel)

    def launch(n_lanes: int, count: Array, inputs: Sequence[Array], outputs: Sequence[Any]) -> list[Array]:
        run = jax.ffi.ffi_call(name, list(outputs), input_output_aliases=kernel.aliases())
        return list(run(np.asarray([n_lanes], np.int32), count, *inputs))

    return launch


@functools.cache
def compiler() -> str | None:
    """Return the C++ compiler: that of the variable CXX, else the first that is found; None if there is none."""
    return next(
        (path for name in (os.environ.get("CXX"), "g++", "clang++") if name and (path := shutil.which(name))), None
    )


def command() -> list[str]:
    """Return the compiler's command up to the names of files.

    Raises:
        KernelError: If there is no compiler.
    """
    path = compiler()
    if path is None:
        raise KernelError("no C++ compiler was found; install g++ or clang++, or set CXX")
    return [path, *FLAGS, *shlex.split(os.environ.get("CXXFLAGS", "")), "-I", jaxcompat.ffi_include_folder()]


def target(kernel: Kernel) -> str:
    """Compile a kernel, unless that was done before, and return the name that XLA calls it by.

    The name holds the key, so that a program in JAX's own cache never finds a kernel for another machine.

    Raises:
        KernelError: If the compiler refuses it or takes too long, or the library cannot be loaded.
    """
    words = command()
    if dump.enabled():
        dump.write("kernel.cpp", f"// {shlex.join(words)} -x c++ -\n{kernel.text}")
    key = kernel_cache.digest(*words, toolchain(tuple(words)), kernel.text)
    name = f"crazysim_advance_{key}"
    if name not in _LOADED:
        library = _library(words, key, kernel.text)
        with _LOCK:
            if name not in _LOADED:
                jaxcompat.register_host_target(name, library.crazysim_advance)
                _LOADED[name] = library
    return name


_LOADED: dict[str, ctypes.CDLL] = {}
"""Libraries by the name of their kernel."""
_LOCK = threading.Lock()


@functools.cache
def toolchain(words: tuple[str, ...]) -> str:
    """Return everything besides source and options that compiled code depends on.

    That is the compiler's version, the instruction set that ``-march=native`` stands for here, the C library, and the
    versions of JAX and of this package.
    """
    # Asked for its steps, a compiler prints its version and the options that -march=native is replaced by.
    steps = _run([*words, "-fsyntax-only", "-x", "c++", os.devnull, "-###"], "")
    libc = " ".join(platform.libc_ver())
    return "\n".join([steps.stdout, steps.stderr, cpu_features(), libc, jaxcompat.versions(), __version__])


def cpu_features() -> str:
    """Return the architecture of the CPU and, where the system lists them, its features."""
    try:
        lines = CPU_INFO.read_text().splitlines()
    except OSError:
        lines = []
    listed = next((line for line in lines if line.split(":")[0].strip().lower() in ("flags", "features")), "")
    return f"{platform.machine()} {platform.processor()} {listed}"


def _library(words: Sequence[str], key: str, source: str) -> ctypes.CDLL:
    """Return a kernel's library: from the cache, or compiled."""
    place = kernel_cache.folder()
    for path in kernel_cache.find(place, key):
        library = _loaded(path)
        if library is not None:
            return library
    for where in dict.fromkeys((place, kernel_cache.temporary())):  # code in a shared folder may not be executable
        library = _loaded(_compile(words, key, source, where))
        if library is not None:
            return library
    raise KernelError(f"the kernel that {words[0]} compiled cannot be loaded; check that it compiles for this machine")


def _loaded(path: Path) -> ctypes.CDLL | None:
    """Return a library, or None if it cannot be loaded or holds no kernel."""
    try:
        library = ctypes.CDLL(str(path))
    except OSError:
        return None
    return library if hasattr(library, "crazysim_advance") else None


def _compile(words: Sequence[str], key: str, source: str, place: Path) -> Path:
    made = place / f"{key}.{os.getpid()}.{threading.get_ident()}.tmp"
    try:
        done = _run([*words, "-x", "c++", "-", "-o", str(made)], source)
        if done.returncode:
            raise KernelError(f"{words[0]} refused the kernel: {done.stderr.strip()[:2000]}")
        return kernel_cache.store(place, key, made)
    except OSError as error:
        raise KernelError(f"{words[0]} left no library: {error}") from error
    finally:
        made.unlink(missing_ok=True)


def _run(words: Sequence[str], source: str) -> subprocess.CompletedProcess[str]:
    """Run the compiler in a process group of its own, which a timeout ends with all its children."""
    given = os.environ.get("CRAZYSIM_COMPILE_TIMEOUT", TIMEOUT)
    try:
        limit = float(given)
    except ValueError:
        raise ConfigError(f"expected seconds in CRAZYSIM_COMPILE_TIMEOUT, got {given!r}; set a number") from None
    pipe = subprocess.PIPE
    try:
        process = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    except OSError as error:
        raise KernelError(f"{words[0]} cannot be run: {error}") from error
    try:
        out, err = process.communicate(source, limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        raise KernelError(
            f"{words[0]} took longer than {limit:g} s; set CRAZYSIM_COMPILE_TIMEOUT to a larger number of seconds"
        ) from None
    return subprocess.CompletedProcess(list(words), process.returncode, out, err)
