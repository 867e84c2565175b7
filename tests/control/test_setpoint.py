"""Setpoints and the state commands that are made of them."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazysim.control.setpoint import Setpoint

pytestmark = pytest.mark.usefixtures("x64")

SIZES = {"pos": 3, "vel": 3, "acc": 3, "jerk": 3, "snap": 3, "yaw": 1, "yaw_rate": 1, "yaw_acc": 1}


def random_setpoint(*batch):
    rng = np.random.default_rng(0)
    return Setpoint(**{name: rng.uniform(-3, 3, (*batch, n)) for name, n in SIZES.items()})


def test_a_command_has_the_fields_in_the_order_of_the_state_controller():
    s = random_setpoint()
    cmd = np.asarray(s.command())
    np.testing.assert_array_equal(cmd[:9], np.concatenate([s.pos, s.vel, s.acc]))
    np.testing.assert_allclose(cmd[9:13], Rotation.from_euler("z", s.yaw[0]).as_quat(), atol=1e-15)
    np.testing.assert_array_equal(cmd[13:], [0, 0, s.yaw_rate[0]])
    expected = np.concatenate([s.jerk, s.snap, s.yaw_rate, s.yaw_acc])
    np.testing.assert_array_equal(s.feedforward(), expected)


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_a_command_and_its_feedforward_give_the_setpoint_back(batch):
    s = random_setpoint(*batch)
    restored = Setpoint.of_command(s.command(), s.feedforward())
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-14), restored, s)


def test_a_command_without_feedforward_gives_the_yaw_rate_and_no_further_derivatives():
    s = random_setpoint(2)
    restored = Setpoint.of_command(s.command())
    np.testing.assert_array_equal(restored.yaw_rate, s.yaw_rate)
    for name in ("jerk", "snap", "yaw_acc"):
        np.testing.assert_array_equal(getattr(restored, name), np.zeros_like(getattr(s, name)))
