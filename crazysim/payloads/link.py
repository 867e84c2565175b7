"""Physics of a link, a rod or a cable, between a rigid body and a point mass.

The link is a constraint, so the accelerations of body and mass follow from one system of equations. With the unit
vector q from the attachment p to the mass, the tension T per mass (the *specific tension* t = T / m_tip) obeys

    t (1 + m_tip q.A q) = q.(a_tip - a_p) + |w|^2 / L + impulses

where a_tip and a_p are the accelerations of mass and attachment without the link, w is the velocity of the mass relative
to the attachment, and ``A`` maps a force at the attachment to its acceleration. Nothing divides by m_tip: at zero the
body is free, and the mass still swings.

A hinge about the body's y axis keeps the mass in the body's x-z plane. That is a second constraint along the body's y
axis, whose force acts on the body as if the rod were part of it, and so turns it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimState, SimStateDeriv
from crazysim.rotation import cross, dot, matvec

TINY = 1e-12
"""Summand of denominators that vanish where both mass and damping are zero, kg."""
SLOW = 0.1
"""Speed below which a cable that becomes taut does not bounce, m/s."""
PULL = 0.1
"""Fraction of an error in length that one step of a scheme of higher order removes."""
BAND = 1e-4
"""Relative slack up to which a cable counts as taut in schemes of higher order: 0.04 mm of 0.4 m."""


class Link(NamedTuple):
    """Parameters of a link."""

    attach: Array
    """Attachment on the body, from its centre of mass, body frame, m. (3,)"""
    length: Array
    """Length, m. (1,)"""
    mass: Array
    """Mass at the tip, kg. (1,)"""
    damping: Array
    """Viscous torque of the joint over the angular velocity, N m s. (1,)"""
    restitution: Array
    """Ratio of radial speeds after and before a cable becomes taut, 1. (1,)"""
    holds: Array | bool = True
    """True where the link is connected. ()"""
    is_cable: bool = False
    """True for a cable, which can be slack; False for a rod."""
    is_hinge: bool = False
    """True if the link turns about the body's y axis only."""


class Relative(NamedTuple):
    """Geometry of a link at an instant, world frame unless noted."""

    rot: Array
    """Attitude of the body. (3, 3)"""
    arm: Array
    """Attachment from the centre of mass, m. (3,)"""
    offset: Array
    """Tip from the attachment, m. (3,)"""
    distance: Array
    """Length of the offset, m. (1,)"""
    direction: Array
    """Unit vector along the offset; down where the offset is zero. (3,)"""
    vel: Array
    """Velocity of the tip relative to the attachment, m/s. (3,)"""


def relative(s: SimState, pos: Array, vel: Array, attach: Array) -> Relative:
    """Return the geometry of the link from a body to a tip."""
    rot = rotation.matrix(s.quat)
    arm = matvec(rot, attach)
    offset = pos - s.pos - arm
    distance = rotation.safe_norm(offset)
    is_zero = distance == 0
    direction = jnp.where(is_zero, jnp.asarray([0.0, 0.0, -1.0], pos.dtype), offset / jnp.where(is_zero, 1.0, distance))
    return Relative(rot, arm, offset, distance, direction, vel - s.vel - matvec(rot, cross(s.ang_vel, attach)))


class Linked(NamedTuple):
    """Result of ``couple``."""

    deriv: SimStateDeriv
    """Derivative of the body under the reaction of the link."""
    rate: Array
    """Rate of the tip's position, m/s. (3,)"""
    acc: Array
    """Acceleration of the tip, m/s^2. (3,)"""
    tension: Array
    """Tension of the link, N; negative where a rod pushes. (1,)"""


def couple(
    s: SimState, deriv: SimStateDeriv, mass: Array, J_inv: Array, link: Link, pos: Array, vel: Array, free_acc: Array,
    dt: float | None, freq: int,
) -> Linked:  # fmt: skip
    """Return the derivative of a body and a tip that a link joins.

    Schemes of order 1 get the mean over a step. Then the impulse that ends all relative motion along the link is part
    of the tension: of a rod in every step, of a cable where it would be longer than ``length`` at the end of the step.
    The change of the constraint's direction counts half: the other half follows as an impulse in the next step, which
    makes the swing time-reversible (the kicks of RATTLE, Andersen 1983, at both ends of the step). The tip moves with
    its new velocity, relative to the attachment. Errors in length are removed from positions only.

    Args:
        s: State of the body. Leaves (k,)
        deriv: Derivative of the free body.
        mass: Mass of the body, kg. (1,)
        J_inv: Inverse of its inertia, 1/(kg m^2). (3, 3)
        link: Parameters.
        pos: Position of the tip, world frame, m. (3,)
        vel: Velocity of the tip, world frame, m/s. (3,)
        free_acc: Acceleration of the tip without the link, world frame, m/s^2. (3,)
        dt: Duration of the step, s; None for the derivative at an instant.
        freq: Steps per second, Hz.
    """
    r = relative(s, pos, vel, link.attach)
    q, w, h = r.direction, r.vel, 1 / freq
    m = jnp.where(link.holds, link.mass, 0.0) if link.holds is not True else link.mass
    share = 1.0 if dt is None else 0.5

    # Joint damping, implicit in time, so that it cannot reverse a motion.
    ang_vel = matvec(r.rot, s.ang_vel)
    turning = cross(ang_vel, r.offset)
    swing = w - turning
    stiff = link.damping / (link.length * link.length)
    damped = -stiff / (link.mass + h * stiff + TINY) * (swing - dot(q, swing) * q)
    tip = free_acc + damped

    def body_arm(point: Array, direction: Array) -> tuple[Array, Array]:
        """Return the angular acceleration of the body per force along a direction, and the moment arm."""
        lever = cross(point, direction)
        return matvec(J_inv, lever), lever

    attach_acc = deriv.acc + matvec(r.rot, cross(deriv.ang_acc, link.attach))
    centripetal = matvec(r.rot, cross(s.ang_vel, cross(s.ang_vel, link.attach)))
    along_b = rotation.matvec(jnp.swapaxes(r.rot, -1, -2), q)
    turn_1, lever_1 = body_arm(link.attach, along_b)
    rel_acc = tip - attach_acc
    m_11 = 1 + m * (1 / mass + dot(turn_1, lever_1))
    out = dot(q, w)
    rhs = dot(q, rel_acc) + share * ((dot(w, w) - out * out) / link.length - dot(q, centripetal))

    if link.is_hinge:
        y = r.rot[..., :, 1]
        tip_b = link.attach + rotation.matvec(jnp.swapaxes(r.rot, -1, -2), r.offset)
        y_b = jnp.asarray([0.0, 1.0, 0.0], q.dtype)
        turn_2, lever_2 = body_arm(tip_b, y_b)
        m_22 = 1 + m * (1 / mass + dot(turn_2, lever_2))
        m_12 = dot(q, y) + m * (dot(q, y) / mass + dot(turn_1, lever_2))
        spin = cross(ang_vel, turning) - 2 * cross(ang_vel, w) - centripetal
        rhs_2 = dot(y, rel_acc - cross(matvec(r.rot, deriv.ang_acc), r.offset)) + share * dot(y, spin)
        aside = dot(y, swing)
        rhs_2 = rhs_2 + (aside / dt if dt is not None else 2 * PULL * freq * aside)
    if dt is not None:
        wanted = jnp.zeros_like(out)
        if link.is_cable:
            gap = jnp.maximum(link.length - r.distance, 0.0) / dt
            bounces = (link.restitution > 0) & (out > SLOW)
            stretched = jnp.maximum(r.distance - link.length, 0.0)
            fallen = 2 * stretched * jnp.maximum(dot(q, rel_acc), 0.0)
            back = link.restitution * rotation.safe_sqrt(out * out - fallen)
            wanted = jnp.where(bounces, -back, gap)
            # The bounce begins where the cable would be taut at the end of the step.
            reaches = out + dt * dot(q, rel_acc) > gap
            wanted = jnp.where(bounces & ~reaches, gap, wanted)
        rhs = rhs + (out - wanted) / dt
    elif link.is_cable:
        rhs = jnp.where(r.distance > (1 - BAND) * link.length, rhs + 2 * PULL * freq * out, 0.0)
    else:
        rhs = rhs + 2 * PULL * freq * out
    if link.is_hinge:
        det = m_11 * m_22 - m_12 * m_12
        t_1, t_2 = (m_22 * rhs - m_12 * rhs_2) / det, (m_11 * rhs_2 - m_12 * rhs) / det
    else:
        t_1 = rhs / m_11
    if link.is_cable:
        t_1 = jnp.maximum(t_1, 0.0)

    pull = t_1 * q
    force = m * (pull - damped)
    torque = m * t_1 * lever_1
    lever_d = matvec(jnp.swapaxes(r.rot, -1, -2), cross(r.arm + r.offset, damped))
    torque = torque - m * lever_d
    if link.is_hinge:
        pull = pull + t_2 * y
        force = force + m * t_2 * y
        torque = torque + m * t_2 * lever_2
    acc, ang_acc = force / mass, matvec(J_inv, torque)
    held = pull - damped if link.holds is True else jnp.where(link.holds, pull - damped, 0.0)
    tip_acc = free_acc - held

    stretch = r.distance - link.length
    if link.is_cable:
        stretch = jnp.where(stretch > -BAND * link.length, stretch, 0.0) if dt is None else jnp.maximum(stretch, 0.0)
    error = stretch * q
    if link.is_hinge:
        error = error + dot(y, r.offset) * y
    if dt is None:
        rate = vel - PULL * freq * error
        new = deriv.replace(acc=deriv.acc + acc, ang_acc=deriv.ang_acc + ang_acc)
    else:
        # ``deriv.vel`` moves the body; the tip moves with its new velocity relative to that.
        moved = deriv.vel - s.vel + matvec(r.rot, cross(deriv.ang_vel - s.ang_vel, link.attach))
        rate = vel + dt * (tip_acc - attach_acc) + moved - error / dt
        new = deriv.replace(
            acc=deriv.acc + acc,
            ang_acc=deriv.ang_acc + ang_acc,
            vel=deriv.vel + dt * acc,
            ang_vel=deriv.ang_vel + dt * ang_acc,
        )
    if link.holds is not True:
        loose = vel if dt is None else vel + dt * free_acc
        rate = jnp.where(link.holds, rate, loose)
    return Linked(new, rate, tip_acc, m * t_1)


def end_relative_motion(
    s: SimState, mass: Array, J_inv: Array, link: Link, pos: Array, vel: Array
) -> tuple[SimState, Array]:
    """Return the body and the tip's velocity after the impulse that ends relative motion along the link.

    Of a cable only if it is taut and the tip moves outwards; above ``SLOW`` it bounces by the restitution. Momentum is
    kept, and energy is not gained.

    Args:
        s: State of the body. Leaves (k,)
        mass: Mass of the body, kg. (1,)
        J_inv: Inverse of its inertia, 1/(kg m^2). (3, 3)
        link: Parameters.
        pos: Position of the tip, world frame, m. (3,)
        vel: Velocity of the tip, world frame, m/s. (3,)
    """
    r = relative(s, pos, vel, link.attach)
    q, out = r.direction, dot(r.direction, r.vel)
    lever = cross(link.attach, matvec(jnp.swapaxes(r.rot, -1, -2), q))
    turn = matvec(J_inv, lever)
    share = 1 / (1 + link.mass * (1 / mass + dot(turn, lever)))
    change = out
    if link.is_cable:
        taut = (r.distance > (1 - BAND) * link.length) & (out > 0)
        change = jnp.where(taut, jnp.where(out > SLOW, 1 + link.restitution, 1.0) * out, 0.0)
    change = jnp.where(link.holds, change * share, 0.0)
    body = s.replace(vel=s.vel + link.mass / mass * change * q, ang_vel=s.ang_vel + link.mass * change * turn)
    return body, vel - change * q
