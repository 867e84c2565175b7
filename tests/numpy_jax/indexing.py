"""Parts of arrays at computed places."""

import numpy as np
from jax import lax

from numpy_jax.program import MissingError


def window(x, sizes, starts):
    """Return the index of a window, which XLA moves inside."""
    begins = [min(max(int(k), 0), n - size) for k, n, size in zip(starts, x.shape, sizes, strict=True)]
    return tuple(slice(k, k + size) for k, size in zip(begins, sizes, strict=True))


def dynamic_slice(eqn):
    """Return a window."""
    sizes = eqn.params["slice_sizes"]
    return lambda x, *starts: x[window(x, sizes, starts)]


def dynamic_update_slice(eqn):
    """Return an array with a window replaced."""

    def fn(x, update, *starts):
        out = np.array(x)
        out[window(x, np.shape(update), starts)] = update
        return out

    return fn


def gather(eqn):
    """Return windows at places of an array."""
    p, (operand, indices) = eqn.params, (v.aval for v in eqn.invars)
    d, sizes, mode = p["dimension_numbers"], p["slice_sizes"], p["mode"]
    if mode == lax.GatherScatterMode.ONE_HOT:
        raise MissingError("gather by one-hot")
    fill = p["fill_value"]
    if fill is None:
        kind = operand.dtype.kind
        extremes = {"f": lambda: np.nan, "b": lambda: True, "i": lambda: np.iinfo(operand.dtype).min}
        fill = extremes.get(kind, lambda: np.iinfo(operand.dtype).max)()
    batch = indices.shape[:-1]
    removed = (*d.collapsed_slice_dims, *d.operand_batching_dims)
    kept = [k for k in range(operand.ndim) if k not in removed]
    places = window_places(operand.shape, sizes, batch, kept, d.operand_batching_dims, d.start_indices_batching_dims)
    ndim, axes = len(batch) + len(kept), iter(range(len(batch)))
    offsets = dict(zip(d.offset_dims, range(len(batch), ndim), strict=True))
    final = [offsets[k] if k in offsets else next(axes) for k in range(ndim)]

    def fn(x, starts):
        index, inside = places(starts, d.start_index_map)
        out = np.asarray(x)[index]
        if mode == lax.GatherScatterMode.FILL_OR_DROP and not inside.all():
            out = np.where(inside.reshape(inside.shape + (1,) * len(kept)), out, np.asarray(fill, out.dtype))
        return np.transpose(out, final)

    return fn


def scatter(combine):
    """Return the entry of a scatter; ``combine`` writes updates to an index of an array."""

    def make(eqn):
        p, (operand, indices, updates) = eqn.params, (v.aval for v in eqn.invars)
        d, mode = p["dimension_numbers"], p["mode"]
        if mode == lax.GatherScatterMode.ONE_HOT or (combine is write and not is_assignment(p["update_jaxpr"])):
            raise MissingError("scatter with a function")
        batch = indices.shape[:-1]
        removed = (*d.inserted_window_dims, *d.operand_batching_dims)
        kept = [k for k in range(operand.ndim) if k not in removed]
        sizes = [1] * operand.ndim
        for k, axis in zip(kept, d.update_window_dims, strict=True):
            sizes[k] = updates.shape[axis]
        args = operand.shape, sizes, batch, kept, d.operand_batching_dims, d.scatter_indices_batching_dims
        places = window_places(*args)
        outer = [k for k in range(updates.ndim) if k not in d.update_window_dims]
        order = (*outer, *d.update_window_dims)

        def fn(x, starts, new):
            index, inside = places(starts, d.scatter_dims_to_operand_dims)
            new, out = np.transpose(new, order), np.array(x)
            if mode != lax.GatherScatterMode.CLIP and not inside.all():
                index = tuple(np.broadcast_to(k, new.shape)[inside] for k in index)
                new = new[inside]
            combine(out, index, new)
            return out

        return fn

    return make


def write(out, index, new):
    """Replace numbers."""
    out[index] = new


def is_assignment(jaxpr):
    """Return whether the function of a scatter returns the update."""
    inner = getattr(jaxpr, "jaxpr", jaxpr)
    return inner is None or (not inner.eqns and inner.outvars == inner.invars[1:])


def window_places(shape, sizes, batch, kept, batching, index_batching):
    """Return a function from starts to the index of all windows, moved inside, and which of them were inside."""
    ndim = len(batch) + len(kept)
    offsets = {
        k: np.arange(sizes[k]).reshape([-1 if len(batch) + i == j else 1 for j in range(ndim)])
        for i, k in enumerate(kept)
    }
    for k, axis in zip(batching, index_batching, strict=True):
        offsets[k] = np.arange(shape[k]).reshape([-1 if j == axis else 1 for j in range(ndim)])
    offsets = [offsets.get(k, np.zeros([1] * ndim, int)) for k in range(len(shape))]

    def places(starts, dims):
        index, inside = list(offsets), np.ones(batch, bool)
        for i, k in enumerate(dims):
            start, most = np.asarray(starts)[..., i].astype(np.int64), shape[k] - sizes[k]
            inside &= (start >= 0) & (start <= most)
            start = np.clip(start, 0, most)
            index[k] = index[k] + start.reshape(start.shape + (1,) * len(kept))
        return tuple(index), inside

    return places
