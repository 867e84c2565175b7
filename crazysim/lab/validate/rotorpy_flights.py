"""Wrenches and flights of RotorPy's Crazyflie 2.0 at the same rotor speeds."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from crazysim.core.plugin import Plugin
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.dynamics.rotor import RPM_TO_RAD_S
from crazysim.engine.stage import stage
from crazysim.lab.validate.closed_forms import angle_between, read_state, with_states
from crazysim.lab.validate.rows import Row
from crazysim.plugins.effects import RotorAerodynamics, Wind
from crazysim.sim.sim import Sim

FREQ, PERIOD = 1000, 0.1
"""Rate of crazysim's steps, Hz, and time between two commands, s."""
WIND = np.array([3.0, -1.0, 0.5])
"""Wind of the flights in moving air, world frame, m/s."""
INITIAL_STATES = {
    "pos": np.array([0.0, 0.0, 50.0]),
    "vel": np.array([0.5, -0.3, 0.2]),
    "ang_vel": np.array([0.2, -0.1, 0.3]),
}
"""States at the start, m, m/s, rad/s."""

States = list[dict[str, NDArray]]
"""States at several times; variables have crazysim's names."""


def hover_speed(params: dict[str, Any]) -> float:
    """Return the rotor speed of hover, rad/s."""
    return math.sqrt(params["mass"] * GRAVITY_MAGNITUDE / (params["num_rotors"] * params["k_eta"]))


def create_simulation(params: dict[str, Any], n_worlds: int = 1, drag: bool = True) -> Sim:
    """Return a simulation of an airframe with RotorPy's parameters.

    Args:
        params: RotorPy's parameters of a multirotor without parasitic drag and translational lift.
        drag: True for a linear drag as large as the drag of the rotors in hover, False for none.
    """
    hub_positions, lag_rate = np.stack(list(params["rotor_pos"].values())), 1 / params["tau_m"]
    linear_drag = -len(hub_positions) * hover_speed(params) * np.array([params["k_d"], params["k_d"], params["k_z"]])
    rotors = {
        "position": hub_positions,
        "yaw_torque_sign": params["rotor_directions"],
        "thrust_curve": [0.0, 0.0, params["k_eta"] * RPM_TO_RAD_S**2],
        "torque_curve": [0.0, 0.0, params["k_m"] * RPM_TO_RAD_S**2],
        "lag": [lag_rate, 0.0, lag_rate, 0.0],
        "thrust_max": params["k_eta"] * params["rotor_speed_max"] ** 2,
    }
    tables: dict[str, Any] = {"base": "cf2x_L250", "rigid_body": {"mass": params["mass"]}, "rotors": rotors}
    tables["drag"] = {"coefficients": linear_drag * drag}
    sim = Sim(n_worlds, drone=tables, control="rotor_vel", integrator="rk4", freq=FREQ)
    p, inertia = sim.data.params, np.diag([params["Ixx"], params["Iyy"], params["Izz"]])
    # Set as parameters, as an airframe would cause a warning: the largest moment exceeds the sum of the others.
    changes = {"J": inertia, "J_inv": np.linalg.inv(inertia), "prop_inertia": np.zeros_like(p.prop_inertia)}
    sim.data = sim.data.replace(params=p.replace(**{k: np.asarray(x, p.J.dtype) for k, x in changes.items()}))
    return sim


def rotor_aerodynamics(params: dict[str, Any]) -> RotorAerodynamics:
    """Return the effect with the coefficients of RotorPy's rotors."""
    return RotorAerodynamics(drag=params["k_d"], inflow=params["k_z"], hub_height=0.0)


def fly_crazysim(
    params: dict[str, Any], commands: NDArray, effects: Sequence[Plugin] = (), drag: bool = False
) -> States:
    """Return the states of a flight in crazysim after each command.

    Args:
        commands: Speeds of the rotors, rad/s. (n, 4)
        effects: Effects of the air.
        drag: See ``create_simulation``.
    """
    sim = create_simulation(params, drag=drag)
    for effect in effects:
        sim.add(effect)
    sim.data = with_states(sim.data, **INITIAL_STATES, rotor_vel=np.full(4, hover_speed(params) / RPM_TO_RAD_S))
    states = []
    for command in commands:
        sim.rotor_vel_control(command[None, None] / RPM_TO_RAD_S)
        sim.step(round(PERIOD * FREQ))
        states.append(read_state(sim))
    return states


def fly_rotorpy(params: dict[str, Any], commands: NDArray, aero: bool = False) -> States:
    """Return the states of a flight in RotorPy after each command, with crazysim's names and units.

    Args:
        commands: Speeds of the rotors, rad/s. (n, 4)
        aero: True to fly in ``WIND`` with RotorPy's aerodynamic forces, False for neither.
    """
    multirotor = importlib.import_module("rotorpy.vehicles.multirotor").Multirotor
    drone = multirotor(params, aero=aero, integrator_kwargs={"rtol": 1e-10, "atol": 1e-12})
    state = {
        "x": INITIAL_STATES["pos"],
        "v": INITIAL_STATES["vel"],
        "q": np.array([0.0, 0.0, 0.0, 1.0]),
        "w": INITIAL_STATES["ang_vel"],
    }
    state |= {"wind": WIND * aero, "rotor_speeds": np.full(4, hover_speed(params))}
    states = []
    for command in commands:
        state = drone.step(state, {"cmd_motor_speeds": command}, PERIOD)
        names = {"pos": "x", "vel": "v", "quat": "q", "ang_vel": "w", "rotor_vel": "rotor_speeds"}
        states.append({own_name: np.asarray(state[name]) for own_name, name in names.items()})
        states[-1]["rotor_vel"] = states[-1]["rotor_vel"] / RPM_TO_RAD_S
    return states


def state_differences(a: dict[str, NDArray], b: dict[str, NDArray]) -> dict[str, float]:
    """Return the differences of two states: the angle for ``quat``, degrees, and the norm for other variables."""
    differences = {name: float(np.linalg.norm(a[name] - b[name])) for name in a}
    return differences | {"quat": math.degrees(angle_between(a["quat"], b["quat"]))}


def compute_air_wrenches(params: dict[str, Any], speed: float, n: int = 100) -> tuple[NDArray, NDArray]:
    """Return the additional forces and torques of the air in ``n`` states, in crazysim and in RotorPy.

    Args:
        speed: Largest velocity along each axis, m/s. Body rates reach 3 rad/s, rotor speeds 10% from hover.

    Returns:
        Force, N, and torque, N m, body frame, of crazysim, and of RotorPy. (n, 6) each
    """
    rng = np.random.default_rng(1)
    vel, ang_vel = rng.uniform(-speed, speed, (n, 3)), rng.uniform(-3, 3, (n, 3))
    speeds = hover_speed(params) * rng.uniform(0.9, 1.1, (n, 4))
    sim = create_simulation(params, n)
    plugin = sim.add(rotor_aerodynamics(params))
    moving_data = with_states(
        sim.data, vel=vel[:, None], ang_vel=ang_vel[:, None], rotor_vel=speeds[:, None] / RPM_TO_RAD_S
    )
    s = stage("drone")(plugin.influence)(moving_data).states
    drag = vel @ np.asarray(sim.data.params.drag_matrix).reshape(3, 3)
    own_values = np.concatenate([np.asarray(s.force)[:, 0] + drag, np.asarray(s.torque)[:, 0]], axis=-1)
    multirotor = importlib.import_module("rotorpy.vehicles.multirotor").Multirotor
    rotorpy, rotorpy_without_drag = multirotor(params), multirotor(params, aero=False)
    reference_values = [
        np.concatenate(rotorpy.compute_body_wrench(*x)) - np.concatenate(rotorpy_without_drag.compute_body_wrench(*x))
        for x in zip(ang_vel, speeds, vel, strict=True)
    ]
    return own_values, np.stack(reference_values)


def compare_with_rotorpy() -> Iterable[Row]:
    """Yield differences of flights under the same commands of the rotors, and of wrenches in moving air."""
    params = importlib.import_module("rotorpy.vehicles.crazyflie_params").quad_params
    commands = hover_speed(params) * (1 + np.random.default_rng(0).uniform(-0.02, 0.02, (20, 4)))
    with jax.enable_x64(True):
        own_values, reference_values = fly_crazysim(params, commands[:10]), fly_rotorpy(params, commands[:10])
        differences = state_differences(own_values[-1], reference_values[-1])
        drag_only = fly_crazysim(params, commands, [Wind(WIND)], drag=True)
        own_values = fly_crazysim(params, commands, [Wind(WIND), rotor_aerodynamics(params)], drag=True)
        reference_values = fly_rotorpy(params, commands, aero=True)
        slow, fast = (compute_air_wrenches(params, speed) for speed in (0.1, 3.0))
    # RotorPy's integrator has a relative tolerance of 1e-10 in each of about 100 steps
    for name, quantity, unit, bound in (("pos", "position", "m", 1e-8), ("quat", "attitude", "degrees", 1e-6),
                                    ("ang_vel", "angular velocity", "rad/s", 1e-8),
                                    ("rotor_vel", "rotor speeds", "rpm", 1e-4)):  # fmt: skip
        yield Row(f"flight without air, 1 s: {quantity}", "RotorPy", differences[name], unit, (0, bound))
    own_wrench, reference_wrench = fast
    for quantity, axes, unit in (("force across the rotors", [0, 1], "N"), ("yaw torque", [5], "N m")):
        remark = f"RotorPy: up to {np.abs(reference_wrench[:, axes]).max():.2g} {unit}"
        yield Row(
            f"air at up to 3 m/s: {quantity}",
            "RotorPy",
            float(np.abs(own_wrench - reference_wrench)[:, axes].max()),
            unit,
            (0, 1e-15),
            remark,
        )
    for speed, (own_wrench, reference_wrench) in ((0.1, slow), (3.0, fast)):
        for quantity, axes, unit in (("force along the rotors", [2], "N"), ("roll and pitch torque", [3, 4], "N m")):
            remark = f"RotorPy: up to {np.abs(reference_wrench[:, axes]).max():.2g} {unit}"
            difference = float(np.abs(own_wrench - reference_wrench)[:, axes].max())
            yield Row(f"air at up to {speed:g} m/s: {quantity}", "RotorPy", difference, unit, None, remark)
    for seconds in (1, 2):
        k = round(seconds / PERIOD) - 1
        differences, drag_only_differences = (
            state_differences(own_values[k], reference_values[k]),
            state_differences(drag_only[k], reference_values[k]),
        )
        for name, quantity, unit in (("pos", "position", "m"), ("quat", "attitude", "degrees")):
            remark = f"linear drag alone: {drag_only_differences[name]:.3g} {unit}"
            yield Row(f"flight in wind, {seconds} s: {quantity}", "RotorPy", differences[name], unit, None, remark)
