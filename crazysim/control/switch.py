"""Several controllers on one drone. A function of state, setpoint and time, or a fixed index, selects a controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control.allocation import AllocationParams, force_torque2rotor_vel
from crazysim.control.levels import Control
from crazysim.control.protocol import Controller, DroneData
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.engine.pytree import PyTree, leaf
from crazysim.errors import expect, require


class SwitchParams(PyTree):
    """Parameters of several controllers."""

    controllers: tuple[Any, ...]
    """Parameters of each controller."""
    allocation: AllocationParams
    """Allocation of controllers that return a wrench."""
    index: Array | None = leaf("parameter", 1, (1,))
    """Index of the controller to use; None with a switch function. (1,)"""


class SwitchMemory(PyTree):
    """Memory of several controllers."""

    controllers: tuple[Any, ...]
    """Memory of each controller."""
    active: Array = leaf("drone", 1)
    """Index of the active controller; -1 before the first tick. (n_worlds, n_drones, 1)"""
    rotor_vel: Array = leaf("drone", 1)
    """Rotor speeds that were commanded last, rpm. (n_worlds, n_drones, n_rotors)"""


class Switch(Controller):
    """Several controllers that take turns in commanding a drone. ``Sim(controller=[...], switch=...)`` creates it.

    Only the active controller's memory changes. When a controller becomes active, its ``take_over`` sets its memory, so
    that its first command can continue the last command. The switch also allocates wrenches to the rotors.
    """

    name: ClassVar[str] = "switch"
    levels: ClassVar[tuple[Control, ...]] = (Control.state, Control.attitude, Control.body_rate)
    output: ClassVar[Control] = Control.rotor_vel
    controllers: tuple[Controller, ...]
    """The controllers."""
    switch: Any
    """Function ``(state, setpoint, time) -> index`` for one drone, or indices, () or (n_worlds, n_drones).

    ``state`` is the ``SimState`` of the drone; ``setpoint`` is its ``Setpoint``, or its command below the level
    ``state``; ``time`` is the time since the last reset, s. A returned index that is out of range is clipped."""
    freq: int = 500
    """Rate at which the switch is evaluated, Hz; in a simulation, a common multiple of the rates of all controllers."""

    @property
    def members(self) -> tuple[Controller, ...]:
        return self.controllers

    def params(self, airframe: Airframe) -> SwitchParams:
        index: Any = None if callable(self.switch) else _check_indices(self.switch, len(self.controllers))
        params = tuple(c.params(airframe) for c in self.controllers)
        return SwitchParams(params, AllocationParams.create(airframe), index)

    def memory(self, airframe: Airframe) -> SwitchMemory:
        memory = tuple(c.memory(airframe) for c in self.controllers)
        zero_rotor_vel: Any = np.zeros(airframe.n_rotors)
        return SwitchMemory(memory, np.full(1, -1, np.int32), zero_rotor_vel)  # type: ignore[arg-type]

    def update(
        self, data: DroneData, command: Setpoint | Array, memory: SwitchMemory, params: SwitchParams
    ) -> tuple[Array, SwitchMemory]:
        index = self._active_index(data, command, params)
        has_switched = (memory.active[0] >= 0) & (memory.active[0] != index)
        rotor_vel, new_memories = memory.rotor_vel, []
        # All controllers are computed; the selected one acts when it is due.
        for k, (controller, m, p) in enumerate(
            zip(self.controllers, memory.controllers, params.controllers, strict=True)
        ):
            is_selected = index == k
            takes_over = is_selected & has_switched
            m = _select_tree(takes_over, controller.take_over(data, command, m, p, memory.rotor_vel), m)
            if isinstance(command, Setpoint) and controller.has_outer:
                is_due = is_selected & (takes_over | _is_tick(data, controller.outer_freq))
                m = _select_tree(is_due, controller.outer(data, command, m, p), m)
            is_due = is_selected & (takes_over | _is_tick(data, controller.freq))
            output, new_memory = controller.update(data, command, m, p)
            if controller.output == Control.force_torque:
                output = force_torque2rotor_vel(output, params=params.allocation)
            rotor_vel = jnp.where(is_due, output, rotor_vel)
            new_memories.append(_select_tree(is_due, new_memory, m))
        active = jnp.full_like(memory.active, index)
        return rotor_vel, SwitchMemory(tuple(new_memories), active, rotor_vel)

    def _active_index(self, data: DroneData, command: Setpoint | Array, params: SwitchParams) -> Array:
        if params.index is not None:
            index = params.index[0]
        else:
            index = jnp.asarray(self.switch(data.states, command, data.core.steps / data.core.freq))
        require(
            index.shape == () and jnp.issubdtype(index.dtype, jnp.integer),
            f"expected one integer from the switch function, got shape {index.shape} and type {index.dtype}. "
            f"Use jnp.where(..., 1, 0), for one drone.",
        )
        return jnp.clip(index, 0, len(self.controllers) - 1).astype(jnp.int32)


def make_switch(controllers: Sequence[Controller], switch: Callable[..., Any] | Any) -> Switch:
    require(controllers, "expected at least one controller, got an empty list. Use controller=['pid', 'mellinger'].")
    require(
        switch is not None,
        "expected a switch for several controllers, got None. Use switch=fn with fn(state, setpoint, time) -> "
        "index, or indices of the drones' controllers.",
    )
    return Switch(tuple(controllers), switch)


def _check_indices(switch: Any, n: int) -> np.ndarray:
    indices = np.asarray(switch)
    expect(
        indices.dtype.kind in "iu" and indices.ndim in (0, 2) and not np.any((indices < 0) | (indices >= n)),
        f"switch as a function or as integers from 0 to {n - 1} of shape () or (n_worlds, n_drones)",
        switch,
        "Use np.zeros((n_worlds, n_drones), int) for the first controller.",
    )
    return indices[..., None].astype(np.int32)


def _is_tick(data: DroneData, freq: Any) -> Array | bool:
    return data.core.steps % (data.core.freq // freq) == 0


def _select_tree(mask: Any, new_tree: Any, old_tree: Any) -> Any:
    return jax.tree.map(lambda x, y: y if x is y else jnp.where(mask, x, y), new_tree, old_tree)
