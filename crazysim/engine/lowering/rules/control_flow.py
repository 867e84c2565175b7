"""Rules for calls (inlined), branches (all computed, one selected) and loops (lowered to loops or unrolled)."""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np

from crazysim.engine.errors import LimitError
from crazysim.engine.ir.blocks import Block, Element, constant, is_constant
from crazysim.engine.jaxcompat import ClosedJaxpr, JaxprEqn, as_function, close_jaxpr, expand_primitive, jaxpr_as_fun
from crazysim.engine.lowering.jaxprs import (
    MAX_UNROLL,
    ElementArray,
    Lowering,
    UnsupportedError,
    as_elements,
    constants,
    rule,
    scalars,
)


@rule("jit", "pjit", "closed_call", "core_call", "remat2", "checkpoint", "custom_lin", "run_state")
def _call(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return ctx.lower(close_jaxpr(eqn.params.get("jaxpr") or eqn.params["call_jaxpr"]), args)


@rule("pure_callback", "io_callback")
def _host_call(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    raise LimitError("it calls a function on the host")


@rule("custom_jvp_call")
def _custom_jvp(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return _lower_with_derivative(ctx, eqn, args, close_jaxpr(eqn.params["call_jaxpr"]))


@rule("stop_gradient")
def _stop_gradient(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    aval = eqn.invars[0].aval
    if not jax.numpy.issubdtype(aval.dtype, np.inexact) or all(map(is_constant, args[0].reshape(-1))):
        return args
    called_jaxpr = jax.make_jaxpr(lambda x: x)(jax.ShapeDtypeStruct(aval.shape, aval.dtype))
    return _lower_with_derivative(ctx, eqn, args, called_jaxpr)


@rule("call_hi_primitive")
def _expand(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    # If the results have no derivative, such as the indices from ``jnp.searchsorted``, the expansion is lowered like
    # any call. It then reads tables where the operands are tables.
    avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
    called_jaxpr = jax.make_jaxpr(expand_primitive(eqn))(*avals)
    if not any(jax.numpy.issubdtype(v.aval.dtype, np.inexact) for v in eqn.outvars):
        return ctx.lower(called_jaxpr, args)
    return _lower_with_derivative(ctx, eqn, args, called_jaxpr)


def _lower_with_derivative(
    ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray], called_jaxpr: ClosedJaxpr
) -> list[ElementArray]:
    body = ctx.make_inner()
    block = body.finish(body.lower(called_jaxpr, [_add_inputs(body, x) for x in args]))

    @functools.cache
    def derivative() -> Block:
        call_fn = as_function(eqn)
        avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        tangent_jaxpr = jax.make_jaxpr(lambda x, dx: jax.jvp(call_fn, x, dx)[1])(avals, avals)
        tangents = Lowering()
        inputs = [_add_inputs(tangents, x) for x in (*args, *args)]
        return tangents.finish(tangents.lower(tangent_jaxpr, inputs))

    return _add_operation(ctx, "custom_jvp", eqn, scalars(*args), (block,), (("derivative", derivative),))


@rule("custom_linear_solve")
def _linear_solve(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    n_before_solve = lengths.matvec + lengths.vecmat
    solve_consts = args[n_before_solve : n_before_solve + lengths.solve]
    n_consts = n_before_solve + lengths.solve + lengths.transpose_solve
    return ctx.lower(close_jaxpr(jaxprs.solve), [*solve_consts, *args[n_consts:]])


@rule("cond")
def _cond(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    index_array, *operands = args
    branches = [close_jaxpr(b) for b in eqn.params["branches"]]
    index = index_array[()]
    if is_constant(index):
        return ctx.lower(branches[int(np.clip(index, 0, len(branches) - 1))], operands)
    outs = [ctx.lower(b, operands) for b in branches]
    results = []
    for k, v in enumerate(eqn.outvars):
        selected = outs[-1][k]
        for i in range(len(branches) - 2, -1, -1):
            is_at_most = ctx.scalar("le", index, constant(i, index.dtype), dtype=bool)
            operands_of_select = [as_elements([is_at_most], ()), selected, outs[i][k]]
            selected = ctx.elementwise("select_n", operands_of_select, v.aval.dtype)
        results.append(selected)
    return results


@rule("platform_index")
def _platform_index(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    platforms = list(eqn.params["platforms"])
    named = sorted({name for names in platforms for name in names or ()} & {"cpu", "gpu", "cuda", "rocm"})
    if named or None not in platforms:
        raise UnsupportedError(
            f"primitive 'platform_index' with a branch for {', '.join(named) or 'some platforms only'}"
        )
    return [constants(platforms.index(None), np.int32)]


@rule("scan")
def _scan(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    params, length = eqn.params, eqn.params["length"]
    body = close_jaxpr(params["jaxpr"])
    # The parameters with the numbers of constants, carried and stacked operands have different names in different
    # versions of JAX, so these are counted by axes: a stacked operand has one axis more than in the body.
    n_carry = sum(o.aval.ndim == v.aval.ndim for o, v in zip(eqn.outvars, body.jaxpr.outvars, strict=True))
    n_stacked = sum(o.aval.ndim > v.aval.ndim for o, v in zip(eqn.invars, body.jaxpr.invars, strict=True))
    n_consts = len(eqn.invars) - n_carry - n_stacked
    consts, carry, xs = args[:n_consts], args[n_consts : n_consts + n_carry], args[n_consts + n_carry :]
    if len(body.jaxpr.outvars) == n_carry and not xs and length > 1:
        inner = ctx.make_inner()
        inputs = [_add_inputs(inner, x) for x in carry]
        block = inner.finish(inner.lower(body, [*consts, *inputs]))
        return _add_operation(ctx, "loop", eqn, scalars(*carry), (block,), (("length", length),))
    if length > MAX_UNROLL:
        raise UnsupportedError(
            f"primitive 'scan' with operands for each of {length} iterations; at most {MAX_UNROLL} are unrolled"
        )
    outs_by_iteration: list[list[ElementArray]] = []
    for i in range(length)[::-1] if params["reverse"] else range(length):
        outs = ctx.lower(body, [*consts, *carry, *(x[i, ...] for x in xs)])
        carry = outs[:n_carry]
        outs_by_iteration.append(outs[n_carry:])
    if params["reverse"]:
        outs_by_iteration.reverse()
    if not length:
        return [*carry, *(np.empty(v.aval.shape, object) for v in eqn.outvars[n_carry:])]
    ys = [np.stack([outs[k] for outs in outs_by_iteration]) for k in range(len(body.jaxpr.outvars) - n_carry)]
    return [*carry, *ys]


@rule("while")
def _while(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    params = eqn.params
    n_cond, n_body = params["cond_nconsts"], params["body_nconsts"]
    if params["cond_jaxpr"].jaxpr.outvars[0].aval.shape:
        # A batch of loops runs until the last one ends.
        avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        return ctx.lower(jax.make_jaxpr(functools.partial(_run_batch, params))(*avals), args)
    cond_consts, body_consts, carry = args[:n_cond], args[n_cond : n_cond + n_body], args[n_cond + n_body :]
    cond, body = ctx.make_inner(), ctx.make_inner()
    cond_args = [*cond_consts, *(_add_inputs(cond, x) for x in carry)]
    cond_block = cond.finish(cond.lower(close_jaxpr(params["cond_jaxpr"]), cond_args))
    body_args = [*body_consts, *(_add_inputs(body, x) for x in carry)]
    body_block = body.finish(body.lower(close_jaxpr(params["body_jaxpr"]), body_args))
    return _add_operation(ctx, "while", eqn, scalars(*carry), (cond_block, body_block))


def _run_batch(params: dict[str, Any], *operands: Any) -> list[Any]:
    n_cond, n_body = params["cond_nconsts"], params["body_nconsts"]
    consts, carry = operands[: n_cond + n_body], operands[n_cond + n_body :]
    test, body = (jaxpr_as_fun(close_jaxpr(params[name])) for name in ("cond_jaxpr", "body_jaxpr"))

    def step(carry: Any) -> Any:
        (runs,) = test(*consts[:n_cond], *carry)
        new = body(*consts[n_cond:], *carry)
        flags = [runs.reshape(runs.shape + (1,) * (x.ndim - runs.ndim)) for x in carry]
        return tuple(jax.numpy.where(*x) for x in zip(flags, new, carry, strict=True))

    return list(jax.lax.while_loop(lambda carry: test(*consts[:n_cond], *carry)[0].any(), step, carry))


@rule("any_lane")
def _any_lane(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    (condition,) = args
    return [condition if is_constant(condition[()]) else as_elements([ctx.scalar("any_lane", condition[()])], ())]


def _add_inputs(ctx: Lowering, template: ElementArray) -> ElementArray:
    def new_input(x: Any) -> Any:
        return tuple(map(new_input, x)) if isinstance(x, tuple) else ctx.builder.input(x.dtype)

    return as_elements([new_input(x) for x in template.reshape(-1)], template.shape)


def _add_operation(
    ctx: Lowering, op: str, eqn: JaxprEqn, args: list[Element], blocks: tuple[Block, ...], params: tuple = ()
) -> list[ElementArray]:
    key_flags = [jax.dtypes.issubdtype(v.aval.dtype, jax.dtypes.prng_key) for v in eqn.outvars]
    sizes = [
        int(np.prod(v.aval.shape)) * (2 if is_key else 1) for v, is_key in zip(eqn.outvars, key_flags, strict=True)
    ]
    dtypes = [np.uint32 if is_key else v.aval.dtype for v, is_key in zip(eqn.outvars, key_flags, strict=True)]
    result_dtypes = [dtype for dtype, size in zip(dtypes, sizes, strict=True) for _ in range(size)]
    results = iter(ctx.builder.add_many(op, tuple(args), result_dtypes, params, blocks))
    out = []
    for v, is_key, size in zip(eqn.outvars, key_flags, sizes, strict=True):
        items = [next(results) for _ in range(size)]
        out.append(as_elements(list(zip(items[::2], items[1::2], strict=True)) if is_key else items, v.aval.shape))
    return out
