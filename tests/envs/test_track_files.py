"""Race tracks from YAML files."""

import random

import numpy as np
import pytest
import yaml

from crazysim import ConfigError
from crazysim.envs import Track, gates_of_track, load_track, track_names

FILE = """
initState: { pos: [0, 0, 1], vel: [0, 0, 0] }
endState: { pos: [9, 0, 1] }
orders: ['B', 'A', 'B']
A: { type: 'SingleBall', position: [4, 1, 2], radius: 0.5, margin: 0.2 }
B: { type: 'RectanglePrisma', position: [3, 0, 2], rpy: [0, -90, 90], width: 2, height: 1, marginW: 0.4, marginH: 0.2 }
"""


def test_a_track_has_its_gates_in_their_order_with_directions_and_margins(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(FILE, encoding="utf-8")
    track = load_track(path)
    gates = gates_of_track(track)
    np.testing.assert_array_equal([gate.pos for gate in gates], [(3, 0, 2), (4, 1, 2), (3, 0, 2)])
    # TOGT's z axis points backwards: at -90 degrees of pitch and 90 of yaw a drone flies along y, and up is z.
    np.testing.assert_allclose(gates[0].rot, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(gates[0].size, (1.6, 0.8))
    np.testing.assert_allclose(np.ptp(gates[0].frame, axis=0), (2.0, 1.0))
    assert gates[1].is_ball
    assert float(gates[1].opening) == 0.4
    assert (track.start, track.finish) == ((0, 0, 1), (9, 0, 1))
    assert track.low[2] == 0


def test_built_in_tracks_are_those_of_their_sources():
    """Three laps of seven points on UZH's Split-S track, without the last two."""
    assert track_names() == ("lsy_drone_racing", "split_s_gates", "split_s_shapes", "split_s_waypoints")
    assert load_track("lsy_drone_racing") == Track()
    tracks = {name: load_track(name) for name in track_names()[1:]}
    assert [track.n_gates for track in tracks.values()] == [19, 7, 19]
    for track in tracks.values():
        assert track.start == (-5.0, 4.5, 1.2)
        assert track.finish == (4.75, -0.9, 1.2)
    corners = {len(np.atleast_1d(gate.opening)) for gate in gates_of_track(tracks["split_s_shapes"])}
    assert corners == {1, 3, 4, 5, 6}


def test_half_planes_bound_a_triangle_in_either_order_of_its_corners():
    gate = gates_of_track(load_track("split_s_shapes"))[0]
    for corners in (gate.opening, gate.opening[::-1]):
        planes = type(gate)(gate.pos, gate.rot, corners, corners, 0.0).half_planes
        inside = lambda point, planes=planes: bool(np.all(planes[:, :2] @ point < planes[:, 2]))  # noqa: E731
        assert [inside(np.array(p)) for p in ((0, 0), (0.55, 0), (0.65, 0), (1.1, -1.15), (0, -1.3), (0, 1.1))] == [
            True, True, False, True, False, True,
        ]  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("orders", "order", "gates in 'orders'"),
        ("['B', 'A', 'B']", "B", "gates in 'orders'"),
        ("['B', 'A', 'B']", "[]", "gates in 'orders'"),
        ("['B', 'A', 'B']", "[[A]]", "gates in 'orders'"),
        ("'A', ", "'C', ", "'C' in mine.yaml as a table, got .*'A'"),
        ("initState", "start", "'initState' in mine.yaml as a table"),
        ("pos: [9, 0, 1]", "pos: [9, 0]", r"pos of endState of shape \(3,\), got \(2,\)"),
        ("RectanglePrisma", "Ring", "'B' in mine.yaml of type SingleBall, RectanglePrisma"),
        ("radius", "size", "keys type, position, radius, margin of 'A' in mine.yaml, got size"),
        ("width", "widht", "position, width, height, marginW, marginH of 'B' in mine.yaml, got .*widht"),
        ("rpy", "rpz", "of 'B' in mine.yaml, got .*rpz"),
        ("margin: 0.2", "margin: 0.2, rpy: [0, 0, 0]", "of 'A' in mine.yaml, got .*rpy"),
        ("width: 2", "width: wide", "width of 'B' as a number, got 'wide'"),
        ("width: 2", "width: [2, 2]", "width of 'B' of shape"),
        ("width: 2", "width: -2", "width of 'B' to be from"),
        ("width: 2", "width: .nan", "width of 'B' to be from"),
        ("marginH: 0.2", "marginH: 1.0", "margin of 'B' in mine.yaml that leaves an opening, got 'height: 0'"),
        ("position: [3, 0, 2]", "position: [3, 0]", r"position of 'B' of shape \(3,\), got \(2,\)"),
        ("rpy: [0, -90, 90]", "rpy: 90", "rpy of 'B' of shape"),
        ("pos: [0, 0, 1]", "pos: [0, [", "YAML"),
        ("pos: [0, 0, 1]", "pos: 2026-99-99", "YAML"),
    ],
)
def test_law_09_a_wrong_track_file_is_named(tmp_path, old, new, words):
    path = tmp_path / "mine.yaml"
    assert old in FILE
    path.write_text(FILE.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=words):
        load_track(path)
    with pytest.raises(ConfigError, match=r"one of lsy_drone_racing.*got 'nowhere'"):
        load_track("nowhere")


ODD_VALUES = (
    None,
    True,
    "1",
    "A",
    -1,
    0,
    1e300,
    float("nan"),
    [],
    [1, 2],
    ["A"],
    [[0, 0, 1]],
    {},
    {"type": "A"},
    2**70,
)


def mutate(tables, rng):
    """Replace, remove or rename one entry of a random table or list, or replace everything."""
    places = [tables]
    for place in places:
        values = place.values() if isinstance(place, dict) else place
        places += [value for value in values if isinstance(value, (dict, list)) and value]
    place = rng.choice(places)
    key = rng.choice(list(place) if isinstance(place, dict) else range(len(place)))
    change = rng.randrange(4)
    if change == 0:
        return rng.choice(ODD_VALUES) if rng.random() < 0.05 else tables
    if change == 1:
        del place[key]
    elif change == 2 and isinstance(place, dict):
        place[rng.choice([f"{key}s", 1, None, ""])] = place.pop(key)
    else:
        place[key] = rng.choice(ODD_VALUES)
    return tables


def read(path):
    try:
        return load_track(path)
    except ConfigError as error:
        return str(error)


def test_law_09_a_file_with_any_wrong_entry_is_refused_or_a_track(tmp_path):
    """Every error is ours, and what is no error has finite gates with an area."""
    rng, path, n_refused = random.Random(0), tmp_path / "mine.yaml", 0
    for k in range(600):
        tables = yaml.safe_load(FILE)
        for _ in range(1 + k % 3):
            tables = mutate(tables, rng) if isinstance(tables, dict) and tables else tables
        path.write_text(yaml.safe_dump(tables), encoding="utf-8")
        track = read(path)
        if isinstance(track, str):
            assert "mine.yaml" in track
            n_refused += 1
            continue
        for gate in gates_of_track(track):
            assert np.isfinite(np.concatenate([gate.pos, gate.rot.ravel()])).all()
            assert np.all(gate.size > 0)
    assert 300 < n_refused < 590
