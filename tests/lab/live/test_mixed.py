"""Twins and swarms in the live loop, together with sources that never answer, fail or are wrong."""

import numpy as np
import pytest

from crazysim import Sim
from crazysim.lab.live import FunctionSource, Live, MocapSource, RealTimeSource, Swarm, ThreadSource, Twin, Twins
from crazysim.lab.live.mocap import Frame, Poll

LEVEL_QUAT = (0.0, 0.0, 0.0, 1.0)


class SilentSource(ThreadSource):
    """A source that never answers."""

    def stream(self, stop_event):
        stop_event.wait()
        yield from ()


class FailingSource(ThreadSource):
    """A source that fails at once."""

    def stream(self, stop_event):
        raise OSError("unplugged")
        yield


def test_the_loop_drives_twins_and_swarms_and_waits_for_no_source():
    sim = Sim(n_drones=2, control="state")
    swarm = Swarm(sim)
    moving = RealTimeSource(FunctionSource(lambda t: {"cf1": ((1.0 + 0.1 * t, 0, 1), LEVEL_QUAT)}, 200.0)).start()
    silent, failing = SilentSource("silent").start(), FailingSource("failing").start()
    twins = [
        Twins(sim, source, {"": Twin("box")}, [name])
        for source, name in ((moving, "cf1"), (silent, "s"), (failing, "f"))
    ]
    with Live(sim, control_freq=100) as live:
        for part in [*twins, swarm]:
            live.add(part, on_error="report")
        live.call_at(0.2, lambda _: swarm["cf1"].take_off(0.5, 1.0))
        report = live.run(seconds=2.0)  # a wait for the silent source would not end
    assert swarm.state("cf1").pos[2] == pytest.approx(0.5, abs=0.15)
    assert swarm.state("cf2").pos[2] < 0.01
    assert np.asarray(twins[0].handles["cf1"].pose(sim.data)[0])[0, 0, 0] > 1.1
    kinds = {(r.kind, r.name) for part in twins for r in part.reports.latest}
    assert {("stalled", "silent"), ("ended", "failing")} <= kinds
    assert "2.0" in str(report)
    for part in twins:
        part.close()


class HostileSource(MocapSource):
    """A source that makes every mistake once, each at a different time."""

    name, simulated = "hostile", True

    def poll(self, step, freq):
        now = step / freq
        stamp, names, pos = now, ("a", "b"), np.array([[0.1 * now, 3, 1], [0, 4, 1]])
        match round(100 * now):
            case 50:
                stamp = now - 0.01  # repeats
            case 60:
                stamp = now - 0.05  # goes back in time
            case 70:
                pos[0, 0] += 5.0  # jumps
            case 80:
                pos[1, 2] = np.nan
            case 90:
                stamp = np.nan
            case 100:
                names = ("a", "ghost")  # a body without a twin
            case 110:
                names = ("b", "b")
            case k if k >= 120:
                return Poll(now, [])  # stops
        return Poll(now, [Frame(stamp, names, pos, np.tile(LEVEL_QUAT, (2, 1)), now)])


def test_everything_that_a_source_does_wrong_is_reported_by_name_and_time(caplog):
    """Everything else continues: drones hold their setpoints, and twins of valid bodies follow these bodies."""
    sim = Sim(n_drones=1, control="state")
    sim.scene.add("box", "wall", pos=[5, 5, 0])
    twins = Twins(sim, HostileSource(), {"": Twin("box", {"size": (0.1, 0.1, 0.1)})}, ["a", "b"])
    xs = []
    with Live(sim, control_freq=100, speed="max") as live:
        live.command[..., 2] = 1.0
        live.add(twins, on_error="report")
        live.add(lambda _: xs.append(twins.pose("a")[0][0]))
        report = live.run(seconds=2.0)
    assert report.n_steps == 200
    assert report.failures == 0
    reports = [(r.kind, r.name, round(r.time, 2)) for r in twins.reports.latest if r.kind not in ("dropped", "late")]
    assert reports == [
        ("repeated", "hostile", 0.49), ("backwards", "hostile", 0.55), ("jumped", "a", 0.70),
        ("invalid", "b", 0.80), ("invalid", "hostile", 0.90), ("unknown", "ghost", 1.00),
        ("duplicate", "b", 1.10), ("stalled", "hostile", 1.40),
    ]  # fmt: skip
    for kind, name, time in reports:
        assert f"{name} {kind} at {time:.3f} s" in caplog.text
    np.testing.assert_allclose(xs[119], 0.119, atol=1e-6)
    assert np.abs(np.diff(xs)).max() < 0.01, "no jump and no NaN reaches the scene"
    np.testing.assert_allclose(xs[-1], 0.119, atol=1e-6)  # the twin stays where the body was seen last
    np.testing.assert_allclose(sim.data.states.pos[0, 0, 2], 1.0, atol=0.2)  # the drone has risen to its setpoint
