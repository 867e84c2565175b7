"""Flatness of drone and load: the states and inputs keep load and drone on the path in the dynamics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim, rotation
from crazysim.plugins.payloads import SlungLoad
from crazysim.plugins.payloads.load_flatness import load_flat_state

LENGTH, LOAD = 0.4, 0.2
DT = 1e-5
TIMES = (0.7 - DT, 0.7, 0.7 + DT, 0.0, 0.4, 1.3)
PLACE = np.array([1.0, 2.0, 3.0])
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
    paths[:-1], paths[-1, 0] = [path_at(x) for x in t], PLACE
    yaw[:-1] = np.stack([0.3 * np.sin(t), 0.3 * np.cos(t), -0.3 * np.sin(t)], axis=-1)

    def torque(paths):
        states = load_flat_state(paths, yaw, p.mass[0], LOAD, LENGTH, p.J, p.gravity_vec)
        return jnp.sum(states.torque), states

    with jax.enable_x64(True):
        gradient, states = jax.jit(jax.grad(torque, has_aux=True))(paths)
    return jax.tree.map(np.asarray, states), np.asarray(gradient)


def of_one(flat, k):
    return jax.tree.map(lambda x: x[k], flat[0])


def test_derivatives_are_those_of_the_states_in_time(flat, x64):
    before, now, after = (of_one(flat, k) for k in range(3))
    for value, rate in (("pos", "vel"), ("vel", "acc"), ("direction", "direction_rate"), ("ang_vel", "ang_acc")):
        slope = (getattr(after, value) - getattr(before, value)) / (2 * DT)
        np.testing.assert_allclose(getattr(now, rate), slope, rtol=1e-5, atol=1e-6)
    turned = rotation.multiply(rotation.conjugate(before.quat), after.quat)
    np.testing.assert_allclose(now.ang_vel, turned[:3] / DT * np.sign(turned[3]), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(now.direction), 1, rtol=1e-12)


def test_the_dynamics_have_the_accelerations_of_the_flat_states(sim, flat, x64):
    """Thrust and torque of the flat states, as external forces on a drone without rotors' thrust, move it along."""
    load = sim.add(SlungLoad(mass=LOAD, length=LENGTH, in_scene=False))
    derivative = jax.jit(sim.step_pipeline["integration"].fn.derivative)
    for k in (3, 4, 5):
        want, path = of_one(flat, k), path_at(TIMES[k])
        rot = np.asarray(rotation.matrix(want.quat))
        states = jax.tree.map(lambda x: x[0, 0], sim.data.states).replace(
            pos=want.pos, vel=want.vel, quat=want.quat, ang_vel=want.ang_vel, force=rot[:, 2] * want.thrust,
            torque=rot @ want.torque, rotor_vel=np.zeros(4),
        )  # fmt: skip
        record = load.read(sim.data)
        record = record.replace(pos=path[0], vel=path[1], attached=record.attached[0, 0])
        controls = sim.data.controls.replace(rotor_vel=np.zeros(4))
        deriv = derivative(sim.data.replace(states=states, controls=controls, plugins={"load": record}))
        np.testing.assert_allclose(deriv.acc, want.acc, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(deriv.ang_acc, want.ang_acc, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(deriv.plugins["load"]["vel"], path[2], rtol=1e-9, atol=1e-9)


def test_at_rest_the_load_hangs_below(flat, x64):
    got = of_one(flat, -1)
    np.testing.assert_allclose(got.pos, PLACE + [0, 0, LENGTH])
    np.testing.assert_allclose(got.thrust, [(0.605 + LOAD) * 9.81])
    np.testing.assert_allclose(got.quat, [0, 0, 0, 1])
    assert np.isfinite(flat[1]).all()
