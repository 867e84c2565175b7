"""The complete first-principles model, compared with the same physics in NumPy, and at hover."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import unit_quats, vectors
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from crazysim import load_airframe
from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import quadratic_curve

pytestmark = pytest.mark.usefixtures("x64")

model = jax.jit(first_principles.dynamics)


quats = unit_quats()


def reference(quat, vel, ang_vel, cmd, rotor_vel, force, torque, airframe):
    a = airframe.value
    rotation = Rotation.from_quat(quat).as_matrix()
    total_force = np.array(force) + rotation @ np.diag(a("drag.coefficients")) @ rotation.T @ vel
    total_torque = rotation.T @ torque
    rotor_acc, momentum = [], np.zeros(3)
    for i in range(airframe.n_rotors):
        position, sign = a("rotors.position")[i], a("rotors.yaw_torque_sign")[i]
        thrust = np.polyval(a("rotors.thrust_curve")[::-1], rotor_vel[i])
        drag_torque = np.polyval(a("rotors.torque_curve")[::-1], rotor_vel[i])
        x, y = a("rotors.lag")[:2] if cmd[i] > rotor_vel[i] else a("rotors.lag")[2:]
        acc = x * (cmd[i] - rotor_vel[i]) + y * (cmd[i] ** 2 - rotor_vel[i] ** 2)
        rotor_acc.append(acc)
        total_force = total_force + rotation @ [0, 0, thrust]
        in_plane = np.array([position[0], position[1], 0.0])  # the height above the centre gives no torque to a z force
        total_torque = total_torque + np.cross(in_plane, [0, 0, thrust]) + [0, 0, sign * drag_torque]
        spin = -sign * a("rotors.inertia") * 2 * np.pi / 60
        momentum = momentum + [0, 0, spin * rotor_vel[i]]
        total_torque = total_torque - [0, 0, spin * acc]
    total_torque = total_torque - np.cross(ang_vel, momentum)
    acc = total_force / a("rigid_body.mass") + [0, 0, -9.81]
    inertia = airframe.inertia
    ang_acc = np.linalg.solve(inertia, total_torque - np.cross(ang_vel, inertia @ ang_vel))
    return vel, acc, ang_acc, np.array(rotor_acc)


@given(
    quat=quats,
    vel=vectors(3, 10),
    ang_vel=vectors(3, 15),
    cmd=arrays(np.float64, 4, elements=st.floats(0, 25e3)),
    rotor_vel=arrays(np.float64, 4, elements=st.floats(0, 25e3)),
    force=vectors(3, 1),
    torque=vectors(3, 1e-2),
)
@pytest.mark.parametrize("name", ["cf21B_500", "bumblebee"])
def test_derivatives_agree_with_the_same_physics_in_numpy(name, quat, vel, ang_vel, cmd, rotor_vel, force, torque):
    airframe = load_airframe(name)
    params = first_principles.Params.create(airframe)
    out = model(np.zeros(3), quat, vel, ang_vel, cmd, rotor_vel, force, torque, params=params)
    expected = reference(quat, vel, ang_vel, cmd, rotor_vel, force, torque, airframe)
    # Rounding of torques over an inertia of 2e-5 kg m^2, which magnifies it.
    for value, expected_value, atol in zip(out, expected, (0, 1e-11, 1e-8, 1e-8), strict=True):
        np.testing.assert_allclose(value, expected_value, rtol=1e-10, atol=atol)


@pytest.mark.parametrize(
    "name", ["cf2x_L250", "cf2x_P250", "cf2x_T350", "cf21B_500", "crazyflie", "bumblebee", "bumblebee_lab"]
)
def test_nothing_accelerates_at_hover(name):
    params = first_principles.Params.create(load_airframe(name))
    rotor_vel = first_principles.hover_rotor_vel(params)
    level = np.array([0, 0, 0.6, 0.8])
    vel, acc, ang_acc, rotor_acc = model(
        np.zeros(3), level, np.zeros(3), np.zeros(3), rotor_vel, rotor_vel, params=params
    )
    np.testing.assert_allclose(np.concatenate([vel, acc]), 0, atol=1e-12)
    np.testing.assert_allclose(rotor_acc, 0, atol=1e-9)  # rounding of terms of 1e5 rpm/s
    np.testing.assert_allclose(ang_acc, 0, atol=1e-9)  # torques cancel to 1e-17 N m, over 1e-5 kg m^2


@pytest.mark.parametrize("name", ["cf2x_L250", "cf21B_500", "crazyflie", "bumblebee"])
def test_limits_of_rotor_speed_give_the_limits_of_thrust(name):
    airframe = load_airframe(name)
    p = first_principles.Params.create(airframe)
    thrust_limits = quadratic_curve(jnp.stack([p.rotor_vel_min, p.rotor_vel_max]), p.rpm2thrust)[:, 0]
    expected = [airframe.value("rotors.thrust_min"), airframe.value("rotors.thrust_max")]
    np.testing.assert_allclose(thrust_limits, expected, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(p.J @ p.J_inv, np.eye(3), atol=1e-12)


def test_external_wrench_acts_in_the_world_frame():
    """A drone on its side, with body z along world x, by hand.

    q turns by 90 degrees about y: body x points along world -z, so a torque of 1e-3 N m about world z is -1e-3 about
    body x; J_x = 25e-6, so -40 rad/s^2. A force of m newton along world y accelerates by 1 m/s^2 along world y.
    """
    params = first_principles.Params.create(load_airframe("cf21B_500"))
    half = np.sqrt(0.5)
    still = np.zeros(4)
    _, acc, ang_acc, _ = model(
        np.zeros(3), np.array([0, half, 0, half]), np.zeros(3), np.zeros(3), still, still,
        np.array([0, 0.0434, 0]), np.array([0, 0, 1e-3]), params=params,
    )  # fmt: skip
    np.testing.assert_allclose(acc, [0, 1, -9.81], atol=1e-12)
    np.testing.assert_allclose(ang_acc, [-40, 0, 0], atol=1e-10)
