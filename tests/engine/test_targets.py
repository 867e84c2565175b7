"""Every operation of the table in every target: XLA and kernels compute the same as the interpreter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.engine.backends import cuda, fused, interpret, kernel, lanes, native, source
from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir import ops
from crazysim.engine.ir.blocks import Builder
from crazysim.engine.ir.program import Leaf, Program, Segment
from crazysim.engine.sharding import Location
from crazysim.engine.tools import symbolic

FLOATS = [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 0.49999997, 1.5, 2.5, -2.5, 1e-3, 3.7, -7.2, 88.0, 1e4, 2.0**31, -(2.0**31),
          3e9, -3e9, 5e9, 1e20, 1e30, np.inf, -np.inf, np.nan]  # fmt: skip
INTEGERS = [0, 1, -1, 2, -2, 7, -7, 31, 32, 33, 40, -40, 1000, 2**31 - 1, -(2**31)]
VALUES = {
    "float32": FLOATS,
    "int32": INTEGERS,
    "uint32": [x % 2**32 for x in INTEGERS],
    "bool": [False, True],
}
N_LANES = 1000

# Rounding of library functions of XLA, of the host and of NumPy, in units in the last place.
TOLERANCE = dict.fromkeys(
    "cbrt rsqrt exp2 logistic pow tan asin acos atan atan2 sinh cosh asinh acosh atanh erf erfc".split(), 16
)
TOLERANCE |= {"erf_inv": 64}
# Absolute errors of XLA's functions near their zeros.
ABSOLUTE_TOLERANCE = dict.fromkeys(["lgamma", "digamma"], 3e-6)
DOMAINS = {"acos": (-1, 1), "asin": (-1, 1), "atanh": (-0.99, 0.99), "erf_inv": (-0.99, 0.99), "acosh": (1, 1e4),
          "lgamma": (0.1, 50), "digamma": (0.1, 50), "pow": (0.1, 9), "sin": (-1e4, 1e4), "cos": (-1e4, 1e4),
          "tan": (-1.4, 1.4), "sinh": (-50, 50), "cosh": (-50, 50), "erfc": (-5, 5)}  # fmt: skip
"""Ranges in which functions are compared; elsewhere libraries differ or overflow."""


def numbers(dtype, name, seed):
    """Return random and special numbers of a type, from the domain of an operation if it has one. (N_LANES,)"""
    rng = np.random.default_rng(seed)
    if name in DOMAINS:
        return rng.uniform(*DOMAINS[name], N_LANES).astype(dtype)
    special = np.array(VALUES[dtype], dtype)
    return rng.choice(special, N_LANES) if dtype != "float32" else np.where(
        rng.random(N_LANES) < 0.5, rng.choice(special, N_LANES), rng.normal(0, 3, N_LANES).astype(dtype)
    )  # fmt: skip


def cases():
    out = []
    for row in ops.TABLE.values():
        if row.structured:
            continue
        if row.operands == "*":
            pairs = [(a, b) for a in VALUES for b in VALUES]
            if row.name == "bitcast_convert_type":
                pairs = [(a, b) for a, b in pairs if a != b and "bool" not in (a, b)]
            out += [(row.name, (a,), b) for a, b in pairs if a != b]
            continue
        for dtype in VALUES:
            if np.dtype(dtype).kind in row.kinds:
                operands = tuple("bool" if letter == "b" else dtype for letter in row.operands)
                out.append((row.name, operands, "bool" if row.results == "b" else dtype))
    return out


@pytest.fixture(scope="module")
def all_operations():
    builder, leaves, arrays, reads, outputs = Builder(stage="all"), [], [], [], []
    for k, (name, operands, result) in enumerate(cases()):
        args = []
        for j, dtype in enumerate(operands):
            args.append(builder.input(dtype))
            reads.append((len(leaves), 0))
            leaves.append(Leaf(f"{name}.{k}.{j}", "drone", (N_LANES, 1), np.dtype(dtype)))
            arrays.append(jnp.asarray(numbers(dtype, name, 10 * k + j)).reshape(N_LANES, 1))
        params = (("y", -3 if operands[0] == "float32" else 5),) if name == "integer_pow" else ()
        outputs.append(builder.add(name, args, result, params))
    writes = tuple((len(leaves) + k, 0) for k in range(len(outputs)))
    leaves += [Leaf(f"out {k}", "drone", (N_LANES, 1), x.dtype) for k, x in enumerate(outputs)]
    arrays += [jnp.zeros((N_LANES, 1), x.dtype) for x in outputs]
    segment = Segment("drone", ("all",), "each", builder.finish(outputs), tuple(reads), writes)
    return Program(tuple(leaves), 1, (segment,)), arrays


@pytest.fixture(scope="module")
def expected(all_operations):
    program, arrays = all_operations
    (segment,) = program.fused_segments
    inputs = [np.asarray(arrays[leaf])[:, 0] for leaf, _ in segment.reads]
    return interpret.run_block(segment.block, inputs, (N_LANES,))


def assert_agree(computed, expected, engine):
    wrong = []
    for case, x, y in zip(cases(), computed, expected, strict=True):
        name, x, y = case[0], np.asarray(x).reshape(-1), np.asarray(y)
        assert x.dtype == y.dtype, case
        if y.dtype.kind != "f":
            same = x == y
        else:
            with np.errstate(all="ignore"):
                smallest_error = max(ABSOLUTE_TOLERANCE.get(name, 0), 1.2e-38)  # XLA flushes subnormal numbers to zero
                close = (
                    np.abs(x.astype(np.float64) - y) <= TOLERANCE.get(name, 4) * 2.0**-23 * np.abs(y) + smallest_error
                )
            # The sign of a zero that max and min return is not defined.
            same_sign = np.signbit(x) == np.signbit(y) if name not in ("max", "min", "clamp") else np.ones_like(x, bool)
            same = (np.isnan(x) & np.isnan(y)) | ((x == y) & ((y != 0) | same_sign)) | (close & (y != 0))
        if not same.all():
            k = int(np.argmin(same))
            wrong.append((*case, k, x[k], y[k]))
    assert not wrong, f"{engine}: " + "; ".join(map(str, wrong))


def test_xla_agrees_with_the_interpreter(all_operations, expected):
    program, arrays = all_operations
    written, _ = jax.jit(lambda leaves: lanes.run_steps(program, leaves, 1))(arrays)
    assert_agree(written, expected, "lanes")


def test_a_kernel_agrees_with_the_interpreter(all_operations, expected):
    if native.compiler() is None:
        pytest.skip("no C++ compiler here")
    program, arrays = all_operations
    written, _ = jax.jit(lambda leaves: fused.build(program, Location("cpu"))(leaves, 1))(arrays)
    assert_agree(written, expected, "fused")


def test_nvidia_compiles_every_operation(all_operations):
    program, _ = all_operations
    text = kernel.write_kernel(program, "cuda")
    if cuda.nvrtc() is None:
        pytest.skip("NVRTC is not here")
    assert ".entry advance(" in cuda.ptx(text, cuda.DEFAULT_ARCHITECTURE)


def _number(rng, dtype, low, high):
    if dtype == "bool":
        return np.bool_(rng.random() < 0.5)
    if dtype == "uint32":
        return np.uint32(rng.choice([0, 1, 5, 2**31, 2**32 - 1]))
    return np.asarray(rng.uniform(low, high)).astype(dtype)


@pytest.mark.usefixtures("casadi")
def test_casadi_agrees_with_the_interpreter_or_refuses():
    """The comparison is in float64, on finite numbers, since CasADi has neither NaN nor infinity."""
    import casadi

    refused = set()
    for name, operands, result in cases():
        dtypes = [d.replace("float32", "float64") for d in operands]
        builder = Builder(stage="one")
        args = [builder.input(d) for d in dtypes]
        params = (("y", 3),) if name == "integer_pow" else ()
        block = builder.finish([builder.add(name, args, result.replace("float32", "float64"), params)])
        try:
            symbolic.require_casadi(block)
        except UnsupportedError as error:
            refused.add((name, error.stage))
            continue
        low, high = DOMAINS.get(name, (-3, 3))
        rng = np.random.default_rng(0)
        symbols = [casadi.SX.sym(f"x{k}") for k in range(len(args))]
        function = casadi.Function("f", symbols, symbolic.run_block(block, symbols))
        for _ in range(5):
            values = [_number(rng, d, low, min(high, 50)) for d in dtypes]
            if name in ("rem", "div") and values[1] == 0:
                continue
            (expected_number,) = interpret.run_block(block, values, ())
            computed = float(function(*map(float, values)))
            np.testing.assert_allclose(computed, float(expected_number), rtol=1e-9, atol=1e-9, err_msg=name)
    assert {stage for _, stage in refused} == {"one"}
    assert {name for name, _ in refused} >= {"shift_left", "nextafter", "lgamma", "digamma", "bitcast_convert_type"}


def test_kernels_refuse_types_that_they_do_not_have():
    builder = Builder(stage="mine")
    x = builder.input(np.int64)
    with pytest.raises(UnsupportedError, match=r"no numbers of type int64 \(stage 'mine', jax"):
        source.require_block_source(builder.finish([builder.add("add", (x, x), np.int64)]))
