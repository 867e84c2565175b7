"""Rotor speeds from commands and voltage, and the lag of motors."""

from dataclasses import replace

import numpy as np
import pytest

from crazysim.drones import load_airframe
from crazysim.errors import ConfigError
from crazysim.lab.identify import Log, motor_lag, with_speeds
from crazysim.lab.identify.fitted import lag_signal
from crazysim.lab.identify.motors import mean_motor_lag

DT, N = 0.01, 1500
AIRFRAME = "cf2x_L250"


def create_log(command, voltage=None, rotor_vel=None):
    t, zeros = DT * np.arange(N), np.zeros((N, 3))
    rotor_vel = np.zeros((N, 0)) if rotor_vel is None else rotor_vel
    return Log("flight", t, zeros, np.tile([0.0, 0, 0, 1], (N, 1)), zeros, zeros, rotor_vel, command, voltage=voltage)


def test_voltage_and_lag_give_the_speeds():
    """A step of the commands in the middle, at 3.8 V, against a fine integration of the airframe's equation."""
    airframe = load_airframe(AIRFRAME)
    command = np.where(np.arange(N) < N // 2, 0.6, 0.7)
    result = with_speeds(create_log(np.tile(command[:, None], 4), np.full(N, 3.8)), airframe)
    low, high = (airframe.rotor_vel(np.polyval(airframe.value("battery.thrust_over_voltage")[::-1], 3.8 * x))
                 for x in (0.6, 0.7))  # fmt: skip
    a, b, _, _ = airframe.value("rotors.lag")
    speed, fine_speeds = float(np.ravel(low)[0]), []
    for k in range(200 * 20):
        speed += DT / 200 * (np.ravel(high)[0] - speed) * (a + b * (np.ravel(high)[0] + speed))
        if k % 200 == 199:
            fine_speeds.append(speed)
    middle = N // 2 - 100
    np.testing.assert_allclose(result.rotor_vel[:middle, 0], np.ravel(low)[0], rtol=1e-4)
    np.testing.assert_allclose(result.rotor_vel[middle + 1 : middle + 21, 0], fine_speeds, rtol=1e-3)
    assert "modelled" in result.repairs[0]


def test_rotors_that_need_more_command_pull_the_same():
    command = np.tile([0.6, 0.63, 0.6, 0.66], (N, 1))
    command[50, 2] = -9.9
    result = with_speeds(create_log(command, np.full(N, 3.8)), load_airframe(AIRFRAME))
    np.testing.assert_allclose(result.rotor_vel, result.rotor_vel[:, :1] * np.ones(4), rtol=1e-5)
    assert "interpolated 1 commands" in result.repairs[1]


def test_samples_on_the_ground_are_left_out():
    command = np.full((N, 4), 0.6)
    command[:200] = command[-100:] = 0.1
    result = with_speeds(
        replace(create_log(command, np.full(N, 3.8)), gaps=np.array([50, 400])), load_airframe(AIRFRAME)
    )
    assert (result.t[0], result.t[-1]) == pytest.approx((200 * DT + 1, (N - 102) * DT - 1))
    assert result.gaps.tolist() == [100]
    assert len(result.pos) == len(result.rotor_vel) == len(result.t)


def test_measured_speeds_stay_and_commands_in_other_units_are_refused():
    airframe, command = load_airframe(AIRFRAME), np.full((N, 4), 40000.0)
    measured = create_log(command, np.full(N, 3.8), command)
    assert with_speeds(measured, airframe) is measured
    assert with_speeds(create_log(command), airframe).rotor_vel.shape == (N, 0)
    with pytest.raises(ConfigError, match="share_per_command"):
        with_speeds(create_log(command, np.full(N, 3.8)), airframe)


@pytest.mark.parametrize("rate", [10.0, 40.0])
def test_lag_is_found_behind_noise_and_delay(rate):
    """Speeds that are 12 ms late and noisy by a tenth of their deviation; their scatter is below 2%."""
    rng = np.random.default_rng(0)
    command = np.repeat(rng.uniform(0.4, 0.9, (N // 20, 4)), 20, axis=0)
    t, response = DT * np.arange(N), lag_signal(command, DT, rate)
    speeds = np.stack([np.interp(t - 0.012, t, x) for x in (8000 + 9000 * response + 6000 * response**2).T], axis=-1)
    speeds += rng.normal(scale=0.1 * speeds.std(), size=speeds.shape)
    result = motor_lag([create_log(command, rotor_vel=speeds), create_log(command)])
    assert result.shape == (1, 4)
    np.testing.assert_allclose(np.median(result), rate, rtol=0.04)
    assert np.all(np.isnan(motor_lag([replace(create_log(command, rotor_vel=1e4 * command))])))


@pytest.mark.parametrize("rate", [10.0, 20.0, 40.0])
def test_deviation_of_the_lag_contains_commands_that_change_between_samples(rate):
    """Commands of a loop at 500 Hz, which jump at each tick of a loop at 100 Hz, and are logged at 100 Hz."""
    for seed in range(3):
        rng, n_steps = np.random.default_rng(seed), 5 * N
        commands = np.roll(np.repeat(rng.uniform(8000, 12000, (n_steps // 100, 4)), 100, axis=0), seed, axis=0)
        jumps = np.repeat(rng.normal(scale=600, size=(N, 4)), 5, axis=0)
        commands += jumps * np.tile(np.exp(-np.arange(5) / 2.5), N)[:, None]
        speeds, decay = commands + 0, np.exp(-0.002 * rate)
        for k in range(n_steps - 1):
            speeds[k + 1] = decay * speeds[k] + (1 - decay) * commands[k]
        measured = speeds[4::5] + rng.normal(scale=10, size=(N, 4))
        value, deviation = mean_motor_lag([create_log(commands[4::5], rotor_vel=measured)])
        assert abs(value - rate) < 3 * deviation, (value, deviation)
        assert deviation < 0.3 * rate, (value, deviation)
