"""Records of a simulation: states, controls, parameters, core and plugins."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import AllocationParams, AttitudeParams, Control, Controller, StateParams, command_size
from crazysim.drones import Airframe
from crazysim.dynamics import Dynamics, first_principles, fitted
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, floating, leaf, scopes, static

SimParams = first_principles.Params | fitted.Params


class SimState(PyTree):
    """Rigid-body and rotor state of every drone, and the external wrench on it."""

    pos: Array = leaf("drone", 1)
    """Position of the centre of mass, world frame, m. (n_worlds, n_drones, 3)"""
    quat: Array = leaf("drone", 1)
    """Attitude, body to world, unit, xyzw. (n_worlds, n_drones, 4)"""
    vel: Array = leaf("drone", 1)
    """Velocity of the centre of mass, world frame, m/s. (n_worlds, n_drones, 3)"""
    ang_vel: Array = leaf("drone", 1)
    """Angular velocity, body frame, rad/s. (n_worlds, n_drones, 3)"""
    force: Array = leaf("drone", 1)
    """External force on the centre of mass, world frame, N; kept until it is changed. (n_worlds, n_drones, 3)"""
    torque: Array = leaf("drone", 1)
    """External torque, world frame, N m; kept until it is changed. (n_worlds, n_drones, 3)"""
    rotor_vel: Array = leaf("drone", 1)
    """Rotor speeds, rpm; in ``so_rpy_rotor*`` the collective thrust, N. (n_worlds, n_drones, n_rotors)"""

    @staticmethod
    def create(n_worlds: int, n_drones: int, n_rotors: int = 4) -> SimState:
        """Return drones at rest on the floor, level, on a grid of 1 m around the origin of their world."""
        shape = (n_worlds, n_drones)
        grid = np.zeros((n_drones, 3))
        grid[:, :2] = grid_2d(n_drones)
        return SimState(
            pos=of_host(grid, *shape, 3),
            quat=of_host([0.0, 0.0, 0.0, 1.0], *shape, 4),
            vel=of_host(0.0, *shape, 3),
            ang_vel=of_host(0.0, *shape, 3),
            force=of_host(0.0, *shape, 3),
            torque=of_host(0.0, *shape, 3),
            rotor_vel=of_host(0.0, *shape, n_rotors),
        )


class SimStateDeriv(PyTree):
    """Time derivative of the state of every drone."""

    vel: Array = leaf("drone", 1)
    """Velocity, world frame, m/s. (n_worlds, n_drones, 3)"""
    ang_vel: Array = leaf("drone", 1)
    """Angular velocity, body frame, rad/s. (n_worlds, n_drones, 3)"""
    acc: Array = leaf("drone", 1)
    """Acceleration, world frame, m/s^2. (n_worlds, n_drones, 3)"""
    ang_acc: Array = leaf("drone", 1)
    """Angular acceleration, body frame, rad/s^2. (n_worlds, n_drones, 3)"""
    rotor_acc: Array = leaf("drone", 1)
    """Rotor acceleration, rpm/s; in ``so_rpy_rotor*`` the rate of thrust, N/s. (n_worlds, n_drones, n_rotors)"""
    plugins: dict[str, dict[str, Array]] = dataclasses.field(default_factory=dict)
    """Derivatives of plugins' own states, per second: by plugin, then by field of its record."""

    @staticmethod
    def create(n_worlds: int, n_drones: int, device: Any = None, n_rotors: int = 4) -> SimStateDeriv:
        """Return zeros.

        Args:
            n_worlds: Number of worlds.
            n_drones: Number of drones per world.
            device: Device of the arrays; None for arrays of the host.
            n_rotors: Number of rotors.
        """
        sizes = {"vel": 3, "ang_vel": 3, "acc": 3, "ang_acc": 3, "rotor_acc": n_rotors}
        zeros = {name: of_host(0.0, n_worlds, n_drones, size) for name, size in sizes.items()}
        return SimStateDeriv(**(zeros if device is None else jax.device_put(zeros, device)))


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
    def create(n_worlds: int, n_drones: int, controller: Controller, airframe: Airframe) -> ControllerData:
        """Return a controller at rest, with the airframe's gains.

        Raises:
            ConfigError: If the airframe lacks a number, or a record has leaves of another scope.
        """
        memory, params = controller.memory(airframe), controller.params(airframe)
        for record, kinds in ((memory, ("drone",)), (params, ("shared", "drone"))):
            others = set(jax.tree.leaves(scopes(record))) - set(kinds)
            if others:
                raise ConfigError(
                    f"expected leaves of scope {' or '.join(kinds)} in {type(record).__name__} of controller "
                    f"{controller.name!r}, got {sorted(others)}. Declare them with leaf(...)."
                )

        def of_all(x: Any) -> Any:
            dtype = floating() if np.issubdtype(np.asarray(x).dtype, np.floating) else np.asarray(x).dtype
            return of_host(x, n_worlds, n_drones, *np.shape(x), dtype=dtype)

        return ControllerData(jax.tree.map(of_all, memory), params, controller.freq)


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
        airframe: Airframe,
        freqs: dict[Control, int],
        controller: Controller | None = None,
    ) -> SimControls:
        """Return controllers at rest, with the airframe's gains; ``controller`` None is Crazyflow's cascade.

        Raises:
            ConfigError: If the dynamics do not support the command level.
        """
        shape = (n_worlds, n_drones)
        with_rotors = dynamics == Dynamics.first_principles
        require_pair(dynamics, control)
        require_controller(dynamics, control, controller)

        def zeros(n: int) -> Any:
            return of_host(0.0, *shape, n)

        cascade = with_rotors and controller is None

        state = attitude = body_rate = force_torque = rotor_vel = None
        if control == Control.state:
            cmd = of_host(np.eye(16)[12], *shape, 16)
            # A copy, because two leaves that share a buffer cannot both be donated.
            state = StateControlData(
                cmd,
                cmd.copy(),
                freqs[Control.state],
                pos_err_i=zeros(3) if controller is None else None,
                params=StateParams.create(airframe) if controller is None else None,
                feedforward=None if controller is None else zeros(8),
                staged_feedforward=None if controller is None else zeros(8),
            )
        if control == Control.attitude or (control == Control.state and controller is None):
            attitude = AttitudeControlData(
                cmd=zeros(4),
                staged_cmd=zeros(4),
                freq=freqs[Control.attitude],
                ang_vel_des=zeros(3) if cascade else None,
                staged_ang_vel_des=zeros(3) if cascade else None,
                r_int_error=zeros(3) if cascade else None,
                prev_ang_vel=zeros(3) if cascade else None,
                params=AttitudeParams.create(airframe) if cascade else None,
            )
        if control == Control.body_rate:
            body_rate = BodyRateControlData(
                zeros(4),
                zeros(4),
                freqs[control],
                r_int_error=zeros(3) if cascade else None,
                prev_ang_vel=zeros(3) if cascade else None,
                params=AttitudeParams.create(airframe) if cascade else None,
            )
        if with_rotors:
            rotor_vel = zeros(airframe.n_rotors)
        if with_rotors and Control.rotor_vel not in (control, controller and controller.output):
            params = AllocationParams.create(airframe)
            force_torque = ForceTorqueControlData(zeros(4), zeros(4), freqs[Control.force_torque], params)
        data = None if controller is None else ControllerData.create(*shape, controller, airframe)
        return SimControls(control, state, attitude, body_rate, force_torque, rotor_vel, data)


class SimCore(PyTree):
    """Time, sizes, seed and flags."""

    freq: int = static()
    """Rate of physics steps, Hz."""
    steps: Array = leaf("world")
    """Number of physics steps since the last reset of the world. (n_worlds, 1)"""
    episode: Array = leaf("world")
    """Number of resets of the world; enters its random numbers. (n_worlds, 1)"""
    nonfinite: Array = leaf("world")
    """True where the world has become non-finite since its last reset. (n_worlds, 1)"""
    n_worlds: int = static()
    """Number of worlds."""
    n_drones: int = static()
    """Number of drones per world."""
    world_id: Array = leaf("world")
    """Index of the world; enters its random numbers. (n_worlds, 1)"""
    drone_id: Array = leaf("drone")
    """Index of the drone in its world; enters its random numbers. (n_worlds, n_drones)"""
    drone_mocap_ids: Array = leaf("shared", 1)
    """MuJoCo mocap ids of the bodies of the drones. (n_drones,)"""
    rng_key: Array = leaf("shared", 0)
    """Random key of the seed; a reset does not change it. ()"""
    mjx_synced: Array = leaf("shared", 0)
    """True where the scene matches this data. ()"""

    @staticmethod
    def create(freq: int, n_worlds: int, n_drones: int, drone_mocap_ids: Any, rng_key: int | Array) -> SimCore:
        """Return the core of a simulation before its first step."""
        return SimCore(
            freq=freq,
            steps=of_host(0, n_worlds, 1, dtype=np.int32),
            episode=of_host(0, n_worlds, 1, dtype=np.int32),
            nonfinite=of_host(False, n_worlds, 1, dtype=bool),
            n_worlds=n_worlds,
            n_drones=n_drones,
            world_id=of_host(np.arange(n_worlds)[:, None], n_worlds, 1, dtype=np.int32),
            drone_id=of_host(np.arange(n_drones), n_worlds, n_drones, dtype=np.int32),
            drone_mocap_ids=of_host(drone_mocap_ids, n_drones, dtype=np.int32),
            rng_key=as_key(rng_key),
            mjx_synced=of_host(False, dtype=bool),
        )


class Objects(PyTree):
    """Poses of the movable objects of the scene in every world; ``sim.scene.add`` creates them."""

    pos: Array = leaf("world", 2)
    """Positions of the frames of the objects, world frame, m. (n_worlds, 1, n_objects, 3)"""
    quat: Array = leaf("world", 2)
    """Attitudes, body to world, unit, xyzw. (n_worlds, 1, n_objects, 4)"""
    vel: Array = leaf("world", 2)
    """Velocities that contact response uses, world frame, m/s; they do not move the objects.
    (n_worlds, 1, n_objects, 3)"""
    mocap_ids: Array = leaf("shared", 1)
    """MuJoCo mocap ids of the bodies of the objects. (n_objects,)"""
    names: tuple[str, ...] = static()
    """Names of the bodies of the objects."""


class SimData(PyTree):
    """Complete data of a simulation, which a step takes and returns."""

    states: SimState
    """Rigid-body and rotor state of the drones."""
    controls: SimControls
    """Commands, internal states and gains of the controllers."""
    params: Any
    """Physical parameters of the drones; ``SimParams`` of the dynamics model."""
    core: SimCore
    """Time, sizes, seed and flags."""
    plugins: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Records of plugins and of user stages, by name. Records (``PyTree``) declare the scopes of their leaves and are
    reset per world; bare arrays are opaque, and only full resets restore them."""
    objects: Objects | None = None
    """Movable objects of the scene; None if there are none."""

    @staticmethod
    def create(
        n_worlds: int,
        n_drones: int,
        dynamics: Dynamics,
        control: Control,
        airframe: Airframe,
        freq: int,
        freqs: dict[Control, int],
        drone_mocap_ids: Any,
        rng_key: int | Array,
        controller: Controller | None = None,
    ) -> SimData:
        """Return data of drones at rest, without plugins.

        ``freqs`` are the rates of the controllers, Hz; ``controller`` None is Crazyflow's cascade.
        """
        return SimData(
            states=SimState.create(n_worlds, n_drones, n_rotor_states(dynamics, airframe)),
            controls=SimControls.create(n_worlds, n_drones, control, dynamics, airframe, freqs, controller),
            params=create_params(dynamics, airframe),
            core=SimCore.create(freq, n_worlds, n_drones, drone_mocap_ids, rng_key),
        )


def of_host(value: Any, *shape: int, dtype: Any = None) -> Any:
    """Return a value broadcast to a shape as a NumPy array, which needs no compilation."""
    return np.array(np.broadcast_to(value, shape), dtype or floating())


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
    if dynamics != Dynamics.first_principles:
        raise ConfigError(
            f"expected dynamics with rotors for controller {controller.name!r}, got {dynamics.value!r}, which contains "
            f"a controller of its own. Use dynamics='first_principles'."
        )


def create_params(dynamics: Dynamics, airframe: Airframe) -> SimParams:
    """Return the shared parameters of an airframe for a dynamics model.

    Raises:
        ConfigError: If the airframe has no parameters for the model.
    """
    if dynamics == Dynamics.first_principles:
        return first_principles.Params.create(airframe)
    return fitted.Params.create(airframe, dynamics)


def n_rotor_states(dynamics: Dynamics, airframe: Airframe) -> int:
    """Return the length of ``states.rotor_vel``: one per rotor, or four for a fitted model, as in Crazyflow."""
    return airframe.n_rotors if dynamics == Dynamics.first_principles else 4


def command_shape(data: SimData, control: Control) -> tuple[int, int, int]:
    """Return the shape of a command to all drones, (n_worlds, n_drones, k)."""
    n_worlds, n_drones, n_rotors = data.states.rotor_vel.shape
    return n_worlds, n_drones, command_size(control, n_rotors)


def as_key(seed: int | Array) -> Array:
    """Return the typed random key of a seed; a key is returned unchanged.

    Raises:
        ConfigError: If it is neither an integer nor a key.
    """
    dtype = getattr(seed, "dtype", np.dtype(int) if type(seed) is int else None)
    is_key = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    is_integer = dtype is not None and jnp.issubdtype(dtype, jnp.integer)
    if np.shape(seed) != () or not (is_key or is_integer):
        raise ConfigError(f"expected an integer or one key as seed, got {seed!r}; use an integer or jax.random.key(0)")
    try:
        return seed if is_key else jax.random.key(seed)  # type: ignore[return-value]
    except OverflowError as error:
        raise ConfigError(f"the seed {seed} needs more than 64 bits; use a smaller integer") from error


def grid_2d(n: int, spacing: float = 1.0, center: Any = (0.0, 0.0)) -> np.ndarray:
    """Return the ``n`` points of a square grid nearest to its centre, nearest first, m. (n, 2)"""
    side = math.isqrt(n - 1) + 1
    line = spacing * (np.arange(side) - (side - 1) / 2)
    x, y = np.meshgrid(line, line)
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    return points[np.argsort(np.linalg.norm(points, axis=-1), kind="stable")[:n]] + np.asarray(center)
