"""The outer loop, from setpoint to attitude and thrust."""

import functools

import jax
import numpy as np
import pytest
from cases import controller_params
from scipy.spatial.transform import Rotation

from crazysim.control import StateParams, state2attitude

pytestmark = pytest.mark.usefixtures("x64")

LEVEL = np.array([0.0, 0, 0, 1])
controller = jax.jit(state2attitude, static_argnames="ctrl_freq")
params = functools.partial(controller_params, StateParams)


def setpoint(pos=(0, 0, 0), vel=(0, 0, 0), acc=(0, 0, 0), quat=(0, 0, 0, 1), rates=(0, 0, 0)):
    return np.array([*pos, *vel, *acc, *quat, *rates], np.float64)


def run_controller(cmd, pos=(0, 0, 0), quat=LEVEL, vel=(0, 0, 0), integral=(0, 0, 0), ctrl_freq=100, p=None):
    state = (np.array(pos, float), np.asarray(quat), np.array(vel, float))
    return controller(*state, cmd, np.array(integral, float), ctrl_freq, params=params() if p is None else p)


def test_at_the_setpoint_the_command_is_level_and_carries_the_assumed_mass():
    """The thrust follows from the firmware's factors: 0.0393 * 9.81 N * 132000 PWM/N * 0.8 N / 65535 PWM."""
    cmd, integral = run_controller(setpoint())
    np.testing.assert_allclose(cmd, [0, 0, 0, 0.0393 * 9.81 * 132000 * 4 * 0.2 / 65535], atol=1e-12)
    np.testing.assert_array_equal(integral, np.zeros(3))


@pytest.mark.parametrize("freq", [50, 100, 500])
def test_the_integral_sums_errors_over_the_control_rate_and_stays_within_its_limit(freq):
    _, integral = run_controller(setpoint(pos=(0.1, -0.2, 0.3)), integral=(0.5, 0, 0), ctrl_freq=freq)
    np.testing.assert_allclose(integral, [0.5 + 0.1 / freq, -0.2 / freq, 0.3 / freq], rtol=1e-12)
    _, integral = run_controller(setpoint(pos=(1000, -1000, 1000)), integral=(1.9, -1.9, 0.3), ctrl_freq=freq)
    np.testing.assert_allclose(integral, [2, -2, 0.4], rtol=1e-12)


def test_each_gain_acts_on_its_error():
    """The setpoint is straight above, so the thrust is the force: kp, kd, ki and mass are each checked by hand."""
    p = params(thrust_scale=[1.0])
    mass, kp, kd, ki = 0.0393, 1.25, 0.5, 0.05

    def thrust(**kwargs):
        return float(run_controller(setpoint(**kwargs.pop("to", {})), p=p, **kwargs)[0][3])

    hover = thrust()
    assert thrust(to={"pos": (0, 0, 0.1)}) - hover == pytest.approx(0.1 * kp + ki * 0.1 / 100)
    assert thrust(to={"vel": (0, 0, 0.1)}) - hover == pytest.approx(0.1 * kd)
    assert thrust(vel=(0, 0, 0.1)) - hover == pytest.approx(-0.1 * kd)
    assert thrust(to={"acc": (0, 0, 0.1)}) - hover == pytest.approx(0.1 * mass)
    assert thrust(integral=(0, 0, 0.2)) - hover == pytest.approx(0.2 * ki)


@pytest.mark.parametrize("scale", [1.0, 1e-3, -7.0])
def test_only_the_yaw_of_a_commanded_quaternion_of_any_length_is_used(scale):
    yaw, tilt = Rotation.from_euler("z", 0.7), Rotation.from_euler("ZYX", [0.7, 0.4, -0.3])
    expected, _ = run_controller(setpoint(quat=yaw.as_quat()))
    np.testing.assert_allclose(run_controller(setpoint(quat=scale * tilt.as_quat()))[0], expected, atol=1e-12)
    assert float(expected[2]) == pytest.approx(0.7)
