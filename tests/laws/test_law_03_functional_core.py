"""Law 3: the functional API (the core) does the same as ``Sim`` (its shell), inside jit, scan, vmap and grad."""

import ast
import importlib
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import hover_command, repeat_command, trees_equal, with_states

from crazysim import Sim, dynamics
from crazysim.core import functional as F

MASK = np.array([False, True, False])
ROUNDING = {"rtol": 2e-6, "atol": 2e-6}  # float32: another program around the step fuses and rounds differently


@pytest.fixture(scope="module")
def start():
    sim = Sim(3, 2, attitude_freq=250)
    sim.data = with_states(
        sim.data, pos=[0.1, 0.2, 2.0], vel=[0.5, -0.3, 0.1], rotor_vel=[12000.0, 13000, 12500, 12000]
    )
    sim.build_default_data()
    commands = repeat_command(sim.data, hover_command(sim.data)) * np.ones((4, 3, 2, 1))
    commands = commands + np.random.default_rng(3).uniform(-0.1, 0.1, commands.shape)
    return sim, sim.data, sim.build_step_fn(), sim.build_reset_fn(), commands.astype(np.float32)


def assert_close(a, b):
    """Assert that two data are equal: states up to rounding, integers and flags exactly."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for name in ("steps", "episode", "nonfinite"):
        np.testing.assert_array_equal(getattr(a.core, name), getattr(b.core, name))
    for x, y in zip(jax.tree.leaves((a.states, a.controls)), jax.tree.leaves((b.states, b.controls)), strict=True):
        scale = max(1.0, np.abs(y).max())  # rotor speeds are near 1e4
        np.testing.assert_allclose(np.asarray(x) / scale, np.asarray(y) / scale, **ROUNDING)


@pytest.fixture(scope="module")
def shell_rollout(start):
    """Return the data after commands, steps and a masked reset of ``Sim``."""
    sim, data, _, _, commands = start
    sim.data = data
    sim.attitude_control(commands[0])
    sim.step(3)
    sim.attitude_control(commands[1])
    sim.step(4)
    sim.reset(MASK)
    sim.attitude_control(commands[2])
    sim.step(3)
    return sim.data


def make_rollout(start, step):
    _, default, _, reset, _ = start

    def function(data, commands):
        data = step(F.attitude_control(data, commands[0]), 3)
        data = step(F.attitude_control(data, commands[1]), 4)
        data = reset(data, default, MASK)
        return step(F.attitude_control(data, commands[2]), 3)

    return function


def test_the_shell_only_calls_the_core(start, shell_rollout):
    _, data, step, _, commands = start
    before = jax.tree.map(jnp.copy, data)
    run = make_rollout(start, lambda d, n: step(d, jnp.int32(n)))  # as Sim.step calls it: any number, one compilation
    assert trees_equal(run(data, commands), shell_rollout)
    assert trees_equal(data, before)
    assert shell_rollout.core.steps[:, 0].tolist() == [10, 3, 10]
    assert shell_rollout.core.episode[:, 0].tolist() == [0, 1, 0]


def test_jit_agrees_with_the_shell(start, shell_rollout):
    """Law 3: commands, steps and a masked reset as one compiled function."""
    _, data, step, _, commands = start
    assert_close(jax.jit(make_rollout(start, step))(data, jnp.asarray(commands)), shell_rollout)


def test_scan_agrees_with_the_shell(start):
    """Law 3: a rollout in ``lax.scan``, a command before every step."""
    sim, data, step, _, commands = start
    commands = np.concatenate([commands, commands[::-1]])

    def body(data, command):
        data = step(F.attitude_control(data, command), 1)
        return data, data.states.pos

    final, track = jax.jit(lambda d, c: jax.lax.scan(body, d, c))(data, jnp.asarray(commands))
    sim.data, expected = data, []
    for command in commands:
        sim.attitude_control(command)
        sim.step()
        expected.append(sim.data.states.pos)
    assert_close(final, sim.data)
    np.testing.assert_allclose(track, np.stack(expected), **ROUNDING)


SHELL_MODULES = ("sim", "configuration")
ARRAY_MODULES = {"jnp", "np", "numpy", "jax", "lax", "rotation", "math"}
ALLOWED_CALLS = {"jnp.asarray", "jax.ensure_compile_time_eval"}
"""Calls that make arrays of host values, also inside a trace; everything else belongs into a pure function."""


def find_arithmetic(source):
    """Return the arithmetic of a module: operators outside ``HOST_ARITHMETIC``, and calls of array functions."""
    result = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.BinOp, ast.AugAssign, ast.UnaryOp)):
            is_union = isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr)  # str | Path
            is_not = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)
            is_negative_number = isinstance(node, ast.UnaryOp) and isinstance(node.operand, ast.Constant)  # -1
            if not (is_union or is_not or is_negative_number or ast.unparse(node) in HOST_ARITHMETIC):
                result.append(ast.unparse(node))
        elif isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            if name.split(".")[0] in ARRAY_MODULES and name not in ALLOWED_CALLS:
                result.append(name)
        elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store):
            result.append(ast.unparse(node))
    return result


HOST_ARITHMETIC = {"self.freq // self.control_freq"}
"""Integer arithmetic on settings that is allowed: the steps of a control step."""


@pytest.mark.parametrize("module", SHELL_MODULES)
def test_the_shell_computes_nothing(module):
    """Law 3: ``Sim`` only calls pure functions, and uses no operators and no array functions."""
    source = inspect.getsource(importlib.import_module(f"crazysim.sim.{module}"))
    assert find_arithmetic(source) == []
    for physics in (dynamics.first_principles, dynamics.fitted):
        assert physics not in vars(importlib.import_module(f"crazysim.sim.{module}")).values()


PHYSICS = (
    "vel = vel + dt * acc",
    "pos += vel",
    "vel = -vel",
    "x = jnp.where(on, a, b)",
    "pos[0] = 1.0",
    "up = r @ thrust",
)


@pytest.mark.parametrize("line", PHYSICS)
def test_the_check_finds_arithmetic(line):
    """The test above can fail: each line is physics that somebody might write into ``Sim``."""
    assert len(find_arithmetic(line)) > 0
    assert find_arithmetic("def f(x: int | None = -1):\n    return not x") == []
