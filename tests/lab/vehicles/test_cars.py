"""Cars in a simulation: engines, counts, commands, paths, gradients, the scene, terrain, and wrong input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, Sim, Terrain
from crazysim.lab.vehicles.car_params import CarParams
from crazysim.lab.vehicles.car_state import CarState
from crazysim.lab.vehicles.following import PathState, motor_reference
from crazysim.lab.vehicles.model import load_vehicle
from crazysim.plugins.vehicles import LPV, Bicycles, Cars, Path, PathLQR, PurePursuit, Stanley, ackermann
from crazysim.trajectories import circle, figure_eight

EIGHT = figure_eight(5, 1.5, period=14.0, height=0.0)
CONTROLLERS = {"pursuit": PurePursuit(), "stanley": Stanley(), "lpv": LPV(), "lqr": PathLQR()}


def build(n_worlds=2, n_drones=1, engine="interpret", cars_only=True, **settings):
    """Return a simulation with cars, and its plugin; with ``cars_only`` the drones stand still."""
    sim = Sim(n_worlds, n_drones, control="rotor_vel", engine=engine)
    cars = sim.add(Cars(**settings))
    if cars_only:
        stages = sim.step_pipeline.items()
        sim.step_pipeline = {name: fn for name, fn in stages if name.startswith("cars") or name == "increment_steps"}
    return sim, cars


def car_states(sim):
    record = sim.data.plugins["cars"]
    return {name: np.asarray(getattr(record, name)) for name in ("pos", "yaw", "body_vel", "yaw_rate", "steer")}


@pytest.mark.parametrize(("n_worlds", "n_drones", "n_cars"), [(1, 1, 1), (2, 3, 4)])
def test_cars_follow_their_commands_for_any_counts(n_worlds, n_drones, n_cars):
    sim, cars = build(n_worlds, n_drones, "fused", members=n_cars, level="speed", in_scene=False)
    command = np.random.default_rng(0).uniform([0.5, -0.3], [1.5, 0.3], (n_worlds, n_cars, 2))
    sim.data = cars.with_command(sim.data, command)
    sim.step(300)
    np.testing.assert_allclose(car_states(sim)["body_vel"][..., 0], command[..., 0], atol=0.1)


@jax.jit
def deviations(record, time):
    """Return the distances of the cars of a world from their path, and their lags behind it, m. (n_cars,) each"""

    def deviation(pos, arc, start):
        arc = record.path.project(0, pos[:2], arc[0])
        reference = record.path.time_reference(0, time - start[0])[0]
        return jnp.linalg.norm(pos[:2] - record.path.point_at(0, arc).pos), reference[0] - arc

    return jax.vmap(deviation)(record.pos[0], record.arc[0], record.start[0])


@pytest.mark.parametrize("name", CONTROLLERS)
def test_cars_follow_a_path(name):
    """Three cars on a figure eight at up to 1.5 m/s, which start beside it and with other headings."""
    sim, _ = build(1, engine="fused", members=3, path=EIGHT, controller=CONTROLLERS[name], in_scene=False)
    record = sim.data.plugins["cars"]
    pos, yaw = np.asarray(record.pos) + np.float32([0.0, 0.1, 0.0]), np.asarray(record.yaw) + np.float32(0.3)
    sim.data = sim.plugins["cars"].write(sim.data, record.replace(pos=jnp.asarray(pos), yaw=jnp.asarray(yaw)))
    sim.step(3000)
    distances, lags = [], []
    for k in range(20):
        sim.step(150)
        distance, lag = deviations(sim.data.plugins["cars"], np.float32((3000 + 150 * (k + 1)) / 500))
        distances.append(distance)
        lags.append(lag)
    assert np.shape(lags) == (20, 3)
    assert np.max(distances) < {"pursuit": 0.06, "stanley": 0.1, "lpv": 0.05, "lqr": 0.03}[name]
    assert np.abs(lags).max() < 0.15


@pytest.mark.parametrize("kind", [PurePursuit, Stanley, PathLQR])
def test_gains_of_the_speed_are_settings_of_controllers(kind):
    """A car at 1 m/s whose reference has 1.5 m/s and is 0.2 m ahead."""
    car = CarParams.create(load_vehicle("f1tenth_ros"), 500)
    zero, speed = jnp.zeros(1), jnp.float32([1.5])
    state = CarState(jnp.zeros(3), zero, jnp.float32([1.0, 0.0]), zero, zero, zero)
    path_state = PathState(None, None, zero, zero, zero, zero, speed, jnp.float32([0.2]))
    controller = kind(position_gain=3.0, speed_gain=2.0, reference_max=0.05)
    driven = controller.driving(state, path_state, None, car)
    np.testing.assert_allclose(driven, motor_reference(speed, 3.0 * 0.2 + 2.0 * 0.5, car), rtol=1e-6)
    if kind is Stanley:
        assert driven > 0.05
        assert controller.update(state, path_state, None, None, car)[0][0] == np.float32(0.05)
        assert LPV(reference_max=0.05).reference_max == 0.05
        with pytest.raises(ConfigError, match=r"expected no speed_gain of LPV, got 2\.0\. Use longitudinal="):
            LPV(speed_gain=2.0)


@pytest.mark.parametrize("controller", [PurePursuit(), PathLQR()], ids=["pursuit", "lqr"])
def test_cars_follow_a_path_backwards(controller):
    path = Path.of_trajectory(circle(2.0, speed=0.6), backwards=True)
    sim, _ = build(1, engine="fused", path=path, controller=controller, in_scene=False)
    sim.step(5000)
    record = sim.data.plugins["cars"]
    assert np.asarray(record.body_vel)[0, 0, 0] == pytest.approx(-0.6, abs=0.05)
    assert np.linalg.norm(np.asarray(record.pos)[0, 0, :2]) == pytest.approx(2.0, abs=0.08)


def test_references_by_arc_length_stop_at_the_end():
    path = Path.of_points([(0, 0), (1, 0.3), (2, 0), (3, 0.5)], speed=1.0)
    sim, _ = build(1, engine="fused", path=path, reference="arc", in_scene=False)
    sim.step(4000)
    record = sim.data.plugins["cars"]
    np.testing.assert_allclose(np.asarray(record.pos)[0, 0, :2], [3, 0.5], atol=0.1)
    assert abs(np.asarray(record.body_vel)[0, 0, 0]) < 0.02


def test_bicycles_are_driven_by_a_torque():
    """The acceleration is the torque over the radius, over mass and rotating inertia."""
    sim = Sim(control="rotor_vel")
    bikes = sim.add(Bicycles(2, in_scene=False))
    assert bikes.names == ("Bicycle_0", "Bicycle_1")
    sim.data = bikes.with_command(sim.data, np.full((1, 2, 2), [0.01, 0.3]))
    sim.step(500)
    record = bikes.read(sim.data)
    inertia = 1 + 2 * 0.1507964 + 2 * (0.01 / 0.04**2 + 0.1507964 / 2)
    speed = np.asarray(record.body_vel)[0, 0, 0]
    # Each wheel has a friction of 0.001 N m / 0.04 m, which is smaller below the slip speed.
    assert (0.01 / 0.04 - 2 * 0.001 / 0.04) / inertia < speed < 0.01 / 0.04 / inertia
    np.testing.assert_array_equal(record.steer, 0.0)


def test_wheels_roll_and_steer_in_the_scene():
    sim, cars = build(1, members=2, trailer=True, vehicle="aiml_head", pos=[(1, 0), (-1, 0)], yaw=[0.0, np.pi / 2])
    sim.data = cars.with_command(sim.data, np.tile([0.05, 0.3], (1, 2, 1)))
    sim.step(100)
    sim.scene.sync_one(sim.plugins.with_moved_objects(sim.data), 0)
    model, data, record = sim.mj_model, sim.mj_data, jax.tree.map(np.asarray, cars.read(sim.data))
    left, right = np.asarray(jax.jit(ackermann)(record.steer[0, 0], 0.32226, 0.20032))
    for k, angle in ((0, left), (1, right), (2, 0.0), (3, 0.0)):
        axis = data.body(f"cars_wheel:{k}").xmat.reshape(3, 3)[:, 1]
        np.testing.assert_allclose(np.arctan2(-axis[0], axis[1]), angle + record.yaw[0, 0, 0], atol=1e-5)
    wheel = data.body("cars_wheel:7").xmat.reshape(3, 3)
    rolled = np.arctan2(-wheel[2, 0], wheel[2, 2])
    np.testing.assert_allclose(rolled, record.distance[0, 1, 0] / 0.052388, atol=1e-5)
    np.testing.assert_allclose(data.body("cars:1").xpos, record.pos[0, 1], atol=1e-6)
    deck = data.body("cars_trailer:0").xmat.reshape(3, 3)
    np.testing.assert_allclose(np.arctan2(deck[1, 0], deck[0, 0]), record.joints[0, 0, 1], atol=1e-6)
    assert model.nbody > 2 * (1 + 4 + 1 + 1 + 4)


def test_cars_roll_down_a_slope():
    """Without drive a car on a plane of 0.1 rad accelerates by g sin(a), less its damping."""
    x = np.linspace(-20, 20, 41)
    heights = np.tile(5 - np.tan(0.1) * x, (41, 1))
    sim = Sim(control="rotor_vel", engine="fused")
    sim.add(Terrain(heights, size=(40.0, 40.0)))
    cars = sim.add(Cars(pos=(0, 0), in_scene=False))
    np.testing.assert_allclose(np.asarray(cars.read(sim.data).pos)[0, 0, 2], 5 + 0.052388, atol=1e-4)
    sim.step(250)
    record = jax.tree.map(np.asarray, cars.read(sim.data))
    np.testing.assert_allclose(record.normal[0, 0], [np.sin(0.1), 0, np.cos(0.1)], atol=1e-5)
    np.testing.assert_allclose(record.pos[0, 0, 2] - 0.052388, 5 - np.tan(0.1) * record.pos[0, 0, 0], atol=2e-3)
    speed = 0.0
    for _ in range(250):
        force = 4.0304 * speed + 0.8656 * speed / np.hypot(speed, 0.1)
        speed += (9.81 * np.sin(0.1) * np.cos(0.1) - force / 2.923) / 500
    assert record.body_vel[0, 0, 0] == pytest.approx(speed, rel=0.01)


def test_a_car_has_a_view_by_its_name():
    sim, cars = build(2, members=3, in_scene=False)
    assert sim["Fleet1Tenth_1"].pos.shape == (2, 3)
    np.testing.assert_array_equal(sim["Fleet1Tenth_2"].pos, np.asarray(cars.read(sim.data).pos)[:, 2])
    sim["Fleet1Tenth_1"].command([0.1, 0.2])
    np.testing.assert_allclose(np.asarray(cars.read(sim.data).command)[:, 1], [[0.1, 0.2]] * 2)
    np.testing.assert_array_equal(np.asarray(cars.read(sim.data).command)[:, 0], 0.0)
