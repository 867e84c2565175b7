"""Jets of rotors on loads: panels and forces by hand, tables and their files, engines, gradients, wrong input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states

from crazysim import ConfigError, RotorJet, SharedLoad, Sim, SlungLoad
from crazysim.geometry import Shape
from crazysim.lab.plugins.panels import shape_panels
from crazysim.plugins.effects.downwash import hover_jet_speed
from crazysim.plugins.payloads import Hook, JetTable, load_jet_table

RPM = 60 / (2 * np.pi)
"""Speed of 1 rad/s, rpm."""
SIZE = (0.2, 0.1, 0.04)
"""Lengths of the load, a box, m."""
DEPTH = 0.5
"""Distance of the load below its drone, m."""


@pytest.mark.parametrize("shape, area", [(Shape("box", (0.1, 0.05, 0.02)), 0.064), (Shape("sphere", (0.1,)), 0.12566)])
def test_panels_form_a_closed_surface(shape, area):
    """Sums over panels: of areas, of area times normal, which is zero, and of position times normal, three volumes."""
    panels = shape_panels(shape, 0.03)
    assert panels.pos.shape == panels.normal.shape
    assert len(panels.area) == len(panels.pos) >= 24
    np.testing.assert_allclose(panels.area.sum(), area, rtol=1e-4)
    # a spiral of n points on a ball balances to one part in n
    np.testing.assert_allclose((panels.area * panels.normal).sum(axis=0), 0, atol=area / len(panels.pos))
    volume = 0.2 * 0.1 * 0.04 if shape.kind == "box" else 4 / 3 * np.pi * 0.1**3
    np.testing.assert_allclose((panels.area * panels.normal * panels.pos).sum() / 3, volume, rtol=1e-6)


def build(n_worlds=2, n_drones=1, rotor_vel=1000.0, engine="interpret", **kwargs):
    """Return a simulation of bumblebees with rotors at 1000 rad/s and a box 0.5 m below each, and the jet."""
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, drone="bumblebee", control="rotor_vel", engine=engine)
    grid = np.arange(n_worlds * n_drones * 3).reshape(n_worlds, n_drones, 3) * [1.0, 0.5, 0.0] + [0, 0, 2.0]
    sim.data = with_states(sim.data, pos=grid, rotor_vel=rotor_vel * RPM)
    sim.rotor_vel_control(np.full((n_worlds, n_drones, 4), rotor_vel * RPM))
    sim.build_default_data()
    sim.add(SlungLoad(0.2, DEPTH, size=SIZE))
    return sim, sim.add(RotorJet(**kwargs))


def jet_record(sim):
    """Return the record of the jet after only its stage."""
    return jax.jit(sim.step_pipeline["rotor_jet"])(sim.data).plugins["rotor_jet"]


def pressure_table(low=40.0, high=160.0):
    """Return pressures that decrease linearly downwards to zero 1 m below the drone, at two speeds."""
    z = np.linspace(-1.0, 0.0, 11)
    shape = np.broadcast_to(1 + z, (5, 5, 11))
    return JetTable([500.0, 1500.0], np.stack([low * shape, high * shape]), None, (-0.2, -0.2, -1.0), 0.1)


def test_a_pressure_that_increases_upwards_pushes_down_by_its_gradient_times_the_volume():
    """-P A n over a closed surface is -grad P V: 100 Pa/m between both speeds, for 0.8 l."""
    sim, plugin = build(table=pressure_table())
    sim.step()
    np.testing.assert_allclose(
        np.asarray(plugin.read(sim.data).force)[0, 0], [0, 0, -100 * 0.2 * 0.1 * 0.04], atol=2e-6
    )


def test_tables_are_linear_in_the_speed_and_fall_to_zero_below_the_smallest():
    sim, _plugin = build(n_worlds=4, table=pressure_table())
    sim.data = with_states(sim.data, rotor_vel=np.array([250.0, 500.0, 1000.0, 2000.0])[:, None, None] * RPM)
    expected = -np.array([20.0, 40.0, 100.0, 160.0]) * 0.2 * 0.1 * 0.04
    # float32: a sum of cancelling terms
    np.testing.assert_allclose(np.asarray(jet_record(sim).force)[:, 0, 2], expected, rtol=2e-3)


def test_moving_air_passes_its_momentum_to_the_sides_that_face_it():
    """Air of (1, 0, -5) m/s: rho v (v.(-n)) A on the upper side and on the windward side, none in the lee."""
    velocity = np.broadcast_to([1.0, 0.0, -5.0], (1, 5, 5, 11, 3))
    table = JetTable([1000.0], None, velocity, (-0.2, -0.2, -1.0), 0.1)
    sim, _plugin = build(table=table, air_density=1.2)
    record = jax.tree.map(np.asarray, jet_record(sim))
    expected = 1.2 * np.array([1.0, 0, -5.0]) * (5.0 * 0.2 * 0.1 + 1.0 * 0.1 * 0.04)
    np.testing.assert_allclose(record.force[1, 0], expected, rtol=1e-5, atol=1e-7)
    # the force of the side acts at (-0.1, 0, 0), that of the top at (0, 0, 0.02)
    side, top = 1.2 * 0.1 * 0.04 * np.array([1, 0, -5.0]), 1.2 * 5 * 0.02 * np.array([1, 0, -5.0])
    torque = np.cross([-0.1, 0, 0], side) + np.cross([0, 0, 0.02], top)
    np.testing.assert_allclose(record.torque[1, 0], torque, rtol=1e-4, atol=1e-7)


def test_outside_the_box_of_the_table_there_is_no_jet():
    table = pressure_table()._replace(origin=(-0.2, -0.2, -0.4))  # from -0.4 to 0.6 m: the load hangs below
    sim, _plugin = build(table=table)
    assert not np.asarray(jet_record(sim).force).any()


def test_the_analytic_jet_has_the_speed_of_downwash():
    """One panel for the whole top: rho u^2 A at its centre, DEPTH - 0.02 below the drone, in the middle of the jet."""
    sim, _plugin = build(panel=1.0)
    force = np.asarray(jet_record(sim).force)
    radius = float(sim.airframe.value("shape.propeller_radius", ()))
    thrust = 4 * 9.3945e-7 * 1000**2  # N, with the lab's coefficient
    below, ones = np.array([[0.0, 0.0, -(DEPTH - 0.02)]]), np.ones((1, 1))
    speed = jax.jit(hover_jet_speed)(
        below, np.array([[0, 0, 1.0]]), thrust * ones, np.sqrt(8) * radius * ones, 1.225 * ones
    )
    speed = np.asarray(speed)[0, 0]
    assert 3 < speed < 30
    np.testing.assert_allclose(force[0, 0], [0, 0, -1.225 * speed**2 * 0.2 * 0.1], rtol=1e-5, atol=1e-6)


def test_the_force_of_a_jet_accelerates_the_load():
    """A released load under a jet falls faster by F dt / m; the record holds the force of that step."""
    sim, plugin = build(table=pressure_table(400.0, 400.0))
    load = sim.plugins["load"]
    sim.data = load.release(sim.data)
    before = np.asarray(load.read(sim.data).vel)
    sim.step()
    force = np.asarray(plugin.read(sim.data).force)
    assert force[0, 0, 2] < -0.2
    expected = before + (force / 0.2 + np.array([0, 0, -9.81])) / 500
    np.testing.assert_allclose(load.read(sim.data).vel, expected, rtol=1e-5, atol=1e-6)
    hook_sim = Sim(drone="bumblebee", control="rotor_vel", engine="interpret")
    hook_sim.data = with_states(hook_sim.data, pos=[0, 0, 2.0], rotor_vel=1000 * RPM)
    hook_sim.add(Hook.bumblebee(0.2, load_at=(0, 0, 1.5)))
    hook_sim.add(RotorJet(pressure_table(400.0, 400.0)))
    hook_sim.step()
    plugins = hook_sim.data.plugins
    fall, force = (np.asarray(x)[0, 0, 2] for x in (plugins["load"].vel, plugins["rotor_jet"].force))
    np.testing.assert_allclose(fall, (force / 0.2 - 9.81) / 500, rtol=1e-4)


def test_a_load_gets_the_jets_of_all_drones_above():
    """A drone flies above another: the load of the lower drone gets both jets, that of the upper drone one jet."""
    sim, _plugin = build(n_drones=2, n_worlds=1, all_drones=True)
    sim.data = with_states(sim.data, pos=np.array([[[0, 0, 2.0], [0.0, 0, 3.0]]]))
    load = sim.plugins["load"]
    sim.data = load.hang(sim.data)
    force_of_all = np.asarray(jet_record(sim).force)[0, :, 2]
    own_sim, _ = build(n_drones=2, n_worlds=1)
    own_sim.data = with_states(own_sim.data, pos=np.array([[[0, 0, 2.0], [0.0, 0, 3.0]]]))
    own_sim.data = own_sim.plugins["load"].hang(own_sim.data)
    force_of_own = np.asarray(jet_record(own_sim).force)[0, :, 2]
    assert force_of_all[0] < 1.1 * force_of_own[0] < 0
    np.testing.assert_allclose(force_of_all[1], force_of_own[1], rtol=1e-5)


def test_law_08_gradients_of_a_step_equal_central_differences(x64):
    sim, _ = build(n_worlds=1)
    load = sim.plugins["load"]
    sim.data = load.release(sim.data)

    @jax.jit
    @jax.value_and_grad
    def end(rotor_vel):
        data = sim.data.replace(states=sim.data.states.replace(rotor_vel=rotor_vel * jnp.ones((1, 1, 4))))
        for stage in sim.step_pipeline.values():
            data = stage(data)
        return load.read(data).vel[0, 0, 2]

    start, h = 900 * RPM, 0.1
    central = (end(start + h)[0] - end(start - h)[0]) / (2 * h)
    assert abs(float(central)) > 1e-8
    np.testing.assert_allclose(end(start)[1], central, rtol=1e-5)


def write_tables(folder, speeds, rows):
    for speed, table in zip(speeds, rows, strict=True):
        np.savetxt(folder / f"pressure_{speed:04d}.txt", table)


def test_files_of_the_lab_are_read_in_their_order(tmp_path, rng):
    """A cube of 3^3 voxels, z is the fastest index; the box is below the drone: from -n/200 m, in z from -n/100 m."""
    tables = rng.uniform(0, 100, size=(2, 27))
    write_tables(tmp_path, (500, 1500), tables)
    table = load_jet_table(tmp_path)
    np.testing.assert_array_equal(table.speeds, [500, 1500])
    np.testing.assert_allclose(table.pressure[1, 0, 1, 2], tables[1, 0 * 9 + 1 * 3 + 2])
    np.testing.assert_allclose(table.origin, [-0.015, -0.015, -0.03])
    assert table.velocity is None
    assert table.shape == (2, 3, 3, 3)
    np.savetxt(tmp_path / "velocity_0500.txt", np.ones((27, 3)))
    np.savetxt(tmp_path / "velocity_1500.txt", np.ones((27, 3)))
    assert load_jet_table(tmp_path).velocity.shape == (2, 3, 3, 3, 3)
    flat = tmp_path / "flat"
    flat.mkdir()
    write_tables(flat, (700,), rng.uniform(size=(1, 81 * 81 * 2)))
    assert load_jet_table(flat).shape == (1, 81, 81, 2)
    write_tables(flat, (700,), rng.uniform(size=(1, 24)))
    assert np.asarray(load_jet_table(flat, shape=(4, 3, 2), origin=(0, 0, -1)).origin).tolist() == [0, 0, -1]


@pytest.mark.parametrize("files, message", [
    ({}, "expected files named NAME_SPEED.txt"),
    ({"readme.txt": "x"}, "got readme.txt"),
    ({"a_0500.txt": "1\nx\n"}, "expected a table of numbers"),
    ({"a_0500.txt": "1 2\n"}, "expected one or three columns"),
    ({"a_0500.txt": "1\n", "b_500.txt": "1\n"}, "a second for 500 rad/s"),
    ({"a_0500.txt": "1\n", "a_0600.txt": "1\n1\n"}, "the same number of rows"),
    ({"a_0500.txt": "1\n", "v_0600.txt": "1 2 3\n"}, "at the speeds of the pressures"),
    ({"a_0500.txt": "1\n1\n"}, r"Use shape=\(n_x, n_y, n_z\)"),
])  # fmt: skip
def test_law_09_wrong_files(tmp_path, files, message):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_jet_table(tmp_path)


WRONG_TABLES = [
    (JetTable([500.0]), "got neither"),
    (JetTable([500.0, 400.0], np.zeros((2, 2, 2, 2))), "ascending"),
    (JetTable([500.0], np.zeros((2, 2, 2, 2))), r"pressure of shape \(1, n_x, n_y, n_z\)"),
    (JetTable([500.0], None, np.zeros((1, 2, 2, 2))), "velocity of shape"),
    (JetTable([500.0], np.zeros((1, 2, 2, 2)), np.zeros((1, 3, 2, 2, 3))), "on the same grid"),
    (JetTable([500.0], np.zeros((1, 2, 2, 2)), spacing=-1.0), "expected spacing to be positive"),
    (JetTable([500.0], np.full((1, 2, 2, 2), np.inf)), "finite"),
    (np.zeros(3), "expected table of RotorJet as JetTable"),
]
LOAD = SlungLoad(0.1, in_scene=False)
SHARED = SharedLoad(0.1, in_scene=False, name="shared")


@pytest.mark.parametrize("load, settings, remedy", [
    *[(LOAD, {"table": table}, words) for table, words in WRONG_TABLES],
    (LOAD, {"panel": 0.0}, "panel"),
    (LOAD, {"air_density": 0.0}, "air_density"),
    (None, {}, r"Use sim\.add"),
    (SHARED, {}, "'shared'"),
    (SHARED, {"load": "shared"}, "loads of one drone each"),
])  # fmt: skip
def test_law_09_wrong_settings(load, settings, remedy):
    sim = Sim(n_drones=2, drone="bumblebee", control="rotor_vel", integrator="symplectic_euler")
    if load is not None:
        sim.add(load)
    with pytest.raises(ConfigError, match=remedy):
        sim.add(RotorJet(**settings))


def test_law_09_fitted_dynamics_have_no_rotors_with_jets():
    with pytest.raises(ConfigError, match="acts on single rotors"):
        Sim(dynamics="so_rpy", plugins=[RotorJet()])
