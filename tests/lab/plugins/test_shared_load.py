"""One load under several drones."""

import numpy as np
import pytest
from cases import broadcast_like, with_params, with_states

from crazysim import Sim
from crazysim.plugins.payloads import SharedLoad, SlungLoad

SETTINGS = {"drone": "bumblebee", "control": "rotor_vel", "engine": "fused", "strict": True}
CORNERS = np.array([[0.3, 0.3, 5.0], [-0.3, 0.3, 5.0], [-0.3, -0.3, 5.0], [0.3, -0.3, 5.0]])
"""Start positions of the drones, m."""


def build(n_drones, integrator, engine="fused", **settings):
    sim = Sim(1, n_drones, **SETTINGS | {"engine": engine}, integrator=integrator)
    sim.data = with_states(sim.data, pos=CORNERS[:n_drones])
    return sim, sim.add(SharedLoad(**{"in_scene": False, "mass": 0.3} | settings))


def test_a_shared_load_of_one_drone_is_a_slung_load(x64):
    ends = []
    for kind in (SharedLoad, SlungLoad):
        sim = Sim(**SETTINGS, integrator="rk4")
        sim.data = with_states(sim.data, pos=CORNERS[:1])
        load = sim.add(kind(mass=0.2, length=0.4, cable=False, attach=(0.02, 0.01, -0.03), in_scene=False))
        record = load.read(sim.data)
        start = broadcast_like(np.asarray(sim.data.states.pos) + [0.02, 0.01, -0.43], record.pos)
        sim.data = load.write(sim.data, record.replace(pos=start, vel=broadcast_like([0.5, 0.2, 0.0], record.vel)))
        sim.step(200)
        ends.append(np.concatenate([np.ravel(load.read(sim.data).pos), np.ravel(sim.data.states.ang_vel)]))
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-5)  # SOFT is a millionth of the tension


@pytest.mark.parametrize(("integrator", "cable"), [("symplectic_euler", True), ("rk4", False)])
def test_four_drones_share_the_weight_and_keep_momentum(integrator, cable, x64):
    sim, load = build(4, integrator, cable=cable)
    mass = float(sim.data.params.mass[0])
    carried_mass = mass + 0.3 / 4
    drop = np.sqrt(1 - 0.18)
    pull = 0.3 / 4 * 9.81 * 0.3 / drop  # horizontal pull on each, towards the middle
    outward = np.sign(CORNERS[:, :2]) * pull
    force = np.concatenate([outward, np.full((4, 1), carried_mass * 9.81)], axis=-1)
    sim.data = with_states(sim.data, force=force)
    sim.step(250)
    np.testing.assert_allclose(np.asarray(sim.data.states.pos)[0], CORNERS, atol=1e-4)
    np.testing.assert_allclose(np.asarray(load.read(sim.data).pos)[0, 0], [0, 0, 5 - drop], atol=1e-4)
    sim.data = with_states(sim.data, vel=np.random.default_rng(0).normal(size=(4, 3)), force=np.zeros((4, 3)))

    def momentum():
        return mass * np.asarray(sim.data.states.vel)[0].sum(0) + 0.3 * np.asarray(load.read(sim.data).vel)[0, 0]

    before = momentum()
    sim.step(100)
    np.testing.assert_allclose(momentum() - before, [0, 0, -9.81 * 0.2 * (4 * mass + 0.3)], atol=1e-10)


def throw_apart(integrator, freq, n_worlds=32):
    """Throw one to four drones apart for 1 s, on cables of 1 m without gravity, in all directions."""
    sim = Sim(n_worlds, 4, **SETTINGS, integrator=integrator, freq=freq)
    sim.data = with_params(with_states(sim.data, pos=CORNERS), gravity_vec=np.zeros(3))
    load = sim.add(SharedLoad(mass=0.3, length=1.0, in_scene=False))
    is_held = np.arange(4) <= np.arange(n_worlds)[:, None] % 4
    vel = np.random.default_rng(0).normal(size=(n_worlds, 4, 3))
    sim.data = load.release(with_states(sim.data, vel=vel), ~is_held)
    masses = np.append(np.where(is_held, float(sim.data.params.mass[0]), 0.0), np.full((n_worlds, 1), 0.3), 1)[
        ..., None
    ]

    def observe():
        record = load.read(sim.data)
        pos, vel = (np.append(getattr(sim.data.states, x), getattr(record, x), 1) for x in ("pos", "vel"))
        offset, rel_vel = (x - (masses * x).sum(1, keepdims=True) / masses.sum(1, keepdims=True) for x in (pos, vel))
        distance = np.linalg.norm(pos[:, :4] - pos[:, 4:], axis=-1)
        return np.where(is_held, distance, 0.0).max(1), (masses * np.cross(offset, rel_vel)).sum(1)

    _, momentum = observe()
    lengths, momenta = zip(*[(sim.step(freq // 50), observe())[1] for _ in range(50)], strict=True)
    error = np.linalg.norm(np.array(momenta) - momentum, axis=-1).max(0) / np.linalg.norm(momentum, axis=-1)
    return np.max(lengths, 0), error


@pytest.mark.long("compiles two steps of four drones")
@pytest.mark.parametrize("integrator", ["symplectic_euler", "rk4"])
def test_cables_of_drones_thrown_apart_keep_their_length_and_angular_momentum(integrator, x64):
    """A taut cable of 1 m becomes longer by v^2 dt^2 / 2 in a straight step across it at a relative speed v."""
    (length, coarse_error), (fine_length, fine_error) = (throw_apart(integrator, freq) for freq in (250, 1000))
    speed = 8.0  # twice the largest speed of a drone at the start
    assert np.max(length) < 1 + (speed / 250) ** 2 / 2
    assert np.max(fine_length) < 1 + (speed / 1000) ** 2 / 2
    assert np.max(coarse_error) < 1e-3
    assert np.median(coarse_error) > 8 * np.median(fine_error)  # order 2: a sixteenth


def test_slack_and_released_cables_do_not_pull(x64):
    """The first drone has released the load, and the third is so near that its cable is slack."""
    sim, load = build(3, "symplectic_euler", "interpret")
    start_pos = np.array(CORNERS[:3])
    start_pos[2] = [0.0, 0.0, 4.5]
    sim.data = load.release(with_states(sim.data, pos=start_pos), [[True, False, False]])
    start = np.asarray(sim.data.states.pos)[0]
    sim.step(10)
    moved = np.asarray(sim.data.states.pos)[0] - start
    np.testing.assert_allclose(moved[0, :2], 0, atol=1e-12)
    np.testing.assert_allclose(moved[2, :2], 0, atol=1e-12)


def test_a_shared_load_is_drawn():
    sim = Sim(2, 3, drone="bumblebee", control="rotor_vel", integrator="symplectic_euler", engine="interpret")
    load = sim.add(SharedLoad(mass=0.3))
    sim.step(5)
    assert sim.contact_report().object_names == ("load:0",)
    sim.sync(1)
    body = sim.mj_model.body("load:0").mocapid.item()
    np.testing.assert_allclose(sim.mj_data.mocap_pos[body], np.asarray(load.read(sim.data).pos)[1, 0], atol=1e-6)
