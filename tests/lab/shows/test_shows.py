"""Flown shows: closest approaches, collisions, tracking errors, films, pages, live shows and the command."""

import functools
import json
import threading

import numpy as np
import pytest
from screens import screen_pixels, virtual_screen

from crazysim.__main__ import main
from crazysim.errors import ConfigError
from crazysim.lab.live import Window
from crazysim.lab.show_files import Lights, Show, save_show
from crazysim.lab.shows import (
    collisions,
    film,
    fly_show,
    live_show,
    page,
    report,
    sampled_approaches,
    summary,
    tracking_rms,
)
from crazysim.trajectories import Trajectory, line

LIGHTS = [
    Lights.of_pieces([0.0, 1.0], [(1, 0, 0), (0, 0, 1)]),
    Lights.of_pieces([0.0, 2.0], [(0, 0, 0), (1, 1, 1)], [(1, 1, 1), (1, 1, 1)]),
    Lights.constant((0, 1, 0)),
]
SHOW = Show(
    names=("a", "b", "c"),
    trajectories=Trajectory.stack(
        [
            line((0, 0, 1), (1, 0, 1), 2.0),
            line((1, 0.02, 1), (0, 0.02, 1), 2.0),
            line((0.5, 2, 0.5), (0.5, 2, 1.5), 2.0),
        ]
    ),
    lights=Lights.stack(LIGHTS),
    settings={"validation": {"minDistance": 0.3}},
)
"""Two drones that meet head-on after 1 s, with 2 cm between their paths, and a third drone next to them."""


@pytest.fixture(scope="module")
def flight():
    return fly_show(SHOW)


def test_closest_approach_of_straight_lines():
    """Two drones at 1 m/s each pass at a distance of 0.3 m at 1.234 s, which is between two samples."""
    t = np.arange(0.0, 3.0, 0.1)
    x = t - 1.234
    pos = np.stack([np.stack([x, 0 * x, 0 * x], -1), np.stack([-x, 0 * x + 0.3, 0 * x], -1)], axis=1)
    distance, when = sampled_approaches(t, pos)
    assert distance[0, 1] == distance[1, 0] == pytest.approx(0.3, abs=1e-6)
    assert when[0, 1] == pytest.approx(1.234, abs=1e-6)
    assert np.all(np.isinf(np.diag(distance)))


@pytest.fixture(scope="module")
def screen(tmp_path_factory):
    yield from virtual_screen(tmp_path_factory.mktemp("screen"))


def test_a_window_plays_the_show(screen, tmp_path, opengl, monkeypatch, capsys):
    """A drone is lit red, then blue: both are seen."""
    slow = Trajectory.stack([line((0, 0, 1), (1, 0, 1), 4.0)])
    lights = Lights.stack([Lights.of_pieces([0.0, 2.0], [(1, 0, 0), (0, 0, 1)])])
    save_show(Show(names=("a",), trajectories=slow, lights=lights), tmp_path / "show.skyc")
    monkeypatch.setenv("DISPLAY", screen[0])
    # A small window is drawn in time without a GPU, however busy the machine is.
    monkeypatch.setattr("crazysim.lab.live.Window", functools.partial(Window, width=320, height=180))
    seen, has_ended = [], threading.Event()

    def watch():
        while not has_ended.wait(0.1):
            picture = screen_pixels(screen[1], wait=False)[:300, :400].astype(np.int16)
            red = np.all(picture[..., :1] > picture[..., 1:] + 130, axis=-1).sum()
            blue = np.all(picture[..., 2:] > picture[..., :2] + 130, axis=-1).sum()
            seen.extend(name for name, n in (("red", red), ("blue", blue)) if n > 4 and name not in seen)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        main(["show", str(tmp_path / "show.skyc"), "--window"])
    finally:
        has_ended.set()
        watcher.join()
    out = capsys.readouterr().out
    assert " 4.0 s, computed in" in out
    assert "4.00 s in" in out
    assert seen == ["red", "blue"]


def test_planned_positions_and_colours_are_those_of_the_show(flight):
    assert flight.times[0] == 0.0
    assert flight.duration == pytest.approx(2.0)
    np.testing.assert_allclose(flight.planned[0], [[0, 0, 1], [1, 0.02, 1], [0.5, 2, 0.5]], atol=1e-6)
    np.testing.assert_allclose(flight.planned[-1], [[1, 0, 1], [0, 0.02, 1], [0.5, 2, 1.5]], atol=1e-6)
    np.testing.assert_allclose(flight.pos[0], flight.planned[0], atol=1e-6)
    samples = np.searchsorted(flight.times, [0.5, 1.0, 1.5])
    np.testing.assert_allclose(flight.colors[samples, 0], [(1, 0, 0), (0, 0, 1), (0, 0, 1)])
    np.testing.assert_allclose(flight.colors[samples, 1, 0], [0.25, 0.5, 0.75], atol=1e-6)


def test_a_report_lists_distances_and_durations(flight):
    figures = json.loads(json.dumps(report(flight)))
    assert set(figures) == {"planned", "flown"}
    assert set(figures["planned"]) == {"closest", "duration"}
    assert set(figures["flown"]) == {"closest", "tracking_rms", "duration"}
    for kind in figures.values():
        assert kind["duration"] == pytest.approx(2.0)
        assert sorted(sorted(pair["drones"]) for pair in kind["closest"]) == [["a", "b"], ["a", "c"], ["b", "c"]]
        distances = [pair["distance"] for pair in kind["closest"]]
        assert distances == sorted(distances)
    nearest = figures["planned"]["closest"][0]
    assert nearest["drones"] == ["a", "b"]
    assert nearest["distance"] == pytest.approx(0.02, abs=1e-4)
    assert nearest["time"] == pytest.approx(1.0, abs=1e-3)
    flown = figures["flown"]["closest"][0]
    assert flown["drones"] == ["a", "b"]
    assert flown["time"] == pytest.approx(1.0, abs=0.4)
    assert flown["distance"] != nearest["distance"]
    errors = np.linalg.norm(flight.pos - flight.planned, axis=-1)
    assert figures["flown"]["tracking_rms"]["a"] == pytest.approx(np.sqrt(np.mean(errors[:, 0] ** 2)), rel=1e-5)
    assert 0.001 < figures["flown"]["tracking_rms"]["a"] < 0.3
    assert tracking_rms(flight)["c"] < 0.3


def test_collisions_are_listed(flight):
    (result,) = collisions(flight)
    assert result["drones"] == ["a", "b"]
    assert 0.5 < result["time"] < 1.4
    text = summary(flight, report(flight))
    assert "a and b" in text
    assert "1 of 3 pairs closer than the show's 0.3 m" in text
    assert "collisions        1: a and b" in text


def test_part_of_a_show_and_wrong_settings():
    short = fly_show(SHOW, seconds=0.5)
    assert short.duration == pytest.approx(0.5)
    assert len(short.times) == len(short.pos) == len(short.planned) == len(short.colors)
    for seconds in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match="positive duration"):
            fly_show(SHOW, seconds=seconds)
    with pytest.raises(ConfigError, match="different names"):
        SHOW.replace(names=("a", "a", "c"))
    with pytest.raises(ConfigError, match="one entry for each of 2 drones"):
        SHOW.replace(names=("a", "b"))


def test_film_has_the_colours_of_the_lights(flight, tmp_path, opengl):
    from crazysim.lab.shows.view import create_view, media_flight
    from crazysim.media.flight_recorder import show_flight_at

    view = create_view(flight, width=320, height=240, text=None)
    data = flight.sim.data
    images = []
    for now in (0.3, 1.95):  # not while a collision is marked
        show_flight_at(flight.sim, media_flight(flight), now)
        images.append(view.render(flight.sim).astype(int))
    flight.sim.data = data
    reddish = [int(((x[..., 0] > 150) & (x[..., 1:].max(-1) < 90)).sum()) for x in images]
    bluish = [int(((x[..., 2] > 150) & (x[..., :2].max(-1) < 90)).sum()) for x in images]
    assert reddish[0] > reddish[1]
    assert bluish[1] > bluish[0]
    flight.sim.close()
    assert film(flight, tmp_path / "show.mp4", fps=2, width=320, height=240) == 5
    show_flight_at(flight.sim, media_flight(flight), 1.95)
    night = view.render(flight.sim).astype(int)
    flight.sim.data = data
    assert np.median(night) < 0.5 * np.median(images[1])  # the scene is dark, the lights are not
    assert np.percentile(night.max(-1), 99.9) > 120
    assert (tmp_path / "show.mp4").stat().st_size > 1000


def test_page_has_lights_that_change(flight, viser):
    from crazysim.lab.shows.view import media_flight
    from crazysim.media import web

    recorded = media_flight(flight)
    constant_colors = np.broadcast_to(flight.colors[:1], flight.colors.shape)
    sizes = [len(web.page(recorded)), len(web.page(recorded, lights=constant_colors)), len(page(flight))]
    assert sizes[0] < sizes[1]
    assert sizes[1] + 300 < sizes[2]
    with pytest.raises(ConfigError, match="lights of shape"):
        web.page(recorded, lights=flight.colors[:3])


def test_the_show_command_writes_a_report(tmp_path, capsys):
    save_show(SHOW, tmp_path / "show.skyc")
    arguments = ["show", str(tmp_path / "show.skyc"), "--report", str(tmp_path / "report.json")]
    assert main([*arguments, "--seconds", "1.2"]) == 0
    text = capsys.readouterr().out
    assert "3 drones, 1.2 s" in text
    figures = json.loads((tmp_path / "report.json").read_text())
    assert figures["flown"]["duration"] == pytest.approx(1.2)
    for wrong in (
        ["--film", "show.txt"],
        ["--page", "page.txt"],
        ["--report", "nowhere/report.json"],
    ):
        assert main(["show", str(tmp_path / "show.skyc"), *wrong]) == 2
        assert "expected" in capsys.readouterr().err
    assert main(["show", str(tmp_path / "nowhere.skyc")]) == 2


def test_a_live_show_has_lights():
    """The lights are those of the show at three times, and the drones end at their planned positions."""
    seen = {}
    with live_show(SHOW, speed="max") as live:
        for t in (0.5, 1.5):
            live.call_at(t, lambda live: seen.update({live.step: live.lights[0].copy()}))
        live.run(SHOW.duration)
        expected = SHOW.lights.colors([0.5, 1.5])
        np.testing.assert_allclose([seen[50], seen[150]], expected, atol=1e-6)
        np.testing.assert_array_equal(expected[:, 0], [[1, 0, 0], [0, 0, 1]])
        np.testing.assert_allclose(live.sim.data.states.pos[0], [[1, 0, 1], [0, 0.02, 1], [0.5, 2, 1.5]], atol=0.1)
        live.go_to(0.5)
        np.testing.assert_allclose(live.lights[0], SHOW.lights.colors([live.time - 0.01])[0], atol=0.05)


def test_the_live_command(tmp_path, capsys):
    save_show(SHOW, tmp_path / "show.skyc")
    main(["show", str(tmp_path / "show.skyc"), "--live", "--seconds", "0.2"])
    assert "times real time" in capsys.readouterr().out
    assert main(["show", str(tmp_path / "show.skyc"), "--live", "--film", str(tmp_path / "a.mp4")]) == 2
    assert "expected --live or --film, got both" in capsys.readouterr().err
