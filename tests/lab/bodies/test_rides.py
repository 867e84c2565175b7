"""Drones that ride on cars, and bodies that cars push."""

import itertools

import jax
import numpy as np
import pytest
from cases import with_states

from crazysim import ContactResponse, FreeBodies, Sim
from crazysim.engine.stage import vmap_drones, vmap_worlds
from crazysim.plugins.contacts.contact_points import contact_points, find_surfaces
from crazysim.plugins.vehicles import Cars


def build(**kwargs):
    sim = Sim(control="rotor_vel")
    cars = sim.add(Cars(1, pos=(0.0, 0.0), yaw=0.0, level="speed", **kwargs))
    return sim, cars


def deck_of(sim):
    """Return the height of the upper side of the car's box, world frame, and the box's position in the car, m."""
    body = next(b for b in sim.scene.collision_model.objects if b.name == "cars:0")
    geom = max(body.geoms, key=lambda g: g.pos[2] + g.shape.size[2])
    return geom.pos[2] + geom.shape.size[2] + float(np.asarray(sim.data.plugins["cars"].pos)[0, 0, 2]), geom.pos


def test_a_drone_lands_on_a_moving_car_and_rides():
    # the body of a vehicle with two wheels is one box, half as wide as the vehicle
    sim, cars = build(vehicle={"base": "f1tenth_ros", "wheels": {"number": 2}, "shape": {"width": 0.4}})
    height, deck_pos = deck_of(sim)
    sim.add(ContactResponse(friction=0.9))
    sim.data = cars.with_command(sim.data, np.float32([[[0.8, 0.0]]]))
    sim.step(1000)
    car = cars.read(sim.data)
    np.testing.assert_allclose(np.asarray(car.vel)[0, 0, 0], 0.8, rtol=0.05)
    start = np.asarray(car.pos)[0, 0] + np.array([deck_pos[0], deck_pos[1], 0.0])
    start[2] = height + 0.06
    sim.data = with_states(sim.data, pos=start, vel=[0.8, 0, 0], quat=[0, 0, 0, 1], ang_vel=0.0)
    sim.step(250)
    gap = np.asarray(sim.data.states.pos)[0, 0] - np.asarray(cars.read(sim.data).pos)[0, 0]
    sim.data = cars.with_command(sim.data, np.float32([[[0.8, 0.15]]]))  # it turns
    sim.step(500)
    car, s = cars.read(sim.data), sim.data.states
    car_pos, pos, car_vel, vel = (np.asarray(x)[0, 0] for x in (car.pos, s.pos, car.vel, s.vel))
    assert abs(np.asarray(car.yaw)[0, 0, 0]) > 0.15
    assert pos[2] > height
    np.testing.assert_allclose(np.linalg.norm((pos - car_pos)[:2]), np.linalg.norm(gap[:2]), atol=0.005)
    np.testing.assert_allclose(vel[:2], car_vel[:2], atol=0.08)


def test_a_car_pushes_a_body():
    sim, cars = build()
    bodies = sim.add(FreeBodies(1, size=(0.2, 0.2, 0.2), mass=0.2, pos=(0.6, 0, 0.1), drones=False))
    sim.data = cars.with_command(sim.data, np.float32([[[0.5, 0.0]]]))
    sim.step(1500)
    car, body = (np.stack([x.pos, x.vel])[:, 0, 0, 0] for x in (cars.read(sim.data), bodies.read(sim.data)))
    assert body[0] > 0.8
    assert body[0] - car[0] > 0.2
    assert body[1] == pytest.approx(car[1], abs=0.05)


def test_the_deck_of_a_turning_car_moves_with_its_points():
    """The deck moves at v + w x r below each corner of the drone, for a car with 0.5 m/s and 2 rad/s."""
    sim, cars = build()
    car = cars.read(sim.data)
    sim.data = cars.write(sim.data, car.with_vel(np.float32([[[0.5, 0, 0]]]), np.float32([[[0, 0, 2.0]]])))
    sim.data = with_states(sim.data, pos=[0.1, 0.2, 0.3], quat=[0, 0, 0, 1])
    surfaces = [surface for surface in find_surfaces(sim, None) if surface.population == "cars"]
    box = np.asarray(sim.airframe.value("shape.collision_box"))
    points = vmap_worlds(vmap_drones(lambda drone: contact_points(drone, surfaces[:1], box).vel[:8]))
    vel = jax.jit(points)(sim.data)
    corners = box[:3] + box[3:] * np.array(list(itertools.product((-1, 1), repeat=3)))
    lever = corners + [0.1, 0.2, 0.3] - np.asarray(car.pos)[0, 0]
    expected = np.array([0.5, 0, 0]) + np.cross([0, 0, 2.0], lever)
    np.testing.assert_allclose(np.asarray(vel)[0, 0], expected, atol=1e-5)
