"""Twins, swarms and messages in the live loop, beside a source that never answers."""

import time

import numpy as np
import pytest

from crazysim import Sim
from crazysim.live import FunctionSource, Live, RealTimeSource, Swarm, ThreadSource, Twin, Twins

LEVEL = (0.0, 0.0, 0.0, 1.0)


class Silent(ThreadSource):
    """A source that never answers."""

    def stream(self, stopped):
        stopped.wait()
        yield from ()


class Failing(ThreadSource):
    """A source that fails at once."""

    def stream(self, stopped):
        raise OSError("unplugged")
        yield


def test_the_loop_drives_twins_and_swarms_and_waits_for_no_source():
    sim = Sim(n_drones=2, control="state")
    swarm = Swarm(sim)
    moving = RealTimeSource(FunctionSource(lambda t: {"cf1": ((1.0 + 0.1 * t, 0, 1), LEVEL)}, 200.0)).start()
    silent, failing = Silent("silent").start(), Failing("failing").start()
    twins = [
        Twins(sim, source, {"": Twin("box")}, [name])
        for source, name in ((moving, "cf1"), (silent, "s"), (failing, "f"))
    ]
    with Live(sim, control_freq=100) as live:
        for part in [*twins, swarm]:
            live.add(part, on_error="report")
        live.at(0.2, lambda _: swarm["cf1"].take_off(0.5, 1.0))
        began = time.perf_counter()
        report = live.run(seconds=2.0)
        assert time.perf_counter() - began < 15
    assert swarm.state("cf1").pos[2] == pytest.approx(0.5, abs=0.15)
    assert swarm.state("cf2").pos[2] < 0.01
    assert np.asarray(twins[0].handles["cf1"].pose(sim.data)[0])[0, 0, 0] > 1.1
    kinds = {(r.kind, r.name) for part in twins for r in part.reports.latest}
    assert {("stalled", "silent"), ("ended", "failing")} <= kinds
    assert "2.0" in str(report)
    for part in twins:
        part.close()
