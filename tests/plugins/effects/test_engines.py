"""Effects on every engine: fused with the physics, meaning what they mean plain, and absent until added."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Battery, Downwash, GroundEffect, Latency, MotorFailure, Plugin, Sim, Wind, WindField
from crazysim.engine import Step
from crazysim.engine.backends import native
from crazysim.plugins import effects
from crazysim.plugins.effects.grid import Grid

EFFECTS = [
    Wind(velocity=[2.0, 0.5, 0.0], speed_20ft=5.0, exponent=0.2),
    WindField(Grid(np.linspace(-1, 1, 300).reshape(5, 5, 4, 3), (-1, -1, 0), 0.5), spread=(0.3, 0.3, 0.0)),
    Downwash(),
    Battery(capacity=0.25, resistance=0.05),
    MotorFailure(rate=0.5),
    Latency(delay=2, max_delay=4),
    GroundEffect(),
]


def test_every_effect_is_here():
    assert {type(effect) for effect in EFFECTS} == {
        x for x in vars(effects).values() if isinstance(x, type) and issubclass(x, Plugin)
    }


@pytest.fixture(scope="module")
def sim():
    """Return a flight with every effect on."""
    sim = Sim(n_worlds=3, n_drones=2, control="attitude", drone="cf2x_L250", rng_key=5)
    for effect in EFFECTS:
        sim.add(effect)
    states = jax.device_get(sim.data.states)
    sim.data = sim.data.replace(states=states.replace(
        pos=states.pos * 0.2 + np.float32([0, 0, 1.0]), rotor_vel=states.rotor_vel + 14000.0))  # fmt: skip
    sim.attitude_control(np.tile(np.float32([0.1, 0, 0, 0.32]), (3, 2, 1)))
    return sim


def test_every_effect_is_fused(sim):
    program = sim.step_fn.plan(sim.data).program
    assert program.unfused_stages == ()
    segments = program.fused_segments
    fused = {name for s in segments for name in s.stages}
    assert {"wind", "wind_field", "wind_field_displacement", "downwash", "battery", "motors"} <= fused
    assert [s.scope for s in segments] == ["drone"]


def test_effects_mean_the_same_on_every_engine(sim):
    """20 steps, rounding grown by the controller's gains; random numbers are the same bits everywhere."""
    expected = Step(sim.step_pipeline, "plain")(sim.data, jnp.int32(20))
    still = Step(Sim(n_worlds=3, n_drones=2, control="attitude", drone="cf2x_L250").step_pipeline, "interpret")(
        sim.data, jnp.int32(20)
    )
    assert np.abs(np.asarray(expected.states.vel) - np.asarray(still.states.vel)).max() > 1e-3
    for engine in ("lanes", "fused") if native.compiler() else ("lanes",):
        found = Step(sim.step_pipeline, engine)(sim.data, jnp.int32(20))
        for name in ("pos", "quat", "vel"):
            a, b = getattr(found.states, name), getattr(expected.states, name)
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-5, err_msg=f"{engine} {name}")
