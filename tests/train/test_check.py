"""What ``crazysim train TASK --check`` says about a task."""

import pytest

from crazysim.__main__ import main
from crazysim.envs import TASKS
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
    "the start is a success": ({check.HOVER: {"success": 0.9}}, "Zero actions succeed from 90%"),
    "too short": ({check.DEMONSTRATION: {"success": 0.0, "error": 0.3}}, "below 0.05 for the last 1 s of 5 s"),
    "ends at the goal": ({check.DEMONSTRATION: {"success": 0.0, "crashed": 1.0}}, "define succeeded(data)"),
    "living costs": ({check.HOVER: {"reward": -20.0, "reward near": -20.0}}, "mostly by the term 'near' (1 and -20)"),
    "no slope": ({check.DEMONSTRATION: {"reward": 0.5, "reward near": 0.5}}, "loses 0.5 by the term 'near'"),
    "sign": ({check.DEMONSTRATION: {"reward turn": -14.0}, check.HOVER: {"reward turn": 0.0},
        check.RANDOM: {"reward turn": 0.0}}, "loses 14 by the term 'turn'"),
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
    findings = check.check_flights(metrics, TASKS["hover"].task())
    assert len(findings) == bool(finding)
    assert finding in "".join(findings)


def test_the_command_checks_a_task_and_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(check, "N_WORLDS", 8)
    small = "--worlds 4 --set seconds=0.4 engine=interpret --config n_steps=8 epochs=1 minibatches=1 hidden=[8]"
    main(["train", "hover", *small.split(), "--iterations", "1", "--no-film", "--out", "run"])
    capsys.readouterr()
    assert main(["train", "hover", "--check", "--start", "run", *small.split()]) == 0, "something was found"
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:2]] == [check.HOVER, check.RANDOM]
    assert lines[2].startswith("define demonstrate(obs)")
    assert lines[3].startswith(f"after 10 iterations from the policy of {tmp_path / 'run'}, the return")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


BROKEN = """
from crazysim.envs.tasks.hover import Hover

class Broken(Hover):
    name = "broken"

    def demonstrate(obs):
        return obs["speed"]
"""


def test_a_demonstration_that_fails_is_named(tmp_path, capsys):
    (tmp_path / "broken.py").write_text(BROKEN)
    assert main(["train", f"{tmp_path / 'broken.py'}:Broken", "--check"]) == 2
    assert "Broken.demonstrate(obs) as a function" in capsys.readouterr().err


@pytest.mark.parametrize("others", ["--resume", "--seeds 0,1", "--sweep discount=0.9,0.99", "--tune"])
def test_the_check_refuses_what_it_would_ignore(others, capsys):
    assert main(["train", "hover", "--check", *others.split()]) == 2
    assert f"expected --check alone, got it with {others.split()[0]}" in capsys.readouterr().err
