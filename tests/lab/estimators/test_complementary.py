"""The complementary filter: agreement with the compiled firmware, flight on it, and wrong input."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim, rotation
from crazysim.lab.estimators import complementary
from crazysim.lab.validate import firmware_filters


@pytest.mark.parametrize("kind", ["pressure", "ground"])
def test_the_filter_agrees_with_the_compiled_firmware(kind):
    """In 2,000 steps of 1 ms, except for the rounding of 500 updates in float32."""
    result, recorded = firmware_filters.complementary_states(kind)
    assert np.ptp(recorded[:, [0, 1, 2, 4, 5]], axis=0).min() > 0.05, "nothing moved in the recording"
    np.testing.assert_allclose(result[:, :4], recorded[:, :4], rtol=0, atol=5e-6)
    np.testing.assert_allclose(result[:, 4], recorded[:, 4], rtol=0, atol=5e-6)
    np.testing.assert_allclose(result[:, 5], recorded[:, 5], rtol=0, atol=5e-4)  # differences over 10 ms


@pytest.fixture(scope="module")
def flown_sim():
    """Return drones that have tilted back and forth for 2 s on the filter, whose name adds the Crazyflie's sensors."""
    sim = Sim(4, control="attitude", rng_key=4, estimator="complementary")
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(1.0)))
    thrust = float(sim.data.params.mass[..., 0].reshape(-1)[0]) * 9.81
    for k in range(20):
        sim.attitude_control(np.tile(np.float32([0.2 * math.sin(1.5 * k), 0.0, 0.0, thrust]), (4, 1, 1)))
        sim.step(50)
    return sim


def test_drones_fly_on_the_estimate(flown_sim):
    """Attitudes agree within some degrees (the accelerometer shows thrust, not gravity), heights within centimetres."""
    record, s = flown_sim.data.plugins["complementary"], flown_sim.data.states
    estimated_z, true_z = (np.asarray(rotation.matrix(q))[..., 2, :] for q in (record.quat, s.quat))
    tilt = np.degrees(np.arccos(np.clip(np.sum(estimated_z * true_z, axis=-1), -1, 1)))
    assert 1e-3 < tilt.max() < 5
    assert np.abs(np.asarray(record.height - s.pos[..., 2:])).max() < 0.1
    assert np.abs(np.asarray(s.quat)[..., 3]).min() > 0.9
    measured = flown_sim.plugins.observations(flown_sim.data)
    np.testing.assert_array_equal(measured["complementary.pos"][..., :2], 0.0)
    assert list(flown_sim.plugins) == ["imu", "barometer", "complementary"]


def test_gradients_of_the_estimate_equal_central_differences(x64):
    """Gradients are with respect to body rates and specific forces, away from the kinks of the dead band."""
    quat = jnp.array([0.1, -0.2, 0.05, 0.97])
    quat = quat / jnp.linalg.norm(quat)

    @jax.jit
    @jax.value_and_grad
    def loss(x):
        turned, integral = complementary.update_mahony(quat, jnp.zeros(3), x[:3], x[3:], 0.004, 0.4, 0.001)
        climb = complementary.inertial_climb(jnp.zeros(1), turned, x[3:], 0.004)
        return jnp.sum(turned * jnp.arange(4.0)) + 1e3 * jnp.sum(integral) + climb[0]

    x, h = jnp.array([0.3, -0.2, 0.1, 1.0, 2.0, 12.0]), 1e-5
    slope = [(loss(x + d)[0] - loss(x - d)[0]) / (2 * h) for d in h * jnp.eye(6)]
    np.testing.assert_allclose(loss(x)[1], slope, rtol=1e-6, atol=1e-9)
