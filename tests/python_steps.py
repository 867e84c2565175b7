"""Steps in Python, for the tests: a function of NumPy's scalars that is written for a program.

An operation on a scalar takes a tenth of the time that one on an array takes, so that short flights of a few drones
are over before a kernel is compiled. Numbers have the types that they have in ``interpret``, and so the same rounding.
"""

import functools
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
"""Functions that return scalars of the type of theirs."""


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


def cost(program, n_lanes):
    """Return the number of operations on arrays that take as long as a step of all drones."""
    if program not in _COSTS:
        _COSTS[program] = sum(n_operations(segment.block, repeated=True) for segment in program.fused_segments)
    return _COSTS[program] * (SCALAR * n_lanes if are_few(program, n_lanes) else 1 + n_lanes / LANES)


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
    """Return the written leaves after some steps, and the worlds that are flagged, as ``interpret.steps`` does."""
    n_worlds, n_drones = lanes.batch(program, leaves)
    n_lanes = n_worlds * n_drones
    taken = _TAKEN[program] = _TAKEN.get(program, 0) + n_steps
    if not are_few(program, n_lanes):
        return interpret._steps(program, leaves, n_steps)
    if program not in _WRITTEN and taken * (1 - SCALAR * n_lanes) > WRITING * program.group:
        _WRITTEN[program] = Function(program)
    return (_WRITTEN.get(program) or functools.partial(interpret._steps, program))(leaves, n_steps)


_COSTS, _TAKEN = WeakKeyDictionary(), WeakKeyDictionary()
"""Operations of a step of programs, and how many steps they have taken."""


class Function:
    """The steps of drones that read each other's numbers, or of one."""

    def __init__(self, program):
        """Write the function of a program whose stages are all fused."""
        self.program, self.group, self.globals = program, program.group, {}
        self.lines, self.depth, self.count = [], 1, itertools.count()
        segments, check = program.fused_segments, program.check
        checked = check.reads if check is not None else ()
        slots = {slot for s in segments for slot in program.per_drone(s, [*s.reads, *s.writes])}
        slots |= {slot for s in segments for slot in s.hoisted_reads} | {*checked}
        slots |= {(i, k) for i in program.written for k in range(program.leaves[i].size)}
        self.shapes = {i: lanes.shape_of(program, i, 1).shape[1:] for i in program.written}
        self.columns = {i: [k for _, k in some] for i, some in itertools.groupby(sorted(slots), lambda slot: slot[0])}

        for segment in program.of("first"):
            self.segment(segment, [()] * self.group)
        each = [(s, self.drones(s.hoisted, [[self.name(x, d) for x in s.hoisted_reads] for d in range(self.group)]))
                for s in program.of("each")]  # fmt: skip
        self.line("for _ in range(n_steps):")
        self.depth += 1
        self.line("pass")
        for segment, constants in each:
            self.segment(segment, constants)
        self.depth -= 1
        flags = ["False"] * self.group
        if check is not None:
            given = [[self.name(x, d) for x in checked] for d in range(self.group)]
            flags = [x for (x,) in self.drones(check.block, given)]
            fresh = [self.new() for _ in flags]
            self.assign(fresh, flags)  # the last stages may write what it was made of
            flags = fresh
        for segment in program.of("last"):
            self.segment(segment, [()] * self.group)

        arguments = [x for i in self.columns for x in self.names(i)]
        results = [*flags, *(x for i in program.written for x in self.names(i))]
        self.line(f"return {', '.join(results)},")
        text = "\n".join([f"def steps({', '.join(['n_steps', *arguments])}):", *self.lines])
        exec(compile(text, "<steps>", "exec"), self.globals)
        self.steps = self.globals["steps"]

    def __call__(self, leaves, n_steps):
        """Return the written leaves after some steps, and the worlds that are flagged."""
        n_worlds, n_drones = lanes.batch(self.program, leaves)
        n_units = n_worlds * n_drones // self.group
        given = [self.numbers(i, leaves[i], n_worlds, n_units) for i in self.columns]
        with np.errstate(all="ignore"):
            found = [self.steps(n_steps, *itertools.chain(*numbers)) for numbers in zip(*given, strict=True)]
        flagged = np.array([some[: self.group] for some in found], bool).reshape(n_worlds, n_drones)
        written, end = [], self.group
        for i in self.program.written:
            start, end = end, end + self.group * self.program.leaves[i].size
            written.append(self.array(i, [some[start:end] for some in found], n_worlds))
        return written, flagged.any(axis=1, keepdims=True)

    def names(self, leaf):
        """Return the names of the numbers of a leaf, drone after drone."""
        drones = range(self.group if self.program.leaves[leaf].scope in ("drone", "world") else 1)
        return [self.name((leaf, k), d) for d in drones for k in self.columns[leaf]]

    def numbers(self, leaf, x, n_worlds, n_units):
        """Return the numbers of a leaf that each call takes."""
        columns, example, n_drones = self.columns[leaf], self.program.leaves[leaf], self.program.n_drones
        if example.scope not in ("drone", "world"):
            x = x.reshape(-1)
            return [[x if k == TABLE else x[k] for k in columns]] * n_units
        if x is None:  # written before it is read
            x = np.zeros((n_worlds * n_drones, example.size), example.number)
        elif example.rows_of:
            x = x.T
        else:
            x = x.reshape(n_worlds, -1, example.size)
            x = x if x.shape[1] == n_drones else np.broadcast_to(x, (n_worlds, n_drones, example.size))
        x = x.reshape(-1, example.size)
        x = x if len(columns) == example.size else x[:, columns]
        return [list(numbers) for numbers in x.reshape(n_units, -1)]

    def array(self, leaf, numbers, n_worlds):
        """Return a written leaf, from its numbers of each call."""
        example, n_drones = self.program.leaves[leaf], self.program.n_drones
        x = np.array(numbers, example.number).reshape(n_worlds, n_drones, example.size)
        if example.rows_of:
            return np.ascontiguousarray(x.reshape(-1, example.size).T)
        shape = self.shapes[leaf]
        return np.ascontiguousarray(x[:, : shape[0]]).reshape(n_worlds, *shape)

    def name(self, slot, drone):
        """Return the variable of a slot: one for each drone, or for all."""
        leaf, k = slot
        if self.program.leaves[leaf].scope not in ("drone", "world"):
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
            given = [[*(self.name(x, d) for x in segment.reads), *constants[d]] for d in range(self.group)]
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
        if op.name == "integer_pow" and op.param("y") == 2:
            return f"{args[0]} * {args[0]}"
        if op.name == "convert_element_type" and (floating or a.dtype.kind != "f") and op.dtype.kind != "b":
            return f"{args[0]}.astype({self.known(op.dtype)})"
        if row.numpy in UFUNCS:
            return (
                f"{self.known(row.numpy)}({args[0]})"
                if len(args) == 1
                else f"{self.known(row.numpy)}({', '.join(args)})"
            )
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
        with self:
            self.assign(found, self.block(block, dict(names)))
            self.line("pass")
        return found

    def op_loop(self, op, args, names):
        """Add a loop of some turns."""
        (block,), carry = op.blocks, [self.new() for _ in op.results]
        self.assign(carry, args)
        self.line(f"for _ in range({op.param('length')}):")
        with self:
            self.assign(carry, self.block(block, names | dict(zip(block.inputs, carry, strict=True))))
        return carry

    def op_while(self, op, args, names):
        """Add a loop that a condition ends."""
        (test, body), carry = op.blocks, [self.new() for _ in op.results]
        self.assign(carry, args)
        self.line("while True:")
        with self:
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
            with self:
                outs = self.block(block, own | dict(zip(block.inputs, inputs, strict=True)))
                self.assign(found, [f"({FORMS[n].format(x, y)})" for n, x, y in zip(reduce, found, outs, strict=True)])
            own.update(zip(op.results, found, strict=True))

    def __enter__(self):
        """Begin an inner block."""
        self.depth += 1

    def __exit__(self, *_):
        """End it."""
        self.depth -= 1


_WRITTEN = WeakKeyDictionary()
"""Functions of programs."""
