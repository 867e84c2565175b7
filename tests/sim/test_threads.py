"""One simulation in several threads: no step and no command is lost."""

import threading

import numpy as np
import pytest

from crazysim import Sim

N_CALLS = 200


def run_together(*calls):
    """Run functions in threads of their own, which begin at once."""
    start, errors = threading.Barrier(len(calls)), []

    def run(call):
        start.wait()
        try:
            for k in range(N_CALLS):
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


def test_steps_of_two_threads_are_all_taken(sim):
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
