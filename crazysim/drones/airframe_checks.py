"""Checks that a drone with the numbers of an airframe can fly."""

from __future__ import annotations

import numpy as np

from crazysim.drones.airframe import GRAVITY_MAGNITUDE, Airframe
from crazysim.drones.keys import GUIDE, LAYOUT
from crazysim.errors import AirframeWarning, ConfigError, require, short_repr, warn
from crazysim.tables import INERTIA, check_numbers

MAX_ROTORS = 64
"""Largest number of rotors; the VoloCity, an air taxi, has 18."""
MAX_THRUST_TO_WEIGHT = 1000
"""Largest ratio of thrust to weight; racers have about 20."""
MAX_ANG_ACC = 1e6
"""Largest angular acceleration by the rotors, rad/s^2; built-in airframes have up to 3,600."""
MAX_ROTOR_VEL = 1e6
"""Largest rotor speed, rpm; built-in airframes have up to 40,000."""
MIN_SINGULAR_VALUE = 1e-3
"""Smallest singular value of the mixing matrix; a quadrotor in X has 2."""
MAX_INERTIA_EXCESS, INERTIA_ROUNDING = 0.05, 1e-5
"""Limits of the relative excess of the largest moment of inertia over the sum of the other two. An excess up to
``INERTIA_ROUNDING`` is ignored, and an excess up to ``MAX_INERTIA_EXCESS`` is only a warning, since moments that were
measured separately can have it. RotorPy's Crazyflie has 1%."""


def check_airframe(airframe: Airframe) -> None:
    """Check shapes, ranges and the consistency of an airframe's numbers.

    Warns:
        AirframeWarning: If the largest moment of inertia exceeds the sum of the other two by up to 5%.
    """
    for table in ("rigid_body", "rotors"):
        airframe.table(table)
    owner, position = f"airframe {airframe.name!r}", airframe.value("rotors.position")
    require(
        position.ndim == 2 and position.shape[1] == 3,
        f"{owner}: expected rotors.position of shape (n, 3), got {position.shape}",
    )
    n = len(position)
    require(
        n <= MAX_ROTORS,
        f"{owner}: expected at most {MAX_ROTORS} rotors, got {n}. Leave the others out of rotors.position.",
    )
    for path, value in airframe.values.items():
        check_numbers(owner, path, value, LAYOUT.keys[path], n)
    for path in ("rigid_body.mass", "rotors.yaw_torque_sign", "rotors.thrust_min", "rotors.thrust_max"):
        airframe.value(path)
    for check in (_check_inertia, _check_rotors, _check_curves, _check_forces, _check_controller, _check_camera):
        message = check(airframe)
        if message:
            raise ConfigError(f"{owner}: {message}. Check the number; {GUIDE} has the units.")


# Each check returns a message about the first problem, without its full stop, or None.


def _check_inertia(airframe: Airframe) -> str | None:
    inertia = airframe.inertia
    moments = np.sort(np.linalg.eigvalsh(inertia))
    if not np.allclose(inertia, inertia.T, atol=0) or not np.all((moments >= INERTIA.low) & (moments <= INERTIA.high)):
        return (
            f"expected an inertia of three positive moments {INERTIA.text}, or a symmetric positive definite 3 x 3 "
            f"matrix, got {short_repr(inertia.tolist())}"
        )
    excess = moments[2] / (moments[0] + moments[1]) - 1
    message = (
        f"expected an inertia whose largest moment is at most the sum of the others, as for every body, got "
        f"moments of {', '.join(f'{m:.4g}' for m in moments)} kg m^2"
    )
    if excess > MAX_INERTIA_EXCESS:
        return message
    if excess > INERTIA_ROUNDING:
        remedy = "Measure the moments again, or lower the largest."
        text = f"airframe {airframe.name!r}: {message}: {100 * excess:.1f}% more. {remedy}"
        warn(text, AirframeWarning)
    return None


def _check_rotors(airframe: Airframe) -> str | None:
    value = airframe.value
    n, mass = airframe.n_rotors, float(value("rigid_body.mass"))
    low, high, signs = value("rotors.thrust_min"), value("rotors.thrust_max"), value("rotors.yaw_torque_sign")
    # Rotors that can lift the drone.
    if not low < high:
        return f"expected 0 <= thrust_min < thrust_max, got {low} N and {high} N"
    if not n * low < mass * GRAVITY_MAGNITUDE < n * high <= MAX_THRUST_TO_WEIGHT * mass * GRAVITY_MAGNITUDE:
        return (
            f"expected rotors that lift {mass} kg, between their least and largest thrust and with at most "
            f"{MAX_THRUST_TO_WEIGHT} times its weight, got {n} rotors of {low} to {high} N"
        )
    if set(signs.tolist()) != {-1.0, 1.0}:
        return (
            f"expected yaw_torque_sign as 1 or -1 for each rotor, and not all equal, got {short_repr(signs.tolist())}"
        )
    if not airframe.arm > 0:
        return "expected rotors beside the centre of mass, got all of them at x = y = 0"
    # Rotors that can turn it about each axis.
    axes = "x and y" if n < 4 else "x, y and z"  # three rotors cannot hold the heading as well
    mixing = np.vstack([np.ones(n), airframe.mixing_matrix])[: 3 if n < 4 else 4]
    if np.linalg.matrix_rank(mixing, tol=MIN_SINGULAR_VALUE) < len(mixing):
        return (
            f"expected rotors whose thrusts lift the drone and turn it about {axes}, each alone, got positions (x, y) "
            f"{short_repr(value('rotors.position')[:, :2].tolist())} m with "
            f"yaw_torque_sign {short_repr(signs.tolist())}"
        )
    hover_thrusts = np.linalg.pinv(mixing)[:, 0] * mass * GRAVITY_MAGNITUDE
    if not np.all((hover_thrusts >= low) & (hover_thrusts <= high)):
        return (
            f"expected rotors that keep the drone level in hover with {low} to {high} N each, got "
            f"{short_repr(hover_thrusts.round(4).tolist())} N, which their positions around the centre of mass need"
        )
    # Plausible angular acceleration, and inertia of propellers.
    moments = np.linalg.eigvalsh(airframe.inertia)
    if airframe.arm * n * high / moments[0] > MAX_ANG_ACC:
        return (
            f"expected rotors that turn the body with at most {MAX_ANG_ACC:g} rad/s^2, got {high} N on arms of "
            f"{airframe.arm:g} m for moments of inertia from {moments[0]:.4g} kg m^2"
        )
    rotor_inertia = np.sum(np.broadcast_to(airframe.values.get("rotors.inertia", 0.0), n))
    if rotor_inertia > moments[-1]:
        return (
            f"expected propellers with a smaller inertia than the whole drone, got {rotor_inertia:.4g} and at most "
            f"{moments[-1]:.4g} kg m^2"
        )
    return None


def _check_curves(airframe: Airframe) -> str | None:
    numbers = airframe.values
    if "rotors.thrust_curve" in numbers:
        curves = np.atleast_2d(numbers["rotors.thrust_curve"])
        with np.errstate(all="ignore"):
            low, high = airframe.rotor_vel_limits
        if np.any(curves[:, 2] <= 0) or not np.all((low >= 0) & (low < high) & (high <= MAX_ROTOR_VEL)):
            return (
                f"expected thrust_curve with a positive quadratic term, that rises from thrust_min to thrust_max "
                f"between 0 and {MAX_ROTOR_VEL:g} rpm, got {short_repr(curves.tolist())}"
            )
        if "rotors.torque_curve" in numbers:
            k0, k1, k2 = np.atleast_2d(numbers["rotors.torque_curve"]).T
            torques = np.array([k0 + speed * (k1 + speed * k2) for speed in (low, high)])
            max_torque = MAX_ANG_ACC * np.min(np.linalg.eigvalsh(airframe.inertia)) / airframe.n_rotors
            hover_speed = airframe.rotor_vel([numbers["rigid_body.mass"] * GRAVITY_MAGNITUDE / airframe.n_rotors])
            if not np.all(k1 + 2 * k2 * hover_speed > 0):
                return (
                    f"expected torque_curve that rises at the speed of hover, got "
                    f"{short_repr(np.atleast_2d(numbers['rotors.torque_curve']).tolist())}"
                )
            if not np.all((torques >= 0) & (torques <= max_torque)):
                return (
                    f"expected torque_curve of at least 0 N m at the speeds of thrust_min and thrust_max, and at most "
                    f"{max_torque:.4g} N m, got {torques.min():.4g} to {torques.max():.4g} N m"
                )
    if "rotors.lag" in numbers:
        lag = np.atleast_2d(numbers["rotors.lag"])
        if np.any(lag[:, 0::2] + lag[:, 1::2] == 0):
            return (
                f"expected lag with a positive linear or quadratic term on spin-up and on spin-down, without which a "
                f"rotor never reaches its speed, got {short_repr(lag.tolist())}"
            )
    return None


def _check_forces(airframe: Airframe) -> str | None:
    numbers, n = airframe.values, airframe.n_rotors
    weight, max_thrust = numbers["rigid_body.mass"] * GRAVITY_MAGNITUDE, n * numbers["rotors.thrust_max"]
    for path in ("drag.coefficients", "fitted.so_rpy_rotor_drag.drag_coefficients"):
        if (
            path in numbers
            and np.max(np.linalg.eigvalsh((airframe.matrix(path) + airframe.matrix(path).T) / 2)) > 1e-12
        ):
            return f"expected {path} that brakes, so negative or zero, got {short_repr(numbers[path].tolist())}"
    for model in airframe.tables.get("fitted", {}):
        coefs = [numbers.get(f"fitted.{model}.{key}") for key in ("acc_coef", "cmd_f_coef")]
        if coefs[0] is not None and coefs[1] is not None and coefs[0] + coefs[1] * max_thrust <= weight:
            return (
                f"expected acc_coef and cmd_f_coef of fitted.{model} to lift {weight:.4g} N, got "
                f"{coefs[0] + coefs[1] * max_thrust:.4g} N at the largest thrust"
            )
    if numbers.get("battery.cells", 1.0) % 1:
        return f"expected battery.cells as a whole number, got {numbers['battery.cells']}"
    if "battery.thrust_over_voltage" in numbers and airframe.full_thrust_voltage is None:
        return (
            "expected battery.thrust_over_voltage to reach thrust_max at a positive voltage, got a curve that does not"
        )
    return None


def _check_controller(airframe: Airframe) -> str | None:
    low, high = (airframe.values.get(f"controller.pwm_{end}") for end in ("min", "max"))
    if low is not None and high is not None and not low < high:
        return f"expected pwm_min below pwm_max, got {low} and {high}"
    return None


def _check_camera(airframe: Airframe) -> str | None:
    camera = airframe.values.get("shape.track_camera")
    if camera is not None and not abs(camera[0]) > 0:
        return f"expected track_camera behind or ahead of the drone, with x other than 0, got {camera.tolist()}"
    return None
