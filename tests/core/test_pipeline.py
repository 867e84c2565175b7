"""Pipelines: stages are added, replaced and removed by name, also in the pipelines of a simulation."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim, stage
from crazysim.core.pipeline import (
    append_fn,
    insert_fn_after,
    insert_fn_before,
    prepend_fn,
    remove_fn,
    replace_fn,
)
from crazysim.errors import UnknownNameError


def first(x):
    return x


def second(x):
    return x


def third(x):
    return x


@pytest.fixture
def pipeline():
    return {"first": first, "second": second}


@pytest.mark.parametrize(
    "change, order",
    [
        (lambda p: append_fn(p, third), "first second third"),
        (lambda p: prepend_fn(p, third), "third first second"),
        (lambda p: insert_fn_before(p, "first", third), "third first second"),
        (lambda p: insert_fn_before(p, "second", third), "first third second"),
        (lambda p: insert_fn_after(p, "first", third), "first third second"),
        (lambda p: insert_fn_after(p, "second", third), "first second third"),
        (lambda p: append_fn(p, third, "wind"), "first second wind"),
        (lambda p: append_fn(p, partial(third), name="wind"), "first second wind"),
        (lambda p: append_fn(p, lambda x: x, name="wind"), "first second wind"),
        (lambda p: replace_fn(p, third, "first"), "first second"),
        (lambda p: remove_fn(p, "first"), "second"),
    ],
)
def test_every_change_keeps_the_order_of_the_rest(pipeline, change, order):
    original = pipeline
    assert change(pipeline) is None
    assert " ".join(pipeline) == order
    assert original is pipeline, "changed in place"


@pytest.mark.parametrize(
    "change, error, fragment",
    [
        (lambda p: append_fn(p, first), UnknownNameError, "stage named 'first' already exists"),
        (lambda p: prepend_fn(p, third, "second"), UnknownNameError, "stage named 'second' already exists"),
        (lambda p: insert_fn_before(p, "zeroth", third), UnknownNameError, "Use one of first, second"),
        (lambda p: insert_fn_after(p, "zeroth", third), UnknownNameError, "Use one of first, second"),
        (lambda p: replace_fn(p, third, "third"), UnknownNameError, "Use one of first, second"),
        (lambda p: remove_fn(p, "third"), UnknownNameError, "Use one of first, second"),
        (lambda p: append_fn(p, partial(third)), ValueError, "a name of a stage that is not a named function, got"),
        (lambda p: append_fn(p, lambda x: x), ValueError, "a name of a stage that is not a named function, got"),
        (lambda p: append_fn(p, 3), ValueError, "expected a function as a stage, got 3"),
    ],
)
def test_invalid_changes_leave_the_pipeline_as_it_was(pipeline, change, error, fragment):
    with pytest.raises(error) as raised:
        change(pipeline)
    assert fragment in str(raised.value)
    assert isinstance(raised.value, ValueError)
    assert list(pipeline.items()) == [("first", first), ("second", second)]


@pytest.fixture(scope="module")
def sim():
    return Sim(n_worlds=2, n_drones=2)


@pytest.fixture(autouse=True)
def restore(request):
    if "sim" not in request.fixturenames:
        yield
        return
    sim = request.getfixturevalue("sim")
    data, stages, resets = sim.data, dict(sim.step_pipeline), dict(sim.reset_pipeline)
    yield
    sim.data, sim.step_pipeline, sim.reset_pipeline = data, stages, resets
    sim.build_step_fn()
    sim.build_reset_fn()


def lift(data):
    return data.replace(states=data.states.replace(pos=data.states.pos + jnp.asarray([0, 0, 1.0])))


EDITS = {
    "append": lambda sim: append_fn(sim.step_pipeline, lift),
    "replace": lambda sim: replace_fn(sim.step_pipeline, lift, "still"),
    "assign an item": lambda sim: sim.step_pipeline.update(still=lift),
    "assign a dict": lambda sim: setattr(sim, "step_pipeline", sim.step_pipeline | {"still": lift}),
}


def still(data):
    return data


@pytest.mark.parametrize(("edit", "is_rebuilt"), [*((edit, False) for edit in EDITS), ("append", True)])
def test_an_edit_takes_effect_at_the_next_step(sim, edit, is_rebuilt):
    sim.step_pipeline = {"still": still, "increment_steps": sim.step_pipeline["increment_steps"]}
    before_editing = sim.build_step_fn()
    start = sim.data
    sim.step(2)
    np.testing.assert_array_equal(sim.data.states.pos, start.states.pos)
    EDITS[edit](sim)
    if is_rebuilt:
        sim.build_step_fn()
    sim.step(3)
    np.testing.assert_allclose(heights(sim.data), heights(start) + 3)
    np.testing.assert_array_equal(sim.data.core.steps, 5)
    # A function that was built before is a snapshot, and stays one.
    np.testing.assert_array_equal(before_editing(start, jnp.int32(3)).states.pos, start.states.pos)
    np.testing.assert_allclose(sim.step_fn(start, jnp.int32(3)).states.pos, sim.data.states.pos)


def heights(data):
    return np.asarray(data.states.pos)[..., 2]


def test_law_06_an_edit_compiles_once_and_an_undone_one_not_at_all(sim):
    traces = []

    def counted(data):
        traces.append(1)
        return data

    sim.step()
    step, integration = sim.step_fn, sim.step_pipeline["integration"]
    append_fn(sim.step_pipeline, lift)
    remove_fn(sim.step_pipeline, "lift")
    replace_fn(sim.step_pipeline, integration, "integration")
    sim.step()
    assert sim.step_fn is step
    append_fn(sim.step_pipeline, stage("drone")(counted), "counted")
    sim.step()
    step, n = sim.step_fn, len(traces)
    assert n > 0
    for _ in range(10):
        sim.step()
    assert sim.step_fn is step
    assert len(traces) == n


def test_rollouts_and_explanations_are_of_the_edited_pipeline(sim):
    start = heights(sim.data)
    sim.step_pipeline = {"lift": lift, "increment_steps": sim.step_pipeline["increment_steps"]}
    assert "lift" in sim.explain()
    sim.rollout(lambda params, data: jnp.zeros((2, 2, 4)), n_control_steps=2)
    np.testing.assert_allclose(heights(sim.data), start + 2 * sim.freq // sim.control_freq)


@pytest.mark.parametrize("is_rebuilt", [False, True])
def test_an_edit_takes_effect_at_the_next_reset(sim, is_rebuilt):
    def raise_them(data, default_data, mask=None):
        del default_data, mask
        return lift(data)

    before_editing = sim.build_reset_fn()
    append_fn(sim.reset_pipeline, raise_them)
    if is_rebuilt:
        sim.build_reset_fn()
    sim.reset()
    np.testing.assert_allclose(heights(sim.data), heights(sim.default_data) + 1)
    reset_fn = sim.reset_fn
    sim.reset()
    assert sim.reset_fn is reset_fn
    old = before_editing(sim.data, sim.default_data)
    np.testing.assert_array_equal(old.states.pos, sim.default_data.states.pos)
