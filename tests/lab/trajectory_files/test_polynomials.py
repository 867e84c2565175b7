"""The Crazyflie's trajectory memory and CSV, against bytes and rows by hand, written and read back."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from crazysim.errors import ConfigError
from crazysim.lab.show_files.show_trajectory import format_trajectory
from crazysim.lab.trajectory_files.csv import POLYNOMIAL_HEADER
from crazysim.lab.trajectory_files.pieces import trajectory_pieces
from crazysim.trajectories import Trajectory, line
from crazysim.trajectories.files import (
    load_csv,
    load_memory,
    pack_compressed,
    pack_poly4d,
    save_csv,
    save_memory,
    save_samples,
    unpack_compressed,
    unpack_poly4d,
)

FIGURE_EIGHT = (
    "1.050000,0.0,-0.0,0.0,-0.0,0.830443,-0.276140,-0.384219,0.180493,-0.0,0.0,-0.0,0.0,-1.356107,0.688430,0.587426,"
    "-0.329106,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0"
)
"""First piece of Bitcraze's public example of a figure eight."""


def random_trajectory(seed=0, n=4, degree=7, size=0.5):
    rng = np.random.default_rng(seed)
    c = size * rng.normal(size=(n, 4, degree + 1)) / np.arange(1, degree + 2)
    for k in range(1, n):  # continuous
        c[k, :, 0] = c[k - 1].sum(-1)
    lengths = rng.integers(300, 3000, n) / 1000
    return Trajectory.of_pieces(lengths, c / lengths[:, None, None] ** np.arange(degree + 1))


def check_same(a, b, atol):
    (ends, c), (other_ends, d) = trajectory_pieces(a), trajectory_pieces(b)
    np.testing.assert_allclose(ends, other_ends, atol=1e-6)
    u = np.linspace(0, 1, 11)
    u_column = u[:, None, None, None]
    np.testing.assert_allclose(
        (c * u_column ** np.arange(c.shape[2])).sum(-1), (d * u_column ** np.arange(d.shape[2])).sum(-1), atol=atol
    )


def test_poly4d_is_33_floats_with_the_duration_last():
    axes = np.arange(32.0).reshape(4, 8)
    content = pack_poly4d(Trajectory.of_pieces([2.0], axes[None]))
    expected = b"".join(struct.pack("<ffffffff", *axis) for axis in axes) + struct.pack("<f", 2.0)
    assert content == expected
    check_same(unpack_poly4d(content), Trajectory.of_pieces([2.0], axes[None]), 1e-3)


def test_poly4d_and_csv_are_read_back(tmp_path):
    t = random_trajectory()
    check_same(unpack_poly4d(pack_poly4d(t)), t, 1e-5)
    save_memory(t, tmp_path / "a.bin")
    check_same(load_memory(tmp_path / "a.bin"), t, 1e-5)
    save_csv(t, tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == POLYNOMIAL_HEADER
    check_same(load_csv(tmp_path / "a.csv"), t, 1e-5)


def test_compressed_bytes_by_hand():
    """A start, a straight piece in x with a quarter turn, and a cubic piece in z, as cflib packs them."""
    c = np.zeros((2, 4, 4))
    c[0, :, 0] = 1.0, -2.0, 0.5, 0.0
    c[0, 0, 1], c[0, 3, 1] = 0.25, np.pi / 2
    c[1, :, 0] = 1.25, -2.0, 0.5, np.pi / 2
    c[1, 2, 2:] = 3.0, -2.0
    lengths = np.array([1.5, 2.0])
    t = Trajectory.of_pieces(lengths, c / lengths[:, None, None] ** np.arange(4))
    content = pack_compressed(t)
    expected = struct.pack("<hhhh", 1000, -2000, 500, 0)
    expected += struct.pack("<BH", 1 | 1 << 6, 1500) + struct.pack("<hh", 1250, 900)
    expected += struct.pack("<BH", 2 << 4, 2000) + struct.pack("<hhh", 500, 1500, 1500)
    expected += bytes(3)
    assert content == expected
    check_same(unpack_compressed(content), t, 1e-6)


def test_compressed_trajectories_are_read_back(tmp_path):
    t = random_trajectory(seed=1)
    check_same(unpack_compressed(pack_compressed(t)), t, 2e-3)
    save_memory(t, tmp_path / "a.bin", compressed=True)
    check_same(load_memory(tmp_path / "a.bin", compressed=True), t, 2e-3)
    assert len(pack_compressed(t)) < len(pack_poly4d(t))


def test_long_pieces_are_split():
    c = np.zeros((1, 4, 2))
    c[0, 0, 1] = 0.1
    t = Trajectory.of_pieces([150.0], c)
    restored = unpack_compressed(pack_compressed(t))
    np.testing.assert_allclose(trajectory_pieces(restored)[0], [65.0, 130.0, 150.0])
    np.testing.assert_allclose(trajectory_pieces(restored)[1][:, 0].sum(-1), [6.5, 13.0, 15.0], atol=1e-5)


def test_csv_of_crazyswarm_is_read(tmp_path):
    path = tmp_path / "figure8.csv"
    for header in (
        POLYNOMIAL_HEADER,
        "# " + POLYNOMIAL_HEADER,
        POLYNOMIAL_HEADER.replace("duration", "Duration") + ",",
        "",
    ):
        path.write_text(f"{header}\n{FIGURE_EIGHT}\n{FIGURE_EIGHT},\n\n")
        t = load_csv(path)
        assert t.n_pieces == 2
        assert float(t.duration) == pytest.approx(2.1)
        # By hand: x(0.5) of the first piece.
        x = 0.830443 * 0.5**4 - 0.276140 * 0.5**5 - 0.384219 * 0.5**6 + 0.180493 * 0.5**7
        u = 0.5 / 1.05
        assert np.polyval(np.asarray(t.coefficients[0, 0], float)[::-1], u) == pytest.approx(x, abs=1e-6)
    without_yaw = ",".join(FIGURE_EIGHT.split(",")[:25])
    path.write_text(without_yaw)
    assert load_csv(path).coefficients.shape == (1, 4, 8)


def test_saved_samples_become_a_trajectory(tmp_path):
    times = np.array([5.0, 5.5, 6.5, 7.0])
    pos = np.array([[0, 0, 0], [0, 0, 1], [1, 2, 1], [1, 2, 0.5]], float)
    yaw = np.array([3.0, 3.1, -3.1, -3.0])  # through the half turn
    save_samples(tmp_path / "a.csv", times, pos, yaw)
    ends, c = trajectory_pieces(load_csv(tmp_path / "a.csv"))
    np.testing.assert_allclose(ends, times[1:] - 5, rtol=1e-6)
    values = np.column_stack([pos, np.unwrap(yaw)])
    rates = np.zeros_like(values)
    rates[1:-1] = (values[2:] - values[:-2]) / (times[2:] - times[:-2])[:, None]
    spline = CubicHermiteSpline(times, values, rates)
    np.testing.assert_allclose((c * 0.5 ** np.arange(4)).sum(-1), spline((times[1:] + times[:-1]) / 2), atol=1e-5)
    save_samples(tmp_path / "a.csv", times, pos)
    assert not load_csv(tmp_path / "a.csv").coefficients[:, 3].any()


WRONG_CSV = {
    "empty": ("", "at least one row"),
    "only a header": (POLYNOMIAL_HEADER, "at least one row"),
    "words": ("0,0,0,0\n1,2,x,4", "line 2"),
    "columns": ("1,2,3", "4, 5, 25 or 33 columns"),
    "other columns": ("0,0,0,0\n1,1,1,1,1", "4 columns, as before"),
    "one sample": ("0,0,0,0", "two samples"),
    "times that repeat": ("0,0,0,0\n1,0,0,0\n1,0,0,0", "ascend"),
    "not finite": ("0,0,0,0\n1,0,nan,0", "finite"),
    "large": ("0,0,0,0\n1,0,1e9,0", "up to 100000"),
    "long": ("0,0,0,0\n1e6,0,0,0", "at most 7200 s"),
    "no duration": (FIGURE_EIGHT.replace("1.05", "0.0", 1), "durations of at least"),
    "infinite coefficient": (FIGURE_EIGHT.replace("0.830443", "inf"), "finite"),
    "large coefficient": (FIGURE_EIGHT.replace("0.830443", "1e30"), "coordinates up to"),
}


@pytest.mark.parametrize(("content", "message"), WRONG_CSV.values(), ids=WRONG_CSV)
def test_wrong_csv_files_are_errors(content, message, tmp_path):
    (tmp_path / "a.csv").write_text(content)
    with pytest.raises(ConfigError, match=message):
        load_csv(tmp_path / "a.csv")


@given(st.binary(max_size=300))
def test_any_memory_is_loaded_or_refused(content):
    for unpack in (unpack_poly4d, unpack_compressed):
        try:
            t = unpack(content)
        except ConfigError:
            continue
        assert np.all(np.isfinite(t.coefficients))


cells = st.one_of(st.floats().map(str), st.integers(-9, 9).map(str), st.sampled_from(["", "x", "1e999", "#", "٣"]))


@given(st.lists(st.lists(cells, min_size=1, max_size=6), max_size=6), st.sampled_from(["\n", "\r\n", "\x00"]))
def test_any_csv_is_loaded_or_refused(tmp_path_factory, rows, newline):
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    path.write_text(newline.join(",".join(row) for row in rows))
    try:
        t = load_csv(path)
    except ConfigError:
        return
    assert np.all(np.isfinite(t.coefficients))


def test_a_jump_cannot_be_compressed():
    """A compressed piece begins where the piece before it ends; here the second line begins 3 m further."""
    first, second = (line((x, 0, 1), (x + 1, 0, 1), duration=1.0) for x in (0.0, 4.0))
    with pytest.raises(ConfigError, match="got a jump in x of 3 m at 1 s"):
        pack_compressed(first.then(second))
    with pytest.raises(ConfigError, match="got a jump in x of 3 m at 1 s"):
        format_trajectory(first.then(second))
    turned = first.then(first.moved((1, 0, 0), yaw=np.pi / 2))
    with pytest.raises(ConfigError, match="jump in"):
        pack_compressed(turned)
    pack_compressed(first.then(second.moved((-3, 0, 0))))
    assert len(pack_poly4d(first.then(second))) == 2 * 132
