"""Gradients through every command level: equal to central differences, and finite where a switch lies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Sim
from crazysim.core import functional as F
from crazysim.dynamics import first_principles

WEIGHT = 0.0434 * 9.81
COMMANDS = {
    "state": [0.1, -0.1, 1.1, 0.1, 0, 0, 0, 0.2, 0, 0, 0, 0.1, 0.99, 0.1, 0.05, -0.1],
    "attitude": [0.05, -0.08, 0.1, 1.02 * WEIGHT],
    "body_rate": [0.2, -0.1, 0.3, 1.02 * WEIGHT],
    "force_torque": [1.02 * WEIGHT, 1e-5, -2e-5, 1e-6],
    "rotor_vel": [16_000.0, 16_010.0, 16_020.0, 16_005.0],
}
PAIRS = [("first_principles", c) for c in COMMANDS] + [
    (d, c) for d in ("so_rpy", "so_rpy_rotor_drag") for c in ("state", "attitude")
]
SETTER = {c: getattr(F, f"{c}_control") for c in COMMANDS}


def flight(dynamics, control, engine, n_steps=100):
    """Return a scalar function of (pos, quat direction, vel, ang_vel, rotor_vel, command), and a start for it."""
    sim = Sim(dynamics=dynamics, control=control, engine=engine)
    step = sim.build_step_fn()
    n = sim.data.states.rotor_vel.shape[-1]
    hover = 15_864.0 if dynamics == "first_principles" else WEIGHT
    start = {
        "pos": jnp.asarray([0.0, 0.0, 1.0]),
        "quat": jnp.asarray([0.02, -0.03, 0.05, 1.0]),
        "vel": jnp.asarray([0.1, 0.2, -0.1]),
        "ang_vel": jnp.asarray([0.1, -0.2, 0.1]),
        "rotor_vel": jnp.full(n, 0.98 * hover, float),  # as what is added to it, or all is compiled twice
        "command": jnp.asarray(COMMANDS[control], dtype=float),
    }

    def loss(x):
        quat = x["quat"] / jnp.linalg.norm(x["quat"])
        states = sim.data.states.replace(
            quat=quat[None, None], **{k: x[k][None, None] for k in ("pos", "vel", "ang_vel", "rotor_vel")}
        )
        data = SETTER[control](sim.data.replace(states=states), x["command"][None, None])
        s = step(data, n_steps).states
        return (jnp.sum(s.pos * jnp.array([1.0, -2.0, 3.0])) + 0.5 * jnp.sum(s.vel**2) + jnp.sum(s.quat[..., :3])) * 1.0

    return loss, start


@pytest.mark.parametrize(
    ("dynamics", "control", "engine"), [(*pair, "plain") for pair in PAIRS] + [("first_principles", "attitude", "auto")]
)
def test_gradient_equals_central_differences(dynamics, control, engine, x64):
    """100 steps in float64, along a random direction in each input on its own, away from switches.

    A central difference with a relative step of 1e-6 is off by about 1e-12 of curvature and 1e-10 of rounding,
    over a gradient of order one: 1e-6 leaves room for both.
    """
    loss, start = flight(dynamics, control, engine)
    both = jax.jit(jax.value_and_grad(loss))  # one program for all
    gradient = both(start)[1]
    rng = np.random.default_rng(0)
    compared = 0
    for name, x in start.items():
        direction = jnp.asarray(rng.normal(size=x.shape)) * jnp.maximum(jnp.abs(x), 0.1)
        h = 1e-6
        ahead, behind = (both(start | {name: x + sign * h * direction})[0] for sign in (1, -1))
        numeric = float(ahead - behind) / (2 * h)
        analytic = float(jnp.sum(gradient[name] * direction))
        assert np.isfinite(analytic), name
        np.testing.assert_allclose(analytic, numeric, rtol=1e-5, atol=1e-6, err_msg=name)
        compared += abs(numeric) > 1e-6
    assert compared >= 5, "the loss hardly depends on its inputs: nothing was compared"


def one_sided(fn, x, h):
    """Return the forward and the backward difference quotient."""
    return (fn(x + h) - fn(x)) / h, (fn(x) - fn(x - h)) / h


def nearest_side(gradient, sides):
    """Return by how much a gradient misses the nearer of two one-sided quotients, relative to their size."""
    scale = max(1e-9, *(abs(float(side)) for side in sides))
    return min(abs(float(gradient) - float(side)) for side in sides) / scale


def test_at_the_rotor_switch_the_gradient_is_one_side(x64):
    """A command equal to the speed is the kink between spinning up and down."""
    params = first_principles.Params.create(Sim().airframe)

    def response(cmd):
        states = (jnp.zeros(3), jnp.asarray([0.0, 0, 0, 1]), jnp.zeros(3), jnp.zeros(3))
        return first_principles.dynamics(*states, jnp.full(4, cmd), jnp.full(4, 15_000.0), params=params)[3][0]

    gradient = jax.grad(response)(15_000.0)
    assert nearest_side(gradient, one_sided(response, 15_000.0, 1e-3)) < 1e-5


@pytest.mark.parametrize("at", ["rotor_vel_min", "rotor_vel_max"])
def test_at_saturation_the_gradient_is_one_side(at, x64):
    """At a limit the command either counts in full or not at all."""
    params = first_principles.Params.create(Sim().airframe)
    limit = float(getattr(params, at)[0])

    def saturated(cmd):
        return first_principles.saturate(jnp.full(4, cmd), params)[0]

    assert float(jax.grad(saturated)(limit)) == 1.0
    assert nearest_side(1.0, one_sided(saturated, limit, 1e-3)) < 1e-6
    outside = limit * (1 + 1e-9 * (1 if at == "rotor_vel_max" else -1))
    assert float(jax.grad(saturated)(outside)) == 0.0


def test_on_the_floor_and_at_rest_gradients_are_finite():
    """A drone that rests, one that hits the floor, one that hovers, one with its motors off."""
    sim = Sim(n_worlds=4, control="attitude")
    step = sim.build_step_fn()

    def loss(x):
        pos, vel, thrust = x
        states = sim.data.states.replace(pos=pos, vel=vel)
        cmd = jnp.zeros((4, 1, 4)).at[:, 0, 3].set(thrust)
        s = step(F.attitude_control(sim.data.replace(states=states), cmd), 100).states
        return jnp.sum(s.pos**2) + jnp.sum(s.vel * s.ang_vel) + jnp.sum(s.vel)

    pos = jnp.zeros((4, 1, 3)).at[:, 0, 2].set(jnp.array([-0.001, 0.05, 1.0, 0.5]))
    vel = jnp.zeros((4, 1, 3)).at[1, 0, 2].set(-1.0)
    gradient = jax.jit(jax.grad(loss))((pos, vel, jnp.array([0.0, 0.1, WEIGHT, 0.0])))
    for part in gradient:
        assert np.all(np.isfinite(part))
    assert float(jnp.abs(gradient[0]).sum()) > 0.1
