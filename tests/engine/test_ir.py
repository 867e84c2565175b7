"""Blocks and their builder."""

import numpy as np

from crazysim.engine.ir.blocks import Builder

F = np.float32


def test_a_common_subexpression_is_computed_once():
    b = Builder()
    x, y = b.input(F), b.input(F)
    first, again, other = b.add("add", (x, y), F), b.add("add", (x, y), F), b.add("add", (y, x), F)
    assert first is again
    assert first is not other
    assert len(b.finish([first, again, other]).operations) == 2


def test_an_inner_block_uses_results_of_the_block_around_it():
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
