"""Parameters of the dynamics of a ground vehicle, from the constants of its model."""

from __future__ import annotations

import math

from jax import Array

from crazysim.dynamics.models import GRAVITY, MAX_LAG_STEP
from crazysim.engine.pytree import PyTree, as_parameter, leaf
from crazysim.errors import ConfigError
from crazysim.lab.vehicles.model import VehicleModel

SLIP_SPEED = 0.1
"""Smallest value of ``CarParams.slip_speed``, m/s."""


class CarParams(PyTree):
    """Parameters of a ground vehicle with two axles, each with one value for all vehicles or one for each."""

    mass: Array = leaf("parameter", 1, (1,))
    """Mass of the vehicle with its wheels, kg. (1,)"""
    yaw_inertia: Array = leaf("parameter", 1, (1,))
    """Moment of inertia about the vertical axis through the centre of mass, kg m^2. (1,)"""
    front: Array = leaf("parameter", 1, (1,))
    """Distance of the front axle from the centre of mass, m. (1,)"""
    rear: Array = leaf("parameter", 1, (1,))
    """Distance of the rear axle from the centre of mass, m. (1,)"""
    stiffness: Array = leaf("parameter", 1, (2,))
    """Cornering stiffness of front and rear axle at small slip angles, N/rad. (2,)"""
    grip: Array = leaf("parameter", 1, (2,))
    """Largest horizontal force of front and rear axle, N. (2,)"""
    drive: Array = leaf("parameter", 1, (3,))
    """Force of the drive at motor reference 1, N, its decrease with speed, N s/m, and its dry friction, N. (3,)"""
    drive_max: Array = leaf("parameter", 1, (1,))
    """Largest force of the drive, N. (1,)"""
    front_share: Array = leaf("parameter", 1, (1,))
    """Fraction of the drive's force that acts on the front axle, 1. (1,)"""
    rolling: Array = leaf("parameter", 1, (2,))
    """Resistance of the wheels: increase with speed, N s/m, and dry friction, N. (2,)"""
    towed_mass: Array = leaf("parameter", 1, (1,))
    """Mass that the drive accelerates in addition to ``mass``: trailer, and J / r^2 of wheels and motors, kg. (1,)"""
    steer_max: Array = leaf("parameter", 1, (1,))
    """Largest steering angle, rad. (1,)"""
    steer_rate_max: Array = leaf("parameter", 1, (1,))
    """Largest rate of the steering angle, rad/s. (1,)"""
    steer_bandwidth: Array = leaf("parameter", 1, (1,))
    """Rate at which the steering angle approaches its command, 1/s. (1,)"""
    slip_speed: Array = leaf("parameter", 1, (1,))
    """Speed below which the forces of tyres and dry friction decrease, to zero at standstill, m/s. (1,)"""
    trailer: Array | None = leaf("parameter", 1, (3,))
    """Distance of the hitch behind the centre of mass, length of the drawbar, and distance between the axles of the
    trailer, m; None without a trailer. (3,)"""

    @staticmethod
    def create(vehicle: VehicleModel, freq: int, trailer: bool = False) -> CarParams:
        """Return the parameters of a vehicle model, the same for all vehicles.

        The grip of an axle is its static load times the friction coefficient; load transfer is neglected.

        Args:
            freq: Rate of the physics, Hz: if it is too low for tyres at ``SLIP_SPEED``, ``slip_speed`` is larger.
            trailer: Whether the vehicle tows its trailer.
        """
        number = vehicle.number
        n, wheel_mass, radius = number("wheels.number"), number("wheels.mass"), number("wheels.radius")
        front, rear, half_track = number("axles.front"), number("axles.rear"), number("axles.track") / 2
        mass = number("rigid_body.mass") + n * wheel_mass
        # Uniform cylinders: m (3 r^2 + w^2) / 12 about a diameter, m r^2 / 2 about the axis.
        wheel_yaw_inertia = wheel_mass * (3 * radius**2 + number("wheels.width") ** 2) / 12
        offset_yaw_inertia = wheel_mass * (half_track**2 + (front**2 + rear**2) / 2)
        yaw_inertia = number("rigid_body.yaw_inertia") + n * (wheel_yaw_inertia + offset_yaw_inertia)
        wheel_spin_inertia = number("wheels.armature") + wheel_mass * radius**2 / 2
        axle_loads = [-GRAVITY[2] * mass * x / (front + rear) for x in (rear, front)]
        is_kinematic = vehicle.dynamics == "kinematic"
        stiffness = [0.0, 0.0] if is_kinematic else [number("tyres.front"), number("tyres.rear")]
        moments = front**2 * stiffness[0] + rear**2 * stiffness[1]
        # The rates of lateral motion are at most ``rate_times_speed / speed``. Times the step they must stay below 1.
        rate_times_speed = max(sum(stiffness) / mass, moments / yaw_inertia)
        drive, drive_max = drive_constants(vehicle)
        slip_speed = max(SLIP_SPEED, rate_times_speed / freq)
        rolling = [n * number("wheels.damping") / radius**2, n * number("wheels.friction_loss") / radius]
        towed_mass = n * wheel_spin_inertia / radius**2 + (number("trailer.mass") if trailer else 0.0)
        damping = (drive[1] + rolling[0]) / (mass + towed_mass)
        if damping > MAX_LAG_STEP * freq:
            raise ConfigError(
                f"expected damping of vehicle {vehicle.name!r} to be slow for steps of 1/{freq} s, got {damping:.4g} "
                f"1/s. Use freq={math.ceil(damping / MAX_LAG_STEP)} or more, or less damping of drive and wheels."
            )
        return CarParams(
            mass=as_parameter(mass),
            yaw_inertia=as_parameter(yaw_inertia),
            front=as_parameter(front),
            rear=as_parameter(rear),
            stiffness=as_parameter(stiffness),
            grip=as_parameter([number("tyres.friction") * load for load in axle_loads]),
            drive=as_parameter(drive),
            drive_max=as_parameter(drive_max),
            front_share=as_parameter(vehicle.value("drive.front_share")),
            rolling=as_parameter(rolling),
            towed_mass=as_parameter(towed_mass),
            steer_max=as_parameter(vehicle.value("steering.angle_max")),
            steer_rate_max=as_parameter(vehicle.value("steering.rate_max")),
            steer_bandwidth=as_parameter(min(number("steering.bandwidth"), freq)),
            slip_speed=as_parameter(slip_speed),
            trailer=as_parameter([number(f"trailer.{x}") for x in ("hitch", "drawbar", "axle_distance")])
            if trailer
            else None,
        )


def drive_constants(vehicle: VehicleModel) -> tuple[list[float], float]:
    """Return gain, N, damping, N s/m, and friction, N, of the force of the whole drive, and its limit, N.

    The table's forces are for one of two axles, its torques for one driven wheel.
    """
    share = vehicle.number("drive.front_share")
    if "drive.force" in vehicle.numbers:
        factor, kind = 2.0, "force"
    else:
        n_driven_wheels = vehicle.number("wheels.number") / (2 if share in (0, 1) else 1)
        factor, kind = n_driven_wheels / vehicle.number("wheels.radius"), "torque"
    return (factor * vehicle.value(f"drive.{kind}")).tolist(), factor * vehicle.number(f"drive.{kind}_max")
