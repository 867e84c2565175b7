"""Validation of the settings and arguments of a simulation."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import itertools
import sys
from collections.abc import Mapping
from enum import Enum
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, DTypeLike, NDArray

from crazysim.arguments import Numbers, annotated_types, check_value
from crazysim.control import Control, Controller
from crazysim.control.protocol import controller_chain
from crazysim.control.switch import Switch
from crazysim.errors import ConfigError, UnknownNameError, short_repr
from crazysim.tables import ANY_NUMBER, Range, Shapes, range_between, read_numbers

E = TypeVar("E", bound=Enum)

MAX_ITERATIONS = 1000
"""Largest number of iterations of a contact solver; the defaults are 8 to 30."""
MAX_FRICTION = 1000.0
"""Largest coefficient of friction; rubber has about 1."""
MAX_SOFTNESS = 10.0
"""Largest softness of contacts, s."""

SLOW_FREQ = 200
"""Rate of physics steps, Hz, that replaces a lower one in a check of ``default_rates``: the divisor of ``freq`` that
replaces a default rate must be at least half of that default, or of ``freq`` if it is smaller. The cascades of small
drones are stable from 100 Hz on, and none of them at 50 Hz (hover of ``cf21B_500``, euler)."""


def positive_integer(name: str, value: object, at_most: int | None = None) -> int:
    """Return a positive integer.

    Args:
        at_most: Largest value; None for any.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ConfigError(f"{name} is {short_repr(value)}; it must be a positive whole number")
    if at_most is not None and value > at_most:
        raise ConfigError(f"{name} is {short_repr(value)}; it must be at most {at_most}")
    return int(value)


def check_image_size(width: object, height: object) -> tuple[int, int]:
    """Return width and height of an image, pixels, after checking them."""
    sizes = [int(n) for n in (width, height) if isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n > 0]
    if len(sizes) < 2:
        raise ConfigError(f"expected positive integers as width and height of an image, got {width} x {height} pixels")
    return sizes[0], sizes[1]


class Setting(NamedTuple):
    """Values that a field of a record of settings may have."""

    range: Range = ANY_NUMBER
    """Range of its numbers."""
    is_parameter: bool = False
    """True for a field of a plugin that only fills numbers of its record."""
    per_axis: bool = False
    """Whether to accept one number for all axes of a vector."""
    dtype: DTypeLike | None = None
    """Type of the numbers; None for real ones."""
    shapes: Shapes | None = None
    """Shapes of its array; None for any, or where the simulation decides."""


def setting(
    *,
    default: Any = dataclasses.MISSING,
    default_factory: Any = dataclasses.MISSING,
    low: float = -np.inf,
    high: float = np.inf,
    positive: bool = False,
    shapes: Shapes | None = None,
    keep: bool = True,
) -> Any:
    """Declare a numeric field of a record of settings, such as a task, with the values that it may have.

    ``check_settings`` checks the values. Numbers of fields without a declaration must be finite.

    Args:
        positive: Whether to refuse zero and negative values.
        shapes: Shapes of an array, ``"any"`` for an axis of any length; None for any shape.
        keep: False for a setting of a plugin that is None in ``data.plugins``, such as an array for the scene.
    """
    default = {"default": default} if default_factory is dataclasses.MISSING else {"default_factory": default_factory}
    return dataclasses.field(
        **default,
        metadata={"setting": Setting(range_between(low, high, positive), shapes=shapes), "static": True, "keep": keep},
    )


def color(per_item: bool = False) -> Any:
    """Declare a field with a colour, red, green, blue and opacity from 0 to 1, which is None by default.

    Args:
        per_item: Whether the field also accepts an array with one colour for each item. (n, 4)
    """
    return setting(default=None, low=0.0, high=1.0, shapes=((4,), ("any", 4)) if per_item else ((4,),), keep=False)


@functools.cache
def collect_settings(kind: type) -> dict[str, Setting]:
    """Return the declarations of a class's fields by ``setting`` or ``param``.

    A field without a declaration inherits the declaration of the field of the same name in a base class.
    """
    settings = {}
    for base in reversed(kind.__mro__):
        fields = vars(base).get("__dataclass_fields__", {})
        settings |= {name: f.metadata["setting"] for name, f in fields.items() if "setting" in f.metadata}
    return {field.name: settings.get(field.name, Setting()) for field in dataclasses.fields(kind)}


def check_settings(settings: Any) -> None:
    """Check every field of a record of settings, such as a plugin or a task, by its annotation and declaration.

    Fields of ``bool``, ``int``, ``float``, ``ArrayLike`` and ``Mapping[str, float]`` must have values of that kind,
    with finite numbers in the range of ``setting`` or ``param``. Fields annotated with a class must have instances
    of the class, and fields of ``Callable`` and ``Mapping`` functions and mappings of any kind. None is accepted if the
    annotation or the default allows it. Shapes that depend on the simulation, such as shapes of parameters, are checked
    later. Single numbers of NumPy and JAX are replaced by Python's.
    """
    settings_class = type(settings)
    for field, declared in zip(dataclasses.fields(settings), collect_settings(settings_class).values(), strict=True):
        value, value_types = getattr(settings, field.name), allowed_types(settings_class)[field.name]
        if value is not None or field.default is not None:
            check_value(
                f"{field.name} of {settings_class.__name__}", value, value_types, declared.range,
                declared.shapes if np.ndarray in value_types or declared.is_parameter else ((),),
                whole=declared.dtype is not None, remedy=f"help({settings_class.__name__}) describes it.",
            )  # fmt: skip
        # Numbers of small types would overflow, and JAX does not know all of them.
        if isinstance(value, (np.generic, np.ndarray, Array)) and value.ndim == 0:
            object.__setattr__(settings, field.name, float(value) if value.dtype.kind == "f" else value.item())


@functools.cache
def allowed_types(kind: type) -> dict[str, tuple[type, ...]]:
    """Return the types that each field may have, by its name; an empty tuple if its annotation cannot be checked.

    ``np.ndarray`` represents ``ArrayLike`` and sequences of numbers.
    """
    field_types = {}
    for base in reversed(kind.__mro__):
        module = getattr(sys.modules.get(base.__module__), "__dict__", {})  # a file that was run may have none
        names = module | {"ArrayLike": Numbers, "Param": Numbers}
        for name, hint in inspect.get_annotations(base).items():
            field_types[name] = annotated_types(hint, names)
    return {field.name: field_types.get(field.name, ()) for field in dataclasses.fields(kind)}


def check_softness(freq: int, softness: ArrayLike) -> None:
    """Check the time constant with which an overlap is pushed out, s, at ``freq`` steps per second, Hz."""
    read_numbers(
        "softness", softness, Range(f"from two steps, {2 / freq:.4g} s, to {MAX_SOFTNESS:g}", 2 / freq, MAX_SOFTNESS)
    )


def physics_freq(freq: object) -> int:
    """Check and return the rate of physics steps, Hz."""
    freq = positive_integer("freq", freq)
    if freq > 10_000 and not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise ConfigError(
            f"freq is {freq} Hz: above 10,000 Hz a step is lost in float32 rounding. Enable float64 first: "
            f"jax.config.update('jax_enable_x64', True)"
        )
    return freq


def enum_member(enum: type[E], name: str, value: object) -> E:
    """Return the member of an enum that has a value, or raise an error with the name of the setting."""
    try:
        return enum(value)
    except ValueError:
        names = ", ".join(repr(m.value) for m in enum)
        raise UnknownNameError(f"{name} is {value!r}; it must be one of {names}") from None


def find_device(device: str | jax.Device) -> jax.Device:
    """Return the device with a name such as ``cpu`` or ``gpu:1``."""
    if isinstance(device, jax.Device):
        if device.process_index != jax.process_index():
            raise ConfigError(f"expected a device of this host, got {device}. Use one of jax.local_devices().")
        return device
    platform, colon, index = device.partition(":") if isinstance(device, str) else ("", "", "")
    if not platform or (colon and not index.isdecimal()):
        raise ConfigError(
            f"expected a platform such as 'cpu', 'gpu' or 'gpu:1', or a jax.Device, got {short_repr(device)}. Use "
            f"device='cpu'."
        )
    try:
        devices = jax.local_devices(backend="gpu" if platform == "cuda" else platform)
        return devices[int(index or 0)]
    except (RuntimeError, ValueError, IndexError) as error:
        available = ", ".join(str(d) for d in jax.local_devices())
        raise ConfigError(
            f"expected a device of this host ({available}), got {device!r}: {error}. Use a platform such as 'cpu' or "
            f"'gpu', or 'gpu:1' for its second device. GPUs need the CUDA packages of JAX: pip install 'crazysim[gpu]'."
        ) from None


def as_rgba(rgba: object, n: int | None = None) -> NDArray[np.float64]:
    """Return a colour, read-only. (4,) or (n, 4)

    Args:
        rgba: Red, green, blue and opacity, 0 to 1.
        n: Number of items, to accept one colour for each, (n, 4); None to accept only one colour.
    """
    shapes = ((4,),) if n is None else ((4,), (n, 4))
    return read_numbers("rgba", rgba, range_between(0.0, 1.0), shapes, remedy="Use (1, 0, 0, 1) for red.")


def is_real(array: Any) -> bool:
    """Whether an array has floating-point numbers or integers, neither bools nor complex numbers."""
    return jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)


def as_mask(mask: object, *shapes: tuple[int, ...], item: str = "world") -> Array | None:
    """Return a mask as an array; None, which selects all items, is returned unchanged.

    Shape and type are checked, also of a traced mask.

    Args:
        mask: One bool for each world, or for each item of another kind.
        shapes: Shapes that it may have: (n_worlds,), or () in functions of one world.
        item: Kind of the items, for the message.
    """
    if mask is None:
        return None
    try:
        array = mask if isinstance(mask, jax.Array) else np.asarray(mask)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"expected a mask of one bool per {item}, got {mask!r}; use a NumPy array") from error
    if array.shape not in shapes or array.dtype != bool:
        n = shapes[0][0] if shapes[0] else 1
        raise ConfigError(
            f"expected a mask of shape {' or '.join(map(str, shapes))} and bool, one per {item}, got shape "
            f"{array.shape} and type {array.dtype}; for indices use np.isin(np.arange({n}), indices)"
        )
    return jnp.asarray(array)


def check_rates(control: Control, freq: int, rates: Mapping[Control, int | None]) -> None:
    """Check requested rates, Hz; a rate of None is not checked."""
    used_levels = {
        Control.state: (Control.state, Control.attitude, Control.force_torque),
        Control.rotor_vel: (),
    }.get(control, (control, Control.force_torque))
    for level, requested in rates.items():
        if requested is not None and freq % positive_integer(f"{level.value}_freq", requested) and level in used_levels:
            raise ConfigError(
                f"{level.value}_freq is {requested} Hz, which does not divide freq = {freq} Hz, so its period is "
                f"not a whole number of steps. Use the nearest rate below, {largest_divisor(freq, requested)} Hz."
            )


def control_freqs(
    control: Control, freq: int, rates: Mapping[Control, int | None], controller: Controller | None
) -> dict[Control, int]:
    """Return the rates at which commands take effect, Hz, by command level, for the levels in use.

    The allocation and fitted dynamics have no memory, so their rate may be as low as the rate of physics steps.

    Args:
        freq: Rate of physics steps, Hz.
        rates: Requested rates, Hz. Only the rate of the last level is used; None for the default, the largest
            divisor of ``freq`` up to 500 Hz.
        controller: Controller of the command level, as ``controller_at_rates`` returns it, with the rates of the other
            levels. None if the commands need no controller.
    """
    chain, last_level = controller_chain(controller, control)
    freqs = {}
    for level, level_controller in chain:
        outer_freq = level_controller.outer_freq if level == Control.state else None
        freqs[level] = level_controller.freq if outer_freq is None else outer_freq
    if last_level != Control.rotor_vel:
        name = f"{last_level.value}_freq"
        freqs[last_level] = rates.get(last_level) or default_rates(freq, {name: min(500, freq)})[name]
    return freqs


def default_rates(freq: int, defaults: Mapping[str, int], suffix: str = "") -> dict[str, int]:
    """Return default rates in a simulation: the largest divisors of ``freq`` up to the defaults, Hz.

    Args:
        freq: Rate of physics steps, Hz.
        defaults: Default rates by the names of their settings, Hz.
        suffix: Suffix of the names in messages.
    """

    def find_low_rates(freq: int) -> list[str]:
        limits = {name: min(default, max(freq, SLOW_FREQ)) for name, default in defaults.items()}
        return [name for name, limit in limits.items() if 2 * largest_divisor(freq, defaults[name]) < limit]

    if names := find_low_rates(freq):
        name, default = names[0], defaults[names[0]]
        candidates = (f for k in itertools.count(1) for f in (freq + k, freq - k) if f > 0)
        usable_freq = next(f for f in candidates if not find_low_rates(f))
        raise ConfigError(
            f"expected a freq with a divisor near {default} Hz, the default of {name}{suffix}, got {freq} Hz, whose "
            f"largest divisor up to that is {largest_divisor(freq, default)} Hz. Use freq={usable_freq}, or set "
            f"{name}{suffix}."
        )
    return {name: largest_divisor(freq, default) for name, default in defaults.items()}


def dividing_rate(name: str, rate: object, freq: int) -> int:
    """Return a rate that divides ``freq``, Hz."""
    rate = positive_integer(name, rate)
    if freq % rate:
        raise ConfigError(
            f"expected {name} to divide freq = {freq} Hz, got {rate} Hz. Use the nearest rate below, "
            f"{largest_divisor(freq, rate)} Hz."
        )
    return rate


def controller_at_rates(
    controller: Controller, control: Control, freq: int, requested_rates: Mapping[Control, int | None]
) -> Controller:
    """Return a controller with the rates that it has in a simulation, each a divisor of ``freq``.

    The requested rate of the command level is the rate of the outer loop if there is one; then the requested rate of
    attitude is the rate of ``update``, the inner loop. A rate equal to the default of its class is replaced by a rate
    from ``default_rates``.

    Args:
        freq: Rate of physics steps, Hz.
        requested_rates: Requested rates, Hz; None for the rates of the controller.
    """
    if isinstance(controller, Switch):
        members = tuple(
            controller_at_rates(member, control, freq, requested_rates) for member in controller.controllers
        )
        member_rates = {rate for member in members for rate in (member.freq, member.outer_freq) if rate is not None}
        common_freq = max(member_rates) if all(max(member_rates) % rate == 0 for rate in member_rates) else freq
        return dataclasses.replace(controller, controllers=members, freq=common_freq)
    requested = {"freq": requested_rates.get(control)}
    if control == Control.state and controller.has_outer:
        requested = {"outer_freq": requested_rates.get(control), "freq": requested_rates.get(Control.attitude)}
    class_defaults = {f.name: f.default for f in dataclasses.fields(controller)}  # type: ignore[arg-type]
    rates: dict[str, Any] = {}
    defaults, owner = {}, f" of controller {controller.name!r}"
    for name, requested_rate in requested.items():
        rate = getattr(controller, name) if requested_rate is None else requested_rate
        if requested_rate is None and rate == class_defaults[name]:
            defaults[name] = positive_integer(name + owner, rate)
        else:
            rates[name] = dividing_rate(name + owner, rate, freq)
    rates |= default_rates(freq, defaults, owner)
    if inner := controller.inner:
        rates["inner"] = controller_at_rates(inner, controller.output, freq, requested_rates)
    return dataclasses.replace(controller, **rates)  # type: ignore[type-var]


def largest_divisor(freq: int, limit: int) -> int:
    """Return the largest divisor of a rate that is not above a limit, Hz."""
    return next(f for f in range(min(limit, freq), 0, -1) if freq % f == 0)
