"""Networks as pure functions of weights, observations and memory.

A policy or a value function consists of a ``Network`` and a multilayer perceptron. The network turns the normalised
observations of a drone into features, and may keep a memory between steps. The perceptron turns features into outputs.
The built-in network replaces images by the features of a convolution, then appends a memory. Without convolution and
memory, its features are the observations.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine.pytree import PyTree, float_dtype, select_worlds, static
from crazysim.envs.state import flatten
from crazysim.envs.statistics import RunningStats
from crazysim.errors import ConfigError, require, short_repr
from crazysim.train.convolution import KERNEL_SIZE, Image, convolve, scale_depth
from crazysim.train.interface import Interface, sizes_of, sizes_text
from crazysim.train.seeds import for_each_seed, join_blocks, split_blocks

Layers = list[tuple[Array, Array]]
"""Weights (n_in, n_out) and biases (n_out,), first layer first."""
ApplyLayers = Callable[[Layers, Array], Array]
"""Function from layers and inputs (..., n_in) to outputs (..., n_out), such as ``mlp``."""


def init_mlp(key: Array, sizes: Sequence[int], last_scale: float) -> Layers:
    """Return layers with uniformly distributed weights and zero biases.

    The weights have the variance of the entries of scaled orthogonal matrices, scale^2 / max(n_in, n_out). Orthogonal
    matrices themselves would take longer to trace and compile than this one draw of all weights.

    Args:
        sizes: Number of inputs, sizes of the hidden layers, number of outputs.
        last_scale: Scale of the weights of the last layer; small for a policy, so that it starts near the zero action.
            The scale of the other layers is the square root of 2.
    """
    pairs = list(itertools.pairwise(sizes))
    offsets = np.cumsum([n_in * n_out for n_in, n_out in pairs])
    blocks = jnp.split(jax.random.uniform(key, (offsets[-1],), minval=-1.0, maxval=1.0), offsets[:-1])
    scales = [np.sqrt(2.0)] * (len(pairs) - 1) + [last_scale]
    return [
        (scale * np.sqrt(3.0 / max(n_in, n_out)) * x.reshape(n_in, n_out), jnp.zeros(n_out))
        for x, (n_in, n_out), scale in zip(blocks, pairs, scales, strict=True)
    ]


def mlp(layers: Layers, x: Array) -> Array:
    """Return the outputs of a perceptron with tanh between layers, computed in the dtype of the weights.

    Args:
        x: Inputs. (..., n_in)

    Returns:
        Outputs, in the dtype of the inputs. (..., n_out)
    """
    dtype = x.dtype
    x = x.astype(layers[0][0].dtype)
    for weight, bias in layers[:-1]:
        x = jnp.tanh(x @ weight + bias)
    weight, bias = layers[-1]
    return (x @ weight + bias).astype(dtype)


@dataclass(frozen=True, eq=False)
class Network:
    """Network from the normalised observations of one drone to features.

    Its functions are pure and written for one drone. After a custom network, one linear layer computes the actions
    before tanh, or the value, from the features. ``Network(init, apply)`` has no memory: its ``apply`` gets and returns
    ``()`` as memory.
    """

    init: Callable[[Array, int], Any]
    """``init(key, n_obs) -> weights``: initial weights for ``n_obs`` inputs, any pytree of arrays."""
    apply: Callable[[Any, Any, Any], tuple[Array, Any]]
    """``apply(weights, obs, memory) -> (features, memory)``: features (n_features,) for observations (n_obs,), and the
    memory after the step, of the structure and shapes of ``initial_memory``."""
    initial_memory: Any = ()
    """Memory at the start of an episode, any pytree of arrays; ``()`` for none."""
    images: tuple[Image, ...] = ()
    """Images among the observations; they are passed to the network without normalisation."""
    encode: Callable[[Any, Array], Any] = lambda _weights, obs: obs
    """``encode(weights, obs) -> inputs``: first part of the network, which does not need the memory. Updates compute it
    for all steps at once, and pass its results to ``apply`` in the place of the observations."""
    is_limited: bool = False
    """Whether actions are limited to [-1, 1] instead of passing a tanh."""

    def squash(self, outputs: Array) -> Array:
        """Mean actions of outputs; those that are limited when they are applied stay as they are."""
        return outputs if self.is_limited else jnp.tanh(outputs)

    @property
    def has_memory(self) -> bool:
        """Whether the network keeps a memory between steps."""
        return bool(jax.tree.leaves(self.initial_memory))

    @property
    def is_built_in(self) -> bool:
        """Whether it is the default network, with or without convolution and memory; hidden layers follow it."""
        apply = self.apply.func if isinstance(self.apply, functools.partial) else self.apply
        return apply in (MEMORYLESS_NETWORK.apply, _apply_gru, _apply_convolution)

    @property
    def pixels(self) -> tuple[range, ...]:
        """Indices of the pixels of each image within the observations."""
        return tuple(image.pixels for image in self.images)

    def make_memory(self, *batch: int) -> Any:
        """Return the memory at the start of an episode. (*batch, ...) each"""
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *jnp.shape(x))), self.initial_memory)


class Gru(PyTree):
    """Weights of a gated recurrent unit (Cho et al. 2014), in the order reset gate, update gate, candidate.

    As in cuDNN, the reset gate scales the memory after the multiplication by its weights, not before.
    """

    inputs: Array
    """Weights of the observations. (n_obs, 3 n_memory)"""
    recurrent: Array
    """Weights of the memory. (n_memory, 3 n_memory)"""
    bias: Array
    """Biases. (3 n_memory,)"""

    def encode(self, obs: Array) -> Array:
        return obs @ self.inputs + self.bias

    def __call__(self, encoded: Array, memory: Array) -> Array:
        reset_x, update_x, candidate_x = jnp.split(encoded, 3)
        reset_h, update_h, candidate_h = jnp.split(memory @ self.recurrent, 3)
        update = jax.nn.sigmoid(update_x + update_h)
        candidate = jnp.tanh(candidate_x + jax.nn.sigmoid(reset_x + reset_h) * candidate_h)
        return update * memory + (1.0 - update) * candidate


MEMORYLESS_NETWORK = Network(lambda _key, _n_obs: (), lambda _weights, obs, memory: (obs, memory))
"""Network without weights; its features are the observations."""


def gru_network(size: int) -> Network:
    """Return the network with a gated recurrent unit as memory; its features are the observations and the memory."""
    return _gru_network(size, np.dtype(float_dtype()))


@functools.cache
def _gru_network(size: int, dtype: np.dtype) -> Network:
    def init(key: Array, n_obs: int) -> Gru:
        k_inputs, k_recurrent = jax.random.split(key)
        ((inputs, bias),) = init_mlp(k_inputs, (n_obs, 3 * size), 1.0)
        ((recurrent, _),) = init_mlp(k_recurrent, (size, 3 * size), 1.0)
        return Gru(inputs, recurrent, bias)

    return Network(init, _apply_gru, np.zeros(size, dtype), encode=lambda gru, obs: (obs, gru.encode(obs)))


def _apply_gru(gru: Gru, inputs: tuple[Array, Array], memory: Array) -> tuple[Array, Array]:
    obs, encoded = inputs
    memory = gru(encoded, memory)
    return jnp.concatenate([obs, memory]), memory


class Raptor(PyTree):
    """Weights of a dense layer with ReLU and a memory of the same size."""

    dense: tuple[Array, Array]
    """Weights (n_obs, n_memory) and biases (n_memory,)."""
    memory: Gru
    """Weights of the memory."""


def raptor_network(size: int) -> Network:
    """Return the network of RAPTOR (arXiv 2509.11481): a dense layer with ReLU, and a memory, which is the features."""
    return _raptor_network(size, np.dtype(float_dtype()))


@functools.cache
def _raptor_network(size: int, dtype: np.dtype) -> Network:
    def init(key: Array, n_obs: int) -> Raptor:
        (dense,) = init_mlp(jax.random.fold_in(key, 1), (n_obs, size), np.sqrt(2.0))
        return Raptor(dense, _gru_network(size, dtype).init(key, size))

    def encode(weights: Raptor, obs: Array) -> Array:
        weight, bias = weights.dense
        return weights.memory.encode(jax.nn.relu(obs @ weight + bias))

    return Network(init, _apply_raptor, np.zeros(size, dtype), encode=encode, is_limited=True)


def _apply_raptor(weights: Raptor, encoded: Array, memory: Array) -> tuple[Array, Array]:
    memory = weights.memory(encoded, memory)
    return memory, memory


class Encoder(PyTree):
    """Weights of the convolutions, and of the memory after them."""

    convolutions: tuple[Layers, ...]
    """Layers of each image, see ``crazysim.train.convolution.convolve``."""
    memory: Gru | tuple[()] = ()
    """Weights of the memory; ``()`` for none."""


@functools.cache
def _convolution_network(channels: tuple[int, ...], images: tuple[Image, ...], base: Network) -> Network:
    def init(key: Array, n_obs: int) -> Encoder:
        keys = jax.random.split(jax.random.fold_in(key, 2), (len(images), len(channels)))
        convolutions = tuple(
            [
                init_mlp(keys[i, k], (KERNEL_SIZE**2 * n_in, n_out), np.sqrt(2.0))[0]
                for k, (n_in, n_out) in enumerate(itertools.pairwise((image.channels, *channels)))
            ]
            for i, image in enumerate(images)
        )
        n_features = sum(int(np.prod(list(image.shapes(channels))[-1])) for image in images)
        n_pixels = sum(len(image.pixels) for image in images)
        return Encoder(convolutions, base.init(key, n_obs - n_pixels + n_features))

    def encode(encoder: Encoder, obs: Array) -> Any:
        return base.encode(encoder.memory, _convolve_images(images, encoder, obs))

    apply = functools.partial(_apply_convolution, base.apply)
    return Network(init, apply, base.initial_memory, images, encode)


def _apply_convolution(apply: Callable[..., Any], encoder: Encoder, inputs: Any, memory: Any) -> tuple[Array, Any]:
    return apply(encoder.memory, inputs, memory)


def _convolve_images(images: tuple[Image, ...], encoder: Encoder, obs: Array) -> Array:
    ends = [end for pixels in (image.pixels for image in images) for end in (pixels.start, pixels.stop)]
    vectors = jnp.split(obs, ends)[::2]
    features = []
    for image, layers in zip(images, encoder.convolutions, strict=True):
        pixels = obs[image.pixels.start : image.pixels.stop]
        features.append(convolve(layers, (scale_depth(pixels) if image.is_depth else pixels).reshape(image.shape)))
    return jnp.concatenate([*vectors, *features])


def choose_network(
    memory: int,
    network: Network | None,
    convolution: Sequence[int] = (),
    images: tuple[Image, ...] = (),
    shape: str = "default",
) -> Network:
    """Return ``network``, or the built-in network if it is None.

    Args:
        memory: Size of the memory of the built-in network; 0 for none.
        network: Custom network; None for the built-in one.
        convolution: Channels of the layers of the convolution of the built-in network; empty for no convolution.
        images: Images among the observations, for the convolution.
        shape: Hyperparameter of PPO.
    """
    if shape == "raptor":
        require(
            memory > 0 and network is None and not convolution,
            "expected a memory, and no convolution or custom network, for shape='raptor'. Use memory=16.",
        )
        return raptor_network(memory)
    if network is None:
        base = gru_network(memory) if memory else MEMORYLESS_NETWORK
        return _convolution_network(tuple(convolution), images, base) if convolution else base
    require(
        isinstance(network, Network), f"expected a Network, got {network!r}. Use crazysim.train.Network(init, apply)."
    )
    require(
        not convolution,
        f"expected no convolution with a custom network, got {list(convolution)}. Put it into the network.",
    )
    require(
        not memory,
        f"expected memory=0 with a custom network, got {memory}. Give the network an initial_memory instead.",
    )
    return network


class Weights(PyTree):
    """Weights of a network and of the layers after it."""

    layers: Layers
    """Layers from the features to the outputs."""
    body: Any = ()
    """Weights of the network; ``()`` for the built-in network without convolution and memory."""


def init_weights(network: Network, key: Array, n_obs: int, sizes: Sequence[int], last_scale: float) -> Weights:
    """Return initial weights.

    Args:
        n_obs: Number of inputs.
        sizes: Sizes of the hidden layers after the network, and number of outputs.
        last_scale: Scale of the weights of the last layer, see ``init_mlp``.
    """
    network_weights = network.init(jax.random.fold_in(key, 1), n_obs)
    inputs = jax.eval_shape(network.encode, network_weights, jnp.zeros(n_obs))
    output_shapes = jax.eval_shape(network.apply, network_weights, inputs, network.make_memory())
    features, memory = output_shapes if isinstance(output_shapes, tuple) and len(output_shapes) == 2 else (None, None)
    require(
        getattr(features, "ndim", None) == 1,
        f"expected apply(weights, obs, memory) to return features (n_features,) of one drone and the memory, got "
        f"{output_shapes}. Return a tuple of the two.",
    )
    expected = jax.eval_shape(network.make_memory)
    if jax.tree.structure(memory) != jax.tree.structure(expected) or any(
        (x.shape, x.dtype) != (y.shape, y.dtype)
        for x, y in zip(jax.tree.leaves(memory), jax.tree.leaves(expected), strict=True)
    ):
        raise ConfigError(
            f"expected apply to return a memory like initial_memory, {expected}, got {memory}. Return the memory that "
            f"it gets if it keeps none."
        )
    return Weights(init_mlp(key, (features.shape[-1], *sizes), last_scale), network_weights)


def forward(
    network: Network, weights: Weights, obs: Array, memory: Any, apply_layers: ApplyLayers = mlp
) -> tuple[Array, Any]:
    """Return the outputs of one step, (..., n_outputs), and the memory after it.

    Args:
        weights: Weights of the network and of the layers after it.
        obs: Normalised observations. (..., n_obs)
        memory: Memory before the step: arrays of ``initial_memory`` with the leading axes of ``obs``.
        apply_layers: Function of layers and features that returns the outputs.
    """
    inputs = _batch(network.encode, weights, obs.ndim - 1)(obs)
    features, memory = _batch(network.apply, weights, obs.ndim - 1)(inputs, memory)
    return apply_layers(weights.layers, features), memory


def unroll(
    network: Network, weights: Weights, obs: Array, memory: Any, done: Array, apply_layers: ApplyLayers = mlp
) -> Array:
    """Return the outputs of consecutive steps, (n_steps, ..., n_outputs); gradients flow back through the steps.

    Args:
        weights: Weights of the network and of the layers after it.
        obs: Normalised observations. (n_steps, ..., n_obs)
        memory: Memory before the first step: arrays of ``initial_memory`` with the leading axes of ``obs[0]``.
        done: True where an episode ended with the step; the next step begins with the initial memory. (n_steps, ...)
        apply_layers: Function of layers and features that returns the outputs.
    """
    if not network.has_memory:
        return forward(network, weights, obs, memory, apply_layers)[0]
    apply, initial_memory = _batch(network.apply, weights, obs.ndim - 2), network.make_memory(*done.shape[1:])

    def step(memory: Any, inputs: tuple[Any, Array]) -> tuple[Any, Array]:
        encoded, step_done = inputs
        features, memory = apply(encoded, memory)
        return jax.tree.map(lambda initial, x: select_worlds(step_done, initial, x), initial_memory, memory), features

    encoded = _batch(network.encode, weights, obs.ndim - 1)(obs)
    # Launches take most of the time of a step on a GPU; four steps in a program save a third of an update there.
    _, features = jax.lax.scan(step, memory, (encoded, done), unroll=4)
    return apply_layers(weights.layers, features)


def _batch(fn: Callable[..., Any], weights: Weights, n_axes: int) -> Callable[..., Any]:
    fn = functools.partial(fn, weights.body)
    for _ in range(n_axes):
        fn = jax.vmap(fn)
    return fn


class Policy(PyTree):
    """Deterministic policy: observation statistics and a network.

    ``policy(obs)`` returns actions. A policy with memory has to be called as ``policy.act(obs, memory)``, which also
    returns the memory for the next step; an episode begins with ``policy.initial_memory(n_worlds, n_drones)``.
    """

    stats: RunningStats
    """Mean and variance with which observations are normalised."""
    layers: Any
    """``Layers`` from the features of the network to actions before tanh."""
    body: Any = ()
    """Weights of the network."""
    network: Network = static(default=MEMORYLESS_NETWORK)
    """Network from normalised observations to features."""
    interface: Interface | None = static(default=None)
    """Observations and commands of the training; other observations are refused. None if they are unknown."""

    @property
    def has_memory(self) -> bool:
        """Whether the policy keeps a memory between steps."""
        return self.network.has_memory

    def __call__(self, obs: dict[str, Array]) -> Array:
        require(
            not self.has_memory,
            "expected a memory besides the observations, got none for a policy that has one. Use action, memory = "
            "policy.act(obs, memory), and begin episodes with policy.initial_memory(n_worlds, n_drones).",
        )
        return self.act(obs, ())[0]

    def act(self, obs: dict[str, Array], memory: Any) -> tuple[Array, Any]:
        """Return the action, between -1 and 1, and the memory after the step.

        Args:
            obs: Observations by name. (..., k) each
            memory: Memory before the step, with the leading axes of ``obs``; ``()`` for a policy without memory.
        """
        sizes, n_obs = sizes_of(obs), self.stats.mean.shape[-1]
        if self.interface is not None:
            self.interface.require_observations(sizes)
        elif sum(sizes.values()) != n_obs:
            raise ConfigError(f"expected observations of {n_obs} numbers for this policy, got {sizes_text(sizes)}.")
        vector = flatten(obs)
        expected = self.initial_memory(*vector.shape[:-1])
        shapes, expected_shapes = ([np.shape(x) for x in jax.tree.leaves(tree)] for tree in (memory, expected))
        if shapes != expected_shapes or (shapes and jax.tree.structure(memory) != jax.tree.structure(expected)):
            raise ConfigError(
                f"expected a memory of shapes {expected_shapes}, got {short_repr(memory)}. Begin with "
                f"policy.initial_memory{vector.shape[:-1]}, and pass on what policy.act returns."
            )
        output, memory = forward(self.network, Weights(self.layers, self.body), self.stats.normalize(vector), memory)
        return jnp.clip(self.network.squash(output), -1.0, 1.0), memory

    def initial_memory(self, *batch: int) -> Any:
        """Return the memory at the start of an episode, for a batch such as (n_worlds, n_drones). (*batch, ...) each"""
        return self.network.make_memory(*batch)


class Policies(PyTree):
    """Policies of several seeds. Each controls a block of worlds of equal size."""

    policies: Policy
    """The policies, stacked. (n_seeds, ...) each"""

    @property
    def interface(self) -> Interface | None:
        """Observations and commands of all policies."""
        return self.policies.interface

    def __call__(self, obs: dict[str, Array]) -> Array:
        return self._map_seeds(lambda policy, obs: policy(obs), obs)

    def act(self, obs: dict[str, Array], memory: Any) -> tuple[Array, Any]:
        """Return the action, between -1 and 1, and the memory after the step; see ``Policy.act``."""
        return self._map_seeds(Policy.act, obs, memory)

    def initial_memory(self, *batch: int) -> Any:
        """Return the memory at the start of an episode, for a batch such as (n_worlds, n_drones). (*batch, ...) each"""
        return self.policies.initial_memory(*batch)

    def _map_seeds(self, fn: Callable[..., Any], *args: Any) -> Any:
        blocks = split_blocks(args, self.policies.stats.mean.shape[0])
        return join_blocks(for_each_seed(fn, self.policies, *blocks))
