"""Hundreds of random airframes are thrown into the air, and all controllers with gains from physics recover them."""

import tomllib

import numpy as np
import pytest
from random_airframes import (
    GRAVITY,
    alternation,
    draw_airframes,
    fly_airframes,
    set_flying_states,
    settling_time,
    throw_drones,
)
from scipy.spatial.transform import Rotation

from crazysim import Sim, load_airframe
from crazysim.control import Auto
from crazysim.control.bandwidth import max_ang_acc
from crazysim.drones import estimate_airframe

STEPS = {
    "attitude": ((0, 0.1), (0, 0.5), (1, -0.5), (2, 0.5), (2, 2.5)),
    "body_rate": ((0, 0.5), (0, 3.0), (1, -3.0), (2, 0.5), (2, 2.0)),
}
"""Axes and sizes of the steps of the command at each level, rad or rad/s."""
SLOW = pytest.mark.slow("many more airframes of the same kind")
MANY_DRAWS = [pytest.param(n, seed, 150, marks=SLOW) for n in range(4, 13) for seed in (1, 2, 3)]
FEW_DRAWS = [pytest.param(n, 0, 40) for n in (4, 5, 12)]
LEVEL_CASES = [("attitude", 5, 0, 40), ("body_rate", 6, 0, 40)]
LEVEL_CASES += [pytest.param(level, *draw.values, marks=SLOW) for level in STEPS for draw in MANY_DRAWS]


@pytest.mark.parametrize(("n", "seed", "count"), [*FEW_DRAWS, *MANY_DRAWS])
def test_setpoints_are_reached_from_any_throw(n, seed, count):
    """45 degrees, 2 rad/s, 2 m/s and up to 2 m off: within 2 mm after the time that the bandwidth promises.

    The time is the sum of three: the far part of the way at the speed from which the drone can stop, 14 time constants
    of the position loop, and half a turn of yaw.
    """
    airframes = draw_airframes(n, count, seed)
    distances, heights, alternating = fly_airframes(airframes, "auto", 4, 40, seed)
    times = settling_time(distances, 2e-3)
    for k, airframe in enumerate(airframes):
        position = Auto().params(airframe).position
        frequency, acc = float(np.sqrt(position.stiffness[0])), float(np.min(position.acc_max))
        turn_time = 2 * np.sqrt(np.pi / max_ang_acc(airframe)[2])
        promised = distances[:, :, k].max(0) * frequency / acc + 14 / frequency + turn_time
        assert np.all(times[:, k] < promised), (airframe.name, times[:, k], promised)
        assert heights[:, :, k].max() < 4.0, airframe.name
        assert alternating[k] < 1e-3, airframe.name


@pytest.mark.parametrize(("level", "n", "seed", "count"), LEVEL_CASES)
def test_attitudes_and_body_rates_are_followed_with_little_overshoot(level, n, seed, count):
    """Steps overshoot by at most 10%, and thrown drones follow random commands after 36 s, which weak yaw needs."""
    airframes, steps, throws = draw_airframes(n, count, seed), STEPS[level], 4
    rng = np.random.default_rng(seed)
    sim = Sim(len(steps) + throws, drone=airframes, control=level)
    throw_drones(sim, seed)
    s = sim.data.states
    starts_at_rest = np.arange(sim.n_worlds) < len(steps)
    quat, ang_vel = np.array(s.quat), np.array(s.ang_vel)
    quat[starts_at_rest], ang_vel[starts_at_rest] = [0, 0, 0, 1], 0
    set_flying_states(sim, s.pos, s.vel * ~starts_at_rest[:, None, None], quat, ang_vel)
    command = np.zeros((sim.n_worlds, count, 4), np.float32)
    if level == "attitude":
        command[..., :3] = rng.uniform(-1, 1, command[..., :3].shape) * [0.5, 0.5, 3]
    else:  # about one axis: two rates at once need a gyroscopic torque about the third, which yaw may not have
        command[..., :3] = np.eye(3)[rng.integers(0, 3, command.shape[:2])] * rng.uniform(
            -2, 2, (*command.shape[:2], 1)
        )
    command[..., 3] = [GRAVITY * a.value("rigid_body.mass") for a in airframes]
    for k, (axis, size) in enumerate(steps):
        command[k, :, :3] = size * np.eye(3)[axis]
    getattr(sim, f"{level}_control")(command)

    highest = np.zeros((len(steps), count))
    for _ in range(400):
        sim.step(10)
        now = angles(sim) if level == "attitude" else np.asarray(sim.data.states.ang_vel)
        result = np.stack([now[k, :, axis] / size for k, (axis, size) in enumerate(steps)])
        highest = np.maximum(highest, result)
    sim.step(14000)
    assert highest.max() < 1.1, airframes[int(highest.max(0).argmax())].name
    if level == "attitude":
        expected = Rotation.from_euler("xyz", command[..., :3].reshape(-1, 3))
        actual = Rotation.from_quat(np.asarray(sim.data.states.quat).reshape(-1, 4))
        error = (expected.inv() * actual).magnitude().reshape(sim.n_worlds, count)
    else:
        error = np.linalg.norm(np.asarray(sim.data.states.ang_vel) - command[..., :3], axis=-1)
    assert error.max() < 0.02, airframes[int(error.max(0).argmax())].name
    assert alternation(sim).max() < 1e-3


def angles(sim):
    quat = np.asarray(sim.data.states.quat)
    return Rotation.from_quat(quat.reshape(-1, 4)).as_euler("xyz").reshape(*quat.shape[:2], 3)


CONTROLLER_THROWS = {
    "geometric": {},
    "indi": {},
    "lqr": {"tilt": 0.35, "rate": 1.0, "speed": 0.5, "away": 0.5, "heading": 0.5},
}
"""Settings of throws that other controllers recover from, if they differ from those of the default controller."""


SLOW_CASES = [pytest.param(name, n, marks=SLOW) for name in CONTROLLER_THROWS for n in (4, 5, 6, 8)]


@pytest.mark.parametrize(("controller", "n"), [("geometric", 4), ("indi", 6), ("lqr", 4), *SLOW_CASES])
def test_other_controllers_recover_thrown_drones(controller, n):
    """99% of the flights of 60 s end within 5 cm; slow rotors need slow position loops. No rotor alternates."""
    airframes = draw_airframes(n, 40, 0)
    distances, heights, alternating = fly_airframes(airframes, controller, 4, 60, 0, **CONTROLLER_THROWS[controller])
    assert np.mean(distances[-10:].max(0) < 0.05) >= 0.99, controller
    assert heights.max() < 4.0
    assert alternating.max() < 0.01


HUMMINGBIRD = {
    "name": "hummingbird",  # of RotorPy
    "rigid_body": {"mass": 0.5, "inertia": [3.65e-3, 3.68e-3, 7.03e-3]},
    "rotors": {
        "position": [[0.12, 0.12, 0], [0.12, -0.12, 0], [-0.12, -0.12, 0], [-0.12, 0.12, 0]],
        "yaw_torque_sign": [1, -1, 1, -1],
        "thrust_min": 0.05,
        "thrust_max": 12.5,
        "inertia": 1e-6,
        "thrust_curve": [0, 0, 6.108e-8],
        "torque_curve": [0, 0, 1.4914e-9],
        "lag": [200, 0, 200, 0],
    },
    "drag": {"coefficients": [-0.05, -0.05, -0.1]},
}
RACER = {
    "name": "racer",  # of gym-pybullet-drones, with heavy rotors
    "rigid_body": {"mass": 0.83, "inertia": [3.113e-3, 3.113e-3, 3.113e-3]},
    "rotors": {
        "position": [[0.085, -0.0675, 0], [-0.085, -0.0675, 0], [-0.085, 0.0675, 0], [0.085, 0.0675, 0]],
        "yaw_torque_sign": [-1, 1, -1, 1],
        "thrust_min": 0.05,
        "thrust_max": 8.49,
        "inertia": 5e-6,
        "thrust_curve": [0, 0, 8.47e-9],
        "torque_curve": [0, 0, 2.13e-11],
        "lag": [25, 0, 25, 0],
    },
    "drag": {"coefficients": [-0.05, -0.05, -0.05]},
}


def heavy_drone(inertia, torque):
    """Return an estimated drone of 4 kg with factors on the inertia of its rotors and on their drag torque."""
    numbers = tomllib.loads(estimate_airframe(4.0, 0.38, arm=0.3, thrust_to_weight=2.5))
    rotors = {key: entry["value"] for key, entry in numbers["rotors"].items()}
    rotors |= {"inertia": rotors["inertia"] * inertia, "torque_curve": [torque * k for k in rotors["torque_curve"]]}
    return numbers | {"name": f"{inertia} inertia, {torque} torque", "rotors": rotors}


@pytest.mark.parametrize("controller", ["auto", "indi"])
def test_quick_and_heavy_rotors_hover_and_reach_far_setpoints(controller):
    """To 2 mm, with constant rotor speeds: near setpoints, 30 m aside, without climbing, and 30 m below."""
    sources = [
        HUMMINGBIRD,
        RACER,
        *(heavy_drone(*factors) for factors in ((1, 1), (2, 1), (3, 1), (5, 1), (1, 0.25), (3, 0.25))),
    ]
    sim = Sim(3, drone=[load_airframe(source) for source in sources], control="state", controller=controller)
    set_flying_states(sim)
    goals = np.array([[1.0, 0.0, 1.0], [30.0, 0.0, 0.0], [0.0, 0.0, -30.0]])[:, None]
    if controller == "indi":
        goals[1:] /= 10  # its errors are not limited
    sim.state_control(pos=goals)
    highest = -np.inf
    for _ in range(200):
        sim.step(50)
        highest = max(highest, float(sim.data.states.pos[..., 2].max()))
    sim.step(10000)
    np.testing.assert_allclose(np.asarray(sim.data.states.pos), np.broadcast_to(goals, (3, 8, 3)), atol=2e-3)
    assert highest < 1.5
    assert alternation(sim).max() < 1e-3
