"""The firmware's controllers against recorded outputs of its compiled C sources."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

import crazysim
from crazysim.control import Control, Setpoint
from crazysim.control.mellinger import Mellinger
from crazysim.control.pid import PID
from crazysim.core.airframes import AirframeSource
from crazysim.drones import load_airframe
from crazysim.dynamics.rotor import quadratic_curve
from crazysim.lab.live.attitude import from_rpy
from crazysim.lab.validate.rows import Row

FREQ, POSITION_PERIOD = 500, 5
"""Rate of the ticks, Hz, and number of ticks between two updates of the position controller."""
RECORDINGS = Path(crazysim.__file__).parents[1] / "tests"
"""Folder with the recorded outputs; it exists in a checkout of the sources only."""
FILTERED_AIRFRAME = {"base": "cf2x_L250", "pid": {"position": {"kd": [0.3] * 3}, "velocity": {"kd": [2.0] * 3}}}
"""Airframe with derivative gains of position and velocity, so that their filters have an effect."""
CASES: dict[str, tuple[Any, str, AirframeSource]] = {
    "pid-state": (PID(hold_yaw=True), "state", "cf2x_L250"),
    "pid-brushless": (PID(hold_yaw=True), "state", "cf21B_500"),
    "pid-filters": (PID(hold_yaw=True), "state", FILTERED_AIRFRAME),
    "pid-attitude": (PID(hold_yaw=True), "attitude", "cf2x_L250"),
    "pid-rate": (PID(hold_yaw=True), "body_rate", "cf2x_L250"),
    "mellinger": (Mellinger(), "state", "cf2x_L250"),
    "m-attitude": (Mellinger(), "attitude", "cf2x_L250"),
    "m-heavy": (Mellinger(), "state", "cf21B_500"),
}
"""Controller, command level and airframe, by name of the recording."""
MAX_TRUNCATION = 5.0
"""Largest loss of a motor by the firmware's integer arithmetic, PWM: roll, pitch, yaw and motor lose less than one
each. Where all motors are lowered by the excess of the highest motor, the loss of the highest motor is subtracted."""
MAX_ROUNDING = 3.0
"""Largest difference by rounding, PWM; yaw has a derivative gain of 0.35 * 500 * 120 PWM per degree."""


def recorded_pwm(name: str) -> NDArray:
    """Return the PWM of the motors by the compiled firmware. (n_ticks, n, 4)"""
    with np.load(RECORDINGS / "control" / "firmware_motors.npz") as file:
        return file[name].astype(float)


def pwm_differences(name: str, whole_numbers: bool = False) -> NDArray:
    """Return the absolute differences from the compiled firmware in 8 flights of 240 ticks, PWM. (240, 8, 4)

    Args:
        whole_numbers: Whether to compute in integers where the firmware does.
    """
    controller, mode, drone = CASES[name]
    states, commands = (x.astype(np.float32) for x in sample_flights(mode, 8, 240, seed=11))
    controller = dataclasses.replace(controller, whole_numbers=whole_numbers)
    return np.abs(compiled_pwm(controller, mode, states, commands, drone) - recorded_pwm(name))


def compare_controllers() -> Iterable[Row]:
    """Yield the largest differences of the PWM of motors from the compiled firmware."""
    for name, (controller, mode, drone) in CASES.items():
        airframe_text = f"`{drone}`" if isinstance(drone, str) else "`cf2x_L250` with derivative gains"
        for whole_numbers, bound in ((False, MAX_TRUNCATION + MAX_ROUNDING), (True, 1.0 + MAX_ROUNDING)):
            arithmetic = "integers as the firmware" if whole_numbers else "real numbers"
            quantity = f"{type(controller).__name__} on {mode} commands, {airframe_text}, {arithmetic}: motors"
            yield Row(
                quantity, "compiled C, 240 ticks", float(pwm_differences(name, whole_numbers).max()), "PWM", (0, bound)
            )


def sample_flights(mode: str, n: int, n_ticks: int, seed: int) -> tuple[NDArray, NDArray]:
    """Return states, (n_ticks, n, 13), and commands, (n_ticks, n, k), of n flights from gentle to wild.

    A state is pos, vel, quat, ang_vel; the yaw crosses +-180 degrees. Thrust is in PWM, and zero for a while in some
    flights. State commands change at the ticks of the position loop.
    """
    rng = np.random.default_rng(seed)
    amplitude = np.geomspace(0.02, 1.0, n)[:, None]  # the last flights turn upside down

    def smooth_signal(k: int, scale: Any, period: float) -> NDArray:
        phase, frequency_factor = rng.uniform(0, 2 * np.pi, (3, n, k)), rng.uniform(0.3, 1.7, (3, n, k))
        t = np.arange(n_ticks)[:, None, None, None] / FREQ
        return scale * np.sum(np.sin(2 * np.pi * t * frequency_factor / period + phase), axis=1) / 1.7

    pos, vel = smooth_signal(3, 2 * amplitude, 1.0), smooth_signal(3, 3 * amplitude, 0.7)
    # Rolls go upside down; pitch keeps away from 90 degrees, where rounding of the Euler angles is amplified.
    tilt, yaw = smooth_signal(2, 1.2 * amplitude, 0.5) * [1.0, 0.5], 3.0 + smooth_signal(1, 2.0, 0.9)
    quat = from_rpy(np.concatenate([tilt, yaw], axis=-1))
    ang_vel = smooth_signal(3, 10 * amplitude, 0.3)
    states = np.concatenate([pos, vel, quat, ang_vel], axis=-1)
    if mode == "state":
        tick_of_command = POSITION_PERIOD * (np.arange(n_ticks) // POSITION_PERIOD)
        desired_yaw = (yaw + smooth_signal(1, amplitude, 0.4))[tick_of_command, :, 0]
        quat_des = np.stack([0 * desired_yaw, 0 * desired_yaw, np.sin(desired_yaw / 2), np.cos(desired_yaw / 2)], -1)
        parts = [
            pos + smooth_signal(3, 1.5 * amplitude, 0.6),
            vel + smooth_signal(3, amplitude, 0.4),
            smooth_signal(3, 4 * amplitude, 0.5),
        ]
        rates = smooth_signal(3, 3 * amplitude, 0.3)
        commands = np.concatenate(
            [*(part[tick_of_command] for part in parts), quat_des, rates[tick_of_command]], axis=-1
        )
    else:
        thrust = np.clip(38000 + 40000 * amplitude * smooth_signal(1, 1.0, 0.5), 1000, 65535)
        thrust[n_ticks // 3 : n_ticks // 3 + 20, ::3] = 0
        angles = np.concatenate([tilt, yaw], axis=-1) + smooth_signal(3, amplitude, 0.4)
        commands = np.concatenate(
            [angles if mode == "attitude" else smooth_signal(3, 8 * amplitude, 0.3), thrust], axis=-1
        )
    return states, commands


def compiled_pwm(
    controller: Any, mode: str, states: NDArray, commands: NDArray, drone: AirframeSource = "cf2x_L250"
) -> NDArray:
    """Return the PWM of the motors by a controller of crazysim, in the precision of JAX. (n_ticks, n, 4)"""
    return np.asarray(_compiled_flight(controller, mode)(controller_constants(controller, drone), states, commands))


@functools.cache
def _compiled_flight(controller: Any, mode: str) -> Any:
    return jax.jit(functools.partial(_flight_pwm, controller, mode))


def controller_constants(controller: Any, drone: AirframeSource) -> tuple:
    """Return parameters and memory of a controller, collective thrust per unit of PWM, N, and the thrust curve."""
    airframe = load_airframe(drone)
    newton_per_pwm = 4 * float(airframe.value("rotors.thrust_max")) / 65535
    return (
        controller.params(airframe),
        controller.memory(airframe),
        newton_per_pwm,
        airframe.value("rotors.thrust_curve")[None],
    )


def _flight_pwm(controller: Any, mode: str, constants: tuple, states: Any, commands: Any) -> Array:
    params, initial_memory, newton_per_pwm, thrust_curve = constants
    initial_memory = jax.tree.map(jnp.asarray, initial_memory)
    if mode != "state":
        commands = commands * jnp.asarray([1, 1, 1, newton_per_pwm], commands.dtype)

    def tick(memory: Any, row: tuple) -> tuple[Any, Array]:
        k, s, c = row
        controls = SimpleNamespace(mode=Control(mode), state=SimpleNamespace(cmd=c))
        states = SimpleNamespace(pos=s[:3], vel=s[3:6], quat=s[6:10], ang_vel=s[10:13])
        data = SimpleNamespace(states=states, controls=controls)
        command = Setpoint.of_command(c) if mode == "state" else c
        if mode == "state" and controller.has_outer:
            outer_memory = controller.outer(data, command, memory, params)
            memory = jax.tree.map(lambda new, old: jnp.where(k % POSITION_PERIOD == 0, new, old), outer_memory, memory)
        rotor_vel, memory = controller.update(data, command, memory, params)
        thrust = jnp.where(rotor_vel > 0, quadratic_curve(rotor_vel, thrust_curve), 0.0)
        return memory, 4 * thrust / newton_per_pwm

    def fly_drone(states: Array, commands: Array) -> Array:
        ticks = jnp.arange(len(states))
        return jax.lax.scan(tick, initial_memory, (ticks, states, commands))[1]

    return jax.vmap(fly_drone, 1, 1)(states, commands)
