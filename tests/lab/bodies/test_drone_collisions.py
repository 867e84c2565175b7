"""Drones that collide: speeds by hand, momentum, energy, and overlaps."""

import numpy as np
import pytest
from cases import with_params, with_states
from scipy.spatial.transform import Rotation

from crazysim import DroneCollisions, Sim

N_WORLDS, N_DRONES = 64, 3
START = np.array([[0.2 * i, 0.0, 20.0] for i in range(N_DRONES)])
FAR = np.array([[5.0, 0.0, 20.0]])
"""Position of a third drone that nobody meets."""


@pytest.fixture(scope="module")
def shared_sim():
    sim = Sim(N_WORLDS, N_DRONES, control="rotor_vel")
    sim.data = with_params(sim.data, drag_matrix=0 * np.asarray(sim.data.params.drag_matrix))
    sim.data = with_states(sim.data, pos=START)
    sim.build_default_data()
    sim.add(DroneCollisions())
    return sim


@pytest.fixture
def build(shared_sim):
    """Return a function that gives the shared simulation, which compiles once, other numbers of the plugin."""

    def replace(**numbers):
        shared_sim.replace(DroneCollisions(**numbers))
        shared_sim.reset()
        return shared_sim

    return replace


@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_a_central_impact_passes_momentum_on(build, restitution):
    """With equal masses (1 + e) / 2 of the speed goes to the drone that is hit; the other world has no impact."""
    sim = build(restitution=restitution)
    vel = np.zeros((N_WORLDS, N_DRONES, 3))
    vel[0, 0, 0], vel[1, 0, 0] = 2.0, -2.0
    sim.data = with_states(sim.data, pos=np.concatenate([START[:2], FAR]), vel=vel)
    sim.step(80)
    vel_x = np.asarray(sim.data.states.vel)[:2, :2, 0]
    fraction = (1 + restitution) / 2
    np.testing.assert_allclose(vel_x[0], [2 * (1 - fraction), 2 * fraction], atol=0.02)
    np.testing.assert_allclose(vel_x[1], [-2.0, 0.0], atol=1e-6)


def test_momentum_is_kept_in_an_oblique_impact_of_three(build):
    sim = build(friction=0.8)
    sim.data = with_states(sim.data, vel=np.array([[2.0, 0.1, 0.05], [0, 0, 0], [-1.0, 0.0, 0.1]]))
    before = np.asarray(sim.data.states.vel, np.float64)[0].sum(axis=0)
    sim.step(100)
    after = np.asarray(sim.data.states.vel, np.float64)[0].sum(axis=0) + [0, 0, 3 * 9.81 * 0.2]
    np.testing.assert_allclose(after, before, atol=1e-4)
    assert np.abs(np.asarray(sim.data.states.ang_vel))[0].max() > 0.1, "the impact turns them"
    pos = np.asarray(sim.data.states.pos)[0]
    assert np.all(np.diff(pos[:, 0]) > 0.05), "none has passed through another"


def test_an_overlap_is_removed_without_a_velocity(build):
    """Two drones that overlap at the start separate within tenths of a second, and then fall at the same speed."""
    sim = build()
    sim.data = with_states(sim.data, pos=np.concatenate([[[0, 0, 20.0], [0.0, 0, 20.01]], FAR]))
    sim.step(250)
    states = sim.data.states
    height = 2 * sim.airframe.value("shape.collision_box")[5]
    np.testing.assert_allclose(np.diff(np.asarray(states.pos)[0, :2, 2]), height, atol=1e-4)
    np.testing.assert_allclose(np.diff(np.asarray(states.vel)[0, :2], axis=0), 0, atol=1e-4)


def test_law_08_impacts_of_any_attitude_add_no_energy(build, rng):
    """Rotating drones with restitution 1 and friction.

    Energies are measured in the frame of the mean velocity, which only gravity changes.
    """
    sim = build(restitution=1.0)
    vel = 0.3 * rng.normal(size=(N_WORLDS, N_DRONES, 3)) - 2 * np.arange(N_DRONES)[:, None] * [1, 0, 0]
    sim.data = with_states(
        sim.data,
        pos=START + rng.uniform(-0.04, 0.04, vel.shape) * [0, 1, 1],
        vel=vel,
        quat=Rotation.random(N_WORLDS * N_DRONES, rng=rng).as_quat().reshape(N_WORLDS, N_DRONES, 4),
        ang_vel=5 * rng.normal(size=vel.shape),
    )
    mass, inertia = (np.asarray(x, np.float64) for x in (sim.data.params.mass[0], sim.data.params.J))

    def energy():
        v, w = (np.asarray(x, np.float64) for x in (sim.data.states.vel, sim.data.states.ang_vel))
        v = v - v.mean(axis=1, keepdims=True)
        return 0.5 * mass * (v**2).sum(axis=(1, 2)) + 0.5 * np.einsum("wni,ij,wnj->w", w, inertia, w)

    energies = [energy()]
    for _ in range(20):
        sim.step(10)
        energies.append(energy())
    changes = np.array(energies) / energies[0] - 1
    assert changes.max() < 0.02, "the integration of fast spins adds this much"
    assert changes[-1].min() < -0.3, "they collide, with friction"
