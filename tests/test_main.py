"""The command line and the demo, as a user runs them, but smaller."""

import argparse
import errno
import json
import os
import re
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest
from pictures import read_frames

from crazysim import Sim, errors
from crazysim.__main__ import EXTRAS, main
from crazysim.commands import airframe, demo, demo_flight, info, replay, training
from crazysim.commands.options import parse_pairs
from crazysim.lab.commands import identify, live, show, validate
from crazysim.media import Flight, Recorder
from crazysim.scene.software import film_size

COMMANDS = ("demo", "replay", "show", "live", "train", "evaluate", "export", "render", "airframe", "identify", "info")


def test_without_a_command_the_program_lists_its_commands(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    assert all(f"\n    {name} " in out for name in COMMANDS)


def test_a_closed_pipe_is_no_traceback():
    command = [sys.executable, "-m", "crazysim", "airframe", "check", "crazyflie"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


def test_an_error_of_the_system_is_a_line(monkeypatch, capsys):
    def raise_no_space(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out")

    monkeypatch.setattr("crazysim.commands.info.run", raise_no_space)
    assert main(["info"]) == 2
    assert capsys.readouterr().err == "crazysim: [Errno 28] No space left on device: 'out'\n"


@pytest.mark.parametrize(("command", "option"), [("render run", "--film"), ("airframe check cf2x_L250", "--picture")])
def test_an_unknown_option_shows_the_options_of_its_command(command, option, capsys):
    with pytest.raises(SystemExit):
        main([*command.split(), "--out", "file"])
    error = capsys.readouterr().err
    assert option in error
    assert "unrecognized arguments: --out file" in error


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_a_command_states_defaults_once(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    out = " ".join(capsys.readouterr().out.split())
    assert "(default: None)" not in out
    assert "(default: False)" not in out
    for argument in out.split(" --"):
        assert argument.count("by default") + argument.count("(default:") <= 1, argument
    if command == "train":
        assert "random seed; by default 0" in out


def test_the_demo_flies_counts_plots_and_films(tmp_path, capsys, opengl):
    """A second of 8 worlds of 4 drones: figures are printed and both files are pictures of something."""
    assert main(["demo", "--worlds", "8", "--seconds", "1", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    for word in ("compile time", "steps per second", "tracking error", "contacts"):
        assert word in out
    error_cm = float(out.split("tracking error")[1].split("cm")[0])
    assert 0.1 < error_cm < 20  # the cascade lags some centimetres behind; a crashed drone would be metres off
    assert (tmp_path / "tracks.png").read_bytes().startswith(b"\x89PNG")
    flown = Flight.load(tmp_path / "flight.journal")
    assert flown.pos.shape == (25, 1, 4, 3)
    assert np.ptp(flown.pos[:, 0, :, :2], axis=0).max(-1).min() > 0.4, "every drone is on its way"
    film = tmp_path / "flight.mp4"
    width, height = film_size(960, 544)
    frames = read_frames(film, height, width)
    assert len(frames) == 25  # 1 s
    assert np.mean(np.abs(frames[-1].astype(float) - frames[0])) > 1, "nothing moves in the film"


def test_without_opengl_the_demo_says_so_and_does_the_rest(tmp_path, capsys, monkeypatch):
    def raise_render_error(*args, **kwargs):
        raise demo_flight.RenderError("no OpenGL context could be made")

    monkeypatch.setattr(demo_flight.Sim, "render", raise_render_error)
    assert main(["demo", "--worlds", "8", "--seconds", "1", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert len([line for line in out.splitlines() if line.startswith("no film")]) == 1
    assert (tmp_path / "tracks.png").exists()
    assert not (tmp_path / "flight.mp4").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--seconds", "0.01"], "expected --seconds of at least 0.04, and finite, got 0.01"),
        (["--out", "flight.txt"], "expected a folder, got 'flight.txt': which is a file"),
        (["--device", "toaster"], "toaster"),
    ],
)
def test_wrong_arguments_are_one_line(arguments, word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("flight.txt").touch()
    assert main(["demo", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert word in error
    assert "\n" not in error


def options_with_numbers():
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers()
    for module in (demo, replay, show, live, training, airframe, identify, validate, info):
        module.add_parsers(commands)
    parsers = dict(commands.choices)
    parsers |= {f"airframe {name}": x for name, x in parsers.pop("airframe")._actions[1].choices.items()}
    for command, command_parser in parsers.items():
        for action in command_parser._actions:
            if action.type is not None and action.type not in (Path, training.parse_seeds):
                yield pytest.param(command_parser, action, id=f"{command} {action.dest}")


@pytest.mark.parametrize(("parser", "action"), list(options_with_numbers()))
def test_every_number_of_a_command_is_checked_before_its_work(parser, action, capsys):
    option, takes_any_sign = action.option_strings[0], action.dest == "seed"
    for text in ("1e3x", "nan", "1e400", *([] if takes_any_sign else ["-3"])):
        with pytest.raises(SystemExit):
            parser.parse_args([f"{option}={text}"] if action.nargs is None else [option, *[text] * action.nargs])
        error = capsys.readouterr().err
        assert re.search(rf"{option}: expected a .*from .*, got '{text}'. Use for example", error), error


def test_a_warning_of_a_command_is_its_message_alone(monkeypatch, capsys):
    monkeypatch.setattr(info, "run", lambda _: errors.warn("the cache is full"))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        main(["info"])
    assert capsys.readouterr().err == "crazysim: the cache is full\n"


def test_the_poles_are_where_drones_can_hit_them():
    """Contacts are found in some worlds and not in all: the check would be worthless otherwise."""
    sim = demo_flight.build_sim(64, 4, "cpu")
    fly = demo_flight.build_frame_step(sim)
    touched = np.zeros(64, bool)
    for _ in range(75):
        sim.data, _ = fly(sim.data)
        touched |= demo_flight.find_pole_contacts(sim).any((1, 2))
    assert 0 < touched.sum() < 64


PROGRAM_WITHOUT_PACKAGES = """
import contextlib, io, json, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1].split(","):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
from crazysim.__main__ import main
for command in sys.argv[2:]:
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
        status = main(command.split())
    print(json.dumps([status, out.getvalue()]))
"""
"""The command line of an installation without the packages of the first argument, which runs the other arguments."""
COMMANDS_BY_EXTRA = {
    "train hover --iterations 1 --out {0}": "train",
    "evaluate {0}": "train",
    "export {0} --c {0}/policy.h": "train",
    "render {0}": "train",
    "replay {0}/flight.journal": "web",
    "live --browser --seconds 0.1 --port 0": "web",
    "demo --worlds 1 --drones 1 --seconds 0.1 --out {0}": "demo",
}
"""The extra that a command lacks."""


def test_a_command_names_the_extra_that_it_lacks(tmp_path):
    recorder = Recorder(Sim())
    recorder.add()
    recorder.flight().save(tmp_path / "flight.journal")
    commands = [command.format(tmp_path) for command in COMMANDS_BY_EXTRA]
    program = [sys.executable, "-c", PROGRAM_WITHOUT_PACKAGES, ",".join({*EXTRAS, "trimesh"}), *commands]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    for extra, line in zip(COMMANDS_BY_EXTRA.values(), done.stdout.splitlines(), strict=True):
        status, text = json.loads(line)
        assert f"pip install 'crazysim[{extra}]'" in text
        assert status == (0 if extra == "demo" else 2), "the demo flies without plot and film"
        assert "1 worlds" not in text
        assert "1 drones" not in text
    assert "Traceback" not in done.stderr


def test_the_extras_of_the_table_bring_their_packages():
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    extras = tomllib.loads(text)["project"]["optional-dependencies"]
    for package, extra in EXTRAS.items():
        needed = "viser" if package == "websockets" else package  # viser depends on it
        assert any(line.replace("-", "_").startswith(needed) for line in extras[extra]), package


def test_values_of_settings_are_json_or_python_or_text():
    values = parse_pairs(
        ["a=True", "b=false", "c=None", "d=[1, 2.5]", "e=crazyflie", "f=x=y", "g=(16, 12)", "h=2026_12_01"]
    )
    assert values == {
        "a": True,
        "b": False,
        "c": None,
        "d": [1, 2.5],
        "e": "crazyflie",
        "f": "x=y",
        "g": (16, 12),
        "h": "2026_12_01",
    }
