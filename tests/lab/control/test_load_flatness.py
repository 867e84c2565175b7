"""Flatness of drone and load: the dynamics keep load and drone on the path with the calculated states and inputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim, rotation
from crazysim.lab.control.load_flatness import load_flat_state
from crazysim.plugins.payloads import SlungLoad

LENGTH, LOAD = 0.4, 0.2
"""Length of the rod, m, and mass of the load, kg."""
DT = 1e-5
TIMES = (0.7 - DT, 0.7, 0.7 + DT, 0.0, 0.4, 1.3)
"""Times of the flat states, s; the first three are for central differences."""
REST_POS = np.array([1.0, 2.0, 3.0])
"""Position of a load at rest, m."""


def path_at(t):
    """Return position and six derivatives of a load on a tilted figure eight, m. (7, 3)"""
    orders = np.arange(7)
    rates, sizes, phases = np.array([1.8, 3.6, 1.8]), np.array([0.8, 0.4, 0.2]), np.array([0.0, 0.0, 0.7])
    return sizes * rates ** orders[:, None] * np.sin(rates * t + phases + orders[:, None] * np.pi / 2)


@pytest.fixture(scope="module")
def sim():
    with jax.enable_x64(True):
        return Sim(drone="bumblebee", control="rotor_vel", integrator="rk4", freq=500)


@pytest.fixture(scope="module")
def flat(sim):
    """Return flat states at ``TIMES`` and at rest, and gradients of the torques, all from one program."""
    p, t = sim.data.params, np.array(TIMES)
    paths, yaw = np.zeros((len(t) + 1, 7, 3)), np.zeros((len(t) + 1, 3))
    paths[:-1], paths[-1, 0] = [path_at(x) for x in t], REST_POS
    yaw[:-1] = np.stack([0.3 * np.sin(t), 0.3 * np.cos(t), -0.3 * np.sin(t)], axis=-1)

    def torque(paths):
        states = load_flat_state(paths, yaw, p.mass[0], LOAD, LENGTH, p.J, p.gravity_vec)
        return jnp.sum(states.torque), states

    with jax.enable_x64(True):
        gradient, states = jax.jit(jax.grad(torque, has_aux=True))(paths)
    return jax.tree.map(np.asarray, states), np.asarray(gradient)


def state_at(flat, k):
    """Return the flat state with an index in ``TIMES``; the last one is at rest."""
    return jax.tree.map(lambda x: x[k], flat[0])


def test_rates_are_the_time_derivatives_of_the_states(flat, x64):
    before, now, after = (state_at(flat, k) for k in range(3))
    for value, rate in (("pos", "vel"), ("vel", "acc"), ("direction", "direction_rate"), ("ang_vel", "ang_acc")):
        slope = (getattr(after, value) - getattr(before, value)) / (2 * DT)
        np.testing.assert_allclose(getattr(now, rate), slope, rtol=1e-5, atol=1e-6)
    turned = rotation.multiply(rotation.conjugate(before.quat), after.quat)
    np.testing.assert_allclose(now.ang_vel, turned[:3] / DT * np.sign(turned[3]), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(now.direction), 1, rtol=1e-12)


def test_the_dynamics_have_the_accelerations_of_the_flat_states(sim, flat, x64):
    """The wrench of the flat states moves a drone with stopped rotors along the path."""
    load = sim.add(SlungLoad(mass=LOAD, length=LENGTH, in_scene=False))
    derivative = jax.jit(sim.step_pipeline["integration"].fn.derivative)
    for k in (3, 4, 5):
        expected, path = state_at(flat, k), path_at(TIMES[k])
        rot = np.asarray(rotation.matrix(expected.quat))
        states = jax.tree.map(lambda x: x[0, 0], sim.data.states).replace(
            pos=expected.pos, vel=expected.vel, quat=expected.quat, ang_vel=expected.ang_vel,
            force=rot[:, 2] * expected.thrust, torque=rot @ expected.torque, rotor_vel=np.zeros(4),
        )  # fmt: skip
        record = load.read(sim.data)
        record = record.replace(pos=path[0], vel=path[1], attached=record.attached[0, 0])
        controls = sim.data.controls.replace(rotor_vel=np.zeros(4))
        deriv = derivative(sim.data.replace(states=states, controls=controls, plugins={"load": record}))
        np.testing.assert_allclose(deriv.acc, expected.acc, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(deriv.ang_acc, expected.ang_acc, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(deriv.plugins["load"]["vel"], path[2], rtol=1e-9, atol=1e-9)


def test_at_rest_the_load_hangs_below_the_drone(flat, x64):
    flat_state = state_at(flat, -1)
    np.testing.assert_allclose(flat_state.pos, REST_POS + [0, 0, LENGTH])
    np.testing.assert_allclose(flat_state.thrust, [(0.605 + LOAD) * 9.81])
    np.testing.assert_allclose(flat_state.quat, [0, 0, 0, 1])
    assert np.isfinite(flat[1]).all()
