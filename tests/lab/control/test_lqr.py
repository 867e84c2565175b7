"""Linear quadratic regulators: gains of the literature, errors, limits of the weights, and flights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flights import figure_eight, fly, hover, make_sim, path_setpoint, rms_error, start_on_path
from scipy.spatial.transform import Rotation

from crazysim import load_airframe
from crazysim.control import Setpoint
from crazysim.errors import ConfigError
from crazysim.lab.control.linear_models import linearize, load_derivative
from crazysim.lab.control.load_lqr import LoadLQR, load_gain, load_lqr_control
from crazysim.lab.control.lqr import LQR, flat_reference, hover_gain, lqr_control, state_error
from crazysim.lab.control.tracking_lqr import (
    TrackingLQR,
    error_derivative,
    interpolate_gain,
    tracking_gains,
    tracking_lqr_control,
)

LAB_Q, LAB_R = [100] * 6 + [10] * 3 + [1] * 3, [50] * 4
LAB_LOAD_Q = [10, 10, 100, 1, 1, 10, 0.1, 0.1, 1, 0.4, 0.4, 0.4, 0.1, 0.1, 0.05, 0.05]
LAB_LOAD_R = [1, 80, 80, 80]
"""Diagonals of the weights of AIMotionLab-Virtual, without and with a load."""
GRAVITY = np.array([0, 0, -9.81])


def rounded(x):
    return [round(float(v), 4) for v in x]


# Gains ------------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
def test_gains_about_hover_equal_those_of_the_lab():
    gain = np.asarray(LQR(Q=LAB_Q, R=LAB_R).params(load_airframe("bumblebee_lab")).gain)
    assert rounded(gain[0, [2, 5]]) == [1.4142, 1.9264]
    assert rounded(gain[2, [0, 3, 7, 10]]) == [1.4142, 1.6341, 2.3243, 0.1635]
    assert rounded(gain[1, [1, 4, 6, 9]]) == [-1.4142, -1.6345, 2.3295, 0.1643]
    assert rounded(gain[3, [8, 11]]) == [0.4472, 0.1496]
    gain = np.asarray(LQR(Q=LAB_Q, R=LAB_R).params(load_airframe("crazyflie")).gain)
    assert rounded(gain[0, [2, 5]]) == [1.4142, 1.4419]
    assert rounded(gain[2, [0, 3, 7, 10]]) == [1.4142, 1.6202, 2.1684, 0.1416]
    assert rounded(gain[3, [8, 11]]) == [0.4472, 0.1415]


@pytest.mark.usefixtures("x64")
def test_gains_with_a_load_equal_those_of_the_lab():
    """The gains are those that AIMotionLab-Virtual computes for 0.05 kg on a rod of 0.4 m, at 100 Hz."""
    params = LoadLQR(100, Q=LAB_LOAD_Q, R=LAB_LOAD_R).params(load_airframe("bumblebee"))
    gain = np.asarray(params.gain)
    assert rounded(gain[0, [2, 5]]) == [9.6398, 4.7304]
    assert rounded(gain[1, [1, 4, 6, 9, 12, 14]]) == [-0.2667, -0.2000, 0.6085, 0.0705, -0.0137, 0.0184]
    assert rounded(gain[2, [0, 3, 7, 10, 13, 15]]) == [0.2646, 0.1982, 0.6021, 0.0695, -0.0131, 0.0183]
    assert rounded(gain[3, [8, 11]]) == [0.0972, 0.0660]

    def model(x, u):
        args = (params.mass, params.J, params.gravity_vec, params.load_mass, params.length)
        return load_derivative(x, u, *args)

    A, B = jax.jit(lambda x, u: linearize(model, x, u))(np.zeros(16), np.array([0.655 * 9.81, 0, 0, 0]))
    closed_loop = np.eye(16) + 0.01 * A - 0.01 * B @ gain
    assert round(float(np.abs(np.linalg.eigvals(closed_loop)).max()), 5) == 0.99168


def zero_setpoint():
    return Setpoint(*[np.zeros(3)] * 5, *[np.zeros(1)] * 3)


def test_setpoints_of_a_trajectory_are_finite():
    setpoints = jax.tree.map(lambda x: np.zeros((4, *x.shape)), zero_setpoint())
    setpoints = setpoints.replace(jerk=np.full((4, 3), np.nan), yaw=np.full((4, 1), np.inf))
    with pytest.raises(ConfigError, match=r"expected finite setpoints, got NaN or infinity in jerk, yaw\. Evaluate"):
        TrackingLQR(setpoints=setpoints, dt=0.1).params(load_airframe("bumblebee"))


# Along a trajectory -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def knots():
    """Return setpoints along a figure eight, every 0.1 s."""
    times = np.arange(50) * 0.1
    return jax.jit(jax.vmap(lambda t: path_setpoint(figure_eight, t)))(times)


@pytest.mark.usefixtures("x64")
def test_error_dynamics_agree_with_flights(knots):
    """Derivatives equal differences of errors after 1e-5 s of flight of a reference drone and a disturbed one."""
    p = jax.tree.map(np.asarray, LQR().params(load_airframe("bumblebee")))
    sp = jax.tree.map(lambda x: np.asarray(x, np.float64)[7], knots)
    sp = sp.replace(yaw_rate=np.array([0.7]), yaw_acc=np.array([-0.4]))
    reference = jax.tree.map(np.asarray, jax.jit(flat_reference)(sp, p))
    w = reference.ang_vel
    ang_acc = np.linalg.solve(p.J, reference.wrench[1:] - np.cross(w, p.J @ w))
    size, h = 1e-5, 1e-5
    rng = np.random.default_rng(4)
    error, extra_wrench = size * rng.normal(size=12), size * rng.normal(size=4)
    slope = jax.jit(error_derivative)(error, extra_wrench, reference, ang_acc, p.mass, p.J)

    def advance(matrix, ang_vel, vel, pos, wrench):
        turned = matrix @ Rotation.from_rotvec(h * np.array(ang_vel)).as_matrix()
        rate = np.linalg.solve(p.J, wrench[1:] - np.cross(ang_vel, p.J @ ang_vel))
        return turned, ang_vel + h * rate, vel + h * (wrench[0] * matrix[:, 2] / p.mass + GRAVITY), pos + h * vel

    target = np.array(reference.matrix)
    matrix = target @ Rotation.from_rotvec(np.array(error[6:9])).as_matrix()
    ang_vel = error[9:] + matrix.T @ target @ w
    after = advance(
        matrix, ang_vel, reference.vel + error[3:6], reference.pos + error[:3], reference.wrench + extra_wrench
    )
    later = advance(target, np.asarray(w), reference.vel, reference.pos, reference.wrench)
    moved = reference._replace(pos=later[3], vel=later[2], matrix=later[0], ang_vel=later[1])
    quat = Rotation.from_matrix(np.array(after[0])).as_quat()
    result = jax.jit(state_error)(after[3], quat, after[2], after[1], moved)
    np.testing.assert_allclose((result - error) / h / size, slope / size, atol=2e-2)


@pytest.mark.usefixtures("x64")
def test_gains_along_a_hover_equal_the_gain_for_hover():
    p = LQR().params(load_airframe("bumblebee"))
    still = jax.jit(jax.vmap(lambda t: path_setpoint(hover, t)))(np.arange(4) * 0.1)
    Q, R = np.diag(LAB_Q).astype(float), np.diag(LAB_R).astype(float)
    gains = jax.jit(tracking_gains, static_argnames="n_steps")(
        still, 0.1, np.asarray(p.mass), np.asarray(p.J), np.zeros((3, 3)), Q, R, n_steps=2000
    )
    expected = jax.jit(hover_gain)(np.asarray(p.mass), np.asarray(p.J), Q, R)
    np.testing.assert_allclose(gains[0], expected, atol=5e-3 * np.abs(expected).max())


def test_the_table_is_interpolated_and_held():
    gains = np.arange(3.0)[:, None, None] * np.ones((4, 12))
    for time, expected in ((-1, 0), (0.05, 0.5), (0.1, 1), (0.17, 1.7), (9, 2)):
        np.testing.assert_allclose(jax.jit(interpolate_gain)(np.float32(time), gains, 0.1), expected, rtol=1e-6)


# Flights ----------------------------------------------------------------------------------------------------------


def state_of(data):
    s = data.states
    return s.pos[0, 0], s.quat[0, 0], s.vel[0, 0], s.ang_vel[0, 0]


@pytest.mark.parametrize(("drone", "bound"), [("cf21B_500", 0.04), ("bumblebee", 0.01)])
def test_a_figure_eight_is_tracked(drone, bound, knots):
    """The figure eight is 2 m wide, at up to 2 m/s. Gains are those for hover, then those along the trajectory."""
    sim = make_sim(drone)
    p = LQR().params(load_airframe(drone))
    start_on_path(sim, figure_eight)
    states, setpoints, _, _ = fly(sim, lambda d, sp, m: (lqr_control(*state_of(d), sp, params=p), m), figure_eight, 4.8)
    assert rms_error(states, setpoints) < bound

    tracking_params = TrackingLQR(setpoints=knots, dt=0.1).params(load_airframe(drone))
    assert np.ptp(np.asarray(tracking_params.gains), axis=0).max() > 0.01 * np.abs(tracking_params.gains).max()

    def law(data, sp, tick):
        return tracking_lqr_control(*state_of(data), sp, tick / 500, params=tracking_params), tick + 1

    sim.reset()
    start_on_path(sim, figure_eight)
    states, setpoints, _, _ = fly(sim, law, figure_eight, 4.8, jnp.float32(0))
    assert rms_error(states, setpoints) < bound


def test_heading_turns_the_gain():
    p = LQR().params(load_airframe("bumblebee"))
    for yaw in (0.0, 1.0, -2.5):
        nose = np.float32([np.cos(yaw), np.sin(yaw), 0.0])
        zero, none = np.zeros(3, np.float32), np.zeros(1, np.float32)
        sp = Setpoint(nose, zero, zero, zero, zero, np.float32([yaw]), none, none)
        quat = np.float32(Rotation.from_euler("z", yaw).as_quat())
        wrench = np.asarray(jax.jit(lqr_control)(zero, quat, zero, zero, sp, params=p))
        assert wrench[2] > 1e-3
        np.testing.assert_allclose(wrench[[1, 3]], 0, atol=1e-6)


@pytest.mark.usefixtures("x64")
def test_the_gain_with_a_load_without_mass_is_that_of_the_drone():
    """The rod has no weights, so it has no influence."""
    J, mass, none = np.diag([1.5e-3, 1.45e-3, 2.66e-3]), np.array([0.605]), np.zeros(1)
    Q = np.diag([*LAB_Q, 1e-9, 1e-9, 1e-9, 1e-9])
    gain = jax.jit(load_gain)(mass, J, none, np.array([0.4]), 1e-4, 1e-4 * Q, 1e-4 * np.diag(LAB_R).astype(float))
    expected = jax.jit(hover_gain)(mass, J, np.diag(LAB_Q) * 1.0, np.diag(LAB_R) * 1.0)
    np.testing.assert_allclose(gain[:, :12], expected, atol=0.02)


def test_at_rest_at_the_setpoint_the_thrust_carries_drone_and_load():
    p = LoadLQR(load_mass=0.1).params(load_airframe("bumblebee"))
    zero, down, none = np.zeros(3, np.float32), np.float32([0, 0, -1.0]), np.zeros(1, np.float32)
    sp = Setpoint(zero, zero, zero, zero, zero, none, none, none)
    state = (zero, np.float32([0, 0, 0, 1.0]), zero, zero, down, zero)
    control = jax.jit(load_lqr_control, static_argnames="target")
    wrench = control(*state, sp, params=p, target="drone")
    np.testing.assert_allclose(wrench, [0.705 * 9.81, 0, 0, 0], rtol=1e-6)
    above = (np.float32([0, 0, 0.4]), *state[1:])
    np.testing.assert_allclose(control(*above, sp, params=p), [0.705 * 9.81, 0, 0, 0], rtol=1e-6)
