"""Random programs from the public surface of ``jax.numpy`` and ``jax.lax``, as lines of Python.

A program is a list of expressions, each of which may use the values before it: ``v0``, ``v1``, ... Programs are text,
so a program that fails can be printed, shortened and copied into a test. A line is drawn from a template, and used if
JAX accepts it, so templates need not state which shapes and types fit together.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

MAX_ELEMENTS = 24
"""Maximum number of elements of a value; larger values only make programs slow."""

NAMES: dict = {"jax": jax, "jnp": jnp, "lax": lax, "np": np}


@dataclasses.dataclass(frozen=True)
class Program:
    inputs: tuple[str, ...]
    """Names of the inputs, which are ``v0``, ``v1``, ..."""
    lines: tuple[str, ...]
    """Expressions; the values of the lines follow the inputs."""

    def values(self, inputs_by_name: dict) -> list:
        values = [inputs_by_name[name] for name in self.inputs]
        for line in self.lines:
            values.append(evaluate(line, values))
        return values

    def __str__(self) -> str:
        input_lines = [f"v{k} = {name}" for k, name in enumerate(self.inputs)]
        return "\n".join(input_lines + [f"v{k} = {line}" for k, line in enumerate(self.lines, len(self.inputs))])


@functools.cache
def _compiled(line: str, n: int) -> Callable:
    arguments = ", ".join(f"v{k}" for k in range(n))
    return eval(f"lambda {arguments}: {line}", dict(NAMES))


def evaluate(line: str, values: Sequence):
    return _compiled(line, len(values))(*values)


class Draw:
    def __init__(self, rng: np.random.Generator, avals: Sequence[jax.ShapeDtypeStruct]):
        self.rng, self.avals = rng, avals
        self.shape: tuple[int, ...] = ()
        """Shape of the value that was chosen last."""

    def choice(self, options: Sequence):
        return options[int(self.rng.integers(len(options)))]

    def int(self, low: int, high: int) -> int:
        """Return a random integer from ``low`` to ``high``, both included."""
        return int(self.rng.integers(low, high + 1))

    def value(self, kinds: str = "biuf", min_ndim: int = 0, max_ndim: int = 9) -> str:
        """Return the name of a random value whose type is of one of the kinds; the last such value is the likeliest."""
        fits = [k for k, a in enumerate(self.avals)
                if _kind(a.dtype) in kinds and min_ndim <= len(a.shape) <= max_ndim]  # fmt: skip
        if not fits:
            raise TypeError("no such value")
        k = fits[-1] if self.rng.random() < 0.4 else self.choice(fits)
        self.shape = tuple(self.avals[k].shape)
        return f"v{k}"

    def match(self, kinds: str = "biuf") -> str:
        fits = [k for k, a in enumerate(self.avals) if _kind(a.dtype) in kinds and a.shape in (self.shape, ())]
        return f"v{self.choice(fits)}" if fits else self.value(kinds)

    def axis(self) -> int:
        n = len(self.shape)
        return self.int(-n, n - 1) if n else 0

    def real(self) -> str:
        return self.choice(["0.5", "2.0", "-1.0", "3.0", "0.25", "1e-3", "-2.5", "1.0", "7.0"])


def _kind(dtype) -> str:
    return "f" if jnp.issubdtype(dtype, jnp.floating) else np.dtype(dtype).kind


Template = Callable[[Draw], str]
TEMPLATES: list[tuple[str, Template]] = []


def template(group: str, weight: int = 1) -> Callable[[Template], Template]:
    """Register a function that draws a line; the probability of its choice is proportional to ``weight``."""

    def register(fn: Template) -> Template:
        TEMPLATES.extend([(group, fn)] * weight)
        return fn

    return register


UNARY_FLOAT = (
    "lax.abs lax.sign lax.floor lax.ceil lax.is_finite lax.exp lax.exp2 lax.log lax.log1p lax.expm1 lax.tanh lax.sin "
    "lax.cos lax.tan lax.asin lax.acos lax.atan lax.sinh lax.cosh lax.asinh lax.acosh lax.atanh lax.logistic lax.sqrt "
    "lax.rsqrt lax.cbrt lax.square lax.erf lax.erfc lax.erf_inv lax.lgamma lax.digamma lax.neg lax.reciprocal jnp.sinc "
    "jnp.round jnp.rint jnp.trunc jnp.signbit jnp.isnan jnp.isinf jnp.nan_to_num jnp.deg2rad jnp.spacing "
    "jax.nn.relu jax.nn.relu6 jax.nn.softplus jax.nn.silu jax.nn.gelu jax.nn.elu jax.nn.sigmoid jax.nn.leaky_relu "
    "jax.nn.hard_tanh jax.nn.log_sigmoid jax.nn.soft_sign jnp.cbrt jnp.log2 jnp.log10 jnp.isposinf jnp.i0 "
    "lax.bessel_i0e lax.bessel_i1e jax.scipy.special.entr jax.scipy.special.ndtr jax.scipy.special.logit"
).split()
UNARY_INT = "lax.abs lax.sign lax.bitwise_not lax.neg lax.square jnp.invert lax.population_count lax.clz".split()
UNARY_ANY = (
    "jnp.logical_not jnp.ravel jnp.abs jnp.positive lax.stop_gradient jnp.asarray jnp.atleast_1d jnp.atleast_2d "
)
UNARY_ANY += "jnp.zeros_like jnp.ones_like lax.full_like_ jnp.real jnp.copy jnp.isreal lax.optimization_barrier"
BINARY_FLOAT = (
    "lax.add lax.sub lax.mul lax.div lax.rem lax.pow lax.max lax.min lax.atan2 lax.nextafter jnp.hypot jnp.fmod "
    "jnp.remainder jnp.floor_divide jnp.copysign jnp.heaviside jnp.logaddexp jnp.fmax jnp.fmin jnp.arctan2 jnp.divide "
    "jnp.logaddexp2 jnp.true_divide jnp.maximum jnp.minimum jnp.power jnp.float_power jnp.nextafter jnp.ldexp_"
).split()
BINARY_ANY = (
    "jnp.add jnp.subtract jnp.multiply jnp.maximum jnp.minimum jnp.equal jnp.not_equal jnp.less jnp.less_equal "
    "jnp.greater jnp.greater_equal jnp.logical_and jnp.logical_or jnp.logical_xor jnp.remainder jnp.floor_divide "
    "jnp.mod jnp.divide jnp.power"
).split()
BINARY_INT = (
    "lax.add lax.sub lax.mul lax.div lax.rem lax.max lax.min lax.bitwise_and lax.bitwise_or lax.bitwise_xor "
    "lax.shift_left lax.shift_right_logical lax.shift_right_arithmetic jnp.left_shift jnp.right_shift jnp.gcd_ "
    "jnp.floor_divide jnp.remainder jnp.fmod jnp.bitwise_and jnp.bitwise_or"
).split()


def _split_names(text: Sequence[str] | str) -> list[str]:
    """Return the names in a text, without the disabled ones, which end in an underscore."""
    names = text.split() if isinstance(text, str) else text
    return [name for name in names if not name.endswith("_")]


# Element-wise
@template("elementwise", 8)
def unary(d: Draw) -> str:
    return f"{d.choice(_split_names(UNARY_FLOAT))}({d.value('f')})"


@template("elementwise", 2)
def unary_int(d: Draw) -> str:
    return f"{d.choice(_split_names(UNARY_INT))}({d.value('iu')})"


@template("elementwise", 2)
def unary_any(d: Draw) -> str:
    return f"{d.choice(_split_names(UNARY_ANY))}({d.value()})"


@template("elementwise", 8)
def binary_float(d: Draw) -> str:
    name = d.choice(_split_names(BINARY_FLOAT))
    first = d.value("f")
    second = d.match("f") if d.rng.random() < 0.7 else d.real()
    return f"{name}({first}, {second})" if d.rng.random() < 0.8 else f"{name}({second}, {first})"


@template("elementwise", 5)
def binary_any(d: Draw) -> str:
    """Functions of two operands of any types, which JAX promotes."""
    return f"{d.choice(BINARY_ANY)}({d.value()}, {d.match()})"


@template("elementwise", 6)
def binary_int(d: Draw) -> str:
    kind = d.choice("iu")
    first = d.value(kind)
    second = d.match(kind) if d.rng.random() < 0.7 else str(d.int(0 if kind == "u" else -3, 40))
    return f"{d.choice(_split_names(BINARY_INT))}({first}, {second})"


@template("elementwise", 3)
def selections(d: Draw) -> str:
    x = d.value()
    return d.choice([
        f"jnp.where({d.match('b')}, {x}, {d.match()})", f"jnp.clip({x}, {d.match()}, {d.match()})",
        f"lax.select({d.match('b')}, {x}, {x})", f"lax.clamp({d.match()}, {x}, {d.match()})",
        f"lax.select_n({d.match('bi')}, {x}, {d.match()})", f"jnp.where({x} > 0, {x}, 0)",
        f"lax.select_n(jnp.clip(lax.convert_element_type({d.match('i')}, np.int32), 0, 2), {x}, -{x}, {x} * 2)",
        f"jnp.select([{d.match('b')}, {d.match('b')}], [{x}, {d.match()}], {d.int(-1, 2)})",
        f"jnp.piecewise({x}, [{x} < 0, {x} >= 1], [-1, lambda t: t * 2, 3])",
    ])  # fmt: skip


@template("elementwise", 3)
def powers(d: Draw) -> str:
    x = d.value("f")
    return d.choice([
        f"lax.integer_pow({x}, {d.int(-4, 7)})", f"{x} ** {d.int(-3, 5)}", f"{x} ** {d.real()}",
        f"lax.round({x}, lax.RoundingMethod({d.int(0, 1)}))", f"jnp.round({x}, {d.int(-1, 2)})",
        f"lax.reduce_precision({x}, {d.int(3, 8)}, {d.int(2, 23)})", f"lax.pow({x}, {d.match('i')})",
        f"lax.integer_pow({d.value('iu')}, {d.int(0, 5)})", f"jnp.power({d.value('iu')}, {d.int(0, 5)})",
        f"lax.nextafter({x}, {d.match('f')})", f"jnp.frexp({x})[{d.int(0, 1)}]", f"jnp.modf({x})[{d.int(0, 1)}]",
        f"jnp.ldexp({x}, {d.match('i')})", f"jnp.divmod({x}, {d.match('f')})[{d.int(0, 1)}]",
    ])  # fmt: skip


@template("types", 5)
def conversions(d: Draw) -> str:
    kind = d.choice(["np.float32", "np.int32", "np.uint32", "bool"] * 12 + ["np.int8", "np.uint8", "np.int16",
                    "np.uint16", "np.float16", "jnp.bfloat16"])  # fmt: skip
    return d.choice([
        f"{d.value()}.astype({kind})", f"lax.convert_element_type({d.value()}, {kind})",
        f"lax.bitcast_convert_type({d.value('iuf')}, {d.choice(['np.float32', 'np.int32', 'np.uint32'])})",
        f"{d.value()}.view({d.choice(['np.float32', 'np.int32', 'np.uint32', 'np.float32'])})",
    ])  # fmt: skip


# Movement
@template("movement", 8)
def movement(d: Draw) -> str:
    """Functions that only move elements."""
    x = d.value(min_ndim=1)
    axis, n, length = d.axis(), len(d.shape), d.shape[d.axis()]
    low, high = d.int(-2, 2), d.int(-1, 2)
    return d.choice([
        f"jnp.flip({x}, {axis})", f"jnp.roll({x}, {d.int(-4, 4)}, {axis})", f"jnp.swapaxes({x}, 0, -1)",
        f"jnp.pad({x}, {d.int(0, 2)}, mode={d.choice(['constant', 'edge', 'reflect', 'wrap', 'symmetric'])!r})",
        f"lax.pad({x}, {x}.dtype.type(1), {[(d.int(-1, 2), d.int(-1, 2), d.int(0, 2)) for _ in range(n)]})",
        f"lax.pad({x}, {d.value(max_ndim=0)}, {[(low, high, d.int(0, 1))] * n})",
        f"jnp.concatenate([{x}, {d.match()}], {axis})", f"jnp.stack([{x}, {d.match()}], {axis})",
        f"jnp.repeat({x}, {d.int(0, 2)}, {axis})", f"jnp.tile({x}, {d.int(1, 2)})", f"lax.rev({x}, [{n - 1}])",
        f"jnp.expand_dims({x}, {axis})", f"jnp.squeeze({x})", f"jnp.reshape({x}, -1)", f"{x}.T",
        f"jnp.moveaxis({x}, 0, -1)", f"lax.slice_in_dim({x}, 0, {length}, {d.int(1, 2)}, {axis})",
        f"{x}[::{d.choice([-1, 2, -2])}]", f"{x}[..., {d.int(-length, length - 1) if length else 0}]",
        f"{x}[..., None]", f"{x}[{d.int(-2, 1)}:]", f"jnp.diff({x}, axis={axis})", f"jnp.diag({x})", f"jnp.tril({x})",
        f"jnp.triu({x}, {d.int(-1, 1)})", f"jnp.broadcast_to({x}, (2, *{x}.shape))", f"jnp.rot90({x})",
        f"jnp.split({x}, [1], {axis})[{d.int(0, 1)}]", f"jnp.array_split({x}, 2, {axis})[{d.int(0, 1)}]",
        f"jnp.append({x}, {d.value()})", f"jnp.insert({x}, 1, {d.value(max_ndim=0)})", f"jnp.delete({x}, 0, {axis})",
        f"jnp.diagonal({x}, {d.int(-1, 1)})", f"jnp.kron({x}, {d.value(max_ndim=1)})", f"jnp.trace({x})",
        f"lax.broadcast({x}, (2,))", f"lax.collapse({x}, 0)", f"jnp.meshgrid({x}, {x})[0]", f"jnp.vander({x}, 3)",
        f"lax.dynamic_index_in_dim({x}, {d.int(-4, 4)}, {axis})", f"jnp.unstack({x}, axis={axis})[0]",
        f"jnp.unstack({x})[-1]", f"lax.split({x}, (1, {max(d.shape[0] - 1, 0)}))[-1]", f"lax.tile({x}, {[2] * n})",
    ])  # fmt: skip


@template("movement", 1)
def constants(d: Draw) -> str:
    x = d.value(max_ndim=1)
    return d.choice([
        f"jnp.arange({d.int(1, 5)}) + {x}[..., None]", f"jnp.eye({d.int(1, 3)}, dtype={x}.dtype)",
        f"jnp.linspace({d.value('f', 0, 0)}, {d.value('f', 0, 0)}, {d.int(1, 4)})",
        f"jnp.full_like({x}, {d.int(-1, 3)})", f"lax.iota(np.{d.choice(['int32', 'uint32', 'float32'])}, 4)",
        f"lax.broadcasted_iota(np.int32, (2, 3), {d.int(0, 1)})", f"jnp.tri(3, dtype={x}.dtype)",
        f"jax.nn.one_hot({d.value('i', 0, 1)}, 3)", f"jnp.logspace({d.value('f', 0, 0)}, 1.0, 3)",
    ])  # fmt: skip


@template("movement", 3)
def foldable_constants(d: Draw) -> str:
    """Constants that the engines fold; later lines are then often computed before the program runs."""
    floats = "0.0 -0.0 1.0 -1.0 0.5 2.5 -3.5 np.nan np.inf -np.inf 1e30 3e9 -3e9 255.5 1e-30 100000.0".split()
    integers = "0 1 -1 3 -7 127 128 255 256 2147483647 -2147483648 65536".split()
    return d.choice([
        f"lax.full((3,), np.float32({d.choice(floats)}))", f"lax.full((), np.int32({d.choice(integers)}))",
        f"lax.full((3,), np.uint32(np.int64({d.choice(integers)}) & 0xffffffff))",
        f"lax.full((), {d.choice(['True', 'False'])})",
        f"np.float32([{d.choice(floats)}, {d.choice(floats)}, {d.choice(floats)}]) + 0 * jnp.arange(3)",
        f"jnp.asarray(np.float32([{d.choice(floats)}, {d.choice(floats)}, {d.choice(floats)}]))",
        f"jnp.asarray(np.int32([{d.choice(integers)}, {d.choice(integers)}, {d.choice(integers)}]))",
    ])  # fmt: skip


# Reductions
REDUCTIONS = "sum prod max min mean var std argmax argmin any all nansum nanmax nanmin nanargmax_ cumsum cumprod "
REDUCTIONS += "count_nonzero ptp nanmean median sort argsort logical_or.reduce_ nancumsum"


@template("reductions", 8)
def reductions(d: Draw) -> str:
    x = d.value(min_ndim=1)
    axis, n = d.axis(), len(d.shape)
    back = d.choice(["True", "False"])
    return d.choice([
        f"jnp.{d.choice(_split_names(REDUCTIONS))}({x}, axis={axis})",
        f"jnp.{d.choice(_split_names(REDUCTIONS))}({x}, {axis})",
        f"jnp.{d.choice(_split_names(REDUCTIONS))}({x})",
        f"lax.{d.choice(['cumsum', 'cumprod', 'cummax', 'cummin', 'cumlogsumexp'])}({x}, {axis % n}, reverse={back})",
        f"lax.reduce_{d.choice(['max', 'min', 'sum', 'prod', 'and', 'or', 'xor'])}({x}, ({axis % n},))",
        f"lax.{d.choice(['argmax', 'argmin'])}({x}, {axis % n}, {d.choice(['np.int32', 'np.uint32', 'np.int8'])})",
        f"lax.reduce({x}, {x}.dtype.type({d.int(0, 2)}), lax.{d.choice(['add', 'mul', 'max', 'min'])}, ({axis % n},))",
        f"lax.reduce(({x}, {x}), ({x}.dtype.type(1), {x}.dtype.type(0)), "
        f"lambda a, b: (lax.max(a[0], b[0]), lax.add(a[1], b[1])), ({axis % n},))[{d.int(0, 1)}]",
        f"jnp.linalg.norm({x}, axis={axis})", f"jax.nn.softmax({x}, {axis})", f"jax.nn.logsumexp({x}, {axis})",
        f"jax.nn.log_softmax({x}, {axis})", f"jnp.quantile({x}, 0.3, axis={axis})", f"jnp.cumsum({x}, {axis})",
        f"jax.nn.standardize({x}, {axis})", f"jnp.ptp({x}, {axis})", f"jnp.average({x}, {axis})",
        f"jnp.unwrap({x}, axis={axis})", f"jnp.gradient({x}, axis={axis})", f"jnp.trapezoid({x}, axis={axis})",
        f"lax.reduce_window({x}, {x}.dtype.type(0), lax.add, {(2,) * n}, {(1,) * n}, 'SAME')",
        f"jnp.lexsort(({x}, {d.match()}))", f"lax.top_k({x}, 2)[{d.int(0, 1)}]", f"jnp.unique({x}, size=3)",
        f"lax.associative_scan(jnp.{d.choice(['add', 'multiply', 'maximum'])}, {x}, axis={axis}, reverse={back})",
    ])  # fmt: skip


@template("reductions", 3)
def sorts(d: Draw) -> str:
    x = d.value(min_ndim=1)
    axis = d.axis() % max(len(d.shape), 1)
    y, z = d.match(), d.match()
    stable = d.choice(["True", "False"])
    return d.choice([
        f"lax.sort(({x}, {y}), {axis}, {stable}, num_keys={d.int(1, 2)})[1]",
        f"lax.sort(({x}, {y}, {z}), {axis}, num_keys={d.int(1, 3)})[{d.int(0, 2)}]",
        f"jnp.sort({x}, {axis}, stable={stable}, descending={d.choice(['True', 'False'])})",
        f"jnp.argsort({x}, {axis}, stable=True, descending={d.choice(['True', 'False'])})",
        f"lax.sort_key_val({x}, {y})[1]", f"jnp.partition({x}, 1, {axis})", f"jnp.searchsorted(jnp.sort({x}), {y})",
        f"jnp.digitize({x}, np.array([-1.0, 0.0, 2.0]))", f"jnp.interp({x}, np.arange(3.0), np.arange(3.0) ** 2)",
    ])  # fmt: skip


# Products
@template("products", 4)
def products(d: Draw) -> str:
    kind = d.choice(["f", "f", "iu", "biuf"])
    x = d.value(kind, 1)
    y = d.match(kind)
    z = d.value(kind, 1)
    return d.choice([
        f"{x} @ {z}", f"{x} @ {y}.T", f"jnp.outer({x}, {z})", f"jnp.dot({x}, {y})", f"jnp.vdot({x}, {y})",
        f"jnp.cross({x}, {y})", f"jnp.einsum('...i,...i->...', {x}, {y})", f"jnp.inner({x}, {z})",
        f"jnp.tensordot({x}, {y}, 1)", f"jnp.einsum('ij,kj->ik', {x}, {z})", f"jnp.convolve({x}, {z})",
        f"lax.dot({x}, {y}, preferred_element_type=np.{d.choice(['float32', 'int32'])})",
        f"lax.dot_general({x}, {y}, ((({len(d.shape) - 1},), ({len(d.shape) - 1},)), ((), ())))",
        f"lax.dot_general({x}, {y}, (((), ()), ((0,), (0,))))", f"jnp.correlate({x}, {z}, 'same')",
        f"jnp.polyval({x}, {z})", f"lax.batch_matmul({x}, {y})", f"jnp.vecdot({x}, {y})", f"jnp.matvec({x}, {z})",
    ])  # fmt: skip


@template("linear algebra", 2)
def systems(d: Draw) -> str:
    """Small linear systems; their matrices are far from singular if their elements are moderate."""
    x = d.value("f", 2, 3)
    n = d.shape[-1]
    x = f"jnp.clip(jnp.nan_to_num({x}), -4, 4)"  # results of LAPACK for NaN depend on the order of its operations
    spd = f"({x} @ jnp.swapaxes({x}, -1, -2) + 4 * jnp.eye({x}.shape[-2]))"
    b = d.choice([f"jnp.ones({x}.shape[-2])", f"{spd}[..., 0]"])
    lower = d.choice(["True", "False"])
    return d.choice([
        f"jnp.linalg.cholesky({spd})", f"jnp.linalg.solve({spd}, {b})", f"jnp.linalg.inv({spd})",
        f"jnp.linalg.det({spd})", f"jax.scipy.linalg.solve_triangular({spd}, {b}, lower={lower})",
        f"jax.scipy.linalg.solve_triangular({spd}, {b}, trans={d.int(0, 1)}, unit_diagonal=True, lower={lower})",
        f"jax.scipy.linalg.cho_solve((jnp.linalg.cholesky({spd}), True), {b})", f"jnp.linalg.matrix_power({x}, 2)",
        f"jax.scipy.linalg.lu({spd})[{d.int(0, 2)}]", f"jnp.linalg.slogdet({spd})[{d.int(0, 1)}]",
        f"lax.linalg.triangular_solve({spd}, {spd}, left_side={lower}, lower={d.choice(['True', 'False'])})",
        f"lax.linalg.lu({spd})[{d.int(0, 2)}]", f"jnp.linalg.norm({x})", f"jax.scipy.linalg.expm(0.1 * {x})",
        f"jnp.linalg.qr({spd})[1]", f"jnp.linalg.pinv({spd})", f"jnp.linalg.eigvalsh({spd})", f"jnp.eye({n}) @ {x}",
    ])  # fmt: skip


# Indexing
@template("indexing", 8)
def gathers(d: Draw) -> str:
    x = d.value(min_ndim=1)
    axis, length = d.axis(), max(d.shape[0], 1)
    i, j = d.value("iu", 0, 1), d.value("iu", 0, 1)
    mode = d.choice(["clip", "fill", "wrap", "drop", "promise_in_bounds"])
    inside = f"jnp.clip({i}, 0, {length - 1})"
    known = [d.int(-length - 1, length) for _ in range(d.int(1, 3))]
    return d.choice([
        f"{x}[{i}]", f"{x}[{inside}]", f"{x}[{i}, ...]", f"{x}[..., {j}]", f"{x}[{i}, {j}]",
        f"{x}[{inside}, {d.int(0, 1)}]",
        f"{x}.at[{i}].get(mode={mode if mode != 'promise_in_bounds' else 'clip'!r}, fill_value={d.int(0, 3)})",
        f"{x}.at[{inside}].get(mode={mode!r}, unique_indices=True)",
        f"jnp.take({x}, {i}, {axis}, mode={mode if mode in ('clip', 'fill', 'wrap') else 'clip'!r})",
        f"jnp.take({x}, np.array({known}), {axis})", f"{x}[np.array({known})]", f"{x}[:, {i}]", f"{x}[{i}, :, None]",
        f"jnp.take({x}, np.array({known}), {axis}, mode='fill')", f"{x}.at[np.array({known})].get(mode={mode!r})",
        f"jnp.take_along_axis({x}, {d.value('i', 1)}, {axis}, mode={d.choice(['clip', 'fill'])!r})",
        f"lax.dynamic_slice_in_dim({x}, {d.value('iu', 0, 0)}, {d.int(1, length)}, 0)",
        f"lax.dynamic_slice({x}, [{d.value('iu', 0, 0)}] * {x}.ndim, {[d.int(1, max(s, 1)) for s in d.shape]})",
        f"lax.dynamic_index_in_dim({x}, {d.value('iu', 0, 0)}, 0, keepdims={d.choice(['True', 'False'])})",
        f"{x}[{x} > 0]", f"jnp.choose({i} % 2, [{x}, {x} + 1], mode='wrap')", f"{x}[jnp.argmax({x})]",
        f"{x}[jnp.argsort({x})]", f"jnp.take_along_axis({x}, jnp.argmin({x}, {axis}, keepdims=True), {axis})",
        f"jax.vmap(lambda r, k: r[k], (0, None))({x}, {i})", f"jax.vmap(lambda r, k: r[k])({x}, {x}.astype(int))",
        f"{x}[1:, {i}]",
        f"jax.vmap(lambda r: lax.dynamic_slice(r, ({d.value('iu', 0, 0)},), (2,)))({x})",
    ])  # fmt: skip


@template("indexing", 4)
def tables(d: Draw) -> str:
    i, j = d.value("iu", 0, 1), d.value("iu", 0, 0)
    kind = d.choice(["np.float32", "np.int32", "np.uint32", "np.bool_"])
    x = f"jnp.asarray(({kind})(np.arange({3 * d.int(9, 80)}) * {d.int(1, 7)} % 11).reshape(-1, 3))"
    mode = d.choice(["clip", "fill", "wrap", "drop"])
    return d.choice([
        f"{x}[{i}]", f"{x}[{i}, {j}]", f"{x}[:, 1][{i}]", f"{x}.at[{i}, 2].get(mode={mode!r})", f"{x}[{j}][{j} % 3]",
        f"lax.dynamic_slice({x}, [{j}, {j}], (2, 2))", f"{x}.T[{j}, {i}]", f"jnp.take({x}, {i}, 0, mode='wrap')",
        f"jax.vmap(lambda k: {x}[k, {j}])(jnp.arange(3) + {j}.astype(np.int32))",
    ])  # fmt: skip


@template("indexing", 10)
def scatters(d: Draw) -> str:
    x = d.value(min_ndim=1)
    length, n = max(d.shape[0], 1), len(d.shape)
    i, j = d.value("iu", 0, 1), d.value("iu", 0, 1)
    known = [d.int(-length - 1, length) for _ in range(d.int(1, 3))]
    places = [f"{i}", f"np.array({known})", f"{d.int(-length, length - 1)}", f"{d.int(0, 1)}:", f"{i}, {j}",
              f"..., {j}",
              f"jnp.clip({i}, 0, {length - 1})", "::2", f":, {i}", f"np.array({known}), ...", f"{i}, :",
              f"np.array({known}), {j}", "...", f"{d.int(-2, 0)}, {d.int(0, 1)}"]  # fmt: skip
    place = d.choice(places)
    flags = d.choice(["", "", ", mode='clip'", ", mode='drop'", ", mode='fill'", ", mode='wrap'"])
    if place in ("...", "::2") and d.rng.random() < 0.5:
        flags = ", indices_are_sorted=True, unique_indices=True"
    update = d.choice([f"{d.value(max_ndim=1)}", f"{d.value(max_ndim=0)}", "2", f"{x}[{place}]", f"{x}[0]"])
    method = d.choice(["set", "set", "add", "multiply", "min", "max", "subtract", "divide", "power"])
    function = d.choice(["lambda t: t * 2", "jnp.sin", "lambda t: -t", "jnp.sign", "lambda t: jnp.where(t > 0, t, 1)",
                         "jnp.abs", "lambda t: t + 1", "lambda t: t * t - t", "jnp.zeros_like"])  # fmt: skip
    return d.choice(
        [f"{x}.at[{place}].{method}({update}{flags})"] * 8
        + [f"{x}.at[{place}].apply({function}{flags})"] * 4
        + [
            f"lax.dynamic_update_slice_in_dim({x}, {x}[:{d.int(1, length)}], {d.value('iu', 0, 0)}, 0)",
            f"lax.dynamic_update_slice({x}, {x}[:1], [{d.value('iu', 0, 0)}] * {n})",
            f"lax.dynamic_update_index_in_dim({x}, {x}[0], {d.value('iu', 0, 0)}, 0)",
            f"jax.vmap(lambda r, k: r.at[k].set(1, mode={d.choice(['drop', 'clip'])!r}), (0, None))({x}, {i})",
            f"jax.vmap(lambda r, k: r.at[k].{d.choice(['add', 'apply'])}(jnp.sign({d.value(max_ndim=0)}) "
            f"if {d.int(0, 1)} else jnp.abs))({x}, {x}.astype(int))",
            f"jax.vmap(lambda r, k: r.at[k].add(1))({x}, jnp.clip({x}.astype(int), -1, 3))",
            f"jnp.put_along_axis({x}, jnp.argmax({x}, 0, keepdims=True), 2, 0, inplace=False)",
            f"jax.ops.segment_sum({x}, jnp.clip({x}.astype(int), -1, 2), 3)",
            f"jax.ops.segment_max({x}, {d.match('i')}, 3)", f"jnp.bincount(jnp.clip({i}, 0, 3), length=3)",
            f"jnp.histogram({x}, bins=3, range=(-2.0, 2.0))[0]", f"jnp.fill_diagonal({x}, 3, inplace=False)",
            _windowed_scatter(d, x),
        ]
    )  # fmt: skip


def _windowed_scatter(d: Draw, x: str) -> str:
    rows = d.value("i", 1, 1)
    mode = d.choice(["clip", "fill", "promise_in_bounds"])
    kind = d.choice(["", "_add", "_mul", "_min", "_max", "_sub"])
    numbers = "lax.ScatterDimensionNumbers(update_window_dims=(1,), inserted_window_dims=(), "
    numbers += "scatter_dims_to_operand_dims=(0,))"
    inside = f"jnp.clip({rows}, 0, 1)" if mode == "promise_in_bounds" else rows
    return (
        f"lax.scatter{kind}(jnp.ravel({x}), {inside}[:, None], jnp.ones(({rows}.shape[0], 2), {x}.dtype) * 2, "
        f"{numbers}, "
        f"mode={mode!r})"
    )


# Control flow
@template("control flow", 6)
def control_flow(d: Draw) -> str:
    x = d.value("f") if d.rng.random() < 0.7 else d.value("iu")
    test, index = d.value("b", 0, 0), d.value("iu", 0, 0)
    length = d.shape[0] if d.shape else 1
    body = d.choice(["c * 0.5 + 1", "jnp.sin(c)", "-c", "c[::-1]", "c * c", "jnp.where(c > 1, c - 1, c + 2)", "c + k"])
    pair = d.choice(["c + y, c * y", "y, c", "jnp.maximum(c, y), c", "c, (y, c - y)[0]", "c * 0.5 + y, None"])
    back = d.choice(["True", "False"])
    inner = d.choice(["jnp.sin(t) * t", "t * t", "jnp.sum(t)", "jax.nn.relu(t)", "jnp.linalg.norm(t)", "jnp.tanh(t)"])
    limit, count = d.int(1, 9), d.value("i", 0, 0)
    return d.choice([
        f"lax.cond({test}, lambda t: t * 2, lambda t: t + t, {x})", f"lax.cond({test}, jnp.sin, jnp.cos, {x})",
        f"lax.cond({x}.sum() > 0, lambda: {x}, lambda: -{x})",
        f"lax.switch({index}, [lambda t: t, lambda t: -t, lambda t: t * t], {x})",
        f"lax.fori_loop(0, {d.int(0, 4)}, lambda k, c: (lambda c: {body})(c).astype(c.dtype), {x})",
        f"lax.fori_loop({d.int(-1, 1)}, jnp.clip({count}, 0, 6), lambda k, c: (({body}).astype(c.dtype)), {x})",
        f"lax.while_loop(lambda c: (c[1] < {limit}) & (c[0].sum() < 9), "
        f"lambda c: (c[0] + c[0], c[1] + 1), ({x}, 0))[0]",
        f"lax.while_loop(lambda c: c < {limit}, lambda c: c + 1 + jnp.sign(c) ** 2, jnp.clip({count}, -5, 5))",
        f"lax.scan(lambda c, y: ({pair}), {x}[0], {x}, reverse={back})[0]",
        f"lax.scan(lambda c, y: ({pair}), {x}[0], {x}, reverse={back})[1]",
        f"lax.scan(lambda c, _: (c * 0.5 + 1, c), {x}, None, length={d.int(1, 4)})[{d.int(0, 1)}]",
        f"lax.scan(lambda c, y: (c + 1, c * y), 0, {x}, unroll={d.int(1, 2)})[1]",
        f"lax.map(lambda t: {inner}, {x})", f"jax.jit(lambda t: {inner})({x})", f"jax.vmap(lambda t: {inner})({x})",
        f"jax.checkpoint(lambda t: {inner})({x})", f"jax.grad(lambda t: jnp.sum({inner}))({x})",
        f"jax.jacfwd(lambda t: {inner})({x})", f"jax.jvp(lambda t: {inner}, ({x},), ({x},))[1]",
        f"jax.value_and_grad(lambda t: jnp.sum(jnp.sin(t)))({x})[1]",
        f"jax.lax.platform_dependent({x}, cpu=jnp.sin, default=jnp.cos)",
        f"jax.hessian(lambda t: jnp.sum(t ** 3))({x})", f"jax.device_put({x})", f"lax.optimization_barrier({x})",
        f"jnp.vectorize(lambda a, b: a * b + 1)({x}, {d.match()})", f"jnp.apply_along_axis(jnp.sum, 0, {x})",
        f"lax.fori_loop(0, {length}, lambda k, c: c.at[k].set(c[k] * 2 + k), {x})",
        f"lax.scan(lambda k, y: (jax.random.fold_in(k, 1), y * 2), jax.random.key(3), {x})[1]",
    ])  # fmt: skip


# Random numbers
@template("random", 2)
def random_numbers(d: Draw) -> str:
    key = f"jax.random.fold_in(jax.random.key({d.choice(['3', d.value('iu', 0, 0)])}), {d.value('iu', 0, 0)})"
    return d.choice([
        f"jax.random.bits({key}, (3,))", f"jax.random.uniform({key}, (3,))", f"jax.random.key_data({key})",
        f"jax.random.randint({key}, (2,), -5, 5)", f"jax.random.bernoulli({key}, 0.4, (3,))",
        f"jax.random.uniform(jax.random.split({key}, 3)[{d.int(0, 2)}])", f"jax.random.permutation({key}, 4)",
        f"jax.random.choice({key}, 4, (2,))", f"jax.random.bits({key}, (2,), np.uint8)",
        f"jax.random.normal({key}, (2,))",
        f"jax.vmap(lambda k: jax.random.bits(k))(jax.random.split({key}, 3))", f"jax.random.exponential({key}, (2,))",
        f"lax.scan(lambda c, k: (c + 1, jax.random.bits(k)), 0, jax.random.split({key}, 2))[1]",
        f"jax.random.key_data(lax.scan(lambda k, _: tuple(jax.random.split(k)), {key}, None, length=2)[1])",
        f"jax.random.key_data(jax.random.split({key}, 3)[{d.value('iu', 0, 0)}])",
        f"jax.random.key_data(jnp.where({d.value('b', 0, 0)}, {key}, jax.random.key(0)))",
    ])  # fmt: skip


def draw_program(rng: np.random.Generator, input_shapes: dict[str, jax.ShapeDtypeStruct], n_lines: int) -> Program:
    inputs = tuple(input_shapes)
    avals = list(input_shapes.values())
    lines: list[str] = []
    while len(lines) < n_lines:
        _, fn = TEMPLATES[int(rng.integers(len(TEMPLATES)))]
        line, aval = _draw_line(rng, fn, avals)
        if aval is not None:
            lines.append(line)
            avals.append(aval)
    return remove_unused_lines(Program(inputs, tuple(lines)))


def _draw_line(rng: np.random.Generator, fn: Template, avals: Sequence) -> tuple[str, Any]:
    try:
        line = fn(Draw(rng, avals))
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # an unsafe conversion, or something deprecated
            aval = jax.eval_shape(lambda *values: evaluate(line, values), *avals)
    except Exception:  # any error: JAX refuses the line
        return "", None
    if not isinstance(aval, jax.ShapeDtypeStruct) or aval.size > MAX_ELEMENTS or aval.dtype.kind == "c":
        return "", None
    if jax.dtypes.issubdtype(aval.dtype, jax.dtypes.extended):
        return "", None
    return line, aval


def remove_unused_lines(program: Program) -> Program:
    """Return a program without the inputs and lines that its last line does not need."""
    return prune_program(program, len(program.inputs) + len(program.lines) - 1)


def prune_program(program: Program, last: int) -> Program:
    """Return a program without the lines and inputs that the value with index ``last`` does not need."""
    import re

    n = len(program.inputs)
    used = {last}
    for k in range(last, n - 1, -1):
        if k in used:
            used |= {int(m) for m in re.findall(r"\bv(\d+)\b", program.lines[k - n])}
    order = sorted(used)
    new_index = {old_index: k for k, old_index in enumerate(order)}
    lines = tuple(
        re.sub(r"\bv(\d+)\b", lambda m: f"v{new_index[int(m[1])]}", program.lines[k - n]) for k in order if k >= n
    )
    return Program(tuple(program.inputs[k] for k in order if k < n), lines)
