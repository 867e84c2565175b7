"""Blocks: built once, never changed."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.engine.backends import interpret
from crazysim.engine.ir import blocks
from crazysim.engine.ir.blocks import Builder
from crazysim.engine.ir.verify import verify_block

pytestmark = pytest.mark.fast

F = np.float32


def values_of(block, *inputs):
    return [x.item() for x in interpret.run(block, [F(x) for x in inputs], ())]


def test_a_common_subexpression_is_computed_once():
    b = Builder()
    x, y = b.input(F), b.input(F)
    first, again, other = b.add("add", (x, y), F), b.add("add", (x, y), F), b.add("add", (y, x), F)
    assert first is again
    assert first is not other
    assert len(b.finish([first, again, other]).operations) == 2


def test_an_inner_block_uses_what_is_computed_around_it():
    b = Builder()
    x = b.input(F)
    outside = b.add("sin", (x,), F)
    inner = Builder(b)
    assert inner.add("sin", (x,), F) is outside
    fresh = inner.add("cos", (x,), F)
    assert b.add("cos", (x,), F) is not fresh  # what the block computes is not defined outside


def test_zeros_of_both_signs_are_different_constants():
    b = Builder()
    x = b.input(F)
    assert b.add("atan2", (F(0.0), x), F) is not b.add("atan2", (F(-0.0), x), F)
    assert b.add("atan2", (F(np.nan), x), F) is b.add("atan2", (F(np.nan), x), F)


def test_an_operation_has_any_number_of_results():
    b = Builder()
    words = [b.input(np.uint32) for _ in range(4)]
    first, second = b.add_many("threefry2x32", words, (np.uint32, np.uint32))
    assert b.add_many("threefry2x32", words, (np.uint32, np.uint32)) == (first, second)
    assert len(verify_block(b.finish([second])).operations) == 1


def test_a_block_does_not_change():
    block = Builder().finish([])
    with pytest.raises(dataclasses.FrozenInstanceError):
        block.outputs = ()
    with pytest.raises(dataclasses.FrozenInstanceError):
        blocks.Value(np.dtype(F)).dtype = np.dtype(int)
    with pytest.raises(AttributeError):
        blocks.Operation("add", (), ()).name = "sub"


def test_an_operation_that_is_not_in_the_table_is_a_defect():
    b = Builder()
    with pytest.raises(KeyError, match=r"'convolve' is not in ops\.TABLE"):
        b.add("convolve", (b.input(F),), F)


def test_pruning_keeps_what_outputs_need_and_nothing_else():
    b = Builder()
    x, y = b.input(F), b.input(F)
    used = b.add("exp", (x,), F)
    b.add("log", (y,), F)
    block = blocks.prune(b.finish([used]), keep_inputs=False)
    assert [op.name for op in block.operations] == ["exp"]
    assert block.inputs == (x,)
    assert blocks.prune(b.finish([used])).inputs == (x, y)


def test_pruning_looks_into_inner_blocks():
    b = Builder()
    x, mask = b.input(F), b.input(bool)
    outside = b.add("exp", (x,), F)
    inner = Builder(b)
    inner.add("cos", (x,), F)
    block = inner.finish([inner.add("sin", (outside,), F)])
    (new,) = b.add_many("when", (mask, x), (F,), (), (block,))
    pruned = blocks.prune(b.finish([new]))
    assert [op.name for op in pruned.walk()] == ["exp", "when", "sin"]


def test_substitution_replaces_operands_everywhere():
    b = Builder()
    x, mask = b.input(F), b.input(bool)
    inner = Builder(b)
    block = inner.finish([inner.add("neg", (x,), F)])
    (new,) = b.add_many("when", (mask, x), (F,), (), (block,))
    replaced = blocks.substitute(b.finish([new, x]), {x: F(3.0)})
    np.testing.assert_array_equal(interpret.run(replaced, [F(1.0), np.bool_(True)], ()), [-3.0, 3.0])


def test_inlining_simplifies_by_what_is_known():
    inner = Builder()
    x, y = inner.input(F), inner.input(F)
    block = inner.finish([inner.add("mul", (inner.add("add", (x, F(1)), F), y), F)])
    b = Builder()
    z = b.input(F)
    (out,) = blocks.inline(b, block, {x: F(2.0), y: z})
    assert [(op.name, op.args[0]) for op in b.finish([out]).operations] == [("mul", F(3.0))]
    assert values_of(b.finish([out]), 5.0) == [15.0]


def test_arrays_are_elements_in_row_major_order():
    from crazysim.engine.lowering.jaxprs import as_elements, constants, scalars

    elements = constants(jnp.arange(6.0).reshape(2, 3), F)
    assert elements.shape == (2, 3)
    assert [float(x) for x in scalars(elements.T)] == [0, 3, 1, 4, 2, 5]
    assert scalars(as_elements([(1, 2), (3, 4)], (2,))) == [1, 2, 3, 4]
