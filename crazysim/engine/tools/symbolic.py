"""CasADi expressions of a block: every value is an expression of single numbers.

CasADi computes in float64, whatever types the program has. Integers are whole numbers in float64. In arithmetic, only
unsigned sums and differences wrap around. Numbers are assumed not to be NaN, so tests for NaN are false.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir import ops
from crazysim.engine.ir.blocks import Block, Element, Operation, Value
from crazysim.engine.ir.program import Segment, Slot

RANDOM_REASON = "it draws random numbers"
"""Reason why a stage with random numbers has no expressions."""

Expression = Any
"""A ``casadi.SX`` of one number."""

MAX_ITERATIONS = 256
"""Maximum number of iterations of a loop that is unrolled."""


def step_expressions(segment: Segment, get_number: Callable[[Slot], Expression]) -> dict[Slot, Expression]:
    """Return the expressions that a step writes.

    Args:
        segment: A segment of one drone.
        get_number: Function that returns the number in a slot before the step.

    Raises:
        UnsupportedError: If CasADi has no form for an operation; the error names the stage.
    """
    require_casadi(segment.hoisted)
    require_casadi(segment.block)
    hoisted = run_block(segment.hoisted, [get_number(slot) for slot in segment.hoisted_reads])
    outputs = run_block(segment.block, [*(get_number(slot) for slot in segment.reads), *hoisted])
    return dict(zip(segment.writes, outputs, strict=True))


def require_casadi(block: Block) -> None:
    """Raise ``UnsupportedError`` unless CasADi has a form for all operations of a block."""
    refused = [(op.stage, reason) for op in block.walk() if (reason := _refusal_reason(op)) is not None]
    if refused:
        random_draws = [(stage, reason) for stage, reason in refused if reason == RANDOM_REASON]
        stage, reason = (random_draws or refused)[0]  # random numbers are the most informative reason
        raise UnsupportedError(reason, stage=stage)


def _refusal_reason(op: Operation) -> str | None:
    match op.name:
        case "threefry2x32":
            return RANDOM_REASON
        case "while":
            return "a loop that runs until a condition fails cannot be unrolled"
        case "lookup":
            return "it looks a number up in a table, at a place that is computed"
        case "loop" if op.param("length") > MAX_ITERATIONS:
            return f"a loop of {op.param('length')} iterations is too long; at most {MAX_ITERATIONS} are unrolled"
    row = ops.TABLE[op.name]
    if row.structured or op.name == "convert_element_type":
        return None
    shared_type = next((x.dtype for x, letter in zip(op.args, row.operands, strict=True) if letter == "T"), op.dtype)
    if row.casadi is None or shared_type.kind not in row.casadi_kinds:
        return f"operation {op.name!r} on {shared_type.name} has no form in CasADi"
    return None


def run_block(block: Block, inputs: Sequence[Expression]) -> list[Expression]:
    """Return the outputs of a block whose operations all have a form in CasADi."""
    return _Interpreter().run(block, inputs)


class _Interpreter:
    """Interpreter that computes the expressions of values."""

    def __init__(self) -> None:
        import casadi  # an extra

        self.casadi = casadi
        self.env: dict[Value, Expression] = {}
        self.in_custom_jvp = False

    def run(self, block: Block, inputs: Sequence[Expression]) -> list[Expression]:
        self.env.update(zip(block.inputs, inputs, strict=True))
        for op in block.operations:
            if op.name != "barrier":
                self.env.update(zip(op.results, self._results(op, [self._element(x) for x in op.args]), strict=True))
        return [self._element(x) for x in block.outputs]

    def _element(self, x: Element) -> Expression:
        return self.env[x] if isinstance(x, Value) else self.casadi.SX(float(x))

    def _results(self, op: Operation, args: list[Expression]) -> list[Expression]:
        match op.name:
            case "when":
                mask, *old_values = args
                new_values = self.run(op.blocks[0], [])
                return [self.casadi.if_else(mask, x, y) for x, y in zip(new_values, old_values, strict=True)]
            case "loop":
                for _ in range(op.param("length")):
                    args = self.run(op.blocks[0], args)
                return args
            case "any_lane":
                return args
            case "custom_jvp":
                was_in_custom_jvp, self.in_custom_jvp = self.in_custom_jvp, True
                outputs = self.run(op.blocks[0], args)
                self.in_custom_jvp = was_in_custom_jvp
                return outputs
            case "convert_element_type":
                return [self._convert(op, args[0])]
            case "sqrt" if self.in_custom_jvp:
                return [self._guarded_sqrt(args[0])]
        form = ops.TABLE[op.name].casadi
        if form is None:
            raise UnsupportedError(f"operation {op.name!r} has no form in CasADi", stage=op.stage)
        is_name = isinstance(form, str)
        result = getattr(self.casadi, form)(*args) if is_name else form(self.casadi, *args, **dict(op.params))
        if op.name == "div" and op.dtype.kind in "iu":
            return [self._round_towards_zero(result)]
        return [self._wrap(result) if op.dtype.kind == "u" and op.name in ("add", "sub") else result]

    def _convert(self, op: Operation, x: Expression) -> Expression:
        old_type, new_type = op.args[0].dtype, op.dtype
        if new_type.kind == "b":
            return x != 0
        if new_type.kind not in "iu" or old_type.kind == "b":
            return x
        limits = np.iinfo(new_type)
        if old_type.kind == "f":
            return self.casadi.fmin(self.casadi.fmax(self._round_towards_zero(x), limits.min), limits.max)
        is_in_range = np.iinfo(old_type).min >= limits.min and np.iinfo(old_type).max <= limits.max
        return x if is_in_range else self._wrap(x, float(limits.min), 2.0 ** (8 * new_type.itemsize))

    def _wrap(self, x: Expression, low: float = 0.0, length: float = 2.0**32) -> Expression:
        return x - length * self.casadi.floor((x - low) / length)

    def _round_towards_zero(self, x: Expression) -> Expression:
        return self.casadi.if_else(x < 0, self.casadi.ceil(x), self.casadi.floor(x))

    def _guarded_sqrt(self, x: Expression) -> Expression:
        # It is used in functions with a custom derivative, such as norms, whose arithmetic has an infinite derivative
        # at zero.
        ca = self.casadi
        return ca.if_else(x > 0, ca.sqrt(ca.if_else(x > 0, x, 1.0)), 0.0)
