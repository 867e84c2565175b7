"""A policy flies in the live loop as in its environment, to goals that are typed, clicked or listed in a file."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from live_loops import no_compilation
from policies import save_steering, steer

from crazysim.__main__ import main
from crazysim.envs import make
from crazysim.errors import ConfigError
from crazysim.lab.live import Live, PolicyPilot
from crazysim.lab.live.picture import PictureSource
from crazysim.lab.live.policy_pilot import ARRIVAL_DISTANCE, parse_point, read_points
from crazysim.media import Flight

POINTS = [[0.5, 0.0, 1.0], [0.5, 0.5, 1.4]]


@pytest.fixture(scope="module")
def env():
    return make("hover", 2)


@pytest.fixture
def live_and_pilot(env):
    """Return a loop with a pilot that flies from the start."""
    pilot = PolicyPilot(env, steer)
    with Live(env.sim, env.freq, speed="max") as live:
        pilot.add_to(live)
        yield live, pilot


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return save_steering(tmp_path_factory.mktemp("run"))


def read_positions(live):
    return np.asarray(live.sim.data.states.pos)[:, 0]


def test_a_policy_flies_as_in_its_environment(env, live_and_pilot):
    live, _ = live_and_pilot
    state = jax.jit(env.reset)(jax.random.key(0))
    step = jax.jit(lambda state: env.step(state, steer(state.obs)))
    for _ in range(50):
        state = step(state)
    live.run(1.0)
    np.testing.assert_allclose(read_positions(live), state.data.states.pos[:, 0], atol=1e-5)


def test_a_policy_is_compiled_before_the_clock_starts(live_and_pilot, caplog):
    live, _ = live_and_pilot
    with no_compilation(live, caplog):
        live.run(0.2)


def test_typed_lines_set_the_goal_and_wrong_ones_change_nothing(live_and_pilot, caplog):
    live, pilot = live_and_pilot
    others = pilot.goals[1].copy()
    pilot.listen(live, ["0.5 -0.3, 1.2\n", "\n", "home\n", "1 2\n", "4 0 1\n", "0 0 nan\n", "0 0 -1\n"]).join()
    live.run(4.0)
    np.testing.assert_allclose(pilot.goals[0, 0], [0.5, -0.3, 1.2])
    np.testing.assert_array_equal(pilot.goals[1], others)
    assert np.abs(read_positions(live)[0] - [0.5, -0.3, 1.2]).max() < 0.05
    refused = [record.getMessage() for record in caplog.records if "refused" in record.getMessage()]
    assert len(refused) == 5
    assert "expected x y z, m, got 'home'" in refused[0]
    assert "within the arena of 'hover', x and y from -3 to 3 m, z from 0.02 to 3 m, got 4 0 1" in refused[2]
    source = PictureSource(live.sim, [0, 1])
    np.testing.assert_array_equal(source.take_picture(live).spheres["setpoints"].pos, pilot.goals)
    live.selected = None
    pilot.listen(live, ["0 0 1"]).join()
    live.run(0.1)
    assert "expected a selected drone" in caplog.text


def test_a_click_sets_the_goal_of_the_selected_drone_at_its_height(live_and_pilot):
    live, pilot = live_and_pilot
    height = pilot.goals[0, 0, 2]
    live.click(1, np.array([2.0, 2.0, 0.0]))  # the selected drone is in another world
    live.click(0, np.array([0.2, 0.4, 0.0]))
    np.testing.assert_allclose(pilot.goals[0, 0], [0.2, 0.4, height])
    assert pilot.goals[1, 0, 0] < 1.5
    live.run(4.0)
    assert np.abs(read_positions(live)[0] - pilot.goals[0, 0]).max() < 0.05
    live.reset()
    live.run(0.02)
    np.testing.assert_array_equal(pilot.goals, pilot._target_fn(live.sim.data))
    assert abs(pilot.goals[0, 0, 0] - 0.2) > 1e-3, "a reset begins the episode again"


def test_listed_points_are_passed_in_order(env):
    pilot = PolicyPilot(env, steer, POINTS)
    with Live(env.sim, env.freq, speed="max") as live:
        pilot.add_to(live)
        np.testing.assert_array_equal(pilot.goals[:, 0], [POINTS[0]] * 2)
        live.run(6.0)
        assert pilot.n_passed.tolist() == [[2], [2]]
        np.testing.assert_array_equal(pilot.goals[:, 0], [POINTS[1]] * 2)
        assert np.linalg.norm(read_positions(live) - POINTS[1], axis=-1).max() < ARRIVAL_DISTANCE
        live.go_to(0.1)
        assert pilot.n_passed.tolist() == [[0], [0]]
        live.go_to(6.0)
        assert pilot.n_passed.tolist() == [[2], [2]]
        live.reset()
        assert pilot.n_passed.tolist() == [[0], [0]]
        np.testing.assert_array_equal(pilot.goals[:, 0], [POINTS[0]] * 2)


def test_points_outside_of_the_arena_and_tasks_without_goals_are_refused(env):
    with pytest.raises(ConfigError, match="point 2: expected x y z, m, within the arena of 'hover'"):
        PolicyPilot(env, steer, [[0, 0, 1], [0, 3.5, 1]])
    track = make("track")
    with pytest.raises(ConfigError, match="a policy whose goals are positions, got one of 'track'"):
        PolicyPilot(track, lambda obs: jnp.zeros((1, 1, 4)), POINTS)
    pilot = PolicyPilot(track, lambda obs: jnp.zeros((1, 1, 4)))
    with pytest.raises(ConfigError, match="a policy whose goals are positions"):
        pilot.go_to(Live(track.sim, track.freq), [0, 0, 1])


def test_points_are_read_from_text(tmp_path):
    np.testing.assert_array_equal(parse_point(" 1, -2.5 3e-1\n"), [1.0, -2.5, 0.3])
    path = tmp_path / "points.csv"
    path.write_text("# x, y, z\n0.5,0,1\n\n0.5;0.5;1.4  # the last\n")
    np.testing.assert_array_equal(read_points(path), POINTS)
    path.write_text("0,0,1\n0,0\n")
    with pytest.raises(ConfigError, match=r"points.csv, line 2: expected x y z, m, got '0,0'"):
        read_points(path)
    path.write_text("# nothing\n")
    with pytest.raises(ConfigError, match="expected points in"):
        read_points(path)
    path.write_text("0,0,1\n", encoding="utf-16-le")
    with pytest.raises(ConfigError, match=r"expected text in UTF-8 in .*Save it as UTF-8"):
        read_points(path)
    with pytest.raises(ConfigError, match=r"expected an existing file, got .*none.csv"):
        read_points(tmp_path / "none.csv")


def test_the_command_flies_to_typed_and_to_listed_goals(folder, tmp_path, capsys):
    """The command flies once to a goal on the standard input, with a recording, and once to the points in a file."""
    read_end, write_end = os.pipe()
    os.write(write_end, b"0.4 0.2 1.1\n")
    os.close(write_end)
    stdin_copy = os.dup(0)
    os.dup2(read_end, 0)
    arguments = ["live", "--policy", str(folder), "--headless", "--speed", "max"]
    try:
        assert main([*arguments, "--seconds", "4", "--record", str(tmp_path / "f.journal")]) == 0
    finally:
        os.dup2(stdin_copy, 0)
        os.close(stdin_copy)
        os.close(read_end)
    assert "x and y from -3 to 3 m" in capsys.readouterr().out
    assert np.abs(Flight.load(tmp_path / "f.journal").pos[-1, 0, 0] - [0.4, 0.2, 1.1]).max() < 0.05
    path = tmp_path / "points.csv"
    path.write_text("0.5,0,1\n0.5,0.5,1.4\n")
    assert main([*arguments, "--seconds", "6", "--goals", str(path)]) == 0
    assert "points passed: 2" in capsys.readouterr().out
    wrong = {
        ("--goals", "none.csv"): "expected an existing file, got 'none.csv'",
        ("--drones", "2"): "the settings of the run with --policy, got --drones",
        ("--pilot",): "got --pilot",
    }
    for options, message in wrong.items():
        assert main([*arguments, "--seconds", "1", *options]) == 2
        assert message in capsys.readouterr().err
    assert main(["live", "--headless", "--seconds", "1", "--goals", str(path)]) == 2
    assert "expected --policy with --goals, got none" in capsys.readouterr().err
