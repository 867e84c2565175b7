"""The firmware's PID and Mellinger controllers, compared with the compiled firmware, and in flight."""

import jax
import numpy as np
import pytest
from cases import vectors
from hypothesis import given
from hypothesis import strategies as st

from crazysim.control.power_distribution import PowerDistributionParams, distribute_power
from crazysim.drones import load_airframe
from crazysim.lab.validate import firmware_controllers

distribute = jax.jit(distribute_power, static_argnames="whole_numbers")


@pytest.mark.parametrize("name", firmware_controllers.CASES)
def test_motor_commands_agree_with_the_firmware(name):
    """The compiled C sources (docs/guides/controllers.md) use integers, which differ by up to 5 PWM from real numbers.

    Truncation of roll, pitch, yaw and motor loses less than one each. If the highest motor exceeds its limit, all
    motors are lowered by the excess. The error is then that of a difference of two motors: twice that of two torques,
    and less than one.
    """
    expected = firmware_controllers.recorded_pwm(name)
    assert 0.05 < np.mean(expected == 0) < 0.5
    assert 0.05 < np.mean(expected == 65535) < 0.5
    real_differences = firmware_controllers.pwm_differences(name)
    assert real_differences.max() < firmware_controllers.MAX_TRUNCATION + firmware_controllers.MAX_ROUNDING
    assert np.mean(real_differences < 4) > 0.998
    integer_differences = firmware_controllers.pwm_differences(name, whole_numbers=True)
    assert integer_differences.max() < 1.0 + firmware_controllers.MAX_ROUNDING
    assert np.mean(integer_differences < 0.5) > 0.9  # equal; rounding of float32 moves a number across an integer


@pytest.fixture(scope="module")
def motors():
    return PowerDistributionParams.create(load_airframe("cf2x_L250"))


@given(vectors(3, 60000.0), st.floats(1.0, 65535.0))
def test_power_distribution_stays_within_the_limits(torque, thrust):
    motors = PowerDistributionParams.create(load_airframe("cf2x_L250"))
    pwm = np.asarray(distribute(np.array([thrust]), np.asarray(torque, np.float32), params=motors))
    assert pwm.min() >= 0
    assert pwm.max() <= 65535.01
    assert not np.any(np.asarray(distribute(np.array([0.0]), np.asarray(torque, np.float32), params=motors)))
