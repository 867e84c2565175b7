"""Checks of a task: that it is installed, has all methods, and returns arrays of the right shapes."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import inspect
from collections.abc import Iterator, Mapping
from types import CodeType

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import GetAttrKey, keystr, tree_leaves_with_path

from crazysim.core.data import SimData
from crazysim.core.settings import check_settings
from crazysim.eager import explain_traced_values
from crazysim.engine.pytree import n_world_axes, scopes, watched_flags
from crazysim.engine.sharding import fetch_arrays
from crazysim.envs.references import GUIDE
from crazysim.envs.state import EnvState
from crazysim.envs.task import TASK_RECORD_NAME, Task
from crazysim.errors import ConfigError, expect, require
from crazysim.sim.sim import Sim

REQUIRED_METHODS = ("spawn", "observe", "rewards", "terminated", "error")
"""Methods that every task defines."""
HOOKS = {name for name, x in vars(Task).items() if inspect.isfunction(x)} - {"read", "write"} | {"demonstrate"}
"""Methods of tasks that the environment or a training calls."""


def require_installed(sim: Sim, task: object) -> None:
    expect(isinstance(sim, Sim), "a simulation", sim, "Use Sim(), or crazysim.envs.make.")
    require(isinstance(task, Task), f"expected a Task, got {task!r}. Use a class of crazysim.envs.tasks, or write one.")
    check_settings(task)
    require(
        (task.Record is None and type(task).after_substep is Task.after_substep)
        or (
            TASK_RECORD_NAME in sim.plugins
            and isinstance(sim.data.plugins.get(TASK_RECORD_NAME), task.Record or object)
        ),
        f"expected a simulation in which task {task.name!r} is installed, got one without its states. Call "
        f"task.install(sim) first, or use crazysim.envs.make; an install of your own ends with self.add_states(sim).",
    )


def require_finite_start(task: Task, state: EnvState) -> None:
    """Check that episodes begin in finite states, and without NaN in the record of the task."""
    states, record = state.data.states, state.data.plugins.get(TASK_RECORD_NAME)
    arrays = {field.name: getattr(states, field.name) for field in dataclasses.fields(states)}  # type: ignore[arg-type]
    flags = zip(tree_leaves_with_path(record), jax.tree.leaves(watched_flags(record)), strict=True)
    record_arrays = {keystr(path): x for (path, x), is_watched in flags if is_watched and x.dtype.kind == "f"}
    for name, x in (arrays | record_arrays).items():
        value = fetch_arrays(x)
        is_bad = np.isnan(value) if name in record_arrays else ~np.isfinite(value)
        if is_bad.any():
            world = int(np.argwhere(is_bad)[0, 0])
            raise ConfigError(
                f"task {task.name!r}: expected spawn to return finite states, got {name} with NaN or infinity in "
                f"world {world}. Check the settings of the task and the numbers that spawn draws."
            )


def check_record(state: EnvState, stepped: EnvState) -> None:
    """Check that a step keeps names, shapes and types of observations, info and memory.

    Args:
        state: State at the start of an episode.
        stepped: Shapes and types of the state after a step.
    """
    leaf_scopes, n_drones = jax.tree.leaves(scopes(state.record)), state.full_data.core.n_drones
    start_leaves, stepped_leaves = (dict(tree_leaves_with_path(x.record)) for x in (state, stepped))
    for (path, x), scope in zip(start_leaves.items(), leaf_scopes, strict=True):
        name = keystr(path).lstrip(".")
        require(
            scope not in ("batch", "opaque"),
            f"expected {name} to be declared for drones, worlds or as shared, got a field that is {scope!r}. "
            f'Declare it with leaf("drone"), leaf("world") or leaf("shared").',
        )
        require(
            scope != "drone" or x.shape[1:2] == (n_drones,),
            f"expected {name} of shape (n_drones, ...) in one world, with {n_drones} drones, got {x.shape[1:]}. "
            f"Return one row for every drone.",
        )
        require(
            path[0] != GetAttrKey("obs") or x.ndim == 3,
            f"expected {name} of shape (n_drones, k) in one world, got {x.shape[1:]}. For one number per drone use "
            f"x[:, None]; for one array per drone use x.reshape(n_drones, -1).",
        )
        y = stepped_leaves.get(path)
        require(
            y is not None and (x.shape, x.dtype) == (y.shape, y.dtype),
            f"expected a step to return {name} as it is at the start of an episode, {_describe(x)}, got "
            f"{'none' if y is None else _describe(y)}. Tasks and wrappers must always return the "
            f"same names and shapes.",
        )
    if added_names := [keystr(path).lstrip(".") for path in stepped_leaves if path not in start_leaves]:
        raise ConfigError(
            f"expected a step to return the entries that exist at the start of an episode, got "
            f"{', '.join(added_names)} as well. Add the same entries in after_reset."
        )


def check_task(task: Task, data: SimData, action_size: int) -> None:
    """Check that a task has all methods, and that observations and rewards have the documented shapes.

    The methods are traced once to get their shapes, not executed.

    Args:
        task: The task, installed.
        data: Data of all worlds.
        action_size: Length of the action of one drone.
    """
    # Methods that every task defines.
    title = f"task {task.name or type(task).__name__!r}"
    _refuse_misspelt_methods(type(task), title)
    undefined = [name for name in REQUIRED_METHODS if getattr(type(task), name) is getattr(Task, name)]
    require(
        not undefined,
        f"{title}: expected class {type(task).__name__} to define {', '.join(REQUIRED_METHODS)}, got no "
        f"{', '.join(undefined)}. {GUIDE} describes each method.",
    )
    # Types and shapes of the results, without computing them.
    n_worlds, n_drones = data.states.pos.shape[:2]
    batch, batch_name = ((n_worlds,), "n_worlds, ") if task.batched else ((), "")
    world = data if task.batched else jax.tree.map(_world_shape, scopes(data), data)
    action = jax.ShapeDtypeStruct((*batch, n_drones, action_size), data.states.pos.dtype)
    with explain_traced_values(title), _name_missing_record(title, data):
        obs, rewards, terminated, error, info = jax.eval_shape(
            lambda data, action: (
                task.observe(data), task.rewards(data, action, action), task.terminated(data), task.error(data),
                task.info(data),
            ), world, action,
        )  # fmt: skip

    for method, result in (("observe", obs), ("rewards", rewards), ("info", info)):
        require(
            isinstance(result, Mapping) and (result or method == "info"),
            f"{title}: expected {method} to return a dict of names to arrays, got {_describe(result)}. {GUIDE} "
            f"has an example.",
        )
    drones = (*batch, n_drones)
    for name, x in obs.items():
        shape = getattr(x, "shape", ())
        require(
            shape[:-1] == drones and len(shape) == len(drones) + 1,
            f"{title}: expected observation {name!r} of shape ({batch_name}n_drones, k) = "
            f"({', '.join(map(str, drones))}, k), got {_describe(x)}. For one number per drone use x[:, None]; "
            f"for one array per drone use x.reshape(n_drones, -1).",
        )
    for name, x in [(f"reward term {name!r}", x) for name, x in rewards.items()] + [("error", error)]:
        require(
            getattr(x, "shape", None) == drones,
            f"{title}: expected {name} of shape ({batch_name}n_drones,) = {drones}, got {_describe(x)}. For the "
            f"same number for all drones use jnp.full(data.core.n_drones, x).",
        )
    for name, x in info.items():
        require(
            x.shape == batch or x.shape[: len(drones)] == drones,
            f"{title}: expected info {name!r} of shape ({batch_name.removesuffix(', ')}) or "
            f"({batch_name}n_drones, ...) = ({', '.join(map(str, drones))}, ...), got {_describe(x)}. For an array "
            f"of the world use jnp.broadcast_to(x, (data.core.n_drones, *x.shape)).",
        )
    require(
        getattr(terminated, "shape", None) == batch and jnp.issubdtype(terminated.dtype, jnp.bool_),
        f"{title}: expected terminated of type bool and shape ({batch_name.removesuffix(', ')}), got "
        f"{_describe(terminated)}. It is one value per world: use jnp.any or jnp.all over the drones.",
    )


def _refuse_misspelt_methods(cls: type[Task], title: str) -> None:
    # Of the classes outside of the package; a method that other methods use is no misspelt one.
    bases = cls.__mro__[: cls.__mro__.index(Task)]
    functions = [(base, name, getattr(x, "__func__", x)) for base in bases for name, x in vars(base).items()]
    functions = [(base, name, fn) for base, name, fn in functions if inspect.isfunction(fn)]
    used_names = {used for _, _, fn in functions for used in _names_of(fn.__code__)}
    own_names = {name for base, name, _ in functions if not base.__module__.startswith("crazysim.")}
    for name in sorted(own_names - used_names - HOOKS):
        similar = difflib.get_close_matches(name, HOOKS - own_names, 1, 0.8)
        require(
            not similar or name.startswith("_"),
            f"{title}: expected methods that something calls, got {name!r}, which nothing calls. Use the name "
            f"{''.join(similar)!r} if you mean that method, or else begin the name with an underscore.",
        )


def _names_of(code: CodeType) -> set[str]:
    return set(code.co_names).union(*(_names_of(x) for x in code.co_consts if isinstance(x, CodeType)))


@contextlib.contextmanager
def _name_missing_record(title: str, data: SimData) -> Iterator[None]:
    try:
        yield
    except KeyError as error:
        error.add_note(
            f"in {title}: data.plugins has {', '.join(map(repr, data.plugins)) or 'no records'}. Use sim.add for a "
            f"plugin, and self.add_states(sim, ...) in install for the states of the task, {TASK_RECORD_NAME!r}."
        )
        raise


def _world_shape(scope: str, x: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape[n_world_axes(scope) :], x.dtype)


def _describe(x: object) -> str:
    if not hasattr(x, "shape"):
        return f"a {type(x).__name__}" if not isinstance(x, Mapping) else "an empty dict"
    return f"shape {x.shape} and type {x.dtype}"
