"""Swarms: commanders that interpret commands as the firmware does, and the simulation that follows them."""

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazysim import Sim
from crazysim.control import Control
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.lab.live.host_trajectory import HostTrajectory, to_host_trajectories
from crazysim.lab.live.loop import Live
from crazysim.lab.live.swarm import Commander, DroneState, Swarm
from crazysim.lab.live.swarm.motion import PlannedMotion, nearest_yaw, plan_move
from crazysim.trajectories import Trajectory, circle, line, minimum_snap

MAX_DISTANCE = 0.02
"""Largest distance of a drone from its setpoint shortly after a move, m."""


def create_flying_commander(control="state", **commands):
    """Return a commander in flight at (1, 2, 1), after commands that are given by name with their arguments."""
    commander = Commander(Control(control))
    tick(commander, 10.0)
    for name, arguments in commands.items():
        getattr(commander, name)(*arguments)
    return commander


def tick(commander, now, pos=(1.0, 2.0, 1.0), yaw=0.5):
    return commander.tick(now, np.array(pos), np.zeros(3), yaw)


# Plans --------------------------------------------------------------------------------------------------------------


def test_a_move_starts_at_its_state_and_ends_at_rest():
    rng = np.random.default_rng(0)
    start, goal = rng.normal(size=(3, 4)), rng.normal(size=4)
    path = plan_move(start, goal, 2.5)
    np.testing.assert_allclose(path.derivatives(0.0, 2), start, atol=1e-12)
    end = path.derivatives(2.5, 3)
    np.testing.assert_allclose(end, [goal, [0] * 4, [0] * 4, [0] * 4], atol=1e-10)
    np.testing.assert_allclose(path.derivatives(0.0, 3)[3], 0, atol=1e-10)
    straight = plan_move(start, goal, 2.5, linear=True)
    np.testing.assert_allclose(straight.setpoint(1.25), (start[0] + goal) / 2)


def test_a_reversed_slow_plan():
    path = HostTrajectory.from_trajectory(line([0, 0, 1], [2, 0, 1], 4.0))
    plan = PlannedMotion(path, 1.0, timescale=2.0, reversed=True)
    np.testing.assert_allclose(plan.evaluate(1.0)[0, :3], [2, 0, 1], atol=1e-6)
    np.testing.assert_allclose(plan.evaluate(5.0)[0, :3], [1, 0, 1], atol=1e-6)
    slope = (plan.evaluate(5.01)[0] - plan.evaluate(4.99)[0]) / 0.02
    np.testing.assert_allclose(plan.evaluate(5.0)[1], slope, atol=1e-5)
    np.testing.assert_allclose(
        plan.evaluate(5.0)[2], (plan.evaluate(5.01)[1] - plan.evaluate(4.99)[1]) / 0.02, atol=1e-5
    )
    assert not plan.has_ended(8.9)
    assert plan.has_ended(9.0)


def test_paths_equal_trajectories():
    trajectories = [circle(radius=0.5, period=3.0), minimum_snap([[0, 0, 1], [1, 0, 2], [2, 1, 1]], [1.0, 2.0])]
    for path, trajectory in zip(to_host_trajectories(trajectories), trajectories, strict=True):
        for t in (-1.0, 0.0, 0.7, 1.0, 2.9, 4.1):
            s = trajectory.evaluate(t)
            expected = [[*s.pos, *s.yaw], [*s.vel, *s.yaw_rate], [*s.acc, *s.yaw_acc]]
            np.testing.assert_allclose(path.derivatives(t, 2), expected, atol=2e-3)
    assert len(to_host_trajectories(Trajectory.stack(trajectories))) == 2
    assert len(to_host_trajectories(trajectories[0])) == 1


def test_the_nearest_yaw():
    assert nearest_yaw(3.0, -3.0) == pytest.approx(2 * np.pi - 3.0)
    assert nearest_yaw(7.0, 0.5) == pytest.approx(2 * np.pi + 0.5)


# Commander ----------------------------------------------------------------------------------------------------------


def test_motors_are_off_before_take_off_and_after_landing():
    commander = Commander()
    assert tick(commander, 0.0) is None
    commander.take_off(1.5, 2.0, yaw=0.0)
    np.testing.assert_allclose(tick(commander, 2.0)[:3], [1, 2, 1.5])
    commander.land(0.1, 1.0)
    assert tick(commander, 2.99, pos=(1, 2, 0.1)) is not None
    assert tick(commander, 3.0, pos=(1, 2, 0.1)) is None


def test_a_landing_continues_if_the_drone_is_still_too_high():
    """It is too high if the controller has an offset, if it carries a load, or on a pad above the target."""
    commander = create_flying_commander(land=(0.04, 1.0))
    above = np.array([1.0, 2.0, 0.13])
    heights = [commander.tick(now, above, np.array([0, 0, -0.2]), 0.5)[2] for now in (11.0, 11.1, 11.3, 20.0)]
    np.testing.assert_allclose(heights, [0.04, 0.01, -0.05, -0.96], atol=1e-9)
    assert commander.tick(20.1, above * [1, 1, 0.05 / 0.13], np.array([0, 0, -0.2]), 0.5) is None
    standing_commander = create_flying_commander(land=(0.04, 1.0))
    assert standing_commander.tick(11.4, above, np.zeros(3), 0.5) is not None
    assert standing_commander.tick(11.6, above, np.zeros(3), 0.5) is None


def test_commands_are_in_the_frame_of_the_estimate():
    """The drone is at (1, 2) with yaw 0.5; its estimate is (5, 5) with yaw 0.5 + pi / 2, a quarter turn to the left."""
    commander = create_flying_commander()
    commander.set_estimate(np.array([1.0, 2.0, 1.0]), 0.5, np.array([5.0, 5.0, 0.0, 0.5 + np.pi / 2]))
    commander.go_to([5.0, 6.0, 0.5], 0.5 + np.pi / 2, 1.0)
    tick(commander, 11.0)
    command = tick(commander, 13.0)
    np.testing.assert_allclose(command[:3], [2.0, 2.0, 1.5], atol=1e-9)
    np.testing.assert_allclose(command[9:13], [0, 0, np.sin(0.25), np.cos(0.25)], atol=1e-9)
    state = DroneState(0.0, np.array([2.0, 2.0, 1.0]), command[9:13], np.array([1.0, 0, 0]), np.zeros(3), np.zeros(3))
    estimate = commander.estimate(state)
    np.testing.assert_allclose([*estimate.pos, *estimate.vel], [5, 6, 0, 0, 1, 0], atol=1e-9)
    assert estimate.rpy[2] == pytest.approx(0.5 + np.pi / 2)
    tilted = create_flying_commander("attitude")
    tilted.set_estimate(np.zeros(3), 0.0, np.array([0.0, 0.0, 0.0, 1.0]))
    tilted.command("attitude", [0.1, 0.2, 1.3, 0.4])
    np.testing.assert_allclose(tick(tilted, 10.1), [0.1, 0.2, 0.3, 0.4])
    commander.reset()
    assert commander.estimate(state) is state


def test_parameters_have_an_effect_or_are_refused():
    swarm = Swarm(Sim(control="state"))
    values = swarm.parameters[0]
    initial_values = dict(values)
    for name, value in {"stabilizer.controller": 2, "ring.effect": 6, "pid_attitude.pitch_kd": 0.1234}.items():
        with pytest.raises(ConfigError, match="expected a value whose effect is simulated"):
            swarm.set_parameter(0, name, value)
    for name, value in {"deck.bcFlow2": 0, "ring.fadeTime": np.nan}.items():
        with pytest.raises(ConfigError, match="can be written"):
            swarm.set_parameter("cf1", name, value)
    for name in ("sound.freq", "no.thing"):
        with pytest.raises(ConfigError, match=r"has, got .*lists the parameters"):
            swarm.set_parameter(0, name, 1)
        with pytest.raises(ConfigError, match="lists the parameters"):
            values.get_value(name)
    for name, value in initial_values.items():
        if not values.definitions[name].read_only:
            swarm.set_parameter(0, name, np.float32(value))
    assert dict(values) == pytest.approx(initial_values)
    assert {"pid_attitude.roll_kp": 6.0, "pid_attitude.yaw_kd": 0.35}.items() <= initial_values.items()


def test_lights_fade_and_shine_by_their_effect():
    swarm = Swarm(Sim(control="state"))
    swarm.set_parameter(0, "ring.solidRed", 255)
    np.testing.assert_array_equal(swarm.colors[0], 0)
    swarm.set_parameter(0, "ring.effect", 7)
    np.testing.assert_allclose(swarm.colors[0], [1, 20 / 255, 20 / 255])
    swarm.set_parameter(0, "ring.fadeTime", 0.0)
    swarm.set_parameter(0, "ring.fadeColor", 0x000000)
    swarm.set_parameter(0, "ring.effect", 14)
    swarm.set_parameter(0, "ring.fadeTime", 1.0)
    swarm.set_parameter(0, "ring.fadeColor", 0xFF3300)
    np.testing.assert_array_equal(swarm.colors[0], 0)
    swarm.advance(0.5)
    np.testing.assert_allclose(swarm.colors[0], [0.5, 0.1, 0], atol=0.011)  # the error of a control step
    swarm.advance(1.0)
    np.testing.assert_allclose(swarm.colors[0], [1, 0.2, 0], atol=1e-12)
    swarm.set_parameter(0, "colorLedBot.wrgb8888", 0x10200000)
    np.testing.assert_allclose(swarm.colors[0], np.array([48, 16, 16]) / 255)
    swarm.colors[0] = 0.5  # set by a program
    swarm.advance(0.1)
    np.testing.assert_array_equal(swarm.colors[0], 0.5)
    swarm.set_parameter(0, "ring.effect", 13)
    swarm.set_leds(0, np.array([0xF800] * 6 + [0x001F] * 6))
    np.testing.assert_allclose(swarm.colors[0], [0.5, 0, 0.5])


def test_moves_continue_from_the_setpoint_in_force():
    commander = create_flying_commander(go_to=([2, 2, 1], 0.5, 2.0))
    command = tick(commander, 11.0, pos=(9, 9, 9))
    velocity = command[3:6].copy()
    assert velocity[0] > 0.5
    commander.go_to([0, 0, 1], 0.0, 3.0, relative=True)
    later_command = tick(commander, 11.0, pos=(9, 9, 9))
    np.testing.assert_allclose(later_command[3:6], velocity)
    assert tick(commander, 20.0)[0] == pytest.approx(command[0])


def test_a_mask_selects_the_groups_of_a_commander():
    commander = Commander()
    commander.group = 0b101
    assert [commander.in_group(mask) for mask in (0, 1, 2, 4, 6)] == [True, True, False, True, True]


def test_absolute_and_relative_trajectories_start_at_the_right_position():
    path = HostTrajectory.from_trajectory(line([0, 0, 1], [2, 0, 1], 4.0))
    commander = create_flying_commander(upload=(3, path), take_off=(1.0, 1.0))
    tick(commander, 12.0)
    commander.start_trajectory(3)
    np.testing.assert_allclose(tick(commander, 16.0)[:3], [3, 2, 1])
    commander.start_trajectory(3, relative=False)
    np.testing.assert_allclose(tick(commander, 20.0)[:3], [2, 0, 1], atol=1e-6)
    commander.start_trajectory(3, relative=True, relative_yaw=True)
    assert commander.goal()[0, 3] == pytest.approx(0.0, abs=1e-6)


def test_streamed_setpoints_take_precedence_until_they_stop():
    commander = create_flying_commander(go_to=([5, 0, 1], 0.0, 1.0))
    commander.position([1, 1, 1], 0.1)
    np.testing.assert_allclose(tick(commander, 10.1)[:3], [1, 1, 1])
    commander.go_to([5, 0, 1], 0.0, 1.0)
    np.testing.assert_allclose(tick(commander, 10.2)[:3], [1, 1, 1])  # the stream is still in force
    commander.notify_setpoints_stop(0.1)
    np.testing.assert_allclose(tick(commander, 10.25)[:3], [1, 1, 1])
    assert tick(commander, 11.5)[0] == pytest.approx(5.0)


def test_high_level_commands_begin_at_the_drone_while_setpoints_stream():
    reports = []
    commander = Commander(report=reports.append)
    tick(commander, 10.0, pos=(2.0, -1.0, 1.0), yaw=0.3)
    commander.position([5, 5, 5], 1.0)
    commander.notify_setpoints_stop()
    np.testing.assert_allclose(commander.goal()[0], [2, -1, 1, 0.3])  # the stream has set no setpoint yet
    commander.land(0.0, 2.0)
    np.testing.assert_allclose(tick(commander, 12.0, pos=(2.0, -1.0, 0.5))[:3], [2, -1, 0], atol=1e-9)
    assert not reports

    commander.position([5, 5, 5], 1.0)
    tick(commander, 12.1, pos=(3.0, 0.0, 1.0))
    commander.go_to([1, 0, 0], 0.0, 1.0, relative=True)
    assert len(reports) == 1
    assert "before go_to" in reports[0]
    assert "notify_setpoints_stop" in reports[0]
    np.testing.assert_allclose(tick(commander, 12.2)[:3], [5, 5, 5])
    commander.notify_setpoints_stop()
    np.testing.assert_allclose(tick(commander, 13.2)[:3], [4, 0, 1], atol=1e-9)


def test_the_end_of_a_stream_holds_the_position_and_then_stops_the_motors():
    commander = create_flying_commander(velocity=([1, 0, 0], 0.0))
    assert tick(commander, 10.4)[0] == pytest.approx(1.4)
    hold_command = tick(commander, 10.6, pos=(3, 3, 3))
    np.testing.assert_allclose(hold_command[:6], [3, 3, 3, 0, 0, 0])
    np.testing.assert_allclose(tick(commander, 11.9, pos=(4, 4, 4))[:3], [3, 3, 3])
    assert tick(commander, 12.1) is None


def test_hover_setpoints_turn_with_the_drone():
    commander = create_flying_commander(hover=(0.5, 0.0, 0.0, 1.7))
    command = tick(commander, 10.2)
    np.testing.assert_allclose(command[:3], [1 + 0.1 * np.cos(0.5), 2 + 0.1 * np.sin(0.5), 1.7])
    np.testing.assert_allclose(command[3:6], [0.5 * np.cos(0.5), 0.5 * np.sin(0.5), 0], atol=1e-12)


def test_attitudes_integrate_the_yaw_rate():
    commander = create_flying_commander("attitude", attitude=(0.1, 0.2, 1.0, 0.4))
    np.testing.assert_allclose(tick(commander, 10.2), [0.1, 0.2, 0.7, 0.4])
    np.testing.assert_allclose(tick(commander, 10.9), [0.0, 0.0, 0.7, 0.4])


def test_emergency_and_disarming():
    commander = create_flying_commander(go_to=([2, 2, 1], 0.5, 2.0))
    commander.arm(False)
    assert tick(commander, 10.1) is None
    with pytest.raises(ConfigError, match="disarmed"):
        commander.take_off(1.0, 1.0)
    commander.arm()
    commander.take_off(1.0, 1.0)
    commander.emergency()
    assert tick(commander, 10.2) is None
    with pytest.raises(ConfigError, match="locked"):
        commander.take_off(1.0, 1.0)


@pytest.mark.parametrize(
    "name, arguments, error",
    [
        ("take_off", (np.nan, 1.0), "finite numbers"),
        ("take_off", (1.0, 0.0), "positive duration"),
        ("land", (0.0, -1.0), "positive duration"),
        ("go_to", ([0, 0], 0.0, 1.0), "3 finite numbers"),
        ("go_to", ([0, 0, 1e9], 0.0, 1.0), "3 finite numbers"),
        ("go_to", ("abc", 0.0, 1.0), "3 numbers for goal"),
        ("start_trajectory", (7,), "one of the trajectories"),
        ("upload", (300, None), "from 0 to 255"),
        ("full_state", ([0] * 3, [0] * 3, [0] * 3, [0] * 4, [0] * 3), "unit quaternion"),
        ("attitude", (0, 0, 0, 0.4), "of level 'attitude'"),
        ("command", ("attitude", [0, 0, 0, 0.4]), "of level 'attitude'"),
    ],
)
def test_wrong_commands(name, arguments, error):
    commander = create_flying_commander()
    with pytest.raises(ConfigError, match=error):
        getattr(commander, name)(*arguments)
    assert tick(commander, 10.1) is None


numbers = st.floats(allow_nan=True, allow_infinity=True)
calls = st.one_of(
    st.tuples(st.sampled_from(["take_off", "land"]), st.tuples(numbers, numbers)),
    st.tuples(st.just("go_to"), st.tuples(st.tuples(numbers, numbers, numbers), numbers, numbers, st.booleans())),
    st.tuples(st.just("velocity"), st.tuples(st.tuples(numbers, numbers, numbers), numbers)),
    st.tuples(st.just("hover"), st.tuples(numbers, numbers, numbers, numbers)),
    st.tuples(st.just("position"), st.tuples(st.tuples(numbers, numbers, numbers), numbers)),
    st.tuples(st.just("start_trajectory"), st.tuples(st.integers(0, 2), numbers)),
    st.tuples(st.just("stop"), st.just(())),
)


@settings(max_examples=200, deadline=None)
@given(sequence=st.lists(st.tuples(st.floats(0.01, 3.0), calls), max_size=8))
def test_setpoints_stay_finite_after_any_commands(sequence):
    commander = create_flying_commander(upload=(1, HostTrajectory.from_trajectory(circle(radius=0.5, period=2.0))))
    now = 10.0
    for dt, (name, arguments) in sequence:
        with contextlib.suppress(ConfigError):
            getattr(commander, name)(*arguments)
        now += dt
        command = tick(commander, now)
        assert command is None or np.isfinite(command.astype(np.float32)).all()


# Swarm --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def swarm():
    return Swarm(Sim(n_drones=2, control="state"), ["a", "b"])


def test_a_swarm_reports_a_command_that_a_stream_keeps_from_taking_effect(swarm):
    swarm["b"].position([0, 0, 1], 0.0)
    swarm["b"].take_off(1.0, 1.0)
    assert [(r.name, "before take_off" in r.text) for r in swarm.reports.latest] == [("b", True)]
    swarm["b"].reset()


def test_a_swarm_flies(swarm):
    swarm.sim.reset()
    swarm.advance(0.1)
    home = swarm.home("a")
    swarm["a"].take_off(1.0, 2.0)
    swarm.advance(3.0)
    np.testing.assert_allclose(swarm.state("a").pos, [*home[:2], 1.0], atol=MAX_DISTANCE)
    np.testing.assert_allclose(swarm.state("b").pos, swarm.home("b"), atol=0.01)
    np.testing.assert_allclose(swarm.state("a").acc, [0, 0, 9.81], atol=0.3)
    swarm["a"].go_to([0.5, 0.0, 0.0], np.pi / 2, 2.0, relative=True)
    swarm.advance(3.0)
    np.testing.assert_allclose(swarm.state("a").pos[:2], home[:2] + [0.5, 0.0], atol=0.05)
    assert swarm.state("a").rpy[2] == pytest.approx(np.pi / 2, abs=0.05)
    swarm["a"].land(0.0, 2.0)
    swarm.advance(3.0)
    assert swarm.state("a").pos[2] < 0.02
    assert not swarm["a"].motors_on
    rotor = np.asarray(swarm.sim.data.states.rotor_vel)[0]
    assert rotor.max() < 2000  # rpm: the rotors run down


def test_a_reset_returns_to_the_floor(swarm):
    swarm["b"].take_off(1.0, 1.0)
    swarm.advance(1.0)
    swarm.sim.reset()
    swarm.advance(0.1)
    assert not swarm["b"].motors_on
    assert swarm.time == pytest.approx(0.1)


def test_a_thread_flies_in_real_time(swarm):
    swarm.sim.reset()
    swarm.advance(0.1)
    with swarm.start(speed=4.0):
        start_time = swarm.time
        swarm.sleep(0.5)
        assert swarm.time - start_time >= 0.5 - 1e-6
        with pytest.raises(ConfigError, match="running one"):
            swarm.advance(0.1)
    swarm.advance(0.1)


def test_a_loop_calls_the_swarm_and_shows_its_colours(swarm):
    swarm.colors[0] = (1.0, 0.5, 0.0)
    live = Live(swarm.sim)
    swarm(live)
    np.testing.assert_array_equal(live.lights[0], swarm.colors)
    with pytest.raises(ConfigError, match="got the loop of another simulation"):
        swarm(Live(Sim(control="state")))


def test_wrong_swarms(swarm):
    with pytest.raises(ConfigError, match="one world"):
        Swarm(Sim(n_worlds=2, control="state"))
    with pytest.raises(ConfigError, match="1 different names"):
        Swarm(Sim(control="state"), ["a", "b"])
    with pytest.raises(UnknownNameError, match="expected one of the drones"):
        swarm["c"]
