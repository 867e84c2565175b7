"""Order of convergence of the integrators, compared with motions in closed form, in float64."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazysim import Sim
from crazysim.core.data import SimStateDeriv
from crazysim.core.integration import INTEGRATORS, Integrator
from crazysim.core.stages import first_principles_derivative

DURATION = 0.5
"""Duration of every flight, s."""
STEPS = np.array([32, 64, 128])
"""Number of steps in this time, by drone."""


@pytest.fixture(scope="module")
def data():
    """Return one world of three drones, one for each number of steps, in float64."""
    with jax.enable_x64(True):
        return Sim(n_drones=len(STEPS), control="rotor_vel").data


@partial(jax.jit, static_argnames=("integrator", "deriv_fn"))
def fly(data, freq, n_steps, integrator, deriv_fn):
    """Return the states after a different number of steps of a different length for each drone.

    Rates are static in the record. Here they are an array, so that one compilation serves all of them.
    """

    def step(k, states):
        core = data.core.replace(freq=freq)
        new = INTEGRATORS[integrator](data.replace(states=states, core=core), deriv_fn).states
        return jax.tree.map(lambda a, b: jnp.where(k < n_steps, a, b), new, states)

    return jax.lax.fori_loop(0, jnp.max(n_steps), step, data.states)


def fly_all(data, integrator, deriv_fn=first_principles_derivative):
    n_steps = STEPS[None, :, None]
    return jax.device_get(fly(data, n_steps / DURATION, n_steps, Integrator(integrator), deriv_fn))


def convergence_order(errors):
    errors = np.asarray(errors)
    assert np.all(errors > 1e-14), f"rounding hides the order: {errors}"
    return np.polyfit(np.log(1 / STEPS), np.log(errors), 1)[0]


def prepare_data(data, params=None, **states):
    """Return the data with other states and parameters, without drag, thrust and torques that are not in ``params``."""
    new = {k: np.broadcast_to(np.asarray(v, float), getattr(data.states, k).shape) for k, v in states.items()}
    p = data.params
    params = {k: np.asarray(v, float) for k, v in (params or {}).items()}
    zero_params = {k: np.zeros_like(getattr(p, k)) for k in ("drag_matrix", "rpm2thrust", "rpm2torque")}
    return data.replace(states=data.states.replace(**new), params=p.replace(**(zero_params | params)))


def rotation_error(quat, exact):
    return [(Rotation.from_quat(np.asarray(q)) * exact.inv()).magnitude() for q in quat[0]]


@pytest.mark.parametrize("integrator", list(Integrator))
def test_law_08_order_of_position_and_velocity_under_drag(integrator, data, x64):
    """v' = -k v + g, with v(t) = g/k + (v0 - g/k) exp(-k t)."""
    k, g, v0 = 4.0, np.array([0, 0, -9.81]), np.array([3.0, -2.0, 5.0])
    mass = float(data.params.mass[0])
    start = prepare_data(data, {"drag_matrix": -k * mass * np.eye(3)}, pos=[0, 0, 10], vel=v0)
    states = fly_all(start, integrator)
    decay = np.exp(-k * DURATION)
    vel = g / k + (v0 - g / k) * decay
    pos = np.array([0, 0, 10]) + g / k * DURATION + (v0 - g / k) * (1 - decay) / k
    assert abs(convergence_order(np.linalg.norm(states.vel[0] - vel, axis=-1)) - integrator.order) < 0.2
    assert abs(convergence_order(np.linalg.norm(states.pos[0] - pos, axis=-1)) - integrator.order) < 0.2


@pytest.mark.parametrize("integrator", list(Integrator))
def test_law_08_order_of_attitude_with_an_axis_that_turns(integrator, data, x64):
    """A free body with J = diag(A, A, C): its attitude is the product of two turns at constant rates.

    exp(t L / A) q0 exp(t wz (1 - C/A) ez), L being the angular momentum in the world frame. Averaging body rates as
    if rotations commuted has only order 2, and so has a commutator of the wrong sign.
    """
    A, C, ang_vel = 2e-5, 5e-5, np.array([4.0, 3.0, 8.0])
    q0 = Rotation.from_euler("ZYX", [0.5, -0.4, 0.3])
    inertia = np.diag([A, A, C])
    params = {"J": inertia, "J_inv": np.linalg.inv(inertia)}
    states = fly_all(prepare_data(data, params, pos=[0, 0, 10], quat=q0.as_quat(), ang_vel=ang_vel), integrator)
    momentum = q0.apply(inertia @ ang_vel)
    body = Rotation.from_rotvec([0, 0, ang_vel[2] * (1 - C / A) * DURATION])
    exact = Rotation.from_rotvec(momentum / A * DURATION) * q0 * body
    assert abs(convergence_order(rotation_error(states.quat, exact)) - integrator.order) < 0.3
    transverse = body.inv().apply([4.0, 3.0, 0.0])
    expected_ang_vel = np.array([transverse[0], transverse[1], 8.0])
    assert (
        abs(convergence_order(np.linalg.norm(states.ang_vel[0] - expected_ang_vel, axis=-1)) - integrator.order) < 0.3
    )


def swaying_derivative(data):
    """Return a derivative whose body rate depends on the attitude, so that the middle stages of RK4 matter."""
    s = data.states
    ang_vel = jnp.stack([3 + 4 * s.quat[..., 1], 2 - 5 * s.quat[..., 0], 1 + 6 * s.quat[..., 3]], axis=-1)
    zero = jnp.zeros_like(s.vel)
    return SimStateDeriv(vel=zero, ang_vel=ang_vel, acc=zero, ang_acc=zero, rotor_acc=jnp.zeros_like(s.rotor_vel))


def test_law_08_rk4_has_order_4_where_rates_depend_on_the_attitude(data, x64):
    """The reference is q' = q w / 2, solved by SciPy to 1e-13; the result depends on the middle stages."""
    from scipy.integrate import solve_ivp

    def rate(_, q):
        x, y, z, w = q
        wx, wy, wz = 3 + 4 * y, 2 - 5 * x, 1 + 6 * w
        return 0.5 * np.array(
            [w * wx + y * wz - z * wy, w * wy + z * wx - x * wz, w * wz + x * wy - y * wx, -x * wx - y * wy - z * wz]
        )

    q0 = Rotation.from_euler("ZYX", [0.5, -0.4, 0.3]).as_quat()
    exact = solve_ivp(rate, (0, DURATION), q0, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    states = fly_all(prepare_data(data, quat=q0), "rk4", swaying_derivative)
    assert abs(convergence_order(rotation_error(states.quat, Rotation.from_quat(exact))) - 4) < 0.3


@pytest.mark.parametrize("integrator", list(Integrator))
def test_law_08_order_of_rotor_speed(integrator, data, x64):
    """Spin-up with a linear lag a: r(t) = c (1 - exp(-a t))."""
    lag = {"rotor_dyn_coef": [[8.0, 0.0, 8.0, 0.0]]}
    start = prepare_data(data, lag, pos=[0, 0, 10])
    start = start.replace(controls=start.controls.replace(rotor_vel=np.full((1, 3, 4), 1000.0)))
    errors = fly_all(start, integrator).rotor_vel[0, :, 0] - 1000 * (1 - np.exp(-8 * DURATION))
    assert abs(convergence_order(np.abs(errors)) - integrator.order) < 0.3


def test_symplectic_euler_moves_with_the_new_velocities_and_euler_with_the_old(data, x64):
    start = prepare_data(data, pos=[0, 0, 10], vel=[1, 0, 0], ang_vel=[0, 0, 1])
    start = start.replace(states=start.states.replace(force=np.full((1, 3, 3), 0.0434)))
    dt, deriv_fn = 1 / 500, first_principles_derivative
    integrate_both = jax.jit(
        lambda data: [INTEGRATORS[name](data, deriv_fn).states for name in ("euler", "symplectic_euler")]
    )
    old, new = jax.device_get(integrate_both(start))
    acc = np.array([1.0, 1.0, 1.0 - 9.81])
    np.testing.assert_allclose(old.pos[0, 0], [dt, 0, 10], rtol=1e-14)
    np.testing.assert_allclose(new.pos[0, 0], np.array([dt, 0, 10]) + dt * dt * acc, rtol=1e-14)
    np.testing.assert_array_equal(old.vel, new.vel)
