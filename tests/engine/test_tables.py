"""Tables: shared arrays and constants that stages read from memory at computed indices, in every engine."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import PyTree, Sim, leaf, stage
from crazysim.engine import Step
from crazysim.engine.backends import cuda, interpret, kernel
from crazysim.engine.ir.listing import list_program
from crazysim.engine.ir.verify import verify
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.optimise import optimise
from crazysim.engine.stage import as_stages
from crazysim.errors import EngineWarning

RNG = np.random.default_rng(0)
CONSTANTS = RNG.normal(size=(11, 2, 3)).astype(np.float32)
CONSTANTS[:, 1, 2] = 0.25
DESCENDING_NUMBERS = np.arange(70, dtype=np.int32)[::-1].copy()
N_WORLDS, N_DRONES = 13, 2


class Tables(PyTree):
    """Shared arrays, and indices of every drone, some of which are out of range."""

    numbers: jax.Array = leaf("shared", 3)
    """Table of numbers. (9, 5, 4)"""
    ends: jax.Array = leaf("shared", 1)
    """Table of numbers. (100,)"""
    integers: jax.Array = leaf("shared", 1)
    """Table of integers. (20,)"""
    flags: jax.Array = leaf("shared", 1)
    """Table of bools. (12,)"""
    places: jax.Array = leaf("drone", 1)
    """Indices into the tables. (n_worlds, n_drones, 3)"""
    out: jax.Array = leaf("drone", 1)
    """Elements that a case reads, filled with zeros. (n_worlds, n_drones, 8)"""


def bisection(x, value):
    """Return the last index at which an ascending array is below a value, by bisection in a loop."""

    def halve(_, bounds):
        low, high = bounds
        middle = (low + high) // 2
        is_below = x[middle] < value
        return jnp.where(is_below, middle, low), jnp.where(is_below, high, middle)

    low, _ = jax.lax.fori_loop(0, 7, halve, (jnp.int32(0), jnp.int32(len(x))))
    return low.astype(jnp.float32)


CASES = {
    "an entry": lambda t, i, j, k: t.ends[i],
    "an entry of three axes": lambda t, i, j, k: t.numbers[i, j, k],
    "a row": lambda t, i, j, k: t.numbers[i, j],
    "a matrix, then a row of it": lambda t, i, j, k: t.numbers[i][j],
    "a record of one, then a piece": lambda t, i, j, k: jax.tree.map(lambda x: x[i], t.numbers)[:, 1][j],
    "along the last axis": lambda t, i, j, k: t.numbers[..., k][2, :3],
    "a known and a computed place": lambda t, i, j, k: t.numbers[i, 3],
    "part of a table": lambda t, i, j, k: t.ends[3:97:2][i],
    "a table turned around": lambda t, i, j, k: t.ends[::-1][i],
    "a transposed table": lambda t, i, j, k: t.numbers.T[k, j],
    "a table in another shape": lambda t, i, j, k: t.numbers.reshape(45, 4)[i],
    "filled outside": lambda t, i, j, k: t.numbers.at[i, j].get(mode="fill", fill_value=7.0),
    "clipped": lambda t, i, j, k: t.numbers.at[i, j].get(mode="clip"),
    "a slice": lambda t, i, j, k: jax.lax.dynamic_slice(t.ends, (i,), (4,)),
    "a corner": lambda t, i, j, k: jax.lax.dynamic_slice(t.numbers, (i, j, k), (2, 1, 2)).ravel(),
    "several places": lambda t, i, j, k: t.ends[jnp.stack([i, j, i + j])],
    "several at once": lambda t, i, j, k: jax.vmap(lambda a: t.numbers[a, j, 1])(jnp.stack([i, k])),
    "places from a table": lambda t, i, j, k: t.ends[t.integers[i]],
    "truth values": lambda t, i, j, k: jnp.where(t.flags[i], 1.0, 2.0),
    "integers": lambda t, i, j, k: t.integers[i].astype(jnp.float32),
    "unsigned places": lambda t, i, j, k: t.ends[i.astype(jnp.uint32)],
    "small places": lambda t, i, j, k: t.ends[i.astype(jnp.int8)],
    "constants": lambda t, i, j, k: jnp.asarray(CONSTANTS)[i, :, 1:].ravel(),
    "more constants than can be selected": lambda t, i, j, k: jnp.asarray(DESCENDING_NUMBERS)[i].astype(jnp.float32),
    "in a branch": lambda t, i, j, k: jax.lax.cond(i > 2, lambda: t.ends[i], lambda: t.ends[j]),
    "in a loop": lambda t, i, j, k: jax.lax.fori_loop(0, 7, lambda n, x: x + t.ends[n + i], 0.0),
    "a bisection": lambda t, i, j, k: bisection(jnp.asarray(DESCENDING_NUMBERS)[::-1] * 0.5, i * 0.3),
    "a search in constants": lambda t, i, j, k: jnp.searchsorted(jnp.asarray(DESCENDING_NUMBERS)[::-1] * 0.5, i * 0.3),
    "a search in a table": lambda t, i, j, k: t.ends[jnp.searchsorted(t.ends[::-1], i * 0.3, side="right")],
}
"""Functions of the tables and of three indices of a drone."""


KERNEL_CASES = [name for name in CASES if name != "small places"]
"""Cases that kernels, which have no integers of 8 bits, can run."""


@functools.cache
def make_data():
    sim = Sim(n_worlds=N_WORLDS, n_drones=N_DRONES, control="rotor_vel")
    places = RNG.integers(-3, 12, (N_WORLDS, N_DRONES, 3))
    places[0] = [[2**31 - 1, -(2**31), 100], [99, -100, 5]]
    tables = Tables(
        np.float32(RNG.normal(size=(9, 5, 4))),
        np.float32(RNG.normal(size=100)),
        RNG.integers(-5, 120, 20).astype(np.int32),
        RNG.integers(0, 2, 12).astype(bool),
        places.astype(np.int32),
        np.zeros((N_WORLDS, N_DRONES, 8), np.float32),
    )
    return sim.data.replace(plugins={"tables": tables})


def case_stage(name, scope="drone"):
    def read_case(tables, places):
        result = jnp.ravel(CASES[name](tables, *places))[:8]
        return jnp.pad(result.astype(jnp.float32), (0, 8 - len(result)))

    @stage(scope, when=lambda data: data.core.steps % 2 == 0)
    def read(data):
        tables = data.plugins["tables"]
        read_drone = functools.partial(read_case, tables)
        out = read_drone(tables.places) if scope == "drone" else jnp.stack([read_drone(p) for p in tables.places])
        return data.replace(plugins={"tables": tables.replace(out=out)})

    return read


def sum_stage(names, scope="drone"):
    @stage(scope)
    def total(data):
        tables = data.plugins["tables"]
        summed = 0.0
        for n, name in enumerate(names):
            summed = summed + case_stage(name, scope).fn(data).plugins["tables"].out * 0.9**n
        return data.replace(plugins={"tables": tables.replace(out=summed)})

    return total


def make_pipeline(names, scope="drone"):
    return {name: case_stage(name, scope) for name in names}


WORLD_CASES = ["a matrix, then a row of it", "constants", "places from a table"]
"""Cases that are also tested in a stage of one world."""


@pytest.mark.parametrize(("scope", "names"), [("drone", list(CASES)), ("world", WORLD_CASES)])
def test_a_lowered_stage_reads_the_same_elements_as_the_stage(scope, names):
    def read_all(data):
        return {name: read(data).plugins["tables"].out for name, read in make_pipeline(names, scope).items()}

    for name, expected in jax.jit(read_all)(make_data()).items():
        program = optimise(lower_stages(as_stages(make_pipeline([name], scope)), make_data()))
        verify(program)
        assert program.fused, program.unfused_stages[0].explanation
        leaves = jax.tree.leaves(make_data())
        (out,), _ = interpret.run_steps(program, [*leaves, pack_leaves(program, leaves)], 1)
        np.testing.assert_array_equal(out, expected, err_msg=name)


@pytest.mark.parametrize(("scope", "names"), [("drone", KERNEL_CASES), ("world", WORLD_CASES)])
def test_a_kernel_reads_the_same_elements_as_the_stage(scope, names):
    total = sum_stage(names, scope)
    result = Step({"total": total})(make_data(), jnp.int32(1)).plugins["tables"].out
    np.testing.assert_allclose(result, jax.jit(total)(make_data()).plugins["tables"].out, rtol=1e-5, atol=1e-3)


def pack_leaves(program, leaves):
    return np.concatenate([np.ravel(leaves[i]) for i in program.packed]) if program.packed else np.zeros(0)


def test_a_table_is_read_where_it_is_and_never_selected_from():
    program = optimise(lower_stages(as_stages(make_pipeline(["a matrix, then a row of it"])), make_data()))
    (segment,) = program.fused_segments
    names = [op.name for op in segment.block.walk()]
    assert names.count("lookup") == 4
    assert names.count("select_n") < 4
    assert "float32[180] = plugins['tables'].numbers[:]" in list_program(program)
    assert "lookup(" in list_program(program)
    assert not program.packed


def test_the_source_for_gpus_is_well_formed():
    """One kernel has all cases; NVRTC compiles it if it is installed."""
    program = optimise(lower_stages(as_stages({"total": sum_stage(KERNEL_CASES)}), make_data()))
    text = kernel.write_kernel(program, "cuda").text
    assert "TABLE f32 t" in text
    assert text.count("lookup(p") > 20
    assert "lookup_four(p" in text
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here")
    assert cuda.compile_source(text, cuda.DEFAULT_ARCHITECTURE, "PTX")


def test_gradients_by_states_and_entries_are_those_of_the_stage():
    @stage("drone")
    def read(data):
        tables, vel = data.plugins["tables"], data.states.vel
        row = tables.numbers[tables.places[0], tables.places[1]]
        return data.replace(states=data.states.replace(vel=vel * row[:3] + row[3]))

    def loss(step, numbers, vel):
        tables = make_data().plugins["tables"].replace(numbers=numbers)
        start = make_data().replace(plugins={"tables": tables}, states=make_data().states.replace(vel=vel))
        return jnp.sum(step(start, 2).states.vel ** 2)

    numbers, vel = make_data().plugins["tables"].numbers, make_data().states.vel + jnp.asarray([1.0, 2.0, 3.0])
    with pytest.warns(EngineWarning, match="read as a table"):
        result = jax.grad(functools.partial(loss, Step({"read": read})), argnums=(0, 1))(numbers, vel)
    expected = jax.grad(functools.partial(loss, lambda data, _: read(read(data))), argnums=(0, 1))(numbers, vel)
    for a, b in zip(result, expected, strict=True):
        assert float(jnp.abs(b).max()) > 0.1
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


def test_another_table_of_the_same_shape_is_not_compiled_again():
    step = Step(make_pipeline(["a row"]), "auto")
    before = step(make_data(), jnp.int32(1)).plugins["tables"].out
    tables = make_data().plugins["tables"]
    other = make_data().replace(plugins={"tables": tables.replace(numbers=2 * tables.numbers)})
    np.testing.assert_array_equal(step(other, jnp.int32(1)).plugins["tables"].out, 2 * before)
    assert step.plan(other) is step.plan(make_data())
