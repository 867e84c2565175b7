"""Kinematics of a trailer with two joints: a steered front axle on a drawbar, and a deck on its own rear axle."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.errors import ConfigError
from crazysim.lab.vehicles.car_params import CarParams
from crazysim.lab.vehicles.car_state import CarState, to_world_frame


def trailer_rates(state: CarState, params: CarParams) -> Array:
    """Return the rates of the headings of drawbar and deck, with axles that roll without slip, rad/s. (..., 2)

    The hitch moves with the vehicle. The component of its velocity across the drawbar turns the drawbar, and the
    component along it moves the front axle. The front axle's velocity across the deck turns the deck.
    """
    if params.trailer is None or state.joints is None:
        raise ConfigError(
            "expected parameters of a trailer, got none. Use CarParams.create(vehicle, freq, trailer=True)."
        )
    hitch, drawbar, axles = (params.trailer[..., k : k + 1] for k in range(3))
    vx, vy = state.body_vel[..., :1], state.body_vel[..., 1:] - hitch * state.yaw_rate
    bar_angle = state.yaw - state.joints[..., :1]
    cos, sin = jnp.cos(bar_angle), jnp.sin(bar_angle)
    longitudinal_vel, lateral_vel = cos * vx - sin * vy, sin * vx + cos * vy
    deck_angle = state.joints[..., :1] - state.joints[..., 1:]
    return jnp.concatenate([lateral_vel / drawbar, longitudinal_vel * jnp.sin(deck_angle) / axles], axis=-1)


def trailer_axles(state: CarState, params: CarParams) -> tuple[Array, Array]:
    """Return the positions of the middles of the trailer's front and rear axle, world frame, m. (..., 2) each"""
    hitch, drawbar, axles = (params.trailer[..., k : k + 1] for k in range(3))  # type: ignore[index]
    zero = jnp.zeros_like(state.yaw)
    hitch_pos = state.pos[..., :2] + to_world_frame(state.yaw, jnp.concatenate([zero - hitch, zero], axis=-1))
    front = hitch_pos + to_world_frame(state.joints[..., :1], jnp.concatenate([zero - drawbar, zero], axis=-1))  # type: ignore[index]
    rear = front + to_world_frame(state.joints[..., 1:], jnp.concatenate([zero - axles, zero], axis=-1))  # type: ignore[index]
    return front, rear
