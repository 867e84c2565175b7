"""Gradients of flights from one compiled step: the gradient of a loop over the step compiles for twice as long."""

import jax
import jax.numpy as jnp
import numpy as np


def on_device(tree):
    """Return a tree on the first device: JAX compiles a function once more for arrays that were put nowhere."""
    return jax.device_put(tree, jax.devices()[0])


def zero_like(x):
    """Return zeros in place of an array of numbers; keys of random numbers stay."""
    return x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else np.zeros_like(x)


class OneStep:
    """A step of some stages and its gradient in reverse mode as one program, called again and again.

    The data may be any tree that the stages return in the same structure.
    """

    def __init__(self, stages, data):
        """Take stages, and data of the structure, shapes and types that they advance."""
        self._treedef = jax.tree.structure(data)

        @jax.jit
        def step(floats, rest, cotangents):
            def once(floats):
                after = self._joined(floats, rest)
                for stage in stages:
                    after = stage(after)
                return self._parted(after)

            after, pull, rest = jax.vjp(once, floats, has_aux=True)
            return after, rest, pull(cotangents)[0]

        self._step = step

    def fly(self, data, n_steps):
        """Return the data after some steps, and what ``gradient`` needs: the arrays before each of them."""
        floats, rest = self._parted(on_device(data))
        passed, zeros = [], on_device(jax.tree.map(np.zeros_like, floats))
        for _ in range(n_steps):
            passed.append((floats, rest))
            floats, rest, _ = self._step(floats, rest, zeros)
        return self._joined(floats, rest), passed

    def gradient(self, slope, passed):
        """Return the gradient of a number by the data at the start, from the gradient by the data at the end.

        Args:
            slope: Data with derivatives in place of floating-point numbers; other leaves are ignored.
            passed: Second result of ``fly``.
        """
        floats, rest = self._parted(on_device(slope))
        for before in reversed(passed):
            _, _, floats = self._step(*before, floats)
        return self._joined(floats, rest)

    def _parted(self, data):
        """Return the leaves of floating type, and the others, each with None for the rest."""
        leaves = self._treedef.flatten_up_to(data)
        is_float = [jnp.issubdtype(x.dtype, jnp.floating) for x in leaves]
        floats = [x if yes else None for x, yes in zip(leaves, is_float, strict=True)]
        return floats, [None if yes else x for x, yes in zip(leaves, is_float, strict=True)]

    def _joined(self, floats, rest):
        return self._treedef.unflatten([y if x is None else x for x, y in zip(floats, rest, strict=True)])
