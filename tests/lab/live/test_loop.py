"""The live loop: its calls, pauses, jumps in time and recordings, and errors that it survives."""

import logging
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest
from waiting import Clock

from crazysim.errors import ConfigError
from crazysim.lab.live import Fleet, Live, RemoteCommands, TakeOff, Viewer
from crazysim.lab.live.server import CommandQueue
from crazysim.media import Flight
from crazysim.sim import Sim


@pytest.fixture(scope="module")
def sim():
    return Sim(n_drones=2, control="state", freq=500)


@pytest.fixture
def live(sim):
    sim.reset()
    with Live(sim, control_freq=100, speed="max") as live:
        yield live


def test_processes_and_events_are_called_at_their_rates_and_in_order(live):
    calls = []
    live.add(lambda live: calls.append(("control", live.step)))
    live.add(lambda live: calls.append(("slow", live.step)), freq=25, name="slow")
    live.call_at(0.05, lambda live: calls.append(("event", live.step)))
    report = live.run(0.1)
    assert [step for name, step in calls if name == "control"] == list(range(10))
    assert [step for name, step in calls if name == "slow"] == [0, 4, 8]
    assert calls.index(("event", 5)) == calls.index(("control", 5)) + 1
    assert float(live.sim.time[0, 0]) == pytest.approx(0.1)
    assert report.simulated_s == pytest.approx(0.1)
    assert report.n_steps == 10
    assert "times real time" in str(report)
    assert "slow" in str(report)


def test_commands_stay_in_force(live):
    live.command[0, :, 2] = 1.0
    live.run(3.0)
    # The cascade of Crazyflow has an integral that overshoots, here by 11 cm.
    np.testing.assert_allclose(live.sim.data.states.pos[0, :, 2], 1.0, atol=0.15)
    np.testing.assert_allclose(live.sim.data.states.pos[0, :, :2], [[-0.5, -0.5], [0.5, -0.5]], atol=0.05)
    live.reset()
    live.run(0.5)  # hovering where they are, on the floor
    assert live.time == pytest.approx(0.5)
    assert np.asarray(live.sim.data.states.pos[0, :, 2]).max() < 0.15


def test_real_time_and_slow_motion(live):
    """An idle loop is never ahead of real time, at any speed."""
    for speed, seconds in ((1.0, 0.5), (4.0, 2.0), (0.25, 0.2)):
        live.speed = speed
        start_time = time.perf_counter()
        report = live.run(seconds)
        wall_s = time.perf_counter() - start_time
        assert wall_s > 0.9 * seconds / speed  # the last of 20 steps or more is not waited for
        assert report.factor == pytest.approx(seconds / report.wall_s, rel=0.01)
        assert report.wall_s <= wall_s


def test_speed_can_change_and_the_run_can_stop_from_within(live):
    live.call_at(0.1, lambda live: setattr(live, "speed", 1.0))
    live.call_at(0.2, lambda live: live.stop())
    assert live.run(10.0).simulated_s == pytest.approx(0.21)
    assert live.speed == 1.0


def test_a_pause_stops_time_and_a_single_step_moves_it(live):
    live.paused = True
    steps = []

    def act():
        time.sleep(0.1)
        live.post(lambda live: steps.append(live.step))
        live.post(lambda live: live.advance(3))
        live.post(lambda live: steps.append(live.step))
        live.post(lambda live: setattr(live, "paused", False))

    thread = threading.Thread(target=act)
    thread.start()
    report = live.run(0.2)
    thread.join()
    assert steps == [0, 3]
    assert report.simulated_s == pytest.approx(0.2)


def test_keys_pause_step_and_stop_the_loop(live):
    for key in ("space", ".", ".", "+"):
        live.keyboard.press(key)
    live.call_at(0.02, lambda live: live.keyboard.press("escape"))
    live.keyboard.press("space")
    live.run(10.0)
    assert live.step == 3  # the two single steps, then one: escape counts before the next
    assert live.speed == 2.0
    live.keyboard.press("tab")
    live.keyboard.press("backspace")
    live.keyboard.press("escape")
    live.run(1.0)
    assert live.selected == (0, 1)
    assert live.step == 0


def test_sliders_and_buttons_by_key(live):
    moved, pressed = [], []
    live.slider("wind", 0.0, 10.0, 5.0, lambda live, value: moved.append(value))
    live.slider("mass", -1.0, 1.0, 0.98, lambda live, value: moved.append(-value))
    live.button("shoot", pressed.append, key="f")
    assert live.widget_lines == ("wind: 5  [ ]", "mass: 0.98", "shoot  f")
    for key in "]]['" + "]]f":
        live.keyboard.press(key)
    live.run(0.01)
    np.testing.assert_allclose(moved, [5.5, 6.0, 5.5, -1.0, -1.0])
    assert pressed == [live]
    assert live.slider_values == {"wind": 5.5, "mass": 1.0}
    with pytest.raises(ConfigError, match="a slider of \\['wind', 'mass'\\]"):
        live.set_value("speed", 1.0)
    with pytest.raises(ConfigError, match="'wind' twice"):
        live.slider("wind", 0.0, 1.0, 0.0, lambda live, value: None)


def test_going_back_repeats_what_was_flown_bit_for_bit(live):
    resets = []

    class Wave:
        def __call__(self, live):
            live.command[0, :, 2] = 1.0 + 0.5 * np.sin(live.time)

        def reset(self, live):
            resets.append(live.step)

    fired = []
    live.add(Wave())
    live.call_at(1.5, lambda live: fired.append(live.step))
    live.run(3.0)
    end = np.asarray(live.sim.data.states.pos)
    live.go_to(1.2)
    assert live.time == pytest.approx(1.2)
    assert resets == [100]
    assert np.abs(np.asarray(live.sim.data.states.pos) - end).max() > 1e-3
    live.go_to(3.0)
    np.testing.assert_array_equal(live.sim.data.states.pos, end)
    assert fired == [150, 150]
    live.go_to(0.0)
    np.testing.assert_array_equal(live.sim.data.states.pos, live.sim.default_data.states.pos)
    assert float(live.sim.time[0, 0]) == 0


def test_a_reset_within_a_step_happens_after_it(live):
    live.call_at(0.03, lambda live: live.reset() if live.n_steps_run < 5 else None)
    live.run(0.1)
    assert live.n_steps_run == 10
    assert live.step == 6  # four steps, then six more


def test_errors_of_scripts_end_the_run_and_those_of_sources_do_not(live, caplog):
    def source(live):
        raise OSError("gone")

    process = live.add(source, name="radio", on_error="report")
    with caplog.at_level(logging.WARNING):
        report = live.run(0.2)
    assert process.failures == report.failures == 20
    assert caplog.text.count("radio failed at") == 1, "one message a second"
    assert "gone" in caplog.text
    live.call_at(0.3, lambda live: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        live.run(1.0)
    assert live.time == pytest.approx(0.3)


def test_wrong_requests_are_reported_and_the_run_continues(live, caplog):
    live.post(lambda live: live.go_to(-1.0))
    live.post(lambda live: live.select(0, 7))
    report = live.run(0.1)
    assert report.simulated_s == pytest.approx(0.1)
    assert "time of 0 s or more, got -1.0" in caplog.text


class CountingViewer(Viewer):
    """A viewer that counts its pictures, closes after ``max_pictures``, and takes ``work`` seconds or fails."""

    def __init__(self, max_pictures=10**9, work=0.0, broken=False):
        self.n, self._max_pictures, self._work, self._broken, self.closed = 0, max_pictures, work, broken, False

    def open(self, live):
        self.n = 0

    def update(self, live):
        self.n += 1
        if self._broken and self.n > 2:
            raise RuntimeError("no light")
        time.sleep(self._work)

    @property
    def is_open(self):
        return self.n < self._max_pictures

    def close(self):
        self.closed = True


def test_pictures_come_at_their_own_rate(live):
    live.speed = 0.5  # control steps every 20 ms
    viewer = live.show(CountingViewer())
    report = live.run(0.5)
    assert 2 < viewer.n < 50 * report.wall_s + 4  # 50 a second and one before, fewer on a busy machine
    assert report.n_pictures == pytest.approx(viewer.n, abs=1)


def test_the_run_ends_when_the_last_viewer_is_closed(live):
    live.speed = 1.0
    first, second = live.show(CountingViewer(max_pictures=3)), live.show(CountingViewer(max_pictures=8))
    live.run()
    assert first.closed
    assert second.closed
    assert live.n_steps_run > 0


def test_a_broken_viewer_is_closed_and_named(live, caplog):
    live.speed = 1.0
    broken, other = live.show(CountingViewer(broken=True)), live.show(CountingViewer(max_pictures=8))
    live.run()  # until the other one closes
    assert (broken.n, other.n) == (3, 8)
    assert broken.closed
    assert "CountingViewer failed" in caplog.text
    assert "no light" in caplog.text


class EqualViewer(CountingViewer):
    """A viewer that equals every other viewer, as two windows with the same settings do."""

    def __eq__(self, other):
        return True

    __hash__ = None


def test_only_the_closed_one_of_two_equal_viewers_is_removed(live):
    live.speed = 1.0
    open_viewer, closed_viewer = live.show(EqualViewer(max_pictures=6)), live.show(EqualViewer(max_pictures=2))
    live.run()
    assert (open_viewer.n, closed_viewer.n) == (6, 2)
    assert closed_viewer.closed


def test_missed_real_time_is_reported(live, caplog, monkeypatch):
    clock = Clock()
    monkeypatch.setattr("crazysim.lab.live.loop.perf_counter", clock)
    monkeypatch.setattr("crazysim.lab.live.loop.sleep", clock.sleep)
    live.speed = 1.0
    for event_time, delay in ((0.1, 0.9), (0.2, 0.4)):
        live.call_at(event_time, lambda live, delay=delay: clock.sleep(delay))
    report = live.run(0.3)
    assert report.max_lateness == pytest.approx(0.89)
    assert report.max_lateness_time == pytest.approx(0.11)
    assert report.lost_s == pytest.approx(0.89 + 0.39)
    assert report.n_late_steps == 2
    assert clock.now - 10.0 == pytest.approx(0.29 + report.lost_s)
    assert caplog.text.count("real time missed") == 1
    assert "real time missed at 0.11 s" in caplog.text
    assert "given up" in str(report)


def test_a_recording_has_every_sample_and_is_switched_on_and_off(live, tmp_path):
    live.command[0, :, 2] = 1.0
    path = live.record(tmp_path / "a.journal")
    live.run(0.5)
    live.reset()  # the time of the recording continues
    live.run(0.5)
    live.toggle_recording()
    assert not live.is_recording
    live.run(0.1)
    live.toggle_recording()
    assert live.is_recording
    live.run(0.1)
    live.stop_recording()
    first, second = Flight.load(path), Flight.load(tmp_path / "a-2.journal")
    np.testing.assert_allclose(first.time, np.arange(51) / 50, atol=1e-9)
    assert first.setpoint.shape == (51, 1, 2, 3)
    np.testing.assert_array_equal(first.pos[26, 0], first.pos[1, 0], "the same start")
    np.testing.assert_allclose(second.time[[0, -1]], [0, 0.1], atol=1e-9)


def test_a_recording_that_cannot_be_written_ends_and_the_run_continues(live, tmp_path, monkeypatch, caplog):
    live.record(tmp_path / "a.journal")

    def raise_disk_full(_file, _content):
        raise OSError(28, "No space left on device")

    live.call_at(0.05, lambda live: monkeypatch.setattr("crazysim.media.journal.os.write", raise_disk_full))
    report = live.run(0.2)
    monkeypatch.undo()
    assert report.simulated_s == pytest.approx(0.2)
    assert not live.is_recording
    assert "No space left" in caplog.text
    np.testing.assert_allclose(Flight.load(tmp_path / "a.journal").time, [0, 0.02, 0.04], atol=1e-9)


KILLED_PROGRAM = textwrap.dedent("""
    import os, signal, sys
    from crazysim import Sim
    from crazysim.lab.live import Live
    live = Live(Sim(n_drones=2, control="state"), speed="max")
    live.command[..., 2] = 1.0
    live.record(sys.argv[1])
    live.call_at(1.0, lambda live: os.kill(os.getpid(), signal.SIGKILL))
    live.run(5.0)
""")


def test_a_killed_process_loses_no_sample(tmp_path):
    path = tmp_path / "killed.journal"
    completed = subprocess.run([sys.executable, "-c", KILLED_PROGRAM, path], check=False)
    assert completed.returncode == -signal.SIGKILL
    flight = Flight.load(path)
    np.testing.assert_allclose(flight.time, np.arange(51) / 50, atol=1e-9)
    assert np.isfinite(flight.pos).all()
    assert flight.pos[-1, 0, :, 2].min() > 0.3


def test_commands_from_the_network_and_resets():
    sim = Sim(n_drones=2, control="state")
    fleet, queue = Fleet(sim, teleport=False), CommandQueue()
    with Live(sim, speed="max") as live:
        live.add(RemoteCommands(fleet, queue))
        live.call_at(0.1, lambda live: queue._enqueue(TakeOff(None, 0.5)) if live.n_steps_run < 50 else None)
        live.run(3.0)
        np.testing.assert_allclose(sim.data.states.pos[0, :, 2], 0.5, atol=0.15)
        live.lights[:] = 1.0
        live.reset()
        live.run(1.0)
        assert np.asarray(sim.data.states.pos[0, :, 2]).max() < 0.15
        np.testing.assert_allclose(fleet.setpoint(0)[:3], [-0.5, -0.5, 0], atol=1e-6)
        np.testing.assert_array_equal(live.lights, 0.0)  # a fleet without a show has no light


def test_the_loop_runs_at_the_attitude_level(live):
    with Live(Sim(control="attitude"), speed="max") as other:
        other.command[..., 3] = 0.6
        other.run(0.5)
        assert float(other.sim.data.states.pos[0, 0, 2]) > 0.1


def test_memory_does_not_grow(live):
    """The number of snapshots is bounded; the first is kept, and a second jump adds none."""
    live.run(70.0)
    assert len(live._history._latest) == 60
    live.go_to(65.0)
    live.go_to(65.0)
    live.advance()
    assert [snapshot.step for snapshot in live._history._latest][-2:] == [6400, 6500]
    with pytest.raises(ConfigError, match="time that was flown"):
        Live(live.sim).go_to(1.0)
    live.go_to(5.0)
    assert live.time == pytest.approx(5.0)
    assert live._pace._counts.shape == (5000,)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda live: Live(live.sim, control_freq=30), "control_freq that divides freq=500 Hz, got 30 Hz"),
        (lambda live: Live(live.sim, fps=0), "positive fps"),
        (lambda live: Live(live.sim, snapshot_s=float("nan")), "positive snapshot_s"),
        (lambda live: live.add(print, freq=33), "rate of 'print' that divides 100 Hz, got 33 Hz"),
        (lambda live: live.add(3), "function of the loop, got 3"),
        (lambda live: live.add(print, on_error="ignore"), "'raise' or 'report', got 'ignore'"),
        (lambda live: live.call_at(-1, print), "time of 0 s or later, got -1"),
        (lambda live: live.call_at(float("nan"), print), "time of 0 s or later"),
        (lambda live: live.run(0), "positive duration"),
        (lambda live: live.go_to(float("inf")), "time of 0 s or more"),
        (lambda live: live.advance(0), "n_steps"),
        (lambda live: live.select(0, 2), "drone below 2"),
        (lambda live: live.slider("wind", 0, 1, 2, print), "expected low < high, and a value between them"),
        (lambda live: live.button("b", print, key="F13"), "lower-case character"),
        (lambda live: live.record("nowhere/a.journal"), "file that can be created"),
        (lambda live: live.record("a.journal", freq=30), "divides 100 Hz"),
    ],
)
def test_wrong_input_is_refused(live, call, message):
    with pytest.raises(ConfigError, match=message):
        call(live)
