"""A builder simplifies operations only by identities that hold for every number.

A known zero is a zero of a shared parameter: its products may be left out, even if the other number could be infinite.
"""

import numpy as np
import pytest

from crazysim.engine.ir.algebra import known_zero, simplify
from crazysim.engine.ir.blocks import Builder

F = np.float32


def build_operation(name, *args, dtype=F):
    """Return the result of an operation, the input that replaces ``...`` in ``args``, and the number of operations."""
    b = Builder()
    x = b.input(dtype)
    out = b.add(name, [x if a is ... else a for a in args], dtype)
    return out, x, len(b.operations)


@pytest.mark.parametrize(
    "name, args",
    [
        ("add", (..., F(0))),
        ("add", (F(0), ...)),
        ("sub", (..., F(0))),
        ("mul", (..., F(1))),
        ("mul", (F(1), ...)),
        ("div", (..., F(1))),
        ("convert_element_type", (...,)),
        ("bitcast_convert_type", (...,)),
        ("select_n", (np.bool_(True), F(3), ...)),
    ],
)
def test_neutral_elements_are_left_out(name, args):
    out, x, n = build_operation(name, *args)
    assert out is x
    assert n == 0


@pytest.mark.parametrize("dtype", [F, np.float64])
def test_a_term_with_a_known_zero_is_removed(dtype):
    zero = known_zero(dtype)
    product, _, n = build_operation("mul", zero, ..., dtype=dtype)
    assert (product.dtype, float(product), n) == (dtype, 0.0, 0)
    assert build_operation("add", product, ..., dtype=dtype)[2] == 0
    assert build_operation("div", product, ..., dtype=dtype)[2] == 0
    assert build_operation("mul", build_operation("neg", product, dtype=dtype)[0], ..., dtype=dtype)[2] == 0
    assert build_operation("sub", zero, ..., dtype=dtype)[2] == 1  # the sign of the other operand changes
    assert build_operation("div", ..., zero, dtype=dtype)[2] == 1


@pytest.mark.parametrize(
    "name, args, expected",
    [
        ("div", (7, -2), -3),
        ("div", (-7, 2), -3),
        ("div", (5, 0), -1),
        ("div", (-(2**31), -1), -(2**31)),
        ("rem", (-7, 2), -1),
        ("rem", (5, 0), 5),
        ("shift_left", (1, 33), 0),
        ("shift_right_arithmetic", (-8, 40), -1),
        ("shift_right_logical", (-1, 1), 2**31 - 1),
        ("abs", (-(2**31),), -(2**31)),
    ],
)
def test_integers_fold_as_xla_computes_them(name, args, expected):
    args = tuple(np.int32(x) for x in args)
    assert simplify(name, args, np.dtype(np.int32), ()) == expected


@pytest.mark.parametrize(
    "x, dtype, expected",
    [
        (np.nan, np.int32, 0),
        (np.inf, np.int32, 2**31 - 1),
        (-3e9, np.int32, -(2**31)),
        (-1.5, np.uint32, 0),
        (5e9, np.uint32, 2**32 - 1),
        (-1.9, np.int32, -1),
        (300.0, np.uint8, 255),
        (1e30, np.int64, 2**63 - 1),
        (-0.0, bool, False),
        (np.nan, bool, True),
    ],
)
def test_conversions_fold_as_xla_computes_them(x, dtype, expected):
    assert simplify("convert_element_type", (F(x),), np.dtype(dtype), ()) == expected


def test_angles_of_zero_are_exact():
    expected = {"sin": 0.0, "cos": 1.0}
    assert {name: simplify(name, (F(0),), np.dtype(F), ()) for name in expected} == expected
    assert simplify("atan2", (F(0), F(2)), np.dtype(F), ()) == 0
    assert simplify("atan2", (F(0), F(-2)), np.dtype(F), ()) is None
    assert simplify("sin", (F(1),), np.dtype(F), ()) is None
