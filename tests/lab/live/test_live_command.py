"""The command crazysim live, as a user runs it."""

import socket

import numpy as np
import pytest

from crazysim.__main__ import main
from crazysim.lab.live.circles import CIRCLE_DURATION, CLIMB_DURATION, HEIGHT, RADIUS, circle_commands
from crazysim.media import Flight


def test_a_headless_flight_prints_the_real_time_factor(tmp_path, capsys):
    path = tmp_path / "f.journal"
    arguments = ["--drones", "3", "--seconds", "4", "--headless", "--speed", "max", "--record", str(path)]
    assert main(["live", *arguments]) == 0
    out = capsys.readouterr().out
    assert "times real time" in out
    assert f"recording to {path}" in out
    flight = Flight.load(path)
    assert len(flight.time) == 201
    circling_pos = flight.pos[100:, 0]
    assert np.abs(circling_pos[..., 2] - HEIGHT).max() < 0.3
    assert np.ptp(circling_pos[..., :2], axis=0).min() > 0.8 * RADIUS


def test_circles_are_consistent():
    """Velocity and acceleration are derivatives of position once the drones have risen, and the start is at rest."""
    initial_pos = np.array([[[1.0, 2.0, 0.0]]])
    t, h = CLIMB_DURATION + 0.3 * CIRCLE_DURATION, 1e-4
    earlier, now, later = (circle_commands(initial_pos, t + k * h)[0, 0] for k in (-1, 0, 1))
    np.testing.assert_allclose(now[3:6], (later[:3] - earlier[:3]) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(now[6:9], (later[:3] - 2 * now[:3] + earlier[:3]) / h**2, atol=1e-5)
    start = circle_commands(initial_pos, 0.0)[0, 0]
    np.testing.assert_allclose(start[:3], initial_pos[0, 0])
    assert not start[3:9].any()


def test_an_airframe_with_fitted_models_alone_flies(capsys):
    arguments = ["live", "--drone", "hb_x500", "--drones", "1", "--seconds", "0.1", "--headless", "--speed", "max"]
    assert main(arguments) == 2
    assert "so_rpy_rotor_drag), got 'first_principles'" in capsys.readouterr().err
    assert main([*arguments, "--dynamics", "so_rpy_rotor_drag"]) == 0


def test_the_live_command_takes_a_pilot(capsys):
    assert main(["live", "--drones", "2", "--seconds", "0.5", "--headless", "--speed", "max", "--pilot"]) == 0
    assert "pilot" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--headless"], "expected --seconds with --headless"),
        (["--headless", "--browser", "--seconds", "1"], "expected --headless or --browser, got both"),
        (
            ["--headless", "--seconds", "1", "--control-freq", "33"],
            "state_freq is 33 Hz, which does not divide freq = 500 Hz",
        ),
        (["--headless", "--seconds", "1", "--record", "nowhere/f"], "file that can be created"),
        (["--headless", "--seconds", "1", "--pilot", "--commands"], "or a pilot, got both"),
        (["--window", "--seconds", "1"], "expected a screen for --window, got none. Use --browser or --headless."),
    ],
)
def test_wrong_options_are_refused_in_one_line(arguments, message, monkeypatch, capsys):
    monkeypatch.setattr("crazysim.commands.options.has_screen", lambda: False)
    assert main(["live", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error


def test_a_port_in_use_is_refused_in_one_line(viser, capsys):
    with socket.create_server(("127.0.0.1", 0)) as busy_socket:
        assert main(["live", "--browser", "--seconds", "1", "--port", str(busy_socket.getsockname()[1])]) == 2
    error = capsys.readouterr().err.strip()
    assert "expected a free address" in error
    assert "\n" not in error
