"""Export of the step of one drone as a CasADi function, for tools such as acados."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from crazysim.arguments import check_arguments
from crazysim.control import Control
from crazysim.core.data import SimData
from crazysim.core.functional import stage_command, staged_leaves
from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir.program import Program, Slot, UnfusedStage
from crazysim.engine.jaxcompat import is_key
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.passes.schedule import fuse
from crazysim.engine.stage import Axes, as_stages, stage
from crazysim.engine.tools import symbolic
from crazysim.errors import ConfigError, UnknownNameError, expect, optional_import, require
from crazysim.sim.sim import Sim

STATES = ("states.pos", "states.quat", "states.vel", "states.ang_vel", "states.rotor_vel")
"""First fields of every state vector: m, unit xyzw, m/s, rad/s, rpm (in ``so_rpy_rotor*`` N)."""

FEEDFORWARD = "controls.state.staged_feedforward"
"""Field with the feedforward of setpoints."""


@dataclasses.dataclass(frozen=True)
class VectorLayout:
    """Layout of a vector: fields of ``SimData``, concatenated, each in row-major order."""

    sizes: Mapping[str, int]
    """Size of each field of one drone, in the order of the vector. The names are paths in ``SimData``; each
    entry has the unit of its field."""

    def __len__(self) -> int:
        return sum(self.sizes.values())

    def __getitem__(self, name: str) -> slice:
        require(
            name in self.sizes,
            f"{name!r} is not in this vector; it has {', '.join(self.sizes) or 'no fields'}",
            UnknownNameError,
        )
        names = list(self.sizes)
        start = sum(self.sizes[n] for n in names[: names.index(name)])
        return slice(start, start + self.sizes[name])

    def of(self, data: SimData, world: int = 0, drone: int = 0) -> np.ndarray:
        """Return the vector of one drone of a simulation. (len(self),)"""
        axes, leaves = Axes(data), jax.tree.leaves(data)
        indices = [axes.names.index(name) for name in self.sizes]
        parts = [_drone_numbers(axes.scopes[i], leaves[i], world, drone) for i in indices]
        return np.concatenate([np.zeros(0), *parts])


@dataclasses.dataclass(frozen=True)
class CasadiStep:
    """Step of one drone as a CasADi function, and the layouts of its vectors."""

    function: Any
    """``casadi.Function``: ``x_next = step(x, u)``, or ``step(x, u, p)`` if there are parameters."""
    x: VectorLayout
    """State: position, attitude, velocity, body rates, rotor speeds, internal states of controllers and effects."""
    u: VectorLayout
    """Command, in the order and units of the setter of the command level. The feedforward of a setpoint is its yaw rate
    and zeros, unless ``"controls.state.staged_feedforward"`` is a parameter."""
    p: VectorLayout
    """Requested parameters."""
    dt: float
    """Length of the step, s."""

    def __call__(self, *args: Any) -> Any:
        return self.function(*args)


@check_arguments
def to_casadi(sim: Sim, parameters: Sequence[str] = (), world: int = 0, drone: int = 0) -> CasadiStep:
    """Return the step of one drone as a CasADi function.

    The step pipeline in ``sim.step_pipeline``, including effects and user stages, is converted to expressions operation
    by operation, so the result equals ``sim.step`` in float64 up to rounding. Everything that is neither state,
    nor command, nor a requested parameter is a constant with its current value for that drone. In a float32 simulation
    the constants have that precision.

    Args:
        parameters: Fields of the vector ``p``, by their path in ``SimData``, such as ``"params.mass"`` or
            ``"states.force"``.

    Raises:
        ValueError: If the step cannot be exported; the message names the stage and the reason.
        ImportError: If CasADi is not installed.
    """
    with optional_import("the export needs", "casadi", "casadi"):
        import casadi
    data, stages = sim.data, as_stages(sim.step_pipeline)
    require(
        0 <= world < data.core.n_worlds and 0 <= drone < data.core.n_drones,
        f"expected a world from 0 to {data.core.n_worlds - 1} and a drone from 0 to {data.core.n_drones - 1}, got "
        f"world {world} and drone {drone}",
    )
    if len(staged_leaves(data)) > 1 and FEEDFORWARD not in parameters:
        stages = [stage("drone")(_stage_default_feedforward), *stages]
    # Below, a leaf is an index into ``program.leaves``, and a slot is a leaf with the index of one of its elements.
    program = fuse(lower_stages(stages, data))
    leaves, names = jax.tree.leaves(data), [x.name for x in program.leaves]
    mode = data.controls.mode
    command = "controls.rotor_vel" if mode == Control.rotor_vel else f"controls.{mode.value}.staged_cmd"
    state = [names.index(name) for name in STATES]
    inputs = [names.index(command), *_parameter_leaves(program, parameters, command)]
    sizes = {leaf: program.leaves[leaf].size for leaf in {*state, *inputs, *program.written_leaves}}
    symbols = {leaf: casadi.SX.sym(names[leaf], size) for leaf, size in sizes.items()}

    def initial_value(slot: Slot) -> Any:
        leaf, k = slot
        if leaf in symbols:
            return symbols[leaf][k]
        number = _drone_numbers(program.leaves[leaf].scope, leaves[leaf], world, drone)[k]
        if np.isnan(number):
            raise ConfigError(
                f"expected numbers for the constants of the step, got NaN in {names[leaf]!r} of world {world} and "
                f"drone {drone}. Set it, or use parameters=[{names[leaf]!r}]."
            )
        return casadi.SX(float(number))

    written_values = _step_expressions(program, initial_value)
    next_values = {
        leaf: casadi.vertcat(*(written_values.get((leaf, k), symbol[k]) for k in range(symbol.numel())))
        for leaf, symbol in symbols.items()
    }
    # A leaf is part of the state if the next value of any leaf of the state depends on it.
    while memory_leaves := [
        leaf
        for leaf, symbol in symbols.items()
        if leaf not in (*state, *inputs)
        and any(casadi.depends_on(next_values[state_leaf], symbol) for state_leaf in state)
    ]:
        state += memory_leaves
    state = state[: len(STATES)] + sorted(state[len(STATES) :])
    parts = {"x": state, "u": inputs[:1], "p": inputs[1:]}
    used_parts = [part for part, part_leaves in parts.items() if part_leaves]
    arguments = [casadi.vertcat(*(symbols[leaf] for leaf in parts[part])) for part in used_parts]
    x_next = casadi.vertcat(*(next_values[leaf] for leaf in state))
    return CasadiStep(
        casadi.Function("step", arguments, [x_next], used_parts, ["x_next"]),
        *(VectorLayout({names[leaf]: sizes[leaf] for leaf in part}) for part in parts.values()),
        dt=1 / data.core.freq,
    )


def _step_expressions(program: Program, initial_value: Callable[[Slot], Any]) -> dict[Slot, Any]:
    for segment in program.segments:
        if isinstance(segment, UnfusedStage):
            raise _export_error(segment.name, segment.error.reason)
        coupling_stage = next(
            (op.stage for op in segment.block.operations if op.name == "over_others"), segment.stages[0]
        )
        if segment.couples_drones:
            raise _export_error(coupling_stage, "it reads all drones of its world, but a step of one drone is exported")
    written_values: dict[Slot, Any] = {}
    for segment in program.fused_segments:
        slots = (*segment.reads, *segment.hoisted_reads)
        numbers = {slot: written_values[slot] if slot in written_values else initial_value(slot) for slot in slots}
        try:
            written_values |= symbolic.step_expressions(segment, numbers.__getitem__)
        except UnsupportedError as error:
            raise _export_error(error.stage, error.reason) from None
    return written_values


def _export_error(stage: str, reason: str) -> ConfigError:
    return ConfigError(f"the step cannot be exported because of its stage {stage!r}: {reason}")


def _stage_default_feedforward(data: SimData) -> SimData:
    return stage_command(data, staged_leaves(data)[0])


def _parameter_leaves(program: Program, parameters: Sequence[str], command: str) -> list[int]:
    names = [x.name for x in program.leaves]
    is_list = isinstance(parameters, (list, tuple)) and all(isinstance(x, str) for x in parameters)
    expect(is_list and len(set(parameters)) == len(parameters), "parameters as a list of distinct names", parameters)
    choices = [
        name
        for leaf, name in enumerate(names)
        if name not in (*STATES, command)
        and leaf not in program.written_leaves
        and program.leaves[leaf].scope in ("drone", "shared")
        and jax.numpy.issubdtype(program.leaves[leaf].dtype, jax.numpy.floating)
    ]
    for name in parameters:
        require(
            name in choices,
            f"expected a parameter of this step, got {name!r}; use one of {', '.join(choices)}",
            UnknownNameError,
        )
    return [names.index(name) for name in parameters]


def _drone_numbers(scope: str, x: Any, world: int, drone: int) -> np.ndarray:
    x = np.asarray(jax.random.key_data(x) if is_key(x) else x)
    index = {"drone": (world, drone), "world": (world, 0)}.get(scope, ())
    return x[index].astype(np.float64).reshape(-1)
