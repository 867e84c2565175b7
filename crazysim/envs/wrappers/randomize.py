"""Wrapper that randomises the simulation with a function."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.stage import Axes
from crazysim.envs.env import Env
from crazysim.envs.random import episode_key
from crazysim.envs.wrappers.base import Wrapper
from crazysim.errors import ConfigError
from crazysim.pytree import scopes


class RandomizeWith(Wrapper):
    """Begin every episode with other data: masses, motors, or whatever a function changes.

    ``fn(data, key) -> data`` receives one world and its key of the episode. Parameters that it changes are one per
    drone; name them in ``params``.
    """

    def __init__(self, env: Env, fn: Callable[[SimData, Array], SimData], params: tuple[str, ...] = ()):
        super().__init__(env)
        params_now = env.sim.data.params
        known = {field.name: getattr(params_now, field.name) for field in dataclasses.fields(params_now)}
        if missing := [name for name in params if known.get(name) is None]:
            raise ConfigError(
                f"expected parameters of {env.sim.dynamics.value}, {', '.join(known)}, got {', '.join(missing)}"
            )
        self.fn, self.params = fn, tuple(params)

    def prepare(self, data: SimData) -> SimData:
        shape = data.states.pos.shape[:2]
        shared = [name for name in self.params if getattr(scopes(data.params), name) == "shared"]
        values = {name: getattr(data.params, name) for name in shared}
        repeated = {name: jnp.broadcast_to(x, (*shape, *x.shape)) for name, x in values.items()}
        return data.replace(params=data.params.replace(**repeated))

    def after_spawn(self, data: SimData) -> SimData:
        drawn = self.fn(data, episode_key(data, "randomize"))
        axes = Axes(data)
        leaves = zip(axes.names, axes.scopes, jax.tree.leaves(data), jax.tree.leaves(drawn), strict=True)
        shared = [name for name, scope, x, new in leaves if scope in ("shared", "opaque") and new is not x]
        if shared:
            raise ConfigError(
                f"{', '.join(shared)} cannot be randomised: all worlds share it. Name parameters that should be one "
                f"per drone in params=, as in RandomizeWith(env, fn, params=('mass',))."
            )
        return drawn
