"""Loads on rods and cables: invariants, impacts, the limit of no mass, and the laws.

Flights use the fused engine, whose programs compile in a quarter of the time.
"""

import jax
import numpy as np
import pytest
from cases import INTEGRATORS, with_params, with_record, with_states
from scipy.spatial.transform import Rotation
from tangents import push_forward

from crazysim import Sim
from crazysim.plugins.payloads import SlungLoad, direction

MASS, LOAD = 0.605, 0.2
"""Masses of drone and load, kg."""
OFFSET = (0.02, 0.01, -0.03)
"""Position of an attachment off the centre of mass, body frame, m."""


def build(n_worlds=1, n_drones=1, height=500.0, **kwargs):
    options = {"drone": "bumblebee", "control": "rotor_vel", "engine": "fused", "strict": True} | kwargs
    sim = Sim(n_worlds, n_drones, **options)
    sim.data = with_states(sim.data, pos=np.asarray(sim.data.states.pos) + [0, 0, height])
    return sim


def momentum(load, data):
    """Return momentum, and angular momentum about the common centre of mass. (n_worlds, 3) each"""
    s, r = data.states, load.read(data)
    x, y, v, u, quat, w = (np.asarray(a)[:, 0] for a in (s.pos, r.pos, s.vel, r.vel, s.quat, s.ang_vel))
    centre, mean = (MASS * x + LOAD * y) / (MASS + LOAD), (MASS * v + LOAD * u) / (MASS + LOAD)
    spin = Rotation.from_quat(quat).apply(w @ np.asarray(data.params.J))
    orbit = MASS * np.cross(x - centre, v - mean) + LOAD * np.cross(y - centre, u - mean)
    return MASS * v + LOAD * u, orbit + spin


def relative_energy(load, data):
    """Return the kinetic energy of drone and load relative to their centre of mass, J. (n_worlds,)"""
    s, r = data.states, load.read(data)
    v, u, w = (np.asarray(a)[:, 0] for a in (s.vel, r.vel, s.ang_vel))
    reduced = MASS * LOAD / (MASS + LOAD)
    return reduced / 2 * np.sum((v - u) ** 2, axis=-1) + np.sum(w @ np.asarray(data.params.J) * w, axis=-1) / 2


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_law_08_momentum_and_energy_of_drone_and_load_are_kept(integrator, x64):
    """In free fall the tension is the only force: 10 s at 500 Hz, attached at the centre of mass and off it."""
    sim, attach = build(2, integrator=integrator), np.array([(0, 0, 0), OFFSET])
    load = sim.add(SlungLoad(mass=LOAD, attach=attach[:, None], in_scene=False))
    sim.data = with_record(load, sim.data, vel=(1.0, 0.5, 0.0))
    (p0, l0), e0 = momentum(load, sim.data), relative_energy(load, sim.data)
    n = 5000
    sim.step(n)
    p, spin = momentum(load, sim.data)
    np.testing.assert_allclose(p, p0 + [0, 0, -9.81 * n / 500 * (MASS + LOAD)], atol=1e-11)
    assert np.abs(relative_energy(load, sim.data) / e0 - 1).max() < 2e-3
    assert (np.linalg.norm(spin - l0, axis=-1) < 1e-2 * np.linalg.norm(l0, axis=-1)).all()
    record, states = load.read(sim.data), sim.data.states
    load_pos, pos, quat = (np.asarray(x)[:, 0] for x in (record.pos, states.pos, states.quat))
    length = np.linalg.norm(load_pos - pos - Rotation.from_quat(quat).apply(attach), axis=-1)
    assert np.abs(length - 0.4).max() < 1e-4


@pytest.mark.parametrize(("integrator", "cable"), [*((integrator, False) for integrator in INTEGRATORS), ("rk4", True)])
def test_law_08_energy_never_grows_below_a_heavy_drone(integrator, cable):
    """A pendulum below a hovering body of 1e9 kg: 60 s at 500 Hz in float32, with amplitudes up to 2.5 rad."""
    sim = build(8, integrator=integrator, height=2.0)
    sim.data = with_params(sim.data, mass=np.full(1, 1e9, np.float32))
    sim.data = with_states(sim.data, force=np.array([0, 0, 9.81e9]))
    load = sim.add(SlungLoad(mass=LOAD, cable=cable, in_scene=False))
    angle = np.linspace(0.2, 2.5, 8)
    pos = np.stack([0.4 * np.sin(angle), 0 * angle, 2 - 0.4 * np.cos(angle)], axis=-1)[:, None]
    sim.data = with_record(load, sim.data, pos=pos)

    def energy():
        r, s = load.read(sim.data), sim.data.states
        load_pos, vel, pos, drone_vel = (np.asarray(x)[:, 0] for x in (r.pos, r.vel, s.pos, s.vel))
        return 9.81 * (load_pos - pos)[:, 2] + np.sum((vel - drone_vel) ** 2, axis=-1) / 2

    start, energies = energy(), []
    for _ in range(60):
        sim.step(497)
        energies.append(energy())
    span = 2 * 9.81 * 0.4
    # Semi-implicit schemes oscillate within a band of dt, which does not widen.
    assert (np.array(energies) - start).max() < 0.01 * span
    assert (np.array(energies)[-20:].max(0) - np.array(energies)[:20].max(0)).max() < 0.002 * span
    if not cable:
        assert np.abs(np.array(energies) - start).max() < 0.01 * span


def test_a_load_without_mass_does_not_change_the_flight():
    flights = []
    for mass in (None, 0.0):
        sim = build(integrator="rk4", height=5.0)
        if mass is not None:
            load = sim.add(SlungLoad(mass=mass, attach=OFFSET, damping=0.001, drag=0.1, in_scene=False))
        sim.rotor_vel_control(np.array([[[12000.0, 12100, 12050, 11990]]]))
        sim.step(300)
        flights.append(sim.data.states)
    for name in ("pos", "quat", "vel", "ang_vel"):
        np.testing.assert_allclose(getattr(flights[1], name), getattr(flights[0], name), rtol=1e-5, atol=1e-5)
    assert np.isfinite(load.read(sim.data).pos).all()


def test_a_cable_that_becomes_taut_ends_the_relative_motion_along_it(x64):
    """The impulse of two masses along the line, with and without a bounce: speeds by hand."""
    sim, restitution = build(2, integrator="rk4", engine="interpret"), np.array([0.0, 0.6])
    load = sim.add(SlungLoad(mass=LOAD, cable=True, restitution=restitution[:, None], in_scene=False))
    start = np.asarray(sim.data.states.pos)
    sim.data = with_record(load, sim.data, pos=start + [0, 0, -0.35], vel=(0.0, 0.0, -1.0))
    sim.step(15)  # 3 cm: still slack
    v, u = np.asarray(sim.data.states.vel)[:, 0, 2], np.asarray(load.read(sim.data).vel)[:, 0, 2]
    np.testing.assert_allclose(v - u, 1.0, atol=1e-9)
    sim.step(15)
    t = 30 / 500
    mean = -LOAD / (MASS + LOAD) - 9.81 * t
    v, u = np.asarray(sim.data.states.vel)[:, 0, 2], np.asarray(load.read(sim.data).vel)[:, 0, 2]
    np.testing.assert_allclose(MASS * v + LOAD * u, (MASS + LOAD) * mean, rtol=1e-9)
    np.testing.assert_allclose(v - u, -restitution, atol=1e-3)


def test_the_order_of_convergence_is_that_of_the_integrator(x64):
    """With a load Runge-Kutta has order four and Euler's scheme order one; both converge to the same flight.

    The load has drag, and its joint damping and a position far from the centre of mass. Each of them reduces the order
    of Runge-Kutta to 1 to 3 if it is implicit in time, or if lengths are corrected by a fraction per step.
    """

    def end(integrator, freq):
        sim = build(integrator=integrator, freq=freq)
        far = (0.05, 0.03, -0.1)
        load = sim.add(SlungLoad(mass=LOAD, attach=far, drag=0.05, damping=0.001, in_scene=False))
        sim.data = with_states(sim.data, ang_vel=np.array([0.5, -1.0, 2.0]), vel=np.array([0.3, 0, 0]))
        sim.data = load.hang(sim.data)
        sim.rotor_vel_control(np.full((1, 1, 4), 13000.0))
        sim.step(freq // 2)
        return np.concatenate([np.ravel(load.read(sim.data).pos), np.ravel(sim.data.states.ang_vel)])

    exact = end("rk4", 3200)
    for integrator, order, freqs in (("rk4", 4, (100, 400)), ("euler", 1, (250, 1000))):
        errors = [np.abs(end(integrator, freq) - exact).max() for freq in freqs]
        slope = np.log(errors[0] / errors[1]) / np.log(freqs[1] / freqs[0])
        assert abs(slope - order) < 0.4, (integrator, errors)


@pytest.mark.parametrize(("name", "direction"), [("mass", 1.0), ("length", 1.0), ("vel", [0.5, -1.0, 0.7])])
def test_law_08_slopes_are_central_differences(name, direction, x64):
    sim = build(height=2.0, engine="interpret")
    mass, length = np.full((1, 1), LOAD), np.full((1, 1), 0.4)  # of each drone, since shared numbers have no slopes
    load = sim.add(SlungLoad(mass, length, attach=OFFSET, damping=0.001, cable=True, in_scene=False))
    sim.rotor_vel_control(np.full((1, 1, 4), 13000.0))
    data = jax.tree.map(lambda x: x.astype(float) if x.dtype == np.float32 else x, sim.data)
    data = with_record(load, data, vel=(0.3, 0.2, -0.1))
    number, path = np.asarray(getattr(load.read(data), name)), f".plugins['load'].{name}"
    slopes = push_forward(sim.step_fn, data, {path: np.asarray(direction)}, 40)
    ahead, behind = (
        sim.step_fn(with_record(load, data, **{name: number + h * np.asarray(direction)}), 40) for h in (1e-5, -1e-5)
    )
    ends = {".states.pos": lambda x: x.states.pos, ".states.ang_vel": lambda x: x.states.ang_vel}
    ends[".plugins['load'].vel"] = lambda x: load.read(x).vel
    for path, read in ends.items():
        expected = np.asarray(read(ahead) - read(behind)) / 2e-5
        assert np.abs(expected).max() > 1e-4
        np.testing.assert_allclose(slopes[path], expected, rtol=2e-4, atol=1e-6, err_msg=path)


def test_a_released_load_comes_to_rest_on_the_floor(x64):
    sim = build(height=1.0)
    load = sim.add(SlungLoad(mass=LOAD, cable=True, size=(0.1, 0.1, 0.06), in_scene=False))
    sim.data = with_record(load, load.release(sim.data), vel=(0.5, 0.0, 0.0))
    sim.step(500)
    pos, vel = (np.asarray(x)[0, 0] for x in (load.read(sim.data).pos, load.read(sim.data).vel))
    np.testing.assert_allclose(pos[2], 0.03, atol=1e-12)
    np.testing.assert_allclose(vel, 0, atol=1e-12)
    assert 0.1 < pos[0] < 0.3  # it fell for 0.34 s at 0.5 m/s, and friction stopped it


def test_loads_are_objects_of_the_scene():
    sim = build(2, 2, height=1.0, engine="interpret")
    load = sim.add(SlungLoad(mass=0.05, cable=True, size=0.05))
    pos = np.asarray(load.read(sim.data).pos).copy()
    pos[1, 0] = np.asarray(sim.data.states.pos)[1, 1]  # into the other drone
    sim.data = with_record(load, sim.data, pos=pos)
    report = sim.contact_report(floor=False, drones=False)
    assert report.object_names == ("load:0", "load:1")
    touched = np.asarray(report.objects)
    assert touched[1, 1, 0]
    assert not touched[0].any()
    assert not touched[1, 0].any()
    sim.sync(1)
    body = sim.mj_model.body("load:0").mocapid.item()
    np.testing.assert_allclose(sim.mj_data.mocap_pos[body], pos[1, 0], atol=1e-6)
    sim.step()
    sim.sync(1)
    np.testing.assert_allclose(sim.mj_data.mocap_pos[body], np.asarray(load.read(sim.data).pos)[1, 0], atol=1e-6)


def test_direction_and_its_rate(x64):
    sim = build()
    load = sim.add(SlungLoad(mass=LOAD, attach=OFFSET, in_scene=False))
    sim.data = with_states(sim.data, ang_vel=np.array([1.0, 2.0, 3.0]))
    sim.data = with_record(load, sim.data, vel=(0.3, 0.2, 0.1))
    q, rate = (np.asarray(x) for x in jax.jit(direction)(sim.data))
    np.testing.assert_allclose(q[0, 0], [0, 0, -1], atol=1e-12)
    lever = np.cross([1.0, 2.0, 3.0], OFFSET)
    np.testing.assert_allclose(rate[0, 0], (np.array([0.3, 0.2, 0]) - lever * [1, 1, 0]) / 0.4, atol=1e-12)
