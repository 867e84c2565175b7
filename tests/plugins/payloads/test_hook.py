"""The hook: the impulse of picking up, release, and a hinge that turns the drone."""

import jax
import numpy as np
import pytest
from cases import broadcast_like, with_states
from scipy.spatial.transform import Rotation

from crazysim import Sim
from crazysim.plugins.payloads import Hook

MASS, LOAD = 0.605, 0.2
"""Masses of drone and load, kg."""
SETTINGS = {"drone": "bumblebee", "control": "rotor_vel", "engine": "fused", "strict": True}


def build(height=5.0, integrator="euler", **settings):
    sim = Sim(**SETTINGS, integrator=integrator)
    sim.data = with_states(sim.data, pos=np.array([0.0, 0.0, height]))
    return sim, sim.add(Hook.bumblebee(**{"in_scene": False} | settings))


def test_picking_up_keeps_momentum(x64):
    """Without a mass of the hook, P = (q.u - q.v) / (1/m + 1/m_L), and q' = (I - q q^T) (u - v) / L.

    P is the impulse along the rod's direction q, u and v are the velocities of load and drone, L is the rod's length.
    """
    sim, hook = build(integrator="rk4", hook_mass=0.0, damping=0.0, load_at=(0.0, 0.0, 4.59))
    sim.data = with_states(hook.command(sim.data, True), vel=np.array([0.1, 0.0, 0.0]))
    record = hook.read(sim.data)
    u = np.array([0.2, 0.1, -0.2])
    record = record.replace(vel=np.asarray(record.vel) + u, tip_vel=np.asarray(record.tip_vel) + [0.1, 0.0, 0.0])
    states, record = (
        jax.tree.map(lambda x: np.asarray(x)[0, 0] if np.ndim(x) > 1 else x, part) for part in (sim.data.states, record)
    )
    after = jax.jit(record.pick_up_and_release)(sim.data.replace(states=states, plugins={"load": record}))
    after = jax.tree.map(np.asarray, (after.states, after.plugins["load"]))
    (states, load), v, q = after, np.array([0.1, 0, 0]), np.array([0, 0, -1.0])
    assert load.attached
    impulse = (q @ u - q @ v) / (1 / MASS + 1 / LOAD)
    np.testing.assert_allclose(states.vel, v + impulse * q / MASS, atol=1e-12)
    direction_rate = (load.vel - states.vel) / 0.4
    np.testing.assert_allclose(direction_rate, (u - v - q * (q @ (u - v))) / 0.4, atol=1e-9)
    np.testing.assert_allclose(MASS * states.vel + LOAD * load.vel, MASS * v + LOAD * u, atol=1e-12)


def test_conditions_of_picking_up_and_release():
    """A hook takes a load only with the command, near it and at a low speed; a released load falls freely."""
    sim, hook = build(load_at=(0.0, 0.0, 4.58))
    start, record = sim.data, hook.read(sim.data)
    pos = np.asarray(record.pos)
    for drop, vel, grip, is_attached in (
        (0.08, 0, True, False),
        (0, 0.8, True, False),
        (0, 0.2, False, False),
        (0, 0.2, True, True),
    ):
        moved = record.replace(pos=broadcast_like(pos - [0, 0, drop], pos), vel=broadcast_like([vel, 0, 0], pos))
        sim.data = hook.command(hook.write(start, moved), grip)
        sim.step()
        assert np.asarray(hook.read(sim.data).attached)[0, 0] == is_attached, (drop, vel, grip)
    sim.step(50)
    sim.data = hook.command(sim.data, False)
    before = np.asarray(hook.read(sim.data).vel)
    sim.step(100)
    after = jax.tree.map(np.asarray, hook.read(sim.data))
    assert not after.attached.any()
    np.testing.assert_allclose((after.vel - before)[0, 0], [0, 0, -9.81 * 0.2], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(after.tip_pos - np.asarray(sim.data.states.pos)), 0.4, atol=1e-4)


def test_a_hinge_keeps_the_rod_in_its_plane_and_turns_the_drone(x64):
    ends = {}
    for dof in (1, 2):
        sim, hook = build(500.0, dof=dof, damping=0.0, integrator="rk4")
        record = hook.read(sim.data)
        push = broadcast_like([0.5, 0.4, 0.0], record.vel)
        sim.data = hook.write(sim.data, record.replace(vel=push, tip_vel=push))
        sim.step(250)
        s, tip = sim.data.states, hook.read(sim.data).tip_pos
        pos, quat, ang_vel, tip = (np.asarray(x)[0, 0] for x in (s.pos, s.quat, s.ang_vel, tip))
        ends[dof] = Rotation.from_quat(quat).inv().apply(tip - pos), ang_vel
    assert abs(ends[1][0][1]) < 1e-4
    assert abs(ends[2][0][1]) > 0.1
    assert np.abs(ends[1][1][[0, 2]]).max() > 0.5, "roll or yaw of the drone"
    assert np.abs(ends[2][1]).max() < 1e-9, "a force at the centre of mass does not turn it"


def test_a_load_on_the_floor_stays_at_rest(x64):
    sim, hook = build(2.0, load_at=(1.0, 0.5, 0.0))
    sim.step(50)
    record = hook.read(sim.data)
    np.testing.assert_allclose(np.asarray(record.pos)[0, 0], [1.0, 0.5, 0.04 + 0.1275])
    np.testing.assert_allclose(record.vel, 0, atol=1e-12)
    assert np.isfinite(record.tip_pos).all()


@pytest.mark.parametrize("size", [(0.14, 0.14, 0.08), 0.05])
def test_hook_and_load_are_drawn_where_they_meet(size):
    """The wires of the load end in its ring, which is at the bend of the hook that carries it."""
    sim, _ = build(2.0, in_scene=True, size=size)
    sim.scene.sync_one(sim.plugins.with_moved_objects(sim.data), 0)
    model, data = sim.mj_model, sim.mj_data

    def ends(body):
        """Return both ends of all rods of a body, world frame, m."""
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies_of(body) and model.geom_type[g] == 3]
        half = np.array([data.geom_xmat[g].reshape(3, 3)[:, 2] * model.geom_size[g, 1] for g in geoms])
        return np.concatenate([data.geom_xpos[geoms] + half, data.geom_xpos[geoms] - half])

    def bodies_of(name):
        return {b for b in range(model.nbody) if model.body_rootid[b] == model.body(name).id}

    ring = np.array([0.0, 0.0, 2.0 - 0.4])
    for body in ("load:0", "load_hook:0"):
        assert np.linalg.norm(ends(body) - ring, axis=-1).min() < 4e-3, body
    box = next(
        g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies_of("load:0") and model.geom_conaffinity[g]
    )
    np.testing.assert_allclose(data.geom_xpos[box], ring - [0, 0, 0.1275], atol=1e-5)
