"""What a simulation is asked to be and to do, checked at once."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import Control
from crazysim.errors import ConfigError, UnknownNameError


def positive(name: str, value: Any) -> int:
    """Return a positive whole number, or say which argument is none."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ConfigError(f"{name} is {value!r}; it must be a positive whole number")
    return int(value)


def physics_freq(freq: Any) -> int:
    """Return the physics steps per second, Hz, or say why there cannot be so many."""
    freq = positive("freq", freq)
    if freq > 10_000 and not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise ConfigError(
            f"freq is {freq} Hz: above 10,000 Hz a step is lost in float32 rounding. Enable float64 first: "
            f"jax.config.update('jax_enable_x64', True)"
        )
    return freq


def member(enum: Any, name: str, value: Any) -> Any:
    """Return the member of an enum, or say what its members are."""
    try:
        return enum(value)
    except ValueError:
        names = ", ".join(repr(m.value) for m in enum)
        raise UnknownNameError(f"{name} is {value!r}; it must be one of {names}") from None


def find_device(device: str | jax.Device) -> jax.Device:
    """Return the device of a name such as ``cpu`` or ``gpu:1``, or say what there is."""
    if isinstance(device, jax.Device):
        return device
    if not isinstance(device, str):
        raise ConfigError(f"a device is a platform such as 'cpu', 'gpu' or 'gpu:1', or a jax.Device, not {device!r}")
    platform, _, index = device.partition(":")
    try:
        devices = jax.devices("gpu" if platform == "cuda" else platform)
        return devices[int(index or 0)]
    except (RuntimeError, ValueError, IndexError) as error:
        found = ", ".join(str(d) for d in jax.devices())
        raise ConfigError(
            f"device {device!r} does not exist ({error}); there is {found}. Give a platform such as 'cpu' or 'gpu', "
            f"or 'gpu:1' for the second of its devices. GPUs need jax's CUDA packages: pip install 'crazysim[gpu]'."
        ) from None


def as_mask(mask: Any, n_worlds: int) -> Array | None:
    """Return which worlds are meant, None for all, or say what a mask must be. (n_worlds,)"""
    if mask is None:
        return None
    try:
        array = mask if isinstance(mask, jax.Array) else np.asarray(mask)
    except ValueError as error:
        raise ValueError(f"the mask {mask!r} is no regular array; needed is one bool per world") from error
    if array.shape != (n_worlds,) or array.dtype != bool:
        raise ValueError(
            f"the mask has shape {array.shape} and type {array.dtype}; needed are {(n_worlds,)} and bool, one per world"
        )
    return jnp.asarray(array)


def control_freqs(control: Control, freq: int, given: dict[Control, int | None]) -> dict[Control, int]:
    """Return the rate of every controller, Hz: as given, or the usual one, or the largest below it that divides.

    Args:
        control: Command level, from which follows which controllers are in use.
        freq: Physics steps per second, Hz.
        given: The rates asked for; None for the usual one.

    Raises:
        ConfigError: If a controller in use could not fire every whole number of steps.
    """
    in_use = {
        Control.state: (Control.state, Control.attitude, Control.force_torque),
        Control.rotor_vel: (),
    }.get(control, (control, Control.force_torque))
    freqs = {}
    for level, asked in given.items():
        if asked is None:
            freqs[level] = _largest_divisor(freq, min(100 if level == Control.state else 500, freq))
            continue
        freqs[level] = positive(f"{level.value}_freq", asked)
        if level in in_use and freq % asked:
            raise ConfigError(
                f"{level.value}_freq is {asked} Hz, which does not divide freq = {freq} Hz, so it cannot fire every "
                f"whole number of steps. The nearest rate below is {_largest_divisor(freq, min(asked, freq))} Hz."
            )
    return freqs


def _largest_divisor(freq: int, limit: int) -> int:
    return next(f for f in range(limit, 0, -1) if freq % f == 0)
