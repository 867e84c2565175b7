"""Films: their frames are read back and compared with the flight."""

import builtins
import re

import jax.numpy as jnp
import numpy as np
import pytest
from disks import full_disk
from pictures import read_frames

from crazysim.errors import ConfigError, RenderError
from crazysim.media import Film, Recorder, View
from crazysim.sim import Sim

WIDTH, HEIGHT = 96, 64


@pytest.fixture(scope="module")
def sim(opengl, plain_scene):
    """Return a simulation of two worlds with a camera that looks down."""
    sim = Sim(n_worlds=2, xml_path=plain_scene)
    yield sim
    sim.close()


def move_to_step(sim, steps):
    """Set the drones to their positions after some steps at 1 m/s to the east, and the clock."""
    pos = jnp.zeros((2, 1, 3)).at[..., 0].set(-0.5 + steps / sim.freq).at[1, :, 1].set(0.3).at[..., 2].set(1.0)
    core = sim.data.core.replace(steps=jnp.full_like(sim.data.core.steps, steps))
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos), core=core)


def make_view(**options):
    return View(**{"camera": "down", "width": WIDTH, "height": HEIGHT} | options)


def column_of_drone(frame):
    """Return the mean column of the pixels that are darker than the floor."""
    return np.nonzero(frame.astype(int).max(-1) < 130)[1].mean()


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_film_shows_the_drone_fly_from_left_to_right(sim, tmp_path, suffix):
    """One second at 1 m/s has 11 frames at 10 Hz; from frame to frame the drone moves right by 0.1 m."""
    path = tmp_path / f"flight{suffix}"
    with Film(path, make_view(), fps=10) as film:
        for k in range(11):
            move_to_step(sim, 50 * k)
            assert film.add(sim) == 1
    frames = read_frames(path, HEIGHT, WIDTH)
    assert len(frames) == film.n_frames == 11
    columns = [column_of_drone(frame) for frame in frames]
    focal = 0.5 * HEIGHT / np.tan(np.deg2rad(45 / 2))
    np.testing.assert_allclose(np.diff(columns), 0.1 * focal, atol=1.5)
    np.testing.assert_allclose(columns[5] + 0.5, WIDTH / 2, atol=1.5)


def test_a_film_stays_in_its_folder_when_the_working_directory_changes(tmp_path, monkeypatch):
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    with Film("flight.gif", make_view()) as film:
        film.write(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        monkeypatch.chdir(tmp_path / "other")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["flight.gif", "other"]


@pytest.mark.parametrize(("fps", "speed", "n_frames"), [(10, 1.0, 11), (25, 1.0, 26), (10, 0.25, 41), (10, 5.0, 3)])
def test_the_number_of_frames_follows_from_simulated_time(sim, tmp_path, fps, speed, n_frames):
    """At any rate of calls, a second has fps / speed frames and the first one; with few calls images are repeated."""
    n_frames_of_calls = []
    with Film(tmp_path / "flight.mp4", make_view(), fps=fps, speed=speed) as film:
        for k in range(21):
            move_to_step(sim, 25 * k)
            n_frames_of_calls.append(film.add(sim))
    assert (
        sum(n_frames_of_calls) == film.n_frames == len(read_frames(tmp_path / "flight.mp4", HEIGHT, WIDTH)) == n_frames
    )
    assert max(n_frames_of_calls) - min(n_frames_of_calls[1:]) <= 1


def test_a_reset_does_not_turn_the_film_back(sim, tmp_path):
    with Film(tmp_path / "flight.mp4", make_view(), fps=10) as film:
        for steps in (0, 50, 100, 0, 50, 100):
            move_to_step(sim, steps)
            film.add(sim)
    assert film.n_frames == 5  # 0.2 s before the reset, 0.2 s after it


def test_a_recorded_flight_is_played_world_by_world(sim, tmp_path, capfd):
    """Recorded at 10 Hz and played at 20 Hz: drones are interpolated, and the simulation stays as it is."""
    recorder = Recorder(sim)
    for k in range(6):
        move_to_step(sim, 50 * k)
        recorder.add()
    move_to_step(sim, 5000)
    two_worlds = make_view(worlds=[0, 1], columns=1, border=0)
    with Film(tmp_path / "flight.mp4", two_worlds, fps=20, progress=True) as film:
        assert film.play(sim, recorder.flight()) == 11
    assert not capfd.readouterr().err  # no bar without a terminal
    np.testing.assert_allclose(sim.data.states.pos[:, 0, 0], 9.5)
    np.testing.assert_array_equal(sim.data.core.steps, 5000)
    frames = read_frames(tmp_path / "flight.mp4", HEIGHT, WIDTH)
    for k in range(2):
        columns = [column_of_drone(frame[two_worlds.tile(k)]) for frame in frames]
        focal = 0.25 * HEIGHT / np.tan(np.deg2rad(45 / 2))
        np.testing.assert_allclose(np.diff(columns), 0.05 * focal, atol=1.0)
        np.testing.assert_allclose(columns[10] - columns[0], 0.5 * focal, atol=1.5)


def test_images_can_be_written_as_frames(sim, tmp_path):
    with Film(tmp_path / "flight.mp4", make_view(), fps=10) as film:
        film.write(np.full((HEIGHT, WIDTH, 3), 200, np.uint8), 3)
    frames = read_frames(tmp_path / "flight.mp4", HEIGHT, WIDTH)
    assert len(frames) == 3
    np.testing.assert_allclose(frames.astype(int), 200, atol=3)


def test_a_file_name_may_look_like_an_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Film("-y.mp4", make_view(), fps=10) as film:
        film.write(np.full((HEIGHT, WIDTH, 3), 200, np.uint8), 2)
    assert len(read_frames(tmp_path / "-y.mp4", HEIGHT, WIDTH)) == 2


# Wrong input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("flight.avi", {}, "ends with .mp4 or .gif"),
        ("nowhere/flight.mp4", {}, "an existing folder"),
        *(("flight.mp4", {"fps": fps}, "fps") for fps in (0, -5, np.nan)),
        ("flight.mp4", {"speed": 0.0}, "positive speed, got 0.0"),
        ("flight.mp4", {"view": View(width=321, height=240)}, "321 x 240 pixels. Use 322 x 240"),
        ("folder.mp4", {}, "got the folder"),
    ],
)
def test_invalid_films_are_refused(tmp_path, name, options, message):
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(ConfigError, match=re.escape(message)):
        Film(tmp_path / name, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.mp4"]


@pytest.mark.parametrize(
    ("options", "write", "message"),
    [
        ({}, lambda film, sim: None, r"at least one frame .*film\.add\(sim\)"),
        ({"worlds": [2]}, lambda film, sim: film.add(sim), "got 2"),
        ({"camera": "up"}, lambda film, sim: film.add(sim), "got 'up'"),
        ({}, lambda film, sim: film.write(np.zeros((9, 9, 3))), r"\(64, 96, 3\), uint8, got \(9, 9, 3\), float64"),
    ],
)
def test_invalid_frames_are_refused_and_leave_no_file(sim, tmp_path, options, write, message):
    with pytest.raises(ConfigError, match=message), Film(tmp_path / "a.mp4", make_view(**options)) as film:
        write(film, sim)
    assert not list(tmp_path.iterdir())


def test_a_film_replaces_an_older_one_only_when_it_is_complete(sim, tmp_path):
    path = tmp_path / "flight.mp4"
    path.write_bytes(b"before")

    def film_until_the_disk_is_full():
        with full_disk(), Film(path, make_view()) as film:
            film.add(sim)
            assert path.read_bytes() == b"before"

    with pytest.raises(RenderError, match=r"can be written, got .*flight\.mp4': "):
        film_until_the_disk_is_full()
    assert path.read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == ["flight.mp4"]
    with Film(path, make_view()) as film:
        film.add(sim)
    assert path.read_bytes()[4:8] == b"ftyp"
    assert [p.name for p in tmp_path.iterdir()] == ["flight.mp4"]


@pytest.mark.parametrize(("missing", "word"), [("imageio_ffmpeg", "imageio-ffmpeg"), ("tqdm", "tqdm")])
def test_a_missing_package_is_named(tmp_path, monkeypatch, missing, word):
    original_import = builtins.__import__

    def import_without_package(name, *args, **kwargs):
        if name == missing:
            raise ImportError(name)
        return original_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", import_without_package)
    with pytest.raises(ImportError, match=rf"need {word}, which is not installed\. Run pip install 'crazysim\[demo\]'"):
        Film(tmp_path / "flight.mp4", progress=True)
