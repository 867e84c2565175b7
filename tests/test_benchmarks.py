"""Benchmarks measure drones that fly: the scripts run, small, and refuse to report crashed ones."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def run(script, *arguments):
    command = [sys.executable, BENCHMARKS / script, "--worlds", "4", "--controls", "rotor_vel", *arguments]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return [json.loads(line) for line in out.splitlines() if line.startswith("{")]


def test_step_prints_a_line_with_its_machine():
    (line,) = run("step.py", "--integrators", "euler", "--repeats", "2")
    assert line["steps_per_s"] > 0
    assert {"device", "cores", "jax", "python", "date"} <= line.keys()


def test_compile_prints_its_parts():
    (line,) = run("compile.py", "--integrators", "euler")
    assert line["compile_s"] > 0
    assert line["trace_s"] > 0


def test_a_crashed_drone_is_no_figure(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    import measure

    from crazysim import Sim

    sim = Sim(n_worlds=2, control="rotor_vel")
    measure.hovering(sim, "rotor_vel")
    sim.step(100)
    assert measure.still_flies(sim)
    sim.rotor_vel_control([[[0.0] * 4]] * 2)
    sim.step(500)
    assert not measure.still_flies(sim)


@pytest.mark.parametrize("script", ["step.py", "compile.py", "versus_crazyflow.py"])
def test_every_script_explains_itself(script):
    out = subprocess.run([sys.executable, BENCHMARKS / script, "--help"], capture_output=True, text=True, check=True)
    assert "--worlds" in out.stdout
