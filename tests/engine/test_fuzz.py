"""The fuzzer, and programs for which it found wrong results of an engine."""

import numpy as np
import pytest
from fuzz import Case, Fuzzer
from programs import Program

from crazysim.engine.lowering.jaxprs import RULES, constants

PROGRAMS_ONCE_WRONG = {
    # A reduction to an array without elements has no size to be inferred.
    "reduction to nothing": (("b3",), "jnp.unique(v0[:1], size=3)"),
    # Both rows of an exchange in a sort were views of one array: medians of matrices were wrong.
    "sort along an axis of a matrix": (("f23",), "jnp.sort(v0, 0, descending=True)"),
    "median along an axis of a matrix": (("f33",), "jnp.median(v0, -2)"),
    "sort with a second operand": (("f33", "i"), "lax.sort((v0, v0 * v1), 0, False, num_keys=2)[1]"),
    "sort by bools": (("b3", "i3"), "lax.sort_key_val(v0, v1)[1]"),
    "order of NaN in top_k": (("f33",), "jnp.partition(v0, 1, 1)"),
    # In XLA each exchange computed the variances anew, with another sign of NaN, so that one was lost.
    "NaN of either sign in top_k": (("f33",), "lax.top_k(jnp.var(v0, axis=0), 2)[0]"),
    "top_k of equals": (("i23",), "lax.top_k(v0, 2)[1]"),
    "rows without elements": (("f33",), "jnp.gradient(v0[:2], axis=0)"),
    "power with an integer exponent": (("f23", "i23"), "lax.pow(v0, v1)"),
    "sign of zeros and of unsigned numbers": (("f33", "u3"), "lax.sign(v0) * lax.sign(v1).astype(np.float32)"),
    "sign of a zero that is known": ((), "lax.full((3,), np.float32(-0.0))"),
    "bits as the same type": (("f3",), "lax.bitcast_convert_type(v0, np.float32)"),
    "a quotient of zeros": (("f23", "b"), "v0.at[0:].divide(v1)"),
    "a product with a zero that is known": (("f4",), "v0 * np.float32([0.0, 1.0, -0.0, 2.0])"),
    "the root as a power": (("f3",), "jnp.float_power(v0, 0.5)"),
    "a matrix that is not positive definite": (
        ("f33",),
        "jnp.linalg.cholesky(jnp.round(jnp.clip(jnp.nan_to_num(v0), -3, 3)))",
    ),
    "a singular matrix": ((), "jax.scipy.linalg.lu(lax.full((3, 3), np.float32(1.0)))[2]"),
    "a function of two reductions": (
        ("i23",), "lax.reduce((v0, v0), (0, 1), lambda a, b: (a[0] + b[0], lax.max(a[1], b[1])), (1,))[1]"
    ),
    "a scan over keys": (
        ("i",),
        "lax.scan(lambda c, k: (c, jax.random.bits(k)), 0, jax.random.split(jax.random.key(v0), 2))[1]",
    ),
    "a scan over nothing": (("f3",), "lax.scan(lambda c, y: (c + y, c), v0[0], v0[:0])[1].sum() + v0"),
    "NaN as an integer": ((), "lax.full((3,), np.float32(np.nan)).astype(np.int32)"),
    "too large for an integer": ((), "lax.full((3,), np.float32(3e9)).astype(np.uint32)"),
    "a product of bools": (("b3",), "jnp.outer(v0, v0) @ v0 | (v0 @ v0)"),
    "angles of any size": (("f33",), "jnp.sin(v0) + jnp.cos(v0 * 1e7)"),
    "lgamma of infinity": (("f3",), "lax.lgamma(v0)"),
    # XLA's threads on a CPU take subnormal numbers for zero; NumPy's do not by themselves.
    "infinity times a subnormal number": (("f33",), "jnp.sort(jnp.deg2rad(v0), 0) * np.float32(np.inf)"),
    "order of subnormal numbers": (("f4",), "jnp.argsort(v0 * np.float32([0.0, 0.5, -0.5, 1e-8]))"),
    "device_put": (("f3",), "jax.device_put(v0) + 1"),
    # pmap of jax 0.10 and Brax's training begin with one; elements stay where they are.
    "reshard": (
        ("f3",),
        "jax.sharding.reshard(v0, jax.sharding.NamedSharding(jax.make_mesh((1,), ('i',)), jax.P())) + 1",
    ),
}  # fmt: skip
"""Inputs and the line of a program, by the former defect. Inputs are those of ``fuzz``: ``f23`` is float32, (2, 3)."""

REFUSED_PROGRAMS = {
    "platform_index": (("f3",), "lax.platform_dependent(v0, cpu=jnp.sin, default=jnp.cos)"),
    "dot_general": (("f33",), "lax.dot(v0, v0, preferred_element_type=np.int32)"),
    "svd": (("f33",), "jnp.linalg.svd(jnp.nan_to_num(v0))[1]"),
    "float16": (("f3",), "v0.astype(np.float16)"),
}
"""Inputs and the line of a program, by a word of the reason for which the engine refuses it."""


@pytest.fixture(scope="module")
def fuzzer():
    return Fuzzer(0)


def make_cases(programs, scope="drone"):
    return [Case(Program(inputs, (line,)), scope) for inputs, line in programs.values()]


@pytest.mark.parametrize("scope", ["drone", "world"])
def test_programs_that_were_wrong_give_the_results_of_plain(scope):
    fuzzer = Fuzzer(1)
    programs = (
        PROGRAMS_ONCE_WRONG
        if scope == "drone"
        else {name: PROGRAMS_ONCE_WRONG[name] for name in ("sort by bools", "top_k of equals")}
    )
    findings = list(fuzzer.check(make_cases(programs, scope)))
    assert not findings, "\n".join(map(str, findings))
    assert not fuzzer.counts["refused"], fuzzer.refused
    assert fuzzer.counts["compared on lanes"] == len(programs)


def test_refused_programs_are_refused_when_the_step_is_planned(fuzzer):
    for name, program in REFUSED_PROGRAMS.items():
        fuzzer.refused.clear()
        assert not list(fuzzer.check(make_cases({name: program})))
        (reason,) = fuzzer.refused
        assert name in reason


def test_random_programs_give_the_results_of_plain(fuzzer):
    """Few programs are run here; ``python tests/engine/fuzz.py --programs 20000`` runs many."""
    findings = list(fuzzer.check(fuzzer.draw(8)))
    assert not findings, "\n".join(map(str, findings))
    assert fuzzer.counts["compared on lanes"] >= 4


def subtract_from_zero(ctx, eqn, args):
    """Return 0 - x, which has another sign where x is zero."""
    return [ctx.elementwise("sub", [constants(0, np.float32), args[0]], np.float32)]


@pytest.mark.parametrize(
    ("name", "wrong", "line"),
    [
        ("rev", lambda ctx, eqn, args: args, "jnp.flip(v0)"),
        ("neg", subtract_from_zero, "-v0"),
        ("lgamma", lambda ctx, eqn, args: [ctx.elementwise("digamma", args, np.float32)], "lax.lgamma(v0)"),
    ],
)
def test_a_wrong_rule_is_found(monkeypatch, name, wrong, line):
    monkeypatch.setitem(RULES, name, wrong)
    (finding,) = Fuzzer(2, engines=("interpret",)).check([Case(Program(("f33",), (line,)), "drone")])
    assert finding.engine == "interpret"
    assert line in str(finding)


def test_a_rule_that_fails_is_found_and_a_program_that_jax_refuses_is_not(monkeypatch):
    monkeypatch.setitem(RULES, "rev", lambda ctx, eqn, args: 1 / 0)
    fuzzer = Fuzzer(2, engines=("interpret",))
    (finding,) = fuzzer.check([Case(Program(("f33",), ("jnp.flip(v0)",)), "drone")])
    assert finding.engine == "lowering"
    assert "ZeroDivisionError" in finding.description
    monkeypatch.setattr(fuzzer, "run", lambda *args: 1 / 0)
    assert not list(fuzzer.check([Case(Program(("f33",), ("jnp.flip(v0)",)), "drone")]))
    assert fuzzer.counts["refused by JAX"] == 1
