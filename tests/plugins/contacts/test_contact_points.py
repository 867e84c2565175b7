"""Velocities of the surfaces that a drone touches."""

import jax.numpy as jnp
import numpy as np

from crazysim import Cars, Sim, rotation
from crazysim.plugins.contacts.contact_points import contact_points, find_surfaces


def test_points_on_a_turning_car_have_the_velocity_of_the_car_there():
    """The velocity is the cross product of the car's angular velocity and the position relative to the car."""
    sim = Sim(plugins=[Cars()], engine="interpret")
    cars = sim.data.plugins["cars"]
    turning = cars.with_vel(jnp.zeros_like(cars.vel), jnp.zeros_like(cars.ang_vel).at[..., 2].set(3.0))
    states = sim.data.states.replace(pos=cars.pos[:, :1] + jnp.asarray([0.2, 0.05, 0.2]))
    data = sim.data.replace(plugins={"cars": turning}, states=states)
    surfaces = [surface for surface in find_surfaces(sim, None) if surface.population == "cars"]
    contacts = contact_points(data, surfaces, np.array([0, 0, 0, 0.05, 0.05, 0.02]))
    assert contacts.point.shape == (1, 1, len(surfaces) * 10, 3)
    points = states.pos[..., None, :] + rotation.rotate(states.quat[..., None, :], contacts.point)
    expected = np.cross([0, 0, 3.0], points - cars.pos[..., None, :])
    np.testing.assert_allclose(contacts.vel, expected, atol=1e-6)
    assert np.ptp(expected, axis=2).max() > 0.1
