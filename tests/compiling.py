"""How the tests compile: without optimisation, which takes half the time, and in one MLIR context."""

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

HAS_EMITTERS = version("jaxlib").startswith("0.10.")
"""True where XLA has an option for the fusion of loops; later versions refuse it."""


QUICK = (
    "-Og -fira-algorithm=priority -fira-region=one --param ggc-min-expand=200 --param ggc-min-heapsize=500000 -nostdlib"
)
"""Options of g++ that take 0.6 of the time that -O1 takes, and as little as -O0, whose kernels are slow; below
500 MB it collects no garbage. Python has loaded the C libraries already, so none is linked."""


SHORT = 0.05
"""Time of compiling from which a program is kept, s: writing and reading one takes some 10 ms."""
CACHE = Path(__file__).parents[1] / ".cache" / "jax"
"""Folder of compiled programs and kernels."""


def cache() -> dict[str, str]:
    """Return variables that make processes keep programs; what compiles within 50 ms is compiled again as soon."""
    return {
        "JAX_COMPILATION_CACHE_DIR": str(CACHE),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(SHORT),
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


def share_mlir_context() -> None:
    """Let all programs of this process be written in one MLIR context.

    JAX makes a context for each program, with all dialects, which takes 4 ms and 1.2 MB. One for all keeps the names
    and types of every program, which is little for the tests, and would be too much for a process that runs for weeks.
    A program that is written while another one is gets a context of its own.
    """
    from jax._src.interpreters import mlir
    from jax.extend.mlir import ir

    make, shared = mlir.make_ir_context, mlir.make_ir_context()

    mlir.make_ir_context = lambda: shared if ir.Context.current is None else make()


def precompiled_headers() -> str:
    """Return options by which g++ reads the headers of all kernels as it has compiled them once: a tenth faster."""
    from crazysim.engine import native

    if not _is_gcc(os.environ) or "-include" in os.environ.get("CXXFLAGS", ""):
        return ""
    lines = (Path(native.__file__).parent / "targets/host.h").read_text().splitlines()
    text = "\n".join(line for line in lines if line.startswith("#include <"))
    words = native.command()
    folder = CACHE.parent / "headers" / hashlib.sha256("\n".join([*words, text]).encode()).hexdigest()[:16]
    if not (folder / "kernel.h.gch").exists():
        folder.mkdir(parents=True, exist_ok=True)
        header, made = (folder / f"{os.getpid()}{suffix}" for suffix in (".h", ".gch"))  # two workers may be here
        header.write_text(text)
        subprocess.run([*words, "-x", "c++-header", str(header), "-o", str(made)], check=True)
        header.replace(folder / "kernel.h")
        made.replace(folder / "kernel.h.gch")
    return f" -include {shlex.quote(str(folder / 'kernel.h'))}"


def _is_gcc(given: Mapping[str, str]) -> bool:
    name = given.get("CXX", "g++")
    return sys.platform == "linux" and "clang" not in name and shutil.which(name) is not None


def options() -> dict[str, bool | int]:
    """Return XLA's options: no optimisation, and no emitters of fused loops, which take three times as long."""
    always = {"xla_backend_optimization_level": 0, "xla_cpu_parallel_codegen_split_count": 1}
    return always | ({"xla_cpu_use_fusion_emitters": False} if HAS_EMITTERS else {})


def environment(given: Mapping[str, str]) -> dict[str, str]:
    """Return variables for the tests: two host devices, and no optimising unless ``XLA_FLAGS`` says how much.

    CI runs laws and engines once more with all optimisations.
    """
    flags = given.get("XLA_FLAGS", "")
    quick = "xla_backend_optimization_level" not in flags
    if quick:
        flags += "".join(f" --{name}={str(value).lower()}" for name, value in options().items())
    own = {"CXXFLAGS": f"{given.get('CXXFLAGS', '')} {QUICK if _is_gcc(given) else '-O1'}"} if quick else {}
    return {"XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count=2"} | own
