"""The fitted models: equal to the fit in the range that was flown, bounded and continuous beyond."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FITTED_DYNAMICS, vectors
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazysim import load_airframe, rotation
from crazysim.dynamics import Dynamics, fitted

pytestmark = pytest.mark.usefixtures("x64")

model = jax.jit(fitted.dynamics)


def params(dynamics="so_rpy", name="cf21B_500"):
    return fitted.Params.create(load_airframe(name), Dynamics(dynamics))


def body_rates(rpy, rates):
    h = 1e-6
    ahead, behind = (Rotation.from_euler("ZYX", (rpy + s * h * rates)[::-1]) for s in (1, -1))
    return (behind.inv() * ahead).as_rotvec() / (2 * h)


def fit_ang_acc(rpy, rates, cmd, p):
    """Return the angular acceleration of rpy'' = a rpy + b rpy' + c cmd: how E(rpy) rpy' changes along that motion."""
    acc = np.asarray(p.rpy_coef * rpy + p.rpy_rates_coef * rates + p.cmd_rpy_coef * cmd)
    h = 1e-4
    ahead, behind = (body_rates(rpy + s * h * rates + h * h / 2 * acc, rates + s * h * acc) for s in (1, -1))
    return (ahead - behind) / (2 * h)


def model_ang_acc(rpy, rates, cmd, p):
    quat, still = Rotation.from_euler("ZYX", rpy[::-1]).as_quat(), np.zeros(3)
    command = np.concatenate([cmd, [0.4]])
    return model(still, quat, still, body_rates(rpy, rates), command, np.zeros(4), params=p)[2]


@given(
    rpy=st.tuples(st.floats(-3, 3), st.floats(-1.38, 1.38), st.floats(-3, 3)).map(np.array),
    rates=vectors(3, 3),
    cmd=vectors(3, 1.0),
)
def test_below_80_degrees_the_angles_obey_the_fit(rpy, rates, cmd):
    """Up to 1.38 rad, 79 degrees, of pitch. Differences of differences leave 1e-5 of 1e3 rad/s^2."""
    expected = fit_ang_acc(rpy, rates, cmd, params())
    np.testing.assert_allclose(model_ang_acc(rpy, rates, cmd, params()), expected, rtol=1e-4, atol=0.05)


@pytest.mark.parametrize("pitch", [-79.9, 79.9])
def test_the_fit_holds_up_to_80_degrees_of_pitch(pitch):
    rates = (1.0, -2.0, 1.5)
    rpy, cmd = np.array([0.5, np.deg2rad(pitch), -0.7]), np.array([0.1, 0.2, -0.3])
    expected = fit_ang_acc(rpy, np.array(rates), cmd, params())
    np.testing.assert_allclose(model_ang_acc(rpy, np.array(rates), cmd, params()), expected, rtol=1e-4, atol=0.05)


@pytest.mark.parametrize("cmd, rates", [(57.0, 0.0), (0.3, 50.0), (-57.0, -20.0)])
def test_up_to_100_rad_and_100_rad_a_second_the_fit_holds(cmd, rates):
    """Three equal numbers of 57 have a length of 98.7; three angles that change by 50 rad/s turn the body by 92.

    The finite differences have relative errors of 2e-4 here.
    """
    rpy, cmd, rates = np.array([0.5, -0.2, -0.7]), np.full(3, cmd), np.full(3, rates)
    expected = fit_ang_acc(rpy, rates, cmd, params())
    np.testing.assert_allclose(model_ang_acc(rpy, rates, cmd, params()), expected, rtol=3e-4, atol=0.05)


@pytest.mark.parametrize("varied_quantity", ["rate", "command"])
def test_beyond_the_fit_the_model_changes_to_spring_and_damper_without_a_jump(varied_quantity):
    """From 90 to 210 rad/s, or rad: half the step, half the largest change; at 200 it is the spring and damper."""
    changes, p = [], params()
    quat, direction = np.asarray(rotation.from_rpy(jnp.array([0.2, 0.9, 0.3]))), np.array([0.6, 0.0, 0.8])
    for n in (20_001, 40_001):
        varied = np.linspace(90, 210, n)[:, None] * direction
        rates = varied if varied_quantity == "rate" else np.zeros((n, 3))
        commands = np.concatenate(
            [varied if varied_quantity == "command" else np.zeros((n, 3)), np.full((n, 1), 0.4)], axis=-1
        )
        still = np.zeros((n, 3))
        ang_acc = model(still, np.tile(quat, (n, 1)), still, rates, commands, np.zeros((n, 4)), params=p)[2]
        changes.append(np.max(np.abs(np.diff(ang_acc, axis=0))))
    assert changes[1] == pytest.approx(changes[0] / 2, rel=0.05)
    error = Rotation.from_euler("ZYX", commands[-1, 2::-1]).inv() * Rotation.from_quat(quat)
    x, y, z, w = error.as_quat()
    expected = 2 * w * p.rpy_coef * np.array([x, y, z]) + p.rpy_rates_coef * rates[-1]
    np.testing.assert_allclose(ang_acc[-1], expected, rtol=1e-9)


@pytest.mark.parametrize("dynamics", FITTED_DYNAMICS)
def test_translation_by_hand(dynamics):
    """Nose down by 0.2 rad at 3 m/s along x, commanded thrust 0.5 N, thrust by now 0.3 N."""
    p = params(dynamics)
    quat = rotation.from_rpy(jnp.array([0.0, 0.2, 0.0]))
    vel = np.array([3.0, 0, 0])
    out = model(np.zeros(3), quat, vel, np.zeros(3), np.array([0, 0, 0, 0.5]), np.full(4, 0.3), params=p)
    lagged_thrust = 0.5 if dynamics == "so_rpy" else 0.3
    thrust = float(p.acc_coef[0] + p.cmd_f_coef[0] * lagged_thrust)
    force = thrust * np.array([np.sin(0.2), 0, np.cos(0.2)])
    if dynamics == "so_rpy_rotor_drag":
        along, across = np.array([np.cos(0.2), 0, -np.sin(0.2)]), np.array([np.sin(0.2), 0, np.cos(0.2)])
        coefficients = np.diag(p.drag_matrix)
        force += coefficients[0] * (along @ vel) * along + coefficients[2] * (across @ vel) * across
    np.testing.assert_allclose(out[1], force / 0.0434 + [0, 0, -9.81], atol=1e-12)
    rate = 0.0 if dynamics == "so_rpy" else float(p.thrust_dyn_coef[0]) * 0.2
    np.testing.assert_allclose(out[3], np.full(4, rate), atol=1e-12)


def test_external_wrench_acts_in_the_world_frame():
    """Yawed by 90 degrees to the left, body y along world -x: 1e-3 N m about world x is -1e-3 about body y."""
    p = params()
    half = np.sqrt(0.5)
    args = (np.zeros(3), np.array([0, 0, half, half]), np.zeros(3), np.zeros(3), np.array([0, 0, 0, 0.4]), np.zeros(4))
    free, pushed = model(*args, params=p), model(*args, np.array([0.0434, 0, 0]), np.array([1e-3, 0, 0]), params=p)
    np.testing.assert_allclose(pushed[1] - free[1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pushed[2] - free[2], [0, -1e-3 / 28e-6, 0], atol=1e-9)


def test_saturate_limits_the_thrust_only():
    p = params()
    low, high = float(p.thrust_min[0]), float(p.thrust_max[0])
    thrust = np.array([-1.0, 0.0, 1e-6, 0.3, 10.0])
    cmd = np.concatenate([np.full((5, 3), 9.0), thrust[:, None]], axis=-1)
    out = fitted.saturate(cmd, p)
    np.testing.assert_array_equal(out[:, :3], cmd[:, :3])
    np.testing.assert_allclose(out[:, 3], [0, 0, low, 0.3, high])


def attitudes_over_vertical(n, first=79.0, last=101.0):
    """Return attitudes that pitch over the vertical, with some roll and yaw, as quaternions. (n, 4)"""
    pitch = jnp.deg2rad(jnp.linspace(first, last, n))
    return rotation.from_rpy(jnp.stack([jnp.full(n, 0.2), pitch, jnp.full(n, 0.3)], axis=-1))


@pytest.mark.parametrize("sign", [1, -1])
def test_fault_04_angular_acceleration_is_continuous_and_bounded_over_90_degrees(sign):
    """Fault 4 of Crazyflow: NaN at 90 degrees of pitch. Half the step gives half the largest change, so no jump."""
    ang_vel, cmd = np.array([1.0, -2.0, 1.5]), np.array([0.1, 0.2, -0.3, 0.4])
    changes = []
    for n in (20_001, 40_001):
        quats = attitudes_over_vertical(n, 79.0 * sign, 101.0 * sign)
        still, rates, commands = np.zeros((n, 3)), np.tile(ang_vel, (n, 1)), np.tile(cmd, (n, 1))
        ang_acc = model(still, quats, still, rates, commands, np.zeros((n, 4)), params=params())[2]
        assert np.all(np.isfinite(ang_acc))
        # The fit itself has 196 and 259 rad/s^2 at 79 degrees, where 1/cos(pitch) is 5.
        assert np.max(np.abs(ang_acc)) < 1000
        changes.append(np.max(np.abs(np.diff(ang_acc, axis=0))))
    assert changes[0] < 0.5  # rad/s^2 in 0.001 degrees: 10 degrees of pitch take it through its whole range
    assert changes[1] == pytest.approx(changes[0] / 2, rel=0.05)


def test_law_07_gradients_are_finite_over_90_degrees():
    """Law 7, with the vertical itself, exactly and to either side of it, and where the model changes from the fit."""
    quats = attitudes_over_vertical(2001)
    half = np.sqrt(0.5)
    exact = np.array([[0, half, 0, half], [0, -half, 0, half], [0.5, 0.5, 0.5, 0.5], [-0.5, 0.5, 0.5, 0.5]])
    for dtype in (jnp.float64, jnp.float32):
        p = jax.tree.map(lambda x, d=dtype: x.astype(d), params("so_rpy_rotor_drag"))

        def sum_of_ang_acc(quat, ang_vel, cmd, p=p, dtype=dtype):
            zero = jnp.zeros(3, dtype)
            return jnp.sum(fitted.dynamics(zero, quat, zero, ang_vel, cmd, jnp.zeros(4, dtype), params=p)[2])

        gradient = jax.jit(jax.vmap(jax.grad(sum_of_ang_acc, argnums=(0, 1, 2)), (0, None, None)))
        attitudes = jnp.concatenate([quats, jnp.asarray(exact)]).astype(dtype)
        for values in gradient(attitudes, jnp.array([1.0, -2.0, 1.5], dtype), jnp.array([0.1, 0.2, -0.3, 0.4], dtype)):
            assert np.all(np.isfinite(values))
            assert np.max(np.abs(values)) < 1e6


def test_beyond_the_fit_the_drone_is_pulled_to_its_commanded_attitude():
    """At exactly 90 degrees, at rest: the spring turns the shortest way to level, about -y."""
    half = np.sqrt(0.5)
    quat = np.array([0, half, 0, half])
    ang_acc = model(
        np.zeros(3), quat, np.zeros(3), np.zeros(3), np.array([0, 0, 0, 0.4]), np.zeros(4), params=params()
    )[2]
    np.testing.assert_allclose(ang_acc, [0, float(params().rpy_coef[1]), 0], atol=1e-9)
