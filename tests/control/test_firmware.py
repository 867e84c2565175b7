"""The firmware's PID and Mellinger controllers, compared with the compiled firmware, and in flight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import vectors
from hypothesis import given
from hypothesis import strategies as st

from crazysim.control.mellinger import Mellinger, rotation_error
from crazysim.control.pid import PID
from crazysim.control.power_distribution import PowerDistributionParams, distribute_power, rotor_vel_of_pwm
from crazysim.drones import load_airframe
from crazysim.dynamics.rotor import quadratic_curve
from crazysim.errors import ConfigError
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


@pytest.mark.usefixtures("x64")
def test_rounding_to_whole_numbers_does_not_change_the_gradient(motors):
    def total(torque, whole):
        return distribute_power(jnp.array([30000.3]), torque, params=motors, whole_numbers=whole) @ jnp.array(
            [1.0, 2, 3, 5]
        )

    torque = np.array([1001.7, -500.2, 300.9])
    smooth, whole = (jax.jit(jax.grad(total), static_argnums=1)(torque, flag) for flag in (False, True))
    np.testing.assert_allclose(whole, smooth)
    # 1001 / 2, 500 / 2 and 300, truncated, with the signs of each rotor.
    pwm = distribute(np.array([30000.3]), torque, params=motors, whole_numbers=True)
    np.testing.assert_allclose(sorted(np.asarray(pwm)), [29450, 29550, 29950, 31050], atol=1e-9)


@pytest.fixture(scope="module")
def motors():
    return PowerDistributionParams.create(load_airframe("cf2x_L250"))


def test_saturation_lowers_all_motors_and_keeps_the_torque(motors):
    """60000 +- 10000 PWM: the excess of 4465 is subtracted from all four, so the difference stays 20000."""
    pwm = distribute(np.array([60000.0]), np.array([20000.0, 0, 0]), params=motors)
    np.testing.assert_allclose(pwm, [45535, 45535, 65535, 65535], atol=0.02)


@given(vectors(3, 60000.0), st.floats(1.0, 65535.0))
def test_power_distribution_stays_within_the_limits(torque, thrust):
    motors = PowerDistributionParams.create(load_airframe("cf2x_L250"))
    pwm = np.asarray(distribute(np.array([thrust]), np.asarray(torque, np.float32), params=motors))
    assert pwm.min() >= 0
    assert pwm.max() <= 65535.01
    assert not np.any(np.asarray(distribute(np.array([0.0]), np.asarray(torque, np.float32), params=motors)))


def test_thrust_is_proportional_to_pwm_and_idle_is_off(motors):
    pwm = np.array([0.0, 100.0, 32767.5, 65535.0])
    rotor_vel = np.asarray(jax.jit(rotor_vel_of_pwm)(pwm, params=motors))
    assert rotor_vel[0] == 0
    np.testing.assert_allclose(
        np.asarray(quadratic_curve(rotor_vel, np.asarray(motors.rpm2thrust)))[1:], 0.12 * pwm[1:] / 65535, rtol=1e-3
    )


def test_the_rotation_error_is_twice_the_sine_of_the_angle():
    def about_x(angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])

    np.testing.assert_allclose(jax.jit(rotation_error)(about_x(0.3), np.eye(3)), [2 * np.sin(0.3), 0, 0], atol=1e-6)


@pytest.mark.parametrize("controller", [PID(), Mellinger()], ids=["pid", "mellinger"])
def test_an_airframe_without_gains_is_refused(controller):
    with pytest.raises(ConfigError, match=rf"bumblebee.*{controller.name}.*airframe-keys\.md"):
        controller.params(load_airframe("bumblebee"))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("controller", [PID(), Mellinger()], ids=["pid", "mellinger"])
def test_gradients_are_finite_at_rest_and_at_saturation(controller):
    states, commands = np.zeros((6, 2, 13)), np.zeros((6, 2, 16))
    states[..., 9] = commands[..., 12] = 1.0
    commands[:, 1, :3] = 50.0

    def total(commands):
        return firmware_controllers.traceable_pwm(controller, "state", jnp.asarray(states), commands).sum()

    gradient = jax.jit(jax.grad(total))(jnp.asarray(commands))
    assert np.all(np.isfinite(gradient))
    assert np.any(gradient[:, 0])
