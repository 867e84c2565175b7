"""``crazysim info``: a description of the installation for bug reports, as plain text."""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import crazysim
from crazysim import startup

REQUIRED_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "gymnasium")
"""Packages that crazysim needs."""
OPTIONAL_PACKAGES = ("optax", "viser", "websockets", "matplotlib", "imageio-ffmpeg", "casadi", "onnx", "pettingzoo",
                     "warp-lang", "cflib", "motioncapture", "pymavlink", "rosbags", "splax", "ziglang", "tqdm",
                     "trimesh", "flatbuffers")  # fmt: skip
"""Packages of the extras."""
VARIABLES = ("JAX_PLATFORMS", "JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_X64", "XLA_FLAGS", "CUDA_VISIBLE_DEVICES",
             "CXX", "CXXFLAGS", "CRAZYSIM_CACHE", "CRAZYSIM_COMPILE_TIMEOUT", "CRAZYSIM_JAX_FALLBACKS",
             "CRAZYSIM_RENDERING", "XDG_CACHE_HOME", "MUJOCO_GL")  # fmt: skip
"""Environment variables that change the behaviour of crazysim."""


def add_parsers(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("info", help="print versions, devices, compiler and cache, for reports of bugs")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print versions, devices, compiler, cache and rendering of this installation, one per line.

    For a part that is missing or broken, its line gives the reason.
    """
    del options
    text = "\n".join(f"{name + ':':<14}{_value_or_reason(value)}" for name, value in _info_lines())
    home = os.path.expanduser("~")
    # Bug reports are public, so they do not contain the path of the home folder.
    print(text.replace(f"{home}{os.sep}", f"~{os.sep}") if home != "~" else text)


def _info_lines() -> Iterator[tuple[str, Callable[[], str]]]:
    yield "crazysim", lambda: f"{crazysim.__version__}, {Path(crazysim.__file__).parent}"
    yield "Python", lambda: f"{platform.python_version()} ({platform.python_implementation()}), {sys.executable}"
    # Cores that this process may use.
    n_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield "system", lambda: f"{platform.platform()}, {n_cores} CPU cores"
    for name in REQUIRED_PACKAGES:
        yield name, lambda name=name: importlib.metadata.version(name)
    yield "extras", _extras
    yield "devices", _devices
    yield "C++ compiler", _compiler
    yield "NVRTC", _nvrtc
    yield "cache", _cache
    yield "rendering", _rendering
    yield "variables", _variables


def _value_or_reason(value: Callable[[], str]) -> str:
    try:
        return value()
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
    except Exception as error:  # whatever is broken must not hide the other lines
        return f"{type(error).__name__}: {_first_line(str(error))}".removesuffix(": ")


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0][:300]


def _extras() -> str:
    versions = []
    for name in OPTIONAL_PACKAGES:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return ", ".join(versions) or "none"


def _devices() -> str:
    import jax

    return ", ".join(f"{device.platform} {device.device_kind} ({device.id})" for device in jax.devices())


def _compiler() -> str:
    from crazysim.engine.backends import native

    program = native.compiler()
    if program is None:
        return f"none; steps run on a slower engine: {native.MISSING_COMPILER}"
    result = subprocess.run(
        [*shlex.split(program), "--version"], capture_output=True, text=True, timeout=20, check=False
    )
    return f"{program}, {_first_line(result.stdout or result.stderr)}; {shlex.join(native.compiler_command()[1:])}"


def _nvrtc() -> str:
    from crazysim.engine.backends import cuda

    library = cuda.nvrtc()
    return "not found; needed for GPUs only" if library is None else str(library._name)


def _cache() -> str:
    from crazysim.engine import jaxcompat
    from crazysim.engine.cache import default_folder
    from crazysim.storage import untrusted_reason

    configured = jaxcompat.cache_folder()
    folder = default_folder() if configured is None else Path(configured)
    if folder is None:
        return "off"
    reason = untrusted_reason(folder / "crazysim") if (folder / "crazysim").is_dir() else ""
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    size = f"{sum(sizes) / 1e6:.1f} MB in {len(sizes)} files" if folder.is_dir() else "not there yet"
    return f"{folder}: {size}" + (f", kernels refused: {reason}" if reason else "")


def _rendering() -> str:
    code = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).close()"
    environment = os.environ | startup.refused_variables
    backend = environment.get("MUJOCO_GL") or "MUJOCO_GL is not set"
    try:
        process = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False, env=environment
        )
    except subprocess.TimeoutExpired:
        return f"{backend}, gave no answer in 60 s"
    lines = [line for line in process.stderr.strip().splitlines() if line and not line.startswith(" ")]
    outcome = (
        "works" if process.returncode == 0 else f"fails: {lines[-1][:300] if lines else f'exit {process.returncode}'}"
    )
    return f"{backend}, {outcome}"


def _variables() -> str:
    environment = os.environ | startup.refused_variables
    settings = [f"{name}={environment[name]}" for name in VARIABLES if name in environment]
    return ", ".join(settings) or "none"
