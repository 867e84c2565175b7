"""Steps in Python, for the tests: a function of NumPy's scalars that is written for a program.

An operation on a scalar takes a small part of the time that one on an array takes, so that short flights of a few
drones are over before a kernel is compiled. Numbers have the types that they have in ``interpret``, and so the same
rounding.
"""

import contextlib
import itertools
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from crazysim.engine import interpret, lanes, ops
from crazysim.engine.ir import Value
from crazysim.engine.program import TABLE

MOST_DRONES = 8
"""Drones of a world that read each other's numbers, up to which there is a function: it has lines for each of them."""
SIGNS = {
    "add": "+", "sub": "-", "mul": "*", "and": "&", "or": "|", "xor": "^",
    "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">=",
}  # fmt: skip
FORMS = {
    **{name: f"{{0}} {sign} {{1}}" for name, sign in SIGNS.items()},
    "neg": "-{0}",
    "not": "~{0}",
    "abs": "abs({0})",
    "is_finite": "{0} - {0} == 0",
    "max": "{0} if {0} >= {1} or {0} != {0} else {1}",
    "min": "{0} if {0} <= {1} or {0} != {0} else {1}",
    "select_n": "{2} if {0} else {1}",
}
"""Expressions of Python in place of NumPy's functions, which take longer on scalars."""
UFUNCS = (np.sqrt, np.sin, np.cos, np.exp, np.log, np.arctan2, np.floor)
"""Functions of NumPy that return a scalar of their operands' type for scalars."""

BUDGET = 300
"""Operations on arrays that are interpreted in about the time in which g++ compiles one."""
CALL = 500
"""Operations that take as long as a call does besides its steps."""
LANES = 5000
"""Drones in all worlds that double the time of an operation on arrays."""
SCALAR = 0.06
"""Time of an operation on a scalar, as a part of one on an array."""
WRITING = 20
"""Steps on arrays that take as long as writing a function of scalars for one drone."""
ITERATIONS = {"loop": "length", "over_others": "n_members"}
"""Operations that repeat their block, and the parameter that says how often."""
WHILE = 10
"""Iterations of a loop that ends by a condition, as a guess."""


def budget(program):
    """Return for how many operations on arrays steps may take, until a kernel is compiled."""
    return BUDGET * sum(n_operations(segment.block, repeated=False) for segment in program.fused_segments)


def cost(program, n_lanes, n_steps):
    """Return the number of operations on arrays that take as long as a call that takes some steps of all drones."""
    per_operation = SCALAR * n_lanes if are_few(program, n_lanes) else 1 + n_lanes / LANES
    return CALL + n_executed(program, n_steps) * per_operation


def n_executed(program, n_steps):
    """Return the number of operations that some steps of a drone execute."""
    if program not in _SIZES:
        sizes = [(s.phase == "each", n_operations(s.block, repeated=True)) for s in program.fused_segments]
        _SIZES[program] = sum(n for each, n in sizes if not each), sum(n for each, n in sizes if each)
    once, each = _SIZES[program]
    return once + n_steps * each


def n_operations(block, repeated):
    """Return the number of operations of a block: as they are written, or as often as they are executed."""

    def inner(op):
        times = WHILE if op.name == "while" else op.param(ITERATIONS[op.name]) if op.name in ITERATIONS else 1
        return (times if repeated else 1) * sum(n_operations(b, repeated) for b in op.blocks)

    return sum(1 + inner(op) for op in block.operations)


def are_few(program, n_lanes):
    """Return whether scalars, one drone after the other, take less time than arrays."""
    return SCALAR * n_lanes < 1 and program.group <= MOST_DRONES


def steps(program, leaves, n_steps):
    """Return the written leaves after some steps, and the worlds that are flagged, all in NumPy."""
    n_worlds, n_drones = lanes.batch(program, leaves)
    n_lanes = n_worlds * n_drones
    done = _DONE[program] = _DONE.get(program, 0) + n_executed(program, n_steps)
    few = are_few(program, n_lanes)
    if few and program not in _WRITTEN:
        written_in = WRITING * program.group * n_executed(program, 1)
        if done * (1 - SCALAR * n_lanes) > written_in:
            _WRITTEN[program] = Function(program)
    if few and program in _WRITTEN:
        return _WRITTEN[program](leaves, n_steps, n_worlds)
    return interpret._steps(program, leaves, n_steps)


_SIZES, _DONE = WeakKeyDictionary(), WeakKeyDictionary()
"""Operations of programs, those executed once and those of each step; and how many were executed."""


class Function:
    """The steps of drones that read each other's numbers, or of one. It does not keep its program."""

    def __init__(self, program):
        """Write the function of a program whose stages are all fused."""
        self.leaves, self.n_drones, self.group = program.leaves, program.n_drones, program.group
        writer = Writer(program)
        exec(compile(writer.text(), "<steps>", "exec"), writer.globals)
        self.steps, self.columns = writer.globals["steps"], writer.columns
        self.shapes = {i: lanes.shape_of(program, i, 1).shape[1:] for i in program.written}

    def __call__(self, leaves, n_steps, n_worlds):
        """Return the written leaves after some steps, and the worlds that are flagged."""
        n_units = n_worlds * self.n_drones // self.group
        given = [self.numbers(i, leaves[i], n_worlds, n_units) for i in self.columns]
        with np.errstate(all="ignore"):
            found = [self.steps(n_steps, *itertools.chain(*numbers)) for numbers in zip(*given, strict=True)]
        flagged = np.array([some[: self.group] for some in found], bool).reshape(n_worlds, self.n_drones)
        written, end = [], self.group
        for i in self.shapes:
            start, end = end, end + self.group * self.leaves[i].size
            written.append(self.array(i, [some[start:end] for some in found], n_worlds))
        return written, flagged.any(axis=1, keepdims=True)

    def numbers(self, leaf, x, n_worlds, n_units):
        """Return the numbers of a leaf that each call takes."""
        columns, example = self.columns[leaf], self.leaves[leaf]
        if is_shared(example):
            x = x.reshape(-1)
            return [[x if k == TABLE else x[k] for k in columns]] * n_units
        if x is None:  # written before it is read
            x = np.zeros((n_worlds, self.n_drones, example.size), example.number)
        elif example.rows_of:
            x = x.T
        else:
            x = np.broadcast_to(x.reshape(n_worlds, -1, example.size), (n_worlds, self.n_drones, example.size))
        x = x.reshape(-1, example.size)
        x = x if len(columns) == example.size else x[:, columns]
        return [list(numbers) for numbers in x.reshape(n_units, -1)]

    def array(self, leaf, numbers, n_worlds):
        """Return a written leaf, from its numbers of each call."""
        example, shape = self.leaves[leaf], self.shapes[leaf]
        x = np.array(numbers, example.number).reshape(n_worlds, self.n_drones, example.size)
        if example.rows_of:
            return np.ascontiguousarray(x.reshape(-1, example.size).T)
        return np.ascontiguousarray(x[:, : shape[0]]).reshape(n_worlds, *shape)


class Writer:
    """Writes the function of a program."""

    def __init__(self, program):
        """Find the numbers that the function takes: those used of each leaf, and all of a leaf that is written."""
        self.program, self.group, self.globals = program, program.group, {}
        self.lines, self.depth, self.count = [], 1, itertools.count()
        checked = program.check.reads if program.check is not None else ()
        slots = {slot for s in program.fused_segments for slot in program.per_drone(s, [*s.reads, *s.writes])}
        slots |= {slot for s in program.fused_segments for slot in s.hoisted_reads} | {*checked}
        slots |= {(i, k) for i in program.written for k in range(program.leaves[i].size)}
        self.columns = {i: [k for _, k in some] for i, some in itertools.groupby(sorted(slots), lambda slot: slot[0])}
        """Elements of each leaf, in the order of the arguments."""

    def text(self):
        """Return the function, which is called steps."""
        program, none = self.program, [()] * self.group
        for segment in program.of("first"):
            self.segment(segment, none)
        each = [(segment, self.drones(segment.hoisted, self.read(segment.hoisted_reads)))
                for segment in program.of("each")]  # fmt: skip
        self.line("for _ in range(n_steps):")
        with self.indented():
            self.line("pass")
            for segment, constants in each:
                self.segment(segment, constants)
        flags = ["False"] * self.group
        if program.check is not None:
            found = [x for (x,) in self.drones(program.check.block, self.read(program.check.reads))]
            flags = [self.new() for _ in found]
            self.assign(flags, found)  # the last stages may write what it was made of
        for segment in program.of("last"):
            self.segment(segment, none)
        results = [*flags, *(x for i in program.written for x in self.names(i))]
        self.line(f"return {', '.join(results)},")
        arguments = ["n_steps", *(x for i in self.columns for x in self.names(i))]
        return "\n".join([f"def steps({', '.join(arguments)}):", *self.lines])

    def read(self, slots):
        """Return the names of slots, for each drone."""
        return [[self.name(slot, d) for slot in slots] for d in range(self.group)]

    def names(self, leaf):
        """Return the names of the numbers of a leaf, drone after drone."""
        drones = range(1 if is_shared(self.program.leaves[leaf]) else self.group)
        return [self.name((leaf, k), d) for d in drones for k in self.columns[leaf]]

    def name(self, slot, drone):
        """Return the variable of a slot: one for each drone, or for all."""
        leaf, k = slot
        if is_shared(self.program.leaves[leaf]):
            return f"x{leaf}_{'table' if k == TABLE else k}"
        return f"x{leaf}_{k}_{drone}"

    def new(self):
        """Return the name of a new variable."""
        return f"v{next(self.count)}"

    def line(self, text):
        """Add a line."""
        self.lines.append(" " * self.depth + text)

    def assign(self, names, values):
        """Add an assignment of all values at once."""
        if names:
            self.line(f"{', '.join(names)} = {', '.join(values)}")

    def known(self, x: Any) -> str:
        """Return the name of a constant, a table or a function."""
        name = f"c{len(self.globals)}"
        self.globals[name] = x
        return name

    def segment(self, segment, constants):
        """Add a segment, with the hoisted numbers of each drone."""
        leaves = self.program.leaves
        if segment.scope == "drone":
            given = [[*names, *more] for names, more in zip(self.read(segment.reads), constants, strict=True)]
            outs = self.drones(segment.block, given)
            pairs = [(self.name(slot, d), x) for d, some in enumerate(outs)
                     for slot, x in zip(segment.writes, some, strict=True)]  # fmt: skip
        else:

            def place(leaf, k):
                return (k // leaves[leaf].size, (leaf, k % leaves[leaf].size)) if is_drones(leaf) else (0, (leaf, k))

            def is_drones(leaf):
                return leaves[leaf].scope == "drone"

            given = [self.name(slot, d) for d, slot in itertools.starmap(place, segment.reads)]
            outs = self.block(segment.block, dict(zip(segment.block.inputs, given, strict=True)))
            pairs = []
            for slot, x in zip(segment.writes, outs, strict=True):
                d, own = place(*slot)
                pairs += [(self.name(own, i), x) for i in ([d] if is_drones(slot[0]) else range(self.group))]
        self.assign([name for name, _ in pairs], [x for _, x in pairs])

    def drones(self, block, given):
        """Add a block for each drone, and return the outputs of each."""
        names = [dict(zip(block.inputs, some, strict=True)) for some in given]
        for op in block.operations:
            if op.name == "over_others":
                self.over_others(op, names)
            else:
                for own in names:
                    self.operation(op, own)
        return [[self.operand(x, own) for x in block.outputs] for own in names]

    def block(self, block, names):
        """Add a block, and return its outputs."""
        for op in block.operations:
            self.operation(op, names)
        return [self.operand(x, names) for x in block.outputs]

    def operand(self, x, names):
        """Return the name of an element."""
        return names[x] if isinstance(x, Value) else self.known(x)

    def operation(self, op, names):
        """Add an operation, and the names of its results."""
        args = [self.operand(x, names) for x in op.args]
        if not op.blocks and op.name not in ("barrier", "table", "lookup", "threefry2x32"):
            (result,) = op.results
            names[result] = self.new()
            self.line(f"{names[result]} = {self.expression(op, args)}")
        else:
            names.update(zip(op.results, getattr(self, f"op_{op.name}")(op, args, names), strict=True))

    def expression(self, op, args):
        """Return an operation of numbers as an expression."""
        a, row = op.args[0], ops.TABLE[op.name]
        floating = op.dtype.kind == "f"
        if op.name in FORMS:
            return FORMS[op.name].format(*args)
        if op.name == "div" and floating:
            return f"{args[0]} / {args[1]}"
        if op.name == "integer_pow" and abs(op.param("y")) == 2:  # NumPy squares arrays, but not scalars
            square = f"{args[0]} * {args[0]}"
            return square if op.param("y") > 0 else f"1 / ({square})"
        if op.name == "convert_element_type" and (floating or a.dtype.kind != "f") and op.dtype.kind != "b":
            return f"{args[0]}.astype({self.known(op.dtype)})"
        if row.numpy in UFUNCS:
            return f"{self.known(row.numpy)}({', '.join(args)})"
        return f"{self.known(op.dtype.type)}({self.known(interpret._numpy(op))}({', '.join(args)}))"

    def op_barrier(self, op, args, names):
        """Add nothing."""
        return []

    def op_table(self, op, args, names):
        """Return the name of a table."""
        return [self.known(op.param("numbers").array)]

    def op_lookup(self, op, args, names):
        """Add an entry of a table."""
        name = self.new()
        self.line(f"{name} = {args[0]}[{args[1]} + {op.param('offset')}]")
        return [name]

    def op_threefry2x32(self, op, args, names):
        """Add random numbers."""
        found = [self.new(), self.new()]
        self.line(f"{', '.join(found)} = {self.known(interpret.threefry2x32)}({', '.join(args)})")
        return found

    def op_custom_jvp(self, op, args, names):
        """Add the block."""
        (block,) = op.blocks
        return self.block(block, names | dict(zip(block.inputs, args, strict=True)))

    def op_when(self, op, args, names):
        """Add a branch."""
        (block,), found = op.blocks, [self.new() for _ in op.results]
        self.assign(found, args[1:])
        self.line(f"if {args[0]}:")
        with self.indented():
            self.assign(found, self.block(block, dict(names)))
            self.line("pass")
        return found

    def op_loop(self, op, args, names):
        """Add a loop of some turns."""
        (block,), carry = op.blocks, [self.new() for _ in op.results]
        self.assign(carry, args)
        self.line(f"for _ in range({op.param('length')}):")
        with self.indented():
            self.assign(carry, self.block(block, names | dict(zip(block.inputs, carry, strict=True))))
        return carry

    def op_while(self, op, args, names):
        """Add a loop that a condition ends."""
        (test, body), carry = op.blocks, [self.new() for _ in op.results]
        self.assign(carry, args)
        self.line("while True:")
        with self.indented():
            (going,) = self.block(test, names | dict(zip(test.inputs, carry, strict=True)))
            self.line(f"if not {going}: break")
            self.assign(carry, self.block(body, names | dict(zip(body.inputs, carry, strict=True))))
        return carry

    def over_others(self, op, names):
        """Add a block for each drone of the world, once for every one, and the names of its combined results."""
        (block,), published = op.blocks, self.new()
        rows = ["(" + "".join(f"{self.operand(x, own)}, " for x in op.args) + ")" for own in names]
        self.line(f"{published} = ({', '.join(rows)},)")
        for d, own in enumerate(names):
            is_own = self.known([np.bool_(k == d) for k in range(self.group)])
            inputs, found = [self.new() for _ in block.inputs], [self.new() for _ in op.results]
            reduce = op.param("reduce")
            self.assign(found, [self.known(ops.neutral(n, x.dtype)) for n, x in zip(reduce, op.results, strict=True)])
            *others, itself = inputs
            target = "".join(f"{x}, " for x in others)
            self.line(f"for ({target}), {itself} in zip({published}, {is_own}):")
            with self.indented():
                outs = self.block(block, own | dict(zip(block.inputs, inputs, strict=True)))
                self.assign(found, [f"({FORMS[n].format(x, y)})" for n, x, y in zip(reduce, found, outs, strict=True)])
            own.update(zip(op.results, found, strict=True))

    @contextlib.contextmanager
    def indented(self):
        """Indent the lines that are added meanwhile."""
        self.depth += 1
        yield
        self.depth -= 1


def is_shared(leaf):
    """Return whether all drones of all worlds have the same numbers of a leaf."""
    return leaf.scope not in ("drone", "world")


_WRITTEN = WeakKeyDictionary()
"""Functions of programs."""
