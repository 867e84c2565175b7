"""Grids: interpolation against SciPy's and by hand, gradients, loaders, and wrong input."""

import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.plugins.effects.grid import interpolate, load_wind_grid


def test_interpolation_is_that_of_numpy_axis_by_axis(rng):
    values, points = rng.normal(size=(4, 5, 3)), rng.uniform(-1, 6, size=(50, 3))
    expected = []
    for p in points:  # linear along x, then y, then z; np.interp is constant outside
        plane = np.apply_along_axis(lambda v, x=p[0]: np.interp(x, np.arange(4), v), 0, values)
        line = np.apply_along_axis(lambda v, y=p[1]: np.interp(y, np.arange(5), v), 0, plane)
        expected.append(np.interp(p[2], np.arange(3), line))
    result = jax.jit(interpolate)(np.float32(values), np.float32(points))
    np.testing.assert_allclose(result, expected, atol=3e-6)  # float32, eight products


def test_law_08_gradients_are_the_slopes_of_the_cell_and_zero_outside(x64, rng):
    values = rng.normal(size=(4, 4, 4))
    value = jax.jit(lambda p: interpolate(jnp.asarray(values), p))
    slope = jax.jit(jax.grad(value))
    for point in rng.uniform(0.1, 0.9, size=(5, 3)) + rng.integers(0, 3, size=(5, 3)):
        h = 1e-6
        central = [float(value(point + h * e) - value(point - h * e)) / (2 * h) for e in np.eye(3)]
        np.testing.assert_allclose(slope(point), central, rtol=1e-7, atol=1e-8)
    np.testing.assert_array_equal(slope(np.array([-1.0, 7.0, 4.0])), 0)


@pytest.mark.parametrize("y", [np.nan, np.inf, -np.inf, 1e30])
def test_law_07_positions_that_are_not_finite_read_no_memory_beyond_the_grid(y):
    result = jax.jit(interpolate)(np.ones((3, 3, 3)), np.array([1.0, y, 1.0]))
    np.testing.assert_array_equal(result, np.nan if np.isnan(y) else 1.0)


def write_flow(path, header, rows):
    path.write_text(header + "\n" + "\n".join(",".join(f"{x:.6g}" for x in row) for row in rows) + "\n")


HEADER = '"U:0","U:1","U:2","p","Points:0","Points:1","Points:2"'


def test_a_csv_of_paraview_is_read_in_any_order(tmp_path, rng):
    axes = np.array([-1.0, -0.5, 0.0]), np.array([2.0, 2.25]), np.array([0.0, 1.0, 2.0, 3.0])
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    velocity = np.round(rng.normal(size=points.shape), 3)
    rows = np.column_stack([velocity, np.zeros(len(points)), points])
    write_flow(tmp_path / "flow.csv", HEADER, rows[rng.permutation(len(rows))])
    grid = load_wind_grid(tmp_path / "flow.csv")
    np.testing.assert_allclose(grid.values, velocity.reshape(3, 2, 4, 3))
    np.testing.assert_allclose([grid.origin, grid.spacing], [[-1, 2, 0], [0.5, 0.25, 1.0]])


@pytest.mark.parametrize("header, n_rows, shift, message", [
    ('"U:0","U:1","U:2","p","Points:0","Points:1","z"', 12, 0, "got none named 'Points:2'"),
    (HEADER, 11, 0, "expected one row for each of the 3 x 2 x 2 nodes"),
    (HEADER, 12, 0.2, "expected nodes at equal distances"),
])  # fmt: skip
def test_a_csv_that_is_no_grid_is_an_error(tmp_path, header, n_rows, shift, message):
    axes = np.array([0.0, 1.0, 2.0 + shift]), np.arange(2.0), np.arange(2.0)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)[:n_rows]
    write_flow(tmp_path / "flow.csv", header, np.column_stack([0 * points, points[:, 0], points]))
    with pytest.raises(ConfigError, match=message):
        load_wind_grid(tmp_path / "flow.csv")


def test_law_09_files_that_are_no_wind_are_errors_before_memory_is_allocated(tmp_path, rng):
    path = tmp_path / "flow.csv"
    for content, message in (
        (None, "expected an existing file"),
        (b"", "got none named 'Points:0'"),
        (b"\x89PNG\xff\xfe", "bytes that are not UTF-8"),
        (HEADER.encode(), "the names of columns only"),
        (f"{HEADER}\n0,0,0,0,a,0,0\n".encode(), "expected numbers in the columns"),
        (f"{HEADER}\n0,0,0,0,nan,0,0\n".encode(), "expected finite numbers"),
    ):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ConfigError, match=message):
            load_wind_grid(path)
    # No two of 700 points share a coordinate: a grid of all coordinates would take 8 GB.
    write_flow(path, HEADER, np.column_stack([np.zeros((700, 4)), rng.uniform(size=(700, 3))]))
    tracemalloc.start()
    with pytest.raises(ConfigError, match=r"one row for each of the 700 x 700 x 700 nodes .* got 700 rows"):
        load_wind_grid(path)
    assert tracemalloc.get_traced_memory()[1] < 10 * 2**20
    tracemalloc.stop()
