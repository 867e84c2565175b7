"""Passes: programs compute the same numbers with less work, and are well formed after each pass."""

import dataclasses

import jax
import numpy as np
import pytest
from cases import shared_sim

from crazysim.engine.backends import interpret
from crazysim.engine.ir.blocks import Builder, Operation, Value
from crazysim.engine.ir.program import Leaf, Program, Segment
from crazysim.engine.ir.verify import VerificationError, verify
from crazysim.engine.jaxcompat import is_key
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.passes import schedule
from crazysim.engine.stage import as_stages

N_WORLDS = 5
F32 = np.float32


def numbers_by_slot(program, leaves):
    numbers = {}
    for i, x in enumerate(leaves):
        leaf, x = program.leaves[i], np.asarray(jax.random.key_data(x) if is_key(x) else x)
        columns = x.reshape(N_WORLDS, -1).T if leaf.scope in ("drone", "world") else x.ravel()
        numbers |= {(i, k): column for k, column in enumerate(columns)}
    return numbers


def run_program(program, numbers, n_steps):
    numbers = dict(numbers)
    shape = (N_WORLDS,)
    hoisted = {
        id(s): interpret.run_block(s.hoisted, [numbers[slot] for slot in s.hoisted_reads], shape)
        for s in program.segments
    }
    for phase, times in (("before", 1), ("each", n_steps), ("after", 1)):
        for _ in range(times):
            for s in program.phase_segments(phase):
                out = interpret.run_block(s.block, [*(numbers[slot] for slot in s.reads), *hoisted[id(s)]], shape)
                numbers.update(zip(s.writes, out, strict=True))
    return numbers


@pytest.fixture(scope="module")
def pipeline():
    sim = shared_sim(n_worlds=N_WORLDS, n_drones=1, control="state", state_freq=100)
    program = lower_stages(as_stages(sim.step_pipeline), sim.data)
    rng = np.random.default_rng(0)
    numbers = numbers_by_slot(program, jax.tree.leaves(sim.data))
    for slot, x in numbers.items():
        if program.leaves[slot[0]].scope == "drone" and x.dtype == np.float32:
            numbers[slot] = (x + 0.3 * rng.normal(size=x.shape)).astype(np.float32)
    return verify(program), numbers


def test_hoisting_takes_work_out_of_the_loop(pipeline):
    """Results are equal up to the rounding of a product with an inverse instead of a division."""
    program, numbers = pipeline
    fused = schedule.fuse(program)
    hoisted = verify(schedule.hoist(fused))
    (before,), (after,) = fused.segments, hoisted.segments
    assert after.hoisted.outputs
    assert after.n_operations < before.n_operations
    assert {"cos", "sin", "div"} & {op.name for op in after.hoisted.operations}
    assert hoisted.changing_slots().isdisjoint(after.hoisted_reads)
    expected, result = run_program(fused, numbers, 3), run_program(hoisted, numbers, 3)
    for slot, x in expected.items():
        np.testing.assert_allclose(result[slot], x, rtol=2e-4, atol=2e-5, err_msg=str(slot))


def test_barriers_separate_runs_of_operations_and_change_no_number(pipeline):
    program, numbers = pipeline
    fused = schedule.fuse(program)
    separated = verify(schedule.add_barriers(fused))
    (before,), (after,) = fused.segments, separated.segments
    names = [op.name for op in after.block.operations]
    runs = "".join("|" if name == "barrier" else "." for name in names).split("|")
    assert max(map(len, runs)) == schedule.BARRIER_INTERVAL
    assert [name for name in names if name != "barrier"] == [
        op.name for op in before.block.operations if op.name != "barrier"
    ]
    expected, result = run_program(fused, numbers, 3), run_program(separated, numbers, 3)
    for slot, x in expected.items():
        np.testing.assert_array_equal(result[slot], x, err_msg=str(slot))


# Programs of a few numbers ------------------------------------------------------------------------------------------

X, Y, Z, SHARED = (0, 0), (1, 0), (2, 0), (3, 0)
LEAVES = tuple(Leaf(name, "drone", (N_WORLDS, 1), np.dtype(np.float32)) for name in "xyz") + (
    Leaf("shared", "shared", (1,), np.dtype(np.float32)),
)


def segment(name, reads, writes, fn, scope="drone", phase="each"):
    b = Builder(stage=name)
    inputs = [b.input(LEAVES[leaf].dtype) for leaf, _ in reads]
    return Segment(scope, (name,), phase, b.finish(fn(b, *inputs)), tuple(reads), tuple(writes))


def apply_fn(name):
    return lambda b, *args: [b.add(name, args, np.float32)]


def guarded_segment(name, reads, write, fn, limit=0):
    b = Builder(stage=name)
    x, old, *rest = [b.input(np.float32) for _ in [X, write, *reads]]
    inner = Builder(b)
    block = inner.finish([fn(inner, *rest)])
    mask = b.add("gt", (x, np.float32(limit)), bool)
    new = b.add_many("when", (mask, old), (np.float32,), (), (block,))
    return Segment("drone", (name,), "each", b.finish(new), (X, write, *reads), (write,))


@pytest.mark.parametrize("result", [Y, Z])
def test_stages_of_the_same_ticks_are_joined(result):
    """The second stage reads a number that the first writes, and may write it too. Other worlds do not change."""
    half = guarded_segment("half", [SHARED], Y, lambda b, x: b.add("mul", (x, np.float32(0.5)), np.float32))
    sine = guarded_segment("sine", [Y, SHARED], result, lambda b, y, x: b.add("add", (b.add("sin", (y,), F32), x), F32))
    fused = schedule.fuse(Program(LEAVES, 1, (half, sine)))
    joined = verify(schedule.join_ticks(fused))
    assert [op.name for op in fused.segments[0].block.operations].count("when") == 2
    assert [op.name for op in joined.segments[0].block.operations].count("when") == 1
    x = np.array([-1, 1, 0, 2, -3], np.float32)
    numbers = {X: x, Y: x + 10, Z: x + 20, SHARED: np.float32(3)}
    expected, with_joined = run_program(fused, numbers, 2), run_program(joined, numbers, 2)
    assert all((with_joined[slot] == expected[slot]).all() for slot in (X, Y, Z))
    assert (with_joined[result] == np.where(x > 0, np.sin(np.float32(1.5)) + np.float32(3), numbers[result])).all()


def test_the_inverse_of_a_number_is_computed_once():
    def body(b, x, shared):
        quotients = [b.add("div", (x, y), np.float32) for y in (shared, np.float32(0.0), np.float32(-0.0))]
        again = b.add("div", (quotients[0], shared), np.float32)
        return [again, quotients[1], quotients[2]]

    program = Program(LEAVES, 1, (segment("a", [X, SHARED], [X, Y, Z], body),))
    (after,) = verify(schedule.hoist(program)).segments
    assert [x.name for x in after.hoisted.operations] == ["div"]
    assert [x.name for x in after.block.operations] == ["mul"] * 4
    numbers = {X: np.full(N_WORLDS, 3.0, np.float32), SHARED: np.float32(2.0)}
    result = run_program(schedule.hoist(program), numbers, 1)
    assert [result[slot][0] for slot in (X, Y, Z)] == [0.75, np.inf, -np.inf]


# Verification -------------------------------------------------------------------------------------------------------


def broken_program(**changes):
    good = segment("a", [X], [Y], apply_fn("exp"))
    return Program(LEAVES, 1, (dataclasses.replace(good, **changes),))


def program_with_operations(fn):
    b = Builder(stage="a")
    x = b.input(np.float32)
    return broken_program(block=dataclasses.replace(b.finish([x]), operations=tuple(fn(x)), outputs=(x,)))


def new_value(dtype=np.float32):
    return Value(np.dtype(dtype))


WELL_FORMED = segment("a", [X], [Y], apply_fn("exp"))
BROKEN_PROGRAMS = {
    "used before it is defined": (
        broken_program(block=dataclasses.replace(WELL_FORMED.block, outputs=(new_value(),))),
        "before it is defined",
    ),
    "operand of another block": (
        program_with_operations(lambda x: [Operation("exp", (new_value(),), (new_value(),))]),
        "'exp' uses a value",
    ),
    "defined twice": (
        program_with_operations(lambda x: [Operation("exp", (x,), (y := new_value(),)), Operation("neg", (x,), (y,))]),
        "defined twice",
    ),
    "mixed operands": (
        program_with_operations(lambda x: [Operation("add", (x, np.int32(1)), (new_value(),))]),
        "'add' of float32, int32",
    ),
    "result type": (program_with_operations(lambda x: [Operation("lt", (x, x), (new_value(),))]), "'lt' of float32,"),
    "float logic": (program_with_operations(lambda x: [Operation("not", (x,), (new_value(),))]), "'not' of float32"),
    "unknown operation": (program_with_operations(lambda x: [Operation("fft", (x,), (new_value(),))]), "'fft' is not"),
    "half precision": (
        program_with_operations(lambda x: [Operation("neg", (np.float16(1),), (new_value(np.float16),))]),
        "type that the engine",
    ),
    "too few inputs": (broken_program(reads=()), "1 further inputs for 0 hoisted"),
    "too many outputs": (broken_program(writes=(Y, Z)), "1 outputs for 2 slots"),
    "slot read twice": (broken_program(reads=(X, X)), "1 inputs for 2 slots"),
    "slot out of range": (broken_program(writes=((1, 1),)), "output 1 of y, which has 1 numbers"),
    "hoisted number changes": (
        broken_program(writes=(X,), hoisted_reads=(X,), hoisted=WELL_FORMED.block),
        "further inputs for 1 hoisted",
    ),
}
"""Programs and words of the error, by the defect."""


@pytest.mark.parametrize("defect", BROKEN_PROGRAMS)
def test_verification_finds_each_defect(defect):
    program, message = BROKEN_PROGRAMS[defect]
    with pytest.raises(VerificationError, match=message):
        verify(program)


def test_verification_finds_phases_out_of_order():
    late, early = (
        segment("a", [X], [Y], apply_fn("exp"), phase="after"),
        segment("b", [X], [Y], apply_fn("exp")),
    )
    with pytest.raises(VerificationError, match="order of their phases"):
        verify(Program(LEAVES, 1, (late, early)))


# Stages to programs -------------------------------------------------------------------------------------------------


def test_zeros_of_shared_parameters_are_no_inputs():
    sim = shared_sim(n_worlds=N_WORLDS, n_drones=1, control="rotor_vel")
    stages = as_stages(sim.step_pipeline)
    names = [leaf.name for leaf in lower_stages(stages, sim.data).leaves]
    J = names.index("params.J")
    known = lower_stages(stages, sim.data, {J: frozenset({1, 2, 3, 5, 6, 7})})
    assert {k for s in known.segments for i, k in s.reads if i == J} <= {0, 4, 8}
    assert sum(s.n_operations for s in known.segments) < sum(
        s.n_operations for s in lower_stages(stages, sim.data).segments
    )


def test_phases_and_scopes_are_not_joined():
    stages = [
        segment("a", [X], [Y], apply_fn("exp"), phase="before"),
        segment("b", [Y], [Z], apply_fn("neg")),
        segment("c", [Z], [X], apply_fn("exp"), scope="world"),
        segment("d", [X], [Y], apply_fn("exp")),
    ]
    assert len(schedule.fuse(Program(LEAVES, 1, tuple(stages))).segments) == 4


def test_stages_of_other_ticks_are_not_joined():
    """The third has the ticks of the first, which the second separates from it."""
    first, second, third = (
        guarded_segment(f"stage{i}", [SHARED], write, lambda b, x: b.add("sin", (x,), F32), limit)
        for i, (write, limit) in enumerate([(Y, 0), (Z, 1), (Y, 0)])
    )
    joined = schedule.join_ticks(schedule.fuse(Program(LEAVES, 1, (first, second, third))))
    assert [op.name for op in joined.segments[0].block.operations].count("when") == 3


def test_a_changed_clock_gives_other_ticks():
    first = guarded_segment("first", [], Y, lambda b: np.float32(1))
    between = segment("between", [Y], [X], apply_fn("neg"))
    second = guarded_segment("second", [Y], Z, lambda b, y: b.add("sin", (y,), F32))
    joined = schedule.join_ticks(schedule.fuse(Program(LEAVES, 1, (first, between, second))))
    assert [op.name for op in joined.segments[0].block.operations].count("when") == 2
