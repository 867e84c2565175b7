"""Airframes: their files, the mixing that follows from rotor positions, airframes of users, and errors (law 9)."""

import copy
import functools
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from crazysim import ConfigError, Sim
from crazysim.control import AllocationParams, AttitudeParams, StateParams
from crazysim.drones import Drone, airframe_names, load_airframe
from crazysim.drones.body import body_geoms, body_shape
from crazysim.drones.keys import LAYOUT, TABLES
from crazysim.drones.loading import AIRFRAME_FOLDER
from crazysim.dynamics import Dynamics, first_principles, fitted, supported_drones, supported_dynamics
from crazysim.errors import AirframeWarning

FILES = sorted(AIRFRAME_FOLDER.glob("*.toml"))


def read_tables(name):
    return tomllib.loads((AIRFRAME_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))


def iterate_numbers(node, path=""):
    for key, entry in node.items():
        if isinstance(entry, dict) and "value" not in entry:
            yield from iterate_numbers(entry, f"{path}{key}.")
        else:
            yield f"{path}{key}", entry


def plain_tables(name):
    """Return the tables of a built-in airframe without units and sources, as a user would write them."""

    def strip(node):
        return {k: (v["value"] if "value" in v else strip(v)) for k, v in node.items()}

    return strip({k: v for k, v in read_tables(name).items() if k != "sources"})


def test_every_file_is_an_airframe_and_every_airframe_has_a_file():
    assert {path.stem for path in FILES} == set(airframe_names())
    assert len(FILES) >= 7


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_number_has_a_unit_and_a_source(path):
    tables = read_tables(path.stem)
    sources = tables.pop("sources")
    assert tables.pop("base", None) in (None, *airframe_names())
    assert tables.pop("name", path.stem) == path.stem
    result = list(iterate_numbers(tables))
    assert len(list(iterate_numbers(load_airframe(path.stem).tables))) > 30
    for key, entry in result:
        assert isinstance(entry, dict), f"{key} is a bare number"
        assert set(entry) == {"value", "unit", "source"}, key
        assert isinstance(entry["unit"], str), key
        assert entry["unit"], key
        assert entry["source"] in sources, f"{key}: no [sources] entry {entry['source']!r}"
    assert all(len(text) > 10 for text in sources.values())
    unused = set(sources) - {entry["source"] for _, entry in result}
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
        is_first_principles = dynamics == Dynamics.first_principles
        create = (
            first_principles.Params.create if is_first_principles else lambda a, d=dynamics: fitted.Params.create(a, d)
        )
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
def test_every_airframe_has_a_battery(name):
    """Its mass is 10 to 40% of the drone's.

    Like a lithium-polymer battery it holds 80 to 200 W h/kg, and the resistance of a cell times its capacity is 0.01 to
    0.05 ohm A h.
    """
    airframe = load_airframe(name)
    cells, capacity, resistance, mass = (
        float(airframe.value(f"battery.{key}", ())) for key in ("cells", "capacity", "resistance", "mass")
    )
    assert 0.1 < mass / airframe.value("rigid_body.mass") < 0.4
    assert 80 < cells * capacity * 3.7 / mass < 200
    assert 0.01 < resistance / cells * capacity < 0.05


@pytest.mark.parametrize("name", airframe_names())
def test_numbers_of_an_airframe_are_plausible(name):
    """Thrust over weight is from 1.3 to 12 (a racer), and half of the rotors turn each way.

    A rigid body can have the moments of inertia. From first principles, drag brakes, and the speed of hover is between
    the limits of the rotors.
    """
    airframe = load_airframe(name)
    thrust_to_weight = (
        airframe.n_rotors * airframe.value("rotors.thrust_max") / (airframe.value("rigid_body.mass") * 9.81)
    )
    assert 1.3 < thrust_to_weight < 12
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
    tables = plain_tables("cf21B_500")
    tables["rotors"]["position"] = [[0.1, 0.2, 0.0], [0.3, -0.2, 0.0], [-0.4, 0.0, 0.1]]
    tables["rotors"]["yaw_torque_sign"] = [1, -1, 1]
    airframe = load_airframe(tables)
    assert airframe.arm == 0.4
    np.testing.assert_allclose(airframe.mixing_matrix, [[0.5, -0.5, 0.0], [-0.25, -0.75, 1.0], [1, -1, 1]])


@pytest.mark.parametrize("name", airframe_names())
def test_rotors_of_built_in_airframes_are_in_bitcrazes_order_and_turn_as_its_motors(name):
    """Rotors 1 to 4 go clockwise from ahead-right, seen from above.

    A torque to the left lowers the thrusts of rotors 1 and 3, and raises those of 2 and 4, as in
    powerDistributionForceTorque of Bitcraze's firmware and of the lab's bumblebee-firmware. It agrees with PX4's X500,
    whose motors ahead-right and behind-left turn counter-clockwise.
    """
    mixing = load_airframe(name).mixing_matrix
    np.testing.assert_array_equal(np.sign(mixing), [[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])


def test_names_files_and_dicts_give_the_same_airframe(tmp_path):
    text = (AIRFRAME_FOLDER / "cf2x_L250.toml").read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    by_name, by_str, by_path = load_airframe(Drone.cf2x_L250), load_airframe(str(path)), load_airframe(path)
    by_dict = load_airframe(plain_tables("cf2x_L250"))
    assert (by_name.name, by_str.name, by_path.name, by_dict.name) == ("cf2x_L250", "mine", "mine", "custom")
    assert load_airframe(plain_tables("cf2x_L250") | {"name": "named"}).name == "named"
    for other in (by_str, by_path, by_dict):
        for key, entry in iterate_numbers(by_name.tables):
            np.testing.assert_array_equal(entry, other.value(key), key)
    assert load_airframe(by_name) is by_name


def test_a_users_dict_is_not_changed_and_an_airframe_cannot_be_changed():
    tables = plain_tables("cf21B_500") | {"name": "mine"}
    before = copy.deepcopy(tables)
    airframe = load_airframe(tables)
    assert tables == before
    with pytest.raises(ValueError, match="read-only"):
        airframe.value("rigid_body.inertia")[0] = 1.0


def test_a_toml_file_anywhere_on_disk_flies(tmp_path):
    """No file of the package changes, and only the user's file is needed."""
    path = tmp_path / "heavy.toml"
    path.write_text(
        (AIRFRAME_FOLDER / "cf21B_500.toml").read_text(encoding="utf-8").replace("0.0434", "0.0500"), encoding="utf-8"
    )
    sim = Sim(drone=path, control="rotor_vel")
    assert sim.drone == "heavy"
    np.testing.assert_allclose(sim.data.params.mass, [0.05])


MISSING = object()
ROW_OF_ROTORS, OFF_CENTRE = [[x, 0, 0] for x in (-0.1, -0.05, 0.05, 0.1)], [[x, y, 0] for x, y in
    ((0.1, -0.03), (0.02, -0.03), (0.02, 0.03), (0.1, 0.03))]  # fmt: skip
WRONG_AIRFRAMES = [
    ("rigid_body", MISSING, "no table [rigid_body]"),
    ("rigid_body.mass", MISSING, "Add mass to its table [rigid_body]"),
    ("rigid_body.mass", [0.03], ""),
    ("rigid_body.mass", {"kilos": 0.03}, "{ value, unit, source }"),
    ("rigid_body.mass", {"value": 0.03, "units": "kg"}, "{ value, unit, source }"),
    ("rigid_body.mass", "0.03", ""),
    ("rigid_body.mass", -0.03, ""),
    ("rigid_body.mass", 10**400, ""),
    ("rigid_body.mass", 1e-6, "rotors that lift 1e-06 kg"),
    ("rigid_body.mass", 0.2, "rotors that lift 0.2 kg"),
    ("rigid_body.inertia", [1e-5, 1e-5, 9e-5], "at most the sum of the others"),
    ("rigid_body.inertia", [1e-14] * 3, "at most 1e+06 rad/s"),
    ("rigid_body.inertia", [[1e-5, 1e-6, 0], [0, 1e-5, 0], [0, 0, 1e-5]], "symmetric positive definite"),
    ("rotors", 4, "a table [rotors]"),
    ("rotors.inertia", 1.0, "a smaller inertia than the whole drone"),
    ("rotors.inertia", -1e-8, ""),
    ("rotors.thrust_curve", [0, 0, 0], "thrust_curve with a positive quadratic"),
    ("rotors.thrust_curve", [0.2, 0, -1e-10], "thrust_curve with a positive"),
    ("rotors.thrust_curve", [0.1, 0, 4e-10], "rises from thrust_min to thrust_max"),
    ("rotors.thrust_curve", [0, 0, 1e-28], "between 0 and 1e+06 rpm"),
    ("rotors.thrust_curve", MISSING, "got 'first_principles'"),
    ("rotors.torque_curve", [0, 0, -1e-12], "torque_curve that rises"),
    ("rotors.torque_curve", [-1, 0, 2e-12], "torque_curve of at least 0 N m"),
    ("rotors.lag", [-14, 0, 14, 0], ""),
    ("rotors.lag", [0, 0, 14, 0], "lag with a positive linear or quadratic term"),
    ("rotors.lag", [1e4, 0, 14, 0], "freq=6667"),
    ("rotors.yaw_torque_sign", [0.5, -1, 1, -1], "yaw_torque_sign as 1 or -1"),
    ("rotors.yaw_torque_sign", [1, 1, 1, 1], "not all equal"),
    ("rotors.yaw_torque_sign", [1, 1, -1, -1], "turn it about x, y and z"),
    ("rotors.position", [[0, 0, 0.1]] * 4, "beside the centre of mass"),
    ("rotors.position", ROW_OF_ROTORS, "turn it about x, y and z"),
    ("rotors.position", OFF_CENTRE, "level in hover"),
    ("rotors.position", [[1e9, 0, 0]] * 4, ""),
    ("rotors.position", [0.1, 0.1], "rotors.position of shape (n, 3)"),
    ("rotors.position", [[0.1, 0.1], [0.1]], ""),
    ("rotors.thrust_max", -0.1, ""),
    ("rotors.thrust_max", 0.01, "0 <= thrust_min < thrust_max"),
    ("drag.coefficients", [0.02, -0.02, -0.02], "drag.coefficients that brakes"),
    ("drag.coefficients", [-1e3] * 3, "slow for steps of 1/500 s"),
    ("drag", MISSING, "has no value 'drag.coefficients'"),
    ("fitted.so_rpy.rpy_coef", [150.0] * 3, ""),
    ("fitted.so_rpy.rpy_coef", -150.0, "of shape (3,)"),
    ("fitted.so_rpy.cmd_f_coef", 0.1, "fitted.so_rpy to lift"),
    ("fitted.so_rpy.thrust_dyn_coef", 16.0, "Did you mean 'fitted.so_rpy_rotor.thrust_dyn_coef'"),
    ("battery.thrust_over_voltage", [0, 0, 0, 0], "reach thrust_max at a positive"),
    ("controller.attitude.kR", [-1, 1, 1], ""),
    ("controller.attitude.kR", MISSING, "Use controller='auto'"),
    ("controller", MISSING, "[controller.attitude] kR, kw, ki_m, kd_omega, int_err_max; [controller] torque_pwm_max"),
    ("controller.pwm_min", 70000.0, "pwm_min below pwm_max"),
    ("shape.plate", [0.03, 0.0, 0.02], ""),
    ("shape.collision_sphere", [0, 0, 0, -1], "a positive radius"),
    ("shape.track_camera", [0, 0, 1], "behind or ahead of the drone"),
    ("shape.propellor_radius", 0.02, "Did you mean 'shape.propeller_radius'"),
    ("rigidbody", {"mass": 0.05}, "Did you mean [rigid_body]"),
    ("bse", "cf2x_L250", "Did you mean 'base'"),
    ("mass", 0.05, "Did you mean 'rigid_body.mass' or 'battery.mass'"),
    ("paint", {"colour": 3}, "a table that exists, got [paint]"),
]
"""Key of an airframe, its wrong value, and words of the error other than the key."""


@pytest.mark.parametrize(("path", "value", "words"), WRONG_AIRFRAMES)
def test_law_09_a_wrong_airframe_is_refused(path, value, words):
    tables = plain_tables("cf21B_500")
    *parents, key = path.split(".")
    node = functools.reduce(dict.__getitem__, parents, tables)
    node.pop(key) if value is MISSING else node.update({key: value})
    needs_gains = value is MISSING and path.startswith("controller")  # "auto" needs no gains
    with pytest.raises(ConfigError, match=re.escape(words or path)):
        Sim(drone=tables, controller="crazyflow" if needs_gains else "auto")


def test_moments_of_inertia_that_are_slightly_wrong_are_a_warning_with_the_figure():
    """RotorPy's Crazyflie, whose largest moment exceeds the sum of the others by 1%; 6% are an error."""

    def body(z):
        return {"base": "cf2x_L250", "rigid_body": {"mass": 0.03, "inertia": [1.43e-5, 1.43e-5, z]}}

    with pytest.warns(AirframeWarning, match=r"largest moment is at most the sum .* 1\.0% more\. Measure") as caught:
        assert Sim(drone=body(2.89e-5)).data.params.J[..., 2, 2] == np.float32(2.89e-5)
    assert caught[0].filename == __file__, "a warning points to the user's line"
    with pytest.raises(ConfigError, match="largest moment is at most the sum of the others"):
        load_airframe(body(3.04e-5))
    load_airframe(body(2.86e-5 * 1.000005))


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


@pytest.mark.parametrize("name", ["quad.urdf", "quad.XML"])
def test_law_09_a_model_of_bodies_gets_the_way_to_a_toml_file(tmp_path, name):
    path = tmp_path / name
    path.write_text('<?xml version="1.0"?>\n<robot name="quad"/>', encoding="utf-8")
    with pytest.raises(ConfigError, match="crazysim airframe new"):
        load_airframe(path)


def nested(depth):
    value = []
    for _ in range(depth):
        value = [value]
    return value


def test_law_09_files_that_are_no_text_or_too_deep_or_too_large_are_named(tmp_path):
    path = tmp_path / "mine.toml"
    for content, message in (
        (b"\xff\xfe[rotors]", "expected text in .*mine.toml, got bytes that are not UTF-8"),
        ("[rotors]".encode("utf-16-le"), "expected text in UTF-8 in .*mine.toml, got zero bytes, as in UTF-16"),
        (b"a = " + b"[" * 5000, "mine.toml is not valid TOML"),
        (b"a = " + b"{a=" * 5000, "mine.toml is not valid TOML"),
        (b"rotors." + b"a." * 5000 + b"a = 1", "expected a table that exists"),
        (b"rigid_body.mass." + b"a." * 5000 + b"a = 1", "expected rigid_body.mass as a number, an array or"),
        (
            b"rigid_body.mass.value." + b"a." * 5000 + b"a = 1",
            "expected rigid_body.mass as a number or array, got (a dict|{)",
        ),
        (b"a = 2026-02-31", "mine.toml is not valid TOML"),
        (b"#" * 2**21, "expected a file of at most 1048576 bytes"),
    ):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=message):
            load_airframe(path)
    with pytest.raises(ConfigError, match=r"rigid_body.mass as a number or array, got (a list|\[\[)"):
        load_airframe({"rigid_body": {"mass": nested(5000)}})
    for source in ("x" * 5000, "a\0b", tmp_path):
        with pytest.raises(ConfigError, match="no file of that path exists"):
            load_airframe(source)


def test_law_09_a_base_in_a_circle_is_named(tmp_path):
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    one.write_text(f'base = "{two}"\n', encoding="utf-8")
    two.write_text(f'base = "{one}"\n', encoding="utf-8")
    circle = {}
    circle["base"] = circle
    for source in (one, two, circle, {"base": str(one)}):
        with pytest.raises(ConfigError, match=r"expected a base that leads to a file without one, got .* -> "):
            load_airframe(source)


def test_law_09_an_unknown_key_is_answered_with_the_file(tmp_path):
    path, heir = tmp_path / "mine.toml", tmp_path / "heir.toml"
    path.write_text('base = "cf2x_L250"\n[rigid_body]\nmas = 0.05\n', encoding="utf-8")
    heir.write_text(f'base = "{path}"\n', encoding="utf-8")
    for source in (path, heir):
        with pytest.raises(ConfigError, match=r"airframe 'mine' in .*mine\.toml: .*got 'rigid_body.mas'"):
            load_airframe(source)


def test_the_page_lists_all_tables_and_keys_and_no_others():
    page = (Path(__file__).parents[2] / "docs/guides/airframe-keys.md").read_text(encoding="utf-8")
    section = page.split("## Keys")[1].split("## From a dict")[0]
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines() if re.match(r"\| (?!-)", line)
    ]
    result, table = set(), ""
    for row in (row for row in rows[1:] if len(row) != 2):  # the table with two columns explains names of models
        is_shape = len(row) == 3
        if not is_shape and row[0]:
            table = row[0].strip("`")
        keys = re.findall(r"`(\w+)`", row[0] if is_shape else row[1])
        result |= {f"shape.{key}" if is_shape else f"{table}.{key}".removeprefix(".") for key in keys}
    assert result == {*LAYOUT.keys, *LAYOUT.top_level}


def test_models_of_the_keys_are_those_of_the_dynamics():
    fits = {table.removeprefix("fitted.") for table in TABLES if table.startswith("fitted.")}
    assert fits == set(Dynamics) - {Dynamics.first_principles}


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
    with pytest.raises(ConfigError, match=r"has no value 'qqq'. docs/guides/airframe-keys.md lists"):
        airframe.value("qqq")
    with pytest.raises(ConfigError, match=r"has no table \[wings\], only \['battery', 'controller'"):
        airframe.table("wings")


def test_a_base_gives_the_numbers_that_are_not_given(tmp_path):
    """Numbers are replaced one by one, from dicts and files alike, and a base may have a base."""
    (tmp_path / "light.toml").write_text('base = "bumblebee_lab"\n[rotors]\nthrust_min = 0.5\n', encoding="utf-8")
    lab, light = load_airframe("bumblebee_lab"), load_airframe(tmp_path / "light.toml")
    named = load_airframe({"base": str(tmp_path / "light.toml"), "name": "named", "rotors": {"inertia": 1e-6}})
    changed = {"rotors.thrust_min": (0.5, 0.5), "rotors.inertia": (lab.value("rotors.inertia"), 1e-6)}
    assert (light.name, named.name) == ("light", "named")
    for path, value in iterate_numbers(lab.tables):
        for airframe, expected in zip((light, named), changed.get(path, (value, value)), strict=True):
            np.testing.assert_array_equal(airframe.value(path), expected)


@pytest.mark.parametrize(
    "changes",
    [
        {"rigid_body": {"mass": 0.04}},
        {"rigid_body": {"inertia": [2e-5, 2e-5, 3e-5]}},
        {"rotors": {"thrust_curve": [0.0, 0.0, 5e-10]}},
    ],
)
def test_another_body_inherits_no_gains(changes):
    """Gains and fits assume the body and rotors of the base; reading one from the derived airframe says so."""
    base, heir = load_airframe("cf2x_L250"), load_airframe({"base": "cf2x_L250", "name": "mine", **changes})
    changed = next(f"{table}.{key}" for table, keys in changes.items() for key in keys)
    message = rf"Its base 'cf2x_L250' has \[fitted\], \[controller\], \[mellinger\] and \[pid\], .* another {changed}"
    for read in (lambda: heir.value("controller.mass"), lambda: heir.table("pid.rate")):
        with pytest.raises(ConfigError, match=message):
            read()
    assert not {"fitted", "mellinger", "pid"} & set(heir.tables)
    ratios = [airframe.values.get("controller.thrust2torque") for airframe in (base, heir)]
    assert (ratios[1] is None) if "thrust_curve" in changed else ratios[0] == ratios[1]
    np.testing.assert_array_equal(heir.value("drag.coefficients"), base.value("drag.coefficients"))
    same = load_airframe({"base": "cf2x_L250", "rigid_body": {"mass": float(base.value("rigid_body.mass"))}})
    assert set(same.values) == set(base.values)
    with_gain = load_airframe({"base": "cf2x_L250", **changes, "controller": {"mass": 0.04}})
    assert float(with_gain.value("controller.mass")) == 0.04
    assert "controller.mass_thrust" not in with_gain.values


@pytest.mark.parametrize("name", supported_drones("first_principles"))
def test_figure_of_merit_at_hover(name):
    """Ideal over actual power of a rotor at hover, ``T^1.5 / sqrt(2 rho A) / (Q w)``, as the files state it.

    It is below 0.2 for the airframes whose ratio of torque to thrust is that of a preset of AIMotionLab or of CPC.
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
    text = (AIRFRAME_FOLDER / f"{name}.toml").read_text(encoding="utf-8")
    assert f"igure of merit {merit:.2f} at hover" in text or f"a figure of merit of {merit:.2f}," in text
    assert (merit < 0.2) == (name in ("crazyflie", "bumblebee_lab", "uzh_cpc"))


@pytest.mark.parametrize("name", ["cf21B_500", "cf2x_L250", "bumblebee", "hb_x500"])
def test_a_body_without_a_shape_is_about_as_large_as_the_real_one(name):
    """Lengths that are left out follow from mass and rotors: within a factor of 2.1, spheres of contact within 20%."""
    tables = plain_tables(name)
    given = body_shape(load_airframe(tables))
    derived = body_shape(load_airframe({k: v for k, v in tables.items() if k != "shape"}))
    assert set(derived) == set(TABLES["shape"])
    for key in ("plate", "battery", "arm_radius", "motor_radius", "propeller_radius"):
        ratio = (derived[key] / given[key]).ravel()[:2]  # not the thickness of the plate
        assert np.all((ratio > 1 / 2.1) & (ratio < 2.1)), (key, ratio)
    np.testing.assert_allclose(derived["collision_sphere"][3], given["collision_sphere"][3], rtol=0.2)
    assert {key: value.shape for key, value in derived.items()} == {k: v.shapes[0] for k, v in TABLES["shape"].items()}
    partly_derived = body_shape(load_airframe(tables | {"shape": {"propeller_radius": 0.02}}))
    assert partly_derived["propeller_radius"] == 0.02
    np.testing.assert_allclose(partly_derived["plate"], derived["plate"])


def test_a_drone_without_a_shape_steps_and_has_all_geoms():
    tables = plain_tables("cf21B_500")
    del tables["shape"]
    sim = Sim(drone=tables)
    sim.step(5)
    assert len(body_geoms(sim.airframe)) == len(body_geoms(load_airframe("cf21B_500")))
    assert sim.mj_model.geom("col_sphere:0").size[0] > 0.05


def test_full_thrust_voltage_is_that_of_the_firmwares_curves():
    """At this voltage, the firmware's cubic of thrust over voltage gives thrust_max (by ``numpy.roots``)."""
    expected = {"cf21B_500": 3.1257, "cf2x_P250": 3.0799, "cf2x_T350": 2.8166, "cf2x_L250": 2.9836, "crazyflie": 3.3482}
    for name, volts in expected.items():
        assert load_airframe(name).full_thrust_voltage == pytest.approx(volts, abs=1e-4)
    assert load_airframe("hb_x500").full_thrust_voltage is None
