"""Gradients through every command level equal central differences, and are finite at switches."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import build_stagewise_step

from crazysim import ContactResponse, Sim, load_airframe
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
SETTERS = {c: getattr(F, f"{c}_control") for c in COMMANDS}


N_INPUTS = 6
"""Number of inputs of a flight: five states and the command."""
RELATIVE_STEP = 1e-6
"""Relative step of the central differences."""


def make_losses(dynamics, control, engine, n_worlds, n_steps=100):
    """Return a loss as a function of a dict of inputs, each (n_worlds, k), and the inputs of one world to start from.

    The loss has one number per world, (n_worlds,). The quaternion is normalised first.
    """
    sim = Sim(n_worlds, dynamics=dynamics, control=control, engine="plain" if engine == "stages" else engine)
    step = build_stagewise_step(sim) if engine == "stages" else sim.build_step_fn()
    n = sim.data.states.rotor_vel.shape[-1]
    hover = 15_864.0 if dynamics == "first_principles" else WEIGHT
    start = {
        "pos": [0.0, 0.0, 1.0],
        "quat": [0.02, -0.03, 0.05, 1.0],
        "vel": [0.1, 0.2, -0.1],
        "ang_vel": [0.1, -0.2, 0.1],
        "rotor_vel": np.full(n, 0.98 * hover),
        "command": COMMANDS[control],
    }

    def losses(x):
        x = {name: value[:, None] for name, value in x.items()}
        quat = x["quat"] / jnp.linalg.norm(x["quat"], axis=-1, keepdims=True)
        states = sim.data.states.replace(quat=quat, **{k: x[k] for k in ("pos", "vel", "ang_vel", "rotor_vel")})
        data = SETTERS[control](sim.data.replace(states=states), x["command"])
        s = step(data, n_steps).states
        terms = s.pos * jnp.array([1.0, -2.0, 3.0]) + 0.5 * s.vel**2 + s.quat[..., :3]
        return jnp.sum(terms, axis=(1, 2))

    return losses, {name: np.asarray(value, float) for name, value in start.items()}


def forward_mode(losses, x, directions):
    return jax.jvp(losses, (x,), (directions,))


def reverse_mode(losses, x, directions):
    values, pullback = jax.vjp(losses, x)
    (gradient,) = pullback(jnp.ones_like(values))
    return values, sum(jnp.sum(gradient[name] * directions[name], axis=-1) for name in x)


CASES = [
    ("first_principles", "state", "stages", forward_mode),
    ("first_principles", "body_rate", "stages", forward_mode),
    ("first_principles", "rotor_vel", "stages", forward_mode),
    ("so_rpy_rotor_drag", "state", "stages", forward_mode),
    ("so_rpy", "attitude", "plain", reverse_mode),
    ("first_principles", "attitude", "auto", reverse_mode),
]
"""Dynamics, command level, engine and mode. At state level, controllers of lower levels are differentiated too.

Most cases run the stages without an engine in forward mode, which compiles fastest: derivatives of physics and
controllers are defined in forward mode only, and JAX transposes them.
"""


@pytest.mark.long("compiles gradients of every dynamics and engine")
@pytest.mark.parametrize(("dynamics", "control", "engine", "mode"), CASES)
def test_gradient_equals_central_differences(dynamics, control, engine, mode, x64):
    """100 steps in float64, along a random direction in each input on its own, away from switches.

    A central difference with a relative step of 1e-6 has errors of about 1e-12 from curvature and 1e-10 from rounding,
    and the gradient is of order one, so a tolerance of 1e-6 suffices.

    Each input has three worlds: at the start, one step ahead of it and one step behind it.
    """
    losses, start = make_losses(dynamics, control, engine, n_worlds=3 * N_INPUTS)
    rng = np.random.default_rng(0)
    x, directions = {}, {}
    for k, (name, value) in enumerate(start.items()):
        direction = rng.normal(size=value.shape) * np.maximum(np.abs(value), 0.1)
        directions[name] = np.zeros((3 * len(start), len(value)))
        directions[name][3 * k : 3 * k + 3] = direction
        x[name] = value + RELATIVE_STEP * np.tile([0.0, 1.0, -1.0], len(start))[:, None] * directions[name]
    values, slopes = (np.asarray(result) for result in jax.jit(functools.partial(mode, losses))(x, directions))
    compared = 0
    for k, name in enumerate(start):
        _, ahead, behind = values[3 * k : 3 * k + 3]
        numeric, analytic = (ahead - behind) / (2 * RELATIVE_STEP), slopes[3 * k]
        assert np.isfinite(analytic), name
        np.testing.assert_allclose(analytic, numeric, rtol=1e-5, atol=1e-6, err_msg=name)
        compared += abs(numeric) > 1e-6
    assert compared >= 5, "the loss hardly depends on its inputs: nothing was compared"


@pytest.mark.long("compiles a kernel of contacts and of their gradient")
def test_gradients_of_contacts_equal_central_differences(x64):
    """A tilted drone slides over the floor, another is put down on it, and a third one hits a wall, in float64.

    The step and its gradient are one kernel each. Worlds are at the start, one step ahead of it and one step behind it.
    Errors are as in the test above.
    """
    sim = Sim(9, control="rotor_vel", plugins=[ContactResponse()])
    sim.scene.add("wall", pos=[0.2, 0.0, 0.0], length=2.0, height=1.0, thickness=0.1)
    step, rng, h = sim.build_step_fn(), np.random.default_rng(1), 1e-6
    start = {"pos": [0.0, 0.0, 0.005], "vel": [0.4, 0.2, -0.3], "ang_vel": [0.1, -0.2, 0.3]}
    x = {name: np.tile(value, (9, 1, 1)).astype(float) for name, value in start.items()}
    x["vel"][3:6] = 0.0
    x["pos"][6:], x["vel"][6:] = [0.098, 0.0, 0.5], [1.2, 0.2, 0.1]
    directions = {name: np.broadcast_to(rng.normal(size=3), (9, 1, 3)).copy() for name in start}
    directions["vel"][3:6] = 0.0
    for name, direction in directions.items():
        x[name] += h * np.tile([0.0, 1.0, -1.0], 3)[:, None, None] * direction

    def end(x):
        data = jax.tree.map(lambda a: a.astype(float) if a.dtype == np.float32 else a, sim.data)
        quat = jnp.broadcast_to(jnp.array([0.1, 0.05, 0.0, 1.0]) / np.sqrt(1.0125), (9, 1, 4))
        after = step(data.replace(states=data.states.replace(quat=quat, **x)), 5)
        states, impulse = after.states, jnp.abs(after.plugins["contact_response"].impulse)
        ends = states.pos @ jnp.array([1.0, -2.0, 3.0]) + states.vel @ jnp.ones(3) + states.ang_vel @ jnp.ones(3)
        return ends[:, 0], impulse[:, 0]

    @jax.jit
    def differentiate(x):
        values, pullback, impulse = jax.vjp(end, x, has_aux=True)
        (gradient,) = pullback(jnp.ones_like(values))
        return values, impulse, sum(jnp.sum(gradient[name] * directions[name], (1, 2)) for name in x)

    values, impulse, slopes = differentiate(x)
    assert np.all(impulse[:6, 2] > 0)
    assert np.all(impulse[6:, 0] > 0)
    for k in (0, 3, 6):
        numeric = (values[k + 1] - values[k + 2]) / (2 * h)
        assert abs(numeric) > 0.1
        np.testing.assert_allclose(slopes[k], numeric, rtol=1e-5)


def one_sided_quotients(fn, x, h):
    return (fn(x + h) - fn(x)) / h, (fn(x) - fn(x - h)) / h


def side_error(gradient, sides):
    scale = max(1e-9, *(abs(float(side)) for side in sides))
    return min(abs(float(gradient) - float(side)) for side in sides) / scale


def test_at_the_rotor_switch_the_gradient_is_one_side(x64):
    """The response has a kink where the command equals the speed, between spinning up and down."""
    params = first_principles.Params.create(load_airframe("cf21B_500"))

    @jax.jit
    def response(cmd):
        states = (np.zeros(3), np.array([0.0, 0, 0, 1]), np.zeros(3), np.zeros(3))
        return first_principles.dynamics(*states, jnp.full(4, cmd), np.full(4, 15_000.0), params=params)[3][0]

    gradient = jax.jit(jax.grad(response))(15_000.0)
    assert side_error(gradient, one_sided_quotients(response, 15_000.0, 1e-3)) < 1e-5


@pytest.mark.parametrize("limit_name", ["rotor_vel_min", "rotor_vel_max"])
def test_at_saturation_the_gradient_is_one_side(limit_name, x64):
    """At a limit the derivative with respect to the command is 1, beyond it 0."""
    params = first_principles.Params.create(load_airframe("cf21B_500"))
    limit = float(getattr(params, limit_name)[0])

    @jax.jit
    def saturated(cmd):
        return first_principles.saturate(jnp.full(4, cmd), params)[0]

    gradient = jax.jit(jax.grad(saturated))
    assert float(gradient(limit)) == 1.0
    assert side_error(1.0, one_sided_quotients(saturated, limit, 1e-3)) < 1e-6
    outside = limit * (1 + 1e-9 * (1 if limit_name == "rotor_vel_max" else -1))
    assert float(gradient(outside)) == 0.0
