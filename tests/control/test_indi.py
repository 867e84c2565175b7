"""Incremental nonlinear dynamic inversion: its filter, its start, and the disturbances that it compensates."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from flights import fly, hover, make_sim, path_setpoint, start_on_path

from crazysim import Sim, load_airframe
from crazysim.control.geometric import Geometric, geometric_control
from crazysim.control.indi import INDI, INDIMemory, apply_filter, indi_control
from crazysim.control.pid_loop import butterworth


def test_the_filter_agrees_with_scipy():
    b, a = scipy.signal.butter(2, 12.0, fs=500.0)
    np.testing.assert_allclose(butterworth(12.0, 500.0), [b[0], *a[1:]], rtol=1e-12)
    x = np.random.default_rng(0).normal(size=(50, 2))
    state, out, update = np.zeros(4, np.float32), [], jax.jit(apply_filter)
    for value in x:
        y, state = update(np.float32(value), state, np.float32(butterworth(12.0, 500.0)))
        out.append(y)
    np.testing.assert_allclose(out, scipy.signal.lfilter(b, a, x, axis=0), atol=1e-5)


@functools.cache
def law(drone):
    p = INDI().params(load_airframe(drone))

    def rotors(data, setpoint, memory):
        s = data.states
        state = (s.pos[0, 0], s.quat[0, 0], s.vel[0, 0], s.ang_vel[0, 0], s.rotor_vel[0, 0])
        return indi_control(*state, setpoint, memory, 500, params=p)

    return rotors


def memory():
    return jax.tree.map(jnp.asarray, INDI().memory(load_airframe("cf21B_500")))


def test_a_return_to_the_controller_starts_its_filter_anew():
    controller, airframe = INDI(), load_airframe("bumblebee")
    params, setpoint = controller.params(airframe), jax.jit(lambda t: path_setpoint(hover, t))(np.float32(0))
    rotor_vel = np.full(4, 8000.0, np.float32)
    state = {"pos": [0, 0, 0], "quat": [0, 0, 0, 1], "vel": [1.0, 0.0, 0.0], "ang_vel": [0, 0, 0]}
    state = {name: jnp.asarray(np.float32(value)) for name, value in state.items()}
    data = SimpleNamespace(states=SimpleNamespace(**state, rotor_vel=rotor_vel))
    stale = INDIMemory(*map(np.float32, ([-2.0, 0.0, 0.0], np.ones(3), np.full(24, 9.0), np.ones(1))))
    restarted = jax.jit(lambda memory: controller.take_over(data, setpoint, memory, params, rotor_vel))(stale)
    update = jax.jit(lambda memory: controller.update(data, setpoint, memory, params)[0])
    first = np.asarray(update(memory()))
    np.testing.assert_array_equal(update(restarted), first)
    assert np.max(np.abs(np.asarray(update(stale)) - first)) > 100


def push(data, t):
    """Apply a tenth of the weight along x, and a torque about y that would turn the drone by 0.2 rad, from 2 s on."""
    s = data.states
    force = jnp.asarray([0.0426, 0, 0], jnp.float32) * (t > 2)
    torque = jnp.asarray([0, 3e-4, 0], jnp.float32) * (t > 2)
    states = s.replace(force=jnp.broadcast_to(force, s.force.shape), torque=jnp.broadcast_to(torque, s.torque.shape))
    return data.replace(states=states)


def test_a_force_and_a_torque_are_compensated():
    """Within 1 mm after 7 s; geometric control without an integral stays decimetres away."""
    sim = make_sim("cf21B_500", "rotor_vel")
    start_on_path(sim, hover)
    states, setpoints, _, _ = fly(sim, law("cf21B_500"), hover, 9.0, memory(), push)
    error = np.linalg.norm(states.pos - np.asarray(setpoints.pos), axis=-1)
    assert error[-1] < 1e-3
    assert error.max() < 0.1

    p = Geometric().params(load_airframe("cf21B_500"))

    def geometric(data, setpoint, nothing):
        s = data.states
        state = (s.pos[0, 0], s.quat[0, 0], s.vel[0, 0], s.ang_vel[0, 0])
        return geometric_control(*state, setpoint, params=p), nothing

    sim = make_sim("cf21B_500")
    start_on_path(sim, hover)
    states, setpoints, _, _ = fly(sim, geometric, hover, 9.0, None, push)
    assert np.linalg.norm(states.pos[-1] - np.asarray(setpoints.pos)[-1]) > 0.2


@pytest.fixture(scope="module")
def flown_sims():
    """Return simulations, by controller, after 6 s of flight from the floor to a point 1 m high and 1 m aside."""
    sims = {}
    for name in ("geometric", "indi", "lqr"):
        sim = Sim(n_worlds=4, control="state", controller=name, strict=True)
        cmd = np.zeros((4, 1, 16), np.float32)
        cmd[..., :3], cmd[..., 12] = [1.0, 0.5, 1.0], 1.0
        sim.state_control(cmd)
        sim.step(3000)
        sims[name] = sim
    return sims


@pytest.mark.parametrize("name", ["geometric", "indi", "lqr"])
def test_a_controller_by_name_flies_from_the_floor_to_a_setpoint(flown_sims, name):
    """Its step is fused (``strict``), and the flights in all worlds are equal."""
    pos = np.asarray(flown_sims[name].data.states.pos)
    np.testing.assert_allclose(pos[:, 0], np.broadcast_to([1.0, 0.5, 1.0], (4, 3)), atol=0.05)
    np.testing.assert_array_equal(pos, np.broadcast_to(pos[:1], pos.shape))
