"""Capabilities and missing parameters of an airframe as text, and a picture of its body, for ``crazysim airframe``."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from crazysim.control import AllocationParams, AttitudeParams, StateParams
from crazysim.control.allocation import hover_rotor_vel, max_thrust_without_torque, yaw_arm
from crazysim.control.auto import Auto
from crazysim.control.bandwidth import max_ang_acc, precession_rate, rotor_rate
from crazysim.control.controllers import find_controller
from crazysim.control.crazyflow import Crazyflow
from crazysim.drones import Airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.dynamics import Dynamics, supported_dynamics
from crazysim.dynamics.models import require_freq
from crazysim.errors import ConfigError, optional_import
from crazysim.storage import open_replacement

STATE_CONTROLLERS = ("auto", "geometric", "indi", "lqr", "pid", "mellinger")
"""Controllers that follow state commands, besides Crazyflow's cascade."""
QUARTER_TURN = np.pi / 2
"""Angle of the turn for which duration and largest rate are printed, rad."""
MIN_THRUST_TO_WEIGHT = 1.5
"""Thrust over weight below which a warning is given (dimensionless)."""
MIN_AUTHORITY = {"roll": 4.0, "pitch": 4.0, "yaw": 0.2}
"""Angular acceleration under controller ``auto`` below which a warning is given, rad/s^2: the smallest values among the
airframes in the tests."""
MAX_PRECESSION_RATIO = 2.5
"""Ratio of the precession rate to the bandwidth of the attitude loop above which ``auto`` may be unstable
(dimensionless). Of 1,960 random airframes with an odd number of rotors, all with ratios up to 2.45 fly, and the one
with 4.3 does not."""
MAX_PRECESSION_FRACTION = 0.25
"""Ratio of the gyroscopic torque of the rotors at 1 rad/s to the largest roll or pitch torque, above which a warning is
given (dimensionless)."""
MAX_TIME_CONSTANT = 0.2
"""Time constant of rotors above which a warning is given, s: the longest among the airframes in the tests."""
DEFAULT_FREQ = 500
"""Default rate of the physics, Hz."""


def describe_airframe(airframe: Airframe) -> str:
    """Return a report on an airframe: capabilities, missing parameters of each controller, and warnings."""
    rows = [("airframe", airframe.name), *_body_rows(airframe)]
    dynamics = supported_dynamics(airframe)
    rows.append(("dynamics", ", ".join(dynamics) or "none"))
    if Dynamics.first_principles in dynamics:
        rows += _rotor_rows(airframe)
    rows += [("battery", _battery_text(airframe)), *_controller_rows(airframe, dynamics)]
    rows += [("warning", text) for text in _warnings(airframe, dynamics)]
    return "\n".join(f"{name:22}{text}" for name, text in rows)


def draw_airframe(airframe: Airframe, path: Path) -> None:
    """Write a picture of the body, seen from the front and above.

    Raises:
        ImportError: If matplotlib is not installed.
        RenderError: If there is no OpenGL.
    """
    from crazysim.sim import Sim

    with optional_import("pictures need", "matplotlib", "demo"):
        from matplotlib.image import imsave

    reach = float(np.max(np.linalg.norm(airframe.value("rotors.position")[:, :2], axis=-1)))
    sim = Sim(drone=airframe, dynamics=supported_dynamics(airframe)[0], control="attitude", controller="auto")
    try:
        states = sim.data.states
        sim.data = sim.data.replace(states=states.replace(pos=states.pos + np.array([0, 0, 3 * reach])))
        view = {"lookat": [0, 0, 3 * reach], "distance": 5 * reach, "azimuth": 215, "elevation": -35}
        image: Any = sim.render("rgb_array", cam_config=view, width=960, height=640)
        with open_replacement(path) as file:
            imsave(file, image, format=path.suffix[1:])
    finally:
        sim.close()


def _thrust_to_weight(airframe: Airframe) -> float:
    return max_thrust_without_torque(airframe) / float(airframe.value("rigid_body.mass") * GRAVITY_MAGNITUDE)


def _body_rows(airframe: Airframe) -> Iterator[tuple[str, str]]:
    mass, ratio = float(airframe.value("rigid_body.mass")), _thrust_to_weight(airframe)
    max_thrust, min_thrust = (float(airframe.value(f"rotors.thrust_{limit}")) for limit in ("max", "min"))
    hover_thrust = mass * GRAVITY_MAGNITUDE / airframe.n_rotors
    yield "mass", f"{mass:.4g} kg, {airframe.n_rotors} rotors of {min_thrust:.3g} to {max_thrust:.3g} N"
    positions = airframe.value("rotors.position")
    wheelbase = np.max(np.linalg.norm(positions[:, None] - positions, axis=-1))
    yield "wheelbase", f"{1000 * wheelbase:.0f} mm, the largest distance of two rotors"
    signs = airframe.value("rotors.yaw_torque_sign")
    for number, ((x, y, _), sign) in enumerate(zip(1000 * positions, signs, strict=True), 1):
        position_text = (
            f"{abs(x):.0f} mm {'forward' if x > 0 else 'back'}, {abs(y):.0f} mm {'left' if y > 0 else 'right'}"
        )
        sense = "counter-clockwise" if sign < 0 else "clockwise"
        yield f"rotor {number}", f"{position_text}; turns {sense} seen from above"
    yield "thrust over weight", f"{ratio:.2f}"
    yield "hover", f"{1 / ratio:.0%} of the largest thrust"
    yield "tilt at full thrust", f"holds height up to {np.degrees(np.arccos(1 / ratio)):.0f} degrees"
    arms = {"roll": airframe.arm, "pitch": airframe.arm}
    if Dynamics.first_principles in supported_dynamics(airframe):
        arms["yaw"] = yaw_arm(airframe)
    for axis, (name, arm) in enumerate(arms.items()):
        torque = (
            min(hover_thrust - min_thrust, max_thrust - hover_thrust)
            * arm
            * np.sum(np.abs(airframe.mixing_matrix[axis]))
        )
        acc = torque / airframe.inertia[axis, axis]
        rate, seconds = np.sqrt(acc * QUARTER_TURN), 2 * np.sqrt(QUARTER_TURN / max(acc, 1e-9))
        yield (
            name,
            f"up to {acc:.3g} rad/s^2 at hover thrust; a turn by 90 degrees takes {seconds:.2g} s, at up to "
            f"{rate:.3g} rad/s",
        )


def _rotor_rows(airframe: Airframe) -> Iterator[tuple[str, str]]:
    hover_speed, max_speed = float(np.max(hover_rotor_vel(airframe))), float(np.max(airframe.rotor_vel_limits))
    yield "rotor speed", f"{hover_speed:,.0f} rpm in hover, {hover_speed / max_speed:.0%} of {max_speed:,.0f} rpm"
    yield "rotor time constant", f"{1 / rotor_rate(airframe):.3g} s in hover"
    gains: Any = Auto().params(airframe)
    damping, stiffness = float(gains.damping[0]), float(gains.stiffness[0])
    yield (
        "default controller",
        f"body rates follow with {damping:.3g} 1/s, attitudes with {np.sqrt(stiffness):.3g} rad/s",
    )


def _battery_text(airframe: Airframe) -> str:
    missing = [key for key in ("cells", "capacity", "resistance") if f"battery.{key}" not in airframe.values]
    if missing:
        return f"[battery] lacks {', '.join(missing)}, which Battery() needs unless they are passed"
    cells, capacity, resistance = (float(airframe.value(f"battery.{k}")) for k in ("cells", "capacity", "resistance"))
    return f"{cells:.0f} cell{'s' * (cells != 1)}, {capacity:.3g} A h, {resistance:.3g} ohm"


def _controller_rows(airframe: Airframe, dynamics: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    yield "controllers", "command levels that each of them follows"
    if Dynamics.first_principles not in dynamics:
        if dynamics:
            yield "  auto", "state, above the response of the fitted model"
            yield (
                f"  {Crazyflow.name}",
                _levels_text({"state": _missing_parameters(lambda: StateParams.create(airframe)), "attitude": ""}),
            )
        return
    for name in STATE_CONTROLLERS:
        controller: Any = find_controller(name)
        missing = _missing_parameters(functools.partial(controller.params, airframe))
        yield f"  {name}", _levels_text({", ".join(level.value for level in controller.levels): missing})
    params_by_level = {"state": StateParams, "attitude, body_rate": AttitudeParams, "force_torque": AllocationParams}
    missing_by_level = {
        levels: _missing_parameters(functools.partial(params.create, airframe))
        for levels, params in params_by_level.items()
    }
    yield f"  {Crazyflow.name}", _levels_text(missing_by_level)


def _levels_text(missing_by_level: Mapping[str, str]) -> str:
    followed = ", ".join(levels for levels, missing in missing_by_level.items() if not missing)
    reasons = [f"not {levels}: {missing}" for levels, missing in missing_by_level.items() if missing]
    return "; ".join([followed or "none", *reasons])


def _missing_parameters(create: Callable[[], Any]) -> str:
    try:
        create()
    except ConfigError as error:
        text = re.sub(r"^airframe '.*?' ", "", str(error).split(". ")[0])
        return text.split(", which ")[0]
    return ""


def _warnings(airframe: Airframe, dynamics: tuple[str, ...]) -> Iterator[str]:
    positions, ratio = airframe.value("rotors.position"), _thrust_to_weight(airframe)
    if ratio < MIN_THRUST_TO_WEIGHT:
        yield f"thrust over weight is {ratio:.2f}; below {MIN_THRUST_TO_WEIGHT:g} little is left for manoeuvres"
    if np.linalg.norm(np.mean(positions[:, :2], axis=0)) > 0.05 * airframe.arm:
        yield "the rotors are not centred on the centre of mass: their speeds differ in hover"
    if np.sum(airframe.value("rotors.yaw_torque_sign")):
        yield (
            "more rotors turn one way than the other: equal thrusts do not balance the yaw torque, so the rotor speeds "
            "differ in hover"
        )
    if Dynamics.first_principles in dynamics:
        yield from _agility_warnings(airframe)
    if not dynamics:
        yield "no dynamics: expected the curves of the rotors, or a table [fitted.NAME]"


def _agility_warnings(airframe: Airframe) -> Iterator[str]:
    for (axis, minimum), acc in zip(MIN_AUTHORITY.items(), max_ang_acc(airframe), strict=True):
        if acc < minimum:
            seconds = 2 * np.sqrt(QUARTER_TURN / acc)
            yield (
                f"{axis} has at most {acc:.2g} rad/s^2 under controller 'auto': a turn by 90 degrees takes "
                f"{seconds:.2g} s at least"
            )
    if precession_rate(airframe) > MAX_PRECESSION_FRACTION * np.min(max_ang_acc(airframe)[:2]):
        yield (
            f"rotors turn one way more than the other: at 1 rad/s of roll or pitch their momentum takes "
            f"{precession_rate(airframe):.2g} of {np.min(max_ang_acc(airframe)[:2]):.2g} rad/s^2 about the other axis"
        )
    bandwidth = float(np.sqrt(Auto().params(airframe).stiffness[0]))
    if precession_rate(airframe) > MAX_PRECESSION_RATIO * bandwidth:
        yield (
            f"rotors turn one way more than the other: their momentum turns roll into pitch at "
            f"{precession_rate(airframe):.2g} rad/s, against a bandwidth of controller 'auto' of {bandwidth:.2g} "
            f"rad/s: it may not hold the drone"
        )
    if rotor_rate(airframe) * MAX_TIME_CONSTANT < 1:
        yield f"rotors lag by {1 / rotor_rate(airframe):.2g} s: a drone that is thrown takes long to recover"
    try:
        require_freq(airframe, Dynamics.first_principles, DEFAULT_FREQ)
    except ConfigError as error:
        yield str(error)
