"""Drones and members of populations by name, and MJCF with vehicles by name."""

import jax.numpy as jnp
import numpy as np
import pytest
from springs import Springs

from crazysim import ConfigError, Sim, SlungLoad
from crazysim.errors import UnknownNameError

MJCF = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="pole_1" pos="3 0 1"><geom type="box" size="0.1 0.1 1"/></body>
    {bodies}
  </worldbody>
</mujoco>
"""
BODY = '<body name="{}" pos="{}" quat="{}"><freejoint/><geom type="sphere" size="0.1" mass="1"/></body>'
VEHICLES = [
    ("Bumblebee_3", "1 2 3", "1 0 0 0"),
    ("Crazyflie_0", "0 0 1", "0 0 0 1"),
    ("Mass_4", "4 5 6", "1 0 0 0"),
    ("Crazyflie_2", "0 1 1", "1 0 0 0"),
]
"""Name, position and attitude of each body, as in MJCF."""
CAR = ("Fleet1Tenth_5", "2 3 0.05", "0 0 0 1")


def build_fleet(**settings):
    sim = Sim(2, drone=["cf21B_500", "bumblebee", "cf2x_L250"], **settings)
    sim.add(Springs(2))
    return sim


def write_fleet(folder, vehicles=VEHICLES):
    path = folder / "fleet.xml"
    path.write_text(MJCF.format(bodies="\n".join(BODY.format(*v) for v in vehicles)))
    return path


def test_a_view_reads_the_data():
    sim = build_fleet()
    np.testing.assert_array_equal(sim["Bumblebee_0"].pos, sim.data.states.pos[:, 1])
    np.testing.assert_array_equal(sim["Mass_1"].pos, sim.data.plugins["springs"].pos[:, 1])
    view = sim["Mass_1"]
    sim.step(20)
    np.testing.assert_array_equal(view.vel, sim.data.plugins["springs"].vel[:, 1])
    assert (view.name, view.population, view.index) == ("Mass_1", "springs", 1)
    assert np.all(view.vel != 0)


def test_a_view_writes_the_states_of_its_vehicle_only():
    sim = build_fleet()
    before, masses = sim.data.states.pos, sim.data.plugins["springs"].pos
    sim["Crazyflie_1"].set(pos=[0.0, 0, 2], vel=[[1.0, 0, 0], [2.0, 0, 0]])
    sim["Mass_0"].set(pos=[7.0, 8, 9])
    np.testing.assert_array_equal(sim.data.states.pos[:, 2], [[0, 0, 2]] * 2)
    np.testing.assert_array_equal(sim.data.states.vel[:, 2, 0], [1, 2])
    np.testing.assert_array_equal(sim.data.states.pos[:, :2], before[:, :2])
    np.testing.assert_array_equal(sim.data.plugins["springs"].pos[:, 1], masses[:, 1])
    np.testing.assert_array_equal(sim.data.plugins["springs"].pos[:, 0], [[7, 8, 9]] * 2)


@pytest.mark.parametrize("control", ["attitude", "state"])
def test_a_view_commands_its_vehicle_only(control):
    sim = build_fleet(control=control, controller="crazyflow" if control == "attitude" else "geometric")
    size = 4 if control == "attitude" else 16
    commands = np.tile(np.arange(1.0, size + 1), (2, 3, 1))
    getattr(sim, f"{control}_control")(commands)
    before = getattr(sim.data.controls, control)
    sim["Bumblebee_0"].command(np.full(size, 0.5))
    after = getattr(sim.data.controls, control)
    np.testing.assert_array_equal(after.staged_cmd[:, 1], 0.5)
    np.testing.assert_array_equal(after.staged_cmd[:, ::2], before.staged_cmd[:, ::2])
    if control == "state":
        np.testing.assert_array_equal(after.staged_feedforward[:, ::2], before.staged_feedforward[:, ::2])
        assert not np.array_equal(after.staged_feedforward[:, 1], before.staged_feedforward[:, 1])


def test_a_member_accepts_commands_of_its_population():
    sim = build_fleet()
    sim["Mass_1"].command([[1.0, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(sim.data.plugins["springs"].cmd, [[[0, 0, 0], [1, 2, 3]], [[0, 0, 0], [4, 5, 6]]])


def test_rotors_of_other_drones_need_no_command():
    angles = np.pi / 3 * np.arange(6)
    rotors = 0.05 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
    hexarotor = {"base": "cf21B_500", "rotors": {"position": rotors, "yaw_torque_sign": [1, -1] * 3}}
    sim = Sim(drone=["cf21B_500", hexarotor], control="rotor_vel")
    sim["Crazyflie_0"].command([1000.0, 2000, 3000, 4000])
    np.testing.assert_array_equal(sim.data.controls.rotor_vel[0, 0], [1000, 2000, 3000, 4000, 0, 0])


def test_wrong_names_and_shapes_are_refused():
    """Law 9."""
    sim = build_fleet()
    with pytest.raises(
        UnknownNameError, match=r"got 'Crazyfly_0'. There are Crazyflie_0, Bumblebee_0, Crazyflie_1, Mas"
    ):
        sim["Crazyfly_0"]
    large_sim = Sim(n_drones=20)
    with pytest.raises(UnknownNameError, match=r"Did you mean Crazyflie_19 or .*sim\.names has all"):
        large_sim["Crazyflie_190"]
    with pytest.raises(AttributeError, match=r"got 'mass'. Use one of \['pos', 'vel', 'cmd', 'ticks'\]"):
        _ = sim["Mass_0"].mass
    with pytest.raises(UnknownNameError, match="expected a field of 'Mass_0', got 'mass'"):
        sim["Mass_0"].set(mass=1.0)
    with pytest.raises(ValueError, match=r"expected the command of Mass_0 of shape \(3,\), or \(2, 3\) .* got \(4,\)"):
        sim["Mass_0"].command(np.zeros(4))
    with pytest.raises(ValueError, match=r"expected the attitude command of Bumblebee_0 of shape \(4,\).* got \(3,\)"):
        sim["Bumblebee_0"].command(np.zeros(3))
    with pytest.raises(ValueError, match="expected finite numbers as pos of Mass_0"):
        sim["Mass_0"].set(pos=[np.nan, 0, 0])
    with pytest.raises(ConfigError, match=r"names that are not in use, got 'Mass_0' again. Use Springs\(\[...\]\)"):
        sim.add(Springs(1, name="others"))
    with pytest.raises(ConfigError, match="got 'Crazyflie_0' again"):
        sim.add(Springs(["Crazyflie_0"], name="others"))
    assert list(sim.plugins) == ["springs"]
    sim.add(Springs(["Mass_7"], name="others"))
    assert sim.names[-1] == "Mass_7"


def test_the_vehicles_of_a_file_are_adopted(tmp_path):
    load = SlungLoad(0.01, 0.5, in_scene=False)
    sim = Sim.from_mjcf(write_fleet(tmp_path), 2, kinds={"Mass": Springs}, control="state", plugins=[load])
    assert sim.names == ("Bumblebee_3", "Crazyflie_0", "Crazyflie_2", "Mass_4")
    assert [airframe.name for airframe in sim.airframes] == ["bumblebee", "crazyflie", "crazyflie"]
    np.testing.assert_allclose(sim["Bumblebee_3"].pos, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(sim["Crazyflie_0"].quat, [[0, 0, 1, 0]] * 2)
    np.testing.assert_allclose(sim["Mass_4"].pos, [[4, 5, 6]] * 2)
    np.testing.assert_allclose(load.read(sim.data).pos[:, 0], [[1, 2, 2.5]] * 2, rtol=1e-5)
    assert sim.scene.object_names == ("pole_1",)
    sim.step(5)
    sim.reset()
    np.testing.assert_allclose(sim["Mass_4"].pos, [[4, 5, 6]] * 2)
    assert jnp.all(sim.data.core.steps == 0)


def test_cars_of_a_file_are_adopted(tmp_path):
    sim = Sim.from_mjcf(write_fleet(tmp_path, [CAR, *VEHICLES[:2]]), 2)
    assert sim.names == ("Bumblebee_3", "Crazyflie_0", "Fleet1Tenth_5")
    car = sim["Fleet1Tenth_5"]
    np.testing.assert_allclose(car.pos[:, :2], [[2, 3]] * 2)
    np.testing.assert_allclose(np.abs(car.yaw), np.pi, rtol=1e-6)


@pytest.mark.parametrize(
    ("vehicles", "error", "message"),
    [
        (
            [("Tractor_0", "0 0 0", "1 0 0 0")],
            UnknownNameError,
            "prefixes Crazyflie, Bumblebee, Fleet1Tenth, Bicycle, got 'Tractor_0'",
        ),
        (VEHICLES, UnknownNameError, "got 'Mass_4'. Use kinds="),
        ([], ConfigError, "expected at least one drone"),
    ],
)
def test_files_with_other_names_are_refused(tmp_path, vehicles, error, message):
    with pytest.raises(error, match=message):
        Sim.from_mjcf(write_fleet(tmp_path, vehicles))
