"""The scripts of ``benchmarks/`` run with small settings, and refuse to report crashed drones."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def lines_of(text):
    return [json.loads(line) for line in text.splitlines() if line.startswith("{")]


@pytest.fixture
def benchmarks(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)


@pytest.fixture
def run(benchmarks, monkeypatch, capsys):
    import measure

    monkeypatch.setattr(measure, "run_in_process", lambda function, *args: function(*args))

    def run(script, *arguments):
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        module = importlib.import_module(script.removesuffix(".py"))
        if hasattr(module, "run_in_process"):
            monkeypatch.setattr(module, "run_in_process", measure.run_in_process)
        module.main()
        return lines_of(capsys.readouterr().out)

    return run


SMALL = "--worlds 4 --controls rotor_vel --integrators euler"
SCRIPTS = [
    (f"step.py {SMALL} --engine lanes plain --steps 2 --repeats 2", "steps_per_s",
     [{"engine": "lanes", "n_steps": 2}, {"engine": "plain", "n_steps": 2}]),
    ("loop.py --worlds 4 --controls state --repeats 2", "iteration_s",
     [{"control": "state", "n_worlds": 4}, {"benchmark": "loop/contacts"}, {"benchmark": "loop/jax"},
      {"benchmark": "loop/mj_step"}]),
    ("devices.py --small --cases physics gradient --devices 1 2 --repeats 1", "rate",  # which exchange nothing
     [{"case": case, "n_devices": n, "exchanged": {}} for case in ("physics", "gradient") for n in (1, 2)]),
    ("scaling.py --engine lanes --controls rotor_vel --most-worlds 4 --most-drones 1 --total 4 --steps 10 --repeats 1"
     " --plot {0}/scaling.png", "bytes_a_world",
     [{"series": "worlds", "n_worlds": 1}, {"series": "worlds", "n_worlds": 4}, {"series": "drones", "n_worlds": 4}]),
    ("versus_crazyflow.py --only swarm --batch-worlds 2 --swarm 3 --engine lanes --repeats 1", "ratio",
     [{"n_worlds": 2, "n_drones": 3}]),
    ("mppi.py --samples 16 --horizon 5 --repeats 2", "commands_per_s", [{"samples": 16, "horizon": 5}]),
    ("mocap.py --objects 50 --freq 240 --seconds 1", "frame_ms", [{"lost": 0}]),
    ("live.py --seconds 0.3 --drones 2 --only max", "factor", [{"late": 0}]),
    ("plugins.py --worlds 4 --cases imu --repeats 1", "ratio", [{"case": "none", "ratio": 1}, {"case": "imu"}]),
    ("flight_stack.py --worlds 4 --cases rod --repeats 1 --operations", "ratio",
     [{"case": "rotor"}, {"case": "rod", "reference": "rotor"}]),
    ("vehicles.py --worlds 4 --cases path beside_drone --repeats 1", "steps_per_s",
     [{"case": "path", "alone": True}, {"case": "beside_drone", "alone": False}]),
    ("racing.py --small", "duration_s", [{"track": "split_s_shapes", "dt": 0.04}]),
    ("sight.py --worlds 4 --cases gradient --small --repeats 1", "forward_passes", [{"case": "gradient"}]),
    ("gradient.py --worlds 4 --controls rotor_vel --steps 3 --repeats 1", "steps_per_s", [{"control": "rotor_vel"}]),
]  # fmt: skip
"""Scripts with small settings, a positive number that each line has, and parts of the lines."""


@pytest.mark.long("compiles the programs that it measures")
@pytest.mark.parametrize(
    ("command", "figure", "expected"),
    [pytest.param(*x, id=x[0].split(".")[0]) for x in SCRIPTS],
)
def test_a_script_prints_lines_with_their_figure(run, tmp_path, command, figure, expected):
    lines = run(*command.format(tmp_path).split())
    assert [{name: line[name] for name in part} for line, part in zip(lines, expected, strict=True)] == expected
    assert all(line[figure] > 0 for line in lines)
    if command.startswith("step"):
        assert {"device", "processor", "cores", "jax", "python", "date", "crazysim"} <= lines[0].keys()


def test_compile_prints_its_parts_from_a_process_of_its_own():
    """As a user runs it: the script is a program, and each case is compiled by a process that has compiled nothing."""
    command = [sys.executable, BENCHMARKS / "compile.py", *SMALL.split()]
    (line,) = lines_of(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert line["compile_s"] > 0
    assert line["trace_s"] > 0


@pytest.mark.parametrize(("device", "n_calls"), [("cpu", 2), ("gpu", 20)])
def test_each_timed_batch_starts_from_the_same_data(benchmarks, device, n_calls):
    import measure

    from crazysim import Sim

    flight = measure.Flight(Sim(engine="lanes"), "attitude", n_steps=50, device=device)
    assert flight.n_calls == n_calls
    ends = [(flight.seconds(), flight.sim.data.core.steps.item())[1] for _ in range(3)]
    assert ends == [50 * n_calls] * 3


def test_bytes_and_operations_of_a_step_are_counted(benchmarks):
    import limits

    from crazysim import Sim

    each_step, _, n_bytes = limits.count_work(Sim(control="rotor_vel", engine="lanes"))
    # Read: pos, quat, vel, ang_vel, force, torque, rotor speeds and their commands, steps; all written but the forces.
    read = 3 + 4 + 3 + 3 + 3 + 3 + 4 + 4 + 1
    assert n_bytes == 4 * (2 * read - 6)
    assert limits.count_work(Sim(control="rotor_vel", integrator="rk4", engine="lanes"))[0] > 3 * each_step


def write_results(train, out, successes, **changes):
    """Write the results of trainings of ``hover`` with these success rates, one for each seed."""
    out.mkdir(exist_ok=True)
    for seed, success in enumerate(successes):
        result = {
            "task": "hover", "seed": seed, "on": "cpu", "arguments": [], "algorithm": "ppo", "success": success,
            "crashed": 0.0, "error": 0.01 * (1 + seed), "env_steps": 2_600_000, "seconds": 20.0 + seed,
            "curve": [[5.0, 0.5], [9.0, success]], "sources": train.source_hash(), "commit": "abc1234", "parallel": 1,
            "date": "2026-11-26", "machine": "a machine", "jax": "0.10.1",
        }  # fmt: skip
        with (out / "results.jsonl").open("a") as file:
            file.write(json.dumps(result | changes) + "\n")


@pytest.fixture
def train(benchmarks, monkeypatch, tmp_path):
    """Return the script of trainings with copies of the committed data and of the page; the table has no rows."""
    train = importlib.import_module("train")
    for path in (
        train.TABLE.parent / "figures.json",
        train.TABLE.parent / "tables.json",
        train.TABLE.parents[1] / "results.md",
    ):
        (tmp_path / path.name).write_text(path.read_text())
    (tmp_path / train.TABLE.name).write_text("[]")
    monkeypatch.setattr(train, "TABLE", tmp_path / train.TABLE.name)
    monkeypatch.setattr(train.figures, "ROOT", tmp_path)
    monkeypatch.setattr(train.figures, "RESULTS", tmp_path)
    monkeypatch.setattr(train.figures, "PAGES", ["results.md"])
    return train


def test_learning_curves_of_several_seeds_are_drawn_and_summarised(run, train, tmp_path):
    plt = pytest.importorskip("matplotlib.pyplot")
    write_results(train, tmp_path, (0.5, 1.0))
    picture = tmp_path / "curves.png"
    (line,) = run("train.py", "--only-plot", "--tasks", "hover", "--out", tmp_path, "--plot", picture)
    assert (line["seeds"], line["least"], line["median"], line["seconds"]) == ([0, 1], 0.5, 0.75, 20.5)
    assert (line["tenth"], line["error"]) == (0.55, 0.015)
    pixels = (plt.imread(picture)[..., :3].reshape(-1, 3) * 255).round()
    for color in ((31, 119, 180), (255, 127, 14)):  # matplotlib's first two, a line for each seed; smoothed
        assert (np.abs(pixels - color).max(axis=-1) < 40).sum() > 20, color


def test_the_table_gets_the_tasks_whose_seeds_are_all_finished(run, train, tmp_path):
    """The page shows the same rows as the table. Rows of other tasks stay. Rows are in the order of the tasks."""
    other = {"task": "track", "algorithm": "apg", "env_steps": 256_000, "seeds": [3, 7], "least": 1.0, "tenth": 1.0,
             "median": 1.0, "error": None, "unit": "m", "seconds": 5.0, "parallel": 12, "commit": "0000000",
             "date": "2026-11-25", "machine": "another", "jax": "0.11.2"}  # fmt: skip
    train.TABLE.write_text(json.dumps([other]))
    write_results(train, tmp_path, (0.99, 1.0, 0.995), together=3)
    before = (tmp_path / "results.md").read_text()
    run("train.py", "--only-plot", "--tasks", "hover", "--seeds", "0:4", "--out", tmp_path, "--write")
    assert json.loads(train.TABLE.read_text()) == [other]
    (row,) = run("train.py", "--tasks", "hover", "--seeds", "0,1,2", "--out", tmp_path, "--write")[1:]
    assert json.loads(train.TABLE.read_text()) == [row, other]
    page, marker = (tmp_path / "results.md").read_text(), "<!-- figure training -->"
    assert "| `hover` | PPO, 2.6 M | 0 to 2 | 99.0% | 99.5% | 0.02 m | 21 s for 3 seeds |" in page
    assert "| `track` | analytic gradients, 0.26 M | 3, 7 | 100.0% | 100.0% |  | 5 s, 12 at a time |" in page
    assert f"`training`: a machine, 2026-11-26, commit abc1234; another, 2026-11-25, commit 0000000 {marker}" in page
    assert page.partition(marker)[2].partition("\n\n###")[2] == before.partition(marker)[2].partition("\n\n###")[2]


def test_a_check_fails_below_the_table_by_more_than_two_standard_errors(run, train, tmp_path, capsys):
    """With two successes and two failures added, two standard errors of 1,000 starts at 99% are 0.69 points."""
    table = [{"task": "hover", "least": 0.99}]
    train.TABLE.write_text(json.dumps(table))
    check = ("train.py", "--check", "--tasks", "hover")
    write_results(train, tmp_path / "good", [0.984])
    run(*check, "--out", tmp_path / "good")
    write_results(train, tmp_path / "bad", [0.983])
    with pytest.raises(SystemExit, match=r"hover: expected at least 99\.0% .*, got 98\.3% with seed 0"):
        run(*check, "--out", tmp_path / "bad")
    train.TABLE.write_text("[]")
    with pytest.raises(SystemExit, match=r"hover has no row in training\.json.*--write"):
        run(*check, "--out", tmp_path / "good")
    capsys.readouterr()
    write_results(train, tmp_path / "old", [1.0], sources="others")
    assert run("train.py", "--only-plot", "--tasks", "hover", "--seeds", 0, "--out", tmp_path / "old") == []
    (kept,) = run("train.py", "--only-plot", "--keep", "--tasks", "hover", "--seeds", 0, "--out", tmp_path / "old")
    assert kept["least"] == 1.0


@pytest.mark.long("trains in a process of its own")
def test_a_training_that_fails_stops_no_other_and_finished_ones_are_not_repeated(run, train, tmp_path, capsys):
    options = ("--seeds", "0:2", "--parallel", "2", "--out", tmp_path, "--")
    small = ("--iterations", "1", "--worlds", "2", "--set", "seconds=0.1", "engine=interpret",
             "--config", "n_steps=4", "minibatches=2", "hidden=[8]")  # fmt: skip
    with pytest.raises(SystemExit, match=r"^nothing: training with seeds 0, 1 failed$"):
        run("train.py", "--tasks", "nothing", "hover", *options, *small)
    count, *lines = lines_of(capsys.readouterr().out)
    assert count == {"finished": 0, "to_train": 4}
    assert any("task 'nothing' does not exist" in line.get("failed", "") for line in lines)
    assert (lines[-1]["env_steps"], lines[-1]["seeds"], lines[-1]["together"]) == (8, [0, 1], 2)
    again = run("train.py", "--tasks", "hover", *options, *small)
    assert again == [{"finished": 2, "to_train": 0}, lines[-1]]


def test_controllers_are_compared_on_the_same_flights(run):
    small = ["--drones", "cf21B_500", "hb_x500", "--attitudes", "1", "--worlds", "4", "--repeats", "1"]
    flown, cost = run("controllers.py", "--controllers", "geometric", *small)
    assert (flown["controller"], flown["drone"]) == ("geometric", "cf21B_500")  # the other one has no rotors
    assert flown["tracking"] < 0.02
    assert "error_attitude" not in flown  # it takes states only
    assert flown["pushed"] == pytest.approx(0.289, abs=0.02)
    assert cost["steps_per_s"] > 0


def test_the_runs_of_any_task_are_below_the_folder_that_was_named(benchmarks, tmp_path):
    train = importlib.import_module("train")
    tasks = ["hover", "tasks/mine.py:Mine", "../mine.py:Mine", f"{tmp_path}/mine.py:Mine"]
    folders = [train.run_folder(tmp_path / "out", task, "0", "cpu") for task in tasks]
    others = train.run_folder(tmp_path / "out", "hover", "0", "cpu", "--set", "drone=a/b.toml")
    assert others.parent == folders[0].parent
    assert folders[0] == tmp_path / "out" / "hover-cpu-0"
    assert {folder.resolve().parent for folder in folders} == {tmp_path / "out"}
    assert len(set(folders)) == len(tasks)
