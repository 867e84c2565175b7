"""Linear quadratic regulator of a drone with a load on a rod, about hover, for setpoints of load or drone."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.control.flatness import attitude_of_thrust, thrust_direction
from crazysim.control.levels import Control
from crazysim.control.priority import prioritized_wrench
from crazysim.control.protocol import Controller, DroneData
from crazysim.control.rigid_body_params import RigidBodyParams
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics.models import GRAVITY
from crazysim.engine.pytree import PyTree, leaf
from crazysim.errors import expect, require
from crazysim.lab.control.linear_models import linearize, load_derivative, rod_angles
from crazysim.lab.control.lqr import Reference, lqr_weights, solve_on_host, state_error, to_heading_frame
from crazysim.lab.control.riccati import gain_discrete
from crazysim.rotation import cross, dot, matvec

SetpointBody = Literal["load", "drone"]
"""Body that a setpoint describes."""

ROD_JERK_MAX = 500.0
"""Largest third derivative of the direction of the rod that is fed forward, 1/s^3. A swing with an amplitude of 0.5 rad
and an angular frequency of 10 rad/s reaches it."""


class LoadLQRParams(RigidBodyParams):
    """Gain and parameters of the LQR with load, each shared or one per drone."""

    load_mass: Array = leaf("parameter", 1, (1,))
    """Mass of the load that the controller assumes, kg. (1,)"""
    length: Array = leaf("parameter", 1, (1,))
    """Length of the rod that the controller assumes, m. (1,)"""
    gain: Array = leaf("parameter", 2, (4, 16))
    """Gain K from the errors of position, velocity, rotation, body rates, rod angles and their rates to the wrench.
    (4, 16)"""
    attach: Array | None = leaf("parameter", 1, (3,))
    """Position of the rod's joint relative to the centre of mass, body frame, m; None for zero. (3,)"""


def load_gain(
    mass: Array,
    J: Array,
    load_mass: Array,
    length: Array,
    dt: Array,
    Q: Array,
    R: Array,
    attach: Array | None = None,
) -> Array:
    """Return the gain of the discrete LQR about hover with a load, or NaN if there is none; pure and differentiable.

    The model is ``load_derivative``, discretised by ``A_d = I + dt A``, ``B_d = dt B``.

    Args:
        mass: Mass of the drone, kg. (1,)
        J: Inertia, body frame, kg m^2. (3, 3)
        load_mass: Mass of the load, kg. (1,)
        length: Length of the rod, m. (1,)
        dt: Period of the controller, s. ()
        Q: Weights of the states. (16, 16)
        R: Weights of collective thrust and torque. (4, 4)
        attach: Position of the rod's joint relative to the centre of mass, body frame, m; None for zero. (3,)

    Returns:
        Gain K of ``u = -K x``. (4, 16)
    """
    mass, load_mass = jnp.reshape(mass, (1,)), jnp.reshape(load_mass, (1,))
    gravity = jnp.asarray(GRAVITY, J.dtype)

    def model(x: Array, u: Array) -> Array:
        return load_derivative(x, u, mass, J, gravity, load_mass, jnp.reshape(length, (1,)), attach)

    torque = jnp.zeros(3, J.dtype) if attach is None else -cross(attach, load_mass * gravity)
    x, u = jnp.zeros(16, J.dtype), jnp.concatenate([-GRAVITY[2] * (mass + load_mass), torque])
    A, B = linearize(model, x, u)
    return gain_discrete(jnp.eye(16, dtype=J.dtype) + dt * A, dt * B, Q, R)


def load_reference(
    setpoint: Setpoint, params: LoadLQRParams, rod_jerk: Array | None = None
) -> tuple[Reference, Array, Array]:
    """Return the reference of a drone that carries a load along a setpoint, and the direction of the rod and its rate.

    The setpoint gives position r_L, acceleration a_L and jerk j_L of the load. The rod of length L pulls the load along
    its specific force, ``q = -(a_L - g) / |a_L - g|``, so that the drone is at ``r_L - L q``. The thrust is
    ``f = (m + m_L)(a_L - g) - m L q_tt``, plus the drag of a level drone. The body rates follow from
    ``f_t = (m + m_L) j_L - m L q_ttt``. Its last term needs the fifth derivative of the load's position, which a
    setpoint does not have: it is the argument ``rod_jerk``. A joint away from the centre of mass shifts the drone, and
    the load's pull then adds a torque. The acceleration of the joint relative to the centre of mass is neglected.

    Args:
        setpoint: Setpoint of the load.
        rod_jerk: Third derivative q_ttt of the direction, 1/s^3; None for zero. (..., 3)

    Returns:
        Reference of the drone; direction q of the rod from drone to load (..., 3); derivative of the direction, 1/s
        (..., 3).
    """
    p, sp = params, setpoint
    rod_up, rod_up_rate, rod_up_acc = thrust_direction(sp.acc - p.gravity_vec, sp.jerk, sp.snap)
    vel, total_mass = sp.vel + p.length * rod_up_rate, p.mass + p.load_mass
    force = total_mass * (sp.acc - p.gravity_vec) + p.mass * p.length * rod_up_acc - matvec(p.drag_matrix, vel)
    force_rate = total_mass * sp.jerk - (0.0 if rod_jerk is None else p.mass * p.length * rod_jerk)
    force_rate = force_rate - matvec(p.drag_matrix, sp.acc + p.length * rod_up_acc)
    reference = _reference(sp.pos + p.length * rod_up, vel, force, force_rate, sp, p)
    if p.attach is not None:
        arm, joint_vel = _joint_motion(reference.matrix, reference.ang_vel, p.attach)
        reference = reference._replace(pos=reference.pos - arm, vel=reference.vel - joint_vel)
    return reference, -rod_up, -rod_up_rate


def hanging_reference(setpoint: Setpoint, params: LoadLQRParams) -> tuple[Reference, Array, Array]:
    """Return the reference for a setpoint of the drone. The load hangs as it would if the acceleration were constant.

    Args:
        setpoint: Setpoint of the drone.

    Returns:
        The results of ``load_reference``.
    """
    p, sp = params, setpoint
    rod_up, rod_up_rate, _ = thrust_direction(sp.acc - p.gravity_vec, sp.jerk, sp.snap)
    total_mass = p.mass + p.load_mass
    force = total_mass * (sp.acc - p.gravity_vec) - matvec(p.drag_matrix, sp.vel)
    force_rate = total_mass * sp.jerk - matvec(p.drag_matrix, sp.acc)
    return _reference(sp.pos, sp.vel, force, force_rate, sp, p), -rod_up, -rod_up_rate


def _joint_motion(matrix: Array, ang_vel: Array, attach: Array) -> tuple[Array, Array]:
    attach = jnp.broadcast_to(attach, ang_vel.shape)
    return matvec(matrix, attach), matvec(matrix, cross(ang_vel, attach))


def _reference(
    pos: Array, vel: Array, force: Array, force_rate: Array, setpoint: Setpoint, p: LoadLQRParams
) -> Reference:
    # The torque compensates the pull at the joint of a load with the acceleration of the setpoint.
    total_mass = p.mass + p.load_mass
    attitude = attitude_of_thrust(
        force / total_mass, force_rate / total_mass, setpoint.snap, setpoint.yaw, setpoint.yaw_rate, setpoint.yaw_acc
    )
    torque = matvec(p.J, attitude.ang_acc) + cross(attitude.ang_vel, matvec(p.J, attitude.ang_vel))
    if p.attach is not None:
        pull = matvec(jnp.swapaxes(attitude.matrix, -1, -2), p.load_mass * (p.gravity_vec - setpoint.acc))
        torque = torque - cross(jnp.broadcast_to(p.attach, pull.shape), pull)
    wrench = jnp.concatenate([rotation.safe_norm(force), torque], axis=-1)
    return Reference(pos, vel, attitude.matrix, attitude.ang_vel, wrench)


def load_lqr_control(
    pos: Array,
    quat: Array,
    vel: Array,
    ang_vel: Array,
    direction: Array,
    direction_rate: Array,
    setpoint: Setpoint,
    *,
    params: LoadLQRParams,
    target: SetpointBody = "load",
    rod_jerk: Array | None = None,
) -> Array:
    """Track a setpoint with a load by the LQR, with the wrench of the setpoint's motion as feedforward.

    The law is ``u = u_ref - K e``. The errors e are the errors of ``lqr_control``, and the errors of the two angles of
    the rod and of their rates (``rod_angles``). The angles are in the frame of the desired heading.

    Args:
        pos: Position of the drone, world frame, m. (..., 3)
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity of the drone, world frame, m/s. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        direction: Unit vector from the joint of the rod to the load, world frame. (..., 3)
        direction_rate: Derivative of the direction, 1/s. (..., 3)
        setpoint: Setpoint with the leading axes of the state.
        params: Gain, shared or with the leading axes of the state.
        target: ``"load"`` if the setpoint is of the load, ``"drone"`` if it is of the drone.
        rod_jerk: As for ``load_reference``. (..., 3)

    Returns:
        Collective thrust, N, and body torque, N m, within the limits of the rotors. (..., 4)
    """
    p = params
    if target == "load":
        reference, rod, rod_rate = load_reference(setpoint, p, rod_jerk)
    else:
        reference, rod, rod_rate = hanging_reference(setpoint, p)
    vectors = [to_heading_frame(x, setpoint.yaw) for x in (direction, direction_rate, rod, rod_rate)]
    angles, rates = rod_angles(vectors[0], vectors[1])
    angles_ref, rates_ref = rod_angles(vectors[2], vectors[3])
    error = state_error(pos, quat, vel, ang_vel, reference, setpoint.yaw)
    error = jnp.concatenate([error, angles - angles_ref, rates - rates_ref], axis=-1)
    return prioritized_wrench(reference.wrench - matvec(p.gain, error), params=p.allocation)


class LoadLQRMemory(PyTree):
    """Memory of the LQR with load. The third derivative of the rod's direction is computed from it by a difference."""

    rod_acc: Array = leaf("drone", 1, (3,))
    """Second derivative of the direction of the rod at the last tick, 1/s^2. (n_worlds, n_drones, 3)"""
    started: Array = leaf("drone", 1, (1,))
    """One after the first tick, zero before. (n_worlds, n_drones, 1)"""


class LoadLQR(Controller, memory=LoadLQRMemory):
    """Linear quadratic regulator of a drone with a load (``load_lqr_control``) for setpoints of load or drone."""

    name: ClassVar[str] = "load_lqr"
    levels: ClassVar[tuple[Control, ...]] = (Control.state,)
    output: ClassVar[Control] = Control.force_torque
    freq: int = 500
    """Rate of the controller, Hz."""
    load_mass: float = 0.05
    """Mass of the load, kg."""
    length: float = 0.4
    """Length of the rod, m."""
    attach: ArrayLike = (0.0, 0.0, 0.0)
    """Position of the rod's joint relative to the centre of mass, body frame, m; ``attach`` of the load. (3,)"""
    target: SetpointBody = "load"
    """Body that setpoints describe."""
    load: str = "load"
    """Name of the plugin of the load. Its record has ``tip_pos`` and ``tip_vel`` (a hook), or ``pos`` and ``vel``."""
    Q: ArrayLike | None = None
    """Weights of position, velocity, roll, pitch, yaw, body rates, rod angles and their rates, (16,) or (16, 16); None
    for ``lqr_weights``."""
    R: ArrayLike | None = None
    """Weights of collective thrust and torque, (4,) or (4, 4); None for ``lqr_weights``."""

    def params(self, airframe: Airframe) -> LoadLQRParams:
        load_mass, length, joint = self.load_mass, self.length, np.asarray(self.attach)
        require(
            0 <= load_mass < np.inf and 0 < length < np.inf,
            f"expected load_mass of at least 0 kg and a positive length, m, got {load_mass!r} and {length!r}. Use "
            f"LoadLQR(load_mass=0.05, length=0.4).",
        )
        expect(
            joint.shape == (3,) and joint.dtype.kind in "iuf" and np.all(np.isfinite(joint)),
            "attach as three finite numbers, m",
            self.attach,
            "Use LoadLQR(attach=(0.0, 0.0, -0.02)).",
        )
        Q, R = lqr_weights(airframe, self.freq, self.Q, self.R, load_mass, length)
        body = (airframe.value("rigid_body.mass"), airframe.inertia)
        attach = joint if np.any(joint) else None
        joint_args = [] if attach is None else [attach]
        gain = solve_on_host(load_gain, *body, [load_mass], [length], 1 / self.freq, Q, R, *joint_args)
        return LoadLQRParams.create(airframe, load_mass=load_mass, length=length, gain=gain, attach=attach)

    def take_over(
        self, data: DroneData, command: Any, memory: LoadLQRMemory, params: LoadLQRParams, rotor_vel: Array
    ) -> LoadLQRMemory:
        # The derivative in the memory is older than the last tick.
        return memory.replace(started=jnp.zeros_like(memory.started))

    def update(
        self, data: DroneData, command: Any, memory: LoadLQRMemory, params: LoadLQRParams
    ) -> tuple[Array, LoadLQRMemory]:
        require(
            self.load in data.plugins,
            f"expected a load {self.load!r} for controller {self.name!r}, got plugins {list(data.plugins)}. Use "
            f"sim.add(SlungLoad(...)), or LoadLQR(load=...) with its name.",
        )
        s, load = data.states, data.plugins[self.load]
        # The rod of a hook swings even when the hook holds no load.
        tip_pos, tip_vel = (load.tip_pos, load.tip_vel) if hasattr(load, "tip_pos") else (load.pos, load.vel)
        offset, relative_vel = tip_pos - s.pos, tip_vel - s.vel
        if params.attach is not None:
            arm, joint_vel = _joint_motion(rotation.matrix(s.quat), s.ang_vel, params.attach)
            offset, relative_vel = offset - arm, relative_vel - joint_vel
        distance = jnp.maximum(rotation.safe_norm(offset), 1e-3)
        direction = offset / distance
        direction_rate = (relative_vel - dot(direction, relative_vel) * direction) / distance
        rod_acc = -thrust_direction(command.acc - params.gravity_vec, command.jerk, command.snap)[2]
        rod_jerk = memory.started * (rod_acc - memory.rod_acc) * self.freq
        wrench = load_lqr_control(
            *(s.pos, s.quat, s.vel, s.ang_vel, direction, direction_rate, command),
            params=params,
            target=self.target,
            rod_jerk=rotation.clip(rod_jerk, -ROD_JERK_MAX, ROD_JERK_MAX),
        )
        return wrench, memory.replace(rod_acc=rod_acc, started=jnp.ones_like(memory.started))
