"""What ``crazysim train TASK --check`` says about a task."""

import pytest

from crazysim.__main__ import main
from crazysim.train import check

GOOD = {
    check.HOVER: {"success": 0.0, "crashed": 0.0, "reward": 1.0, "reward near": 1.0, "reward failed": 0.0},
    check.RANDOM: {"success": 0.0, "crashed": 1.0, "reward": -9.0, "reward near": 1.0, "reward failed": -10.0},
    check.DEMONSTRATION: {"success": 1.0, "crashed": 0.0, "reward": 9.0, "reward near": 9.0, "reward failed": 0.0},
}
LENGTHS = {check.HOVER: 5.0, check.RANDOM: 1.0, check.DEMONSTRATION: 5.0}
CASES = {
    "nothing": ({}, ""),
    "NaN": ({check.RANDOM: {"nonfinite": 0.5}}, "became non-finite"),
    "the start is a success": ({check.HOVER: {"success": 0.9}}, "Hovering succeeds from 90%"),
    "no success": ({check.DEMONSTRATION: {"success": 0.0}}, "Success was never seen"),
    "too short": ({check.DEMONSTRATION: {"success": 0.5}}, "seconds may be too short"),
    "living costs": ({check.HOVER: {"reward": -20.0}}, "Living costs more than failing"),
    "no slope": ({check.DEMONSTRATION: {"reward": 0.5}}, "does not grow towards the goal"),
    "constant": (
        {name: {"reward alive": 0.1 * length} for name, length in LENGTHS.items()}, "'alive' is 0.1 a second",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_flights_tell_what_is_wrong(case):
    changes, finding = CASES[case]
    metrics = {
        name: {"length": LENGTHS[name], "nonfinite": 0.0} | flown | changes.get(name, {})
        for name, flown in GOOD.items()
    }
    findings = check.check_flights(metrics)
    assert len(findings) == bool(finding)
    assert finding in "".join(findings)


def test_the_command_checks_a_task_and_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(check, "N_WORLDS", 8)
    small = "n_steps=8 epochs=1 minibatches=1 hidden=[8]"
    assert main(["train", "hover", "--check", "--worlds", "4", "--set", "seconds=0.4", "--config", *small.split()]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:3]] == [check.HOVER, check.RANDOM, "10 iterations"]
    assert lines[3].startswith("- Success was never seen")
    assert not list(tmp_path.iterdir())
