"""Flatness of drone and load: the states and inputs keep load and drone on the path in the dynamics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim, rotation
from crazysim.payloads import SlungLoad
from crazysim.payloads.flatness import flat_states

LENGTH, LOAD = 0.4, 0.2


def path_at(t):
    """Return position and six derivatives of a load on a tilted figure eight, m. (7, 3)"""
    orders = np.arange(7)
    rates, sizes, phases = np.array([1.8, 3.6, 1.8]), np.array([0.8, 0.4, 0.2]), np.array([0.0, 0.0, 0.7])
    return sizes * rates ** orders[:, None] * np.sin(rates * t + phases + orders[:, None] * np.pi / 2)


@pytest.fixture
def sim(x64):
    return Sim(drone="bumblebee", control="rotor_vel", integrator="rk4", freq=500, engine="lanes")


def flat(sim, t):
    p = sim.data.params
    yaw = np.array([0.3 * np.sin(t), 0.3 * np.cos(t), -0.3 * np.sin(t)])
    return flat_states(jnp.asarray(path_at(t)), jnp.asarray(yaw), p.mass[0], LOAD, LENGTH, p.J, p.gravity_vec)


def test_derivatives_are_those_of_the_states_in_time(sim):
    before, now, after = (flat(sim, t) for t in (0.7 - 1e-5, 0.7, 0.7 + 1e-5))
    for value, rate in (("pos", "vel"), ("vel", "acc"), ("direction", "direction_rate"), ("ang_vel", "ang_acc")):
        slope = (getattr(after, value) - getattr(before, value)) / 2e-5
        np.testing.assert_allclose(getattr(now, rate), slope, rtol=1e-5, atol=1e-6)
    turned = rotation.multiply(rotation.conjugate(before.quat), after.quat)
    np.testing.assert_allclose(now.ang_vel, turned[:3] / 1e-5 * np.sign(turned[3]), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(now.direction), 1, rtol=1e-12)


def test_the_dynamics_have_the_accelerations_of_the_flat_states(sim):
    """Thrust and torque of the flat states, as external forces on a drone without rotors' thrust, move it along."""
    load = sim.add(SlungLoad(mass=LOAD, length=LENGTH, in_scene=False))
    integration = sim.step_pipeline["integration"].fn
    for t in (0.0, 0.4, 1.3):
        want = flat(sim, t)
        body = rotation.rotate(want.quat, jnp.concatenate([jnp.zeros(2), want.thrust]))
        states = jax.tree.map(lambda x: x[0, 0], sim.data.states).replace(
            pos=want.pos, vel=want.vel, quat=want.quat, ang_vel=want.ang_vel, force=body,
            torque=rotation.rotate(want.quat, want.torque), rotor_vel=jnp.zeros(4),
        )  # fmt: skip
        record = load.read(sim.data)
        record = record.replace(
            pos=jnp.asarray(path_at(t)[0]), vel=jnp.asarray(path_at(t)[1]), attached=record.attached[0, 0]
        )
        controls = sim.data.controls.replace(rotor_vel=jnp.zeros(4))
        one = sim.data.replace(states=states, controls=controls, plugins={"load": record})
        deriv = integration.derivative(one)
        np.testing.assert_allclose(deriv.acc, want.acc, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(deriv.ang_acc, want.ang_acc, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(deriv.plugins["load"]["vel"], path_at(t)[2], rtol=1e-9, atol=1e-9)


def test_at_rest_the_load_hangs_below(sim):
    p = sim.data.params
    rest = jnp.zeros((2, 7, 3)).at[:, 0].set(jnp.array([1.0, 2.0, 3.0]))
    got = flat_states(rest, jnp.zeros((2, 3)), p.mass[0], LOAD, LENGTH, p.J, p.gravity_vec)
    np.testing.assert_allclose(got.pos, [[1, 2, 3.4]] * 2)
    np.testing.assert_allclose(got.thrust, [[(0.605 + LOAD) * 9.81]] * 2)
    np.testing.assert_allclose(got.quat, [[0, 0, 0, 1]] * 2)
    assert np.isfinite(jax.jacobian(lambda x: flat_states(
        x, jnp.zeros((2, 3)), p.mass[0], LOAD, LENGTH, p.J, p.gravity_vec).torque)(rest)).all()  # fmt: skip
