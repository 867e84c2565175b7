"""Wrapper that randomises a simulation at the start of every episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.engine.pytree import scopes
from crazysim.engine.stage import Axes
from crazysim.envs.env import Env
from crazysim.envs.random import episode_key
from crazysim.envs.wrappers.base import Wrapper
from crazysim.errors import ConfigError, expect, require


class RandomizeWith(Wrapper):
    """Wrapper that changes masses, motors or other fields of the data with a function at the start of every episode.

    ``fn(data, key) -> data`` receives the data of one world and the random key of its episode. Parameters that it
    changes must have one value per drone. Name these parameters in ``params``: shared values are then repeated for
    every drone.
    """

    def __init__(self, env: Env, fn: Callable[[SimData, Array], SimData], params: tuple[str, ...] = ()):
        super().__init__(env)
        expect(callable(fn), "a function (data, key) -> data", fn)
        params = (params,) if isinstance(params, str) else params
        expect(
            isinstance(params, (tuple, list)) and all(isinstance(name, str) for name in params),
            "params as names of parameters",
            params,
            "Use ('mass',).",
        )
        sim_params = env.sim.data.params
        fields = {field.name: getattr(sim_params, field.name) for field in dataclasses.fields(sim_params)}
        if unknown_params := [name for name in params if fields.get(name) is None]:
            raise ConfigError(
                f"expected parameters of {env.sim.dynamics.value}, {', '.join(fields)}, got {', '.join(unknown_params)}"
            )
        self.fn, self.params = fn, tuple(params)

    def prepare(self, data: SimData) -> SimData:
        batch_shape = data.states.pos.shape[:2]
        shared_params = [name for name in self.params if getattr(scopes(data.params), name) == "shared"]
        values = {name: getattr(data.params, name) for name in shared_params}
        repeated = {name: jnp.broadcast_to(x, (*batch_shape, *x.shape)) for name, x in values.items()}
        return data.replace(params=data.params.replace(**repeated))

    def after_spawn(self, data: SimData) -> SimData:
        randomised = self.fn(data, episode_key(data, "randomize"))
        require(
            jax.tree.structure(randomised) == jax.tree.structure(data),
            f"expected the function of RandomizeWith to return the data that it gets with other values, got a "
            f"{type(randomised).__name__}. Use data.replace(params=...).",
        )
        axes = Axes(data)
        leaves = [*zip(axes.names, axes.scopes, jax.tree.leaves(data), jax.tree.leaves(randomised), strict=True)]
        shared_names = [name for name, scope, x, y in leaves if scope in ("shared", "opaque") and y is not x]
        require(
            not shared_names,
            f"{', '.join(shared_names)} cannot be randomised: all worlds share it. Name parameters that get a "
            f"value per drone in params=, as in RandomizeWith(env, fn, params=('mass',)).",
        )
        for name, _, x, y in leaves:
            require(
                jnp.shape(x) == jnp.shape(y),
                f"expected the function of RandomizeWith to keep the shape {jnp.shape(x)} of {name}, got "
                f"{jnp.shape(y)}. Use jnp.broadcast_to(value, {jnp.shape(x)}).",
            )
        return randomised
