"""Loads that collide with obstacles and drones: bounces, momentum, energy, contact logs, and engines."""

import jax
import jax.numpy as jnp
import numpy as np
from cases import with_params, with_record, with_states
from scipy.spatial.transform import Rotation

from crazysim import ContactResponse, Hook, Sim, SlungLoad
from crazysim.core.pipeline import remove_fn
from crazysim.engine import Step

RADIUS = 0.03
LENGTH = 0.4
BOX = (0.06, 0.08, 0.05)
"""Lengths of loads that hit from all sides, m."""


def build(n_worlds=1, n_drones=1, height=3.0, **kwargs):
    """Return a simulation of drones at a height, without drag and with motors off."""
    options = {"drone": "bumblebee", "control": "rotor_vel", "engine": "fused"} | kwargs
    sim = Sim(n_worlds, n_drones, **options)
    sim.data = with_params(sim.data, drag_matrix=0 * np.asarray(sim.data.params.drag_matrix))
    sim.data = with_states(sim.data, pos=np.asarray(sim.data.states.pos) + [0, 0, height])
    return sim


def remove_gravity(sim):
    sim.data = with_params(sim.data, gravity_vec=0 * np.asarray(sim.data.params.gravity_vec))
    return sim


def fix_drones(sim):
    sim.data = with_params(sim.data, mass=np.full(1, 1e9, np.float32))
    sim.data = with_states(sim.data, force=np.array([0, 0, 9.81e9]))


def leave_out_drones(sim):
    """Remove the response of drones to surfaces: they touch none here, and it takes most of the time to compile."""
    remove_fn(sim.step_pipeline, "contact_response")
    sim.build_step_fn()


def load_motion(load, sim):
    """Return position and velocity of the load of the first drone, in each world. (n_worlds, 3) each"""
    record = load.read(sim.data)
    return np.asarray(record.pos)[..., 0, :], np.asarray(record.vel)[..., 0, :]


OBSTACLES = {
    "wall": {"thickness": 0.1, "height": 2.7}, "pole": {"radius": 0.05, "height": 2.7}, "sphere": {"radius": 0.05},
}  # fmt: skip


def test_a_swing_ends_at_an_obstacle_with_the_restitution():
    """Below a fixed drone, a load is released from the side and hits an obstacle at its lowest point.

    Each kind of obstacle stands there in three worlds, one for each restitution, and far away in the others.
    """
    sim = build(9)
    fix_drones(sim)
    load = sim.add(SlungLoad(mass=0.1, length=LENGTH, size=RADIUS))
    for k, (kind, options) in enumerate(OBSTACLES.items()):
        handle = sim.scene.add(kind, **options)
        pos = np.tile([0.05 + RADIUS, 0, 2.6 if kind == "sphere" else 0.0], (9, 1))
        pos[np.arange(9) // 3 != k, 1] = 50.0 + 10 * k
        sim.data = handle.set_pose(sim.data, pos[:, None])
    response = sim.add(ContactResponse(friction=0.0))
    leave_out_drones(sim)
    restitution = np.tile([0.0, 0.5, 0.8], 3)
    record = response.read(sim.data).replace(restitution=restitution[:, None, None].astype(np.float32))
    angle = 0.5
    sim.data = response.write(sim.data, record)
    sim.data = with_record(load, sim.data, pos=[-LENGTH * np.sin(angle), 0, 3 - LENGTH * np.cos(angle)])
    fall = np.sqrt(2 * 9.81 * LENGTH * (1 - np.cos(angle)))
    track = []
    for _ in range(200):
        sim.step()
        track.append(np.concatenate(load_motion(load, sim), axis=-1))
    x, v = np.array(track)[..., 0], np.array(track)[..., 3]
    hits = np.argmax(v, axis=0) + 1
    for world, (hit, kind) in enumerate(zip(hits, np.repeat(list(OBSTACLES), 3), strict=True)):
        speed = v[hit - 1 : hit + 1, world]
        np.testing.assert_allclose(speed[0], fall, rtol=0.02, err_msg=kind)
        np.testing.assert_allclose(speed[1], -restitution[world] * fall, atol=0.02 * fall, err_msg=kind)
    assert (x.max(axis=0) < fall / 500 + 1e-3).all()  # at most one step beyond
    assert (np.abs(x[-1, restitution == 0]) < 2e-3).all(), "it rests at the obstacle"
    assert (x[-1, restitution == 0.5] < -0.02).all()


def test_a_moving_object_pushes_a_load():
    sim = remove_gravity(build(engine="interpret"))
    load = sim.add(SlungLoad(mass=0.1, size=RADIUS))
    ball = sim.scene.add("sphere", radius=0.1)
    sim.add(ContactResponse(restitution=0.0, friction=0.0))
    leave_out_drones(sim)
    ball_pos = load_motion(load, sim)[0] - [0.129, 0, 0]
    sim.data = ball.set_pose(load.release(sim.data), ball_pos, vel=[0.5, 0, 0])
    sim.step()
    np.testing.assert_allclose(load_motion(load, sim)[1][0], [0.5, 0, 0], atol=5e-3)


def momentum(load, data, mass):
    """Return momentum and angular momentum of each world about the origin. (n_worlds, 3) each"""
    s, r = jax.tree.map(np.asarray, (data.states, load.read(data)))
    m, J = np.asarray(data.params.mass), np.asarray(data.params.J)
    spin = Rotation.from_quat(s.quat.reshape(-1, 4)).apply((s.ang_vel @ J).reshape(-1, 3)).reshape(s.pos.shape)
    angular = m * np.cross(s.pos, s.vel) + spin + mass * np.cross(r.pos, r.vel)
    return (m * s.vel + mass * r.vel).sum(1), angular.sum(1)


def energy(load, data, mass):
    """Return the kinetic energy of each world, J. (n_worlds,)"""
    s, r = jax.tree.map(np.asarray, (data.states, load.read(data)))
    rotational = np.einsum("wni,ij,wnj->w", s.ang_vel, np.asarray(data.params.J), s.ang_vel)
    translational = float(data.params.mass[0]) * np.square(s.vel) + mass * np.square(r.vel)
    return 0.5 * (translational.sum((1, 2)) + rotational)


def test_law_08_a_load_that_hits_a_drone_keeps_momentum(x64, rng):
    """Released loads hit two drones from all sides. The contact stage by itself keeps momentum and adds no energy."""
    n = 60
    sim = remove_gravity(build(n, 2))
    load = sim.add(SlungLoad(mass=0.2, size=BOX))
    sim.add(ContactResponse(restitution=0.7, friction=0.5))
    step = Step({"hit": sim.step_pipeline["contact_response_of_load_and_drones"]}, "interpret")
    quat = rng.normal(size=(n, 2, 4))
    data = with_states(
        load.release(sim.data), vel=rng.normal(size=(n, 2, 3)), ang_vel=3 * rng.normal(size=(n, 2, 3)),
        quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
    )  # fmt: skip
    load_pos = np.asarray(data.states.pos) + rng.uniform(-0.12, 0.12, (n, 2, 3))
    before = with_record(load, data, pos=load_pos, vel=2 * rng.normal(size=(n, 2, 3)))
    after = step(before, np.int32(1))
    for old, new in zip(momentum(load, before, 0.2), momentum(load, after, 0.2), strict=True):
        np.testing.assert_allclose(new, old, atol=1e-12)
    # The separation of overlaps, at up to 0.25 m/s, may add energy.
    assert (energy(load, after, 0.2) < energy(load, before, 0.2) + 0.5 * (0.2 + 0.605) * 0.25**2).all()
    hits = np.abs(np.asarray(after.plugins["contact_response"].impulse)).max(axis=(1, 2)) > 1e-3
    assert hits.sum() > 20


def test_law_08_loads_and_hooks_that_hit_each_other_keep_momentum(x64, rng):
    """Three released loads and three empty hooks overlap. The contact stage keeps momentum and adds no energy."""
    n = 60
    sim = remove_gravity(build(n, 3))
    load_mass = np.broadcast_to([0.1, 0.2, 0.3], (n, 3))
    hook = sim.add(Hook(mass=load_mass, hook_mass=0.05, size=BOX, ring=0.1, load_at=[0, 0, 1.0]))
    sim.add(ContactResponse(restitution=0.7, friction=0.5))
    step = Step({"hit": sim.step_pipeline["contact_response_between_load"]}, "interpret")
    mass = np.array([0.1, 0.2, 0.3, 0.05, 0.05, 0.05])[:, None]
    state = {name: rng.normal(size=(n, 3, 3)) for name in ("vel", "tip_vel")}
    heap = np.array([0, 0, 3.0])
    pos = heap + rng.uniform(-0.08, 0.08, (n, 3, 3))
    tip = heap + rng.uniform(-0.08, 0.08, (n, 3, 3))
    data = with_record(hook, sim.data, pos=pos + [0, 0, 0.1], tip_pos=tip, **state)
    records = (hook.read(x) for x in (data, step(data, np.int32(1))))
    old, new = (np.concatenate([x.vel, x.tip_vel], axis=1) for x in records)
    np.testing.assert_allclose((mass * new).sum(1), (mass * old).sum(1), atol=1e-12)
    assert (np.sum(mass * new**2, axis=(1, 2)) < np.sum(mass * old**2, axis=(1, 2)) + mass.sum() * 0.25**2).all()
    moved = np.abs(new - old).max(axis=-1) > 1e-3
    assert moved[:, :3].any(axis=1).sum() > 20, "loads"
    assert moved[:, 3:].any(axis=1).sum() > 20, "hooks"


def test_an_empty_hook_stops_at_an_obstacle_and_pushes_a_load():
    """In the first world the hook hits a box 1 cm ahead, in the second a load of the same mass."""
    sim = remove_gravity(build(2, strict=True, engine="interpret"))
    sim.data = with_params(sim.data, mass=np.full(1, 1e9, np.float32))
    hook = sim.add(Hook(mass=0.1, hook_mass=0.1, damping=0.0, size=RADIUS, ring=0.01, load_at=[0, 0, 1.0]))
    box = sim.scene.add("box", pos=[5, 0, 0], size=(0.1, 1.0, 1.0))
    sim.add(ContactResponse(restitution=0.5, friction=0.0))
    leave_out_drones(sim)
    tip = np.asarray(sim.data.states.pos) - [0, 0, 0.4]
    sim.data = box.set_pose(sim.data, [[tip[0, 0] + [0.0245 + 0.05 + 0.01, 0, 0]], [[9, 9, 9]]])
    sim.data = with_record(hook, sim.data, tip_pos=tip, tip_vel=[1.0, 0, 0], reach=0.001)
    pos = np.stack([np.full((1, 3), 5.0), tip[1] + [0.0245 + RADIUS + 0.01, 0, 0.021 + 0.01]])
    sim.data = with_record(hook, sim.data, pos=pos)
    sim.step(10)
    record = hook.read(sim.data)
    np.testing.assert_allclose(np.asarray(record.tip_vel)[:, 0, 0], [-0.5, 0.25], atol=0.01)
    np.testing.assert_allclose(np.asarray(record.vel)[:, 0, 0], [0.0, 0.75], atol=0.01)
    assert "not fused" not in sim.explain()


def test_a_contact_report_contains_empty_hooks():
    sim = build(n_drones=2)
    hook = sim.add(Hook(mass=0.1, load_at=[0, 0, 1.0]))
    tip = np.asarray(sim.data.states.pos)[:, ::-1]
    sim.data = with_record(hook, sim.data, tip_pos=tip)
    report = sim.contact_report(floor=False, drones=False)
    assert report.object_names == ("load:0", "load:1", "load_hook:0", "load_hook:1")
    np.testing.assert_array_equal(
        np.asarray(report.objects)[0], [[False, False, False, True], [False, False, True, False]]
    )


def test_a_wall_that_stops_a_load_holds_back_the_drone():
    """Through the taut rod: the drone flies on towards the wall only until the load has reached it."""
    sim = remove_gravity(build())
    load = sim.add(SlungLoad(mass=0.2, size=RADIUS))
    sim.scene.add("box", pos=[0.4 + RADIUS + 0.05 + 0.01, 0, 3], size=(0.1, 1.0, 1.0))
    sim.add(ContactResponse(restitution=0.0))
    leave_out_drones(sim)
    start = np.asarray(sim.data.states.pos)
    sim.data = with_record(load, with_states(sim.data, vel=[0.5, 0, 0]), pos=start + [LENGTH, 0, 0], vel=[0.5, 0, 0])
    sim.step(100)
    pos, vel = np.asarray(sim.data.states.pos), np.asarray(sim.data.states.vel)
    assert np.abs(vel[0, 0, 0]) < 0.27  # overlaps are separated at 0.25 m/s at most
    assert pos[0, 0, 0] - start[0, 0, 0] < 0.015


def test_the_bounce_has_gradients(x64):
    """The derivative of a drone's speed after a hit by the load's speed before equals the difference quotient.

    Gradients by all states are finite: of a hit (first world), and of loads within their drones, far away, and in the
    middle of an obstacle.
    """
    sim = remove_gravity(build(4, 2, engine="plain"))
    load = sim.add(SlungLoad(mass=0.2, size=RADIUS))
    sim.scene.add("sphere", pos=[5, 0, 3], radius=0.1)
    sim.add(ContactResponse(restitution=0.5, friction=0.3))
    load_stages = [name for name in sim.step_pipeline if name.startswith("contact_response_")]
    assert len(load_stages) == 3
    stages = [sim.step_pipeline[name] for name in ("integration", *load_stages)]
    pos = np.array(sim.data.states.pos)[:, ::-1]
    pos[0] += [0.01, 0, -0.06]
    pos[2, :, 1] += 2.0
    pos[3] = [5, 0, 3]
    data = with_record(load, load.release(sim.data), pos=pos, vel=[0, 0, 1.0])

    def drone_speeds(speed, states, record):
        moved = with_record(load, load.write(data.replace(states=states), record), vel=np.array([0.1, 0, 1.0]) * speed)
        for stage in stages:
            moved = stage(moved)
        return jnp.sum(moved.states.vel[..., 2]), moved.states.vel[0, 0, 2]

    slopes = jax.jit(jax.value_and_grad(drone_speeds, argnums=(0, 1, 2), allow_int=True, has_aux=True))
    results = [slopes(speed, data.states, load.read(data)) for speed in (2.0, 2.001, 1.999)]
    ((_, now), (slope, *gradient)), ((above, _), _), ((lower, _), _) = results
    np.testing.assert_allclose(slope, (above - lower) / 0.002, rtol=1e-4)
    assert now > 0.1
    for x in jax.tree.leaves(gradient):
        assert x.dtype == jax.dtypes.float0 or np.isfinite(x).all()
