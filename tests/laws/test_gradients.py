"""Gradients through every command level: equal to central differences, and finite where a switch lies."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from backward import StepAndPullback
from cases import send

from crazysim import Sim
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
N_INPUTS = 6
"""Number of inputs of a flight: five states and the command."""
N_WORLDS = 3 * N_INPUTS
"""For each input a world at the start, one ahead of it and one behind it."""
N_STEPS = 100
DIFFERENCE = 1e-6
"""Relative step of the central differences."""


@functools.cache
def flight(dynamics, control, engine):
    """Return data and compiled steps with their derivative: on ``plain`` step by step, on others in a loop."""
    sim = Sim(N_WORLDS, dynamics=dynamics, control=control, engine=engine)
    return sim.data, StepAndPullback(sim.build_step_fn(), sim.data, 1 if engine == "plain" else N_STEPS)


def with_inputs(data, x):
    """Return the data with states and a command for every world."""
    states = data.states.replace(**{name: jnp.asarray(x[name][:, None]) for name in x if name != "command"})
    return send(data.replace(states=states), x["command"][:, None])


def start_of(dynamics, control):
    """Return states and a command of one world, by name."""
    return {
        "pos": np.array([0.0, 0.0, 1.0]),
        "quat": np.array([0.02, -0.03, 0.05, 1.0]),
        "vel": np.array([0.1, 0.2, -0.1]),
        "ang_vel": np.array([0.1, -0.2, 0.1]),
        "rotor_vel": np.full(4, 0.98 * (15_864.0 if dynamics == "first_principles" else WEIGHT)),
        "command": np.array(COMMANDS[control]),
    }


@pytest.mark.parametrize(
    ("dynamics", "control", "engine"), [(*pair, "plain") for pair in PAIRS] + [("first_principles", "attitude", "auto")]
)
def test_gradient_equals_central_differences(dynamics, control, engine, x64):
    """100 steps in float64, along a random direction in each input on its own, away from switches.

    A central difference with a relative step of 1e-6 is off by about 1e-12 of curvature and 1e-10 of rounding,
    over a gradient of order one: 1e-6 leaves room for both. All inputs are compared in one flight, in their own worlds.
    """
    data, steps = flight(dynamics, control, engine)
    start, rng = start_of(dynamics, control), np.random.default_rng(0)
    x, directions = {}, {}
    for k, (name, value) in enumerate(start.items()):
        directions[name] = np.zeros((N_WORLDS, len(value)))
        directions[name][3 * k : 3 * k + 3] = rng.normal(size=value.shape) * np.maximum(np.abs(value), 0.1)
        x[name] = value + DIFFERENCE * np.tile([0.0, 1.0, -1.0], N_INPUTS)[:, None] * directions[name]
    length = np.linalg.norm(x["quat"], axis=-1, keepdims=True)
    x["quat"] = quat = x["quat"] / length
    along = np.sum(quat * directions["quat"], axis=-1, keepdims=True)
    directions["quat"] = (directions["quat"] - quat * along) / length

    flown = steps.fly(with_inputs(data, x), N_STEPS)
    end = {name: np.asarray(getattr(flown[-1].states, name)) for name in ("pos", "vel", "quat")}
    weights, vector = np.array([1.0, -2.0, 3.0]), np.array([1.0, 1.0, 1.0, 0.0])
    losses = np.sum(end["pos"] @ weights + 0.5 * np.sum(end["vel"] ** 2, -1) + end["quat"] @ vector, axis=-1)
    ends = {"pos": np.broadcast_to(weights, end["pos"].shape), "vel": end["vel"],
            "quat": np.broadcast_to(vector, end["quat"].shape)}  # fmt: skip
    gradients = steps.gradients(flown, {f"states.{name}": value for name, value in ends.items()})
    staged = "controls.rotor_vel" if control == "rotor_vel" else f"controls.{control}.staged_cmd"
    compared = 0
    for k, name in enumerate(start):
        gradient = gradients[staged if name == "command" else f"states.{name}"][3 * k, 0]
        analytic = gradient @ directions[name][3 * k]
        _, ahead, behind = losses[3 * k : 3 * k + 3]
        numeric = (ahead - behind) / (2 * DIFFERENCE)
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


def test_on_the_floor_and_at_rest_gradients_are_finite(x64):
    """A drone that rests, one that hits the floor, one that hovers, one with its motors off."""
    data, steps = flight("first_principles", "attitude", "auto")
    x = {name: np.zeros((N_WORLDS, len(value))) for name, value in start_of("first_principles", "attitude").items()}
    x["quat"][:, 3] = 1.0
    x["pos"][:4, 2] = -0.001, 0.05, 1.0, 0.5
    x["vel"][1, 2] = -1.0
    x["command"][:4, 3] = 0.0, 0.1, WEIGHT, 0.0
    flown = steps.fly(with_inputs(data, x), N_STEPS)
    states = flown[-1].states
    ends = {"pos": 2 * states.pos, "vel": states.ang_vel + 1, "ang_vel": states.vel}
    gradients = steps.gradients(flown, {f"states.{name}": value for name, value in ends.items()})
    for name, gradient in gradients.items():
        assert np.all(np.isfinite(gradient)), name
    assert np.abs(gradients["states.pos"][:4]).sum() > 0.1
