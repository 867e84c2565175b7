"""Records of the controllers: commands in force and staged, memory, gains and rates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import Array

from crazysim.control import AllocationParams, AttitudeParams, Control, Controller, StateParams
from crazysim.control import attitude as attitude_control
from crazysim.control import state as state_control
from crazysim.control.controllers import CASCADE
from crazysim.control.gains import require_gains
from crazysim.core.airframes import Airframes, as_airframes, for_drones, n_rotors_of
from crazysim.drones import Airframe
from crazysim.dynamics import Dynamics
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, floating, host_array, leaf, scopes, static


class StateControlData(PyTree):
    """Command and internal state of the state controller."""

    cmd: Array = leaf("drone", 1)
    """Setpoint in force: position, velocity, acceleration, quaternion, body rates. (n_worlds, n_drones, 16)"""
    staged_cmd: Array = leaf("drone", 1)
    """Setpoint that takes effect at the next tick. (n_worlds, n_drones, 16)"""
    freq: int = static()
    """Rate of the controller, Hz."""
    pos_err_i: Array | None = leaf("drone", 1)
    """Integral of the position error, m s; None with another controller. (n_worlds, n_drones, 3)"""
    params: StateParams | None
    """Gains and constants; None with another controller."""
    feedforward: Array | None = leaf("drone", 1)
    """Jerk, m/s^3, snap, m/s^4, yaw rate, rad/s, and yaw acceleration, rad/s^2, of the setpoint in force; None in
    Crazyflow's cascade. (n_worlds, n_drones, 8)"""
    staged_feedforward: Array | None = leaf("drone", 1)
    """The same of the staged setpoint; None in Crazyflow's cascade. (n_worlds, n_drones, 8)"""


class AttitudeControlData(PyTree):
    """Command and internal state of the attitude controller."""

    cmd: Array = leaf("drone", 1)
    """Command in force: roll, pitch, yaw, rad, and collective thrust, N. (n_worlds, n_drones, 4)"""
    staged_cmd: Array = leaf("drone", 1)
    """Command that takes effect at the next tick. (n_worlds, n_drones, 4)"""
    freq: int = static()
    """Rate of the controller, Hz."""
    ang_vel_des: Array | None = leaf("drone", 1)
    """Desired body rates in force, rad/s; None in fitted dynamics and with another controller.
    (n_worlds, n_drones, 3)"""
    staged_ang_vel_des: Array | None = leaf("drone", 1)
    """Desired body rates that take effect at the next tick, rad/s; None likewise. (n_worlds, n_drones, 3)"""
    r_int_error: Array | None = leaf("drone", 1)
    """Integral of the rotation error, rad s; None likewise. (n_worlds, n_drones, 3)"""
    prev_ang_vel: Array | None = leaf("drone", 1)
    """Angular velocity at the previous tick, rad/s; None likewise. (n_worlds, n_drones, 3)"""
    params: Any
    """Gains and constants, ``AttitudeParams``; None in fitted dynamics, which contain the controller, and with another
    controller."""


class BodyRateControlData(PyTree):
    """Command and internal state of the body-rate controller."""

    cmd: Array = leaf("drone", 1)
    """Command in force: body rates, rad/s, and collective thrust, N. (n_worlds, n_drones, 4)"""
    staged_cmd: Array = leaf("drone", 1)
    """Command that takes effect at the next tick. (n_worlds, n_drones, 4)"""
    freq: int = static()
    """Rate of the controller, Hz."""
    r_int_error: Array | None = leaf("drone", 1)
    """Integral of the rotation error, rad s; None with another controller. (n_worlds, n_drones, 3)"""
    prev_ang_vel: Array | None = leaf("drone", 1)
    """Angular velocity at the previous tick, rad/s; None with another controller. (n_worlds, n_drones, 3)"""
    params: AttitudeParams | None
    """Gains and constants; None with another controller."""


class ForceTorqueControlData(PyTree):
    """Command of the allocation."""

    cmd: Array = leaf("drone", 1)
    """Command in force: collective thrust, N, and body torque, N m. (n_worlds, n_drones, 4)"""
    staged_cmd: Array = leaf("drone", 1)
    """Command that takes effect at the next tick. (n_worlds, n_drones, 4)"""
    freq: int = static()
    """Rate of the allocation, Hz."""
    params: AllocationParams
    """Limits and constants."""


class ControllerData(PyTree):
    """Memory and parameters of the controller that ``Sim(controller=...)`` names."""

    memory: Any
    """Memory of the drones, a record of the controller's own, or None."""
    params: Any
    """Gains and constants, a record of the controller's own, or None."""
    freq: int = static()
    """Rate of the controller, Hz; an outer loop has that of the command."""

    @staticmethod
    def create(n_worlds: int, n_drones: int, controller: Controller, airframes: Airframes) -> ControllerData:
        """Return a controller at rest, with the gains of each drone's airframe.

        Raises:
            ConfigError: If an airframe lacks a number, or a record has leaves of another scope or of other counts.
        """
        params = for_drones(airframes, controller.params, n_worlds)
        memory, one = for_drones(airframes, controller.memory, n_worlds), controller.memory(as_airframes(airframes)[0])
        for record, kinds in ((memory, ("drone",)), (params, ("shared", "drone"))):
            others = set(jax.tree.leaves(scopes(record))) - set(kinds)
            if others:
                raise ConfigError(
                    f"expected leaves of scope {' or '.join(kinds)} in {type(record).__name__} of controller "
                    f"{controller.name!r}, got {sorted(others)}. Declare memory with leaf('drone', ...), and "
                    f"parameters with leaf('parameter', ...)."
                )

        counts = (n_worlds, n_drones)
        for x, scope in zip(jax.tree.leaves(params), jax.tree.leaves(scopes(params)), strict=True):
            if scope == "drone" and np.shape(x)[:2] != counts:
                raise ConfigError(
                    f"expected parameters of controller {controller.name!r} for all drones or for each, with the "
                    f"leading axes (n_worlds, n_drones) = {counts}, got shape {np.shape(x)}. Use np.broadcast_to."
                )

        def of_all(x: np.ndarray, like: np.ndarray) -> np.ndarray:
            dtype = floating() if np.issubdtype(np.asarray(x).dtype, np.floating) else np.asarray(x).dtype
            core = np.shape(x)[np.ndim(x) - np.ndim(like) :]  # it may have rows of drones, and more rotors
            return host_array(x, n_worlds, n_drones, *core, dtype=dtype)

        return ControllerData(jax.tree.map(of_all, memory, one), params, controller.freq)


def controller_layout(controller: ControllerData | None) -> tuple[object, list[tuple[int, ...]]]:
    """Return what the data of two simulations with the same controller have in common."""
    memory = None if controller is None else controller.memory
    return jax.tree.structure(controller), [np.shape(x) for x in jax.tree.leaves(memory)]


def described_controller(controller: ControllerData | None) -> str:
    """Return the records of a controller for a message."""
    if controller is None:
        return "no records"
    shapes = [np.shape(x) for x in jax.tree.leaves(controller.memory)]
    memory, params = _kind(controller.memory), _kind(controller.params)
    return f"memory {memory} of shapes {shapes}, parameters {params} and freq={controller.freq}"


def _kind(record: object) -> str:
    """Return the name of a record's type, with those of several controllers in it."""
    name, members = type(record).__name__, getattr(record, "controllers", ())
    return f"{name}({', '.join(map(_kind, members))})" if members else name


class SimControls(PyTree):
    """Controllers of a simulation; those not in use are None."""

    mode: Control = static()
    """Command level."""
    state: StateControlData | None
    """State controller."""
    attitude: AttitudeControlData | None
    """Attitude controller."""
    body_rate: BodyRateControlData | None
    """Body-rate controller."""
    force_torque: ForceTorqueControlData | None
    """Allocation."""
    rotor_vel: Array | None = leaf("drone", 1)
    """Commanded rotor speeds, rpm; None in fitted dynamics. (n_worlds, n_drones, n_rotors)"""
    controller: ControllerData | None = None
    """Controller in place of Crazyflow's cascade; None with the cascade."""

    @staticmethod
    def create(
        n_worlds: int,
        n_drones: int,
        control: Control,
        dynamics: Dynamics,
        airframes: Airframes,
        freqs: dict[Control, int],
        controller: Controller | None = None,
    ) -> SimControls:
        """Return controllers at rest, with the gains of each drone's airframe; ``controller`` None is the cascade.

        Raises:
            ConfigError: If the dynamics do not support the command level.
        """
        shape = (n_worlds, n_drones)
        with_rotors = dynamics == Dynamics.first_principles
        require_pair(dynamics, control)
        require_controller(dynamics, control, controller)

        def zeros(n: int) -> Any:
            return host_array(0.0, *shape, n)

        def gains(create: Callable[[Airframe], Any]) -> Any:
            return for_drones(airframes, create, n_worlds)

        cascade = with_rotors and controller is None

        if controller is None:
            for airframe in as_airframes(airframes):
                require_gains(airframe, _gains_of_cascade(control, with_rotors), CASCADE)

        state = attitude = body_rate = force_torque = rotor_vel = None
        if control == Control.state:
            cmd = host_array(np.eye(16)[12], *shape, 16)
            # A copy, because two leaves that share a buffer cannot both be donated.
            state = StateControlData(
                cmd,
                cmd.copy(),
                freqs[Control.state],
                pos_err_i=zeros(3) if controller is None else None,
                params=gains(StateParams.create) if controller is None else None,
                feedforward=None if controller is None else zeros(8),
                staged_feedforward=None if controller is None else zeros(8),
            )
        commands_attitude = controller is None or controller.output == Control.attitude
        if control == Control.attitude or (control == Control.state and commands_attitude):
            attitude = AttitudeControlData(
                cmd=zeros(4),
                staged_cmd=zeros(4),
                freq=freqs[Control.attitude],
                ang_vel_des=zeros(3) if cascade else None,
                staged_ang_vel_des=zeros(3) if cascade else None,
                r_int_error=zeros(3) if cascade else None,
                prev_ang_vel=zeros(3) if cascade else None,
                params=gains(AttitudeParams.create) if cascade else None,
            )
        if control == Control.body_rate:
            body_rate = BodyRateControlData(
                zeros(4),
                zeros(4),
                freqs[control],
                r_int_error=zeros(3) if cascade else None,
                prev_ang_vel=zeros(3) if cascade else None,
                params=gains(AttitudeParams.create) if cascade else None,
            )
        if with_rotors:
            rotor_vel = zeros(n_rotors_of(airframes))
        if with_rotors and Control.rotor_vel not in (control, controller and controller.output):
            params = gains(AllocationParams.create)
            force_torque = ForceTorqueControlData(zeros(4), zeros(4), freqs[Control.force_torque], params)
        data = None if controller is None else ControllerData.create(*shape, controller, airframes)
        return SimControls(control, state, attitude, body_rate, force_torque, rotor_vel, data)


def _gains_of_cascade(control: Control, with_rotors: bool) -> tuple[str, ...]:
    """Return the values of an airframe that Crazyflow's cascade needs at a level and at those below it."""
    rotates = with_rotors and control in (Control.state, Control.attitude, Control.body_rate)
    return (state_control.KEYS if control == Control.state else ()) + (attitude_control.KEYS if rotates else ())


def require_pair(dynamics: Dynamics, control: Control) -> None:
    """Check that a dynamics model supports a command level.

    Raises:
        ConfigError: If it does not.
    """
    if dynamics != Dynamics.first_principles and control not in (Control.state, Control.attitude):
        raise ConfigError(
            f"control {control.value!r} needs rotors, which dynamics {dynamics.value!r} does not have. Use "
            f"dynamics='first_principles', or control 'state' or 'attitude'."
        )


def require_controller(dynamics: Dynamics, control: Control, controller: Controller | None) -> None:
    """Check that a controller follows a command level and has rotors to command; None is Crazyflow's cascade.

    Raises:
        ConfigError: If it does not.
    """
    if controller is None:
        return
    for member in controller.members:
        if control not in member.levels:
            raise ConfigError(
                f"expected a command level that controller {member.name!r} follows, {' or '.join(member.levels)}, got "
                f"control={control.value!r}. Use another level, or controller='crazyflow', which follows all."
            )
    if dynamics != Dynamics.first_principles and controller.output != Control.attitude:
        raise ConfigError(
            f"expected dynamics with rotors for controller {controller.name!r}, got {dynamics.value!r}, which contains "
            f"a controller of its own. Use dynamics='first_principles' or controller='auto'."
        )
    if dynamics == Dynamics.first_principles and controller.output == Control.attitude:
        raise ConfigError(
            f"expected a controller that commands rotors for dynamics {dynamics.value!r}, got {controller.name!r} with "
            f"output 'attitude'. Use output = Control.force_torque."
        )
