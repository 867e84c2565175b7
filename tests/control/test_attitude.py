"""The inner loop, from attitude or body rates to a wrench."""

import functools

import jax
import numpy as np
import pytest
from cases import controller_params, vectors
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazysim import load_airframe
from crazysim.control import AttitudeParams, attitude2force_torque

pytestmark = pytest.mark.usefixtures("x64")

LEVEL, ZERO = np.array([0.0, 0, 0, 1]), np.zeros(3)
HALF_THRUST = 0.4  # N, half of the largest thrust of the four rotors, far from all limits
attitude = jax.jit(attitude2force_torque, static_argnames="ctrl_freq")
params = functools.partial(controller_params, AttitudeParams)


def run_controller(
    cmd, quat=LEVEL, rates=ZERO, desired=ZERO, before=None, desired_before=None, integral=ZERO, freq=500, p=None
):
    before = rates if before is None else before
    desired_before = desired if desired_before is None else desired_before
    args = (quat, rates, np.asarray(cmd, float), desired, before, desired_before, integral, freq)
    return attitude(*args, params=params() if p is None else p)


def torque_of_pwm(roll, pitch, yaw):
    """Return the torque of PWM commands on a Crazyflie, N m: the firmware mixes roll/2, pitch/2, yaw."""
    newton, arm, yaw_arm = 0.2 / 65535, 0.035355, 0.00593893393599368
    return np.array([4 * roll / 2 * newton * arm, 4 * pitch / 2 * newton * arm, 4 * yaw * newton * yaw_arm])


@given(
    quat=vectors(4, 1.0).filter(lambda q: np.linalg.norm(q) > 0.1),
    rpy=st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3)).map(np.array),
)
def test_the_rotation_error_agrees_with_mellinger_and_kumar(quat, rpy):
    """Eq. 10 without its one half; small gains avoid all limits."""
    p = params(kR=[100.0, 100, 100], ki_m=ZERO)
    quat = quat / np.linalg.norm(quat)
    now, desired = Rotation.from_quat(quat).as_matrix(), Rotation.from_euler("ZYX", rpy[::-1]).as_matrix()
    difference = desired.T @ now - now.T @ desired
    error = np.array([difference[2, 1], difference[0, 2], difference[1, 0]])
    wrench, integral = run_controller([*rpy, HALF_THRUST], quat, p=p)
    np.testing.assert_allclose(wrench[1:], torque_of_pwm(*(-100 * error)), atol=1e-9)
    np.testing.assert_allclose(integral, np.clip(-error / 500, -p.int_err_max, p.int_err_max), atol=1e-12)


@pytest.mark.parametrize("freq", [100, 500])
def test_the_derivative_acts_on_roll_and_pitch_at_any_rate(freq):
    p = params(kw=ZERO, ki_m=ZERO, kd_omega=[200.0, 200.0, 200.0])
    before, now = np.array([0.0, 0.01, -0.01]), np.array([0.01, -0.01, 0.02])
    wrench, _ = run_controller([0, 0, 0, HALF_THRUST], rates=now, before=before, freq=freq, p=p)
    pwm = -200 * (now - before) * freq * [1, 1, 0]
    np.testing.assert_allclose(wrench[1:], torque_of_pwm(*pwm), atol=1e-12)
    # The derivative of the desired rates is subtracted: a drone that follows them exactly gets no torque.
    wrench, _ = run_controller(
        [0, 0, 0, HALF_THRUST], rates=now, before=before, desired=now, desired_before=before, freq=freq, p=p
    )
    np.testing.assert_allclose(wrench[1:], ZERO, atol=1e-15)


def test_the_integral_acts_and_is_limited():
    p = params(ki_m=[0, 0, 500.0], kR=ZERO, int_err_max=[1.0, 1.0, 2.0])
    wrench, integral = run_controller([0, 0, 0, HALF_THRUST], integral=np.array([0, 0, 5.0]), p=p)
    np.testing.assert_allclose(integral, [0, 0, 2.0])
    np.testing.assert_allclose(wrench[1:], torque_of_pwm(0, 0, 1000.0), atol=1e-15)


@given(cmd=vectors(4, 3.0), rates=vectors(3, 30))
def test_law_09_thrusts_saturate_rotor_by_rotor_as_documented(cmd, rates):
    wrench, _ = run_controller(cmd, rates=rates)
    airframe = load_airframe("cf21B_500")
    mixing = np.vstack([np.ones(4), airframe.mixing_matrix * [[0.035355], [0.035355], [0.00593893393599368]]])
    thrusts = np.linalg.solve(mixing, wrench)
    if cmd[3] < np.finfo(float).tiny:  # XLA treats subnormal numbers as zero
        np.testing.assert_array_equal(wrench, np.zeros(4))
    else:
        assert np.all(thrusts >= 0.2 * 7000 / 65535 - 1e-12)
        assert np.all(thrusts <= 0.2 + 1e-12)


def test_torque_commands_saturate_one_by_one():
    p = params(torque_pwm_max=[100.0, 200.0, 300.0])
    wrench, _ = run_controller([1.0, 1.0, 1.0, HALF_THRUST], p=p)
    np.testing.assert_allclose(wrench[1:], torque_of_pwm(100, 200, 300), atol=1e-12)
