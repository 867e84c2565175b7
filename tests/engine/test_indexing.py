"""Reads and writes at known and computed indices have the same results on every engine as on ``plain``."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fuzz import Case, Fuzzer
from programs import Program

from crazysim import PyTree, Sim, leaf
from crazysim.engine import Step
from crazysim.engine.stage import stage
from crazysim.errors import EngineWarning


@pytest.fixture(scope="module")
def sim():
    return Sim(n_worlds=2, n_drones=2, control="rotor_vel")


@pytest.fixture(scope="module")
def fuzzer():
    return Fuzzer(0)


class Results(PyTree):
    rows: jax.Array = leaf("drone", 2)
    """A vector for each function. (n_worlds, n_drones, k, 3)"""


WRITES = [
    (lambda x, k: (x + 1).at[:2].apply(lambda v: 2 * v), [2, 2, 1]),
    (lambda x, k: (x + 1).at[2].apply(lambda v: 2 * v), [1, 1, 2]),
    (lambda x, k: (x + 1).at[k + 1].apply(lambda v: 3 * v), [1, 3, 1]),
    (lambda x, k: (x + 1).at[jnp.array([0, 0])].apply(lambda v: 2 * v), [4, 1, 1]),
    (lambda x, k: x.at[2].set(k + 5.0), [0, 0, 5]),
    (lambda x, k: x.at[2].add(k + 5.0), [0, 0, 5]),
    (lambda x, k: x.at[k + 1].set(k + 5.0), [0, 5, 0]),
    (lambda x, k: x.at[k + 3].set(k + 5.0), [0, 0, 0]),
    (lambda x, k: x.at[k + 3].set(k + 5.0, mode="clip"), [0, 0, 5]),
    (lambda x, k: x.at[k - 1].set(k + 5.0), [0, 0, 5]),
    (lambda x, k: x.at[jnp.array([0, 1])].set(x[:2] + 4 + k), [4, 4, 0]),
    (lambda x, k: (x + 3).at[jnp.array([0, 0])].min(jnp.array([2.0, 1.0]) + k), [1, 3, 3]),
]
"""Functions of a zero vector ``x`` and of the step count ``k``, which is 0, and their results."""


def test_updates_at_indices_equal_those_of_plain(sim):
    @stage("drone")
    def write(data):
        rows = [fn(jnp.zeros_like(data.states.pos), data.core.steps) for fn, _ in WRITES]
        return data.replace(plugins={"written": Results(jnp.stack(rows))})

    expected = np.float32([row for _, row in WRITES])
    data = sim.data.replace(plugins={"written": Results(np.full((2, 2, *expected.shape), -1, np.float32))})
    result = np.asarray(Step({"write": write}, strict=True)(data).plugins["written"].rows)
    for k, row in enumerate(expected):
        np.testing.assert_array_equal(result[:, :, k], np.broadcast_to(row, (2, 2, 3)), err_msg=f"function {k}")


WINDOW = "lax.ScatterDimensionNumbers((1,), (), (0,))"
ROWS = "lax.ScatterDimensionNumbers((0,), (0,), (0,))"
BATCHED = "lax.ScatterDimensionNumbers((), (1,), (1,), (0,), (0,))"
ELEMENTS = "lax.GatherDimensionNumbers((), (1,), (1,), (0,), (0,))"
SLICES = "lax.GatherDimensionNumbers((1,), (), (0,))"
"""Dimension numbers of scatters and gathers, as code of the generated programs."""
MODES = ("clip", "fill", "promise_in_bounds")
INDICES = {"clip": "v1", "fill": "v1", "promise_in_bounds": "jnp.clip(v1, 0, 1)"}

PROGRAMS = {
    **{
        f"windows in mode {mode}, {kind}": (
            ("f4", "i3"),
            f"lax.scatter{kind}(v0, {INDICES[mode]}[:, None], v0[:3, None] * jnp.ones(2), {WINDOW}, mode={mode!r})",
        )
        for mode in MODES
        for kind in (("", "_add", "_sub", "_mul", "_min", "_max") if mode == "clip" else ("",))
    },
    **{
        f"batched writes in mode {mode}": (
            ("f23", "i3"),
            f"lax.scatter_add(v0, {INDICES[mode]}[:2, None], v0[:, 1], {BATCHED}, mode={mode!r})",
        )
        for mode in MODES
    },
    **{
        f"batched reads in mode {mode}": (
            ("f23", "i3"),
            f"lax.gather(v0, {INDICES[mode]}[:2, None], {ELEMENTS}, (1, 1), mode={mode!r})",
        )
        for mode in MODES
    },
    **{
        f"read windows in mode {mode}": (
            ("f4", "i3"),
            f"lax.gather(v0, {INDICES[mode]}[:, None], {SLICES}, (2,), mode={mode!r}, fill_value=7.0)",
        )
        for mode in MODES
    },
    "a row of windows": (("f33", "i"), f"lax.scatter_mul(v0, v1[None], v0[0], {ROWS}, unique_indices=True)"),
    "sorted and unique": (("f4",), "v0.at[np.array([1, 3])].set(v0[:2], indices_are_sorted=True, unique_indices=True)"),
    "known and computed": (("f33", "i"), "v0.at[v1, np.array([0, 2])].add(1.0)"),
    "known, from the end": (("f4",), "v0.at[np.array([-1, -4, -5, 4])].add(v0)"),
    "a function, by a computed place": (("f33", "i"), "v0.at[:, v1].apply(jnp.sin)"),
    "a function with constants": (
        ("f4", "i3"),
        "v0.at[v1].apply(lambda t: jnp.where(t > 0, jnp.float32(np.pi) * t, 1))",
    ),
    "integers that wrap": (("i3", "u3"), "v0.at[v1].multiply(np.int32(2**30))"),
    "unsigned places": (("f4", "u3"), "v0[v1] + v0.at[v1].get(mode='fill', fill_value=2.0)"),
    "small places": (("f4", "i3"), "v0[v1.astype(np.int8)]"),
    "truth values": (("b3", "i"), "v0.at[v1].set(True) ^ v0.at[v1].max(v0[0])"),
    "an update as long as the axis": (("i23", "i"), "lax.dynamic_update_slice(v0, v0[:1] * 2, [v1] * 2)"),
    "an update of a corner": (("f33", "i3"), "lax.dynamic_update_slice(v0, v0[:1, :2] * 2, [v1[0], v1[1]])"),
    "a slice of a corner": (("f33", "u3"), "lax.dynamic_slice(v0, [v1[0], v1[1]], (2, 1))"),
    "along an axis": (("f33",), "jnp.take_along_axis(v0, jnp.argsort(v0, 0), 0)"),
    "keys": (("i3", "i"), "jax.random.key_data(jax.random.split(jax.random.key(v0[0]), 3)[v1])"),
}
"""Inputs and the line of a program, by the tested case. Inputs are those of ``fuzz``: ``f23`` is float32, (2, 3)."""


def test_windows_batches_and_modes(fuzzer):
    cases = [Case(Program(inputs, (line,)), "drone") for inputs, line in PROGRAMS.values()]
    findings = list(fuzzer.check(cases))
    assert not findings, "\n".join(map(str, findings))
    assert not fuzzer.counts["refused"]
    assert fuzzer.counts["compared on lanes"] == len(cases)


def test_too_many_places_are_refused_when_the_step_is_planned(sim):
    @stage("drone")
    def write(data):
        row = jnp.zeros(100).at[data.core.steps].set(1.0)
        return data.replace(states=data.states.replace(vel=row[:3]))

    with pytest.warns(EngineWarning, match="stage 'write' is not fused: .* has 100 possible values"):
        Step({"write": write}, "lanes").plan(sim.data)
