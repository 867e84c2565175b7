"""Steps in Python and kernels that are compiled late, with which the tests save compiling, do what kernels do."""

import jax
import jax.numpy as jnp
import late_kernels
import numpy as np
import pytest
import python_steps
from blocks import program_of
from cases import shared_sim, with_states
from rule_cases import CASES, N_LANES, RANDOM, function, given, of_one
from test_rules import lanes_of

from crazysim import Downwash, Sim
from crazysim.core.stage import as_stages, stage
from crazysim.engine import interpret, kernel_cache, lanes, native
from crazysim.engine.build import build_program
from crazysim.engine.fused import build
from crazysim.engine.fused_rollout import FusedRollout
from crazysim.engine.lower import lower_function
from crazysim.jaxcompat import is_key

PLACES = np.random.default_rng(1).normal(size=(40, 3)).astype(np.float32)


def same(program, leaves, n_steps):
    """Check that a function of scalars gives the numbers that the interpreter gives."""
    leaves = [None if x is None else np.asarray(jax.random.key_data(x) if is_key(x) else x) for x in leaves]
    found, flagged = python_steps.Function(program)(leaves, n_steps, lanes.batch(program, leaves)[0])
    expected, flags = interpret._steps(program, leaves, n_steps)
    np.testing.assert_array_equal(flagged, flags)
    for i, x, y in zip(program.written, found, expected, strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y, program.leaves[i].name)


@pytest.mark.parametrize("name", [*CASES, *RANDOM])
def test_a_case_gives_the_numbers_of_the_interpreter(name):
    g = given()
    same(*program_of(lower_function(function(name), of_one(g)), lanes_of(g), N_LANES), 1)


def with_packed(program, leaves):
    """Return leaves with the one that passes add, if they did."""
    return [*leaves, *([jnp.concatenate([leaves[i].ravel() for i in program.packed])] if program.packed else [])]


@pytest.mark.parametrize("plugins, group", [((), 1), ((Downwash(),), 3)], ids=["alone", "together"])
def test_steps_of_drones_are_those_of_the_interpreter(plugins, group):
    """Of drones that do not know of each other, and of a world whose drones read each other's numbers."""
    sim = Sim(n_worlds=2, n_drones=3)
    for plugin in plugins:
        sim.add(plugin)
    program = build_program(as_stages(sim.step_pipeline), sim.data, watched=lambda data: jax.tree.leaves(data.states))
    assert program.group == group
    same(program, with_packed(program, jax.tree.leaves(sim.data)), 4)


def test_stages_of_worlds_step_all_drones():
    @stage(scope="world")
    def gather_up(data):
        pos = data.states.pos
        return data.replace(states=data.states.replace(pos=pos + 0.1 * (pos.mean(axis=0) - pos)))

    pos = np.random.default_rng(0).normal(size=(2, 3, 3))
    pos[1, 2, 0] = np.inf
    data = with_states(shared_sim(n_worlds=2, n_drones=3).data, pos=pos)
    program = build_program([gather_up], data, watched=lambda data: [data.states.pos])
    assert program.group == 3
    same(program, with_packed(program, jax.tree.leaves(data)), 3)


def test_stages_before_and_after_the_steps_on_rows_and_a_table():
    """As in a whole step of an environment, of which some leaves are rows."""

    @stage(scope="drone")
    def begin(data):
        vel = data.states.vel + jnp.asarray(PLACES)[jnp.int32(data.states.pos[0]) % len(PLACES)]
        return data.replace(states=data.states.replace(vel=vel))

    @stage(scope="drone")
    def move(data):
        return data.replace(states=data.states.replace(pos=data.states.pos + 0.5 * data.states.vel))

    @stage(scope="drone")
    def end(data):
        return data.replace(states=data.states.replace(ang_vel=data.states.pos**-2))

    pos = 3 * np.random.default_rng(0).normal(size=(3, 2, 3))
    data = with_states(shared_sim(n_worlds=3, n_drones=2).data, pos=pos)
    whole = FusedRollout([begin], [move], [end], data, {}, 2, "cpu", rows=lambda written: written[1:])
    leaves = jax.tree.leaves(data)
    given = [leaves[i] if i in whole.read else None for i in range(len(leaves))]
    assert whole.program.rows
    assert {segment.phase for segment in whole.program.segments} == {"first", "each", "last"}
    same(whole.program, [*given, *whole.shared(leaves), *whole.pack(leaves)], 2)


@pytest.mark.skipif(not native.compiler(), reason="needs a C++ compiler")
def test_a_kernel_is_compiled_when_it_is_worth_it(monkeypatch):
    """Called by XLA: in Python at first, with the same results afterwards."""
    monkeypatch.setattr(late_kernels, "active", True)
    monkeypatch.setattr(kernel_cache, "find", lambda *_: [])
    compiled, library = [], late_kernels.LIBRARY
    monkeypatch.setattr(late_kernels, "LIBRARY", lambda *given: compiled.append(given) or library(*given))
    block = lower_function(lambda x: (x[0] * 2 + 17, x[1] > 1), np.zeros(2, np.float32))
    program, leaves = program_of(block, [np.float32([1, 2, 3]), np.float32([0, 1, 2])], 3)
    run = build(program, "cpu")
    call = jax.jit(lambda leaves: run(leaves, 1)[0]).lower(leaves).compile()
    first = call(leaves)
    assert not compiled
    (late,) = [x for x in native._LOADED.values() if isinstance(x, late_kernels.Late) and x.program is program]
    late.left = 0
    for x, y in zip(first, call(leaves), strict=True):
        np.testing.assert_array_equal(x, y)
    assert len(compiled) == 1
    np.testing.assert_array_equal(first[0][:, 0], [19, 21, 23])


def test_worlds_of_another_size_are_stepped_by_the_kernel(monkeypatch):
    """Programs of worlds with one and with three drones have one source here, and so one kernel."""
    monkeypatch.setattr(late_kernels, "active", True)
    block = lower_function(lambda x: x * 2 + 23, np.float32(0))
    program, leaves = program_of(block, [np.float32([1, 2, 3])], 3)
    late = late_kernels.Late(program, late_kernels.write(program, "host"), lambda: 1 / 0)
    numbers = [np.asarray(leaves[i]) for i in late.source.inputs]
    out = [np.zeros((3, 1), np.float32)]
    late.call([np.int32([3]), np.int32([1]), *numbers], out)
    np.testing.assert_array_equal(out[0][:, 0], [25, 27, 29])
    with pytest.raises(ZeroDivisionError):  # as it compiles
        late.call([np.int32([3]), np.int32([1]), *(x.reshape(1, 3) for x in numbers)], [out[0].reshape(1, 3)])
