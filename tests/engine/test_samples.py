"""Samples: a kernel that writes them as it flies, and a loop around the step, take the same ones."""

import jax
import numpy as np
import pytest

from crazysim import Sim
from crazysim.effects import Downwash
from crazysim.engine import fused
from crazysim.engine.samples import compile_sampler

N_WORLDS, N_DRONES, N_SAMPLES, N_STEPS = 5, 2, 4, 3

pytestmark = pytest.mark.skipif(fused.missing("cpu") is not None, reason="kernels need a C++ compiler")


def flying(engine="fused"):
    sim = Sim(n_worlds=N_WORLDS, n_drones=N_DRONES, control="attitude", engine=engine)
    cmd = np.zeros((N_WORLDS, N_DRONES, 4), np.float32)
    cmd[..., 0], cmd[..., 3] = np.linspace(-0.2, 0.2, N_DRONES), 0.4
    sim.attitude_control(cmd)
    return sim


def poses(data):
    """Return fields of drones and of worlds, one of them twice."""
    return {"pos": data.states.pos, "again": data.states.pos, "quat": data.states.quat, "steps": data.core.steps}


def taken(sim, keep=poses):
    return compile_sampler(sim.step_fn, sim.data, keep, N_SAMPLES, N_STEPS)(sim.data)


def in_turns(sim, keep=poses):
    """Return the samples that single calls of the step take."""
    data, samples = sim.data, []
    for _ in range(N_SAMPLES):
        data = sim.step_fn(data, N_STEPS)
        samples.append(keep(data))
    return data, jax.tree.map(lambda *x: np.stack(x), *samples)


def same(found, expected):
    for new, old in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert new.dtype == old.dtype
        new, old = (jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
                    for x in (new, old))  # fmt: skip
        np.testing.assert_allclose(new, old, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("engine", ["fused", "lanes", "plain"])
def test_samples_are_those_of_steps_in_turn(engine):
    sim = flying(engine)
    (data, samples), (data_after, expected) = taken(sim), in_turns(sim)
    same(data, data_after)
    same(samples, expected)
    assert samples["pos"].shape == (N_SAMPLES, N_WORLDS, N_DRONES, 3)
    np.testing.assert_array_equal(samples["steps"][:, 0, 0], N_STEPS * np.arange(1, N_SAMPLES + 1))


def test_drones_that_see_each_other_are_sampled():
    sim = Sim(n_worlds=2, n_drones=12, control="attitude", engine="fused")
    sim.add(Downwash())
    (data, samples), (data_after, expected) = taken(sim), in_turns(sim)
    same(data, data_after)
    same(samples, expected)


def test_one_kernel_takes_all_samples(monkeypatch):
    sim = flying()
    calls = []
    launch = fused._launch
    monkeypatch.setattr(fused, "_launch", lambda *args: (calls.append(len(args) > 4 and args[4]), launch(*args))[1])
    taken(sim)
    assert calls[1:] == [N_SAMPLES]  # the first call is that of planning


def test_what_is_computed_of_the_data_is_sampled_by_a_loop():
    def height(data):
        return data.states.pos[..., 2] * 2

    sim = flying()
    same(taken(sim, height)[1], in_turns(sim, height)[1])


def test_a_world_that_is_not_finite_is_flagged():
    sim = flying()
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[2].set(np.nan)))
    data, samples = taken(sim)
    assert np.flatnonzero(data.core.nonfinite).tolist() == [2]
    assert np.isfinite(np.delete(np.asarray(samples["pos"]), 2, axis=1)).all()


def test_nothing_is_taken_from_the_caller():
    sim = flying()
    before = np.array(sim.data.states.pos)
    sampler = compile_sampler(sim.step_fn, sim.data, poses, N_SAMPLES, N_STEPS)
    first, second = sampler(sim.data), sampler(sim.data)
    same(first, second)
    np.testing.assert_array_equal(sim.data.states.pos, before)
