"""Airframes that are estimated from a few numbers."""

import tomllib

import numpy as np
import pytest

from crazysim import ConfigError, Sim
from crazysim.control.bandwidth import rotor_rate
from crazysim.drones import estimate_airframe, load_airframe
from crazysim.dynamics import supported_dynamics

QUAD = {"mass": 1.2, "propeller": 0.127, "arm": 0.12, "thrust_to_weight": 4.0}
SMALL = {"mass": 0.25, "propeller": 0.0762, "arm": 0.07, "thrust_to_weight": 4.0}
HEXA = {"mass": 4.0, "propeller": 0.33, "arm": 0.36, "n_rotors": 6, "thrust_to_weight": 2.4}
"""Numbers of a quadrotor, a small one, and a hexacopter, as ``estimate_airframe`` takes them."""
TABLE = {"throttle": [30, 60, 100], "thrust_g": [200, 600, 1200], "rpm": [10e3, 17.3e3, 24.5e3]}
"""Measurements of a motor with its propeller."""


def load(**numbers):
    return load_airframe(tomllib.loads(estimate_airframe(**numbers)))


@pytest.mark.parametrize("numbers", [QUAD, SMALL, HEXA], ids=["quad", "small", "hexa"])
def test_an_estimated_airframe_hovers(numbers):
    """The default controller needs no gains."""
    airframe = load(**numbers)
    assert supported_dynamics(airframe) == ("first_principles",)
    sim = Sim(drone=airframe, control="state", controller="auto")
    sim.state_control(pos=[0.0, 0, 1.0])
    sim.step(6 * sim.freq)
    np.testing.assert_allclose(sim.data.states.pos[0, 0], [0, 0, 1], atol=0.01)


def test_every_number_has_a_source_that_is_described():
    tables = tomllib.loads(estimate_airframe(**QUAD))
    sources = tables.pop("sources")
    entries = [entry for name, table in tables.items() if name != "name" for entry in table.values()]
    assert {entry["source"] for entry in entries} == set(sources)
    assert all(entry["unit"] for entry in entries)
    assert not any("{" in text for text in sources.values())
    estimates = [key for key, text in sources.items() if text.startswith("estimate: ")]
    assert {"inertia", "thrust_curve", "torque_curve", "lag", "drag", "resistance"} <= set(estimates)


def test_a_quadrotor_is_that_of_the_built_in_airframes():
    """Order and signs of the rotors: clockwise from ahead-right, which turns counter-clockwise."""
    estimated, built_in = load(**QUAD), load_airframe("cf21B_500")
    np.testing.assert_array_equal(estimated.mixing_matrix, built_in.mixing_matrix)
    assert load(**QUAD | {"layout": "+"}).value("rotors.position")[0].tolist() == [0.12, 0, 0]
    assert load(**HEXA).n_rotors == 6


@pytest.mark.parametrize(
    ("name", "propeller", "pitch"), [("cf21B_500", 0.055, 0.035), ("bumblebee", 0.127, None), ("hb_x500", 0.254, 0.114)]
)
def test_estimates_are_near_the_numbers_of_built_in_airframes(name, propeller, pitch):
    """Inertias within 45%, thrust at a speed and torque over thrust within 35%, of the built-in airframes."""
    built_in = load_airframe(name)
    mass = float(built_in.value("rigid_body.mass"))
    total_thrust = float(np.sum(np.broadcast_to(built_in.value("rotors.thrust_max"), built_in.n_rotors)))
    estimated = load(
        mass=mass,
        propeller=propeller,
        positions=built_in.value("rotors.position")[:, :2],
        spins=-built_in.value("rotors.yaw_torque_sign"),
        thrust_to_weight=total_thrust / mass / 9.81,
        pitch=pitch,
    )
    np.testing.assert_allclose(np.diag(estimated.inertia) / np.diag(built_in.inertia), 1, atol=0.45)
    np.testing.assert_allclose(estimated.value("rotors.thrust_max"), built_in.value("rotors.thrust_max"), rtol=1e-5)
    if "rotors.thrust_curve" not in built_in.values:
        return
    speed = built_in.rotor_vel_limits.max()
    thrusts, torques = (
        [float(np.polyval(a.value(f"rotors.{key}_curve")[::-1], speed)) for a in (estimated, built_in)]
        for key in ("thrust", "torque")
    )
    np.testing.assert_allclose(thrusts[0] / thrusts[1], 1, atol=0.35)
    np.testing.assert_allclose(torques[0] / thrusts[0] / (torques[1] / thrusts[1]), 1, atol=0.35)


def test_a_motor_table_gives_thrust_and_curves(tmp_path):
    path = tmp_path / "motor.csv"
    path.write_text(
        "# 2306, 5 inch\n" + "\n".join(",".join(map(str, row)) for row in [TABLE, *zip(*TABLE.values(), strict=True)]),
        encoding="utf-8",
    )
    numbers = {key: value for key, value in QUAD.items() if key != "thrust_to_weight"}
    from_file, from_dict = load(**numbers, motor_table=path), load(**numbers, motor_table=TABLE)
    np.testing.assert_allclose(from_file.value("rotors.thrust_max"), 1.2 * 9.81, rtol=1e-5)
    k = from_file.value("rotors.thrust_curve")[2]
    np.testing.assert_allclose(k, from_dict.value("rotors.thrust_curve")[2])
    np.testing.assert_allclose(k * np.square(TABLE["rpm"]), np.array(TABLE["thrust_g"]) * 9.81e-3, rtol=0.03)
    torque = np.array([2, 4, 8]) * 1e-10 * np.square(TABLE["rpm"]) * [2, 1, 0.5]
    measured = load(**numbers, motor_table=TABLE | {"torque_nm": torque})
    np.testing.assert_allclose(measured.value("rotors.torque_curve")[2], 4e-10, rtol=1e-5)
    power = 4e-10 * np.square(TABLE["rpm"]) * np.array(TABLE["rpm"]) * 2 * np.pi / 60 / 0.75
    electric = load(**numbers, motor_table=TABLE | {"power_w": power})
    np.testing.assert_allclose(electric.value("rotors.torque_curve")[2], 4e-10, rtol=1e-5)


def test_given_numbers_replace_estimates():
    estimated = load(**QUAD, inertia=[4e-3, 5e-3, 8e-3], time_constant=0.03, cells=6, capacity=1.3, resistance=0.04)
    np.testing.assert_allclose(estimated.value("rigid_body.inertia"), [4e-3, 5e-3, 8e-3])
    assert rotor_rate(estimated) == pytest.approx(1 / 0.03, rel=1e-5)
    assert [float(estimated.value(f"battery.{key}")) for key in ("cells", "capacity", "resistance")] == [6, 1.3, 0.04]


NO_RATIO = {"thrust_to_weight": None}
WRONG_NUMBERS = [
    ({"mass": 0.0}, "mass"),
    ({"mass": 1200.0}, "mass in kg and lengths in m"),
    ({"arm": None}, "either arm, .* or positions"),
    ({"arm": 0.08}, "propellers that do not touch"),
    ({"arm": 120.0}, "mass in kg and lengths in m"),
    ({"arm": None, "positions": [[0.1, 0.1, 0]]}, "at least 3 rotors"),
    ({"arm": None, "positions": [[0.2, 0], [-0.2, 0.2], [-0.2, -0.2]]}, "spins for 3 rotors"),
    ({"propeller": 5.0}, r"5 inches are 0\.127 m"),
    ({"n_rotors": 5}, "an even number of rotors"),
    ({"n_rotors": 100_000}, "from 4 to 64"),
    ({"layout": "h"}, "layout"),
    ({"spins": [1, 1, 1, 1]}, "spins"),
    (NO_RATIO, "either thrust_to_weight or motor_table"),
    ({"motor_table": TABLE}, "either thrust_to_weight or motor_table"),
    (NO_RATIO | {"motor_table": "nowhere.csv"}, "existing CSV file"),
    (NO_RATIO | {"motor_table": {"force": [1]}}, "got 'force'"),
    (NO_RATIO | {"motor_table": {"rpm": [1e4]}}, "thrust_n or thrust_g"),
    (NO_RATIO | {"motor_table": TABLE | {"rpm": [1, 2]}}, "columns of equal lengths"),
    (NO_RATIO | {"motor_table": {"thrust_g": ["much"]}}, "column 'thrust_g'"),
    (NO_RATIO | {"motor_table": TABLE | {"rpm": [10e3, 24.5e3, 17.3e3]}}, "thrust grows with the speed"),
    (NO_RATIO | {"motor_table": TABLE | {"torque_nm": [0.1, 0.3, 0.1]}}, "torque grows with the speed"),
    (NO_RATIO | {"motor_table": TABLE | {"thrust_n": [2.0, 60.0, 11.8]}}, "agree on the thrust"),
    ({"thrust_to_weight": 0.9}, "rotors that lift 1.2 kg"),
]


@pytest.mark.parametrize(("change", "words"), WRONG_NUMBERS)
def test_law_09_wrong_numbers_are_refused(change, words):
    with pytest.raises(ConfigError, match=words):
        load(**QUAD | change)
