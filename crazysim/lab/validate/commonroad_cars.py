"""The single-track car of CommonRoad's vehicle models under the same commands."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.engine.pytree import as_parameter
from crazysim.lab.validate.rows import Row
from crazysim.lab.vehicles.car_params import SLIP_SPEED, CarParams
from crazysim.lab.vehicles.car_state import CarState
from crazysim.lab.vehicles.commonroad import CommonRoadParams, CommonRoadState, commonroad_single_track
from crazysim.lab.vehicles.single_track import single_track

REFERENCE = "CommonRoad, BMW 320i"
"""Reference in the rows."""
INTEGRATION_STEP, DURATION, INITIAL_SPEED = 0.005, 6.0, 15.0
"""Step of Runge-Kutta and duration of the drives, s, and their speed at the start, m/s."""


def commonroad_params(car: Any) -> CommonRoadParams:
    """Return the parameters of a CommonRoad vehicle for ``commonroad_single_track``."""
    numbers = {
        "friction": car.tire.p_dy1,
        "stiffness": [-car.tire.p_ky1 / car.tire.p_dy1] * 2,
        "axle_distances": [car.a, car.b],
        "height": car.h_s,
        "mass": car.m,
        "yaw_inertia": car.I_z,
        "steer": [car.steering.min, car.steering.max],
        "steer_rate": [car.steering.v_min, car.steering.v_max],
        "speed": [car.longitudinal.v_min, car.longitudinal.v_max],
        "switch_speed": car.longitudinal.v_switch,
        "acc_max": car.longitudinal.a_max,
    }
    return CommonRoadParams(**{name: as_parameter(x) for name, x in numbers.items()})


def commonroad_rates(state: ArrayLike, command: ArrayLike, params: CommonRoadParams) -> Array:
    """Return the rates of states under commands, by CommonRoad's model. (..., 7)

    The order is CommonRoad's: x, y, steering angle, speed, yaw, yaw rate, slip angle.
    """
    x = jnp.asarray(state)
    car_state = CommonRoadState(x[..., :2], *(x[..., k : k + 1] for k in range(2, 7)))
    return jnp.concatenate(commonroad_single_track(car_state, jnp.asarray(command), params), axis=-1)


def crazysim_rates(state: ArrayLike, command: ArrayLike, params: CommonRoadParams) -> Array:
    """Return the rates by ``single_track``, the model of crazysim's cars, whose tyres have limited grip. (7,)

    Steering angle and acceleration follow the commands within CommonRoad's limits.
    """
    x, p = jnp.asarray(state), params
    limited_rates = commonroad_rates(state, command, params)
    zero, speed, slip = jnp.zeros(1), x[3:4], x[6:7]
    loads = p.mass * GRAVITY_MAGNITUDE * p.axle_distances[..., ::-1] / jnp.sum(p.axle_distances)
    car = CarParams(
        mass=p.mass, yaw_inertia=p.yaw_inertia, front=p.axle_distances[..., :1], rear=p.axle_distances[..., 1:],
        stiffness=p.friction * p.stiffness * loads, grip=p.friction * loads, drive=jnp.stack([p.mass[0], 0, 0]),
        drive_max=jnp.full(1, jnp.inf), front_share=zero, rolling=jnp.zeros(2), towed_mass=zero,
        steer_max=p.steer[..., 1:], steer_rate_max=p.steer_rate[..., 1:], steer_bandwidth=zero,
        slip_speed=jnp.full(1, SLIP_SPEED), trailer=None,
    )  # fmt: skip
    vel = speed * jnp.concatenate([jnp.cos(slip), jnp.sin(slip)])
    rates = single_track(CarState(jnp.zeros(3), x[4:5], vel, x[5:6], x[2:3], zero), limited_rates[3:4], car)
    acc, slip_rate = rates.body_vel, (vel[:1] * rates.body_vel[1:] - vel[1:] * rates.body_vel[:1]) / speed**2
    tangential_acc = (vel @ acc)[None] / speed
    return jnp.concatenate([rates.pos[:2], limited_rates[2:3], tangential_acc, rates.yaw, rates.yaw_rate, slip_rate])


def lane_change(t: float, rate: float) -> list[float]:
    """Return the command of a lane change and braking: rate of the steering angle, rad/s, and acceleration, m/s^2.

    Args:
        t: Time, s.
        rate: Size of the rate of the steering angle, rad/s.
    """
    steps = ((0.0, 0.0), (1.0, rate), (1.5, -rate), (2.0, 0.0), (2.5, -rate), (3.0, rate), (3.5, 0.0))
    return [next(r for start, r in reversed(steps) if t >= start), 1.0 if t < 4 else -1.0]


def simulate_drive(rates: Callable[[NDArray, list[float]], ArrayLike], initial_state: NDArray, rate: float) -> NDArray:
    """Return the state after a lane change, by Runge-Kutta of order 4.

    Args:
        rates: Function that returns the rates of a state under a command.
        initial_state: State at the start.
        rate: Size of the rate of the steering angle, rad/s.
    """
    x = initial_state
    for k in range(round(DURATION / INTEGRATION_STEP)):
        command = lane_change(k * INTEGRATION_STEP, rate)
        k1 = np.asarray(rates(x, command))
        k2 = np.asarray(rates(x + INTEGRATION_STEP / 2 * k1, command))
        k3 = np.asarray(rates(x + INTEGRATION_STEP / 2 * k2, command))
        x = x + INTEGRATION_STEP / 6 * (k1 + 2 * k2 + 2 * k3 + np.asarray(rates(x + INTEGRATION_STEP * k3, command)))
    return x


def compare_with_commonroad() -> Iterable[Row]:
    """Yield differences from CommonRoad's single-track model, of rates and of drives under the same commands."""
    model = importlib.import_module("vehiclemodels.vehicle_dynamics_st").vehicle_dynamics_st
    car = importlib.import_module("vehiclemodels.parameters_vehicle2").parameters_vehicle2()
    rng, n = np.random.default_rng(0), 500
    max_speed, max_steer = car.longitudinal.v_max, car.steering.max
    x = rng.uniform([-9, -9, -max_steer, 0.5, -3, -1, -0.3], [9, 9, max_steer, max_speed, 3, 1, 0.3], (n, 7))
    x[:25, 2], x[25:50, 3] = max_steer, max_speed  # at the stops of the steering angle and of the speed
    u = rng.uniform([-2, -2], [2, 2], (n, 2)) * [car.steering.v_max, car.longitudinal.a_max]
    reference_rates = np.array([model(list(row), list(command), car) for row, command in zip(x, u, strict=True)])
    with jax.enable_x64(True):
        params = commonroad_params(car)
        own_rates = np.asarray(commonroad_rates(x, u, params))
        # rounding of float64 in differences of terms up to 1,000 times as large
        difference = float(np.max(np.abs(own_rates - reference_rates) / (1 + np.abs(reference_rates))))
        yield Row("rates of 500 states, commands beyond the limits", REFERENCE, difference, "", (0, 1e-11))
        rate_laws = [jax.jit(lambda x, u, law=law: law(x, u, params)) for law in (commonroad_rates, crazysim_rates)]
        initial_state = np.array([0.0, 0, 0, INITIAL_SPEED, 0, 0, 0])
        for rate in (0.03, 0.12):
            reference = simulate_drive(lambda x, u: model(list(x), list(u), car), initial_state, rate)
            commonroad_state, single_track_state = (simulate_drive(law, initial_state, rate) for law in rate_laws)
            manoeuvre = f"lane change, steering at {rate:g} rad/s, {DURATION:g} s"
            difference = float(np.linalg.norm((commonroad_state - reference)[:2]))
            yield Row(f"{manoeuvre}: `commonroad_single_track`, position", REFERENCE, difference, "m", (0, 1e-9))
            for k, direction in enumerate(("along", "across")):
                yield Row(
                    f"{manoeuvre}: `single_track`, position {direction}",
                    REFERENCE,
                    float(abs(single_track_state - reference)[k]),
                    "m",
                    remark=f"of {reference[k]:.3g} m",
                )
