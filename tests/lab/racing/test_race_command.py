"""``crazysim race``: what it prints and writes."""

import re
from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

from crazysim.__main__ import main
from crazysim.envs import Track, load_track, make
from crazysim.envs.statistics import RunningStats
from crazysim.lab.live import Live, PolicyPilot
from crazysim.lab.racing.flight import clock_text_at, flight_of_plan, flight_of_policy, plot, summary, track_simulation
from crazysim.lab.racing.live_clock import LiveClock
from crazysim.lab.racing.time_optimal import plan_race
from crazysim.train import checkpoint
from crazysim.train.config import TrainConfig
from crazysim.train.export import describe
from crazysim.train.networks import Policy
from crazysim.train.training import POLICY_FILE

FILE = """
initState: { pos: [0, 0, 1] }
endState: { pos: [6, 0, 1] }
orders: [A, B]
A: { type: RectanglePrisma, position: [2, 0.5, 1], rpy: [0, -90, 0], width: 1, height: 1, marginW: 0.2, marginH: 0.2 }
B: { type: SingleBall, position: [4, -0.5, 1], radius: 0.3, margin: 0.0 }
"""
SQUARE = [(0.2, 0.2), (0.2, -0.2), (-0.2, -0.2), (-0.2, 0.2)]
TWO_POINTS = Track(
    gates_pos=[(-0.2, 0, 1), (0.5, 0, 1)], gates_rpy=[(0, 0, 0)] * 2, openings=[0.3, 0.3], obstacles_pos=(),
    start=(-1, 0, 1), low=(-3, -3, 0), high=(3, 3, 3),
)  # fmt: skip


def fly_ahead(track, seconds=8.0, **settings):
    env = make("race", track=track, control="state", engine="interpret", seconds=seconds, **settings)
    return flight_of_policy(env, lambda obs: jnp.zeros((1, 1, env.actions.size)).at[..., 0].set(1.0))


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("tracks") / "two.yaml"
    path.write_text(FILE, encoding="utf-8")
    return path


@pytest.mark.long("plans, and records a page of the flight")
def test_the_command_prints_laps_and_splits_and_draws(path, tmp_path, capsys):
    files = [tmp_path / "race.png", tmp_path / "race.html"]
    assert main(["race", str(path), "--floor", "0.5", "--plot", str(files[0]), "--page", str(files[1])]) == 0
    text = capsys.readouterr().out
    duration = float(re.search(r"uzh_cpc: ([\d.]+) s", text)[1])
    lap, first, second = map(float, re.search(r"lap 1: ([\d.]+) s; from gate to gate ([\d.]+) ([\d.]+)", text).groups())
    assert lap == pytest.approx(first + second, abs=0.02)  # two decimals
    assert lap < duration
    assert f"the flight ends after {duration:.3f} s" in text
    assert all(file.stat().st_size > 10_000 for file in files)


def test_plots_show_the_sides_of_a_tunnel(monkeypatch, tmp_path):
    track = replace(TWO_POINTS, gates_rpy=[(0, 0, 0), (0, 0, 0.5)], openings=[SQUARE] * 2, lengths=[0.0, 1.0])
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    plot(replace(fly_ahead(TWO_POINTS, seconds=1.0), track=track), tmp_path / "race.png")
    monkeypatch.undo()
    lines = [line.get_xydata() for line in figures[0].axes[0].lines]
    plt.close(figures[0])
    ahead, left = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    for side in (-0.2, 0.2):
        expected = [0.5, 0] + side * left + np.outer([-0.5, 0.5], ahead)
        assert any(np.shape(line) == (2, 2) and np.allclose(line, expected) for line in lines)


@pytest.fixture(scope="module")
def hovering(tmp_path_factory):
    """Return the folder of a run whose policy hovers, on a track of two gates."""
    folder = tmp_path_factory.mktemp("run")
    options = {"track": "split_s_gates", "seconds": 0.1, "engine": "interpret", "drone": "uzh_5inch"}
    env = make("race", **options)
    shapes = jax.eval_shape(env.reset, jax.random.key(0)).obs
    n = sum(x.shape[-1] for x in shapes.values())
    policy = Policy(RunningStats.create(n), [(jnp.zeros((n, 4)), jnp.zeros(4))])
    config = TrainConfig.create("race", config={"hidden": []}, options=options)
    checkpoint.save(folder / POLICY_FILE, policy, describe(env) | {"settings": asdict(config)})
    return folder


@pytest.mark.parametrize("options", [[], ["--penalty", "2"], ["--battery", "0.9", "--laps", "2"]])
def test_a_policy_that_misses_a_gate_ends_with_status_one(hovering, options, capsys):
    assert main(["race", "split_s_gates", "--policy", str(hovering), *options]) == 1
    n = 38 if "--laps" in options else 19
    text = capsys.readouterr().out
    assert f"gate 1 of {n} was not passed: the time of the episode was over" in text
    if "--battery" in options:  # four cells at rest, and sag by some ampere at hover
        start, least, left = map(
            float, re.search(r"battery: ([\d.]+) V at the start, at least ([\d.]+) V, ([\d.]+)%", text).groups()
        )
        assert 15 < least < start < 16.4
        assert 89.9 < left <= 90
    else:
        assert "battery" not in text


def test_law_09_options_of_policies_are_refused_for_plans(path, capsys):
    assert main(["race", str(path), "--penalty", "1", "--battery", "1"]) == 2
    assert "expected --penalty and --battery with --policy" in capsys.readouterr().err


def test_a_policy_flies_with_other_settings_than_in_its_training(hovering, capsys):
    arguments = ["race", "split_s_gates", "--policy", str(hovering), "--set", "seconds=0.2", "--set", "freq=100"]
    assert main(arguments) == 1
    assert "after 0.200 s" in capsys.readouterr().out
    assert main([*arguments, "--dt", "0.02"]) == 2
    assert "got dt. Leave them out." in capsys.readouterr().err


def test_the_tracks_are_listed(capsys):
    assert main(["race", "list"]) == 0
    assert "split_s_gates" in capsys.readouterr().out


def test_the_clock_of_a_film_shows_lap_gate_and_split(path):
    track = load_track(path)
    flight = flight_of_plan(plan_race(track, laps=2), track, laps=2)
    times = np.asarray(flight.clock.times)
    assert bool(flight.clock.finished)
    assert clock_text_at(flight, 0.0) == "  0.00 s\nlap 1 of 2, gate 0 of 4"
    text = clock_text_at(flight, float(times[2]) + 1e-3)
    assert f"lap 2 of 2, gate 3 of 4\nlast gate {times[2]:.2f} s, split {times[2] - times[1]:.2f} s" in text
    assert clock_text_at(flight, 1e3).startswith(f"{times[3]:6.2f} s"), "the clock stops"
    model = track_simulation(track, "uzh_cpc").mj_model
    assert sum(name.startswith("gate") for name in (model.body(k).name for k in range(model.nbody))) >= 2


def test_a_policy_is_timed_in_the_task_race():
    """A constant setpoint 1 m ahead of the origin pulls the drone past two waypoints, which lie on its way."""
    track = TWO_POINTS
    flight = fly_ahead(track)
    times = np.asarray(flight.clock.times)
    assert bool(flight.clock.finished)
    assert 0 < times[0] < times[1] <= flight.time[-1]
    before = np.searchsorted(flight.time, times)
    distance = np.linalg.norm(flight.pos[before] - np.array(track.gates_pos), axis=-1)
    np.testing.assert_allclose(distance, 0.3, atol=0.06)  # a step of 20 ms at up to 3 m/s
    assert "lap 1: " in summary(flight)


def test_penalties_are_added_to_the_time_and_shown():
    """The upper bar of a gate is hit, and a gate beside the way is missed."""
    track = replace(
        TWO_POINTS, openings=[SQUARE, SQUARE, 0.3], gates_pos=[(-0.2, 0, 0.83), (0.1, 1, 1), (0.5, 0, 1)],
        gates_rpy=[(0, 0, 0)] * 3,
    )  # fmt: skip
    flight = fly_ahead(track, penalty=2.0)
    times = np.asarray(flight.clock.times)
    assert bool(flight.clock.finished)
    assert float(flight.clock.time) == pytest.approx(times[-1] + 4.0)
    text = summary(flight)
    assert " missed " in text
    assert "penalties: 4 s" in text
    assert f"all gates after {times[-1] + 4:.3f} s" in text
    assert clock_text_at(flight, times[0] + 0.1).startswith(f"{times[0] + 0.1:6.2f} s + 2 s\n")
    assert clock_text_at(flight, 1e3).startswith(f"{times[-1]:6.2f} s + 4 s\n")


def test_the_clock_runs_in_the_live_loop():
    """The text of viewers, and after a jump backwards only the gates that had been passed."""
    env = make("race", track=TWO_POINTS, control="state", engine="interpret", penalty=1.0)
    pilot = PolicyPilot(env, lambda obs: jnp.zeros((1, 1, env.actions.size)).at[..., 0].set(1.0))
    with Live(env.sim, env.base.freq, speed="max", snapshot_s=0.1) as live:
        pilot.add_to(live)
        clock = LiveClock(env.task)
        clock.add_to(live)
        assert "lap 1 of 1, gate 0 of 2" in live.status
        live.run(2.0)
        times = np.asarray(clock.clock.times)
        expected = np.asarray(fly_ahead(TWO_POINTS, penalty=1.0).clock.times)
        np.testing.assert_allclose(times, expected, atol=0.02)  # an environment draws another start
        assert f"{times[1]:.2f} s, lap 1 of 1, gate 2 of 2, last gate {times[1]:.2f} s, split" in live.status
        live.go_to(float(times.mean()))
        assert "gate 1 of 2" in live.status
        live.advance(50)
        np.testing.assert_allclose(clock.clock.times, times, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"seconds": 0.2}, "gate 1 of 2 was not passed: the time of the episode was over"),
        ({"high": (0.0, 3, 3)}, "gate 2 of 2 was not passed: the drone left the arena"),
        ({"openings": [SQUARE, 0.3], "gates_pos": [(-0.2, 0, 0.75), (0.5, 0, 1)]}, "the drone touched a gate"),
    ],
)
def test_a_missed_gate_has_its_reason(changes, reason):
    seconds, track = (changes["seconds"], TWO_POINTS) if "seconds" in changes else (8.0, replace(TWO_POINTS, **changes))
    assert reason in summary(fly_ahead(track, seconds))
