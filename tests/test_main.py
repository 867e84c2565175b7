"""The command line and the demo, as a user runs them, but smaller."""

import subprocess
import sys

import numpy as np
import pytest
from drawing import draw_coarsely
from imageio_ffmpeg import get_ffmpeg_exe

from crazysim.__main__ import COMMANDS, main
from crazysim.demos import DEMOS, flight
from crazysim.media import Flight


def test_without_a_command_it_lists_what_there_is(capsys):
    assert main([]) == 0
    assert "demo" in capsys.readouterr().out


def test_as_a_module_in_a_process_of_its_own():
    out = subprocess.run([sys.executable, "-m", "crazysim", "--help"], capture_output=True, text=True, check=True)
    assert "demo" in out.stdout


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
        assert "random seed (default: 0)" in out


def test_a_demo_has_a_name(capsys, monkeypatch):
    ran = []
    monkeypatch.setattr(flight, "run", lambda **settings: ran.append(settings))
    assert main(["demo"]) == main(["demo", "flight", "--worlds", "8", "--no-film"]) == 0
    assert ran == [{}, {"n_worlds": 8, "film": False}]
    with pytest.raises(SystemExit):
        main(["demo", "dance"])
    message = capsys.readouterr().err
    assert all(name in message for name in DEMOS)


def test_the_demo_flies_counts_plots_and_films(tmp_path, capsys, monkeypatch, opengl):
    """A second of 8 worlds of 4 drones: figures are printed and both files are pictures of something."""
    draw_coarsely(monkeypatch)
    assert main(["demo", "--worlds", "8", "--seconds", "1", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    for word in ("compile time", "steps per second", "tracking error", "contacts"):
        assert word in out
    error_cm = float(out.split("tracking error")[1].split("cm")[0])
    assert 0.1 < error_cm < 20  # the cascade lags some centimetres behind; a crashed drone would be metres off
    assert (tmp_path / "tracks.png").read_bytes().startswith(b"\x89PNG")
    flown = Flight.load(tmp_path / "flight.npz")
    assert flown.pos.shape == (25, 1, 4, 3)
    assert np.ptp(flown.pos[:, 0, :, :2], axis=0).max(-1).min() > 0.4, "every drone is on its way"
    film = tmp_path / "flight.mp4"
    decode = [get_ffmpeg_exe(), "-loglevel", "error", "-i", film, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    pixels = np.frombuffer(subprocess.run(decode, capture_output=True, check=True).stdout, np.uint8)
    frames = pixels.reshape(-1, 544, 960, 3)
    assert len(frames) == 25  # 1 s
    assert np.mean(np.abs(frames[-1].astype(float) - frames[0])) > 1, "nothing moves in the film"


def test_pick_and_place_succeeds_in_every_world(tmp_path, capsys):
    """From random places of the loads: all are set down within millimetres, and carried within 3 cm RMS."""
    assert main(["demo", "pick", "--worlds", "3", "--no-film", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    for word in ("engine: fused", "picked up         3 of 3", "placed            3 of 3", "steps per second"):
        assert word in out
    assert float(out.split("distance")[1].split("cm")[0]) < 0.5
    assert float(out.split("tracking error")[1].split("cm")[0]) < 3
    flown = Flight.load(tmp_path / "flight.npz")
    assert flown.pos.shape == (625, 1, 1, 3)
    away = np.linalg.norm(flown.body_pos[:, 0] - [1.2, 1.2, 0.04], axis=-1)
    load = np.argmin(away[-1])
    assert away[-1, load] < 5e-3
    from_middle = np.linalg.norm(flown.body_pos[0, 0, load] - [-1.2, -1.2, 0.04])
    assert 0.01 < from_middle < 0.18, "it starts at a random place on the other pad"


def test_a_mixed_fleet_keeps_to_its_paths_and_apart(tmp_path, capsys):
    """Drones of two kinds and cars of two kinds, over hills: a second of two worlds."""
    arguments = ["--worlds", "2", "--seconds", "1", "--no-film", "--out", str(tmp_path)]
    assert main(["demo", "mixed", *arguments]) == 0
    out = capsys.readouterr().out
    for word in ("engine: fused", "Crazyflie_1, Bumblebee_0", "0 begun, in 0 of 2 worlds", "steps per second"):
        assert word in out
    closest = out.split("closest")[1].splitlines()[0].split()
    assert float(closest[0]) > 20
    assert 20 < float(closest[4]) < 80, "one drone escorts a car"
    errors = [line for line in out.splitlines() if line.startswith("tracking error")]
    for name, line in zip(("Crazyflie_0", "Crazyflie_1", "Bumblebee_0's load", "_0", "_1"), errors, strict=True):
        assert name in line
        assert float(line.split("cm RMS")[0].split()[-1]) < 15
    assert main(["demo", "mixed", "--drones", "2"]) == 2
    assert "--drones 3" in capsys.readouterr().err


def test_without_opengl_the_demo_says_so_and_does_the_rest(tmp_path, capsys, monkeypatch):
    def no_picture(*args, **kwargs):
        raise flight.RenderError("no OpenGL context could be made")

    monkeypatch.setattr(flight.Sim, "draw", no_picture)
    assert main(["demo", "--worlds", "8", "--seconds", "1", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert len([line for line in out.splitlines() if line.startswith("no film")]) == 1
    assert (tmp_path / "tracks.png").exists()
    assert not (tmp_path / "flight.mp4").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [(["--seconds", "0"], "--seconds"), (["--worlds", "0"], "n_worlds"), (["--device", "toaster"], "toaster")],
)
def test_wrong_arguments_are_one_line(arguments, word, capsys):
    assert main(["demo", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert word in error
    assert "\n" not in error


def test_the_poles_are_where_drones_can_hit_them():
    """Contacts are found in some worlds and not in all: the check would be worthless otherwise."""
    sim = flight.build(64, 4, "cpu")
    fly = flight.build_fly_frame(sim)
    touched = np.zeros(64, bool)
    for _ in range(75):
        sim.data, _ = fly(sim.data)
        touched |= flight.touches(sim).any((1, 2))
    assert 0 < touched.sum() < 64
