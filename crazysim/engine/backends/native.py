"""Kernels on the host: source compiled by an installed C++ compiler, called by XLA."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.util
import math
import os
import platform
import re
import shlex
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any

import jax
import numpy as np
from jax import Array

from crazysim.engine import jaxcompat
from crazysim.engine.backends import kernel_cache
from crazysim.engine.backends.frame import Kernel, steps_per_interval
from crazysim.engine.cache import cpu_features
from crazysim.engine.errors import KernelError
from crazysim.engine.ir import dump
from crazysim.errors import ConfigError
from crazysim.startup import __version__

COMPILER_FLAGS = ("-std=c++17", "-O2", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math",
                  "-fwrapv", "-shared", "-fPIC", "-fvisibility=hidden", "-pthread", "-nostdinc++", "-w")  # fmt: skip
"""Options of the compiler; the options of the variable CXXFLAGS follow them. Products and sums may be contracted, and
no option assumes that there is no NaN. Integers wrap around (``-fwrapv``), as in XLA. NVRTC has no option for
that, so the source converts integers to unsigned integers before it adds them."""

ZIG_ARGUMENTS = ("cc", "-nostdlib", "-lc", "-lm", "-g0")
"""Arguments that make zig a compiler of kernels. As ``c++``, or without ``-nostdlib``, it would first compile libraries
that kernels do not need, for 20 s."""

MISSING_COMPILER = "no C++ compiler was found; run pip install 'crazysim[compiler]', install g++ or clang++, or set CXX"
"""Reason why there are no kernels on the host, and the remedy."""

COMPILE_TIMEOUT = 300.0
"""Time that the compiler may take, s, unless the variable CRAZYSIM_COMPILE_TIMEOUT says otherwise."""

LINES_IN_ONE_SECOND = 10_000
"""Lines of a kernel that takes at least 1 s to compile; the time grows with the square of the number of lines.

Measured with g++ 12 on one core: 20,000 lines take 5 s if they are matrix products, and 38 s if they are maxima. 40,000
lines of conditions take 94 s.
"""
SELECTING_LINE = re.compile(r"^.*\b(?:select_n_|max_|min_|clamp_|at_least|at_most)\(.*$", re.MULTILINE)
"""Lines of a kernel that select between numbers."""
SELECTING_LINE_WEIGHT = 2.4
"""Weight of a selecting line, in lines. By the measurements above 10,000 lines of conditions would take 94 s / 4^2 =
5.9 s, as long as 24,000 lines with the square law of ``LINES_IN_ONE_SECOND``."""

TEMPORARY_FOLDER_VARIABLES = ("TMPDIR", "ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")
"""Variables that name the folder of a compiler's temporary files."""

KILLING_SCRIPT = """exec 3<&0 </dev/null
(read -r _ <&3; kill -9 0) >/dev/null 2>&1 &
"$@" 3<&-
status=$?
kill -9 $!
exit $status"""
"""Script that runs a command. The script's input is a pipe from this process. When the pipe closes, at the latest when
this process ends in any way, the script kills the command and all its children."""

GRADIENT_MEMORY_BYTES = 256 * 1024
"""Memory for the states that a core stores for an interval of the backward pass, bytes; it fits in its caches."""

VECTOR_BYTES = 64
"""Size of the widest vector, bytes."""

Launch = Callable[[int, Any, Sequence[Array], Sequence[Any]], list[Array]]
"""Function that returns the outputs of a kernel. Its arguments are the number of lanes, the number of steps (1,), the
inputs, and the shapes and types of the outputs. For a kernel with backward pass the number of
steps must be a NumPy array."""


class HostLaunch:
    """A compiled kernel, which traced functions can call."""

    def __init__(self, kernel: Kernel):
        self._name, self._aliases, self._state_bytes = register_kernel(kernel), kernel.aliases(), kernel.state_bytes

    def __call__(self, n_lanes: int, count: Any, inputs: Sequence[Array], outputs: Sequence[Any]) -> list[Array]:
        if self._state_bytes:
            state_bytes = self._state_bytes * (VECTOR_BYTES // 4)  # states of all lanes of a vector
            interval = steps_per_interval(int(count[0]), state_bytes, GRADIENT_MEMORY_BYTES)
            count = np.append(count, np.int32(interval))
        run = jax.ffi.ffi_call(self._name, list(outputs), input_output_aliases=self._aliases)
        return list(run(np.asarray([n_lanes], np.int32), count, *inputs))

    def memory_function(self) -> Callable[[int, int, Any, int], int]:
        """Return the kernel as a function on memory, which does not use XLA and returns when the kernel is done.

        It takes the numbers of lanes and of steps, a ``bytes`` object with the addresses of inputs and outputs, one
        pointer after the other, and the number of inputs. It returns 0 if it could not allocate memory.
        """
        call = _LIBRARIES[self._name].crazysim_call
        call.restype = ctypes.c_int
        call.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_int]
        return call


@functools.cache
def compiler() -> str | None:
    """Return the C++ compiler: CXX if it is set, else g++, clang++ or zig; None if there is no compiler."""
    words = _split_variable("CXX")
    if not words:
        return next((path for name in ("g++", "clang++") if (path := shutil.which(name))), None) or _zig()
    path = shutil.which(words[0])
    if path is None:
        raise ConfigError(f"expected a C++ compiler in CXX, got {os.environ['CXX']!r}. Install it, or unset CXX.")
    return shlex.join([os.path.abspath(path), *words[1:]])


def _zig() -> str | None:
    package = importlib.util.find_spec("ziglang")
    folders = [] if package is None else package.submodule_search_locations or []
    return next(
        (shlex.join([path, *ZIG_ARGUMENTS]) for folder in folders if (path := shutil.which("zig", path=folder))), None
    )


def compiler_command(with_options: bool = True) -> list[str]:
    """Return the compiler's command without the names of files.

    Args:
        with_options: Whether to include CXXFLAGS.
    """
    program = compiler()
    if program is None:
        raise KernelError(MISSING_COMPILER)
    return [
        *shlex.split(program),
        *COMPILER_FLAGS,
        *_split_variable("CXXFLAGS" if with_options else ""),
        "-I",
        jaxcompat.ffi_include_folder(),
    ]


def _split_variable(variable: str) -> list[str]:
    text = os.environ.get(variable, "")
    try:
        return shlex.split(text)
    except ValueError as error:
        raise ConfigError(f"expected words in {variable}, got {text!r}: {error}. Correct the quotation.") from None


def time_limit() -> float:
    """Return the time that the compiler may take, s."""
    text = os.environ.get("CRAZYSIM_COMPILE_TIMEOUT", COMPILE_TIMEOUT)
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise ConfigError(f"expected seconds in CRAZYSIM_COMPILE_TIMEOUT, got {text!r}; set a number above 0")
    return seconds


def register_kernel(kernel: Kernel) -> str:
    """Compile a kernel, unless it was compiled before, and return the name by which XLA calls it.

    The name contains the key, so that a program in JAX's compilation cache never calls a kernel for another machine.

    Raises:
        KernelError: If the compiler refuses it or takes too long, or the library cannot be loaded.
    """
    words = compiler_command()
    if dump.is_enabled():
        dump.write("kernel.cpp", f"// {shlex.join(words)} kernel.cpp\n{kernel.text}")
    key = kernel_cache.digest(*words, toolchain(tuple(words)), kernel.text)
    name = f"crazysim_advance_{key}"
    if name not in _LIBRARIES:
        library = _get_library(words, key, kernel.text)
        with _LIBRARIES_LOCK:
            if name not in _LIBRARIES:
                jaxcompat.register_target(name, library.crazysim_advance, "cpu")
                _LIBRARIES[name] = library
    return name


_LIBRARIES: dict[str, ctypes.CDLL] = {}
"""Libraries by the name of their kernel."""
_LIBRARIES_LOCK = threading.Lock()


@functools.cache
def toolchain(words: tuple[str, ...]) -> str:
    """Return everything besides source and options that compiled code depends on.

    This is the compiler's version, the instruction set that ``-march=native`` selects here, the C library, and the
    versions of JAX and of this package.
    """
    # With -###, a compiler prints its version and the options that replace -march=native.
    with tempfile.TemporaryDirectory(dir=kernel_cache.temporary_folder(), ignore_cleanup_errors=True) as work_folder:
        # Clang prints the working directory, too.
        steps = _run_compiler(
            [*words, "-E", "-x", "c++", os.devnull, "-###"], Path(work_folder), time_limit(), cwd=os.sep
        )
    libc = " ".join(platform.libc_ver())
    return "\n".join([steps.stdout, steps.stderr, cpu_features(), libc, jaxcompat.versions(), __version__])


def _get_library(words: Sequence[str], key: str, source: str) -> ctypes.CDLL:
    cache_folder = kernel_cache.folder()
    for path in kernel_cache.find_files(cache_folder, key):
        library = _load_library(path)
        if library is not None:
            return library
    content, problem = _compile(words, source), None
    # The cache may be on a file system without permission to execute code.
    for folder in dict.fromkeys((cache_folder, kernel_cache.temporary_folder())):
        try:
            library = _load_library(kernel_cache.store_file(folder, key, content, ".so"))
        except OSError as error:
            problem = f"the kernel that {words[0]} compiled cannot be written: {error}; make room, or set TMPDIR"
            continue
        if library is not None:
            return library
    raise KernelError(
        problem or f"the kernel that {words[0]} compiled cannot be loaded; check that it compiles for this machine"
    )


def _load_library(path: Path) -> ctypes.CDLL | None:
    try:
        library = ctypes.CDLL(str(path))
    except OSError:
        return None
    return library if hasattr(library, "crazysim_call") else None


def _compile(words: Sequence[str], source: str) -> bytes:
    seconds, n_lines = time_limit(), source.count("\n")
    if n_lines + (SELECTING_LINE_WEIGHT - 1) * len(SELECTING_LINE.findall(source)) > LINES_IN_ONE_SECOND * math.sqrt(
        seconds
    ):
        raise KernelError(
            f"a kernel of {n_lines:,} lines takes {words[0]} longer than {seconds:g} s; use loops (lax.fori_loop) for "
            f"what is unrolled, or set CRAZYSIM_COMPILE_TIMEOUT to a larger number of seconds"
        )
    with tempfile.TemporaryDirectory(dir=kernel_cache.temporary_folder(), ignore_cleanup_errors=True) as name:
        work_folder, library = Path(name), Path(name) / "kernel.so"
        try:
            (work_folder / "kernel.cpp").write_text(source)
            process = _run_compiler([*words, str(work_folder / "kernel.cpp"), "-o", str(library)], work_folder, seconds)
            if process.returncode:
                _check_settings(work_folder)
                raise KernelError(f"{words[0]} refused the kernel: {process.stderr.strip()[:2000]}")
            return library.read_bytes()
        except OSError as error:
            raise KernelError(f"{words[0]} left no library: {error}") from error


def _check_settings(work_folder: Path) -> None:
    (work_folder / "empty.cpp").write_text("")

    def compile_empty_file(with_options: bool) -> str:
        words = [*compiler_command(with_options), str(work_folder / "empty.cpp"), "-o", str(work_folder / "empty.so")]
        process = _run_compiler(words, work_folder, time_limit())
        return (process.stderr.strip()[:500] or f"exit status {process.returncode}") if process.returncode else ""

    message = compile_empty_file(with_options=True)
    if not message:
        return
    variable = "CXX" if compile_empty_file(with_options=False) else "CXXFLAGS"
    if os.environ.get(variable):
        raise ConfigError(
            f"expected a C++ compiler and options that it accepts, got {variable}={os.environ[variable]!r}: {message}. "
            f"Correct or unset it."
        )


@contextlib.contextmanager
def compiling_threads(n: int | None = None) -> Iterator[ThreadPoolExecutor]:
    """Provide threads that compile. If the ``with`` block is interrupted, their compilers are killed.

    If a compiler was killed, the compilation raises ``KeyboardInterrupt``, too. After an ``Exception`` another engine
    would compile in its place.

    Args:
        n: Number of threads; None for the default of ``ThreadPoolExecutor``.
    """
    interrupted = getattr(_THREAD, "interrupted", None) or threading.Event()  # threads of threads end with them
    with ThreadPoolExecutor(n, initializer=setattr, initargs=(_THREAD, "interrupted", interrupted)) as executor:
        try:
            yield executor
            executor.shutdown()
        except (KeyboardInterrupt, SystemExit):
            interrupted.set()
            for pipe in list(_COMPILER_PIPES):
                pipe.close()
            executor.shutdown(cancel_futures=True)
            raise


_THREAD = threading.local()
"""``interrupted`` is the event of the threads that a thread belongs to: an interrupt has killed their compilers."""
_COMPILER_PIPES: set[IO[str]] = set()
"""Pipes of the running compilers; closing a pipe kills its compiler."""


def _run_compiler(
    words: Sequence[str], work_folder: Path, seconds: float, cwd: str | None = None
) -> subprocess.CompletedProcess[str]:
    pipe = subprocess.PIPE
    reader, writer = os.pipe()
    with os.fdopen(reader) as read_end, os.fdopen(writer, "w") as write_end:
        try:
            process = subprocess.Popen(
                ["/bin/sh", "-c", KILLING_SCRIPT, "sh", *words], stdin=read_end, stdout=pipe, stderr=pipe, text=True,
                start_new_session=True, cwd=cwd,
                env=os.environ | dict.fromkeys(TEMPORARY_FOLDER_VARIABLES, str(work_folder)),
            )  # fmt: skip
        except OSError as error:
            raise KernelError(f"{words[0]} cannot be run: {error}") from error
        with process:
            _COMPILER_PIPES.add(write_end)
            if getattr(_THREAD, "interrupted", threading.Event()).is_set():  # just now: it found no pipe to close
                write_end.close()
            try:
                stdout, stderr = process.communicate(timeout=seconds)
                if write_end.closed:
                    raise KeyboardInterrupt
            except subprocess.TimeoutExpired:
                raise KernelError(
                    f"{words[0]} took longer than {seconds:g} s; set CRAZYSIM_COMPILE_TIMEOUT to a larger number of "
                    f"seconds"
                ) from None
            finally:
                _COMPILER_PIPES.discard(write_end)
                write_end.close()
    return subprocess.CompletedProcess(list(words), process.returncode, stdout, stderr)
