"""Airframes: what their files hold, the mixing that follows from rotor positions, and a user's own."""

import copy
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from crazysim import ConfigError, Sim
from crazysim.control import AllocationParams, AttitudeParams, StateParams
from crazysim.drones import Airframe, Drone, airframe_names, load_airframe
from crazysim.drones.airframe import FOLDER
from crazysim.drones.body import body_geoms, outline
from crazysim.drones.keys import KEYS, TABLES, TOP_LEVEL
from crazysim.dynamics import Dynamics, first_principles, fitted, supported_drones, supported_dynamics

FILES = sorted(FOLDER.glob("*.toml"))


def raw(name):
    return tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))


def numbers(node, path=""):
    """Yield the path and entry of every key that is no table of further keys."""
    for key, entry in node.items():
        if isinstance(entry, dict) and "value" not in entry:
            yield from numbers(entry, f"{path}{key}.")
        else:
            yield f"{path}{key}", entry


def plain(name):
    """Return a built-in airframe as a user would write it: a dict of plain numbers."""

    def strip(node):
        return {k: (v["value"] if "value" in v else strip(v)) for k, v in node.items()}

    return strip({k: v for k, v in raw(name).items() if k != "sources"})


def test_every_file_is_an_airframe_and_the_other_way_round():
    assert {path.stem for path in FILES} == set(airframe_names())
    assert len(FILES) >= 7


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_number_has_a_unit_and_a_source(path):
    tables = raw(path.stem)
    sources = tables.pop("sources")
    assert tables.pop("base", None) in (None, *airframe_names())
    found = list(numbers(tables))
    assert len(list(numbers(load_airframe(path.stem).tables))) > 30
    for key, entry in found:
        assert isinstance(entry, dict), f"{key} is a bare number"
        assert set(entry) == {"value", "unit", "source"}, key
        assert isinstance(entry["unit"], str), key
        assert entry["unit"], key
        assert entry["source"] in sources, f"{key}: no [sources] entry {entry['source']!r}"
    assert all(len(text) > 10 for text in sources.values())
    unused = set(sources) - {entry["source"] for _, entry in found}
    assert not unused


def test_drones_of_a_model_are_those_that_support_it():
    for dynamics in Dynamics:
        drones = supported_drones(dynamics.value)
        assert drones == tuple(drone for drone in Drone if dynamics in supported_dynamics(drone))
    assert Drone.hb_x500 in supported_drones("so_rpy")
    assert Drone.hb_x500 not in supported_drones(Dynamics.first_principles)
    with pytest.raises(ValueError, match=r"expected dynamics as one of first_principles, so_rpy.*, got 'so_rpyx'"):
        supported_drones("so_rpyx")


@pytest.mark.parametrize("name", airframe_names())
def test_every_airframe_gives_parameters_for_all_it_supports(name):
    airframe = load_airframe(name)
    assert airframe.name == name
    supported = supported_dynamics(airframe)
    assert supported
    assert supported == supported_dynamics(name)
    for dynamics in Dynamics:
        is_full = dynamics == Dynamics.first_principles
        create = first_principles.Params.create if is_full else lambda a, d=dynamics: fitted.Params.create(a, d)
        if dynamics in supported:
            create(airframe)
        else:
            with pytest.raises(ConfigError, match=rf"has parameters for \({supported[0]}.*\), got '{dynamics.value}'"):
                create(airframe)
    StateParams.create(airframe)
    AttitudeParams.create(airframe)
    if Dynamics.first_principles in supported:
        AllocationParams.create(airframe)


@pytest.mark.parametrize("name", airframe_names())
def test_numbers_of_an_airframe_are_plausible(name):
    """Thrust to weight between 1.3 and 12 (a racer), drag that dissipates, and curves that rise."""
    airframe = load_airframe(name)
    to_weight = airframe.n_rotors * airframe.value("rotors.thrust_max") / (airframe.value("rigid_body.mass") * 9.81)
    assert 1.3 < to_weight < 12
    moments = np.sort(np.linalg.eigvalsh(airframe.inertia))
    assert moments[0] + moments[1] >= moments[2] * (1 - 1e-9), "no rigid body has such moments of inertia"
    assert sorted(np.abs(airframe.value("rotors.yaw_torque_sign"))) == [1] * airframe.n_rotors
    assert np.sum(airframe.value("rotors.yaw_torque_sign")) == 0
    if Dynamics.first_principles in supported_dynamics(airframe):
        assert np.max(airframe.value("drag.coefficients")) <= 0
        params = first_principles.Params.create(airframe)
        low, hover, high = (
            float(np.min(x))
            for x in (params.rotor_vel_min, first_principles.hover_rotor_vel(params), params.rotor_vel_max)
        )
        assert 0 <= low < hover < high
        assert 5_000 < high < 40_000


def test_mixing_matrix_by_hand():
    """Rotors ahead-left (0.1, 0.2), ahead-right (0.3, -0.2), behind (-0.4, 0): arm 0.4.

    A thrust at (x, y) pushes up along z, so its torque is (y, -x, 0): left rotors roll to the right, rotors ahead
    raise the nose, which is a negative torque about y.
    """
    tables = plain("cf21B_500")
    tables["rotors"]["position"] = [[0.1, 0.2, 0.0], [0.3, -0.2, 0.0], [-0.4, 0.0, 0.1]]
    tables["rotors"]["yaw_torque_sign"] = [1, -1, 1]
    airframe = load_airframe(tables)
    assert airframe.arm == 0.4
    np.testing.assert_allclose(airframe.mixing_matrix, [[0.5, -0.5, 0.0], [-0.25, -0.75, 1.0], [1, -1, 1]])


def test_mixing_matrix_of_a_crazyflie():
    """Rotors 1 to 4 go clockwise from ahead-right, seen from above; 1 and 3 turn so that their drag yaws right."""
    expected = [[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]
    np.testing.assert_array_equal(load_airframe("cf21B_500").mixing_matrix, expected)


def test_names_files_and_dicts_give_the_same_airframe(tmp_path):
    text = (FOLDER / "cf2x_L250.toml").read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    by_name, by_str, by_path = load_airframe(Drone.cf2x_L250), load_airframe(str(path)), load_airframe(path)
    by_dict = load_airframe(plain("cf2x_L250"))
    assert (by_name.name, by_str.name, by_path.name, by_dict.name) == ("cf2x_L250", "mine", "mine", "custom")
    assert load_airframe(plain("cf2x_L250") | {"name": "named"}).name == "named"
    for other in (by_str, by_path, by_dict):
        for key, entry in numbers(by_name.tables):
            np.testing.assert_array_equal(entry, other.value(key), key)
    assert load_airframe(by_name) is by_name


def test_a_users_dict_is_left_alone_and_an_airframe_cannot_be_changed():
    tables = plain("cf21B_500") | {"name": "mine"}
    before = copy.deepcopy(tables)
    airframe = load_airframe(tables)
    assert tables == before
    with pytest.raises(ValueError, match="read-only"):
        airframe.value("rigid_body.inertia")[0] = 1.0


def hexacopter():
    """Return a Crazyflie with six rotors on a circle of 60 mm, the first ahead, neighbours turning against."""
    tables = plain("cf21B_500") | {"name": "hexa"}
    angle = np.pi / 3 * np.arange(6)
    position = 0.06 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    rotors = tables["rotors"] | {"position": position.tolist(), "yaw_torque_sign": [1, -1, 1, -1, 1, -1]}
    del tables["fitted"]
    return tables | {"rotors": rotors, "rigid_body": {"mass": 0.06, "inertia": [6e-5, 6e-5, 1e-4]}}


@pytest.mark.parametrize("control", ["rotor_vel", "attitude"])
def test_a_hexacopter_from_a_dict_hovers(control):
    sim = Sim(n_worlds=2, drone=hexacopter(), control=control)
    assert sim.data.states.rotor_vel.shape == (2, 1, 6)
    rotor_vel = first_principles.hover_rotor_vel(sim.data.params)
    assert rotor_vel.shape == (6,)
    pos = sim.data.states.pos.at[..., 2].set(1.0)
    rotors = np.broadcast_to(rotor_vel, (2, 1, 6))
    # World 1 begins turned by 5 degrees about every axis, which its attitude controller has to undo.
    tilted = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (2, 1, 4)).copy()
    if control == "attitude":
        tilted[1] = [0.0427, 0.0427, 0.0427, 0.9973]
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos, rotor_vel=rotors, quat=tilted))
    if control == "rotor_vel":
        sim.rotor_vel_control(rotors)
    else:
        sim.attitude_control(np.broadcast_to([0, 0, 0, 0.06 * 9.81], (2, 1, 4)))
    sim.step(250)
    states = sim.data.states
    # Rotor speeds in float32 are known to 1e-3 rpm, the thrust to 1e-6 of the weight: micrometres in half a second.
    np.testing.assert_allclose(states.pos[0, 0], [0, 0, 1], atol=1e-4)
    np.testing.assert_allclose(states.quat[0, 0], [0, 0, 0, 1], atol=1e-4)
    # From 5 degrees of tilt the controller settles to below 1 degree of yaw, its slowest axis, and 0.2 of the others.
    np.testing.assert_allclose(states.quat[1, 0], [0, 0, 0, 1], atol=8e-3)
    np.testing.assert_allclose(states.quat[1, 0, :2], [0, 0], atol=2e-3)
    np.testing.assert_allclose(states.pos[1, 0], [0, 0, 1], atol=0.2)


def test_a_toml_file_anywhere_on_disk_flies(tmp_path):
    """No file of the package is touched, and none but the user's is needed."""
    path = tmp_path / "heavy.toml"
    path.write_text(
        (FOLDER / "cf21B_500.toml").read_text(encoding="utf-8").replace("0.0434", "0.0500"), encoding="utf-8"
    )
    sim = Sim(drone=path, control="rotor_vel")
    assert sim.drone == "heavy"
    np.testing.assert_allclose(sim.data.params.mass, [0.05])


def without(path):
    def change(tables):
        *parents, key = path.split(".")
        node = tables
        for parent in parents:
            node = node[parent]
        del node[key]

    return change


def setting(path, value):
    def change(tables):
        *parents, key = path.split(".")
        node = tables
        for parent in parents:
            node = node[parent]
        node[key] = value

    return change


WRONG = {
    "no rigid body": (without("rigid_body"), r"no table \[rigid_body\]"),
    "no mass": (
        without("rigid_body.mass"),
        r"has no value 'rigid_body.mass'. Add mass to its table \[rigid_body\]; docs",
    ),
    "mass a string": (
        setting("rigid_body.mass", "heavy"),
        "expected rigid_body.mass as a number or array, got 'heavy'",
    ),
    "mass a list": (setting("rigid_body.mass", [0.03]), r"expected rigid_body.mass of shape \(\), got \(1,\)"),
    "mass a table": (
        setting("rigid_body.mass", {"kilos": 0.03}),
        r"expected rigid_body.mass as a number, an array or \{ value, unit, source \}, got \{'kilos': 0.03\}",
    ),
    "mass negative": (setting("rigid_body.mass", -0.03), "expected a positive mass, got -0.03 kg"),
    "mass nan": (setting("rigid_body.mass", float("nan")), "expected rigid_body.mass to be finite, got nan"),
    "too heavy": (setting("rigid_body.mass", 0.2), "expected rotors that lift 0.2 kg, got 4 rotors of at most 0.2 N"),
    "inertia of two": (setting("rigid_body.inertia", [1e-5, 1e-5]), "three positive moments"),
    "inertia negative": (setting("rigid_body.inertia", [1e-5, 1e-5, -1e-5]), "three positive moments"),
    "inertia askew": (
        setting("rigid_body.inertia", [[1e-5, 1e-6, 0], [0, 1e-5, 0], [0, 0, 1e-5]]),
        "symmetric positive definite",
    ),
    "rotors a number": (setting("rotors", 4), r"expected a table \[rotors\], got 4"),
    "positions flat": (
        setting("rotors.position", [0.1, 0.1]),
        r"expected rotors.position of shape \(n, 3\), got \(2,\)",
    ),
    "ragged positions": (setting("rotors.position", [[0.1, 0.1], [0.1]]), "as a number or array, got"),
    "three signs": (
        setting("rotors.yaw_torque_sign", [1, -1, 1]),
        r"expected rotors.yaw_torque_sign of shape \(4,\), got \(3,\)",
    ),
    "thrusts reversed": (setting("rotors.thrust_max", 0.01), "expected 0 <= thrust_min < thrust_max, got"),
    "curve of two": (
        setting("rotors.thrust_curve", [0.0, 1e-10]),
        r"expected rotors.thrust_curve of shape \(3,\) or \(4, 3\), got \(2,\)",
    ),
    "one drag": (
        setting("drag.coefficients", [-0.02]),
        r"expected drag.coefficients of shape \(3,\) or \(3, 3\), got \(1,\)",
    ),
    "lag of two": (setting("rotors.lag", [14.0, 1e-4]), r"expected rotors.lag of shape \(4,\) or \(4, 4\), got \(2,\)"),
    "stiffness": (
        setting("fitted.so_rpy.rpy_coef", -150.0),
        r"expected fitted.so_rpy.rpy_coef of shape \(3,\), got \(\)",
    ),
    "no gain": (
        without("controller.attitude.kR"),
        r"has no value 'controller.attitude.kR'. Add kR to its table \[controller.attitude\]; docs",
    ),
    "no controller": (without("controller"), r"has no value 'controller.\w+.\w+'. Add \w+ to its table"),
    "shape misspelt": (
        setting("shape.propellor_radius", 0.02),
        "expected a key that exists, got 'shape.propellor_radius'. Did you mean 'shape.propeller_radius'",
    ),
    "table misspelt": (
        setting("rigidbody", {"mass": 0.05}),
        r"airframe 'custom': expected a table that exists, got \[rigidbody\]. Did you mean \[rigid_body\]\? docs",
    ),
    "inner table misspelt": (
        setting("controller.atitude", {"kR": [1, 1, 1]}),
        r"got \[controller.atitude\]. Did you mean \[controller.attitude\]",
    ),
    "mass misspelt": (
        setting("rigid_body.mas", 0.05),
        "expected a key that exists, got 'rigid_body.mas'. Did you mean 'rigid_body.mass'",
    ),
    "base misspelt": (setting("bse", "cf2x_L250"), "expected a key that exists, got 'bse'. Did you mean 'base'"),
    "mass in no table": (setting("mass", 0.05), "got 'mass'. Did you mean 'rigid_body.mass' or 'controller.mass'"),
    "unit misspelt": (
        setting("rigid_body.mass", {"value": 0.03, "units": "kg"}),
        r"as a number, an array or \{ value, unit, source \}, got \{'value': 0.03, 'units': 'kg'\}",
    ),
    "a table of one's own": (setting("paint", {"colour": 3}), r"expected a table that exists, got \[paint\]. docs"),
    "a coefficient of another model": (
        setting("fitted.so_rpy.thrust_dyn_coef", 16.0),
        "got 'fitted.so_rpy.thrust_dyn_coef'. Did you mean 'fitted.so_rpy_rotor.thrust_dyn_coef'",
    ),
    "shape of two": (setting("shape.plate", [0.03, 0.03]), r"expected shape.plate of shape \(3,\), got \(2,\)"),
    "no drag": (without("drag"), "has no value 'drag.coefficients'"),
    "no thrust curve": (without("rotors.thrust_curve"), r"has parameters for \(so_rpy.*\), got 'first_principles'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_law_09_a_wrong_airframe_is_refused(case):
    change, message = WRONG[case]
    tables = plain("cf21B_500")
    change(tables)
    with pytest.raises(ConfigError, match=message):
        Sim(drone=tables)


@pytest.mark.parametrize(
    "source", ["no_such_drone", "missing.toml", Path("nowhere") / "x.toml", "", 5, None, ["cf21B_500"]]
)
def test_law_09_a_source_that_is_no_airframe_is_answered_with_the_names(source):
    with pytest.raises(
        ConfigError, match=r"expected a drone as .*cf21B_500.*or a dict, got|a drone as a name, the path of a TOML file"
    ):
        load_airframe(source)


def test_law_09_a_broken_toml_file_is_named(tmp_path):
    path = tmp_path / "broken.toml"
    path.write_text("[rotors\nposition = 3", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"broken\.toml is not valid TOML"):
        load_airframe(path)


def test_law_09_an_unknown_key_is_answered_with_the_file(tmp_path):
    path, heir = tmp_path / "mine.toml", tmp_path / "heir.toml"
    path.write_text('base = "cf2x_L250"\n[rigid_body]\nmas = 0.05\n', encoding="utf-8")
    heir.write_text(f'base = "{path}"\n', encoding="utf-8")
    for source in (path, heir):
        with pytest.raises(ConfigError, match=r"airframe 'mine' in .*mine\.toml: .*got 'rigid_body.mas'"):
            load_airframe(source)


def test_the_page_lists_all_tables_and_keys_and_no_others():
    """Cells of the first two columns of the table "Keys", and the first of the table "Shape"."""
    page = (Path(__file__).parents[2] / "docs/guides/airframes.md").read_text(encoding="utf-8")
    section = page.split("## Keys")[1].split("## From a dict")[0]
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines() if re.match(r"\| (?!-)", line)
    ]
    found, table = set(), ""
    for row in rows[1:]:
        is_shape = len(row) == 3
        if not is_shape and row[0]:
            table = row[0].strip("`")
        keys = re.findall(r"`(\w+)`", row[0] if is_shape else row[1])
        found |= {f"shape.{key}" if is_shape else f"{table}.{key}".removeprefix(".") for key in keys}
    assert found == {*KEYS, *TOP_LEVEL}


def test_models_of_the_keys_are_those_of_the_dynamics():
    fits = {table.removeprefix("fitted.") for table in TABLES if table.startswith("fitted.")}
    assert fits == set(Dynamics) - {Dynamics.first_principles}


def test_a_file_may_give_its_own_name(tmp_path):
    path = tmp_path / "file.toml"
    path.write_text('name = "racer"\nbase = "cf2x_L250"\n', encoding="utf-8")
    assert load_airframe(path).name == "racer"


def test_an_airframe_shows_its_name():
    assert repr(load_airframe("hb_x500")) == "Airframe('hb_x500')"
    assert isinstance(load_airframe("hb_x500"), Airframe)


def test_law_09_a_mistyped_path_is_answered_with_those_that_are_near():
    airframe = load_airframe("cf21B_500")
    for path, near in (
        ("mass", "'rigid_body.mass'"),
        ("rigid_body.mas", "'rigid_body.mass'"),
        ("thrust_curve", "'rotors.thrust_curve'"),
        ("motors.thrust_max", "'rotors.thrust_max'"),
        ("controler.state.kp", "'controller.state.kp'"),
    ):
        with pytest.raises(ConfigError, match=f"has no value '{path}'. Did you mean .*{near}"):
            airframe.value(path)
    with pytest.raises(ConfigError, match=r"has no value 'qqq'. docs/guides/airframes.md lists"):
        airframe.value("qqq")
    with pytest.raises(ConfigError, match=r"has no table \[wings\], only \['battery', 'controller'"):
        airframe.table("wings")


def test_a_base_gives_the_numbers_that_are_not_given(tmp_path):
    """Numbers are replaced one by one, from dicts and files alike, and a base may have a base."""
    (tmp_path / "light.toml").write_text('base = "bumblebee_lab"\n[rigid_body]\nmass = 0.5\n', encoding="utf-8")
    lab, light = load_airframe("bumblebee_lab"), load_airframe(tmp_path / "light.toml")
    named = load_airframe({"base": str(tmp_path / "light.toml"), "name": "named", "rotors": {"thrust_max": 12.0}})
    changed = {"rigid_body.mass": (0.5, 0.5), "rotors.thrust_max": (15.0, 12.0)}
    assert (light.name, named.name) == ("light", "named")
    for path, value in numbers(lab.tables):
        for airframe, expected in zip((light, named), changed.get(path, (value, value)), strict=True):
            np.testing.assert_array_equal(airframe.value(path), expected)


@pytest.mark.parametrize("name", supported_drones("first_principles"))
def test_figure_of_merit_at_hover(name):
    """Ideal over actual power of a rotor at hover, ``T^1.5 / sqrt(2 rho A) / (Q w)``, as the files state it.

    Lower than 0.2 are the two that keep a preset of a lab: their files say so.
    """
    airframe = load_airframe(name)
    params = first_principles.Params.create(airframe)
    rotor_vel = float(np.ravel(first_principles.hover_rotor_vel(params))[0])
    radius, thrust = (
        float(airframe.value("shape.propeller_radius")),
        float(airframe.value("rigid_body.mass")) * 9.81 / 4,
    )
    torque = float(np.polyval(airframe.value("rotors.torque_curve")[::-1], rotor_vel))
    ideal = thrust**1.5 / np.sqrt(2 * 1.225 * np.pi * radius**2)
    merit = ideal / (torque * rotor_vel * 2 * np.pi / 60)
    text = (FOLDER / f"{name}.toml").read_text(encoding="utf-8")
    assert f"igure of merit {merit:.2f} at hover" in text or f"a figure of merit of {merit:.2f}," in text
    assert (merit < 0.2) == (name in ("crazyflie", "bumblebee_lab"))


def test_full_thrust_voltage_is_that_of_the_firmwares_curves():
    """Their cubic meets the largest thrust: worked out with numpy.roots from the firmware's four coefficients."""
    expected = {"cf21B_500": 3.1257, "cf2x_P250": 3.0799, "cf2x_T350": 2.8166, "cf2x_L250": 2.9836, "crazyflie": 3.3482}
    for name in airframe_names():
        found = load_airframe(name).full_thrust_voltage
        assert found == (pytest.approx(expected[name], abs=1e-4) if name in expected else None)


@pytest.mark.parametrize("name", ["cf21B_500", "cf2x_L250", "bumblebee", "hb_x500"])
def test_a_body_without_a_shape_is_about_as_large_as_the_real_one(name):
    """Lengths that are left out follow from mass and rotors: within a factor of 2.1, spheres of contact within 20%."""
    tables = plain(name)
    true = outline(load_airframe(tables))
    derived = outline(load_airframe({k: v for k, v in tables.items() if k != "shape"}))
    assert set(derived) == set(TABLES["shape"])
    for key in ("plate", "battery", "arm_radius", "motor_radius", "propeller_radius"):
        ratio = (derived[key] / true[key]).ravel()[:2]  # not the thickness of the plate
        assert np.all((ratio > 1 / 2.1) & (ratio < 2.1)), (key, ratio)
    np.testing.assert_allclose(derived["collision_sphere"][3], true["collision_sphere"][3], rtol=0.2)
    assert {key: value.shape for key, value in derived.items()} == {k: v[0] for k, v in TABLES["shape"].items()}
    some = outline(load_airframe(tables | {"shape": {"propeller_radius": 0.02}}))
    assert some["propeller_radius"] == 0.02
    np.testing.assert_allclose(some["plate"], derived["plate"])


def test_a_drone_without_a_shape_flies_and_is_rendered_and_touches():
    tables = plain("cf21B_500")
    del tables["shape"]
    sim = Sim(drone=tables)
    sim.step(5)
    assert len(body_geoms(sim.airframe)) == len(body_geoms(load_airframe("cf21B_500")))
    assert sim.mj_model.geom("col_sphere:0").size[0] > 0.05
