"""Controllers in C: a compiled library with the interface of ``firmware.h`` commands the motors of every drone."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control.allocation import AllocationParams
from crazysim.control.levels import Control
from crazysim.control.protocol import Controller, DroneData
from crazysim.drones import Airframe
from crazysim.dynamics.rotor import rotor_vel_of_thrust
from crazysim.engine.pytree import PyTree, leaf
from crazysim.errors import ConfigError, expect, require
from crazysim.storage import open_replacement, read_bytes

INTERFACE_VERSION = 1
"""Version of the interface in ``firmware.h``."""
COMMAND_LEVELS = (Control.state, Control.attitude, Control.body_rate)
"""Command levels, in the order of ``enum crazysim_level`` in ``firmware.h``."""
MOTOR_UNITS = ("throttle", "thrust", "rpm")
"""Units of motor commands."""
LIBRARY_FUNCTIONS = ("crazysim_memory_size", "crazysim_init", "crazysim_update_all", "crazysim_version")
"""Functions that a library must export."""
MAX_LIBRARY_BYTES, MAX_MEMORY_BYTES = 2**28, 2**24
"""Largest library, and largest memory of a drone, bytes."""
LOADING_TIMEOUT = 60
"""Longest time that loading a library may take, s."""
COMMAND_SIZE, FEEDFORWARD_SIZE = 16, 8
"""Number of entries of ``command`` and of ``feedforward`` in ``struct crazysim_input``."""


class CFirmwareMemory(PyTree):
    """Memory of a controller in C."""

    words: Array = leaf("drone", 1)
    """Memory of the library, as 32-bit integers. (n_worlds, n_drones, n_words)"""


class CFirmware(Controller, params=AllocationParams):
    """Controller that a compiled library computes, for all drones of all worlds in one call.

    The library runs on the host, between the kernels of the step, so a simulation on a GPU waits for it. Steps with it
    have no derivatives.
    """

    name: ClassVar[str] = "c_firmware"
    levels: ClassVar[tuple[Control, ...]] = COMMAND_LEVELS
    output: ClassVar[Control] = Control.rotor_vel
    include: ClassVar[Path] = Path(__file__).parent
    """Folder of ``firmware.h``, for the compiler's option ``-I``."""
    library: str | Path
    """Path of the shared library. A copy in a temporary folder is loaded, so that a new ``CFirmware`` uses the new file
    after a compilation. The library must not depend on other libraries in its folder."""
    motors: Literal["throttle", "thrust", "rpm"] = "throttle"
    """Unit of the motor commands: ``"throttle"``, the thrust of a rotor as a fraction of its maximum, like a
    Crazyflie's PWM over 65,535; ``"thrust"``, N; or ``"rpm"``. Thrusts are limited to the range of the rotor; a command
    of 0 switches the rotor off."""
    freq: int = 500
    """Rate of the controller, Hz."""

    def __post_init__(self) -> None:
        expect(self.motors in MOTOR_UNITS, f"motors as one of {', '.join(MOTOR_UNITS)}", self.motors)
        _ = self._copy_path

    @functools.cached_property
    def _copy_path(self) -> str:
        return copy_library(self.library)

    def memory(self, airframe: Airframe) -> CFirmwareMemory:
        library = _open_library(self._copy_path)
        words: Any = np.zeros(-(-library.crazysim_memory_size() // 4) or 1, np.uint32)
        library.crazysim_init(words.ctypes.data)
        return CFirmwareMemory(words)

    def update(
        self, data: DroneData, command: Any, memory: CFirmwareMemory, params: AllocationParams
    ) -> tuple[Array, CFirmwareMemory]:
        s, controls = data.states, data.controls
        level, n_motors = COMMAND_LEVELS.index(controls.mode), params.allocation_matrix.shape[0]
        if controls.mode == Control.state:
            setpoint, feedforward = controls.state.cmd, controls.state.feedforward
        else:
            setpoint, feedforward = jnp.zeros(COMMAND_SIZE).at[:4].set(command), jnp.zeros(FEEDFORWARD_SIZE)
        clock = jnp.stack([data.core.steps / data.core.freq, jnp.asarray(1 / self.freq)])
        inputs = jnp.concatenate([clock, s.pos, s.quat, s.vel, s.ang_vel, setpoint, feedforward]).astype(jnp.float32)

        @jax.custom_jvp
        def call_library(words: Array, inputs: Array) -> tuple[Array, Array]:
            shapes = (jax.ShapeDtypeStruct(words.shape, np.uint32), jax.ShapeDtypeStruct((n_motors,), np.float32))
            call_on_host = functools.partial(_call_library, self._copy_path, level, n_motors)
            return jax.pure_callback(call_on_host, shapes, words, inputs, vmap_method="broadcast_all")

        call_library.defjvp(self._refuse_derivative)
        words, motors = call_library(memory.words, inputs)
        return self._rotor_vel(motors.astype(s.pos.dtype), params), CFirmwareMemory(words)

    def _refuse_derivative(self, primals: Any, tangents: Any) -> Any:
        raise ConfigError(
            f"expected a controller in JAX for the derivative of a step, got CFirmware({str(self.library)!r}): a "
            f"compiled library has no derivative. Use a controller such as 'mellinger'."
        )

    def _rotor_vel(self, motors: Array, params: AllocationParams) -> Array:
        if self.motors == "rpm":
            return motors
        thrust = motors * params.thrust_max if self.motors == "throttle" else motors
        clipped_thrust = jnp.clip(thrust, params.thrust_min, params.thrust_max)
        return jnp.where(thrust <= 0, 0.0, rotor_vel_of_thrust(clipped_thrust, params.rpm2thrust))


def _call_library(library: str, level: int, n_motors: int, words: Any, inputs: Any) -> tuple[np.ndarray, np.ndarray]:
    words, inputs = np.array(words, np.uint32, order="C"), np.ascontiguousarray(inputs, np.float32)
    motors = np.zeros((*inputs.shape[:-1], n_motors), np.float32)
    pointers = words.ctypes.data, level, inputs.ctypes.data, motors.ctypes.data
    _open_library(library).crazysim_update_all(motors.size // n_motors, n_motors, words.strides[-2], *pointers)
    return words, motors


def copy_library(library: str | Path) -> str:
    """Load a copy of a library with its current content, and return the path of the copy."""
    remedy, path = f"Compile it as {CFirmware.include / 'firmware.h'} says.", Path(library)
    try:
        content = read_bytes(path, MAX_LIBRARY_BYTES)
    except ConfigError as error:
        raise ConfigError(f"expected a shared library at {path}: {str(error).rstrip('.')}. {remedy}") from error
    copy_path = Path(_copies_folder().name) / f"{path.stem}-{hashlib.sha256(content).hexdigest()[:16]}{path.suffix}"
    if not copy_path.exists():  # a library that is loaded must not be overwritten
        with open_replacement(copy_path) as file:
            file.write(content)
        if reason := _loading_error(copy_path):
            copy_path.unlink()
            raise ConfigError(f"expected a shared library at {path}, got one that cannot be loaded: {reason}. {remedy}")
    library_copy = _open_library(str(copy_path))
    missing_functions = [name for name in LIBRARY_FUNCTIONS if not hasattr(library_copy, name)]
    if missing_functions:
        required_names, missing_names = ", ".join(LIBRARY_FUNCTIONS), ", ".join(missing_functions)
        raise ConfigError(f"expected the functions {required_names} in {path}, got no {missing_names}. {remedy}")
    require(
        (version := library_copy.crazysim_version()) == INTERFACE_VERSION,
        f"expected version {INTERFACE_VERSION} of firmware.h in {path}, got {version}. {remedy}",
    )
    pointer, integer, size = ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t
    library_copy.crazysim_memory_size.restype = size
    require(
        (n_bytes := library_copy.crazysim_memory_size()) <= MAX_MEMORY_BYTES,
        f"expected a memory of at most {MAX_MEMORY_BYTES} bytes a drone, got {n_bytes} from {path}. {remedy}",
    )
    library_copy.crazysim_init.argtypes = [pointer]
    library_copy.crazysim_init.restype = None
    library_copy.crazysim_update_all.argtypes = [integer, integer, size, pointer, integer, pointer, pointer]
    library_copy.crazysim_update_all.restype = None
    return str(copy_path)


def _loading_error(library: Path) -> str:
    # A separate process tries to load it, because the system kills a process that loads a truncated library.
    command = [sys.executable, "-I", "-S", "-c", "import ctypes, sys; ctypes.CDLL(sys.argv[1])", str(library)]
    try:
        process = subprocess.run(command, capture_output=True, text=True, timeout=LOADING_TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return f"it takes over {LOADING_TIMEOUT} s"
    if process.returncode < 0:
        return f"it ends the process with {signal.Signals(-process.returncode).name}"
    return (process.stderr.strip().splitlines() or ["unknown"])[-1] if process.returncode else ""


_open_library = functools.cache(ctypes.CDLL)
"""Function that opens a library by its path. It returns the same object at each call, with the function types that
``copy_library`` has declared."""


@functools.cache
def _copies_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="crazysim-", ignore_cleanup_errors=True)
