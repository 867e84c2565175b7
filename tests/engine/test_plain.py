"""The plain engine loops over the pipeline, carries written leaves, and refuses stages that change the structure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import send, shared_sim, trees_equal, with_states

from crazysim.engine import Step
from crazysim.sim import Reset


@pytest.fixture(scope="module")
def sim():
    return shared_sim(n_worlds=3, n_drones=2, control="attitude")


@pytest.fixture(scope="module")
def data(sim):
    data = with_states(sim.data, pos=[0, 0, 1.0], vel=[0.3, -0.2, 0.1], ang_vel=[1.0, -1.0, 0.5])
    return send(data, np.broadcast_to([0.05, -0.1, 0.2, 0.45], (3, 2, 4)))


@pytest.fixture(scope="module")
def step(sim):
    return Step(sim.step_pipeline, "plain")


def test_a_static_number_of_steps_gives_the_results_of_a_dynamic_number(data, step):
    """The results differ by float32 rounding, since XLA fuses a scan and a loop differently."""
    static, dynamic = step(data, 7), step(data, jnp.int32(7))
    for name in ("pos", "quat", "vel", "ang_vel"):
        np.testing.assert_allclose(getattr(static.states, name), getattr(dynamic.states, name), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(static.core.steps, np.full((3, 1), 7))
    np.testing.assert_array_equal(dynamic.core.steps, np.full((3, 1), 7))


def test_zero_steps_change_nothing(data, step):
    after = step(data, jnp.int32(0))
    assert trees_equal(after.states, data.states)
    assert trees_equal(after.core.steps, data.core.steps)


def test_leaves_that_no_stage_writes_are_returned_as_the_same_arrays(data, step):
    """Parameters and external forces are inputs only: nothing is copied, and no output is made for them."""
    for n_steps in (2, jnp.int32(2)):
        after = step(data, n_steps)
        assert all(a is b for a, b in zip(jax.tree.leaves(after.params), jax.tree.leaves(data.params), strict=True))
        for name in ("force", "torque"):
            assert getattr(after.states, name) is getattr(data.states, name)
        assert after.controls.attitude.staged_cmd is data.controls.attitude.staged_cmd
        assert after.core.rng_key is data.core.rng_key
        assert after.core.episode is data.core.episode


def test_a_reset_runs_its_stages_in_order_with_default_and_mask(sim, data):
    seen = []

    def first(data, default_data, mask):
        seen.append(("first", mask is None))
        return data.replace(states=default_data.states)

    def second(data, default_data, mask):
        seen.append(("second", mask is None))
        return data.replace(states=data.states.replace(vel=data.states.vel + 1))

    reset = Reset({"first": first, "second": second})
    out = reset(data, sim.default_data)
    np.testing.assert_array_equal(out.states.vel, np.ones((3, 2, 3)))
    reset(data, sim.default_data, jnp.array([True, False, True]))
    assert seen == [("first", True), ("second", True), ("first", False), ("second", False)]
