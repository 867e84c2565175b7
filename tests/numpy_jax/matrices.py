"""Products and systems of matrices."""

import math

import numpy as np
import scipy.linalg

from numpy_jax.program import MissingError, prepare


def dot_general(eqn):
    """Return the contraction of two arrays."""
    (left, right), (left_batch, right_batch) = map(lambda x: tuple(map(tuple, x)), eqn.params["dimension_numbers"])
    x, y = (v.aval for v in eqn.invars)
    dtype, shape = eqn.outvars[0].aval.dtype, eqn.outvars[0].aval.shape
    left_free = [k for k in range(x.ndim) if k not in left + left_batch]
    right_free = [k for k in range(y.ndim) if k not in right + right_batch]
    batch = math.prod(x.shape[k] for k in left_batch)
    inner = math.prod(x.shape[k] for k in left)
    m, n = math.prod(x.shape[k] for k in left_free), math.prod(y.shape[k] for k in right_free)

    def fn(x, y):
        x = np.transpose(x, (*left_batch, *left_free, *left)).reshape(batch, m, inner)
        y = np.transpose(y, (*right_batch, *right, *right_free)).reshape(batch, inner, n)
        return np.matmul(x, y, dtype=dtype).reshape(shape)

    return fn


def lu(eqn):
    """Return a matrix as lower and upper triangle, its pivots, and the permutation that they make."""
    x = eqn.invars[0].aval
    n, m = x.shape[-2:]
    (getrf,) = scipy.linalg.get_lapack_funcs(("getrf",), dtype=x.dtype)

    def fn(x):
        out, pivots = np.empty_like(x), np.empty((*x.shape[:-2], min(n, m)), np.int32)
        orders = np.empty((*x.shape[:-2], n), np.int32)
        for k in np.ndindex(x.shape[:-2]):
            out[k], pivots[k], _ = getrf(x[k])
            order = list(range(n))
            for i, j in enumerate(pivots[k]):
                order[i], order[j] = order[j], order[i]
            orders[k] = order
        return [out, pivots, orders]

    return fn


def qr(eqn):
    """Return a matrix as an orthogonal one and an upper triangle."""
    if eqn.params["pivoting"]:
        raise MissingError("qr with pivots")
    mode = "complete" if eqn.params["full_matrices"] else "reduced"
    return lambda x: list(np.linalg.qr(x, mode))


def cholesky(eqn):
    """Return the lower triangle whose square a matrix is, or NaN."""

    def one(x):
        try:
            return np.linalg.cholesky(x)
        except np.linalg.LinAlgError:
            return np.full_like(x, np.nan)

    return lambda x: np.array([one(a) for a in x.reshape(-1, *x.shape[-2:])], x.dtype).reshape(x.shape)


def triangular_solve(eqn):
    """Return the solutions of triangular equations; of a singular one they are not finite."""
    p = eqn.params
    if p["conjugate_a"]:
        raise MissingError("triangular_solve of complex numbers")
    (trsm,) = scipy.linalg.get_blas_funcs(("trsm",), dtype=eqn.outvars[0].aval.dtype)
    how = {"side": not p["left_side"], "lower": p["lower"], "trans_a": p["transpose_a"], "diag": p["unit_diagonal"]}

    def fn(a, b):
        out = np.empty_like(b)
        for k in np.ndindex(b.shape[:-2]):
            out[k] = trsm(1.0, a[k], b[k], **how)
        return out

    return fn


def linear_solve(eqn):
    """Solve a linear equation as it says."""
    counts, solve = eqn.params["const_lengths"], prepare(eqn.params["jaxprs"].solve)
    first = counts.matvec + counts.vecmat
    last = sum(counts)
    return lambda *args: solve.run(*args[first : first + counts.solve], *args[last:])
