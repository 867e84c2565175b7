"""Vehicle models: built-in files, users' files, and wrong input."""

import tomllib

import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.errors import UnknownNameError
from crazysim.lab.vehicles.model import KEYS, VEHICLE_FOLDER
from crazysim.plugins.vehicles import CarParams, load_vehicle, vehicle_names


@pytest.mark.parametrize("name", vehicle_names())
def test_every_number_has_a_unit_and_a_source(name):
    tables = tomllib.loads((VEHICLE_FOLDER / f"{name}.toml").read_text())
    entries = {f"{t}.{k}": x for t, table in tables.items() if t not in ("sources", "base", "model", "name")
               for k, x in table.items()}  # fmt: skip
    assert entries
    assert set(entries) <= set(KEYS)
    for entry in entries.values():
        assert set(entry) == {"value", "unit", "source"}
        assert entry["source"] in tables["sources"]
    assert {entry["source"] for entry in entries.values()} <= set(tables["sources"])


def test_published_vehicles_have_their_parameters():
    assert {"aiml_apr24", "aiml_head", "f1tenth_ros", "bicycle"} <= set(vehicle_names())
    ros, head, apr = (load_vehicle(name) for name in ("f1tenth_ros", "aiml_head", "aiml_apr24"))
    assert [ros.number(f"rigid_body.{k}") for k in ("mass", "yaw_inertia")] == [2.923, 0.0796]
    assert ros.value("drive.force").tolist() == [41.796, 2.0152, 0.4328]
    assert head.value("drive.torque").tolist() == [52.4282, 5.2465, 1.119465]
    assert apr.value("drive.torque").tolist() == [65.0, 3.3, 1.05]
    assert "drive.torque" not in ros.numbers  # the base's drive is replaced as a whole
    for vehicle in (ros, head, apr):
        assert [vehicle.number(f"tyres.{k}") for k in ("front", "rear")] == [41.7372, 29.4662]


def test_parameters_by_hand():
    ros = CarParams.create(load_vehicle("f1tenth_ros"), 500)
    np.testing.assert_allclose(ros.drive, [83.592, 4.0304, 0.8656], rtol=1e-6)  # two axles
    np.testing.assert_allclose(ros.grip, 1.0489 * 9.81 * 2.923 * np.array([0.168, 0.163]) / 0.331, rtol=1e-6)
    assert float(ros.towed_mass[0]) == 0
    head = CarParams.create(load_vehicle("aiml_head"), 500, trailer=True)
    np.testing.assert_allclose(head.mass, 3.4)
    # Four wheels of 0.05 + 0.1 r^2 / 2 kg m^2 over r^2, and the trailer of 3.74 kg.
    np.testing.assert_allclose(head.towed_mass, 4 * (0.05 / 0.052388**2 + 0.05) + 3.74, rtol=1e-6)
    np.testing.assert_allclose(head.yaw_inertia, 0.08 + 0.0167, atol=5e-5)
    np.testing.assert_allclose(head.drive_max, 4 * 2.0 / 0.052388, rtol=1e-6)


def test_slow_physics_gets_a_larger_slip_speed():
    fast, slow = (float(CarParams.create(load_vehicle("f1tenth_ros"), freq).slip_speed[0]) for freq in (500, 50))
    assert fast == pytest.approx(0.1)
    assert slow == pytest.approx(71.2034 / 2.923 / 50, rel=0.02)


def test_a_file_and_a_dict_of_a_user(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('base = "f1tenth_ros"\n[rigid_body]\nmass = 4.0\n[tyres]\nfriction = { value = 0.5 }\n')
    mine, same = load_vehicle(path), load_vehicle({"base": "f1tenth_ros", "rigid_body": {"mass": 4.0}})
    assert mine.name == "mine"
    assert mine.number("tyres.friction") == 0.5
    assert mine.number("rigid_body.mass") == same.number("rigid_body.mass") == 4.0
    assert same.name == "custom"
    assert load_vehicle(mine) is mine


def test_unknown_names_and_broken_files_are_errors(tmp_path):
    with pytest.raises(UnknownNameError):
        load_vehicle("nothing.toml")
    path = tmp_path / "broken.toml"
    path.write_text("[rigid_body\n")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_vehicle(path)
    for content, message in ((b"\xff\xfe[", "not UTF-8"), (b"a = " + b"[" * 5000, "not valid TOML")):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=message):
            load_vehicle(path)
    path.write_text(f'base = "{path}"\n')
    with pytest.raises(ConfigError, match="expected a base that leads to a file without one"):
        load_vehicle(path)
    heavy = load_vehicle({"base": "aiml_head", "drive": {"torque": [52.0, 1e3, 1.0]}})
    with pytest.raises(ConfigError, match=r"expected damping of vehicle 'custom' to be slow .* Use freq=666 or more"):
        CarParams.create(heavy, 500)
