"""A step of an environment as one kernel: what an action means, the physics, the task, and episodes that begin anew.

Task and wrappers are functions of all worlds. Where each world is treated like every other and sees none of them, they
can be written out for one, as stages of the engine: those before the first step of physics, and those after the last.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.stage import Axes, Stage
from crazysim.core.stages import finite
from crazysim.engine.fused_rollout import Whole
from crazysim.engine.independence import require_apart
from crazysim.engine.lower import UnsupportedError
from crazysim.envs.env import DroneEnv, Env, EnvState
from crazysim.pytree import PyTree, leaf, scopes

NAME = "environment"
"""Where the rest of an environment's state is, in ``data.plugins``, while the kernel runs."""


class Rest(PyTree):
    """What an environment's state has beside the simulation: its arrays by name, each in rows of one drone or world."""

    of_drones: dict[str, Array] = leaf("drone", 1)
    """(n_worlds, n_drones, k) each"""
    of_worlds: dict[str, Array] = leaf("world", 1)
    """(n_worlds, 1, k) each"""


@dataclasses.dataclass(frozen=True)
class Renewal:
    """How new episodes begin."""

    over: Callable[[EnvState, EnvState], Array]
    """``over(before, after)``: where, from the states before and after a step. (n_worlds,)"""
    prepare: Callable[[EnvState], EnvState]
    """``prepare(after)``: the state as it is where none begins."""
    begin: Callable[[EnvState, Array], EnvState]
    """``begin(prepared, mask)``: the state with new episodes in the worlds of a mask."""


class WholeStep:
    """``step(state, action) -> state`` of an environment in one kernel, for states of one structure."""

    def __init__(self, env: Env, renewal: Renewal | None, state: EnvState, action: Any, laid: bool = False):
        """Write it out.

        Args:
            env: The environment, without automatic resets.
            renewal: How new episodes begin; None if they do not.
            state: State of the structure that is stepped, or its shapes and types.
            action: Action, or its shape and type.
            laid: Whether it is for ``advance``, which hands few arrays to and fro, rather than to be called.

        Raises:
            UnsupportedError: If something of it cannot be written out for one world.
        """
        self._env, self._renewal = env, renewal
        base = base_of(env)
        self._n_drones = base.sim.n_drones
        if base.sim.mesh is not None:
            raise UnsupportedError("its worlds are spread over devices")
        state, action = jax.eval_shape(lambda *x: x, state, action)
        after = jax.eval_shape(self._plainly, state, action)
        self._given, self._told = _Layout(state), _Layout(after)
        self._action = action
        rest = self._given.shapes | self._told.shapes | {ACTION: action}
        rest |= {OVER: jax.ShapeDtypeStruct((base.sim.n_worlds,), bool)} if renewal else {}
        self._rest = rest
        example = jax.eval_shape(lambda state, action: self._joined(state, action, base.sim.n_worlds), state, action)
        axes = Axes(example)
        self._axes = axes
        self._require_apart(example, state)
        places = _places(state.data, example)
        # A parameter that has become one per drone since is zero for none of them for certain.
        zeros = {places[i]: some for i, some in base.zeros if axes.scopes[places[i]] == "shared"}
        last = [self._stage(self._observed, "observe and reward")]
        if renewal is not None:
            last.append(self._stage(self._begun, "new episodes", lambda one: one.plugins[NAME].of_worlds[OVER][0]))
        scratch = [i for i, name in enumerate(axes.names) if name.endswith(f"[{OVER!r}]")]
        first = [self._stage(self._acted, "actions")]
        self._numbers = _numbers(example)
        told = {self._numbers[name] for name in self._told.shapes if name.startswith(TOLD)}
        lay = (lambda written: [i for i in written if i not in told]) if laid else None
        settings = (base.n_substeps, base.sim.device.platform, scratch, lay)
        self._run = Whole(first, base.stages, last, example, zeros, *settings)
        again = {name for name in self._told.shapes if self._numbers[name] in told & set(self._run.read)} - set(ENDS)
        if laid and again:
            raise UnsupportedError(f"a step reads {', '.join(sorted(again))} of the step before")

    def __call__(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later. (n_worlds, n_drones, k)"""
        joined = self._joined(state, action, state.terminated.shape[0])
        leaves, treedef = jax.tree.flatten(joined)
        return self._stepped(self._run(leaves), treedef, self._told)

    # With few arrays ----------------------------------------------------------------------------------------------

    def lay(self, state: EnvState) -> Laid:
        """Return a state as ``advance`` wants it."""
        action = jnp.zeros(self._action.shape, self._action.dtype)
        leaves = jax.tree.leaves(self._joined(state, action, state.terminated.shape[0]))
        own = {self._numbers[name] for name in (*ENDS, ACTION)}
        constants = {i: leaves[i] for i in self._run.read if i not in own}
        return Laid(self._run.rows(leaves), self._run.shared(leaves), constants)

    def advance(self, laid: Laid, ends: tuple[Array, Array], action: Array) -> tuple[Laid, EnvState]:
        """Return what ``lay`` does of the state one step later, and that state without its data and what it remembers.

        Args:
            laid: The state before.
            ends: Its ``terminated`` and ``truncated``. (n_worlds,) each
            action: What all drones do. (n_worlds, n_drones, k)
        """
        given = self._rows(dict(zip(ENDS, ends, strict=True)) | {ACTION: action})
        read = laid.constants | {self._numbers[k]: x for k, x in (given.of_drones | given.of_worlds).items()}
        read = {i: x for i, x in read.items() if i in self._run.read}
        rows, found = self._run.advance(laid.rows, laid.shared, read)
        told = {name: found.get(self._numbers[name]) for name in self._told.shapes}
        arrays = {
            k: None if x is None else x.reshape(x.shape[0], *self._told.shapes[k].shape[1:]) for k, x in told.items()
        }
        return laid._replace(rows=rows), self._told.state(arrays, None)

    def unlay(self, laid: Laid, state: EnvState) -> EnvState:
        """Return the state after some calls of ``advance``, bare of what they tell.

        Args:
            laid: What the last of them returned.
            state: What was given to ``lay``.
        """
        joined = self._joined(state, state.action, state.terminated.shape[0])
        leaves, treedef = jax.tree.flatten(joined)
        for i, x in self._run.unlaid(laid.rows).items():
            leaves[i] = x
        return self._stepped(leaves, treedef, self._given)

    def _stepped(self, leaves: list[Any], treedef: Any, layout: _Layout) -> EnvState:
        after = self._state(treedef.unflatten(leaves), layout)
        return after.replace(data=_shown(after.data, False))

    # For any number of worlds -------------------------------------------------------------------------------------

    def _acted(self, joined: SimData) -> SimData:
        """Have the data know what the action means."""
        state, action = self._state(joined, self._given), self._of(joined, ACTION, self._action)
        seen: list[SimData] = []

        def fly(data: SimData) -> SimData:
            seen.append(data)
            return data

        _flown(self._env, fly).step(state, action)
        if len(seen) != 1:
            raise UnsupportedError(f"a wrapper steps its environment {len(seen)} times in a step")
        return self._changed(joined, seen[0], {})

    def _observed(self, joined: SimData, before: SimData | None = None) -> SimData:
        """Have the rest know what there is to tell after the physics."""
        state, action = self._state(joined, self._given), self._of(joined, ACTION, self._action)
        now = _without_rest(joined)
        now = now.replace(core=now.core.replace(nonfinite=now.core.nonfinite | ~finite(now)))
        after = _flown(self._env, lambda _: now).step(state.replace(data=now if before is None else before), action)
        told = {}
        if self._renewal is not None:
            told = {OVER: self._renewal.over(state, after)}
            after = self._renewal.prepare(after)
        return self._changed(joined, after.data, self._told.arrays(after) | told)

    def _begun(self, joined: SimData) -> SimData:
        """Begin new episodes in all worlds."""
        after = self._state(joined, self._told)
        if self._renewal is not None:
            after = self._renewal.begin(after, jnp.ones(after.terminated.shape, bool))
        return self._changed(joined, after.data, self._told.arrays(after))

    def _plainly(self, state: EnvState, action: Array) -> EnvState:
        after = _flown(self._env, lambda data: data).step(state, action)
        return after if self._renewal is None else self._renewal.prepare(after)

    # Between a state and one record of data -----------------------------------------------------------------------

    def _joined(self, state: EnvState, action: Array, n_worlds: int) -> SimData:
        """Return the data with all else as one of its records."""
        arrays = self._given.arrays(state) | {ACTION: action}
        zeros = {k: jnp.zeros((n_worlds, *x.shape[1:]), x.dtype) for k, x in self._rest.items() if k not in arrays}
        rest = self._rows(arrays | zeros)
        return state.data.replace(plugins=state.data.plugins | {NAME: rest})

    def _rows(self, arrays: dict[str, Array]) -> Rest:
        of_drones, of_worlds = {}, {}
        for name, x in arrays.items():
            if _is_of_drones(self._rest[name], self._n_drones):
                of_drones[name] = x.reshape(x.shape[0], self._n_drones, -1)
            else:
                of_worlds[name] = x.reshape(x.shape[0], 1, -1)
        return Rest(of_drones, of_worlds)

    def _of(self, joined: SimData, name: str, like: Any) -> Array:
        rest = joined.plugins[NAME]
        x = rest.of_drones[name] if name in rest.of_drones else rest.of_worlds[name]
        return x.reshape(x.shape[0], *like.shape[1:])

    def _state(self, joined: SimData, layout: _Layout) -> EnvState:
        arrays = {name: self._of(joined, name, like) for name, like in layout.shapes.items()}
        return layout.state(arrays, _without_rest(joined))

    def _changed(self, joined: SimData, data: SimData, arrays: dict[str, Array]) -> SimData:
        rest, new = joined.plugins[NAME], self._rows({k: x.astype(self._rest[k].dtype) for k, x in arrays.items()})
        rest = Rest(rest.of_drones | new.of_drones, rest.of_worlds | new.of_worlds)
        # Whether the scene shows the data is the shell's to know.
        data = _shown(data, joined.core.mjx_synced)
        return data.replace(plugins=data.plugins | {NAME: rest})

    # For one world ------------------------------------------------------------------------------------------------

    def _stage(
        self, fn: Callable[[SimData], SimData], name: str, when: Callable[[SimData], Array] | None = None
    ) -> Stage:
        """Return a function of all worlds as a stage of one."""
        axes = {"drone": 1, "world": 2}

        def of_one(one: SimData) -> SimData:
            leaves, treedef = jax.tree.flatten(one)
            scopes = self._axes.scopes
            many = [x[(None,) * axes.get(s, 0)] if s in axes else x for s, x in zip(scopes, leaves, strict=True)]
            after = jax.tree.leaves(fn(_of_worlds(treedef.unflatten(many), 1)))
            return treedef.unflatten(
                [x[(0,) * axes[s]] if s in axes else x for s, x in zip(scopes, after, strict=True)]
            )

        return Stage(of_one, "world", when, name=name)

    def _require_apart(self, example: SimData, state: EnvState) -> None:
        """Check that each world can be written out for itself.

        Raises:
            UnsupportedError: If not.
        """
        leaves, treedef = jax.tree.flatten(example)
        batched = [s in ("drone", "world") for s in self._axes.scopes]
        two = [_two(x) if b else x for x, b in zip(leaves, batched, strict=True)]
        sources = ["worlds" if b else "shared" for b in batched]
        of_data = [s in ("drone", "world") for s in jax.tree.leaves(scopes(state.data))]
        old = [_two(x) if b else x for x, b in zip(jax.tree.leaves(state.data), of_data, strict=True)]
        past = ["the data from before the step" if b else "shared" for b in of_data]

        def apart(fn: Callable[..., SimData]) -> Callable[[list[Any]], list[Any]]:
            def flat(values: list[Any]) -> list[Any]:
                records = [treedef.unflatten(values[: len(two)])]
                if len(values) > len(two):
                    records.append(jax.tree.unflatten(jax.tree.structure(state.data), values[len(two) :]))
                after = jax.tree.leaves(fn(*(_of_worlds(x, 2) for x in records)))
                return [x for x, b in zip(after, batched, strict=True) if b]

            return flat

        require_apart(apart(self._acted), two, sources, "what an action means, or task.mark,")
        require_apart(apart(self._observed), [*two, *old], [*sources, *past], "the task or a wrapper")
        if self._renewal is not None:
            require_apart(apart(self._begun), two, sources, "the beginning of an episode")


class Laid(NamedTuple):
    """A state as few arrays."""

    rows: list[Array]
    """What a step writes. (n_rows, n_lanes) each"""
    shared: list[Array]
    """What all drones share. (n,)"""
    constants: dict[int, Array]
    """What else a step reads, by number."""


ACTION, OVER = "action of this step", "over"
"""Names of what no state has."""
TOLD = (".obs", ".reward", ".terminated", ".truncated", ".info")
"""Names of what a step tells."""
ENDS = (".terminated", ".truncated")
"""What is told and read by the next step."""


class _Layout:
    """Arrays of a state beside its data, by name."""

    def __init__(self, state: EnvState):
        paths, self._treedef = jax.tree_util.tree_flatten_with_path(state.replace(data=None))
        self._names = [jax.tree_util.keystr(path) for path, _ in paths]
        self.shapes = dict(zip(self._names, (x for _, x in paths), strict=True))
        for name, x in self.shapes.items():
            if x.shape[:1] != state.terminated.shape:
                raise UnsupportedError(f"the state's {name} has shape {x.shape}, which is not of worlds")

    def arrays(self, state: EnvState) -> dict[str, Any]:
        return dict(zip(self._names, self._treedef.flatten_up_to(state.replace(data=None)), strict=True))

    def state(self, arrays: dict[str, Any], data: SimData | None) -> EnvState:
        return self._treedef.unflatten([arrays[name] for name in self._names]).replace(data=data)


def base_of(env: Env) -> DroneEnv:
    """Return the environment that all wrappers are around."""
    while not isinstance(env, DroneEnv):
        env = env.env  # type: ignore[attr-defined]
    return env


def _flown(env: Env, fly: Callable[[SimData], SimData]) -> Env:
    """Return an environment that does something else in place of its physics."""
    new = copy.copy(env)
    if isinstance(new, DroneEnv):
        new.fly = fly  # type: ignore[method-assign]
    else:
        new.env = _flown(new.env, fly)  # type: ignore[attr-defined]
    return new


def _two(x: Any) -> jax.ShapeDtypeStruct:
    """Return shape and type of the same of two worlds."""
    return jax.ShapeDtypeStruct((2, *x.shape[1:]), x.dtype)


def _is_of_drones(x: Any, n_drones: int) -> bool:
    return len(x.shape) > 1 and x.shape[1] == n_drones


def _of_worlds(data: SimData, n_worlds: int) -> SimData:
    return data.replace(core=data.core.replace(n_worlds=n_worlds))


def _shown(data: SimData, shown: Any) -> SimData:
    return data.replace(core=data.core.replace(mjx_synced=jnp.asarray(shown)))


def _without_rest(joined: SimData) -> SimData:
    return joined.replace(plugins={k: x for k, x in joined.plugins.items() if k != NAME})


def _numbers(joined: SimData) -> dict[str, int]:
    """Return the numbers of the leaves that are no data, by name."""
    leaves, treedef = jax.tree.flatten(joined)
    rest = treedef.unflatten(range(len(leaves))).plugins[NAME]
    return rest.of_drones | rest.of_worlds


def _places(data: SimData, joined: SimData) -> list[int]:
    """Return where the leaves of the data are among those of the joined data."""
    leaves, treedef = jax.tree.flatten(data)
    numbered = treedef.unflatten(range(len(leaves)))
    rest = jax.tree.map(lambda _: -1, joined.plugins[NAME])
    found = jax.tree.leaves(numbered.replace(plugins=numbered.plugins | {NAME: rest}))
    return [found.index(i) for i in range(len(leaves))]
