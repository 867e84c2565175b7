"""An environment step as one kernel: action, physics, observation and the start of new episodes.

The phases of a step (``crazysim.envs.phases``) are functions of one world. Here they become stages of the engine:
``act`` runs before the first physics step, ``observe`` after the last, and ``begin`` where an episode is over.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.stage import Stage
from crazysim.core.stages import nonfinite
from crazysim.engine.errors import LimitError
from crazysim.engine.fused_call import FusedCall
from crazysim.engine.ir.program import Program
from crazysim.envs.env import Env
from crazysim.envs.reset_policy import ResetPolicy
from crazysim.envs.state import EnvState
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf, n_world_axes, numbered, scopes

NAME = "environment"
"""Key in ``data.plugins`` of the rest of an environment's state while the kernel runs."""
ACTION, OVER = "action of this step", "over"
"""Names of arrays that no state has."""
OUTPUTS = (".obs", ".reward", ".terminated", ".truncated", ".info")
"""Prefixes of the names of what a step returns, and of which it reads the ends of episodes only."""
Action = Array | jax.ShapeDtypeStruct
"""An action, or its shape and type."""
ENDS = (".terminated", ".truncated")
"""Names of outputs that the next step reads."""


class Rest(PyTree):
    """State of an environment besides the simulation's data, by name, as rows of one drone or one world each."""

    of_drones: dict[str, Array] = leaf("drone", 1)
    """(n_worlds, n_drones, k) each"""
    of_worlds: dict[str, Array] = leaf("world", 1)
    """(n_worlds, 1, k) each"""


class PackedState(NamedTuple):
    """A state as few arrays: each array of a compiled call costs more than the arithmetic on it."""

    rows: list[Array]
    """Numbers that a step writes. (n_rows, n_lanes) each"""
    shared: list[Array]
    """Numbers that all drones share. (n,)"""
    constants: dict[int, Array]
    """Other arrays that a step reads, by leaf."""


class FusedEnvStep:
    """``step(state, action) -> state`` of an environment as one kernel, for states of one structure."""

    def __init__(
        self,
        env: Env,
        policy: ResetPolicy | None,
        state: EnvState,
        action: Action,
        packed: bool = False,
    ):
        """Trace and lower the step.

        Args:
            env: The environment, without automatic resets.
            policy: Rule of automatic resets; None for no resets.
            state: A state of the structure that is stepped, or its shapes and types.
            action: An action, or its shape and type.
            packed: True for ``step_packed``, False for calls.

        Raises:
            UnsupportedError: If the engine cannot lower it.
        """
        self._phases, self._policy, self._base, base = env.phases, policy, env.base, env.base
        for wrapper in env.wrappers:
            if wrapper.batched:
                raise LimitError(f"wrapper {wrapper.name!r} is declared to need all worlds at once")
        self._n_drones = base.sim.n_drones
        state, action = jax.eval_shape(lambda *x: x, state, action)
        one, one_action = _of_one_world(state), jax.ShapeDtypeStruct(action.shape[1:], action.dtype)
        self._before, self._after = _Layout(one), _Layout(jax.eval_shape(self._outline, one, one_action))
        self._shapes = self._before.shapes | self._after.shapes | {ACTION: one_action}
        self._shapes |= {OVER: jax.ShapeDtypeStruct((), bool)} if policy else {}
        self._kinds = self._before.kinds | self._after.kinds | {ACTION: "drone", OVER: "world"}
        self._check_kinds()
        joined = jax.eval_shape(self._joined, state, action)
        first, last = [Stage(self._act, "world", name="actions")], [Stage(self._observe, "world", name="observations")]
        if policy is not None:
            last.append(Stage(self._begin, "world", lambda one: one.plugins[NAME].of_worlds[OVER][0], name="resets"))
        self._leaf = _leaves_of_rest(joined)
        scratch = [self._leaf[name] for name in (ACTION, OVER) if name in self._leaf]
        outputs = {self._leaf[name] for name in self._after.shapes if name.startswith(OUTPUTS)}
        rows = (lambda written: [i for i in written if i not in outputs]) if packed else None
        settings = (base.n_substeps, base.sim.device.platform, scratch, rows)
        self._run = FusedCall(first, base.stages, last, joined, *settings)
        again = {name for name in self._after.shapes if self._leaf[name] in outputs & set(self._run.read)} - set(ENDS)
        if packed and again:
            raise LimitError(f"a step reads {', '.join(sorted(again))} of the step before")

    @property
    def program(self) -> Program:
        """Program of the kernel."""
        return self._run.program

    def __call__(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later. (n_worlds, n_drones, k)"""
        leaves, treedef = jax.tree.flatten(self._joined(state, action))
        return self._separated(treedef.unflatten(self._run(leaves)), self._after)

    # Packed states ------------------------------------------------------------------------------------------------

    def pack(self, state: EnvState) -> PackedState:
        """Return a state as the argument of ``step_packed``."""
        action = jnp.zeros((state.terminated.shape[0], *self._shapes[ACTION].shape), self._shapes[ACTION].dtype)
        leaves = jax.tree.leaves(self._joined(state, action))
        own = {self._leaf[name] for name in (*ENDS, ACTION)}
        constants = {i: leaves[i] for i in self._run.read if i not in own}
        return PackedState(self._run.pack(leaves), self._run.shared(leaves), constants)

    def step_packed(
        self, packed: PackedState, ends: tuple[Array, Array], action: Array
    ) -> tuple[PackedState, EnvState]:
        """Return the packed state one step later, and that state without its data and memory.

        Args:
            packed: The state before.
            ends: Its ``terminated`` and ``truncated``. (n_worlds,) each
            action: Action of every drone. (n_worlds, n_drones, k)
        """
        n_worlds = ends[0].shape[0]
        given = self._rest(dict(zip(ENDS, ends, strict=True)) | {ACTION: action}, (n_worlds,))
        read = packed.constants | {self._leaf[k]: x for k, x in (given.of_drones | given.of_worlds).items()}
        read = {i: x for i, x in read.items() if i in self._run.read}
        rows, found = self._run.run_packed(packed.rows, packed.shared, read)
        outputs = {name: found.get(self._leaf[name]) for name in self._after.shapes}
        arrays = {name: None if x is None else x.reshape(self._shape(name, (n_worlds,))) for name, x in outputs.items()}
        return packed._replace(rows=rows), self._after.state(arrays, None)

    def unpack(self, packed: PackedState, state: EnvState) -> EnvState:
        """Return a packed state as a state, without the outputs of its last step.

        Args:
            packed: Result of ``step_packed``.
            state: The state that ``pack`` was called with.
        """
        leaves, treedef = jax.tree.flatten(self._joined(state, state.action))
        for i, x in self._run.unpack(packed.rows).items():
            leaves[i] = x
        return self._separated(treedef.unflatten(leaves), self._before)

    # Stages of one world ------------------------------------------------------------------------------------------

    def _act(self, joined: SimData) -> SimData:
        state, action = self._phases.act(self._state(joined, self._before), self._get(joined, ACTION))
        return self._with(joined, state, self._before, {ACTION: action})

    def _observe(self, joined: SimData) -> SimData:
        before = self._state(joined, self._before)
        data = before.data.replace(core=before.data.core.replace(nonfinite=nonfinite(before.data)))
        after = self._phases.observe(before.replace(data=data), self._get(joined, ACTION))
        over = {}
        if self._policy is not None:
            over = {OVER: self._policy.is_over(before.done, after)}
            after = self._policy.end(after)
        return self._with(joined, after, self._after, over)

    def _begin(self, joined: SimData) -> SimData:
        ended = self._state(joined, self._after)
        new = self._phases.begin(ended, self._base.default_of_world(ended.data))
        return self._with(joined, ended if self._policy is None else self._policy.begin(ended, new), self._after)

    def _outline(self, state: EnvState, action: Array) -> EnvState:
        """Return a state of the structure that a step returns."""
        state = self._phases.observe(*self._phases.act(state, action))
        return state if self._policy is None else self._policy.end(state)

    # Between a state and the data that the engine runs on -----------------------------------------------------------

    def _joined(self, state: EnvState, action: Array) -> SimData:
        """Return the data of all worlds with the rest of the state as a plugin's record."""
        n_worlds = state.terminated.shape[0]
        arrays = {k: jnp.zeros((n_worlds, *x.shape), x.dtype) for k, x in self._shapes.items()}
        arrays |= self._before.arrays(state) | {ACTION: action}
        return state.data.replace(plugins=state.data.plugins | {NAME: self._rest(arrays, (n_worlds,))})

    def _separated(self, joined: SimData, layout: _Layout) -> EnvState:
        """Return the state of all worlds from the joined data."""
        state = self._state(joined, layout, joined.states.pos.shape[:1])
        core = state.data.core.replace(mjx_synced=jnp.asarray(False))
        return state.replace(data=state.data.replace(core=core))

    def _rest(self, arrays: dict[str, Array], worlds: tuple[int, ...]) -> Rest:
        """Return arrays of all worlds, or of one, as rows; those that are not declared for drones are of worlds."""
        of_drones, of_worlds = {}, {}
        for name, x in arrays.items():
            if self._kinds[name] == "drone":
                of_drones[name] = x.reshape(*worlds, self._n_drones, -1)
            else:
                of_worlds[name] = x.reshape(*worlds, *(1 for _ in worlds), -1)
        return Rest(of_drones, of_worlds)

    def _get(self, joined: SimData, name: str, worlds: tuple[int, ...] = ()) -> Array:
        rest = joined.plugins[NAME]
        x = rest.of_drones[name] if name in rest.of_drones else rest.of_worlds[name]
        return x.reshape(self._shape(name, worlds))

    def _shape(self, name: str, worlds: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of an array of all worlds, or of one."""
        ones = n_world_axes(self._kinds[name]) - 1 if worlds else 0
        return (*worlds, *(1 for _ in range(ones)), *self._shapes[name].shape)

    def _check_kinds(self) -> None:
        """Check that every array belongs to worlds or drones, and that those of drones have their axis.

        Raises:
            LimitError: If worlds share one.
            ConfigError: If one that is declared for drones has another first axis.
        """
        for name in self._before.shapes | self._after.shapes:
            kind, shape = self._kinds[name], self._shapes[name].shape
            if n_world_axes(kind) == 0:
                raise LimitError(f"all worlds share {name.lstrip('.')}")
            if kind == "drone" and shape[:1] != (self._n_drones,):
                raise ConfigError(
                    f"expected {name.lstrip('.')} of shape (n_drones, ...) in one world, with {self._n_drones} drones, "
                    f"got {shape}. Return one row for every drone."
                )

    def _state(self, joined: SimData, layout: _Layout, worlds: tuple[int, ...] = ()) -> EnvState:
        data = joined.replace(plugins={k: x for k, x in joined.plugins.items() if k != NAME})
        return layout.state({name: self._get(joined, name, worlds) for name in layout.shapes}, data)

    def _with(
        self, joined: SimData, state: EnvState, layout: _Layout, further: dict[str, Array] | None = None
    ) -> SimData:
        """Return the joined data of one world with a state in place of its own."""
        arrays = layout.arrays(state) | (further or {})
        arrays = {name: jnp.asarray(x, self._shapes[name].dtype) for name, x in arrays.items()}
        old, new = joined.plugins[NAME], self._rest(arrays, ())
        rest = Rest(old.of_drones | new.of_drones, old.of_worlds | new.of_worlds)
        return state.data.replace(plugins=state.data.plugins | {NAME: rest})


class _Layout:
    """Arrays of a state besides its data, by name, with their shapes and types in one world, and their scopes."""

    def __init__(self, state: EnvState):
        paths, self._treedef = jax.tree_util.tree_flatten_with_path(state.replace(data=None))
        self._names = [jax.tree_util.keystr(path) for path, _ in paths]
        self.shapes = dict(zip(self._names, (x for _, x in paths), strict=True))
        kinds = jax.tree.leaves(scopes(state.replace(data=None)))
        self.kinds = {name: _kind(name, x, kind) for (name, x), kind in zip(self.shapes.items(), kinds, strict=True)}

    def arrays(self, state: EnvState) -> dict[str, Any]:
        return dict(zip(self._names, self._treedef.flatten_up_to(state.replace(data=None)), strict=True))

    def state(self, arrays: dict[str, Any], data: SimData | None) -> EnvState:
        return self._treedef.unflatten([arrays[name] for name in self._names]).replace(data=data)


def _kind(name: str, x: jax.ShapeDtypeStruct, declared: str) -> str:
    """Return the scope of an array: as declared, but for entries of ``info``, which are of drones unless scalar."""
    return "drone" if declared == "batched" and name.startswith(".info") and x.ndim else declared


def _of_one_world(state: EnvState) -> EnvState:
    """Return shapes and types of a state in one world."""
    return jax.tree.map(
        lambda kind, x: jax.ShapeDtypeStruct(x.shape[n_world_axes(kind) :], x.dtype), scopes(state), state
    )


def _leaves_of_rest(joined: SimData) -> dict[str, int]:
    """Return the numbers of the leaves that are not data, by name."""
    rest = numbered(joined).plugins[NAME]
    return rest.of_drones | rest.of_worlds
