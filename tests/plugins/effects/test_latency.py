"""Latency: a command arrives exactly after its delay, at every command level; the data of the user stay."""

import numpy as np
import pytest
from cases import hover_command, hover_rotor_state, repeat_command, with_states

from crazysim import Latency, MotorFailure, Sim

DELAY = np.array([[0, 1], [3, 7], [7, 2]])
"""Delay of the commands of each drone, steps. (n_worlds, n_drones)"""
N_STEPS = 24


def command_of(sim, step):
    """Return the command sent before a step: hover, plus an offset that grows with the step."""
    return repeat_command(sim.data, hover_command(sim.data) + (1 + step) * 1e-4)


def fly(sim, n_steps=N_STEPS):
    """Send another command before every step, and return the states. (n_steps, n_worlds, n_drones, 13 + n_rotors)"""
    track = []
    for step in range(n_steps):
        getattr(sim, f"{sim.control.value}_control")(command_of(sim, step))
        sim.step()
        s = sim.data.states
        track.append(np.concatenate([s.pos, s.quat, s.vel, s.ang_vel, s.rotor_vel], axis=-1))
    return np.stack(track)


def build(control, dynamics="first_principles", engine="auto"):
    sim = Sim(n_worlds=3, n_drones=2, control=control, dynamics=dynamics, state_freq=500, engine=engine)
    sim.data = with_states(sim.data, pos=[0, 0, 1.0], rotor_vel=0.9 * hover_rotor_state(sim.data))
    sim.build_default_data()
    return sim


@pytest.mark.parametrize(
    "control, dynamics",
    [(c, "first_principles") for c in ("state", "attitude", "rotor_vel")] + [("attitude", "so_rpy")],
)
def test_a_command_arrives_exactly_after_its_delay(control, dynamics):
    """With a delay of k steps a drone flies as if the initial command had been sent k times before the others."""
    sim = build(control, dynamics, engine="interpret")
    initial = initial_command(sim)
    undelayed = {}
    for k in np.unique(DELAY):
        sim.data = sim.default_data
        track = []
        for step in range(N_STEPS):
            command = initial if step < k else command_of(sim, step - k)
            getattr(sim, f"{control}_control")(command)
            sim.step()
            s = sim.data.states
            track.append(np.concatenate([s.pos, s.quat, s.vel, s.ang_vel, s.rotor_vel], axis=-1))
        undelayed[k] = np.stack(track)
    sim.data = sim.default_data
    sim.add(Latency(DELAY))
    delayed = fly(sim)
    for (world, drone), k in np.ndenumerate(DELAY):
        # Two programs of the same arithmetic: float32, relative to rotor speeds of 15,000 rpm and angles near zero.
        np.testing.assert_allclose(delayed[:, world, drone], undelayed[k][:, world, drone], rtol=2e-6, atol=2e-6)
        others = [j for j in undelayed if j != k]
        assert all(np.abs(undelayed[j] - undelayed[k])[-1, world, drone].max() > 1e-5 for j in others)
    sent = sim.data.controls.rotor_vel if control == "rotor_vel" else getattr(sim.data.controls, control).staged_cmd
    np.testing.assert_array_equal(sent, command_of(sim, N_STEPS - 1).astype(np.float32))


def initial_command(sim):
    controls = sim.default_data.controls
    return np.asarray(
        controls.rotor_vel if sim.control == "rotor_vel" else getattr(controls, sim.control.value).staged_cmd
    )


@pytest.fixture(scope="module")
def delayed_sim():
    sim = build("attitude")
    sim.add(Latency(3, max_delay=5))
    return sim


def test_a_command_that_is_sent_once_stays(delayed_sim):
    """The queue is filled with the command that was sent, not with the one that arrived."""
    sim, before = delayed_sim, delayed_sim.data
    sim.attitude_control(command_of(sim, 5))
    in_force = []
    for _ in range(9):
        sim.step()
        in_force.append(np.asarray(sim.data.controls.attitude.cmd)[0, 0])
    sim.data = before
    np.testing.assert_array_equal(in_force[2], 0.0)
    for command in in_force[3:]:
        np.testing.assert_array_equal(command, command_of(sim, 5)[0, 0].astype(np.float32))


@pytest.mark.parametrize("first", ["latency", "motors"])
def test_a_late_rotor_command_does_not_turn_a_failed_rotor(first):
    """In any order of adding, a command is delayed before the failure acts on it."""
    sim = build("rotor_vel")
    for name in (first, *{"latency", "motors"} - {first}):
        sim.add(Latency(1) if name == "latency" else MotorFailure(effectiveness=[0.0, 1, 1, 1]))
    for step in range(5):
        sim.rotor_vel_control(command_of(sim, step))
        sim.step()
    speed = np.asarray(sim.data.states.rotor_vel)[0, 0]
    assert (
        speed[1:].min() - speed[0] > 1000
    )  # rpm; a failed rotor loses 1,500 in these 10 ms, the others 300 before the command arrives
