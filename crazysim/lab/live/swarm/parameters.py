"""Parameters of a simulated Crazyflie: their types and values, and the LEDs that some of them control."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazysim.drones import Airframe
from crazysim.errors import ConfigError, require

LED_OFF, LED_SOLID, LED_MEMORY, LED_FADE = 0, 7, 13, 14
"""Effects of the LED ring (``effectsFct`` in ledring12.c of crazyflie-firmware): dark, ``ring.solidRed`` and so on, the
memory of 12 LEDs, ``ring.fadeColor``."""
LIGHT_GROUPS = ("ring.", "colorLedBot.")
"""Prefixes of the names of parameters that control lights."""
INITIAL_POSE = ("kalman.initialX", "kalman.initialY", "kalman.initialZ", "kalman.initialYaw")
"""Names of the parameters that hold the pose of the estimate after ``kalman.resetEstimation``, m and rad."""


class Parameter(NamedTuple):
    """One parameter."""

    ctype: str
    """Type in C."""
    value: float = 0.0
    """Value at the start."""
    read_only: bool = False
    """Whether it cannot be written."""
    simulated: bool = True
    """Whether a new value has an effect in the simulation; other parameters refuse new values."""


PARAMETERS: dict[str, Parameter] = {
    "stabilizer.estimator": Parameter("uint8_t", 2, simulated=False),
    "stabilizer.controller": Parameter("uint8_t", 1, simulated=False),
    "kalman.resetEstimation": Parameter("uint8_t"),
    **{name: Parameter("float") for name in INITIAL_POSE},
    "commander.enHighLevel": Parameter("uint8_t", 1, simulated=False),
    **{f"flightmode.stabMode{axis}": Parameter("uint8_t", axis != "Yaw") for axis in ("Roll", "Pitch", "Yaw")},
    "locSrv.extPosStdDev": Parameter("float", 0.01, simulated=False),
    "locSrv.extQuatStdDev": Parameter("float", 0.0045, simulated=False),
    "hlCommander.groupmask": Parameter("uint8_t"),
    "ring.effect": Parameter("uint8_t", LED_OFF),
    "ring.neffect": Parameter("uint32_t", 18, read_only=True),
    **{f"ring.solid{color}": Parameter("uint8_t", 20) for color in ("Red", "Green", "Blue")},
    "ring.fadeColor": Parameter("uint32_t"),
    "ring.fadeTime": Parameter("float", 0.5),
    "ring.headlightEnable": Parameter("uint8_t", simulated=False),
    "colorLedBot.wrgb8888": Parameter("uint32_t"),
    "colorLedBot.brightCorr": Parameter("uint8_t", 1, simulated=False),
    "led.bitmask": Parameter("uint8_t", simulated=False),
    "sound.effect": Parameter("uint8_t", simulated=False),
    "deck.bcFlow2": Parameter("uint8_t", 1, read_only=True),
    "deck.bcLighthouse4": Parameter("uint8_t", read_only=True),
    "deck.bcLedRing": Parameter("uint8_t", 1, read_only=True),
    "deck.bcColorLedBot": Parameter("uint8_t", 1, read_only=True),
    "deck.bcColorLedTop": Parameter("uint8_t", read_only=True),
}
"""Parameters that every simulated drone has."""


def create_parameters(airframe: Airframe, has_multi_ranger: bool) -> dict[str, Parameter]:
    """Return the parameters of a drone, including its multi-ranger deck and its attitude gains.

    Args:
        airframe: Airframe; one without the gains of ``controller="pid"`` has no group ``pid_attitude``.
        has_multi_ranger: Whether the drone has a multi-ranger deck.
    """
    parameters = PARAMETERS | {"deck.bcMultiranger": Parameter("uint8_t", has_multi_ranger, read_only=True)}
    if "pid.attitude.kp" in airframe.values:
        for gain in ("kp", "ki", "kd"):
            values = np.asarray(airframe.value(f"pid.attitude.{gain}"), float)
            for axis, value in zip(("roll", "pitch", "yaw"), values.tolist(), strict=True):
                parameters[f"pid_attitude.{axis}_{gain}"] = Parameter("float", value, simulated=False)
    return parameters


class Parameters(Mapping[str, float]):
    """Values of the parameters of one drone."""

    def __init__(self, definitions: Mapping[str, Parameter]):
        self.definitions = dict(definitions)
        self._values = {name: float(definition.value) for name, definition in definitions.items()}
        self.light = Light()
        self.has_initial_pose = False

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    @property
    def initial_pose(self) -> NDArray:
        """Position, m, and yaw, rad, of the estimate after its reset. (4,)"""
        return np.array([self._values[name] for name in INITIAL_POSE])

    def get_value(self, name: str) -> float:
        """Return the value of a parameter."""
        self._require_parameter(name)
        return self._values[name]

    def _require_parameter(self, name: str) -> None:
        require(name in self.definitions, f"expected a parameter that the simulation has, got {name!r}. {GUIDE_REMARK}")

    def set(self, name: str, value: float, now: float) -> None:
        """Set a value."""
        self._require_parameter(name)
        definition = self.definitions[name]
        require(
            not definition.read_only and math.isfinite(value),
            f"expected a finite value of a parameter that can be written, got {name} = {value:g}",
        )
        # Clients read values in their format, so 0.0045 comes back with the rounding of float32.
        is_same = math.isclose(value, self._values[name], rel_tol=1e-6)
        is_known_effect = name != "ring.effect" or value in (LED_OFF, LED_SOLID, LED_MEMORY, LED_FADE)
        if not (is_known_effect and (definition.simulated or is_same)):
            raise ConfigError(
                f"expected a value whose effect is simulated, got {name} = {value:g}; it stays {self._values[name]:g}. "
                f"{GUIDE_REMARK}"
            )
        self._values[name] = value
        self.has_initial_pose |= name in INITIAL_POSE
        if name.startswith(LIGHT_GROUPS):
            self.light.update_color(self._values, name, now)


GUIDE_REMARK = 'The guide "Real drones and their scripts" lists the parameters.'


class Light:
    """Colour of a drone's light: of the LED ring or the colour LED deck, whichever was set last."""

    def __init__(self) -> None:
        self.memory = np.zeros((12, 3))
        self._start_color, self._target_color = np.zeros(3), np.zeros(3)
        self._start_time, self._duration = 0.0, 0.0

    def color(self, now: float) -> NDArray:
        """Return the colour at a time, s: red, green, blue from 0 to 1. (3,)"""
        fraction = (now - self._start_time) / self._duration if self.is_fading(now) and self._duration > 0 else 1.0
        return self._start_color + fraction * (self._target_color - self._start_color)

    def is_fading(self, now: float) -> bool:
        """Whether a fade is in progress; a reset of the time ends it."""
        return self._start_time <= now < self._start_time + self._duration

    def update_color(self, values: Mapping[str, float], name: str, now: float) -> None:
        """Update the colour from new values of parameters.

        Args:
            values: Values by name.
            name: Parameter that was set, or ``memory`` for the LEDs of the ring's memory.
            now: Time, s.
        """
        effect, duration = values["ring.effect"], 0.0
        parameters_by_effect = {
            LED_SOLID: ("ring.solidRed", "ring.solidGreen", "ring.solidBlue"),
            LED_FADE: ("ring.fadeColor",),
        }
        if name.startswith("colorLedBot."):
            white, *color = int(values["colorLedBot.wrgb8888"]).to_bytes(4, "big")
            target_color = np.minimum(np.array(color) + white, 255) / 255
        elif name not in ("ring.effect", *parameters_by_effect.get(int(effect), ("memory",))):
            return
        elif effect == LED_SOLID:
            target_color = np.array([values[color] for color in parameters_by_effect[LED_SOLID]]) / 255
        elif effect == LED_FADE:
            target_color = np.array(list((int(values["ring.fadeColor"]) & 0xFFFFFF).to_bytes(3, "big"))) / 255
            duration = max(values["ring.fadeTime"], 0.0)
        else:
            target_color = self.memory.mean(axis=0) if effect == LED_MEMORY else np.zeros(3)
        self._start_color, self._target_color = self.color(now), target_color
        self._start_time, self._duration = now, duration
