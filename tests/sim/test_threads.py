"""One simulation in several threads: no step and no command is lost."""

import os
import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_params, with_states

from crazysim import Sim
from crazysim.core.pipeline import BuiltPipeline
from crazysim.engine import Step

N_CALLS = 200


def run_together(*calls, n_calls=N_CALLS):
    """Call each function repeatedly, with the number of the call, in its own thread; threads start together."""
    start, errors = threading.Barrier(len(calls)), []

    def run(call):
        start.wait()
        try:
            for k in range(n_calls):
                call(k)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(call,)) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors


@pytest.fixture(scope="module")
def sim():
    sim = Sim(2, n_drones=2)
    sim.step()
    sim.attitude_control(np.zeros((2, 2, 4)))
    sim.step()
    return sim


def test_steps_of_two_threads_are_all_counted(sim):
    sim.reset()
    run_together(lambda _: sim.step(), lambda _: sim.step())
    assert np.all(sim.data.core.steps == 2 * N_CALLS)


def test_steps_are_taken_while_others_command_read_and_sync(sim):
    sim.reset()
    name = sim.drone_names[1]

    def command(k):
        sim.attitude_control(np.full((2, 2, 4), k))

    def push(k):
        sim[name].set(force=[0.0, 0.0, 0.001 * k])

    def change(k):
        with sim.lock:
            data = sim.data
            sim.data = data.replace(core=data.core.replace(episode=data.core.episode + 1))

    episode = np.asarray(sim.data.core.episode)
    run_together(lambda _: sim.step(), command, push, change, lambda _: sim.sync(0))
    data = sim.data
    assert np.all(data.core.steps == N_CALLS)
    np.testing.assert_array_equal(data.core.episode, episode + N_CALLS)
    np.testing.assert_array_equal(data.controls.attitude.staged_cmd, N_CALLS - 1)
    np.testing.assert_allclose(data.states.force[:, :, 2], [[0, 0.001 * (N_CALLS - 1)]] * 2)
    assert np.all(np.isfinite(sim.mj_data.mocap_pos))


def switch_threads(frame, event, arg):
    """Let other threads run between any two lines of the engine; a trace function of threads."""
    if os.path.join("crazysim", "engine") not in frame.f_code.co_filename:
        return None
    time.sleep(1e-6)
    return switch_threads


@pytest.fixture
def frequent_switches():
    threading.settrace(switch_threads)
    yield
    threading.settrace(None)


@pytest.mark.long("compiles two kernels, and switches threads at every line of the engine")
def test_a_pure_step_computes_with_the_parameters_of_its_own_thread(sim, frequent_switches):
    """The engine caches packed parameters and their zeros between calls, separately for each thread."""
    flying = with_states(sim.data, pos=[0.0, 0.0, 5.0], rotor_vel=15e3, ang_vel=[1.0, 2.0, 3.0])
    inverse_inertia = np.array(flying.params.J_inv)
    inverse_inertia[0, 1] = inverse_inertia[1, 0] = 1e4
    data_of_threads = [
        flying,
        with_params(flying, mass=2 * flying.params.mass),
        with_params(flying, J_inv=inverse_inertia),
    ]
    step, n_steps = Step(sim.step_pipeline), jnp.int32(1)

    def speeds(data):
        states = step(data, n_steps).states
        return np.concatenate([states.vel, states.ang_vel])

    expected = [speeds(data) for data in data_of_threads]

    def compare_speeds(k):
        return lambda _: np.testing.assert_array_equal(speeds(data_of_threads[k]), expected[k])

    run_together(compare_speeds(0), compare_speeds(1), compare_speeds(2), n_calls=40)


def test_a_pipeline_that_is_edited_while_it_is_built_is_built_again():
    """A function of older stages, which another thread is still building, does not replace that of the new stages."""
    building, edited = threading.Event(), threading.Event()

    def build(stages):
        if "slow" in stages:
            building.set()
            edited.wait(300)
        return list(stages)

    def edit(_):
        building.wait(300)
        built.stages = {"quick": run_together}
        built.fn()
        edited.set()

    built = BuiltPipeline("step_pipeline", {}, build)
    built.stages = {"slow": edit}
    run_together(lambda _: built.fn(), edit, n_calls=1)
    assert built.fn() == ["quick"]
