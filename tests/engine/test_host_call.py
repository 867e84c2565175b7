"""Steps on the host without XLA: same numbers as the compiled step, in memory that is never written again."""

import copy
import pickle
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import leaf_on_host, needs_compiler, trees_equal, with_states

from crazysim import Cars, Downwash, Sim
from crazysim.engine.sharding import world_mesh

pytestmark = needs_compiler

COMMAND = np.full((3, 2, 4), 0.1)


def build_falling_sim():
    sim = Sim(3, 2, control="attitude")
    sim.data = with_states(sim.data, pos=[0, 0, 5.0])
    sim.attitude_control(COMMAND)
    return sim


@pytest.fixture
def sim():
    sim = build_falling_sim()
    sim.step(2)
    assert sim.step_fn.plan(sim.data).host_call.was_called
    return sim


def step_on_xla(sim, n):
    """Return the data after ``n`` steps of the function that XLA compiled."""
    return sim.step_fn(sim.data, jnp.int32(n))


@pytest.mark.parametrize(("n_worlds", "n_drones"), [(3, 1), (700, 2)], ids=["one buffer", "a buffer for each array"])
def test_host_calls_give_the_numbers_of_the_compiled_step(n_worlds, n_drones):
    sim = Sim(n_worlds, n_drones, control="state")
    sim.data = with_states(sim.data, pos=[0, 0, 5.0])
    for _ in range(3):
        expected = step_on_xla(sim, 7)
        sim.step(7)
        assert trees_equal(sim.data, expected)


@pytest.mark.parametrize(("n_drones", "control"), [(1, "state"), (9, "rotor_vel")])
def test_numbers_depend_neither_on_blocks_nor_on_threads(n_drones, control):
    """13 worlds end within a block of lanes; 1,400 worlds are distributed over the cores."""
    n_worlds, end_states = 1400, []
    rng = np.random.default_rng(n_drones)
    shapes = {"pos": 3, "vel": 3, "ang_vel": 3, "rotor_vel": 4}
    start = {name: rng.normal(1, 0.3, (n_worlds, n_drones, k)).astype(np.float32) for name, k in shapes.items()}
    start["rotor_vel"] *= 15_000
    for n in (n_worlds, 13):
        sim = Sim(n, n_drones, control=control, engine="fused")
        if n_drones > 1:
            sim.add(Downwash())
        states = {name: jnp.asarray(x[:n]) for name, x in start.items()}
        sim.data = sim.data.replace(states=sim.data.states.replace(**states))
        sim.step(3)
        end_states.append(sim.data.states)
    many, few = end_states
    assert trees_equal(jax.tree.map(lambda x: x[:13], many), few)


def test_two_threads_of_python_may_step_at_once():
    """One caller uses the threads of the kernel; the other caller runs without threads."""
    sims = [Sim(4000, control="attitude") for _ in range(2)]
    for sim in sims:
        sim.data = with_states(sim.data, pos=[0, 0, 5.0])
        sim.step()
    expected = step_on_xla(sims[0], 60)
    threads = [threading.Thread(target=sim.step, args=(60,)) for sim in sims]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(trees_equal(sim.data.states, expected.states) for sim in sims)


def test_a_kernel_without_memory_is_an_error(monkeypatch):
    monkeypatch.setenv("CXXFLAGS", "-O0 '-DALLOCATE(size)=nullptr'")
    sim = Sim(2, 9, control="attitude")
    sim.add(Downwash())
    with pytest.raises(MemoryError, match="no memory"):
        sim.step()
    with pytest.raises(jax.errors.JaxRuntimeError, match="no memory"):
        jax.block_until_ready(step_on_xla(sim, 1))


def test_independent_populations_give_the_numbers_of_the_compiled_step():
    sim = Sim(3, 2)
    sim.add(Cars(2))
    sim.step(5)
    plan = sim.step_fn.plan(sim.data)
    assert len(plan.programs) == 2
    assert plan.host_call.was_called
    expected = step_on_xla(sim, 5)
    sim.step(5)
    assert trees_equal(sim.data, expected)


def test_subnormal_numbers_are_zero_as_in_the_compiled_step(sim):
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(ang_vel=jnp.full_like(states.ang_vel, 1e-40)))
    expected = step_on_xla(sim, 1)
    sim.step()
    assert trees_equal(sim.data, expected)
    assert np.float32(1e-38) / np.float32(100) > 0  # the caller's arithmetic keeps subnormal numbers


def test_fields_that_are_read_later_keep_their_values(sim):
    expected = [np.array(leaf_on_host(x)) for x in jax.tree.leaves(step_on_xla(sim, 3))]
    sim.step(3)
    unread, states = sim.data, sim.data.states
    pos = states.pos
    for k in range(4):
        sim.attitude_control(COMMAND * (k + 2))
        sim.step(3)
        assert not np.array_equal(sim.data.states.pos, pos)
    for x, y in zip(jax.tree.leaves(unread), expected, strict=True):
        np.testing.assert_array_equal(leaf_on_host(x), y)
    assert unread.states is states
    assert states.pos is pos


def test_a_record_that_was_not_read_can_be_copied(sim):
    for copied in (copy.copy(sim.data), copy.deepcopy(sim.data.states), pickle.loads(pickle.dumps(sim.data.states))):
        states = getattr(copied, "states", copied)
        sim.step()
        np.testing.assert_array_equal(states.quat.shape, (3, 2, 4))
        assert not np.array_equal(states.pos, sim.data.states.pos)
    with pytest.raises(AttributeError, match="no attribute 'position'"):
        sim.data.states.position  # noqa: B018


def test_donating_arrays_that_were_read_does_not_change_the_simulation(sim):
    twin = build_falling_sim()
    twin.step(2)
    sim.step()
    twin.step()
    read = sim.data.states, sim.data.params, sim.data.controls
    jax.jit(lambda x: jax.tree.map(lambda y: y * 0 + 7, x), donate_argnums=0)(read)
    sim.step(3)
    twin.step(3)
    assert trees_equal(sim.data.states, twin.data.states)


def test_other_devices_and_engines_keep_the_compiled_step():
    for sim in (Sim(2, engine="lanes"), Sim(2, mesh=world_mesh(jax.devices("cpu")[:2]))):
        assert sim.step_fn.plan(sim.data).host_call is None
        assert "without XLA" not in sim.explain()
    device = jax.devices("cpu")[1]
    sim = Sim(2, device=device)
    sim.step()
    assert sim.step_fn.plan(sim.data).host_call.was_called
    assert "sim.step calls it without XLA" in sim.explain()
    assert sim.data.states.pos.devices() == {device}
    assert sim.data.states.pos.committed
