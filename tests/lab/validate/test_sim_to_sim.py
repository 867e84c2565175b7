"""Policies in other simulators: C MuJoCo flies as crazysim does, and simulators that are missing are left out."""

import importlib.util

import numpy as np
import pytest

from crazysim.__main__ import main
from crazysim.lab.validate import sim_to_sim
from crazysim.lab.validate.sections import sections
from crazysim.lab.validate.simulators import COMMAND_PERIOD, SIMULATORS, Crazysim, Mujoco, Simulator

WEIGHT = 0.0434 * 9.81
"""Weight of cf21B_500, N."""


def pilot(obs):
    """Return the commands that fly to the goal of the task ``hover``, from its observations by name. (n, 4)"""
    difference, vel = obs[:, 3:6], obs[:, 18:21]
    acc = 3.0 * difference - 2.5 * vel
    return np.stack([-acc[:, 1] / 9.81, acc[:, 0] / 9.81, 0 * acc[:, 0], WEIGHT * (1 + acc[:, 2] / 9.81)], axis=-1)


@pytest.fixture(scope="module")
def results():
    return [sim_to_sim.fly_task("hover", pilot, simulator, 3) for simulator in (Crazysim, Mujoco)]


@pytest.mark.long("compiles the step, the controller in the loop, and the task")
def test_a_pilot_flies_in_mujoco_as_in_crazysim(results):
    """Flights from equal starts to equal goals are nearly the same; in MuJoCo drag is missing and the lag differs."""
    ours, theirs = (result.observations for result in results)
    np.testing.assert_array_equal(ours[0], theirs[0])
    distance = np.linalg.norm(ours[0, :, 3:6], axis=-1)
    assert distance.min() > 0.3
    for result in results:
        assert result.success == 1
        assert result.crashed == 0
        assert result.error < 0.02
    apart = np.linalg.norm(ours[..., 6:9] - theirs[..., 6:9], axis=-1).max(axis=0)
    assert np.all(apart < 0.15 * distance)


class Falling(Simulator):
    def __init__(self, start):
        self.states = start

    def fly_period(self, commands):
        vel = self.states["vel"] - [0, 0, 9.81 * COMMAND_PERIOD]
        self.states = self.states | {"vel": vel, "pos": self.states["pos"] + COMMAND_PERIOD * vel}
        return self.states


def test_drones_that_fall_have_crashed():
    result = sim_to_sim.fly_task("hover", lambda obs: np.zeros((len(obs), 4)), Falling, 3)
    assert (result.success, result.crashed) == (0, 1)
    assert np.isnan(result.error)
    assert len(result.observations) < 50  # 1.9 m of free fall, from at most 0.5 m/s upwards, take less than 0.7 s


def test_simulators_that_are_not_installed_are_left_out(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sim_to_sim, "export_policy", lambda *_: pytest.fail("a training"))
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in sim_to_sim.PEERS else find_spec(name))
    installed = [name for name in SIMULATORS if not SIMULATORS[name].module]
    assert installed == ["crazysim", "C MuJoCo"]
    for simulator in SIMULATORS.keys() - installed:
        assert list(sim_to_sim.compare_policy("hover", simulator)) == []
    monkeypatch.setattr(sim_to_sim, "POLICIES", {})
    pytest.importorskip("onnxruntime")
    assert main(["validate", "--only", "sim2sim", "--out", str(tmp_path / "page.md")]) == 0
    advice = "run `pip install crazyflow==0.4.0 'rotorpy[batched]==3.0.0' gym-pybullet-drones@git+https://"
    assert f"left out rows of sim2sim: {advice}" in capsys.readouterr().out
    assert f"Left out: {advice}" in (tmp_path / "page.md").read_text()


def test_a_row_has_success_error_and_the_difference_of_both_exports(monkeypatch):
    shift = np.float32(2e-6)
    policy = sim_to_sim.ExportedPolicy(lambda obs: obs[:, :4], lambda obs: obs[:, :4] + shift, np.zeros(4), np.ones(4))
    monkeypatch.setattr(sim_to_sim, "export_policy", lambda *_: policy)
    result = sim_to_sim.FlightResult(0.5, 0.25, 0.0123, np.linspace(-1, 1, 60).reshape(5, 3, 4))
    monkeypatch.setattr(sim_to_sim, "fly_task", lambda *_: result)
    flown, same = sim_to_sim.compare_policy("hover_crazyflie", "crazysim")
    assert (flown.quantity, flown.figure) == ("`hover`, trained with `randomize=crazyflie`: success", 50)
    assert flown.remark == "mean error 0.012 m, crashed 25 %"
    assert same.figure == pytest.approx(2e-6, rel=0.2)
    assert not same.failed
    assert len(next(x for x in sections() if x.name == "sim2sim").checks) == 6 * len(SIMULATORS)
