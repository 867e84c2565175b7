"""Functions of an index and tables: kernels against XLA and NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.core.branches import any_lane, compute_where, table_row, table_rows
from crazysim.engine.index_map import lower_map, map_indices
from crazysim.errors import UnsupportedError

N = 1003  # not a multiple of a vector's length
PLATFORMS = [None, "cpu"]


@pytest.fixture(scope="module")
def tables():
    rng = np.random.default_rng(3)
    numbers = rng.normal(size=(9, 4)).astype(np.float32)
    return [jnp.asarray(numbers), jnp.asarray(rng.integers(0, 9, (50, 1)), jnp.int32)]


def sum_positive_rows(index, numbers, places):
    """Sum numbers of the rows whose first number is positive, among the first ``index % 10`` rows.

    The number of iterations differs between lanes.
    """
    (place,) = table_rows(places, jax.lax.rem(index, jnp.int32(50)))
    own = table_row(numbers, place)

    def iterate(carry):
        k, total, _ = carry
        row = table_rows(numbers, k)
        return k + 1, compute_where(row[0] > 0, lambda x: x + row[1] * own[2], total), row[3]

    start = jnp.int32(0), jnp.float32(0), jnp.float32(0)
    k, total, last = jax.lax.while_loop(lambda carry: carry[0] < jax.lax.rem(index, jnp.int32(10)), iterate, start)
    return [total, k, last, jax.lax.div(index, jnp.int32(7))]


def compute_by_hand(numbers, places):
    """Return the results of ``sum_positive_rows`` for all indices. (4, N)"""
    out = []
    for i in range(N):
        rows = numbers[: i % 10]
        own = numbers[places[i % 50, 0]]
        out.append((sum(r[1] * own[2] for r in rows if r[0] > 0), len(rows), rows[-1][3] if len(rows) else 0, i // 7))
    return np.array(out).T


@pytest.mark.parametrize("platform", PLATFORMS)
def test_lanes_stop_and_skip_on_their_own(tables, platform):
    result = jax.jit(lambda *tables: map_indices(sum_positive_rows, N, tables, platform))(*tables)
    for x, y in zip(result, compute_by_hand(*map(np.asarray, tables)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("platform", PLATFORMS)
def test_a_batch_of_tables_is_a_batch_of_calls(tables, platform):
    numbers = jnp.stack([tables[0], 2 * tables[0]])
    call = jax.vmap(lambda x: map_indices(sum_positive_rows, N, [x, tables[1]], platform))
    result = jax.jit(call)(numbers)
    assert f"[2,{','.join(map(str, tables[1].shape))}]" not in str(jax.make_jaxpr(call)(numbers)), "it was repeated"
    for k in range(2):
        expected = compute_by_hand(np.asarray(numbers[k]), np.asarray(tables[1]))
        np.testing.assert_allclose(result[0][k], expected[0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("platform", PLATFORMS)
def test_lanes_that_loop_together_agree_with_single_lanes(tables, platform):
    """A row is skipped if no lane needs it, and an initial number that all lanes share differs between lanes later."""

    def fn(index, numbers):
        limit = index.astype(np.float32) / N - 0.5

        def iterate(carry):
            k, count, own = carry
            row = table_rows(numbers, k)
            is_needed = row[0] < limit
            count = compute_where(any_lane(is_needed), lambda n: n + jnp.where(is_needed, 1, 0), count)
            return k + 1, count, own + jax.lax.rem(index, jnp.int32(3))

        start = jnp.int32(0), jnp.int32(0), jnp.int32(0)
        return jax.lax.while_loop(lambda carry: carry[0] < 9, iterate, start)[1:]

    count, own = jax.jit(lambda x: map_indices(fn, N, [x], platform))(tables[0])
    index = np.arange(N)
    limit = index[:, None].astype(np.float32) / np.float32(N) - np.float32(0.5)
    np.testing.assert_array_equal(count, (np.asarray(tables[0])[:, 0] < limit).sum(axis=1))
    np.testing.assert_array_equal(own, 9 * (index % 3))


def test_a_kernel_for_a_gpu_is_compiled_without_one(tables):
    fn = jax.jit(lambda *tables: map_indices(sum_positive_rows, N, tables, "cpu"))
    assert ".visible .entry advance" in fn.trace(*tables).lower(lowering_platforms=("cuda",)).as_text()


def test_only_whole_rows_of_tables_are_read(tables):
    with pytest.raises(UnsupportedError, match="only whole rows are read"):
        lower_map(lambda i, x, _: [jax.lax.dynamic_slice(x, (i, i), (1, 2))[0, 0]], tables)
