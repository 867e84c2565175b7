"""Wind: drag relative to the air, by hand; gusts in many worlds against the formulas of Dryden."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import with_states

from crazysim import Sim, Wind
from crazysim.plugins.effects import wind

SQRT_HALF = np.sqrt(0.5)
DT = 1 / 500


def build(velocity=(0.0, 0.0, 0.0), n_worlds=2, n_drones=2, **kwargs):
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="rotor_vel", rng_key=3, engine="interpret")
    sim.data = with_states(sim.data, pos=[0, 0, 10.0])
    sim.build_default_data()
    sim.add(Wind(velocity, **kwargs))
    return sim


@pytest.fixture(scope="module")
def steady_wind_sim():
    """Return four drones in winds of 3 m/s along x, y and z, and in calm air; nose up, so that body z lies along x."""
    sim = build(np.array([[[3, 0, 0], [0, 3, 0]], [[0, 0, 3], [0, 0, 0.0]]]))
    sim.data = with_states(sim.data, quat=[0, SQRT_HALF, 0, SQRT_HALF])
    return sim


def test_a_steady_wind_pushes_with_the_drag_by_hand(steady_wind_sim):
    """At rest with still rotors: v = dt (-R D R^T w / m + g), D = -(21.64, 21.64, 24.77) mN s/m, m = 43.4 g."""
    sim = steady_wind_sim
    sim.data = with_states(sim.data, vel=0.0)
    before = sim.data
    sim.step()
    push = np.array([[[0.02477138502714662 * 3, 0, 0], [0, 0.021643637770852733 * 3, 0]],
                     [[0, 0, 0.021643637770852733 * 3], [0, 0, 0]]])  # fmt: skip
    expected = DT * (push / 0.0434 + [0, 0, -9.81])
    np.testing.assert_allclose(sim.data.states.vel, expected, rtol=2e-6, atol=1e-8)  # float32
    np.testing.assert_array_equal(sim.data.states.force, before.states.force)
    sim.data = before


N, LAGS = 32768, (0, 8, 20, 40)
"""Number of worlds, and lags of the samples of their gusts, steps."""
WIND = np.array([12.0, 16.0, 0.0])


@pytest.fixture(scope="module")
def samples():
    """Return gusts in wind axes at steps 1 + LAGS of many worlds, 30 m above ground in 20 m/s, at 20 steps/s."""
    sim = Sim(n_worlds=N, control="rotor_vel", freq=20)
    sim.data = with_states(sim.data, pos=[0, 0, 30.48])
    sim.add(Wind(WIND, 10.0))

    @jax.jit
    def run(data):
        def step(data, _):
            data = sim.step_pipeline["wind"](data)
            return sim.step_pipeline["increment_steps"](data), data.plugins["wind"].gust[:, 0]

        return jax.lax.scan(step, data, length=LAGS[-1] + 1)[1]

    x = np.asarray(run(sim.data), np.float64)[list(LAGS)]
    return np.stack([0.6 * x[..., 0] + 0.8 * x[..., 1], -0.8 * x[..., 0] + 0.6 * x[..., 1], x[..., 2]], axis=-1)


def test_gusts_have_the_variance_of_the_specification_from_the_first_step_on(samples):
    """At 100 ft: sigma_w = 0.1 W_20 and sigma_u = sigma_v = sigma_w / 0.2593^0.4, every component by itself."""
    sigma = np.array([1.0 / 0.2593**0.4, 1.0 / 0.2593**0.4, 1.0])
    # a variance from N independent worlds is known to sqrt(2 / N), a mean to 1 / sqrt(N): four of these
    np.testing.assert_allclose(np.mean(samples**2, axis=1), np.broadcast_to(sigma**2, (4, 3)), rtol=4 * np.sqrt(2 / N))
    np.testing.assert_allclose(np.mean(samples, axis=1) / sigma, 0.0, atol=4 / np.sqrt(N))
    correlation = np.corrcoef(samples[-1].T)
    np.testing.assert_allclose(correlation, np.eye(3), atol=4 / np.sqrt(N))


def test_gusts_have_the_correlation_in_time_of_dryden(samples):
    """R_u = exp(-x), R_v = R_w = exp(-x) (1 - x / 2) with x = V t / L: the transforms of the two spectra."""
    airspeed = np.sqrt(20.0**2 + 1)
    length = np.array([30.48 / 0.2593**1.2, 30.48 / 0.2593**1.2, 30.48])
    for i, lag in enumerate(LAGS):
        x = airspeed * lag / 20 / length
        expected = np.exp(-x) * np.array([1, 1 - x[1] / 2, 1 - x[2] / 2])
        result = np.mean(samples[0] * samples[i], axis=0) / np.mean(samples[0] ** 2, axis=0)
        # four standard errors of a correlation of N pairs; the trapezoidal rule's step of 0.033 adds less than 3e-4
        np.testing.assert_allclose(result, expected, atol=4 / np.sqrt(N))
    assert np.exp(-x[2]) - expected[2] > 3 * 4 / np.sqrt(N), "a filter of first order would fail"


def test_uneven_steps_keep_the_variance(rng):
    """P = F P F^T + Q for every loss: the covariance ((1, 1/2), (1/2, 1/2)) stays exactly the same."""
    with jax.enable_x64(True):

        @jax.jit
        @jax.jacobian
        def jacobian(x, loss):
            first, second, noise = jnp.stack([x[0]] * 3), jnp.stack([x[1]] * 2), jnp.stack([x[2]] * 3)
            out = wind.shape_noise(first, second, noise, jnp.full(3, loss))
            return jnp.stack([out[1], out[3]])

        for loss in (1e-6, 0.1, 0.7, 1.0):
            F = np.asarray(jacobian(np.zeros(3), loss))
            P = np.array([[1, 0.5], [0.5, 0.5]])
            np.testing.assert_allclose(F[:, :2] @ P @ F[:, :2].T + np.outer(F[:, 2], F[:, 2]), P, atol=1e-15)


def test_profiles_by_hand():
    """ln(3.048 / 0.04572) / ln(6.096 / 0.04572) at 10 ft, Category C; (10 / 80)^0.2 of a turbine's hub."""
    one = np.ones(1, np.float32)
    heights = np.float32([[3.048], [6.096], [0.04572], [0.01], [-1.0]])
    result = np.asarray(jax.jit(wind.log_profile)(heights, 6.096 * one, 0.04572 * one))
    np.testing.assert_allclose(result[:, 0], [0.85834, 1, 0, 0, 0], atol=1e-5)
    np.testing.assert_allclose(wind.power_profile(10 * one, 80 * one, 0.2 * one), 0.65975, atol=1e-5)
    for slope in (
        jax.grad(lambda z: wind.log_profile(z, 6.0, 0.05).sum()),
        jax.grad(lambda z: wind.power_profile(z, 6.0, 0.2).sum()),
    ):
        assert np.isfinite(jax.jit(slope)(np.float32([-1.0, 0.0, 0.01, 0.05, 1.0]))).all()


@pytest.mark.parametrize("profile, factor", [({"roughness": 0.05}, np.log(2 / 0.05) / np.log(6.096 / 0.05)),
                                            ({"exponent": 0.3}, (2 / 6.096) ** 0.3)])  # fmt: skip
def test_the_mean_wind_grows_with_height(profile, factor):
    sim = build((6.0, 0, 0), **profile)
    sim.data = with_states(sim.data, pos=[0, 0, 2.0])
    sim.step()
    expected = build((6.0 * factor, 0, 0))
    expected.step()
    np.testing.assert_allclose(sim.data.states.vel, expected.data.states.vel, rtol=1e-5)
    assert factor < 0.8
