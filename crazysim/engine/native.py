"""Kernels on the host: source compiled by the C++ compiler that is there, called by XLA."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from crazysim.engine.kernel import Kernel

FLAGS = ("-std=c++17", "-O2", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-shared",
         "-fPIC", "-fvisibility=hidden", "-pthread", "-w")  # fmt: skip
"""Options of the compiler, before those of the variable CXXFLAGS: contraction of multiply and add is allowed, nothing
that forgets NaN is."""


def call(kernel: Kernel, n_lanes: int, count: Array, inputs: Sequence[Array], outputs: Sequence[Any]) -> list[Array]:
    """Return what a kernel writes; arguments as in ``cuda.call``."""
    run = jax.ffi.ffi_call(target(kernel), list(outputs), input_output_aliases=kernel.aliases())
    return list(run(np.asarray([n_lanes], np.int32), count, *inputs))


@functools.cache
def compiler() -> str | None:
    """Return the C++ compiler: of the variable CXX, or the first that is found; None if there is none."""
    return next(
        (path for name in (os.environ.get("CXX"), "g++", "clang++") if name and (path := shutil.which(name))), None
    )


@functools.cache
def target(kernel: Kernel) -> str:
    """Compile a kernel, and return the name that XLA knows it by.

    Raises:
        RuntimeError: If the compiler refuses it, with what it said.
    """
    path = compiler()
    if path is None:
        raise RuntimeError("no C++ compiler was found; install g++ or clang++, or set CXX")
    own = shlex.split(os.environ.get("CXXFLAGS", ""))
    command = [path, *FLAGS, *own, "-I", jax.ffi.include_dir(), "-x", "c++", "-"]
    digest = hashlib.sha256("\0".join([*command, jax.__version__, kernel.text]).encode()).hexdigest()[:16]
    library = _folder() / f"{digest}.so"
    if not library.exists():
        partial = library.with_suffix(f".{os.getpid()}")
        done = subprocess.run([*command, "-o", str(partial)], input=kernel.text, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{path} refused the kernel:\n{done.stderr[:2000]}")
        partial.rename(library)  # whole or not at all, whoever else is writing it
    name = f"crazysim_advance_{digest}"
    function = ctypes.CDLL(str(library)).crazysim_advance
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(function), platform="cpu")
    return name


@functools.cache
def _folder() -> Path:
    """Return where libraries lie: beside JAX's compilation cache, or in a folder that goes with this process."""
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if cache:
        folder = Path(cache) / "crazysim"
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    folder = tempfile.TemporaryDirectory(prefix="crazysim-")
    _KEEP.append(folder)
    return Path(folder.name)


_KEEP: list[tempfile.TemporaryDirectory[str]] = []
