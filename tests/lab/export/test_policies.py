"""Policies as ONNX and as C give the actions of JAX, and describe their inputs and outputs."""

import ctypes
import json
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.envs import make
from crazysim.envs.statistics import RunningStats
from crazysim.train.export import cost_text, describe, to_c, to_onnx
from crazysim.train.networks import Network, Policy, gru_network, init_mlp, init_weights

FLAGS = ("-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror")


@pytest.fixture(scope="module")
def meta():
    return describe(make("hover", 1))


@pytest.fixture(scope="module")
def policy(meta):
    rng, n = np.random.default_rng(0), sum(meta["observations"].values())
    layers = init_mlp(jax.random.key(0), (n, 64, 32, 4), 1.0)
    layers = [(w, jnp.asarray(rng.normal(size=b.shape), jnp.float32)) for w, b in layers]
    mean, var = rng.normal(size=n), np.exp(rng.normal(scale=2.0, size=n))
    var[0] = 0.0  # an observation that never changed
    return Policy(RunningStats(*(jnp.asarray(x, jnp.float32) for x in (mean, var, 1e4))), layers)


@pytest.fixture(scope="module")
def observations_and_actions(meta, policy):
    rng = np.random.default_rng(1)
    n = sum(meta["observations"].values())
    x = rng.normal(size=(500, n)) * np.exp(rng.normal(scale=2.0, size=(500, 1)))
    x = np.array(x * np.sqrt(policy.stats.var) + policy.stats.mean, np.float32)
    x[0] = 1e6
    ends = np.cumsum(list(meta["observations"].values()))[:-1]
    named = dict(zip(meta["observations"], np.split(x, ends, axis=-1), strict=True))
    act = jax.jit(lambda policy, obs: policy({name: obs[name] for name in reversed(named)}))
    actions = np.asarray(act(policy, named))
    assert 0.3 < np.abs(actions).mean() < 0.95  # neither zero nor saturated
    return x, actions


def with_memory(policy, size):
    network = gru_network(size)
    weights = init_weights(network, jax.random.key(2), len(policy.stats.mean), (16, 4), 1.0)
    body = weights.body.replace(bias=jax.random.normal(jax.random.key(3), weights.body.bias.shape))
    return Policy(policy.stats, weights.layers, body, network)


@pytest.fixture(scope="module")
def episodes(policy, observations_and_actions):
    """Return a policy with memory, observations of 25 steps of 20 drones, resets of memories, actions, and memories."""
    policy, obs = with_memory(policy, 9), observations_and_actions[0].reshape(25, 20, -1)
    reset = np.random.default_rng(4).uniform(size=(25, 20)) < 0.1
    seen, memory, actions = jnp.asarray(obs), policy.initial_memory(20), []
    act = jax.jit(policy.act)
    for t in range(25):
        memory = jnp.where(reset[t][:, None], 0.0, memory)
        action, memory = act({"all": seen[t]}, memory)
        actions.append(np.asarray(action))
    action_without_memory = act({"all": seen[-1]}, policy.initial_memory(20))[0]
    assert np.abs(action_without_memory - actions[-1]).max() > 0.05, "memories matter"
    return policy, obs, reset, np.stack(actions), np.asarray(memory)


def compile_header(path, folder, name="policy"):
    source, library = folder / "use.c", folder / "use.so"
    source.write_text(
        f'#include "{path}"\nvoid fly(int n, const float *obs, float *action);\n'
        f"void fly(int n, const float *obs, float *action)\n"
        f"{{ for (int i = 0; i < n; ++i) {name}(obs + 21 * i, action + 4 * i); }}\n"
    )
    cc = shutil.which("cc") or shutil.which("gcc") or "cc"
    subprocess.run([cc, "-std=c99", *FLAGS, "-shared", "-fPIC", source, "-o", library, "-lm"], check=True)
    fly = ctypes.CDLL(str(library)).fly

    def actions(obs):
        out = np.empty((len(obs), 4), np.float32)
        pointers = (x.ctypes.data_as(ctypes.POINTER(ctypes.c_float)) for x in (np.ascontiguousarray(obs), out))
        fly(len(obs), *pointers)
        return out

    return actions


def test_c_gives_the_actions_of_jax(tmp_path, policy, meta, observations_and_actions):
    obs, actions = observations_and_actions
    path = to_c(policy, tmp_path / "policy.h", meta)
    np.testing.assert_allclose(compile_header(path, tmp_path)(obs), actions, atol=5e-6)


def test_the_cost_counts_the_operations(meta, policy):
    """21 observations, layers of 64, 32 and 4, and 9 numbers of memory with layers of 16 and 4."""
    text = cost_text(policy, meta)
    assert text.startswith(f"{21 * 64 + 64 * 32 + 32 * 4:,} multiply-adds, 0 sigmoids and 100 tanh: at most ")
    assert f"{4 * (2 * 21 + 22 * 64 + 65 * 32 + 33 * 4):,} bytes of flash" in text
    n = 27 * (21 + 9) + 30 * 16 + 16 * 4
    assert cost_text(with_memory(policy, 9), meta).startswith(f"{n:,} multiply-adds, 18 sigmoids and 29 tanh: at most ")


def test_c_with_memory_gives_the_actions_of_jax_over_episodes(tmp_path, meta, episodes):
    policy, obs, reset, actions, memory = episodes
    path = to_c(policy, tmp_path / "hover.h", meta, name="hover")
    source, library = tmp_path / "use.c", tmp_path / "use.so"
    source.write_text(
        f'#include "{path}"\nvoid reset(hover_state *state);\n'
        f"void step(hover_state *state, const float *obs, float *action);\n"
        f"void reset(hover_state *state) {{ hover_reset(state); }}\n"
        f"void step(hover_state *state, const float *obs, float *action) {{ hover(state, obs, action); }}\n"
    )
    cc = shutil.which("cc") or shutil.which("gcc") or "cc"
    subprocess.run([cc, "-std=c99", *FLAGS, "-shared", "-fPIC", source, "-o", library, "-lm"], check=True)
    code, states = ctypes.CDLL(str(library)), np.full((20, 9), np.nan, np.float32)

    def pointer(x):
        return x.ctypes.data_as(ctypes.POINTER(ctypes.c_float))

    for t, drone in np.ndindex(25, 20):
        if t == 0 or reset[t, drone]:
            code.reset(pointer(states[drone]))
        action = np.empty(4, np.float32)
        code.step(pointer(states[drone]), pointer(np.ascontiguousarray(obs[t, drone])), pointer(action))
        np.testing.assert_allclose(action, actions[t, drone], atol=2e-5)
    np.testing.assert_allclose(states, memory, atol=2e-5)
    in_cpp = tmp_path / "both.cpp"
    in_cpp.write_text(f'#include "{path}"\nvoid fly(hover_state *s, const float *x, float *a) {{ hover(s, x, a); }}\n'
                    "void begin(hover_state *s) { hover_reset(s); }\n")  # fmt: skip
    subprocess.run(["g++", "-std=c++11", *FLAGS, "-fsyntax-only", in_cpp], check=True)


def test_onnx_with_memory_gives_the_actions_of_jax_over_episodes(tmp_path, meta, episodes):
    runtime = pytest.importorskip("onnxruntime")
    policy, obs, reset, actions, last_memory = episodes
    path = to_onnx(policy, tmp_path / "policy.onnx", meta)
    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert [(x.name, x.shape) for x in session.get_inputs()] == [
        ("observation", ["batch", 21]),
        ("memory", ["batch", 9]),
    ]
    assert [x.name for x in session.get_outputs()] == ["action", "next_memory"]
    memory = np.zeros((20, 9), np.float32)
    for t in range(25):
        memory[reset[t]] = 0.0
        action, memory = session.run(None, {"observation": obs[t], "memory": memory})
        np.testing.assert_allclose(action, actions[t], atol=2e-5)
    np.testing.assert_allclose(memory, last_memory, atol=2e-5)


def test_the_header_describes_inputs_and_outputs(tmp_path, policy, meta):
    text = to_c(policy, tmp_path / "policy.h", meta).read_text()
    assert "[0..2] ang_vel: angular velocity, body frame, rad/s" in text
    assert (
        "[3..5] difference_to_goal: goal minus position (of the load in transport and deliver), world frame, m" in text
    )
    assert "[9..17] rot" in text
    assert "[18..20] vel" in text
    assert "level attitude" in text
    assert "[0] roll, rad = 0 + 0.785398163 * action[0]" in text
    assert "[3] collective thrust, N = 0.42575404 + " in text
    assert text.count("#include") == 1


def test_onnx_gives_the_actions_of_jax(tmp_path, policy, meta, observations_and_actions):
    runtime = pytest.importorskip("onnxruntime")
    obs, actions = observations_and_actions
    path = to_onnx(policy, tmp_path / "policy.onnx", meta)
    assert path.stat().st_size < 40_000
    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    (x,), (y,) = session.get_inputs(), session.get_outputs()
    assert (x.name, x.shape, x.type) == ("observation", ["batch", 21], "tensor(float)")
    assert (y.name, y.shape, y.type) == ("action", ["batch", 4], "tensor(float)")
    np.testing.assert_allclose(session.run(None, {"observation": obs})[0], actions, atol=5e-6)
    np.testing.assert_allclose(session.run(None, {"observation": obs[:1]})[0], actions[:1], atol=5e-6)
    properties = session.get_modelmeta().custom_metadata_map
    assert json.loads(properties["observations"]) == meta["observations"]
    assert list(json.loads(properties["observations"])) == ["ang_vel", "difference_to_goal", "pos", "rot", "vel"]
    assert properties["level"] == "attitude"
    assert json.loads(properties["units"])[0] == "roll, rad"
    np.testing.assert_allclose(json.loads(properties["centre"]), [0, 0, 0, 0.42575404], rtol=1e-6)
    assert len(json.loads(properties["scale"])) == 4


VALUES = np.array([np.nan, np.inf, -np.inf, 3e38, -3e38, -1.0, 0.0], np.float32)
"""Numbers that a broken sensor or estimator may report."""


def broken(obs, rng):
    """Return observations with several ``VALUES`` in each row, and nothing else in some rows."""
    mask = rng.uniform(size=obs.shape) < rng.choice([0.05, 0.3, 1.0], (len(obs), 1))
    return np.where(mask, rng.choice(VALUES, obs.shape), obs).astype(np.float32)


@pytest.mark.parametrize("language", ["c", "onnx"])
def test_exported_actions_are_finite_whatever_is_observed(tmp_path, policy, meta, observations_and_actions, language):
    """An observation of NaN counts as its mean; an infinite one as the limit of a normalised observation."""
    obs, rng = broken(observations_and_actions[0], np.random.default_rng(5)), np.random.default_rng(6)
    if language == "c":
        act = compile_header(to_c(policy, tmp_path / "policy.h", meta), tmp_path)
    else:
        runtime = pytest.importorskip("onnxruntime")
        session = runtime.InferenceSession(to_onnx(policy, tmp_path / "policy.onnx", meta))
        act = lambda x: session.run(None, {"observation": x})[0]  # noqa: E731
    actions = act(obs)
    assert np.isfinite(obs).all(axis=-1).mean() < 0.5
    assert (np.abs(actions) <= 1).all()
    limit = 11 * np.sqrt(np.asarray(policy.stats.var) + 1e-6)
    mean = np.asarray(policy.stats.mean)
    counted = np.clip(np.where(np.isnan(obs), mean, obs), mean - limit, mean + limit).astype(np.float32)
    np.testing.assert_allclose(actions, policy({"x": jnp.asarray(counted)}), atol=1e-5)  # sums in another order
    if language == "onnx":
        with_state = with_memory(policy, 9)
        session = runtime.InferenceSession(to_onnx(with_state, tmp_path / "memory.onnx", meta))
        memory = np.zeros((500, 9), np.float32)
        for _ in range(3):
            action, memory = session.run(None, {"observation": rng.permuted(obs, axis=0), "memory": memory})
            assert (np.abs(action) <= 1).all()
            assert (np.abs(memory) <= 1).all()


@pytest.mark.parametrize("write", [to_c, to_onnx])
def test_a_policy_of_other_sizes_or_with_nan_is_refused(tmp_path, policy, meta, write):
    path = tmp_path / "policy"
    more = meta | {"observations": meta["observations"] | {"wind": 3}}
    with pytest.raises(ConfigError, match=r"from 24 numbers .*wind 3.* got one from 21 to 4"):
        write(policy, path, more)
    broken = [(w, b.at[0].set(jnp.nan)) for w, b in policy.layers]
    with pytest.raises(ConfigError, match="finite weights, got NaN or infinity"):
        write(policy.replace(layers=broken), path, meta)
    assert not path.exists()


def test_a_custom_network_with_the_weights_of_a_gru_is_an_error(tmp_path, policy, meta):
    """Its outputs are not those of the built-in network, although its weights have the same type."""
    policy_with_memory = with_memory(policy, 3)
    network = Network(
        policy_with_memory.network.init, lambda gru, obs, memory: (obs, -gru(gru.encode(obs), memory)), np.zeros(3)
    )
    with pytest.raises(ConfigError, match="policy with the built-in network, got one with another"):
        to_c(policy_with_memory.replace(network=network), tmp_path / "policy.h", meta)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["", "2fast", "fly away", "a-b", "é"])
def test_an_invalid_c_name_is_refused(tmp_path, policy, meta, name):
    with pytest.raises(ConfigError, match="name of a C function"):
        to_c(policy, tmp_path / "policy.h", meta, name)


def test_without_onnx_the_error_names_the_extra(tmp_path, policy, meta, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ImportError, match=r"pip install 'crazysim\[onnx\]'"):
        to_onnx(policy, tmp_path / "policy.onnx", meta)
