"""Time-optimal plans: a bound by hand, gates, published times, and the simulator's own dynamics."""

import numpy as np
import pytest

from crazysim import ConfigError, load_airframe
from crazysim.envs import Track, gates_of_track, load_track, time_flight
from crazysim.lab.racing.time_optimal import fly_open_loop, plan_race

G = 9.81


def climb(*heights, finish=9.0):
    """Waypoints above each other, each passed within 1 cm."""
    n = len(heights)
    return Track(
        gates_pos=[(0, 0, z) for z in heights], gates_rpy=[(0, 0, 0)] * n, openings=[0.01] * n, start=(0, 0, 1),
        finish=(0, 0, finish), obstacles_pos=(),
    )  # fmt: skip


@pytest.mark.long("three searches of a flight")
def test_a_climb_through_three_waypoints_takes_the_time_of_full_thrust_and_fall():
    """Full thrust, then none: h = a t1^2 / 2 + b t2^2 / 2 with a t1 = b t2, and b = g for a drone that turns slowly.

    One that can turns over and brakes with its rotors: no drone brakes at more than full thrust and gravity.
    """
    airframe = load_airframe("uzh_cpc")
    full = 4 * airframe.value("rotors.thrust_max") / airframe.value("rigid_body.mass")
    straight, bound = (np.sqrt(2 * 8.0 * (1 / (full - G) + 1 / b)) for b in (G, full + G))
    plan = plan_race(climb(3.0, 5.0, 7.0), body_rate=(1.0, 1.0, 1.0))
    # The thrust that switches lasts a node of 0.04 s, in which it is a mean: at most 1e-3 of the time is lost.
    assert straight * (1 - 1e-6) < plan.duration < 1.001 * straight
    assert plan.thrust.min() >= -1e-6
    assert plan.thrust.max() <= airframe.value("rotors.thrust_max") + 1e-6
    turning = plan_race(climb(3.0, 5.0, 7.0))
    assert bound < turning.duration < 0.8 * straight


def test_a_plan_keeps_its_limits_and_crosses_its_gates_in_the_simulators_dynamics():
    """A turn through a gate of 0.4 m and back; two steps of RK4 between nodes leave a drift of millimetres."""
    track = Track(
        gates_pos=[(3.0, 0.0, 1.5)], gates_rpy=[(0, 0, np.pi / 2)], openings=[[(0.2, 0.2), (0.2, -0.2), (-0.2, -0.2),
        (-0.2, 0.2)]], start=(0, 0, 1), finish=(0, 0.5, 1), obstacles_pos=(),
    )  # fmt: skip
    rates = (12.0, 12.0, 1.0)
    plan = plan_race(track, "uzh_5inch", body_rate=rates, floor=0.5)
    assert np.all(np.abs(plan.ang_vel) < np.array(rates) + 1e-6)
    assert plan.pos[:, 2].min() > 0.5 - 1e-6
    (gate,) = gates_of_track(track)
    offset = (plan.pos - gate.pos) @ gate.rot
    k = 4 + np.argmin(np.abs(offset[4:, 0]))  # the start lies in the gate's plane, beside the gate
    assert abs(offset[k, 0]) < 1e-4
    assert np.all(np.abs(offset[k, 1:]) < 0.2 + 1e-4)
    assert (plan.vel[k] @ gate.rot)[0] > 0, "along the gate's axis"
    flown = fly_open_loop(plan)
    np.testing.assert_allclose(flown[:, :3], plan.pos, atol=5e-3)
    np.testing.assert_allclose(flown[-1, 3:6], 0, atol=0.01)


@pytest.mark.long("plans with the speeds of the rotors")
def test_rotors_with_lag_take_longer_and_fly_as_in_the_simulator():
    """Commands stay within their limits; six steps of RK4 a node leave a drift of millimetres."""
    track, rates = climb(3.0, 5.0, finish=6.0), (12.0, 12.0, 3.0)
    without, plan = (plan_race(track, "uzh_5inch", body_rate=rates, rotor_lag=lag) for lag in (False, True))
    # At most by the time in which the rotors reach full thrust, and that in which they stop: a few times the lag.
    assert without.duration < plan.duration < without.duration + 4 * 0.033
    airframe = plan.airframe
    assert plan.thrust.max() <= airframe.value("rotors.thrust_max") * (1 + 1e-6)
    assert plan.thrust.min() >= airframe.value("rotors.thrust_min") * (1 - 1e-6)
    np.testing.assert_allclose(plan.rotor_vel[0] / airframe.rotor_vel(0.75 * G / 4), 1, rtol=1e-3)
    np.testing.assert_allclose(fly_open_loop(plan)[:, :3], plan.pos, atol=5e-3)
    # From the speeds before, each rotor approaches its command by exp(-t / 0.033 s).
    command, h = airframe.rotor_vel(plan.thrust), np.diff(plan.time)[:, None]
    expected = command + (plan.rotor_vel[:-1] - command) * np.exp(-h * 30.303)
    np.testing.assert_allclose(plan.rotor_vel[1:], expected, atol=1e-3 * airframe.rotor_vel_limits.max())


@pytest.mark.long("plans eight gates")
def test_a_drone_with_other_curves_crosses_the_gates_of_two_laps():
    """Torque curves with linear terms, corners cut at fast sideways motion, and the last gate as the end."""
    track = load_track("lsy_drone_racing")
    plan = plan_race(track, "cf21B_500", floor=0.2, laps=2)
    clock = time_flight(track, plan.time, plan.pos, laps=2)
    assert bool(clock.finished)
    assert float(clock.time) == pytest.approx(plan.duration, abs=1e-3)
    np.testing.assert_allclose(fly_open_loop(plan)[:, :3], plan.pos, atol=5e-3)


@pytest.mark.long("searches 183 nodes for the fastest flight through seven gates")
def test_the_published_time_through_seven_gates_is_reached():
    """7.01 s (README of TOGT-Planner), within 1%, with its limits; a prism of 16 m is not left."""
    track = load_track("split_s_shapes")
    plan = plan_race(track, body_rate=(15.0, 15.0, 3.0), floor=None)
    assert abs(plan.duration - 7.01) < 0.01 * 7.01
    prism = gates_of_track(track)[2]
    offset = (plan.pos - prism.pos) @ prism.rot
    first, last = (int(np.argmin(np.abs(offset[:, 0] - x))) for x in (-8.0, 8.0))
    excess = offset[first : last + 1, 1:] @ prism.half_planes[:, :2].T - prism.half_planes[:, 2]
    assert last - first > 10
    assert excess.max() < 1e-4
    assert np.linalg.norm(fly_open_loop(plan)[-1, :3] - track.finish) < 0.02


@pytest.mark.parametrize("settings", [{"laps": 0}, {"dt": 0.0}, {"body_rate": (1.0, 1.0)}, {"body_rate": (1, 1, -1)}])
def test_law_09_wrong_settings_are_named(settings):
    with pytest.raises(ConfigError, match=r"lap|dt|body rates"):
        plan_race(climb(3.0), **settings)


def test_law_09_a_track_that_cannot_be_flown_is_named():
    with pytest.raises(ConfigError, match="Raise body_rate or thrust, lower floor"):
        plan_race(climb(3.0, 0.2), floor=1.0)
