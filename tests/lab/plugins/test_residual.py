"""Residuals add the force and torque of their coefficients, in every engine."""

import jax.numpy as jnp
import numpy as np

from crazysim import Residual, Sim
from crazysim.lab.plugins.residual import N_INPUTS

RNG = np.random.default_rng(3)
LINEAR = RNG.normal(size=(6, N_INPUTS)) * np.repeat([1e-2, 1e-5], 3)[:, None]
HIDDEN, OUTPUT = RNG.normal(size=(5, N_INPUTS)), RNG.normal(size=(6, 5)) * np.repeat([1e-2, 1e-5], 3)[:, None]
"""Coefficients of the linear and the hidden terms; the first three rows are forces, and the others torques."""


def drone(**residual):
    return {"base": "cf21B_500", "residual": {key: x.tolist() for key, x in residual.items()}}


def set_flight_states(sim):
    rng, s = np.random.default_rng(0), sim.data.states
    quat = rng.normal(size=s.quat.shape)
    sim.data = sim.data.replace(
        states=s.replace(
            pos=s.pos + np.array([0, 0, 5], np.float32),
            quat=jnp.asarray(quat / np.linalg.norm(quat, axis=-1, keepdims=True), s.pos.dtype),
            vel=jnp.asarray(rng.normal(size=s.vel.shape), s.pos.dtype),
            ang_vel=jnp.asarray(rng.normal(size=s.vel.shape), s.pos.dtype),
            rotor_vel=jnp.asarray(rng.uniform(1e4, 2e4, s.rotor_vel.shape), s.pos.dtype),
        )
    )
    return sim


def test_the_wrench_is_that_of_the_coefficients():
    """Compare velocities after an Euler step with those without the residual, plus the wrench by hand."""
    plain = set_flight_states(Sim(3, 2, drone="cf21B_500", control="rotor_vel", integrator="euler"))
    sim = set_flight_states(
        Sim(3, 2, drone=drone(linear=LINEAR, hidden=HIDDEN, output=OUTPUT), control="rotor_vel", integrator="euler")
    )
    sim.add(Residual())
    s, p = sim.data.states, sim.data.params
    for simulation in (plain, sim):
        simulation.rotor_vel_control(np.asarray(s.rotor_vel))
        simulation.step()
    x, y, z, w = np.moveaxis(np.asarray(s.quat, np.float64), -1, 0)
    rot = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    vel = np.einsum("...ji,...j->...i", rot, np.asarray(s.vel, np.float64))
    rpm = np.asarray(s.rotor_vel, np.float64)
    thrust, drag = [
        c[0, 0] + rpm * (c[0, 1] + rpm * c[0, 2]) for c in (np.asarray(p.rpm2thrust), np.asarray(p.rpm2torque))
    ]
    mixing, mass, arm = np.asarray(p.mixing_matrix, np.float64), float(p.mass[0]), float(p.L[0])
    weight = mass * 9.81
    torque = np.concatenate([thrust @ mixing[:2].T / weight, drag @ mixing[2:].T / (weight * arm)], -1)
    constant = np.ones((3, 2, 1))
    inputs = np.concatenate(
        [
            constant,
            vel,
            vel * np.linalg.norm(vel, axis=-1, keepdims=True),
            np.asarray(s.ang_vel),
            thrust.sum(-1, keepdims=True) / weight,
            torque,
        ],
        -1,
    )
    wrench = inputs @ LINEAR.T + np.tanh(inputs @ HIDDEN.T) @ OUTPUT.T
    dt = 1 / sim.freq
    acc = (np.asarray(sim.data.states.vel) - np.asarray(plain.data.states.vel)) / dt
    ang_acc = (np.asarray(sim.data.states.ang_vel) - np.asarray(plain.data.states.ang_vel)) / dt
    # float32: differences of velocities of order one over 2 ms.
    np.testing.assert_allclose(acc, np.einsum("...ij,...j->...i", rot, wrench[..., :3]) / mass, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(ang_acc, wrench[..., 3:] / np.diag(np.asarray(p.J)), rtol=2e-3, atol=2e-3)


def test_aero_identified_adds_the_residual_of_the_airframe():
    sim = Sim(drone=drone(linear=LINEAR), aero="identified", control="rotor_vel")
    np.testing.assert_allclose(sim.data.plugins["residual"].linear, LINEAR, rtol=1e-6)
