"""Records of the controllers: commands in force and staged, memory, gains and rates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import jax
import numpy as np
from jax import Array

from crazysim.control import AllocationParams, Control, Controller
from crazysim.control.protocol import controller_chain
from crazysim.core.airframes import Airframes, as_airframes, create_per_drone, max_n_rotors
from crazysim.dynamics import Dynamics
from crazysim.engine.pytree import PyTree, float_dtype, host_array, leaf, scopes, static
from crazysim.errors import ConfigError


class ControllerData(PyTree):
    """Memory and parameters of a controller, in the record of the command level that it follows."""

    memory: Any
    """Memory for every drone, in a record that the controller defines, or None."""
    params: Any
    """Gains and constants, in a record that the controller defines, or None."""
    freq: int = static()
    """Rate of the controller, Hz; an outer loop runs at the rate of the command."""

    @staticmethod
    def create(n_worlds: int, n_drones: int, controller: Controller, airframes: Airframes) -> ControllerData:
        """Return the record of a controller at rest, with the gains of each drone's airframe."""
        params = create_per_drone(airframes, controller.params, n_worlds)
        memory = create_per_drone(airframes, controller.memory, n_worlds)
        template = controller.memory(as_airframes(airframes)[0])
        for record, allowed_scopes in ((memory, ("drone",)), (params, ("shared", "drone"))):
            refused_scopes = set(jax.tree.leaves(scopes(record))) - set(allowed_scopes)
            if refused_scopes:
                raise ConfigError(
                    f"expected leaves of scope {' or '.join(allowed_scopes)} in {type(record).__name__} of controller "
                    f"{controller.name!r}, got {sorted(refused_scopes)}. Declare memory with leaf('drone', ...), and "
                    f"parameters with leaf('parameter', ...)."
                )

        counts = (n_worlds, n_drones)
        for x, scope in zip(jax.tree.leaves(params), jax.tree.leaves(scopes(params)), strict=True):
            if scope == "drone" and np.shape(x)[:2] != counts:
                raise ConfigError(
                    f"expected parameters of controller {controller.name!r} for all drones or for each, with the "
                    f"leading axes (n_worlds, n_drones) = {counts}, got shape {np.shape(x)}. Use np.broadcast_to."
                )

        def broadcast(x: np.ndarray, core_template: np.ndarray) -> np.ndarray:
            dtype = float_dtype() if np.issubdtype(np.asarray(x).dtype, np.floating) else np.asarray(x).dtype
            core = np.shape(x)[np.ndim(x) - np.ndim(core_template) :]  # x may have a row per drone, and more rotors
            return host_array(x, n_worlds, n_drones, *core, dtype=dtype)

        return ControllerData(jax.tree.map(broadcast, memory, template), params, controller.freq)


class _LevelData(PyTree):
    """Base class of the records of command levels that a controller follows.

    Its properties have Crazyflow's names and return fields of the controller's record, or None if it lacks them.
    """

    controller: ControllerData | None
    """Controller that follows the commands; None for attitude commands in fitted dynamics, which contain one."""

    @property
    def params(self) -> Any:
        """Gains and constants, a record."""
        return None if self.controller is None else self.controller.params

    @property
    def pos_err_i(self) -> Array | None:
        """Integral of the position error, m s. (n_worlds, n_drones, 3)"""
        return self._memory_field("pos_err_i")

    @property
    def ang_vel_des(self) -> Array | None:
        """Desired body rates in force, rad/s. (n_worlds, n_drones, 3)"""
        return self._memory_field("ang_vel_des")

    @property
    def r_int_error(self) -> Array | None:
        """Integral of the rotation error, rad s. (n_worlds, n_drones, 3)"""
        return self._memory_field("r_int_error")

    @property
    def prev_ang_vel(self) -> Array | None:
        """Angular velocity at the last tick, body frame, rad/s. (n_worlds, n_drones, 3)"""
        return self._memory_field("prev_ang_vel")

    def _memory_field(self, name: str) -> Array | None:
        return None if self.controller is None else getattr(self.controller.memory, name, None)

    def replace(self, **changes: Any) -> Self:
        if self.controller is not None and "params" in changes:
            controller = changes.get("controller", self.controller)
            changes["controller"] = controller.replace(params=changes.pop("params"))
        return super().replace(**changes)


class StateControlData(_LevelData):
    """State command, and the controller that follows it."""

    cmd: Array = leaf("drone", 1)
    """Setpoint in force: position, velocity, acceleration, quaternion, body rates. (n_worlds, n_drones, 16)"""
    staged_cmd: Array = leaf("drone", 1)
    """Setpoint that takes effect at the next tick. (n_worlds, n_drones, 16)"""
    freq: int = static()
    """Rate at which setpoints take effect, Hz."""
    feedforward: Array | None = leaf("drone", 1)
    """Jerk, m/s^3, snap, m/s^4, yaw rate, rad/s, and yaw acceleration, rad/s^2, of the setpoint in force; None if
    the controller accepts none, such as Crazyflow's. (n_worlds, n_drones, 8)"""
    staged_feedforward: Array | None = leaf("drone", 1)
    """Feedforward of the staged setpoint; see ``feedforward``. (n_worlds, n_drones, 8)"""


class AttitudeControlData(_LevelData):
    """Attitude command, and the controller that follows it."""

    cmd: Array = leaf("drone", 1)
    """Command in force: roll, pitch, yaw, rad, and collective thrust, N. (n_worlds, n_drones, 4)"""
    staged_cmd: Array = leaf("drone", 1)
    """Command that takes effect at the next tick. (n_worlds, n_drones, 4)"""
    freq: int = static()
    """Rate at which commands take effect, Hz."""
    staged_ang_vel_des: Array | None = leaf("drone", 1)
    """Desired body rates that take effect at the next tick, rad/s: from a state command, or zero. None with
    controllers other than Crazyflow's. (n_worlds, n_drones, 3)"""


class BodyRateControlData(_LevelData):
    """Body-rate command, and the controller that follows it."""

    cmd: Array = leaf("drone", 1)
    """Command in force: body rates, rad/s, and collective thrust, N. (n_worlds, n_drones, 4)"""
    staged_cmd: Array = leaf("drone", 1)
    """Command that takes effect at the next tick. (n_worlds, n_drones, 4)"""
    freq: int = static()
    """Rate at which commands take effect, Hz."""


class ForceTorqueControlData(PyTree):
    """Command of thrust and torque, and the allocation, which converts it to rotor speeds."""

    cmd: Array = leaf("drone", 1)
    """Command in force: collective thrust, N, and body torque, N m. (n_worlds, n_drones, 4)"""
    staged_cmd: Array = leaf("drone", 1)
    """Command that takes effect at the next tick. (n_worlds, n_drones, 4)"""
    freq: int = static()
    """Rate of the allocation, Hz."""
    params: AllocationParams
    """Limits and constants."""


def check_same_controllers(controls: SimControls, reference: SimControls, name: str | None) -> None:
    """Check that controllers have records of the same structure as in a simulation, with memory of the same shapes.

    Args:
        reference: Commands and controllers of the simulation.
        name: Name of the simulation's controller.
    """
    records, expected_records = _controller_records(controls), _controller_records(reference)
    if records == expected_records:  # the same objects
        return
    if [_layout(controller) for controller in records] != [_layout(controller) for controller in expected_records]:
        expected_text, actual_text = (", then ".join(map(_describe_controller, x)) for x in (expected_records, records))
        raise ConfigError(
            f"expected data of controller {name!r} with {expected_text or 'no records'}, got "
            f"{actual_text or 'no records'}. Use data of this simulation, or of one with the same settings."
        )


def _controller_records(controls: SimControls) -> list[ControllerData]:
    levels = (controls.state, controls.attitude, controls.body_rate)
    return [level.controller for level in levels if level is not None and level.controller is not None]


def _layout(controller: ControllerData) -> tuple[object, list[tuple[int, ...]]]:
    return jax.tree.structure(controller), [np.shape(x) for x in jax.tree.leaves(controller.memory)]


def _describe_controller(controller: ControllerData) -> str:
    shapes = [np.shape(x) for x in jax.tree.leaves(controller.memory)]
    memory, params = _type_name(controller.memory), _type_name(controller.params)
    return f"memory {memory} of shapes {shapes}, parameters {params} and freq={controller.freq}"


def _type_name(record: object) -> str:
    name, members = type(record).__name__, getattr(record, "controllers", ())
    return f"{name}({', '.join(map(_type_name, members))})" if members else name


class SimControls(PyTree):
    """Commands of a simulation, and the controllers that follow them; levels not in use are None."""

    mode: Control = static()
    """Command level."""
    state: StateControlData | None
    """State commands."""
    attitude: AttitudeControlData | None
    """Attitude commands of the simulation, or of the controller that follows state commands."""
    body_rate: BodyRateControlData | None
    """Body-rate commands."""
    force_torque: ForceTorqueControlData | None
    """Commands of thrust and torque, of the user or of a controller."""
    rotor_vel: Array | None = leaf("drone", 1)
    """Commanded rotor speeds, rpm; None in fitted dynamics. (n_worlds, n_drones, n_rotors)"""

    @property
    def controller(self) -> Any:
        """Record of the controller that follows the simulation's commands, ``ControllerData``; None if none does."""
        return getattr(getattr(self, self.mode.value), "controller", None)

    def replace(self, **changes: Any) -> Self:
        if "controller" in changes:
            level = changes.get(self.mode.value, getattr(self, self.mode.value))
            changes[self.mode.value] = level.replace(controller=changes.pop("controller"))
        return super().replace(**changes)

    @staticmethod
    def create(
        n_worlds: int,
        n_drones: int,
        control: Control,
        dynamics: Dynamics,
        airframes: Airframes,
        freqs: Mapping[Control, int],
        controller: Controller | None,
    ) -> SimControls:
        """Return the records of controllers at rest, with the gains of each drone's airframe.

        Args:
            airframes: Airframe of all drones, or of each.
            freqs: Rates at which commands of each level take effect, Hz.
            controller: Controller of the command level; None if commands need none.
        """
        shape = (n_worlds, n_drones)
        check_command_level(dynamics, control)
        check_controller(dynamics, control, controller)
        chain, last_level = controller_chain(controller, control)
        controller_by_level = dict(chain)
        controller_data = {level: ControllerData.create(*shape, x, airframes) for level, x in chain}

        def zeros(n: int) -> Any:
            return host_array(0.0, *shape, n)

        state = attitude = body_rate = force_torque = rotor_vel = None
        if control == Control.state:
            cmd = host_array(np.eye(16)[12], *shape, 16)  # zeros, with the identity quaternion
            has_feedforward = controller_by_level[control].follows_feedforward
            # A copy, because two leaves that share a buffer cannot both be donated.
            state = StateControlData(
                controller_data[control],
                cmd,
                cmd.copy(),
                freqs[Control.state],
                feedforward=zeros(8) if has_feedforward else None,
                staged_feedforward=zeros(8) if has_feedforward else None,
            )
        if Control.attitude in (*controller_by_level, last_level):
            level_controller = controller_by_level.get(Control.attitude)
            attitude = AttitudeControlData(
                controller_data.get(Control.attitude),
                zeros(4),
                zeros(4),
                freqs[Control.attitude],
                staged_ang_vel_des=zeros(3)
                if level_controller is not None and level_controller.follows_rates
                else None,
            )
        if control == Control.body_rate:
            body_rate = BodyRateControlData(controller_data[control], zeros(4), zeros(4), freqs[control])
        if dynamics == Dynamics.first_principles:
            rotor_vel = zeros(max_n_rotors(airframes))
        if last_level == Control.force_torque:
            params = create_per_drone(airframes, AllocationParams.create, n_worlds)
            force_torque = ForceTorqueControlData(zeros(4), zeros(4), freqs[Control.force_torque], params)
        return SimControls(control, state, attitude, body_rate, force_torque, rotor_vel)


def check_command_level(dynamics: Dynamics, control: Control) -> None:
    if dynamics != Dynamics.first_principles and control not in (Control.state, Control.attitude):
        raise ConfigError(
            f"control {control.value!r} needs rotors, which dynamics {dynamics.value!r} does not have. Use "
            f"dynamics='first_principles', or control 'state' or 'attitude'."
        )


def check_controller(dynamics: Dynamics, control: Control, controller: Controller | None) -> None:
    """Check that controllers accept their command levels, and the dynamics the output of the last controller."""
    chain, last_level = controller_chain(controller, control)
    for level, level_controller in chain:
        for member in level_controller.members:
            if level not in member.levels:
                raise ConfigError(
                    f"expected a command level that controller {member.name!r} follows, {' or '.join(member.levels)}, "
                    f"got control={level.value!r}. Use another level, or controller='auto', which follows all."
                )
    name = chain[-1][1].name if chain else None
    if dynamics != Dynamics.first_principles and last_level != Control.attitude:
        raise ConfigError(
            f"expected dynamics with rotors for controller {name!r}, got {dynamics.value!r}, which contains "
            f"a controller of its own. Use dynamics='first_principles' or controller='auto'."
        )
    if dynamics == Dynamics.first_principles and last_level not in (Control.force_torque, Control.rotor_vel):
        raise ConfigError(
            f"expected a controller that commands rotors for dynamics {dynamics.value!r}, got {name!r} with "
            f"output {last_level.value!r}. Use output = Control.force_torque."
        )
