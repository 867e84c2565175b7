"""The default controller: its accuracy with every airframe at every level, and its parts."""

import functools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import unit_quats, with_states
from hypothesis import example, given
from scipy.spatial.transform import Rotation

from crazysim import Sim, load_airframe, rotation
from crazysim.control.auto import DAMPING_RATIO, STIFFNESS_RATIO, Auto, quat_error
from crazysim.control.bandwidth import max_ang_acc, rotor_rate
from crazysim.dynamics import first_principles
from crazysim.dynamics.models import supported_drones
from crazysim.plugins.follow import Follow
from crazysim.trajectories import hover, line

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
HIGH = 50.0
"""Height of flights far from the floor, m."""


@functools.cache
def benchmark():
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import controllers
    finally:
        sys.path.remove(str(BENCHMARKS))
    return controllers


@functools.cache
def airframes():
    return [load_airframe(name) for name in supported_drones("first_principles")] + benchmark().generic_airframes()


# Flights --------------------------------------------------------------------------------------------------------


def test_every_airframe_flies_as_accurately_as_documented():
    result = benchmark().fly_airframes("auto", airframes(), 2.0, 100)
    assert len(result) == 13
    for name, row in result.items():
        assert row["hover"] < 2e-3, (name, row)
        assert row["tracking"] < 0.03, (name, row)
        assert row["pushed"] < 0.01, (name, row)
        assert row["heavier"] < 0.01, (name, row)
        assert row["home"] >= 0.99, (name, row)


@pytest.mark.parametrize("dynamics", ["so_rpy", "so_rpy_rotor_drag"])
def test_the_position_loop_flies_fitted_dynamics(dynamics):
    """The figures also hold with fitted models; hb_x500, the slowest airframe, tracks within 4 cm."""
    names = [load_airframe(name) for name in supported_drones(dynamics)]
    for name, row in benchmark().fly_airframes("auto", names, 2.0, 1, dynamics).items():
        assert row["hover"] < 2e-3, (name, row)
        assert row["tracking"] < (0.04 if name == "hb_x500" else 0.03), (name, row)
        assert row["pushed"] < 0.01, (name, row)
        assert row["heavier"] < 0.01, (name, row)


def hovering_sim(level, worlds, controller="auto", **settings):
    sim = Sim(worlds, drone=airframes(), control=level, controller=controller, **settings)
    s, high = sim.data.states, np.zeros((worlds, len(airframes()), 3), np.float32)
    high[..., 2] = HIGH
    rotor_vel = jnp.broadcast_to(first_principles.hover_rotor_vel(sim.data.params), s.rotor_vel.shape)
    sim.data = sim.data.replace(states=s.replace(pos=jnp.asarray(high), rotor_vel=rotor_vel))
    return sim, np.array([9.81 * a.value("rigid_body.mass") for a in airframes()])


@pytest.mark.parametrize("level", ["attitude", "body_rate"])
def test_steps_of_the_command_settle_with_little_overshoot(level):
    """Overshoot is at most 10%, the error 2% after 2 s, and half of a step takes 0.3 s, for yaw 0.6 s."""
    responses = benchmark().step_responses("auto", airframes(), level)
    assert responses.max() < 1.1
    np.testing.assert_allclose(responses[100:], 1.0, atol=0.02)
    assert np.all(responses[15, :3] > 0.5)
    assert np.all(responses[30] > 0.5)


def test_body_rates_are_followed_and_nothing_levels_the_drone():
    """Half a turn of roll in 1 s at pi rad/s."""
    sim, weights = hovering_sim("body_rate", 1)
    sim.body_rate_control(np.stack([np.array([np.pi, 0, 0, w], np.float32) for w in weights])[None])
    sim.step(500)
    tilt = np.arccos(np.clip(1 - 2 * np.sum(np.asarray(sim.data.states.quat)[0, :, :2] ** 2, axis=-1), -1, 1))
    assert np.all(tilt > 2.6)


def test_the_third_entry_of_an_attitude_may_be_a_yaw_rate():
    sim, weights = hovering_sim("attitude", 1, Auto(yaw_rate=True))
    sim.attitude_control(np.stack([np.array([0.2, 0.0, 0.8, w], np.float32) for w in weights])[None])
    sim.step(1500)
    quat, ang_vel = np.asarray(sim.data.states.quat)[0], np.asarray(sim.data.states.ang_vel)[0]
    rotation = Rotation.from_quat(quat)
    np.testing.assert_allclose(rotation.apply(ang_vel)[:, 2], 0.8, atol=0.01)
    np.testing.assert_allclose(rotation.as_euler("xyz")[:, 0], 0.2, atol=0.02)


def test_an_unknown_torque_leaves_no_error():
    """Without an estimate the torque would turn each drone by 0.2 rad."""
    sim, weights = hovering_sim("attitude", 1)
    params = sim.data.controls.controller.params
    torque = 0.2 * np.asarray(params.torque_max)[:1] / 0.5
    sim.data = sim.data.replace(states=sim.data.states.replace(torque=jnp.asarray(torque * [1.0, -1.0, 0.0])))
    sim.attitude_control(np.stack([np.array([0, 0, 0, w], np.float32) for w in weights])[None])
    sim.step(150)
    early_error = np.abs(Rotation.from_quat(np.asarray(sim.data.states.quat)[0]).as_euler("xyz")[:, :2]).max()
    sim.step(1850)
    late_error = np.abs(Rotation.from_quat(np.asarray(sim.data.states.quat)[0]).as_euler("xyz")[:, :2]).max()
    assert early_error > 0.01
    assert late_error < 1e-3


upward = jax.jit(lambda quat: rotation.matrix(quat)[..., 2, 2])


@pytest.mark.parametrize("dynamics", ["first_principles", "so_rpy_rotor_drag"])
def test_a_fall_does_not_turn_a_drone_on_its_back(dynamics):
    """With drag and estimates compensated, the desired force may then point down, or in any direction."""
    acc = np.zeros((3, 1, 3), np.float32)
    acc[:, 0, 2] = -9.81, -9.5, -9.0
    sim = Sim(3, dynamics=dynamics, control="state", controller="auto")
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(100.0)))
    for _ in range(50):
        sim.state_control(pos=sim.data.states.pos, vel=sim.data.states.vel, acc=acc)
        sim.step(10)
        assert np.all(upward(sim.data.states.quat) > 0.95)
    assert np.all(sim.data.states.vel[..., 2] < -4)


def test_a_setpoint_that_falls_faster_than_gravity_turns_a_drone_over():
    sim = Sim(control="state", controller="auto")
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(100.0)))
    for _ in range(50):
        sim.state_control(pos=sim.data.states.pos, vel=sim.data.states.vel, acc=(0, 0, -16.0))
        sim.step(10)
    assert np.all(upward(sim.data.states.quat) < -0.9)


def test_a_far_setpoint_is_approached_without_losing_height():
    """For a setpoint 30 m aside, the feedback limits the tilt to what the rotors can carry.

    The speed of the approach is inverse to the velocity gain: uzh_cpc, whose rotors have no lag, takes 24 s.
    """
    sim, _ = hovering_sim("state", 1)
    command = np.zeros((1, len(airframes()), 16), np.float32)
    command[..., :3], command[..., 12] = [30.0, 0.0, HIGH], 1.0
    sim.state_control(command)
    low = np.inf
    for _ in range(280):
        sim.step(50)
        low = min(low, float(sim.data.states.pos[..., 2].min()))
    assert low > HIGH - 0.5
    np.testing.assert_allclose(np.asarray(sim.data.states.pos)[0], command[0, :, :3], atol=0.01)


# Parts ------------------------------------------------------------------------------------------------------------


@given(body=unit_quats(), desired=unit_quats())
@example(
    body=np.array([0.74740932, 0, 0, -0.66436384]), desired=np.array([0.10349082, 0.98124632, 0.1149898, 0.1149898])
)
def test_the_rotation_error_is_a_shortest_tilt_and_a_turn(body, desired):
    """Against SciPy's rotations; tilt and turn have the length 2 sin(angle / 2)."""
    relative = Rotation.from_quat(body).inv() * Rotation.from_quat(desired)
    z = relative.as_matrix()[:, 2]
    tilt = np.arccos(np.clip(z[2], -1, 1))
    if tilt > 3.1:
        return  # the direction of the tilt is undefined nearby
    axis = np.cross([0, 0, 1], z)
    axis = axis / max(np.linalg.norm(axis), 1e-12)
    turn = (Rotation.from_rotvec(tilt * axis).inv() * relative).as_rotvec()[2]
    expected = 2 * np.array([*(np.sin(tilt / 2) * axis[:2]), np.sin(turn / 2)])
    result = np.asarray(jitted_quat_error(relative.as_quat().astype(np.float32)))
    np.testing.assert_allclose(result[:2], expected[:2], atol=5e-3)
    np.testing.assert_allclose(np.abs(result[2]), np.abs(expected[2]), atol=5e-3)
    if abs(turn) < 3.0:
        np.testing.assert_allclose(result[2], expected[2], atol=5e-3)


jitted_quat_error = jax.jit(quat_error)


def test_the_gains_are_damped_as_documented():
    """Poles of s^3 / a + s^2 + kd s + kp over a, and of s^2 / a + s + kd: the numbers of the module's docstring."""
    poles = np.roots([1, 1, DAMPING_RATIO, STIFFNESS_RATIO])
    real, pair = poles[np.abs(poles.imag) < 1e-9].real, poles[poles.imag > 0]
    np.testing.assert_allclose(real, -0.31, atol=0.005)
    np.testing.assert_allclose(-pair.real / np.abs(pair), 0.55, atol=0.005)
    rate = np.roots([1, 1, DAMPING_RATIO])[0]
    damping = -rate.real / abs(rate)
    np.testing.assert_allclose(damping, 0.645, atol=0.001)
    np.testing.assert_allclose(np.exp(-np.pi * damping / np.sqrt(1 - damping**2)), 0.07, atol=0.002)


def test_gains_by_hand():
    """cf21B_500: lag 16.094 1/s, made faster to 50 1/s; with 1.5 periods of 500 Hz that is 43.48 1/s."""
    airframe = load_airframe("cf21B_500")
    p = Auto().params(airframe)
    rate = 1 / (1 / 50 + 1.5 / 500)
    np.testing.assert_allclose(p.lead, 50 / rotor_rate(airframe))
    np.testing.assert_allclose(p.damping, 0.6 * rate * np.array([1, 1, 0.5]))
    np.testing.assert_allclose(p.stiffness, 0.12 * rate**2 * np.array([1, 1, 0.25]))
    np.testing.assert_allclose(p.position.damping, 2 * 0.4 / (5 / rate + 0.5 / 100))
    slow = Auto().params(load_airframe("cf2x_L250"))
    np.testing.assert_allclose(slow.lead, 5.0)  # the largest lead
    assert Auto(freq=50, outer_freq=50).params(airframe).lead < p.lead  # half of what is missing in a tick of 20 ms


def test_authority_by_hand():
    """A quadrotor in X of 1 kg with arms of 0.1 m, 0.1 to 10 N a rotor, 20 mm of drag torque over thrust.

    Two rotors lose what they have above 0.1 N, two gain it: 2 (9.81 / 4 - 0.1) N at 0.1 m twice. With at most 3 N a
    rotor, roll and pitch lower the collective thrust to 4 x 1.55 N, which leaves 1.45 N for each; yaw has 3 N - 2.45 N.
    """
    quad = {
        "rigid_body": {"mass": 1.0, "inertia": [0.01, 0.01, 0.02]},
        "rotors": {
            "position": [[0.1, -0.1, 0], [-0.1, -0.1, 0], [-0.1, 0.1, 0], [0.1, 0.1, 0]],
            "yaw_torque_sign": [-1, 1, -1, 1],
            "thrust_min": 0.1,
            "thrust_max": 10.0,
            "inertia": 1e-5,
            "thrust_curve": [0, 0, 1e-8],
            "torque_curve": [0, 0, 2e-10],
            "lag": [500, 0, 500, 0],
        },
        "drag": {"coefficients": [-0.1, -0.1, -0.1]},
    }
    hover = 9.81 / 4
    thrust_margin = hover - 0.1
    np.testing.assert_allclose(
        max_ang_acc(load_airframe(quad)), [40 * thrust_margin, 40 * thrust_margin, 4 * thrust_margin], rtol=1e-6
    )
    quad["rotors"]["thrust_max"] = 3.0
    np.testing.assert_allclose(max_ang_acc(load_airframe(quad)), [40 * 1.45, 40 * 1.45, 4 * (3 - hover)], rtol=1e-6)
    # Quick rotors: the rate follows from the authority, so that the rotors can brake each turn.
    p, (roll, _, yaw) = Auto().params(load_airframe(quad)), max_ang_acc(load_airframe(quad))
    np.testing.assert_allclose(p.lead, 1.0)
    np.testing.assert_allclose((p.stiffness / p.damping) ** 2 * [2, 2, 1], [roll, roll, yaw], rtol=1e-5)


# Laws -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drone", ["cf21B_500", "bumblebee"])
def test_drones_beside_the_start_of_a_slow_climb_leave_the_floor(drone):
    """The floor stops every motion of a drone on it, so measurements there must not tilt the drone."""
    sim = Sim(n_worlds=32, drone=drone, control="state")
    away = np.random.default_rng(0).uniform(-2.0, 2.0, (32, 1, 2))
    sim.data = with_states(sim.data, pos=np.concatenate([away, np.zeros((32, 1, 1))], axis=-1))
    sim.add(Follow([line([0, 0, 0], [0, 0, 1.0], 4.0).then(hover([0, 0, 1.0]))]))
    sim.step(10 * sim.freq)
    np.testing.assert_allclose(np.asarray(sim.data.states.pos), np.broadcast_to([0, 0, 1.0], (32, 1, 3)), atol=0.01)
