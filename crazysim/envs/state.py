"""State of an environment, for all worlds or one world, and checks of actions and goals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.settings import is_real
from crazysim.eager import is_traced
from crazysim.engine.pytree import PyTree, leaf, static
from crazysim.envs.actions import Actions
from crazysim.errors import ConfigError, require, short_repr
from crazysim.tables import read_numbers

ENV_RECORD_NAME = "environment"
"""Key of the environment's record in the plugins of its data."""

T = TypeVar("T")
TERM_PREFIX = "reward "
"""Prefix of the names of the terms of a reward, as in ``RewardTerms``."""
PRIVILEGED = "privileged"
"""Name of the observation that only a critic may use; see ``PrivilegedObservation``."""

Obs = dict[str, Array]
"""Named observations. (n_worlds, n_drones, k) each, or (n_drones, k) in one world"""

NO_EPISODE = "expected a running episode, got none: it has not begun, has ended, or was closed. Call reset()."
"""Message about a step without an episode."""


class EnvRecord(PyTree):
    """Record that an environment adds to the data of its simulation; ``EnvState`` is its public interface."""

    watched = False  # ``Phases.observe`` checks observations and rewards itself

    obs: Obs = leaf("drone", 1)
    """Observations. (n_worlds, n_drones, k) each"""
    images: Obs = leaf("drone", 1)
    """Observations that are images, taken at the end of the step and flattened. (n_worlds, n_drones, k) each"""
    reward: Array = leaf("drone")
    """Reward of the last step. (n_worlds, n_drones)"""
    terminated: Array = leaf("world")
    """Whether the episode ended by success or failure. (n_worlds, 1)"""
    truncated: Array = leaf("world")
    """Whether the episode reached its time limit. (n_worlds, 1)"""
    action: Array = leaf("drone", 1)
    """Action of the last step. (n_worlds, n_drones, k)"""
    drone_info: dict[str, Any] = leaf("drone", None)
    """Entries of ``info`` with a row for each drone. (n_worlds, n_drones, ...) each"""
    world_info: dict[str, Array] = leaf("world")
    """Entries of ``info`` with one number per world. (n_worlds, 1) each"""
    memory: dict[str, Any] = leaf("world", None)
    """Memory of the wrappers, by name of the wrapper. (n_worlds, 1, ...) each; a record in it declares its own axes"""
    next_action: Array = leaf("drone", 1, scratch=True)
    """Action passed to ``step``; after ``act``, the action as changed by the wrappers. (n_worlds, n_drones, k)"""
    must_reset: Array = leaf("world", scratch=True)
    """Whether a new episode begins within the step. (n_worlds, 1)"""
    task: str = static(default="")
    """Name of the task, whose states no other environment takes."""


RESULT_FIELDS = ("obs", "images", "reward", "terminated", "truncated", "drone_info", "world_info")
"""Fields of the record that are results of a step."""


class EnvState(PyTree):
    """State of an environment: argument and result of ``step``.

    Its properties read the simulation's data and the environment's record in them; ``replace`` takes the names of the
    properties. Functions of one world, such as hooks of wrappers, receive a state whose arrays have no axis of worlds.
    """

    full_data: SimData
    """Data of the simulation, with the environment's record in its plugins."""

    @property
    def record(self) -> EnvRecord:
        """The environment's record."""
        return self.full_data.plugins[ENV_RECORD_NAME]

    @property
    def data(self) -> SimData:
        """Data of the simulation, without the environment's record."""
        return self.full_data.replace(plugins={k: x for k, x in self.full_data.plugins.items() if k != ENV_RECORD_NAME})

    @property
    def obs(self) -> Obs:
        """Observations passed to the policy. (n_worlds, n_drones, k) each"""
        return self.record.obs | self.record.images

    @property
    def reward(self) -> Array:
        """Reward of the last step; zero at the start of an episode. (n_worlds, n_drones)"""
        return self.record.reward

    @property
    def terminated(self) -> Array:
        """Whether the episode ended by success or failure. (n_worlds,)"""
        return self._squeeze_axis(self.record.terminated)

    @property
    def truncated(self) -> Array:
        """Whether the episode reached its time limit. (n_worlds,)"""
        return self._squeeze_axis(self.record.truncated)

    @property
    def done(self) -> Array:
        """Whether the episode is over. (n_worlds,)"""
        return self.terminated | self.truncated

    @property
    def action(self) -> Array:
        """Action of the last step; zero at the start of an episode. (n_worlds, n_drones, k)"""
        return self.record.action

    @property
    def info(self) -> dict[str, Any]:
        """Further quantities by name. (n_worlds,) or (n_worlds, n_drones, ...) each"""
        record = self.record
        return {k: self._squeeze_axis(x) for k, x in record.world_info.items()} | record.drone_info

    @property
    def memory(self) -> dict[str, Any]:
        """Memory of the wrappers, by name of the wrapper. (n_worlds, ...) each; a record in it declares its own axes"""
        return _map_outside_records(self._squeeze_axis, self.record.memory)

    @property
    def final_obs(self) -> Obs:
        """Observations at the end of the step: ``info["final_obs"]`` of ``AutoReset``, or ``obs`` if there is none.

        Returns:
            (n_worlds, n_drones, k) each
        """
        return self.record.drone_info.get("final_obs", self.obs)

    def replace(self, **changes: Any) -> EnvState:
        full_data = changes.pop("full_data", self.full_data)
        record = full_data.plugins[ENV_RECORD_NAME]
        if "data" in changes:
            full_data = changes.pop("data")
        if "info" in changes:
            changes |= self._split_info(changes.pop("info"))
        if "obs" in changes:
            changes["obs"] = self._drop_images(changes["obs"])
        if "memory" in changes:
            changes["memory"] = _map_outside_records(self._add_axis, changes["memory"])
        for name in {"terminated", "truncated", "must_reset"} & changes.keys():
            changes[name] = self._add_axis(changes[name])
        record = record.replace(**changes) if changes else record
        return EnvState(full_data.replace(plugins=full_data.plugins | {ENV_RECORD_NAME: record}))

    def _drop_images(self, obs: Obs) -> Obs:
        images = self.record.images
        if changed := [name for name, image in images.items() if name in obs and obs[name] is not image]:
            raise ConfigError(
                f"expected images unchanged in functions of one world, got a new {changed[0]!r}. Images are taken "
                f"after these functions. Change images where they are used, in the policy."
            )
        return {name: x for name, x in obs.items() if name not in images}

    def _split_info(self, info: dict[str, Any]) -> dict[str, dict[str, Any]]:
        n_world_axes, n_drones = max(self.full_data.core.steps.ndim - 1, 0), self.full_data.core.n_drones
        drone_info, world_info = {}, {}
        for name, entry in info.items():
            shapes = [jnp.shape(x) for x in jax.tree.leaves(entry)]
            if all(shape[n_world_axes : n_world_axes + 1] == (n_drones,) for shape in shapes):
                drone_info[name] = entry
            elif all(len(shape) == n_world_axes for shape in shapes):
                world_info[name] = self._add_axis(entry)
            else:
                raise ConfigError(
                    f"expected info[{name!r}] as one number of a world, (), or with one row for each of {n_drones} "
                    f"drones, ({n_drones}, ...), got {', '.join(str(shape[n_world_axes:]) for shape in shapes)}. "
                    f"Return one row for every drone."
                )
        return {"drone_info": drone_info, "world_info": world_info}

    def _squeeze_axis(self, x: Any) -> Any:
        axis = self.full_data.core.steps.ndim - 1
        return x if axis < 0 else _reshape(x, (*x.shape[:axis], *x.shape[axis + 1 :]))

    def _add_axis(self, x: Any) -> Any:
        axis = self.full_data.core.steps.ndim - 1
        return x if axis < 0 else _reshape(x, (*jnp.shape(x)[:axis], 1, *jnp.shape(x)[axis:]))


def _reshape(x: Any, shape: tuple[int, ...]) -> Any:
    return jax.ShapeDtypeStruct(shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else jnp.reshape(x, shape)


def _map_outside_records(fn: Any, memory: dict[str, Any]) -> dict[str, Any]:
    def is_record(x: object) -> bool:
        return isinstance(x, PyTree)

    return jax.tree.map(lambda x: x if is_record(x) else fn(x), memory, is_leaf=is_record)


def state_of_data(data: SimData, task: str = "") -> EnvState:
    """Return a state of a task with an empty record, which the reset of an episode fills."""
    no_array: Any = None
    record = EnvRecord({}, {}, no_array, no_array, no_array, no_array, {}, {}, {}, no_array, no_array, task)
    return EnvState(data.replace(plugins=data.plugins | {ENV_RECORD_NAME: record}))


def flatten(obs: Obs) -> Array:
    """Concatenate named observations in alphabetical order of their names. (..., n_obs)"""
    return jnp.concatenate([obs[name] for name in sorted(obs)], axis=-1)


def check_actions(actions: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Return actions for all worlds as a float32 host array, after checking shape, type and values. (n_worlds, ...)"""
    if isinstance(actions, Array) and not isinstance(actions, jax.core.Tracer):
        actions = np.asarray(actions)
    return np.asarray(read_action(actions, shape), np.float32)


def validate_action(action: ArrayLike, expected: jax.ShapeDtypeStruct, actions: Actions) -> Array:
    """Return an action of the expected dtype, after checking its shape and its type. (n_worlds, n_drones, k)

    Args:
        expected: Shape and dtype of actions of all worlds.
        actions: Meaning of an action, for messages.
    """
    action = read_action(action, expected.shape, actions)
    return (
        action if isinstance(action, Array) and action.dtype == expected.dtype else jnp.asarray(action, expected.dtype)
    )


def read_action(action: Any, shape: tuple[int, ...], actions: Actions | None = None) -> Any:
    """Return an action as an array after checking shape and type, and on the host that its numbers are finite.

    Args:
        actions: Meaning of an action, for messages; None if the shape says enough.
    """
    try:
        array = action if isinstance(action, Array) else (jnp if is_traced([action]) else np).asarray(action)
    except (TypeError, ValueError):  # a list of lists of unequal lengths
        array = np.asarray(None)
    if not is_real(array):
        raise ConfigError(
            f"expected actions as an array of numbers {shape}, got {short_repr(action)} of type {array.dtype}. Use "
            f"float32."
        )
    if array.shape != shape:
        axes = "" if actions is None else f" = (n_worlds, n_drones, {actions.size})"
        remedy = "" if actions is None else f". Actions of this environment: {actions}"
        raise ValueError(f"expected actions of shape {shape}{axes}, got {array.shape}{remedy}")
    if isinstance(array, np.ndarray) and not np.isfinite(array).all():
        worlds = np.unique(np.nonzero(~np.isfinite(array))[0])[:8]
        raise ConfigError(
            f"expected finite actions, got NaN or infinity in world(s) {worlds.tolist()}. Check the policy's weights "
            f"and observations."
        )
    return array


def validate_goals(pos: ArrayLike | Array, state: EnvState) -> Array:
    """Return the goal of each drone, after checking shapes and host numbers. (n_worlds, n_drones, 3)

    Args:
        pos: One goal for all drones (3,), one per world (n_worlds, 3), or one per drone (n_worlds, n_drones, 3); an
            axis of worlds or drones may have length 1.
    """
    template = state.full_data.states.pos
    goals = pos if isinstance(pos, Array) else read_numbers("pos", pos)
    goals = goals[:, None] if goals.ndim == 2 else goals
    has_batch_shape = all(n in (1, expected) for n, expected in zip(goals.shape, template.shape[:2], strict=False))
    require(is_real(goals), f"expected goals as real numbers, got type {goals.dtype}. Use float32.")
    require(
        goals.shape[-1:] == (3,) and (goals.ndim == 1 or (goals.ndim == 3 and has_batch_shape)),
        f"expected goals of shape (3,), (n_worlds, 3) or (n_worlds, n_drones, 3) = {template.shape}, got "
        f"{np.shape(pos)}. Use (1, n_drones, 3) for the same goals in every world.",
    )
    return jnp.broadcast_to(jnp.asarray(goals, template.dtype), template.shape)


def terms_of(values: Mapping[str, T]) -> dict[str, T]:
    """Return the terms of a reward among metrics of ``evaluate``, or in ``info``, by the name of the term."""
    return {name.removeprefix(TERM_PREFIX): x for name, x in values.items() if name.startswith(TERM_PREFIX)}
