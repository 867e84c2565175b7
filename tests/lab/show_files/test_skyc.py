"""Shows: loading what other programs write, saving, and refusing everything else."""

import copy
import json
import random
import tracemalloc
import zipfile

import numpy as np
import pytest
import skyc_files
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from crazysim.errors import ConfigError
from crazysim.lab.show_files import Show, load_show, save_show
from crazysim.lab.show_files.archive import Archive
from crazysim.lab.show_files.skyc import parse_show
from crazysim.lab.trajectory_files.pieces import trajectory_pieces


def evaluate_positions(trajectory, t):
    """Return position, m, and yaw, rad, from the coefficients in float64. (n, 4)"""
    ends, c = trajectory_pieces(trajectory)
    begins = np.concatenate([[0.0], ends[:-1]])
    t = np.clip(t, 0, ends[-1])
    k = np.minimum(np.searchsorted(ends, t, side="right"), len(ends) - 1)
    u = ((t - begins[k]) / (ends - begins)[k])[:, None, None]
    return (c[k] * u ** np.arange(c.shape[2])).sum(-1)


def evaluate_control_points(points, t):
    """Return position, m, and yaw, rad, from the file's control points, by SciPy. (n, 4)"""
    start, last_point, values = points[0][0], points[0][1], np.zeros((len(t), 4))
    for end, point, inner in points[1:]:
        curve = BPoly(np.array([last_point, *inner, point], float)[:, None], [start, end])
        is_inside = (t >= start) & (t <= end)
        values[is_inside, : len(point)] = curve(t[is_inside])
        start, last_point = end, point
    values[:, 3] = np.deg2rad(values[:, 3])
    return values


@pytest.mark.parametrize(
    "create_files", [skyc_files.create_lab_show, skyc_files.create_lab_poly4d_show, skyc_files.create_older_lab_show]
)
def test_trajectories_are_the_curves_of_the_file(create_files):
    files = create_files()
    show = parse_show(skyc_files.pack_archive(files))
    points = files["drones/drone_1/trajectory.json"]["points"]
    t = np.linspace(0.0, points[-1][0], 91)
    np.testing.assert_allclose(evaluate_positions(show.trajectory(1), t), evaluate_control_points(points, t), atol=3e-6)
    assert show.duration == pytest.approx(points[-1][0])


def test_the_lab_show_is_read():
    show = parse_show(skyc_files.pack_archive(skyc_files.create_lab_show()))
    assert show.names == ("cf0", "cf1")
    assert [(cue.time, cue.name) for cue in show.cues] == [(0.0, "start"), (4.0, "land")]
    assert show.settings["validation"]["minDistance"] == 0.8
    assert "cues" not in show.settings
    np.testing.assert_array_equal(show.homes, [[0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(show.landings, [[0, 0, 0.1], [1, 0, 0.1]])
    assert show.encodings == ("COMPRESSED", "COMPRESSED")
    assert show.environment == "indoor"
    np.testing.assert_array_equal(show.lights.colors([0.0, 2.9, 100.0]), np.broadcast_to([1.0, 0.0, 0.0], (3, 2, 3)))


def test_studio_show_rests_until_take_off_and_turns_by_yaw_control():
    show = parse_show(skyc_files.pack_archive(skyc_files.create_studio_show()))
    assert show.names == ("drone_0",)
    assert show.environment == "outdoor"  # as in Skybrush
    assert show.duration == pytest.approx(11.66 + 2.5)
    values = evaluate_positions(show.trajectory(0), np.array([0.0, 6.0, 11.66, 11.91, 12.0, 12.16, 13.5, 14.16]))
    np.testing.assert_allclose(values[:3, :3], [[17.5, 10, 1]] * 3, atol=1e-5)
    np.testing.assert_allclose(values[3, :3], [17.5, 10, 1.36], atol=1e-4)
    np.testing.assert_allclose(np.rad2deg(values[:, 3]), [0, 45, 87.45, 89.325, 90, 70.8, -90, -90], atol=1e-3)


@pytest.mark.parametrize("create_files", skyc_files.SHOW_CREATORS.values(), ids=skyc_files.SHOW_CREATORS)
def test_saved_show_is_the_same(create_files, tmp_path):
    show = parse_show(skyc_files.pack_archive(create_files()))
    save_show(show, tmp_path / "again.skyc")
    again = load_show(tmp_path / "again.skyc")
    assert again.names == show.names
    assert again.cues == show.cues
    assert again.settings == dict(show.settings)
    assert again.parameters == show.parameters
    assert again.encodings == show.encodings
    assert (again.environment, again.meta) == (show.environment, show.meta)
    np.testing.assert_allclose(again.homes, show.homes)
    np.testing.assert_allclose(again.landings, show.landings)
    assert again.duration == show.duration
    t = np.linspace(0.0, show.duration, 301)
    for i in range(show.n_drones):
        np.testing.assert_allclose(
            evaluate_positions(again.trajectory(i), t), evaluate_positions(show.trajectory(i), t), atol=1e-5
        )
    t = np.arange(0.0, show.duration, 0.013)
    np.testing.assert_allclose(again.lights.colors(t), show.lights.colors(t), atol=1e-4)
    save_show(again, tmp_path / "third.skyc")
    third = load_show(tmp_path / "third.skyc")
    np.testing.assert_allclose(third.trajectories.coefficients, again.trajectories.coefficients, atol=1e-5)


def test_saved_files_have_the_structure_of_skybrush(tmp_path):
    save_show(parse_show(skyc_files.pack_archive(skyc_files.create_lab_show())), tmp_path / "a.skyc")
    with zipfile.ZipFile(tmp_path / "a.skyc") as file:
        names = set(file.namelist())
        written = {name: json.loads(file.read(name)) for name in names}
    assert names == set(skyc_files.create_lab_show())
    before = skyc_files.create_lab_show()
    assert written["cues.json"]["version"] == 1
    assert (
        written["show.json"]["swarm"]["drones"][0]["settings"]
        == (before["show.json"]["swarm"]["drones"][0]["settings"])
    )
    trajectory = written["drones/drone_0/trajectory.json"]
    assert {key: trajectory[key] for key in ("version", "takeoffTime", "landingTime", "type")} == {
        "version": 1, "takeoffTime": 0.0, "landingTime": 4.5, "type": "COMPRESSED",
    }  # fmt: skip
    assert [len(point[2]) for point in trajectory["points"]] == [0, 0, 2, 6]
    assert trajectory["points"][0][0] == 0
    assert [point[0] for point in trajectory["points"]] == [0.0, 1.0, 3.0, 4.5]


TRAJECTORY = "drones/drone_0/trajectory.json"
WRONG_VALUES = {
    "unknown version of the show": ("show.json", ["version"], 2, "version 1"),
    "no drones": ("show.json", ["swarm", "drones"], [], "at least one drone"),
    "drone without trajectory": ("show.json", ["swarm", "drones", 0, "settings", "trajectory"], None, "object"),
    "missing file": (
        "show.json", ["swarm", "drones", 0, "settings", "trajectory", "$ref"], "./nowhere.json#", "nowhere.json",
    ),
    "circle of references": ("cues.json", [], {"$ref": "./cues.json"}, "chain"),
    "one name twice": ("show.json", ["swarm", "drones", 0, "settings", "name"], "cf1", "different names"),
    "unknown version of a trajectory": (TRAJECTORY, ["version"], 2, "version 1"),
    "unknown type": (TRAJECTORY, ["type"], "SPLINE", "COMPRESSED"),
    "no points": (TRAJECTORY, ["points"], [], "at least one point"),
    "overlap": (TRAJECTORY, ["points", 2, 0], 0.5, "ascend"),
    "piece without length": (TRAJECTORY, ["points", 2, 0], 1.0, "ascend"),
    "gap": (TRAJECTORY, ["points", 1], [1.0], "control points"),
    "missing coordinate": (TRAJECTORY, ["points", 1, 1], [0.0, 0.0, 1.0], "array of 4 numbers"),
    "degree above 7": (TRAJECTORY, ["points", 1, 2], [[0.0] * 4] * 7, "at most 6"),
    "control points of the first point": (TRAJECTORY, ["points", 0, 2], [[0.0] * 4], "no control points"),
    "not a number": (TRAJECTORY, ["points", 1, 1, 0], "1", "number"),
    "NaN": (TRAJECTORY, ["points", 1, 1, 0], float("nan"), "number"),
    "infinite": (TRAJECTORY, ["points", 1, 1, 0], float("inf"), "number"),
    "late": (TRAJECTORY, ["points", 3, 0], 1e9, "number from 0 to 7200"),
    "negative time": (TRAJECTORY, ["takeoffTime"], -1.0, "number from 0"),
    "lights that are no base64": ("drones/drone_0/lights.json", ["data"], "?", "base64"),
    "lights of another version": ("drones/drone_0/lights.json", ["version"], 7, "version 1"),
    "infinite parameter": (
        "show.json", ["swarm", "drones", 0, "settings", "parameters"], [[0.5, "health.motorPWM", float("inf")]],
        "a finite number",
    ),
    "cue without time": ("cues.json", ["items", 0, "time"], None, "number"),
    "environment": ("show.json", ["environment", "type"], "space", "indoor"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "path", "value", "message"), WRONG_VALUES.values(), ids=WRONG_VALUES)
def test_wrong_shows_are_refused_with_the_place(name, path, value, message):
    files = skyc_files.create_lab_show()
    files = skyc_files.replace_value(files, name, path, value) if path else files | {name: value}
    with pytest.raises(ConfigError, match=message) as refused:
        parse_show(skyc_files.pack_archive(files), "my.skyc")
    assert "my.skyc" in str(refused.value)


@pytest.mark.parametrize("content, remedy", [
    (b"", "zip archive"),
    (b"no zip", "zip archive"),
    (skyc_files.pack_archive(skyc_files.create_lab_show())[:-40], "zip archive"),
    (skyc_files.pack_archive({"cues.json": "{}"}), r"show\.json"),
    (skyc_files.pack_archive({"show.json": "{"}), "JSON"),
    (skyc_files.pack_archive({"show.json": b"[" * 10**6}), "JSON"),
])  # fmt: skip
def test_files_that_are_no_shows(content, remedy):
    with pytest.raises(ConfigError, match=remedy):
        parse_show(content)


def test_names_that_are_no_shows(tmp_path):
    for path in (tmp_path / "nowhere.skyc", tmp_path):
        with pytest.raises(ConfigError, match="existing file"):
            load_show(path)
    with pytest.raises(ConfigError, match=r"\.skyc"):
        save_show(parse_show(skyc_files.pack_archive(skyc_files.create_lab_show())), tmp_path / "show.zip")


def test_archives_that_decompress_to_too_much_are_refused():
    zeros = b"0" * (17 * 2**20)
    with pytest.raises(ConfigError, match="at most 16777216 bytes"):
        parse_show(skyc_files.pack_archive({"show.json": zeros}))
    bomb = skyc_files.pack_archive({"show.json": zeros * 8})
    tracemalloc.start()
    with pytest.raises(ConfigError, match="at most 16777216 bytes"):
        parse_show(bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 2**24  # not the whole of it
    small = Archive(skyc_files.pack_archive({f"{k}": b'"' + b"0" * 2**24 + b'"' for k in range(5)}), "small.skyc")
    with pytest.raises(ConfigError, match="at most 16777216 bytes, 67108864 in all"):
        [small.json(f"{k}") for k in range(5)]
    wrong_sizes = bytearray(skyc_files.pack_archive({"show.json": zeros}))
    for signature, offset in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):  # both state a size of 10 bytes
        start = wrong_sizes.index(signature) + offset
        wrong_sizes[start : start + 4] = (10).to_bytes(4, "little")
    with pytest.raises(ConfigError):
        parse_show(bytes(wrong_sizes))
    points = [[k / 100, [0, 0, 0], []] for k in range(20_001)]
    with pytest.raises(ConfigError, match="at most 20000 entries"):
        parse_show(
            skyc_files.pack_archive(
                skyc_files.replace_value(skyc_files.create_lab_show(), TRAJECTORY, ["points"], points)
            )
        )
    with pytest.raises(ConfigError, match="at most 20100 files"):
        Archive(skyc_files.pack_archive({f"{k}": b"" for k in range(20_101)}), "many.skyc")
    # One long trajectory would pad those of all other drones.
    many = skyc_files.create_lab_show(1)
    drone = many["show.json"]["swarm"]["drones"][0]
    many["show.json"]["swarm"]["drones"] = [copy.deepcopy(drone) for _ in range(301)]
    for i, other in enumerate(many["show.json"]["swarm"]["drones"]):
        other["settings"]["name"] = f"cf{i}"
    many[TRAJECTORY]["points"] = [[k / 100, [0, 0, 0, 0], []] for k in range(7000)]
    with pytest.raises(ConfigError, match="padded to the longest"):
        parse_show(skyc_files.pack_archive(many))


SAMPLES = {name: skyc_files.pack_archive(create_files()) for name, create_files in skyc_files.SHOW_CREATORS.items()}
JUNK = st.sampled_from(
    [None, True, -1, 0, 1e308, float("nan"), "", "x", [], [[]], {}, {"$ref": "./show.json"}, 10**400]
)


def load_or_refuse(content):
    try:
        show = parse_show(content)
    except ConfigError:
        return
    assert isinstance(show, Show)
    assert np.all(np.isfinite(show.trajectories.coefficients))
    assert np.all(np.diff(show.trajectories.ends, prepend=0.0, axis=1) >= 0)
    assert np.all(np.isfinite(show.lights.colors([0.0, 1.0])))


@settings(max_examples=150)
@given(
    name=st.sampled_from(sorted(SAMPLES)),
    changes=st.lists(st.tuples(st.integers(0, 4000), st.integers(0, 255)), min_size=1, max_size=8),
    cut=st.one_of(st.none(), st.integers(0, 4000)),
)
def test_damaged_archives_are_loaded_or_refused(name, changes, cut):
    content = bytearray(SAMPLES[name])
    for k, value in changes:
        content[k % len(content)] = value
    load_or_refuse(bytes(content[:cut]))


def list_paths(value, path=()):
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in items:
        yield from list_paths(child, (*path, key))


@settings(max_examples=200)
@given(
    name=st.sampled_from(sorted(skyc_files.SHOW_CREATORS)), seed=st.integers(0, 10**6), value=JUNK, remove=st.booleans()
)
def test_mutated_json_is_loaded_or_refused(name, seed, value, remove):
    files = copy.deepcopy(skyc_files.SHOW_CREATORS[name]())
    for tables in files.values():
        tables.pop("K", None)
    rng = random.Random(seed)
    member = rng.choice(sorted(files))
    path = rng.choice([path for path in list_paths(files[member]) if path])
    holder = files[member]
    for key in path[:-1]:
        holder = holder[key]
    if remove:
        del holder[path[-1]]
    else:
        holder[path[-1]] = value
    load_or_refuse(skyc_files.pack_archive(files))
