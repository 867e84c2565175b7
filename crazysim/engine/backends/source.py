"""C++ and CUDA source of a block.

A value becomes a variable that is assigned once. An operation becomes an operator or a call of an inline function. A
preamble for each target (``targets/``) defines types and functions; the source of a block is the same for both targets.
"""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import DTypeLike

from crazysim.engine.backends.exchange import Exchange, LineWriter, Registers
from crazysim.engine.backends.uniform import is_shared, shared_carry, shared_results
from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir import ops
from crazysim.engine.ir.blocks import Block, Element, Operation, Value, is_constant

TYPE_NAMES = {np.dtype(name): short for name, short in
         {"float32": "f32", "float64": "f64", "int32": "i32", "uint32": "u32", "bool": "b1"}.items()}  # fmt: skip
"""Names of the types of numbers in the source."""


def require_block_source(block: Block) -> None:
    """Raise an error unless all operations and types of a block can be written as source.

    Raises:
        UnsupportedError: If an operation or type has no source; the error names the stage.
    """
    for op in block.walk():
        row = ops.TABLE[op.name]
        unsupported = next((x.dtype.name for x in (*op.args, *op.results) if x.dtype not in TYPE_NAMES), None)
        if unsupported is not None:
            raise UnsupportedError(f"kernels have no numbers of type {unsupported}", op.name, op.stage)
        if not row.source and not row.structured:
            raise UnsupportedError("kernels have no such operation", op.name, op.stage)


INDENT = "  "
"""Indentation of one depth."""

EntryGroup = tuple[Element, Element, int]
"""Group of four neighbouring table entries that a target reads at once: table, index, and number of the group."""


class Writer(LineWriter):
    """Writer of the source of blocks, line by line."""

    def __init__(self, exchange: Exchange | None = None) -> None:
        self.exchange = Registers() if exchange is None else exchange
        self.lines: list[str] = []
        self.names: dict[Value, str] = {}
        self.shared: set[Value] = set()
        """Values that are scalar variables, because all lanes share them."""
        self.sin_cos_names: dict[str, str] = {}
        """Prefix of the variables that hold sine and cosine of an expression."""
        self.comparisons: dict[Value, Operation] = {}
        """Comparisons by their results."""
        self.tables: list[str] = []
        """Lines with tables of constants, which stand before the kernel."""
        self.entry_groups: dict[EntryGroup, str] = {}
        """Variable of each group of four table entries that is read at once; empty before the first read."""
        self._count = 0

    def new_name(self, prefix: str = "v") -> str:
        self._count += 1
        return f"{prefix}{self._count}"

    def write_line(self, text: str, depth: int) -> None:
        self.lines.append(INDENT * depth + text)

    def write_block(self, block: Block, inputs: Sequence[str], depth: int) -> list[str]:
        self.names.update(zip(block.inputs, inputs, strict=True))
        outer_state = dict(self.sin_cos_names), self.entry_groups  # variables of a block are not defined outside it
        self.entry_groups = dict.fromkeys(_entry_groups(block), "")
        for position, op in enumerate(block.operations):
            if op.name == "over_others":
                self._write_over_others(op, depth, _live_values(block, position))
                self.shared.clear()  # values for later code are stored for each lane
            else:
                self._write_operation(op, depth)
                self.shared.update(shared_results(op, self.shared))
        self.sin_cos_names, self.entry_groups = outer_state
        return [self.element(x) for x in block.outputs]

    def forget_intermediate_results(self) -> None:
        self.sin_cos_names, self.entry_groups = {}, dict.fromkeys(self.entry_groups, "")

    def element(self, x: Element) -> str:
        return self.names[x] if isinstance(x, Value) else literal(x)

    def _write_operation(self, op: Operation, depth: int) -> None:
        args = [self.element(a) for a in op.args]
        match op.name:
            case "barrier":
                pass
            case "when":
                self._write_when(op, args, depth)
            case "loop":
                self._write_loop(op, args, depth)
            case "while":
                self._write_while(op, args, depth)
            case "threefry2x32":
                name = self._name_results(op)
                self.write_line(f"auto {name}_0 = u32_lanes({args[2]}), {name}_1 = u32_lanes({args[3]});", depth)
                self.write_line(f"threefry2x32({args[0]}, {args[1]}, {name}_0, {name}_1);", depth)
            case "table":
                self._write_table(op)
            case "lookup":
                self._write_lookup(op, args, depth)
            case "any_lane":
                name = self.names[op.results[0]] = self.new_name()
                self.write_line(f"const auto {name} = any_lane({args[0]});", depth)
            case "sin" | "cos":
                self._write_sin_cos(op, args[0], depth)
            case "custom_jvp":  # a separate kernel computes its derivative
                outs = self.write_block(op.blocks[0], args, depth)
                name = self._name_results(op)
                for k, out in enumerate(outs):
                    self.write_line(f"const auto {name}_{k} = {out};", depth)
            case _:
                if op.name in ("lt", "gt"):
                    self.comparisons[op.results[0]] = op
                function = _limiting_function(op, self.comparisons)
                text = expression(op, args) if function is None else f"{function}({args[1]}, {args[2]})"
                name = self.names[op.results[0]] = self.new_name()
                self.write_line(f"const auto {name} = {text};", depth)

    def _name_results(self, op: Operation, name: str | None = None) -> str:
        name = name or self.new_name()
        self.names.update((x, f"{name}_{k}") for k, x in enumerate(op.results))
        return name

    def _write_table(self, op: Operation) -> None:
        name = self.names[op.results[0]] = self.new_name("t")
        numbers = ", ".join(_table_entry(x) for x in op.param("numbers").array)
        self.tables.append(f"TABLE {type_name(op.dtype)} {name}[] = {{{numbers}}};")

    def _write_lookup(self, op: Operation, args: list[str], depth: int) -> None:
        offset, key = op.param("offset"), _entry_group(op)
        if key not in self.entry_groups:
            name = self.names[op.results[0]] = self.new_name()
            self.write_line(f"const auto {name} = lookup({args[0]}, {args[1]}, {offset});", depth)
            return
        if not self.entry_groups[key]:
            name = self.entry_groups[key] = self.new_name()
            self.write_line(f"const auto {name} = lookup_four({args[0]}, {args[1]}, {offset // 4 * 4});", depth)
        self.names[op.results[0]] = f"{self.entry_groups[key]}.x[{offset % 4}]"

    def _write_sin_cos(self, op: Operation, x: str, depth: int) -> None:
        if x not in self.sin_cos_names:
            pair = self.sin_cos_names[x] = self.new_name()
            ctype = "auto" if isinstance(op.args[0], Value) else type_name(op.dtype)
            self.write_line(f"{ctype} {pair}_0 = {x}, {pair}_1 = {x};", depth)
            self.write_line(f"sin_cos({x}, {pair}_0, {pair}_1);", depth)
        self.names[op.results[0]] = f"{self.sin_cos_names[x]}_{0 if op.name == 'sin' else 1}"

    def _write_when(self, op: Operation, args: list[str], depth: int) -> None:
        mask, *old_values = args
        name = self._define_carry(op, old_values, [False] * len(old_values), depth)
        self.write_line(f"if (any({mask})) {{", depth)
        for k, value in enumerate(self.write_block(op.blocks[0], [], depth + 1)):
            self.write_line(f"{name}_{k} = select_n_({mask}, {name}_{k}, {value});", depth + 1)
        self.write_line("}", depth)

    def _write_loop(self, op: Operation, args: list[str], depth: int) -> None:
        (body,) = op.blocks
        shared_flags = self._shared_carry(op)
        name = self._define_carry(op, args, shared_flags, depth)
        counter = self.new_name("n")
        self.write_line(f"for (int {counter} = 0; {counter} < {op.param('length')}; ++{counter}) {{", depth)
        outs = self.write_block(body, [f"{name}_{k}" for k in range(len(args))], depth + 1)
        self._assign_carry(op, name, outs, shared_flags, None, depth + 1)
        self.write_line("}", depth)

    def _write_over_others(self, op: Operation, depth: int, live: Sequence[tuple[Value, str]]) -> None:
        (body,) = op.blocks
        published = [(type_name(x.dtype), self.element(x)) for x in op.args]
        reads = self.exchange.publish(self, published, live, depth)
        reductions = op.param("reduce")
        initial = [literal(ops.neutral_number(r, x.dtype)) for r, x in zip(reductions, op.results, strict=True)]
        name = self._define_carry(op, initial, [False] * len(initial), depth)
        best_numbers: dict[int, str] = {}
        for k, (reduction, x) in enumerate(zip(reductions, body.outputs, strict=True)):
            if reduction in ops.INDEX_REDUCTIONS:
                best_numbers[k], worst = self.new_name(), literal(ops.neutral_number(reduction[3:], x.dtype))
                self.write_line(f"auto {best_numbers[k]} = {type_name(x.dtype)}_lanes({worst});", depth)
        counter = self.new_name("j")
        self.write_line(f"UNROLL for (int {counter} = 0; {counter} < GROUP; ++{counter}) {{", depth)
        inputs = [self.new_name() for _ in body.inputs]
        for variable, read in zip(inputs, reads, strict=False):
            self.write_line(f"const auto {variable} = {read(counter)};", depth + 1)
        self.write_line(f"const auto {inputs[-1]} = eq_(own_drone, i32({counter}));", depth + 1)
        outs = self.write_block(body, inputs, depth + 1)
        for k, (reduction, value) in enumerate(zip(reductions, outs, strict=True)):
            if k in best_numbers:
                is_better = self.new_name()
                test = f"{ops.INDEX_REDUCTIONS[reduction]}_({value}, {best_numbers[k]})"
                self.write_line(f"const auto {is_better} = or_({test}, ne_({value}, {value}));", depth + 1)
                self.write_line(
                    f"{name}_{k} = select_n_({is_better}, {name}_{k}, i32_lanes(i32({counter})));", depth + 1
                )
                self.write_line(f"{best_numbers[k]} = select_n_({is_better}, {best_numbers[k]}, {value});", depth + 1)
            else:
                self.write_line(f"{name}_{k} = {reduction}_({name}_{k}, {value});", depth + 1)
        self.write_line("}", depth)

    def _write_while(self, op: Operation, args: list[str], depth: int) -> None:
        test, body = op.blocks
        shared_flags = self._shared_carry(op)
        name = self._define_carry(op, args, shared_flags, depth)
        carry = [f"{name}_{k}" for k in range(len(args))]
        self.write_line("for (;;) {", depth)
        (continues,) = self.write_block(test, carry, depth + 1)
        self.write_line(f"if (!any({continues})) break;", depth + 1)
        mask = None if is_shared(test.outputs[0], self.shared) else continues
        self._assign_carry(op, name, self.write_block(body, carry, depth + 1), shared_flags, mask, depth + 1)
        self.write_line("}", depth)

    def _shared_carry(self, op: Operation) -> list[bool]:
        shared_flags = shared_carry(op, self.shared)
        for block in op.blocks:
            self.shared.update(
                x for x, is_shared_number in zip(block.inputs, shared_flags, strict=True) if is_shared_number
            )
        return shared_flags

    def _define_carry(self, op: Operation, initial: Sequence[str], shared_flags: Sequence[bool], depth: int) -> str:
        name = self._name_results(op)
        for k, (x, value, is_shared_number) in enumerate(zip(op.results, initial, shared_flags, strict=True)):
            ctype = type_name(x.dtype)
            self.write_line(
                f"{ctype} {name}_{k} = {value};" if is_shared_number else f"auto {name}_{k} = {ctype}_lanes({value});",
                depth,
            )
        return name

    def _assign_carry(
        self, op: Operation, name: str, outs: Sequence[str], shared_flags: Sequence[bool], mask: str | None, depth: int
    ) -> None:
        # All new values are written first, because a new value may be the old value of another variable.
        new_names = [self.new_name() for _ in outs]
        for k, (new_name, result) in enumerate(zip(new_names, outs, strict=True)):
            text = result if mask is None or shared_flags[k] else f"select_n_({mask}, {name}_{k}, {result})"
            self.write_line(f"const auto {new_name} = {text};", depth)
        for k, (new_name, x, is_shared_number) in enumerate(zip(new_names, op.results, shared_flags, strict=True)):
            value = new_name if is_shared_number else f"{type_name(x.dtype)}_lanes({new_name})"
            self.write_line(f"{name}_{k} = {value};", depth)


def _live_values(block: Block, position: int) -> list[tuple[Value, str]]:
    earlier_values = [x for op in block.operations[:position] for x in op.results if not x.size]
    used = dataclasses.replace(block, operations=block.operations[position + 1 :]).used_values()
    used = used.union(*(inner.used_values() for inner in block.operations[position].blocks))
    return [(x, type_name(x.dtype)) for x in earlier_values if x in used]


def _entry_group(op: Operation) -> EntryGroup:
    return op.args[0], op.args[1], op.param("offset") // 4


def _entry_groups(block: Block) -> list[EntryGroup]:
    lookups = [op for op in block.operations if op.name == "lookup" and op.param("aligned") and op.dtype == np.float32]
    counts = collections.Counter(_entry_group(op) for op in lookups if isinstance(op.args[1], Value))
    sizes = {_entry_group(op): op.args[0].size for op in lookups}
    return [key for key, n in counts.items() if n >= 3 and key[2] * 4 + 4 <= sizes[key]]


def expression(op: Operation, args: Sequence[str]) -> str:
    source = ops.TABLE[op.name].source
    if not isinstance(source, str):
        source = next(text for kinds, text in source.items() if op.dtype.kind in kinds)
    return source.format(*args, name=op.name, all=", ".join(args), type=type_name(op.dtype), **dict(op.params))


def _limiting_function(op: Operation, comparisons: Mapping[Value, Operation]) -> str | None:
    # A target may have an instruction for it. An example is ``x < low ? low : x``, which becomes ``at_least``.
    if op.name != "select_n" or op.dtype.kind != "f" or op.args[0] not in comparisons:
        return None
    test, (x, limit) = comparisons[op.args[0]], op.args[1:]
    if test.args[0] is not x or not _are_equal(test.args[1], limit):
        return None
    return "at_least" if test.name == "lt" else "at_most"


def _are_equal(a: Element, b: Element) -> bool:
    return a is b or (is_constant(a) and is_constant(b) and literal(a) == literal(b))


def type_name(dtype: DTypeLike) -> str:
    dtype = np.dtype(dtype)
    if dtype not in TYPE_NAMES:
        raise UnsupportedError(f"kernels have no numbers of type {dtype.name}")
    return TYPE_NAMES[dtype]


def _table_entry(x: np.generic) -> str:
    return f"{float(x).hex()}{'f' * (x.dtype == np.float32)}" if x.dtype.kind == "f" else f"{int(x)}"


def literal(x: np.generic) -> str:
    """Return an expression that is exactly equal to a constant."""
    ctype = type_name(x.dtype)
    if ctype == "b1":
        return "b1(1)" if bool(x) else "b1(0)"
    if ctype in ("f32", "f64"):
        if not np.isfinite(x):
            return f"{ctype}_nan()" if np.isnan(x) else f"{'-' if float(x) < 0 else ''}{ctype}_infinity()"
        return f"{ctype}({float(x).hex()})"
    if ctype == "i32":
        return f"i32({int(x)})" if int(x) != -(2**31) else "i32(-2147483647 - 1)"
    return f"u32({int(x)}u)"
