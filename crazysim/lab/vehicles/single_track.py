"""Dynamics of a vehicle on tyres: the single-track model, smooth at standstill, in reverse and while it slides."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from crazysim.lab.vehicles.car_params import CarParams
from crazysim.lab.vehicles.car_state import CarState, to_world_frame
from crazysim.lab.vehicles.trailer import trailer_rates
from crazysim.rotation import clip


def drive_force(reference: Array, speed: Array, params: CarParams) -> Array:
    """Return the force with which the wheels push the vehicle forwards on ground with enough grip, N. (..., 1)

    The total is the motor's force ``gain d - damping v - friction sgn(v)``, limited, minus the resistance of the
    wheels. A part of the total accelerates wheels, motors and a trailer, and the rest acts on the vehicle. The sign of
    the speed changes smoothly within ``slip_speed``.

    Args:
        reference: Motor reference d, 1. (..., 1)
        speed: Forward velocity v, m/s. (..., 1)
    """
    p = params
    sign = speed * lax.rsqrt(speed * speed + p.slip_speed * p.slip_speed)
    motor = p.drive[..., :1] * reference - p.drive[..., 1:2] * speed - p.drive[..., 2:] * sign
    motor = clip(motor, -p.drive_max, p.drive_max)
    resistance = p.rolling[..., :1] * speed + p.rolling[..., 1:] * sign
    return (motor - resistance) * (p.mass / (p.mass + p.towed_mass))


def tyre_force(drive: Array, vel: Array, stiffness: Array, grip: Array, slip_speed: Array) -> tuple[Array, Array]:
    """Return the force of the tyres of an axle along and across its wheels, N. (..., 1) each

    The force across is the cornering stiffness times the lateral slip ``-v_across / |v_along|``, the tangent of the
    slip angle. Here ``|v_along|`` is ``sqrt(v_along^2 + slip_speed^2)``, so that the tyre of a slow wheel damps lateral
    motion. With the vector f of both forces without a limit, the result is ``f / sqrt(1 + |f|^2 / grip^2)``: close to f
    where f is small, and never larger than the grip (a friction circle).

    Args:
        drive: Force of the drive along the wheel without a limit, N. (..., 1)
        vel: Velocity of the axle along and across its wheels, m/s. (..., 2)
        stiffness: Cornering stiffness, N/rad. (..., 1)
        grip: Largest force, N. (..., 1)
        slip_speed: Speed below which slip forces decrease, m/s. (..., 1)
    """
    longitudinal_vel, lateral_vel = vel[..., :1], vel[..., 1:]
    slip_force = -stiffness * lateral_vel * lax.rsqrt(longitudinal_vel * longitudinal_vel + slip_speed * slip_speed)
    # Both forces share the grip; saturation is smooth.
    squared_grip_ratio = (drive * drive + slip_force * slip_force) / (grip * grip)
    scale = lax.rsqrt(1 + squared_grip_ratio)
    return drive * scale, slip_force * scale


def steer_rate(state: CarState, command: Array, params: CarParams) -> Array:
    """Return the rate of the steering angle towards its command within the limits of the servo, rad/s. (..., 1)"""
    p = params
    target = clip(command[..., 1:2], -p.steer_max, p.steer_max)
    return clip(p.steer_bandwidth * (target - state.steer), -p.steer_rate_max, p.steer_rate_max)


def single_track(state: CarState, command: Array, params: CarParams, wrench: Array | None = None) -> CarState:
    """Return the time derivative of the state of a vehicle with one tyre per axle.

    Newton's equations in the body frame, with the forces of ``tyre_force`` on both axles:

        m (v_x' - v_y w) = F_r + F_f cos(d) - S_f sin(d),  m (v_y' + v_x w) = S_r + F_f sin(d) + S_f cos(d),
        I w' = l_f (F_f sin(d) + S_f cos(d)) - l_r S_r

    with forces along F and across S of front and rear wheels and the steering angle d. Rajamani, "Vehicle Dynamics and
    Control", 2012, section 2.3; the forces of the drive act on both axles as in the simulator of AIMotionLab's cars.

    Args:
        command: Motor reference, 1, and steering angle, rad. (..., 2)
        wrench: External force forwards and to the left, N, and torque about the vertical axis, N m, body frame; None
            for no external wrench. (..., 3)
    """
    p, vx, vy, w = params, state.body_vel[..., :1], state.body_vel[..., 1:], state.yaw_rate
    # Forces of the tyres along and across their wheels.
    drive = drive_force(command[..., :1], vx, p)
    cos, sin = jnp.cos(state.steer), jnp.sin(state.steer)
    front_vy, rear_vy = vy + p.front * w, vy - p.rear * w
    wheel_vel = jnp.concatenate([cos * vx + sin * front_vy, cos * front_vy - sin * vx], axis=-1)
    front = tyre_force(p.front_share * drive, wheel_vel, p.stiffness[..., :1], p.grip[..., :1], p.slip_speed)
    rear_vel = jnp.concatenate([vx, rear_vy], axis=-1)
    rear = tyre_force((1 - p.front_share) * drive, rear_vel, p.stiffness[..., 1:], p.grip[..., 1:], p.slip_speed)
    # Sum of the forces, and torque about the centre of mass.
    front_side_force = sin * front[0] + cos * front[1]
    force_x, force_y = rear[0] + cos * front[0] - sin * front[1], rear[1] + front_side_force
    torque = p.front * front_side_force - p.rear * rear[1]
    if wrench is not None:
        force_x, force_y, torque = force_x + wrench[..., :1], force_y + wrench[..., 1:2], torque + wrench[..., 2:]
    # The body's axes turn with the yaw rate.
    acc = jnp.concatenate([force_x / p.mass + vy * w, force_y / p.mass - vx * w], axis=-1)
    return state_rates(state, acc, torque / p.yaw_inertia, steer_rate(state, command, p), p)


def state_rates(state: CarState, acc: Array, yaw_acc: Array, steer_vel: Array, params: CarParams) -> CarState:
    """Return the derivative of a state from the rates of body velocity, yaw rate and steering angle."""
    vel = to_world_frame(state.yaw, state.body_vel)
    return CarState(
        pos=jnp.concatenate([vel, jnp.zeros_like(yaw_acc)], axis=-1),
        yaw=state.yaw_rate,
        body_vel=acc,
        yaw_rate=yaw_acc,
        steer=steer_vel,
        distance=state.body_vel[..., :1],
        joints=None if state.joints is None else trailer_rates(state, params),
    )
