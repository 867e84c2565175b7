"""Geometric tracking control: its torque, its feed-forward, its limits, and flights."""

import functools

import jax
import numpy as np
import pytest
from cases import unit_quats, vectors
from flights import figure_eight, hover, path_setpoint, start_on_path
from hypothesis import given
from scipy.spatial.transform import Rotation

from crazysim import Sim, load_airframe
from crazysim.control import Setpoint
from crazysim.control.bandwidth import bandwidth, rotor_rate
from crazysim.control.flatness import Attitude
from crazysim.control.geometric import Geometric, attitude_errors, geometric_control
from crazysim.control.priority import prioritized_wrench
from crazysim.plugins.follow import Follow
from crazysim.trajectories import curves

ZERO, LEVEL = np.zeros(3), np.array([0.0, 0, 0, 1])
control = jax.jit(geometric_control, static_argnames="feedforward")


@functools.cache
def params(drone="bumblebee", gains="airframe", freq=500):
    return Geometric(freq, gains).params(load_airframe(drone))


def setpoint(**changes):
    zeros = {key: ZERO for key in ("pos", "vel", "acc", "jerk", "snap")} | {
        key: np.zeros(1) for key in ("yaw", "yaw_rate", "yaw_acc")
    }
    return Setpoint(**zeros | {key: np.asarray(value, float) for key, value in changes.items()})


def law(drone, gains="bandwidth", freq=500, feedforward=True):
    p = params(drone, gains, freq)

    def wrench(data, setpoint, memory):
        s = data.states
        state = (s.pos[0, 0], s.quat[0, 0], s.vel[0, 0], s.ang_vel[0, 0])
        return geometric_control(*state, setpoint, params=p, feedforward=feedforward), memory

    return wrench


def lab_wrench(pos, matrix, vel, ang_vel, yaw, drone):
    """Return the wrench of AIMotionLab-Virtual's geometric controller, in NumPy, without the tested code."""
    kr, kv, kR, kw = {"crazyflie": (0.15, 0.2, 0.007, 0.0015), "bumblebee_lab": (4.0, 2.0, 1.7, 0.2)}[drone]
    mass = {"crazyflie": 0.028, "bumblebee_lab": 0.605}[drone]
    inertia = np.diag({"crazyflie": [1.4e-5, 1.4e-5, 2.17e-5], "bumblebee_lab": [1.5e-3, 1.45e-3, 2.66e-3]}[drone])
    force = -kr * pos - kv * vel + mass * 9.81 * np.array([0, 0, 1])
    z = force / np.linalg.norm(force)
    y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0])
    y = y / np.linalg.norm(y)
    desired = np.stack([np.cross(y, z), y, z], axis=-1)
    e = desired.T @ matrix - matrix.T @ desired
    error = 0.5 * np.array([e[2, 1], e[0, 2], e[1, 0]])
    torque = -kR * error - kw * ang_vel + np.cross(ang_vel, inertia @ ang_vel)
    return np.array([force @ matrix[:, 2], *torque])


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("drone", ["crazyflie", "bumblebee_lab"])
def test_the_wrench_agrees_with_the_lab_law(drone, rng):
    """Small errors, so that no rotor saturates; the lab's law has no limits."""
    p = Geometric(gains="airframe").params(load_airframe(drone))
    for _ in range(20):
        rotation = Rotation.from_rotvec(rng.normal(size=3) * 0.05)
        pos, vel, ang_vel, yaw = 0.05 * rng.normal(size=3), 0.05 * rng.normal(size=3), 0.02 * rng.normal(size=3), 0.05
        sp = setpoint(yaw=[yaw], acc=[3, 2, 1], jerk=[1, 1, 1], yaw_rate=[1])
        wrench = control(pos, rotation.as_quat(), vel, ang_vel, sp, params=p, feedforward=False)
        np.testing.assert_allclose(wrench, lab_wrench(pos, rotation.as_matrix(), vel, ang_vel, yaw, drone), atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_a_drone_that_tracks_gets_the_wrench_of_its_motion():
    """On a figure eight, without drag: thrust and torque of Newton and Euler, J w' + w x J w."""
    from crazysim.control.flatness import attitude_of_thrust

    p, attitude = Geometric().params(load_airframe("bumblebee")), jax.jit(attitude_of_thrust)
    setpoint_on_eight = jax.jit(functools.partial(path_setpoint, figure_eight))
    for t in (0.3, 1.0, 2.2):
        sp = jax.tree.map(np.asarray, setpoint_on_eight(t))
        gravity = np.array([0, 0, 9.81])
        now = jax.tree.map(np.asarray, attitude(sp.acc + gravity, sp.jerk, sp.snap, sp.yaw, sp.yaw_rate, sp.yaw_acc))
        quat = Rotation.from_matrix(now.matrix).as_quat()
        wrench = np.asarray(control(sp.pos, quat, sp.vel, now.ang_vel, sp, params=p))
        momentum = p.J @ now.ang_vel
        np.testing.assert_allclose(wrench[0], 0.605 * np.linalg.norm(sp.acc + gravity), rtol=1e-9)
        np.testing.assert_allclose(wrench[1:], p.J @ now.ang_acc + np.cross(now.ang_vel, momentum), atol=1e-10)
        assert np.linalg.norm(now.ang_acc) > 0.2


@pytest.mark.usefixtures("x64")
@given(quat=unit_quats(), other=unit_quats(), ang_vel=vectors(3, 5.0), w_d=vectors(3, 5.0), acc_d=vectors(3, 9.0))
def test_the_angular_acceleration_of_tracking_keeps_the_rate_error(quat, other, ang_vel, w_d, acc_d):
    """Along R' = R w^, R_d' = R_d w_d^ and w' = acc, the error w - R^T R_d w_d does not change."""
    matrix, desired = Rotation.from_quat(quat).as_matrix(), Rotation.from_quat(other).as_matrix()
    acc = attitude_errors(matrix, ang_vel, Attitude(desired, w_d, acc_d))[2]
    rates = matrix @ skew(ang_vel), desired @ skew(w_d)

    def rate_error(matrix, desired, w, w_d):
        return w - matrix.T @ desired @ w_d

    slope = jax.jvp(rate_error, (matrix, desired, ang_vel, w_d), (*rates, np.asarray(acc), acc_d))[1]
    np.testing.assert_allclose(slope, 0.0, atol=1e-10)


def skew(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


# Limits ---------------------------------------------------------------------------------------------------------


def thrusts_of(wrench, p):
    return np.asarray(p.allocation_matrix) @ np.concatenate([wrench[:1], wrench[1:] / np.asarray(p.torque_arms)])


priority = jax.jit(prioritized_wrench)


@pytest.mark.usefixtures("x64")
@given(wrench=vectors(4, 1.0))
def test_a_wrench_is_brought_within_the_limits_by_priority(wrench):
    p = params("cf21B_500", "bandwidth").allocation
    wrench = np.array([2.0, 0.04, 0.04, 0.01]) * wrench
    out = np.asarray(priority(wrench, params=p))
    low, high = float(p.thrust_min[0]), float(p.thrust_max[0])
    thrusts = thrusts_of(out, p)
    assert np.all(thrusts > low - 1e-12)
    assert np.all(thrusts < high + 1e-12)
    without_yaw, yaw = thrusts_of(wrench * [1, 1, 1, 0], p), np.abs(thrusts_of(wrench * [0, 0, 0, 1], p))
    if np.all((without_yaw - yaw >= low) & (without_yaw + yaw <= high)):
        np.testing.assert_allclose(out, wrench, atol=1e-12)
    tilt = thrusts_of(np.array([0, *wrench[1:3], 0]), p)
    limit = max(wrench[0], float(p.weight[0]))
    assert out[0] <= limit + 1e-12  # a torque does not lift the drone
    feasible_scale = min((high - low) / max(np.ptp(tilt), 1e-12), (limit / 4 - low) / max(-tilt.min(), 1e-12))
    if feasible_scale >= 1:
        np.testing.assert_allclose(out[1:3], wrench[1:3], atol=1e-12)  # thrust and yaw give way
    else:
        scale = out[1:3] @ wrench[1:3] / (wrench[1:3] @ wrench[1:3])
        np.testing.assert_allclose(out[1:3], scale * wrench[1:3], atol=1e-12)
        assert feasible_scale / 2 < scale < feasible_scale + 1e-9
        if limit >= 4 * high:
            np.testing.assert_allclose(scale, feasible_scale)
    assert out[3] * wrench[3] >= 0
    assert abs(out[3]) <= abs(wrench[3]) + 1e-15


# Singularities ----------------------------------------------------------------------------------------------------


# Gains and flights --------------------------------------------------------------------------------------------------


def test_rotor_rates_by_hand():
    """13.996 + 2 x 1.1093e-4 x 15900 = 17.5 up, 5.933 + 2 x 3.1951e-4 x 15900 = 16.1 down; 50 without a lag."""
    assert rotor_rate(load_airframe("cf21B_500")) == pytest.approx(16.094, abs=2e-3)
    assert rotor_rate(load_airframe("crazyflie")) == 50


@pytest.mark.parametrize("drone", ["cf21B_500", "cf2x_L250", "crazyflie", "bumblebee"])
def test_gains_by_bandwidth_are_stable_and_damped(drone):
    """Poles of position, velocity, attitude, body rate and a rotor with lag: damping ratios of 0.39 and more."""
    rates, lag = bandwidth(load_airframe(drone), 10**9), rotor_rate(load_airframe(drone))
    kp, kd, w = rates.stiffness[0], rates.damping[0], rates.position
    system = np.diag([1.0, 1, 1, 1, 0][:4], 1)
    system[4] = lag * np.array([-kp * w**2, -kp * 2 * w, -kp, -kd, -1])
    poles = np.linalg.eigvals(system)
    assert np.max(poles.real) < -0.07 * lag
    assert np.min(-poles.real / np.abs(poles)) > 0.39


@pytest.mark.parametrize("freq", [100, 500])
def test_a_figure_eight_in_a_simulation_is_tracked_within_two_centimetres(freq):
    """With ``Follow`` and ``Sim(controller=Geometric(...))`` in a fused step, the error is 2 cm RMS."""
    eight = curves.figure_eight(2.0, 1.0, speed=2.0)
    sim = Sim(control="state", controller=Geometric(freq=freq), strict=True)
    sim.add(Follow(eight))
    start_on_path(sim, figure_eight)
    flown = []
    for _ in range(300):
        sim.step(10)
        flown.append(np.asarray(sim.data.states.pos)[0, 0])
    target = jax.jit(jax.vmap(eight.evaluate))(np.arange(1, 301, dtype=np.float32) * np.float32(0.02)).pos
    errors = np.linalg.norm(np.array(flown) - target, axis=-1)
    assert np.sqrt(np.mean(np.square(errors))) < 0.02


def test_an_integral_compensates_a_push():
    """The force is a tenth of the weight. With an integral the error is below 1 cm after 5 s, else force over gain."""
    drone, offsets = "bumblebee", {}
    gains = Geometric().params(load_airframe(drone))
    for integral in (0.0, 0.6):
        sim = Sim(drone=drone, control="state", controller=Geometric(integral=integral), strict=True)
        start_on_path(sim, hover)
        command = np.zeros((1, 1, 16))
        command[..., 2] = 1.0
        sim.state_control(command)
        push = np.broadcast_to([0.1 * 9.81 * float(gains.mass[0]), 0, 0], (1, 1, 3)).astype("f4")
        for _ in range(50):
            sim.data = sim.data.replace(states=sim.data.states.replace(force=push))
            sim.step(50)
        offsets[integral] = np.linalg.norm(np.asarray(sim.data.states.pos)[0, 0] - [0, 0, 1])
        assert (sim.data.controls.controller.memory is None) == (integral == 0)
    assert offsets[0.6] < 0.01
    # The expected offset neglects drag and the last hundredth of the approach.
    np.testing.assert_allclose(offsets[0.0], 0.1 * 9.81 * gains.mass[0] / gains.kr[0], rtol=0.02)


@pytest.mark.parametrize("drone", ["cf21B_500", "bumblebee"])
def test_gains_of_the_bandwidth_damp_the_position_critically(drone):
    """m x'' + kv x' + kr x = 0 has a double root: kv^2 = 4 m kr."""
    p = params(drone, "bandwidth")
    np.testing.assert_allclose(np.square(p.kv), 4 * p.mass * p.kr, rtol=1e-6)


def test_an_integral_does_not_wind_up():
    for distance, largest in ((0.5, 0.5 * 9.81), (10.0, 0.0)):
        sim = Sim(control="state", controller=Geometric(integral=1.0))
        start_on_path(sim, hover)
        start_states, command = sim.data.states, np.zeros((1, 1, 16))
        command[..., :3] = [distance, 0, 1]
        sim.state_control(command)
        for _ in range(100):
            sim.step(50)
            sim.data = sim.data.replace(states=start_states)
        acc = np.asarray(sim.data.controls.controller.memory.acc)[0, 0, 0]
        np.testing.assert_allclose(acc, largest, rtol=1e-6)
