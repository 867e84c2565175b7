"""Law 9 for arrays that reach kernels: any type, rank, length or origin is the right result or an error at once.

A kernel reads memory as it was written to, whatever array it gets. So every public function that passes arrays to the
engine is called with arrays that are drawn at random from wrong ones: none may return a wrong number.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import LEVELS, hover_command, shared_sim
from hypothesis import given, settings
from hypothesis import strategies as st

from crazysim import ConfigError
from crazysim.core import functional as F
from crazysim.core.data import STATE_SIZES
from crazysim.engine.sharding import world_mesh
from crazysim.envs import AutoReset, DroneVectorEnv, make, rollout
from crazysim.envs.state import EnvState

N_WORLDS, N_DRONES = 4, 2
EDITS = {
    "int32": lambda x: x.astype(jnp.int32),
    "uint8": lambda x: x.astype(jnp.uint8),
    "bool": lambda x: x.astype(bool),
    "complex64": lambda x: x.astype(jnp.complex64),
    "float16": lambda x: x.astype(jnp.float16),
    "bfloat16": lambda x: x.astype(jnp.bfloat16),
    "first": lambda x: x[:1],
    "last": lambda x: x[-1],
    "more worlds": lambda x: jnp.concatenate([x, x]),
    "one drone": lambda x: x[:, :1],
    "no drones": lambda x: x[:, :0],
    "without drones": lambda x: x[:, 0],
    "shorter": lambda x: x[..., :-1],
    "longer": lambda x: jnp.concatenate([x, x[..., :1]], axis=-1),
    "empty": lambda x: x[..., :0],
    "axis in front": lambda x: x[None],
    "axis at the end": lambda x: x[..., None],
    "flat": jnp.ravel,
    "transposed": lambda x: x.T,
    "joined": lambda x: x.reshape(1, -1, x.shape[-1]),
    "two devices": lambda x: jax.device_put(x, jax.sharding.NamedSharding(*two_devices(x))),
    "on the host": np.asarray,
    "float64 on the host": lambda x: np.asarray(x, np.float64),
    "integers on the host": lambda x: np.asarray(x, np.int64),
    "list": lambda x: np.asarray(x).tolist(),
    "ragged": lambda x: [np.asarray(x).tolist(), [1.0]],
    "objects": lambda x: np.asarray(x, object),
    "text": lambda x: np.asarray(x, str),
    "number": lambda x: 1.0,
    "None": lambda x: None,
}  # fmt: skip
OUR_WORDS = ("expected", "with shape")
JAX_WORDS = ("incompatible devices", "as an abstract array")
"""Words of errors of JAX that say what is wrong: arrays on different devices, and arguments that jit does not take."""


def two_devices(x):
    mesh = world_mesh(jax.devices()[: 2 if np.shape(x)[:1] and np.shape(x)[0] % 2 == 0 else 1])
    return mesh, jax.sharding.PartitionSpec(*mesh.axis_names)


@functools.cache
def hover(task="hover", mode=None):
    env = make(task, N_WORLDS)
    env = env if mode is None else AutoReset(env, mode)
    state = jax.jit(env.reset)(jax.random.key(0))
    return env, state, env.flatten(state)


@functools.cache
def flying(level="attitude"):
    sim = shared_sim(n_worlds=N_WORLDS, n_drones=N_DRONES, control=level)
    states = sim.data.states
    pos = jnp.round(states.pos * 4).at[..., 2].set(2.0)
    return sim, sim.data.replace(states=states.replace(pos=pos))


def with_state(data, name, x):
    return data.replace(states=data.states.replace(**{name: x}))


def results_of_state(state):
    return state.obs, state.reward, state.full_data.states


def fly_env(function):
    def build():
        env, state, flat = hover(mode="SameStep")
        calls = {
            "step": lambda a: env.step(state, a),
            "advance": lambda a: EnvState(env.advance(flat, a).data()),
            "step in jit": lambda a: jax.jit(env.step)(state, a),
            "advance in jit": lambda a: EnvState(jax.jit(env.advance)(flat, a).data()),
            "rollout": lambda a: rollout(env, state, lambda obs, memory, key: (a, memory, ()), jax.random.key(1), 2)[0],
        }
        action = jnp.zeros(state.action.shape).at[1, 0, 2].set(1.0)
        return lambda a: results_of_state(calls[function](a)), action

    return build


def fly_vector():
    env = hover_vector()

    def step(action):
        env.reset(seed=0)
        return env.step(action)[:2]

    return step, jnp.zeros((N_WORLDS, 4)).at[1, 2].set(1.0)


@functools.cache
def hover_vector():
    return DroneVectorEnv(make("hover", N_WORLDS))


def command(level, function):
    def build():
        sim, data = flying(level)
        send = getattr(F, f"{level}_control")

        def fly(command):
            sim.data = data
            getattr(sim, f"{level}_control")(command)
            sim.step(3)
            return sim.data.states

        def roll(command):
            sim.data = data
            sim.rollout(lambda params, data: command, None, 2)
            return sim.data.states

        calls = {
            "Sim": fly,
            "F": lambda c: sim.step_fn(send(data, c), 3).states,
            "F in jit": lambda c: jax.jit(lambda c: sim.step_fn(send(data, c), 3).states)(c),
            "rollout": roll,
        }
        hover = np.broadcast_to(hover_command(data), (N_WORLDS, N_DRONES, len(hover_command(data))))
        return calls[function], jnp.round(jnp.asarray(hover, jnp.float32))

    return build


def state_of_step(name, function):
    def build():
        sim, data = flying()
        contacts, depth = sim.scene.contact_fn(), sim.scene.depth_fn(width=8, height=8)
        mask = jnp.array([True, False, True, False])
        calls = {
            "step_fn": lambda x: sim.step_fn(with_state(data, name, x), 2).states,
            "step_fn in jit": lambda x: jax.jit(lambda x: sim.step_fn(with_state(data, name, x), 2).states)(x),
            "reset_fn": lambda x: sim.reset_fn(with_state(data, name, x), sim.default_data, mask).states,
            "default": lambda x: sim.reset_fn(data, with_state(data, name, x), mask).states,
            "contacts": lambda x: contacts(with_state(data, name, x)).floor_distance,
            "depth": lambda x: depth(with_state(data, name, x)).distance,
            "gradient": lambda x: jax.grad(
                lambda vel: sim.step_fn(with_state(data, name, x).replace(), 2).states.pos.sum() + vel
            )(0.0),
        }
        return calls[function], jnp.round(getattr(data.states, name))

    return build


def goals():
    env, state, _ = hover()
    action = jnp.zeros(state.action.shape)
    return lambda x: results_of_state(env.step(env.set_goal(state, x), action)), jnp.ones((N_WORLDS, 1, 3))


CALLS = {f"env {name}": fly_env(name) for name in ("step", "advance", "step in jit", "advance in jit", "rollout")}
CALLS |= {"vector": fly_vector, "set_goal": goals}
CALLS |= {f"{x} {level}": command(level, x) for level in LEVELS for x in ("Sim", "F", "F in jit", "rollout")}
CALLS |= {
    f"{function} {name}": state_of_step(name, function)
    for name in STATE_SIZES
    for function in ("step_fn", "step_fn in jit", "reset_fn", "default")
}
CALLS |= {
    f"{function} {name}": state_of_step(name, function)
    for name in ("pos", "quat")
    for function in ("contacts", "depth")
}
BROADCAST = {"set_goal"}
"""Calls that take fewer axes, as their page says."""


def as_given(x):
    """Return real numbers as float32; None for what is not an array of real numbers."""
    try:
        x = np.asarray(x)
    except (ValueError, TypeError):
        return None
    is_real = jnp.issubdtype(x.dtype, jnp.floating) or jnp.issubdtype(x.dtype, jnp.integer)
    return x.astype(np.float32) if is_real else None


@functools.cache
def built(name):
    return CALLS[name]()


@pytest.mark.parametrize("edit", EDITS)
def test_any_action_of_flat_data_is_a_right_result_or_an_error(edit):
    check_call("env advance", edit)


@settings(max_examples=settings.default.max_examples // 3)  # each compiles a function
@given(name=st.sampled_from(sorted(CALLS)), edit=st.sampled_from(sorted(EDITS)))
def test_any_array_is_a_right_result_or_an_error(name, edit):
    check_call(name, edit)


def check_call(name, edit):
    call, x = built(name)
    wrong = EDITS[edit](x)
    given, result, message = as_given(wrong), None, ""
    try:
        result = call(wrong)
    except (ValueError, TypeError) as error:
        message = str(error)
    if message:
        assert any(words in message for words in (*OUR_WORDS, *JAX_WORDS)), message
        return
    assert given is not None, "not numbers, and no error"
    assert given.shape == x.shape or name in BROADCAST, f"{given.shape} in place of {x.shape}, and no error"
    right = call(jnp.asarray(given))
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(right), strict=True):
        np.testing.assert_array_equal(a, b)


FLAT_EDITS = {
    "worlds": lambda x: x[:1],
    "type": lambda x: x.astype(jnp.int32) if x.dtype == jnp.float32 else x,
    "axis": lambda x: x[None],
}


@pytest.mark.parametrize("edit", FLAT_EDITS)
def test_edited_flat_data_is_refused(edit):
    env, state, flat = hover(mode="SameStep")
    edited = jax.tree.map(lambda x: FLAT_EDITS[edit](x) if x.ndim > 1 else x, flat)
    for advance in (env.advance, jax.jit(env.advance)):
        with pytest.raises(ConfigError, match="in flat data"):
            advance(edited, jnp.zeros(state.action.shape))


@pytest.mark.parametrize(
    "settings",
    [
        {"control": "body_rate"},
        {"n_worlds": 2},
        {"task": "race"},
        {"task": "recover"},
        {"mode": None},
        {"mode": "NextStep"},
    ],
)
def test_states_and_flat_data_of_another_environment_are_refused(settings):
    env, state, flat = hover(mode="SameStep")
    settings = {"mode": "SameStep", "n_worlds": N_WORLDS, "task": "hover", "control": "attitude"} | settings
    mode, task, n_worlds = settings.pop("mode"), settings.pop("task"), settings.pop("n_worlds")
    other = make(task, n_worlds, **settings)
    other = other if mode is None else AutoReset(other, mode)
    action = jnp.zeros(other._action_format.shape)
    for call in (lambda: other.step(state, action), lambda: other.flatten(state), lambda: other.advance(flat, action)):
        with pytest.raises(ConfigError, match=r"expected (a state|flat data) of this"):
            call()
    with pytest.raises(ConfigError, match="expected a state of this environment, got None"):
        env.step(None, action)


@pytest.mark.parametrize(
    "memory", [jnp.zeros((N_WORLDS, 3)), jnp.zeros((N_WORLDS, 2), int), {"h": jnp.zeros((N_WORLDS, 2))}]
)
def test_a_rollout_with_another_memory_is_refused(memory):
    env, state, _ = hover(mode="SameStep")
    initial = jnp.zeros((N_WORLDS, 2))

    def policy(obs, memory, key):
        return jnp.zeros(state.action.shape), memory, ()

    with pytest.raises(ConfigError, match="expected a memory of the shapes and types of initial_memory"):
        rollout(env, state, policy, jax.random.key(0), 2, initial_memory=initial, memory=memory)
