"""Parameters as dicts, under the names and with the shapes of Crazyflow 0.4.0."""

import numpy as np
import pytest

from crazysim.control import load_fn_params as load_control_fn_params
from crazysim.control import load_params as load_control_params
from crazysim.control import state2attitude
from crazysim.drones import load_airframe
from crazysim.dynamics import Dynamics, first_principles, fitted, load_fn_params, load_params, supported_dynamics
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.sim.sim import rotor_vel_limits

SHAPES = {
    "first_principles": {
        "L": (), "prop_inertia": (), "rpm2thrust": (3,), "rpm2torque": (3,), "rotor_dyn_coef": (4,),
        "mixing_matrix": (3, 4), "drag_matrix": (3, 3),
    },
    "so_rpy": {"acc_coef": (), "cmd_f_coef": (), "rpy_coef": (3,), "rpy_rates_coef": (3,), "cmd_rpy_coef": (3,)},
}  # fmt: skip
SHAPES["so_rpy_rotor"] = SHAPES["so_rpy"] | {"thrust_dyn_coef": ()}
SHAPES["so_rpy_rotor_drag"] = SHAPES["so_rpy_rotor"] | {"drag_matrix": (3, 3)}


def test_values_are_those_of_the_airframe_and_of_the_dynamics():
    params = load_params("first_principles", "cf2x_L250")
    assert float(params["mass"]) == 0.0328
    assert float(params["thrust_max"]) == 0.12
    np.testing.assert_allclose(params["J"] @ params["J_inv"], np.eye(3), atol=1e-12)
    record = first_principles.Params.create(load_airframe("cf2x_L250"))
    for name, value in load_fn_params(first_principles.dynamics, "cf2x_L250").items():
        np.testing.assert_allclose(np.squeeze(getattr(record, name)), np.squeeze(value), rtol=1e-6, err_msg=name)


def test_tables_of_the_controller():
    params = load_control_params("mellinger", "cf2x_L250")
    assert set(params) == {"core", "state2attitude", "attitude2force_torque", "body_rate2force_torque"}
    assert float(params["core"]["mass"]) == 0.029
    np.testing.assert_array_equal(params["attitude2force_torque"]["kR"], [70000, 70000, 60000])
    fn_params = load_control_fn_params(state2attitude, "cf2x_L250")
    assert float(fn_params["thrust_max"]) == 0.12
    np.testing.assert_array_equal(fn_params["kp"], [0.4, 0.4, 1.25])
    assert "rpm2thrust" not in load_control_params("mellinger", "hb_x500")["core"]


def test_law_09_wrong_names_are_refused():
    assert Dynamics.first_principles not in supported_dynamics("hb_x500")
    with pytest.raises(ConfigError, match="hb_x500"):
        load_params("first_principles", "hb_x500")
    with pytest.raises(UnknownNameError, match="got 'euler'"):
        load_params("euler", "cf2x_L250")
    with pytest.raises(UnknownNameError, match="got 'pid'"):
        load_control_params("pid", "cf2x_L250")
    with pytest.raises(ConfigError, match="shared by all fitted models"):
        load_fn_params(fitted.dynamics, "cf2x_L250")


def test_limits_of_the_rotors():
    low, high = rotor_vel_limits("first_principles", "cf2x_L250")
    k0, k1, k2 = load_params("first_principles", "cf2x_L250")["rpm2thrust"]
    np.testing.assert_allclose([k0 + k1 * w + k2 * w**2 for w in (low, high)], [0.012817578393, 0.12], rtol=1e-5)
    np.testing.assert_allclose(rotor_vel_limits("so_rpy", "cf2x_L250"), [4 * 0.012817578393, 0.48], rtol=1e-9)
