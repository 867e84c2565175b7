"""Drones of several airframes in a world: each flies as in a simulation of its own airframe."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import build_stagewise_step, with_states
from sweep import FLEET, HEXAROTOR

import crazysim as cs
from crazysim import ConfigError, Sim, load_airframe
from crazysim.core.airframes import create_per_drone
from crazysim.dynamics import first_principles
from crazysim.errors import UnknownNameError

FIRMWARE_PAIR = (HEXAROTOR, "cf2x_L250")
MIXED_PAIR = ("bumblebee", HEXAROTOR)
STATES = ("pos", "quat", "vel", "ang_vel")
CASES = [
    ("state", "crazyflow", FLEET),
    ("body_rate", "crazyflow", MIXED_PAIR),
    ("rotor_vel", "crazyflow", FLEET),
    ("state", "geometric", MIXED_PAIR),
    ("state", "lqr", MIXED_PAIR),
    ("state", "indi", MIXED_PAIR),
    ("state", "mellinger", FIRMWARE_PAIR),
    ("state", "pid", FIRMWARE_PAIR),
]
"""Command level, controller and airframes."""
COMMANDS = {
    "attitude": [0.1, 0.05, 0.2, 0.35],
    "body_rate": [0.1, 0.05, 0.2, 0.35],
    "force_torque": [0.35, 1e-5, 2e-5, 0],
    "rotor_vel": [15000.0, 15100, 14900, 15000, 15050, 15000],
    "state": [0.3, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0],
}
"""Command at each level; rotor speeds are cut to the number of rotors."""


def set_flying(sim, pos):
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos, vel=np.full_like(pos, 0.1)))
    n_rotors = sim.data.states.rotor_vel.shape[-1]
    command = COMMANDS[sim.control.value][: n_rotors if sim.control == "rotor_vel" else None]
    getattr(sim, f"{sim.control.value}_control")(np.tile(command, (*pos.shape[:2], 1)))
    return sim


def random_positions(n_worlds, n_drones):
    return np.float32(np.random.default_rng(0).uniform(0.9, 1.1, (n_worlds, n_drones, 3)))


@pytest.mark.parametrize(("control", "controller", "fleet"), CASES)
def test_each_drone_flies_as_in_a_simulation_of_its_own(control, controller, fleet):
    pos = random_positions(1, len(fleet))
    mixed = set_flying(Sim(drone=fleet, control=control, controller=controller, engine="interpret"), pos)
    mixed.step(25)
    flown = jax.device_get(mixed.data.states)
    for k, airframe in enumerate(fleet):
        single_sim = set_flying(
            Sim(drone=airframe, control=control, controller=controller, engine="interpret"), pos[:, k : k + 1]
        )
        single_sim.step(25)
        n, single_states = single_sim.airframe.n_rotors, jax.device_get(single_sim.data.states)
        for name in STATES:
            expected, result = getattr(single_states, name)[0, 0], getattr(flown, name)[0, k]
            np.testing.assert_allclose(result, expected, rtol=3e-5, atol=3e-5, err_msg=f"{airframe} {name}")
        expected, result = single_states.rotor_vel[0, 0], flown.rotor_vel[0, k]
        np.testing.assert_allclose(result[:n], expected, rtol=1e-3)
        np.testing.assert_array_equal(result[n:], 0)


@pytest.mark.parametrize(("key", "name"), [("inertia", "hexarotor"), ("lag", "bumblebee")])
def test_rotors_of_one_airframe_may_differ_where_numbers_of_rotors_differ(key, name):
    """The airframe whose rotors differ is the one with fewer or the one with more rotors."""
    fleet = {"bumblebee": load_airframe("bumblebee"), "hexarotor": load_airframe(HEXAROTOR)}
    n, value = fleet[name].n_rotors, np.asarray(fleet[name].value(f"rotors.{key}"))
    factors = np.linspace(0.9, 1.1, n).reshape(n, *[1] * (value.ndim if key == "lag" else 0))
    fleet[name] = load_airframe({"base": fleet[name], "rotors": {key: (value * factors).tolist()}})
    pos = random_positions(1, 2)
    mixed = set_flying(Sim(drone=list(fleet.values()), control="body_rate", engine="interpret"), pos)
    mixed.step(25)
    for k, airframe in enumerate(fleet.values()):
        single_sim = set_flying(Sim(drone=airframe, control="body_rate", engine="interpret"), pos[:, k : k + 1])
        single_sim.step(25)
        result, expected = mixed.data.states.ang_vel[0, k], single_sim.data.states.ang_vel[0, 0]
        np.testing.assert_allclose(result, expected, rtol=3e-5, atol=3e-5)


def test_only_parameters_that_differ_have_an_axis_of_drones():
    params = Sim(3, drone=FLEET).data.params
    assert params.gravity_vec.shape == (3,)
    assert params.mass.shape == (3, 4, 1)
    assert params.mixing_matrix.shape == (3, 4, 3, 6)
    exists = np.asarray(params.rotor_vel_max)[0, :, 4:] > 0
    np.testing.assert_array_equal(np.all(exists, axis=-1), [False, False, True, False])
    np.testing.assert_array_equal(np.any(exists, axis=-1), [False, False, True, False])


def test_hover_of_a_mixed_fleet_carries_the_weight_of_each():
    params = Sim(1, drone=FLEET).data.params
    speed = first_principles.hover_rotor_vel(params)
    thrust = np.sum(jax.jit(first_principles.quadratic_curve)(speed, params.rpm2thrust), axis=-1)
    np.testing.assert_allclose(thrust, 9.81 * np.asarray(params.mass)[..., 0], rtol=1e-5)
    np.testing.assert_array_equal(np.asarray(speed)[0, 0, 4:], 0)


@pytest.mark.long("compiles gradients through a controller for each airframe")
@pytest.mark.parametrize(
    ("control", "controller", "engine"),
    [("state", "crazyflow", None), ("rotor_vel", "crazyflow", "lanes")],
)
def test_gradients_of_a_mixed_fleet_are_finite(control, controller, engine):
    """Law 7, without and with an engine: missing rotors cause no division by zero, and nothing depends on them."""
    settings = {"control": control, "controller": controller, "engine": engine or "plain"}
    sim = set_flying(Sim(1, drone=FLEET, **settings), random_positions(1, 4))
    step = sim.step_fn if engine else build_stagewise_step(sim)

    def height(command):
        data = getattr(cs.functional, f"{control}_control")(sim.data, command)
        return jnp.sum(step(data, 10).states.pos)

    command = np.float32(COMMANDS[control])
    slope = np.asarray(jax.jit(jax.grad(height))(np.tile(command, (1, 4, 1))))
    assert np.all(np.isfinite(slope))
    if control == "state":
        assert np.all(slope[0, :, 2] != 0)
    else:
        exists = np.asarray(sim.data.params.rotor_vel_max)[0] > 0
        np.testing.assert_array_equal(slope[0] != 0, exists)


def test_effects_take_the_numbers_of_each_airframe():
    fleet = ("cf21B_500", HEXAROTOR | {"shape": {"propeller_radius": 0.03}})
    sim = Sim(2, drone=fleet, engine="interpret")
    effects = (cs.Battery(0.35, 0.1), cs.GroundEffect(), cs.MotorFailure(), cs.Downwash())
    for effect in effects:
        sim.add(effect)
    for k, airframe in enumerate(fleet):
        single_sim = Sim(2, drone=airframe, engine="interpret")
        for effect in effects:
            record, mixed = single_sim.add(effect).read(single_sim.data), effect.read(sim.data)
            for name in ("full_speed_voltage", "propeller_radius", "rotor_pos", "diameter"):
                if hasattr(record, name):
                    expected = np.asarray(getattr(record, name))
                    result = np.asarray(getattr(mixed, name))
                    result = result[0, k] if result.ndim > expected.ndim else result
                    result = result[: len(expected)]  # rows of rotors that it lacks follow
                    np.testing.assert_allclose(result, expected, rtol=1e-6, err_msg=name)
    sim.step(2)
    assert np.all(np.isfinite(sim.data.states.pos))


def test_contacts_and_rays_meet_the_shape_of_each_drone():
    fleet = ("cf21B_500", "bumblebee", "cf21B_500")
    sim = Sim(1, drone=fleet)
    pos = np.float32([[[0.0, 0, 2], [5, 0, 2], [0, 5, 2]]])
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    radii = np.array([airframe.value("shape.collision_sphere")[3] for airframe in sim.airframes])
    heights = np.array([airframe.value("shape.collision_sphere")[2] for airframe in sim.airframes])
    report = sim.contact_report()
    np.testing.assert_allclose(np.asarray(report.floor_distance)[0], 2 + heights - radii, atol=1e-5)
    between = np.linalg.norm([5.0, 0, heights[0] - heights[1]]) - radii[0] - radii[1]
    np.testing.assert_allclose(np.asarray(report.drone_distance)[0, :2], between, atol=1e-5)
    log = sim.add(cs.ContactLog(floor=False))
    near = pos.copy()
    near[0, 2] = pos[0, 1] + [0.0, radii[1] + radii[2] - 0.01, 0]
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=near))
    sim.add(cs.RangeFinder(directions=[[0.0, 0, -1]]))
    sim.step()
    np.testing.assert_array_equal(np.asarray(log.read(sim.data).drones)[0], [False, True, True])
    assert sim.contact_report().nearest_drone.shape == (1, 3)


def test_drones_of_a_mixed_fleet_stand_on_the_floor():
    sim = Sim(1, drone=("cf21B_500", "bumblebee"), engine="plain")
    sim.add(cs.ContactResponse())
    sim.data = with_states(sim.data, pos=[[[0.0, 0.0, 0.1], [1.0, 0.0, 0.1]]])
    sim.step(250)
    for k, airframe in enumerate(sim.airframes):
        box = airframe.value("shape.collision_box")
        np.testing.assert_allclose(np.asarray(sim.data.states.pos)[0, k, 2], box[5] - box[2], atol=5e-3)


def test_the_airframe_of_a_mixed_fleet_is_an_error_that_lists_them():
    sim = Sim(drone=("cf21B_500", "bumblebee"))
    for name in ("airframe", "drone"):
        with pytest.raises(ConfigError, match=r"'cf21B_500', 'bumblebee'\. Use sim\.airframes, one for each"):
            getattr(sim, name)
    assert [airframe.name for airframe in sim.airframes] == ["cf21B_500", "bumblebee"]


@pytest.mark.parametrize(
    ("n_drones", "fleet", "error", "message"),
    [
        (3, ["cf21B_500", "bumblebee"], ConfigError, r"expected 3 airframes, .* got 2. Use Sim\(n_drones=2\)"),
        (1, [], ConfigError, "expected an airframe or a list with one for each drone, got an empty list"),
        (2, ["cf21B_500", "bumble"], UnknownNameError, "expected a drone as one of .* got 'bumble'"),
        (2, ["cf21B_500", 3], ConfigError, "expected a drone as a name"),
    ],
)
def test_wrong_lists_are_refused(n_drones, fleet, error, message):
    with pytest.raises(error, match=message):
        Sim(n_drones=n_drones, drone=fleet)


def test_airframes_that_lack_gains_are_named():
    with pytest.raises(ConfigError, match=r"airframe 'bumblebee' lacks \[mellinger\] mass, mass_thrust, kp, "):
        Sim(drone=FLEET, control="state", controller="mellinger")
    records = {"cf21B_500": first_principles.Params.create(load_airframe("cf21B_500"))}
    records["bumblebee"] = records["cf21B_500"].replace(L=None)
    with pytest.raises(ConfigError, match="the same fields of Params, got 'cf21B_500' and 'bumblebee'"):
        create_per_drone([load_airframe(name) for name in records], lambda airframe: records[airframe.name], 1)
