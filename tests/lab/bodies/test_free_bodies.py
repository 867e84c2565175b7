"""Free bodies: rest, slides, bounces, stacks and rides against C MuJoCo and by hand, pushes, laws, wrong input."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cases import build_stagewise_step, with_params, with_states
from scipy.spatial.transform import Rotation

from crazysim import ConfigError, ContactResponse, FreeBodies, Sim, Terrain

FREQ = 500


def build(members=1, size=(0.2, 0.2, 0.2), mass=0.1, n_worlds=1, drone_pos=None, **kwargs):
    """Return a simulation with free bodies, and its plugin. Without ``drone_pos`` only the stages of the bodies run."""
    has_drone = drone_pos is not None
    sim = Sim(n_worlds=n_worlds, control="rotor_vel", freq=FREQ, engine="auto" if has_drone else "plain")
    sim.data = with_states(sim.data, pos=drone_pos if has_drone else (-3.0, 0.0, 1.0))
    sim.build_default_data()
    plugin = sim.add(FreeBodies(members, size=size, mass=mass, **{"drones": has_drone} | kwargs))
    if not has_drone:
        keep_stages(sim)
    return sim, plugin


def keep_stages(sim, prefix="bodies"):
    """Remove all stages from the step except those of the bodies."""
    stages = sim.step_pipeline.items()
    sim.step_pipeline = {name: fn for name, fn in stages if name.startswith((prefix, "increment_steps"))}


def mujoco_track(
    bodies, seconds, friction=0.6, steps_per_pose=5, timestep=0.0005, contact='solref="0.004 1"', carrier=""
):
    """Return positions and quaternions, xyzw, of free bodies in C MuJoCo."""
    bodies_xml = ""
    for size, mass, pos, _, *quat in bodies:
        kind = "sphere" if np.ndim(size) == 0 else "box"
        geom_size = f"{size}" if np.ndim(size) == 0 else " ".join(str(s / 2) for s in size)
        orientation = " ".join(str(x) for x in np.roll(quat[0], 1)) if quat else "1 0 0 0"
        bodies_xml += f'<body pos="{pos[0]} {pos[1]} {pos[2]}" quat="{orientation}"><freejoint/>'
        bodies_xml += f'<geom type="{kind}" size="{geom_size}" mass="{mass}"/></body>'
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{timestep}" cone="elliptic" impratio="10"/>
        <default><geom friction="{friction} 0 0" condim="3" {contact}/></default>
        <worldbody><geom type="plane" size="0 0 1"/>{bodies_xml}{carrier}</worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    n, mujoco_steps = len(bodies), round(steps_per_pose / FREQ / timestep)
    for k, body in enumerate(bodies):
        data.qvel[6 * k : 6 * k + 3] = body[3]
    data.qvel[6 * n :] = 1.0
    poses = []
    for step in range(round(seconds / timestep) + 1):
        if step % mujoco_steps == 0:
            pose = data.qpos[: 7 * n].reshape(-1, 7)
            poses.append((pose[:, :3].copy(), np.roll(pose[:, 3:], -1, axis=1)))
        mujoco.mj_step(model, data)
    return [np.stack(x) for x in zip(*poses, strict=True)]


def track(sim, plugin, seconds, steps_per_pose=5):
    """Return positions and quaternions of the bodies of the first world, once in ``steps_per_pose`` steps."""
    poses = []
    for step in range(int(seconds * FREQ / steps_per_pose) + 1):
        if step:
            sim.step(steps_per_pose)
        body = plugin.read(sim.data)
        poses.append((np.asarray(body.pos, np.float64)[0], np.asarray(body.quat, np.float64)[0]))
    return [np.stack(x) for x in zip(*poses, strict=True)]


def simulate_both(bodies, seconds, friction=0.6):
    sizes, masses, pos, vel = zip(*[body[:4] for body in bodies], strict=True)
    quat = np.array([body[4] if len(body) > 4 else (0, 0, 0, 1) for body in bodies])
    sim, plugin = build(len(bodies), list(sizes), masses, pos=np.array(pos), vel=np.array(vel), quat=quat,
                        friction=friction, drones=False)  # fmt: skip
    return track(sim, plugin, seconds), mujoco_track(bodies, seconds, friction)


def test_boxes_and_balls_rest_at_their_poses():
    """Bodies neither creep nor sink nor turn in ten seconds."""
    sim, plugin = build(
        2, [(0.2, 0.3, 0.1), 0.1], pos=[[1, 0, 0.05], [2, 0, 0.1]], quat=[[0, 0, 0.2588190, 0.9659258], [0, 0, 0, 1]]
    )
    sim.step(5000)
    body = plugin.read(sim.data)
    pos, quat, impulse = (np.asarray(x)[0] for x in (body.pos, body.quat, body.impulse))
    np.testing.assert_allclose(pos, [[1, 0, 0.05], [2, 0, 0.1]], atol=2e-5)
    np.testing.assert_allclose(quat, [[0, 0, 0.2588190, 0.9659258], [0, 0, 0, 1]], atol=2e-5)
    np.testing.assert_allclose(impulse[:, 2], 0.1 * 9.81 / FREQ, rtol=1e-3)


TURN, TILTED_SIZE = Rotation.from_euler("xy", (6, 8), degrees=True), (0.2, 0.16, 0.1)
CORNERS = 0.5 * np.array(TILTED_SIZE) * np.array(list(itertools.product((-1, 1), repeat=3)))


@pytest.fixture(scope="module")
def apart():
    """Return tracks by both simulators of a tilted box, a box that slides and a ball, 5 m apart.

    Each has the positions, (n, 3), and quaternions, (n, 4), of crazysim, and those of MuJoCo.
    """
    height = 0.02 - TURN.apply(CORNERS)[:, 2].min()
    bodies = [(TILTED_SIZE, 0.3, (0, 0, height), (0, 0, 0), TURN.as_quat()),
              ((0.2, 0.2, 0.1), 0.5, (0, 5, 0.05), (2.0, 0.5, 0)), (0.1, 0.3, (0, 10, 0.1), (1.4, 0, 0))]  # fmt: skip
    tracks = simulate_both(bodies, 2.0)
    return [[(pos[:, k], quat[:, k]) for pos, quat in tracks] for k in range(3)]


def test_a_tilted_box_comes_to_rest_as_in_mujoco(apart):
    """The lowest corner falls 2 cm, then the others: the box ends level, at the same place, and sinks by micrometres.

    In MuJoCo it sinks in by 0.9 mm at the impact and bounces a little (with 0.14 of the speed at a damping ratio of 1).
    In crazysim a corner stops at once. The positions differ by up to that depth.
    """
    ours, theirs = apart[0]
    assert np.abs(ours[0] - theirs[0]).max() < 1e-3
    lowest = [(pos[-1] + Rotation.from_quat(quat[-1]).apply(CORNERS))[:, 2].min() for pos, quat in (ours, theirs)]
    np.testing.assert_allclose(lowest, 0, atol=1e-5)
    np.testing.assert_allclose(ours[0][-1], theirs[0][-1], atol=5e-4)
    np.testing.assert_allclose(ours[1][-1, :2], [0, 0], atol=1e-5)
    np.testing.assert_allclose(ours[1][-1], theirs[1][-1], atol=2e-3)


def test_a_slide_as_in_mujoco(apart):
    """A box slides v^2 / (2 mu g) = 0.34 m and stops without tipping."""
    ours, theirs = apart[1]
    slide = np.array([2.0, 0.5]) * np.hypot(2, 0.5) / (2 * 0.6 * 9.81)
    np.testing.assert_allclose(ours[0][-1, :2] - [0, 5], slide, rtol=0.02)
    assert np.abs(ours[0] - theirs[0]).max() < 0.01


def test_a_ball_that_slides_begins_to_roll_as_in_mujoco(apart):
    """The ball rolls with 5/7 of its initial speed."""
    ours, theirs = apart[2]
    assert np.abs(ours[0] - theirs[0]).max() < 0.01
    speed = (ours[0][-1, 0] - ours[0][-6, 0]) * FREQ / 25
    np.testing.assert_allclose(speed, 1.0, rtol=0.01)


def test_a_stack_of_five_rests(rng):
    """Five boxes, not quite above each other, for 2 s: below 1 mm/s from 0.2 s on, when impulses have converged."""
    pos = np.zeros((1, 5, 3)) + [1.0, 0.0, 0.0]
    pos[..., :2] += rng.uniform(-0.01, 0.01, (1, 5, 2))
    pos[..., 2] = 0.1 + 0.2 * np.arange(5)
    yaw = Rotation.from_euler("z", rng.uniform(-0.3, 0.3, (5, 1))).as_quat().reshape(1, 5, 4)
    sim, plugin = build(5, (0.2, 0.2, 0.2), 0.5, pos=pos, quat=yaw)
    fastest = []
    for _ in range(20):
        sim.step(50)
        body = plugin.read(sim.data)
        fastest.append(np.abs(np.asarray(body.vel)).max())
    assert max(fastest[1:]) < 1e-3, "eight stacks had at most 0.27 mm/s, with jax 0.10 and 0.11"
    assert max(fastest[6:]) < 1e-4
    np.testing.assert_allclose(np.asarray(body.pos), pos, atol=1e-3)


def test_a_box_over_the_edge_of_another_falls_as_in_mujoco():
    """Its centre is 2 cm beyond the edge: it tips over and lands on the floor."""
    bodies = [((0.2, 0.2, 0.2), 2.0, (0, 0, 0.1), (0, 0, 0)), ((0.2, 0.16, 0.1), 0.1, (0.12, 0, 0.25), (0, 0, 0))]
    (ours, _), (theirs, _) = simulate_both(bodies, 1.5)
    early = slice(31)
    assert np.abs(ours[early] - theirs[early]).max() < 0.01, "until it slips off, 0.3 s"
    assert ours[30, 1, 2] < 0.21
    assert ours[-1, 1, 2] < 0.11


def test_bounces_as_in_mujoco():
    """Times and heights of the first three bounces from 0.5 m with restitution 0.7.

    MuJoCo has no restitution, but a spring and a damper per unit of mass, ``solref="-stiffness -damping"``, with
    stiffness w^2 and damping 2 z w. A contact only pushes. It therefore ends where the acceleration is zero, not where
    the overlap is, after the time 2 arccos(z) / (w sqrt(1 - z^2)). The restitution is exp(-2 z arccos(z) / sqrt(1 -
    z^2)).

    In crazysim a ball bounces in the step in which it would reach the floor: above the floor by up to v dt, and with a
    speed that is wrong by up to g dt. The error of the height is then at most v dt plus e^2 times the error of the
    bounce before, and that of the time two steps for each bounce. MuJoCo's heights are wrong by about a percent, as the
    contact lasts 100 of its steps.
    """
    restitution, height, rate = 0.7, 0.5, 3000.0
    ratio = np.linspace(0, 0.99, 10001)
    ratio = float(np.interp(-restitution, -np.exp(-2 * ratio * np.arccos(ratio) / np.sqrt(1 - ratio**2)), ratio))
    ball = (0.05, 0.2, (0, 0, 0.05 + height), (0, 0, 0))
    spring = f'solref="{-(rate**2)} {-2 * ratio * rate}" solimp="0.999 0.999 0.001"'
    theirs = mujoco_track([ball], 1.3, steps_per_pose=1, timestep=1e-5, contact=spring)
    sim, plugin = build(1, *ball[:2], pos=ball[2], restitution=restitution, drones=False)
    bounces = []
    for pos, _ in (track(sim, plugin, 1.3, steps_per_pose=1), theirs):
        z = pos[:, 0, 2] - 0.05
        apexes = np.flatnonzero((z[2:-1] >= z[1:-2]) & (z[2:-1] > z[3:]))[:3] + 2
        bounces.append((apexes, z[apexes]))
    (our_steps, our_heights), (their_steps, their_heights) = bounces
    np.testing.assert_allclose(their_heights, height * restitution ** (2 * np.arange(1, 4)), rtol=0.02)
    assert np.all(np.abs(our_steps - their_steps) <= 2 * np.arange(1, 4)), (our_steps, their_steps)
    error = 0.0
    for k in range(3):
        speed = restitution**k * np.sqrt(2 * 9.81 * height)
        error = restitution**2 * error + speed / FREQ
        np.testing.assert_allclose(our_heights[k], their_heights[k], atol=error)


def test_law_08_momentum_and_angular_momentum_are_kept(rng):
    sim, plugin = build(3, [(0.2, 0.3, 0.2), 0.12, (0.1, 0.2, 0.3)], [0.5, 0.2, 0.3], friction=0.8, restitution=0.5,
                        pos=[[0, 0, 30], [0.35, 0.02, 30], [0, 0.4, 30.05]],
                        vel=[[0, 0, 0], [-2, 0, 0], [0, -2.0, 0.2]])  # fmt: skip

    def momenta():
        b = jax.tree.map(lambda x: np.asarray(x, np.float64)[0], plugin.read(sim.data))
        spin = Rotation.from_quat(b.quat).apply(b.inertia * b.ang_vel)
        m, p, v = b.mass, b.pos, b.vel
        return (m * v).sum(axis=0), (spin + m * np.cross(p, v)).sum(axis=0)

    record = plugin.read(sim.data)
    weight = np.asarray(record.mass) * np.float32([0, 0, 9.81])
    sim.data = plugin.write(sim.data, record.replace(force=jnp.asarray(weight)))
    before = momenta()
    sim.step(150)
    assert np.abs(np.asarray(plugin.read(sim.data).vel)[0] - [[0, 0, 0], [-2, 0, 0], [0, -2, 0.2]]).max() > 0.5
    after = momenta()
    np.testing.assert_allclose(after[0], before[0], atol=2e-5)
    np.testing.assert_allclose(after[1], before[1], atol=2e-3)  # about the origin 30 m below, float32


@pytest.mark.long("compiles contacts of a scene of its own")
def test_a_drone_lands_on_a_body_and_rides_on_it():
    """The drone comes to rest on a sliding slab, and moves with it; the slab carries the drone's weight."""
    sim, plugin = build(1, (0.6, 0.6, 0.1), 1.0, pos=(0, 0, 0.05), friction=0.9, drone_pos=(0.0, 0.0, 0.2))
    sim.step(800)
    half = float(sim.airframe.value("shape.collision_box")[5] - sim.airframe.value("shape.collision_box")[2])
    np.testing.assert_allclose(np.asarray(sim.data.states.pos)[0, 0], [0, 0, 0.1 + half], atol=2e-3)
    body = plugin.read(sim.data)
    np.testing.assert_allclose(np.asarray(body.impulse)[0, 0, 2], 9.81 / FREQ, rtol=0.02)
    sim.data = plugin.write(
        sim.data, body.replace(force=jnp.asarray([[[12.0, 0, 0]]]))
    )  # 12 N against 9.2 N of friction
    sim.step(300)
    body, states = plugin.read(sim.data), sim.data.states
    moved, vel, drone, drone_vel = (np.asarray(x)[0, 0, 0] for x in (body.pos, body.vel, states.pos, states.vel))
    assert moved > 0.2
    np.testing.assert_allclose(drone, moved, atol=0.01)
    np.testing.assert_allclose(drone_vel, vel, rtol=0.02)


@pytest.mark.long("compiles contacts of a scene of its own")
def test_a_box_and_a_drone_ride_on_a_moving_platform_as_in_mujoco():
    """The platform starts at 1 m/s: both slip back by v^2 / (2 mu g) = 8.5 cm, then move with it.

    MuJoCo's platform is a body of 1000 t on a slide joint, since contacts with its mocap bodies do not drag. Its drone
    is a box with the mass and the collision box of crazysim's drone, whose motors are off and which has no drag. The
    tolerance is the distance that the platform moves in a step.
    """
    speed, friction, seconds = 1.0, 0.6, 1.0
    sim = Sim(control="rotor_vel", freq=FREQ)
    box = np.asarray(sim.airframe.value("shape.collision_box"), np.float64)
    mass = float(np.ravel(sim.data.params.mass)[0])
    bodies = [((0.2, 0.2, 0.1), 0.5, (0, 0.2, 0.25), (0, 0, 0)),
              (tuple(2 * box[3:]), mass, (0, -0.2, 0.2 + box[5]), (0, 0, 0))]  # fmt: skip
    slide = """<body pos="0 0 0.15"><joint type="slide" axis="1 0 0"/>
        <geom type="box" size="0.6 0.4 0.05" mass="1e6"/></body>"""
    theirs = mujoco_track(bodies, seconds, friction, carrier=slide)[0]
    platform = sim.scene.add("box", "platform", size=(1.2, 0.8, 0.1), pos=(0, 0, 0.15))
    plugin = sim.add(FreeBodies(1, size=bodies[0][0], mass=0.5, pos=bodies[0][2], friction=friction, drones=False))
    sim.add(ContactResponse(platform, friction=friction))
    sim.data = with_params(sim.data, drag_matrix=0 * np.asarray(sim.data.params.drag_matrix))
    sim.data = with_states(sim.data, pos=np.array(bodies[1][2]) - box[:3])
    positions = []
    for k in range(int(seconds * FREQ / 5) + 1):
        positions.append([np.asarray(plugin.read(sim.data).pos)[0, 0], np.asarray(sim.data.states.pos)[0, 0] + box[:3]])
        sim.data = platform.set_pose(sim.data, [speed * 5 * k / FREQ, 0, 0.15], vel=[speed, 0, 0])
        sim.step(5)
    ours = np.asarray(positions, np.float64)
    assert np.abs(ours - theirs).max() < speed / FREQ
    slip = speed**2 / (2 * friction * 9.81)
    for pos in (ours, theirs):
        np.testing.assert_allclose((pos[-1, :, 0] - pos[-11, :, 0]) * FREQ / 50, speed, rtol=1e-4)
        np.testing.assert_allclose(pos[-1, :, 0] - speed * seconds, -slip, atol=speed / FREQ)
        np.testing.assert_allclose(pos[-1, :, 1:], pos[0, :, 1:], atol=1e-5)


@pytest.mark.long("compiles contacts of a scene of its own")
def test_objects_of_any_kind_carry_bodies():
    sim = Sim(control="rotor_vel", engine="plain")
    sim.scene.add("landing_pad", pos=(0, 0, 0.3), radius=0.4, mocap=False)
    sim.scene.add("sphere", pos=(3, 0, 0.2), radius=0.2, mocap=False)
    pos = [[0, 0, 0.45], [0.25, 0, 0.45], [3.0, 0, 0.55]]
    plugin = sim.add(FreeBodies(3, size=[(0.2, 0.2, 0.2), 0.1, 0.1], pos=pos, drones=False))
    keep_stages(sim)
    sim.step(1000)
    z = np.asarray(plugin.read(sim.data).pos)[0, :, 2]
    np.testing.assert_allclose(z, [0.4, 0.4, 0.5], atol=1e-3)


def test_bodies_rest_on_terrain():
    """Level ground of 0.4 m, and a slope of 0.3 that friction of 0.6 holds."""
    heights = np.concatenate([np.full((4, 3), 0.4), 0.4 + 0.3 * np.tile(np.arange(1.0, 4.0), (4, 1))], axis=1)
    sim = Sim(control="rotor_vel", engine="plain")
    sim.add(Terrain(heights, (5.0, 3.0)))
    plugin = sim.add(FreeBodies(2, size=(0.2, 0.2, 0.1), pos=[[-1.5, 0, 0.5], [1.5, 0.1, 0.95]], drones=False))
    keep_stages(sim)
    sim.step(1000)
    level, sloped = np.asarray(plugin.read(sim.data).pos)[0]
    np.testing.assert_allclose(level, [-1.5, 0, 0.45], atol=1e-3)
    sim.step(500)
    assert np.abs(np.asarray(plugin.read(sim.data).pos)[0, 1] - sloped).max() < 2e-3
    assert sloped[2] > 0.9


@pytest.mark.parametrize("integrator", ["euler", "symplectic_euler", "rk4"])
def test_law_08_tumbling_bodies_keep_energy_and_angular_momentum(integrator):
    """In 10 s at 60 rad/s about 32 axes, energy changes by 0.2 % at most; with explicit Euler it would diverge."""
    n, rate = 32, 60.0
    sim = Sim(n_worlds=n, control="rotor_vel", freq=FREQ, integrator=integrator)
    plugin = sim.add(FreeBodies(1, size=(0.3, 0.2, 0.1), pos=(0, 0, 1000.0), drones=False))
    keep_stages(sim, "bodies_integration")
    axes = np.random.default_rng(0).normal(size=(n, 1, 3))
    record = plugin.read(sim.data)
    ang_vel = rate * axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    sim.data = plugin.write(sim.data, record.replace(ang_vel=jnp.asarray(ang_vel, jnp.float32)))
    energy, momentum = [], []
    for _ in range(6):
        body = jax.tree.map(lambda x: np.asarray(x, np.float64)[:, 0], plugin.read(sim.data))
        energy.append(0.5 * (body.inertia * body.ang_vel**2).sum(axis=-1))
        momentum.append(Rotation.from_quat(body.quat).apply(body.inertia * body.ang_vel))
        sim.step(1000)
    np.testing.assert_allclose(np.array(energy) / energy[0], 1, atol=2e-3)
    change = np.linalg.norm(np.array(momentum) - momentum[0], axis=-1) / np.linalg.norm(momentum[0], axis=-1)
    assert change.max() < (0.02 if integrator == "rk4" else 2e-3)


@pytest.mark.long("compiles the gradient of contacts")
def test_law_08_gradients_equal_central_differences(x64):
    """The length of a slide with friction by the speed at the start, d(v^2 / (2 mu g)) / dv.

    The derivative in forward mode is compared; the one in reverse mode, its transpose, is only traced.
    """
    sim, plugin = build(1, (0.2, 0.2, 0.1), 0.5, pos=(0, 0, 0.05))
    step = build_stagewise_step(sim)

    def end(speed):
        record = plugin.read(sim.data)
        data = plugin.write(sim.data, record.replace(vel=record.vel.at[0, 0, 0].set(speed)))
        return plugin.read(step(data, 60)).pos[0, 0, 0]

    end_and_slope, h = jax.jit(lambda speed: jax.jvp(end, (speed,), (1.0,))), 1e-5
    central = (end_and_slope(1.0 + h)[0] - end_and_slope(1.0 - h)[0]) / (2 * h)
    np.testing.assert_allclose(end_and_slope(1.0)[1], central, rtol=1e-3)
    assert 0.05 < float(central) < 0.13
    assert jax.eval_shape(jax.grad(end), 1.0).shape == ()


def test_replacing_the_numbers_of_bodies_keeps_their_motion():
    sim, _ = build(2)
    sim.step(5)
    before = sim.data.plugins["bodies"]
    sim.replace(FreeBodies(2, mass=0.4, friction=0.2, restitution=0.5, pos=[0.0, 0.0, 9.0]))
    new, made = sim.data.plugins["bodies"], Sim(plugins=[FreeBodies(2, mass=0.4)]).data.plugins["bodies"]
    np.testing.assert_allclose(new.mass, 0.4, rtol=1e-6)
    np.testing.assert_allclose(new.inertia, np.broadcast_to(made.inertia, new.inertia.shape), rtol=1e-6)
    np.testing.assert_allclose(new.friction, 0.2, rtol=1e-6)
    np.testing.assert_allclose(new.restitution, 0.5, rtol=1e-6)
    np.testing.assert_array_equal(new.pos, before.pos)
    np.testing.assert_array_equal(new.vel, before.vel)


def test_law_09_bodies_that_stayed_in_the_scene_are_used_again_only_in_the_same_number():
    sim, _ = build(2)
    with pytest.raises(ConfigError, match="expected 2 objects 'bodies', which are in the scene already, got 3"):
        sim.replace(FreeBodies(3))
    sim.remove("bodies")
    with pytest.raises(ConfigError, match="expected 2 objects 'bodies', which are in the scene already, got 3"):
        sim.add(FreeBodies(3))
    sim.add(FreeBodies(2))
    assert sim.data.objects.names == ("bodies:0", "bodies:1")
