"""Parameters and disturbances drawn per world and drone, each as a stage of a pipeline; effects checked by physics."""

import jax
import numpy as np
from cases import hover_command, hover_rotor_state, repeat_command, with_states

from crazysim import Sim
from crazysim.core.pipeline import append_fn
from crazysim.core.random import drone_keys
from crazysim.engine.pytree import select_worlds

N_WORLDS, N_DRONES, N_STEPS = 3, 2, 100
DURATION = N_STEPS / 500
"""Duration of a flight, s."""


def draw(keys, low, high, shape=(1,)):
    """Return a uniform draw from each key. (n_worlds, n_drones, *shape)"""
    draw_from_key = lambda key: jax.random.uniform(key, shape, minval=low, maxval=high)  # noqa: E731
    return jax.vmap(jax.vmap(draw_from_key))(keys)


def draw_mass(data, default_data, mask=None):
    """Scale every drone's mass by 0.7 to 1.4."""
    mass = default_data.params.mass * draw(drone_keys(data, "mass"), 0.7, 1.4)
    return data.replace(params=data.params.replace(mass=select_worlds(mask, mass, data.params.mass)))


def draw_inertia(data, default_data, mask=None):
    """Scale every drone's inertia by 0.5 to 2, and its inverse by one over that."""
    scale, p = draw(drone_keys(data, "inertia"), 0.5, 2.0, (1, 1)), default_data.params
    J, J_inv = p.J * scale, p.J_inv / scale
    params = data.params.replace(
        J=select_worlds(mask, J, data.params.J), J_inv=select_worlds(mask, J_inv, data.params.J_inv)
    )
    return data.replace(params=params)


def draw_motors(data, default_data, mask=None):
    """Scale the thrust of each of the four rotors of every drone by 0.8 to 1.2."""
    curve = default_data.params.rpm2thrust * draw(drone_keys(data, "motors"), 0.8, 1.2, (4, 1))
    return data.replace(params=data.params.replace(rpm2thrust=select_worlds(mask, curve, data.params.rpm2thrust)))


def make_drawn_sim(*reset_stages, control="rotor_vel"):
    """Return a simulation of hovering drones whose parameters the reset stages drew, and the data before the reset."""
    sim = Sim(n_worlds=N_WORLDS, n_drones=N_DRONES, control=control, rng_key=5, engine="interpret")
    sim.data = with_states(sim.data, pos=[0, 0, 10.0], rotor_vel=hover_rotor_state(sim.data))
    nominal = sim.build_default_data()
    for stage in reset_stages:
        append_fn(sim.reset_pipeline, stage)
    sim.build_reset_fn()
    sim.reset()
    getattr(sim, f"{control}_control")(repeat_command(nominal, hover_command(nominal)))
    return sim, nominal


def test_a_drawn_mass_sinks_or_climbs_by_newtons_law():
    """At the thrust that carries the nominal mass m0 a mass m accelerates by g (m0 / m - 1), less drag."""
    sim, nominal = make_drawn_sim(draw_mass)
    mass = np.asarray(sim.data.params.mass, np.float64)
    assert mass.shape == (N_WORLDS, N_DRONES, 1)
    assert len(np.unique(mass)) == N_WORLDS * N_DRONES
    sim.step(N_STEPS)
    m0, drag = float(nominal.params.mass[0]), float(nominal.params.drag_matrix[2, 2])
    acc, rate = 9.81 * (m0 / mass[..., 0] - 1), -drag / mass[..., 0]
    expected = acc / rate * (1 - np.exp(-rate * DURATION))
    # explicit Euler is off by half a step in time, 0.5 % at 0.2 s with drag of 0.6 per s; hover in float32 by 1e-4 m/s
    np.testing.assert_allclose(sim.data.states.vel[..., 2], expected, rtol=2e-3, atol=2e-4)
    heavier = mass[..., 0] > m0
    assert heavier.any()
    assert not heavier.all()
    np.testing.assert_array_equal(np.asarray(sim.data.states.vel[..., 2]) < 0, heavier)

    # A reset of one world draws new masses there and keeps the masses of the others.
    sim.reset(np.array([False, True, False]))
    again = np.asarray(sim.data.params.mass, np.float64)
    np.testing.assert_array_equal(again[::2], mass[::2])
    assert not np.any(again[1] == mass[1])


def test_angular_acceleration_is_inverse_to_a_drawn_inertia():
    """A small external torque turns a drone at rest by J w' = tau: twice the inertia, half the rate."""
    sim, nominal = make_drawn_sim(draw_inertia)
    p = sim.data.params
    eye = np.broadcast_to(np.eye(3), (N_WORLDS, N_DRONES, 3, 3))
    np.testing.assert_allclose(p.J @ p.J_inv, eye, atol=1e-5)  # float32 product of inverses
    assert len(np.unique(np.asarray(p.J[..., 0, 0]))) == N_WORLDS * N_DRONES
    torque = 1e-6
    sim.data = with_states(sim.data, torque=[torque, 0, 0])
    sim.step(10)
    expected = torque * 10 / 500 / np.asarray(p.J[..., 0, 0])
    # after 20 ms of turning, rotors' gyroscopic torques cancel but for 1e-4 of float32 differences
    np.testing.assert_allclose(sim.data.states.ang_vel[..., 0], expected, rtol=1e-3)
    np.testing.assert_allclose(nominal.params.J[0, 0], 25e-6, rtol=1e-6)


def test_drawn_motors_accelerate_and_tilt_by_their_thrusts():
    """Rotors at hover speed with thrusts off by drawn factors: acceleration by their mean, roll by left over right."""
    sim, nominal = make_drawn_sim(draw_motors)
    scale = np.asarray(sim.data.params.rpm2thrust[..., 2] / nominal.params.rpm2thrust[0, 2], np.float64)
    assert scale.shape == (N_WORLDS, N_DRONES, 4)
    assert 0.8 <= scale.min() < 0.95
    assert 1.05 < scale.max() <= 1.2
    dt = 1 / 500
    sim.step(1)
    acc = 9.81 * (scale.mean(axis=-1) - 1)
    # float32: the last bits of a hover force, 1e-6 of 9.81 m/s^2 over 2 ms
    np.testing.assert_allclose(sim.data.states.vel[..., 2], acc * dt, atol=1e-6, rtol=1e-4)
    hover_thrust, p = float(nominal.params.mass[0]) * 9.81 / 4, nominal.params
    arm, mixing = float(p.L[0]), np.asarray(p.mixing_matrix, np.float64)
    torque = (scale * hover_thrust * arm) @ mixing[:2].T
    expected = dt * torque / np.diag(p.J)[:2]
    np.testing.assert_allclose(sim.data.states.ang_vel[..., :2], expected, rtol=1e-3, atol=1e-4)
