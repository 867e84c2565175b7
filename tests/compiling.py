"""Settings for compilation in tests: less optimisation by XLA and g++, and persistent caches."""

import shutil
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

CACHE = Path(__file__).parents[1] / ".cache" / "jax"
"""Folder of compiled programs and kernels."""
MIN_KEPT_COMPILE_S = 0.05
"""Minimum compile time of programs that XLA stores, s; writing and reading a program takes some 10 ms."""


def environment(variables: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of the tests: four host devices, persistent caches, and quick compilers.

    ``XLA_FLAGS`` that set ``xla_backend_optimization_level`` keep all optimisations, which CI uses for laws and engine.
    """
    flags = variables.get("XLA_FLAGS", "")
    settings = {
        "JAX_COMPILATION_CACHE_DIR": str(CACHE),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(MIN_KEPT_COMPILE_S),
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    if "xla_backend_optimization_level" not in flags:
        flags += " --xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
        flags += " --xla_llvm_disable_expensive_passes=true"
        if version("jaxlib").startswith("0.10."):
            # Emitters of fused loops take three times as long; later jaxlibs have no option.
            flags += " --xla_cpu_use_fusion_emitters=false"
        settings["CXXFLAGS"] = f"{variables.get('CXXFLAGS', '')} {_quick_cxxflags(variables)}"
    return settings | {"XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count=4"}


def _quick_cxxflags(variables: Mapping[str, str]) -> str:
    """Return options for quick compilation: those of g++ take 0.6 of the time of -O1, as little as -O0."""
    name = variables.get("CXX", "g++")
    is_gcc = sys.platform == "linux" and "clang" not in name and shutil.which(name) is not None
    return "-Og -fira-algorithm=priority -fira-region=one" if is_gcc else "-O1"
