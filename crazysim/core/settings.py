"""Validation of the settings and arguments of a simulation."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import Control, Controller
from crazysim.control.switch import Switch
from crazysim.errors import ConfigError, UnknownNameError


def positive(name: str, value: Any) -> int:
    """Return a positive integer.

    Raises:
        ConfigError: If the value is anything else.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ConfigError(f"{name} is {value!r}; it must be a positive whole number")
    return int(value)


def physics_freq(freq: Any) -> int:
    """Return the rate of physics steps, Hz.

    Raises:
        ConfigError: If it is no positive integer, or too high for float32.
    """
    freq = positive("freq", freq)
    if freq > 10_000 and not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise ConfigError(
            f"freq is {freq} Hz: above 10,000 Hz a step is lost in float32 rounding. Enable float64 first: "
            f"jax.config.update('jax_enable_x64', True)"
        )
    return freq


def member(enum: Any, name: str, value: Any) -> Any:
    """Return the member of an enum.

    Raises:
        UnknownNameError: If there is no such member; the message lists all members.
    """
    try:
        return enum(value)
    except ValueError:
        names = ", ".join(repr(m.value) for m in enum)
        raise UnknownNameError(f"{name} is {value!r}; it must be one of {names}") from None


def find_device(device: str | jax.Device) -> jax.Device:
    """Return the device with a name such as ``cpu`` or ``gpu:1``.

    Raises:
        ConfigError: If there is no such device; the message lists all devices.
    """
    if isinstance(device, jax.Device):
        return device
    if not isinstance(device, str):
        raise ConfigError(
            f"expected a platform such as 'cpu', 'gpu' or 'gpu:1', or a jax.Device, got {device!r}; use device='cpu'"
        )
    platform, _, index = device.partition(":")
    try:
        devices = jax.devices("gpu" if platform == "cuda" else platform)
        return devices[int(index or 0)]
    except (RuntimeError, ValueError, IndexError) as error:
        found = ", ".join(str(d) for d in jax.devices())
        raise ConfigError(
            f"device {device!r} does not exist ({error}); there is {found}. Use a platform such as 'cpu' or 'gpu', "
            f"or 'gpu:1' for its second device. GPUs need the CUDA packages of JAX: pip install 'crazysim[gpu]'."
        ) from None


def as_mask(mask: Any, n_worlds: int) -> Array | None:
    """Return a mask over worlds as an array, None for all worlds. (n_worlds,)

    Raises:
        ValueError: If it is not one bool per world.
    """
    if mask is None:
        return None
    try:
        array = mask if isinstance(mask, jax.Array) else np.asarray(mask)
    except ValueError as error:
        raise ValueError(f"expected a mask of one bool per world, got {mask!r}; use a NumPy array") from error
    if array.shape != (n_worlds,) or array.dtype != bool:
        raise ValueError(
            f"expected a mask of shape {(n_worlds,)} and bool, one per world, got shape {array.shape} and type "
            f"{array.dtype}; for indices use np.isin(np.arange({n_worlds}), indices)"
        )
    return jnp.asarray(array)


def control_freqs(control: Control, freq: int, given: dict[Control, int | None]) -> dict[Control, int]:
    """Return the rate of every controller, Hz: as given, or else the largest divisor of ``freq`` up to the default.

    Args:
        control: Command level, which determines the controllers in use.
        freq: Rate of physics steps, Hz.
        given: Requested rates, Hz; None for the default.

    Raises:
        ConfigError: If the rate of a controller in use does not divide ``freq``.
    """
    in_use = {
        Control.state: (Control.state, Control.attitude, Control.force_torque),
        Control.rotor_vel: (),
    }.get(control, (control, Control.force_torque))
    freqs = {}
    for level, requested in given.items():
        if requested is None:
            freqs[level] = _largest_divisor(freq, min(100 if level == Control.state else 500, freq))
            continue
        freqs[level] = positive(f"{level.value}_freq", requested)
        if level in in_use and freq % requested:
            nearest = _largest_divisor(freq, min(requested, freq))
            raise ConfigError(
                f"{level.value}_freq is {requested} Hz, which does not divide freq = {freq} Hz, so it cannot fire "
                f"every whole number of steps. Use the nearest rate below, {nearest} Hz."
            )
    return freqs


def controller_at_rates(
    controller: Controller, control: Control, freq: int, given: dict[Control, int | None]
) -> Controller:
    """Return a controller with the rates that it has in a simulation, each a divisor of ``freq``.

    The requested rate of the command's level is that of the outer loop if there is one, and that of attitude then that
    of ``update``. A rate that is the default of its class is lowered to the largest divisor.

    Args:
        controller: The controller.
        control: Command level.
        freq: Rate of physics steps, Hz.
        given: Requested rates, Hz; None for those of the controller.

    Raises:
        ConfigError: If a rate does not divide ``freq``.
    """
    if isinstance(controller, Switch):
        members = tuple(controller_at_rates(member, control, freq, given) for member in controller.controllers)
        own = {rate for member in members for rate in (member.freq, member.outer_freq) if rate is not None}
        common = max(own) if all(max(own) % rate == 0 for rate in own) else freq
        return dataclasses.replace(controller, controllers=members, freq=common)
    rates = {"freq": given.get(control)}
    if control == Control.state and controller.has_outer:
        rates = {"outer_freq": given.get(control), "freq": given.get(Control.attitude)}
    defaults = {f.name: f.default for f in dataclasses.fields(controller)}  # type: ignore[arg-type]
    for name, requested in rates.items():
        rate = positive(f"{name} of controller {controller.name!r}", requested or getattr(controller, name))
        nearest = _largest_divisor(freq, min(rate, freq))
        if rate != nearest and (requested or rate != defaults[name]):
            raise ConfigError(
                f"expected {name} of controller {controller.name!r} to divide freq = {freq} Hz, got {rate} Hz. Use the "
                f"nearest rate below, {nearest} Hz."
            )
        rates[name] = nearest
    return dataclasses.replace(controller, **rates)  # type: ignore[type-var]


def _largest_divisor(freq: int, limit: int) -> int:
    return next(f for f in range(limit, 0, -1) if freq % f == 0)
