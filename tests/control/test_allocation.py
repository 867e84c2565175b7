"""The allocation: from a wrench to rotor speeds, and the way back through the dynamics."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from crazysim import load_airframe
from crazysim.control import AllocationParams, force_torque2rotor_vel
from crazysim.dynamics.rotor import quadratic_curve

pytestmark = pytest.mark.usefixtures("x64")

allocate = jax.jit(force_torque2rotor_vel)


def setup(name="cf21B_500"):
    airframe = load_airframe(name)
    return airframe, AllocationParams.create(airframe)


@given(thrusts=arrays(np.float64, 4, elements=st.floats(0.03, 0.19)))
@pytest.mark.parametrize("name", ["cf21B_500", "crazyflie"])
def test_a_wrench_within_the_limits_is_given_exactly(name, thrusts):
    airframe, params = setup(name)
    thrusts = thrusts * airframe.value("rotors.thrust_max") / 0.2
    arms = [airframe.arm, airframe.arm, airframe.value("controller.thrust2torque")]
    torque = arms * (airframe.mixing_matrix @ thrusts)
    rotor_vel = allocate(np.array([np.sum(thrusts), *torque]), params=params)
    np.testing.assert_allclose(quadratic_curve(rotor_vel, params.rpm2thrust), thrusts, rtol=1e-9)


@given(cmd=arrays(np.float64, 4, elements=st.floats(-1, 1, allow_subnormal=False)))
def test_law_09_every_rotor_stays_within_its_limits_or_stops(cmd):
    _, params = setup()
    thrusts = quadratic_curve(allocate(cmd, params=params), params.rpm2thrust)
    if cmd[0] <= 0:
        np.testing.assert_array_equal(thrusts, np.zeros(4))
    else:
        assert np.all(thrusts >= params.thrust_min[0] - 1e-12)
        assert np.all(thrusts <= params.thrust_max[0] + 1e-12)
