"""Recorded flights: their contents, files, and simulations that show them."""

from contextlib import closing

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from pictures import has_colour

from crazysim import SlungLoad
from crazysim.errors import ConfigError, DamagedFileError
from crazysim.media import Flight, Recorder, View, flight_of
from crazysim.media.flight_recorder import show_flight_at
from crazysim.scene.mjx_scene import MjxScene
from crazysim.sim import Sim

ROLL = np.array([[0, 0, 0, 1.0], [0.6, 0, 0, 0.8]])
"""Level, and rolled by 73.7 degrees, xyzw."""


def build(n_worlds=3, **options):
    """Return a simulation of two drones and a movable red ball."""
    sim = Sim(n_worlds=n_worlds, n_drones=2, control="state", **options)
    ball = sim.spec.worldbody.add_body(name="ball", pos=[0, 0, 0.3], mocap=True)
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], rgba=[1, 0, 0, 1])
    sim.build_mjx()
    return sim


@pytest.fixture(scope="module")
def sim():
    """Return a simulation with its rolled balls 0, 1 and 2 m to the east in its three worlds."""
    sim = build()
    k = sim.mj_model.body("ball").mocapid.item()
    sim.mjx_data = sim.mjx_data.replace(
        mocap_pos=sim.mjx_data.mocap_pos.at[:, k, 0].set(jnp.arange(3.0)),
        mocap_quat=sim.mjx_data.mocap_quat.at[:, k].set(jnp.asarray(np.roll(ROLL[1], 1))),
    )
    return sim


@pytest.fixture(scope="module")
def flight(sim):
    """Return a flight of worlds 2 and 0, at 0 and 0.5 s: drone 1 of world 2 rises by 1 m and rolls."""
    recorder = Recorder(sim, worlds=[2, 0])
    data = sim.data
    for k in range(2):
        states = sim.data.states
        states = states.replace(
            pos=states.pos.at[2, 1].set(jnp.array([0.5, 0.0, 1.0 + k])), quat=states.quat.at[2, 1].set(ROLL[k])
        )
        core = sim.data.core.replace(steps=jnp.full_like(sim.data.core.steps, 250 * k))
        sim.data = sim.data.replace(states=states, core=core)
        sim.state_control(np.full((3, 2, 16), 0.1 * (k + 1)))
        recorder.add()
    assert len(recorder) == 2
    sim.data = data
    return recorder.flight()


def test_a_flight_has_the_recorded_poses_and_setpoints(flight):
    np.testing.assert_allclose(flight.time, [0, 0.5])
    np.testing.assert_array_equal(flight.worlds, [2, 0])
    np.testing.assert_allclose(flight.pos[:, 0, 1], [[0.5, 0, 1], [0.5, 0, 2]])
    np.testing.assert_allclose(flight.quat[:, 0, 1], ROLL, atol=1e-7)
    assert (flight.pos[:, 1, 1] != flight.pos[:, 0, 1]).any()
    np.testing.assert_allclose(flight.body_pos[:, :, 0], [[[2, 0, 0.3], [0, 0, 0.3]]] * 2, atol=1e-7)
    np.testing.assert_allclose(flight.body_quat, np.broadcast_to(ROLL[1], (2, 2, 1, 4)), atol=1e-7)
    np.testing.assert_allclose(flight.setpoint[:, 0, 0, 0], [0.1, 0.2], atol=1e-7)
    assert (flight.index(0), flight.index(2)) == (1, 0)


def test_shapes_are_those_of_the_scene(flight, sim):
    """The ball is red and moves with its body, the floor is fixed, and collision geoms are left out."""
    balls = [shape for shape in flight.shapes if shape.mocap == flight.body_ids[0]]
    assert [(ball.kind, ball.size[0]) for ball in balls] == [("sphere", 0.1)]
    np.testing.assert_allclose(balls[0].rgba, [1, 0, 0, 1])
    np.testing.assert_allclose(balls[0].pos, 0, atol=1e-9)
    floor = [shape for shape in flight.shapes if shape.mocap == -1]
    assert [shape.kind for shape in floor] == ["plane"]
    assert np.ptp(floor[0].rgba[:3]) < 0.1, "the mean of a grey texture"
    assert 0.6 < floor[0].rgba[0] < 0.9
    for drone in flight.drone_ids:
        kinds = [shape.kind for shape in flight.shapes if shape.mocap == drone]
        assert kinds.count("cylinder") == 8, "four motors and four propellers"
        assert kinds.count("sphere") == 0, "the collision sphere is left out"


def test_meshes_and_children_of_moving_bodies_are_shapes():
    """A tetrahedron on a turned child of a mocap body is where that body carries it."""
    sim = Sim()
    sim.spec.add_mesh(name="tetra", uservert=[0, 0, 0, 0.3, 0, 0, 0, 0.3, 0, 0, 0, 0.3])
    body = sim.spec.worldbody.add_body(name="box", pos=[1, 0, 0], mocap=True)
    child = body.add_body(name="child", pos=[0, 0, 1], quat=[np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    geom = child.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="tetra", contype=0, conaffinity=0)
    geom.rgba = [0, 1, 0, 1]
    sim.build_mjx()
    recorder = Recorder(sim)
    recorder.add()
    flight = recorder.flight()
    (mesh,) = (shape for shape in flight.shapes if shape.kind == "mesh")
    assert mesh.mocap == sim.mj_model.body("box").mocapid.item()
    assert mesh.faces.shape == (4, 3)
    spin = np.zeros(9)
    mujoco.mju_quat2Mat(spin, np.roll(mesh.quat, 1))
    corners = mesh.vertices @ spin.reshape(3, 3).T + mesh.pos
    expected = [[0, 0, 1], [0, 0.3, 1], [-0.3, 0, 1], [0, 0, 1.3]]  # turned by 90 degrees about z
    for corner in expected:
        assert np.linalg.norm(corners - corner, axis=1).min() < 1e-6


def test_poses_between_two_samples_are_interpolated(flight):
    """At half the time the drone is at half the height and half the turn; times beyond the ends are clipped."""
    half = flight.at(0.25)
    np.testing.assert_allclose(half["pos"][0, 1], [0.5, 0, 1.5])
    angle = np.arctan2(0.6, 0.8) / 2
    np.testing.assert_allclose(half["quat"][0, 1], [np.sin(angle), 0, 0, np.cos(angle)], atol=1e-7)
    np.testing.assert_allclose(flight.at(-1.0)["pos"], flight.pos[0])
    np.testing.assert_allclose(flight.at(9.0)["pos"], flight.pos[1])


def test_a_file_keeps_the_whole_flight(flight, tmp_path):
    flight.save(tmp_path / "flight.journal")
    loaded = Flight.load(tmp_path / "flight.journal")
    for name in ("time", "pos", "quat", "body_pos", "body_quat", "setpoint", "worlds", "drone_ids", "body_ids"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(flight, name))
    assert len(loaded.shapes) == len(flight.shapes)
    for result, expected in zip(loaded.shapes, flight.shapes, strict=True):
        assert (result.kind, result.mocap) == (expected.kind, expected.mocap)
        for name in ("size", "rgba", "pos", "quat", "vertices", "faces"):
            np.testing.assert_array_equal(getattr(result, name), getattr(expected, name))


def test_another_simulation_shows_the_flight(flight, opengl):
    """A new simulation shows drones and ball of world 2 where they were, also where its own ball was elsewhere."""
    other_sim = build()
    show_flight_at(other_sim, flight, 0.25)
    np.testing.assert_allclose(other_sim.data.states.pos[2, 1], [0.5, 0, 1.5])
    np.testing.assert_allclose(other_sim.time[:, 0], [0.25, 0, 0.25], atol=2e-3)
    np.testing.assert_allclose(other_sim.data.controls.state.staged_cmd[2, 0, :3], 0.15, atol=1e-6)
    k = other_sim.mj_model.body("ball").mocapid.item()
    np.testing.assert_allclose(other_sim.mjx_data.mocap_pos[2, k], [2, 0, 0.3], atol=1e-6)
    np.testing.assert_allclose(other_sim.mjx_data.mocap_quat[2, k], np.roll(ROLL[1], 1), atol=1e-6)
    above = {"lookat": [2, 0, 0.3], "distance": 2.0, "azimuth": 90, "elevation": -89}
    for world, is_visible in ((2, True), (0, False)):
        picture = View(worlds=world, width=64, height=48, cam_config=above).render(other_sim).astype(int)
        red = has_colour(picture, [1, 0, 0])
        assert red[23:25, 31:33].all() == red.any() == is_visible
    other_sim.close()


def test_setpoints_replace_the_feedforward_of_earlier_ones(flight):
    """Worlds that are not in the flight keep their feedforward."""
    other_sim = build()
    other_sim.state_control(pos=[0.0, 0.0, 1.0], feedforward=np.ones((3, 2, 8)))
    show_flight_at(other_sim, flight, 0.25)
    result = np.asarray(other_sim.data.controls.state.staged_feedforward)
    np.testing.assert_array_equal(result, np.broadcast_to(np.array([0.0, 1.0, 0.0])[:, None, None], (3, 2, 8)))


def test_objects_with_handles_are_recorded_and_shown():
    """A box that is moved through its handle is where it was in each world, in a new simulation too."""

    def build():
        sim = Sim(n_worlds=2)
        return sim, sim.scene.add("box", count=2, pos=[1.0, 0, 0.5])

    sim, boxes = build()
    recorder = Recorder(sim)
    for k in range(2):
        pos = [[[k, w, 0.5], [2, k, 1]] for w in range(2)]
        sim.data = boxes.set_pose(sim.data, pos=pos, quat=ROLL[k])
        core = sim.data.core.replace(steps=jnp.full_like(sim.data.core.steps, 500 * k))
        sim.data = sim.data.replace(core=core)
        recorder.add()
    flight = recorder.flight()
    np.testing.assert_allclose(flight.body_pos[1], [[[1, 0, 0.5], [2, 1, 1]], [[1, 1, 0.5], [2, 1, 1]]], atol=1e-6)
    np.testing.assert_allclose(flight.body_quat[1], np.broadcast_to(ROLL[1], (2, 2, 4)), atol=1e-6)
    other_sim, other_boxes = build()
    show_flight_at(other_sim, flight, 0.5)
    pos, quat = other_boxes.pose(other_sim.data)
    np.testing.assert_allclose(pos, flight.at(0.5)["body_pos"], atol=1e-6)
    np.testing.assert_allclose(quat, flight.at(0.5)["body_quat"], atol=1e-6)
    np.testing.assert_allclose(pos[:, 0, 0], 0.5, atol=1e-6)


@pytest.mark.parametrize("cable", [True, False], ids=["cable", "rod"])
def test_loads_are_shown_at_their_recorded_poses(cable):
    """The load of the simulation has been released since the recording."""
    sim = Sim(n_worlds=2, control="rotor_vel")
    load = sim.add(SlungLoad(mass=0.1, length=0.5, cable=cable))
    recorder = Recorder(sim)
    pos = sim.data.states.pos
    for k in range(2):
        sim.data = sim.data.replace(
            states=sim.data.states.replace(pos=pos + jnp.array([0.3 * k, 0, 2.0])),
            core=sim.data.core.replace(steps=jnp.full_like(sim.data.core.steps, 500 * k)),
        )
        sim.data = load.hang(sim.data)
        recorder.add()
    flight = recorder.flight()
    sim.data = load.release(sim.data)
    sim.step(100)
    data = sim.data
    show_flight_at(sim, flight, 1.0)
    sim.sync(1)
    np.testing.assert_allclose(sim.mj_data.body("load:0").xpos, [0.3, 0, 1.5], atol=1e-5)
    ids = flight.body_ids
    np.testing.assert_allclose(sim.mj_data.mocap_pos[ids], flight.body_pos[1, 1], atol=1e-6)
    sim.data = data
    sim.sync(1)
    np.testing.assert_allclose(sim.mj_data.body("load:0").xpos, load.read(data).pos[1, 0], atol=1e-6)


def test_a_reset_does_not_turn_the_recording_back(sim):
    recorder = Recorder(sim, worlds=[0])
    data = sim.data
    for steps in (0, 50, 100, 0, 50):
        sim.data = data.replace(core=data.core.replace(steps=jnp.full_like(data.core.steps, steps)))
        recorder.add()
    sim.data = data
    np.testing.assert_allclose(recorder.flight().time, [0, 0.1, 0.2, 0.3], atol=1e-6)


def test_states_of_a_rollout_can_become_a_flight_of_chosen_worlds():
    sim = Sim(n_worlds=2, control="attitude")
    thrust = 1.2 * sim.data.params.mass.ravel()[0] * 9.81

    def policy(params, data):
        return jnp.zeros((2, 1, 4)).at[1, :, 3].set(thrust)

    states = sim.rollout(policy, n_control_steps=200, every=50)
    rollout_flight = flight_of(sim, states, dt=50 / sim.control_freq, worlds=[1])
    np.testing.assert_allclose(rollout_flight.time, np.arange(4) * 50 / sim.control_freq)
    np.testing.assert_allclose(rollout_flight.pos[:, 0], states.pos[:, 1])
    assert rollout_flight.pos[-1, 0, 0, 2] > 0
    assert rollout_flight.setpoint.shape == (4, 1, 0, 3)


# Wrong input ----------------------------------------------------------------------------------------------------


def test_invalid_recordings_flights_and_files_are_refused(sim, flight, tmp_path):
    text, other = tmp_path / "text.npz", tmp_path / "other.npz"
    text.write_text("no flight")
    np.savez(other, a=np.zeros(3))
    for call, message in (
        (lambda: Recorder(sim, worlds=[0, 3]), "world from 0 to 2, got 3"),
        (lambda: Recorder(sim, worlds=[]), "at least one world"),
        (lambda: Recorder(sim).flight(), r"at least one sample.*recorder\.add\(\)"),
        (lambda: flight_of(sim, sim.data.states, dt=0.1), r"positions of shape \(n, \*\(3, 2, 3\)\)"),
        (lambda: show_flight_at(Sim(n_worlds=2, n_drones=2), flight, 0.0), "got 2"),
        (lambda: show_flight_at(Sim(n_worlds=3, n_drones=2), flight, 0.0), "2 drones and 1 other .*got 2 and 0"),
        (lambda: flight.index(1), r"one of \[2, 0\], got 1"),
        (lambda: flight.save(tmp_path / "nowhere" / "flight.journal"), "an existing folder"),
        (lambda: Flight.load(tmp_path / "flight.journal"), "an existing file"),
        (lambda: Flight.load(text), r"a recorded flight, got .*text\.npz"),
        (lambda: Flight.load(other), r"a recorded flight, got .*other\.npz"),
    ):
        with pytest.raises(ConfigError, match=message):
            call()


@pytest.mark.parametrize("kind", ["saved", "appended"])
def test_a_damaged_flight_is_refused_or_read_up_to_the_damage(flight, sim, tmp_path, kind):
    path = tmp_path / "flight.journal"
    if kind == "saved":
        flight.save(path)
    else:
        with closing(Recorder(sim, path=path)) as recorder:
            recorder.add()
            recorder.add(1.0)
    content, damaged = path.read_bytes(), tmp_path / "damaged"
    n_samples, refused = len(Flight.load(path).time), 0
    for k in np.linspace(0, len(content) - 1, 100, dtype=int):
        for changed in (content[:k], content[:k] + bytes([content[k] ^ 4]) + content[k + 1 :]):
            damaged.write_bytes(changed)
            try:
                assert len(Flight.load(damaged).time) <= n_samples
            except ConfigError as error:
                refused += isinstance(error, DamagedFileError) and str(damaged) in str(error)
    assert refused > 10
    damaged.write_bytes(b"")
    with pytest.raises(DamagedFileError, match=r"recorded flight, got .*damaged', which is damaged .*copy"):
        Flight.load(damaged)


def test_a_recording_does_not_use_mjx(monkeypatch):
    """Importing and compiling MJX would take seconds."""
    monkeypatch.setattr(MjxScene, "sync", None)
    recorder = Recorder(Sim())
    recorder.add()
    assert recorder.flight().pos.shape == (1, 1, 1, 3)
