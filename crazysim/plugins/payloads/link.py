"""Physics of a link, a rod or a cable, between a rigid body and a point mass.

The link is a constraint, so the accelerations of body and mass follow from one system of equations. With the unit
vector q from the attachment p to the mass, the tension T per mass (the *specific tension* t = T / m_tip) obeys

    t (1 + m_tip q.A q) = q.(a_tip - a_p) + |w|^2 / L + impulses

where a_tip and a_p are the accelerations of mass and attachment without the link, w is the velocity of the mass across
the link, relative to the attachment, and A maps a force at the attachment to its acceleration. Nothing divides by
m_tip: with m_tip = 0 the body moves freely, and the mass still swings.

A hinge about the body's y axis keeps the mass in the body's x-z plane. That is a second constraint, along the body's y
axis. Its force acts on the body as if the rod were part of the body, and so turns the body.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from crazysim import rotation
from crazysim.core.data import SimState, SimStateDeriv
from crazysim.rotation import add_cross, cross, dot, matvec

MIN_MASS = 1e-12
"""Term added to denominators that vanish where both mass and damping are zero, kg."""
MIN_SQUARED_LENGTH = 1e-20
"""Term added to the squared distance, m^2, so that the direction of a link without length is zero."""
BOUNCE_SPEED = 0.1
"""Speed below which a cable that becomes taut does not bounce, m/s."""
CORRECTION_RATE, MAX_CORRECTION_FRACTION = 50.0, 0.5
"""Rate at which a scheme of higher order removes errors in length, 1/s, and the largest fraction of an error that a
step removes. The order of the scheme requires a rate that does not depend on the step."""
SLACK_ACCELERATION = 1e9
"""Acceleration that no tension of a slack cable outweighs, m/s^2."""
TAUT_BAND = 1e-4
"""Relative slack up to which a cable is treated as taut: 0.04 mm of 0.4 m."""


class LinkParams(NamedTuple):
    """Parameters of a link."""

    attach: Array | None
    """Attachment point relative to the body's centre of mass, body frame, m; None for the centre of mass. (3,)"""
    length: Array
    """Length, m. (1,)"""
    mass: Array
    """Mass at the tip, kg. (1,)"""
    damping: Array | None = None
    """Viscous torque of the joint per angular velocity, N m s; None without damping. (1,)"""
    restitution: Array | None = None
    """Ratio of radial speeds after and before a cable becomes taut, 1; None for no bounce. (1,)"""
    is_attached: Array | None = None
    """Whether the link is connected; None if it always is. ()"""
    is_cable: bool = False
    """True for a cable, which can be slack; False for a rod."""
    is_hinge: bool = False
    """Whether the link turns about the body's y axis only."""


class LinkGeometry(NamedTuple):
    """Geometry of a link at an instant, world frame unless noted."""

    rot: Array
    """Attitude of the body. (3, 3)"""
    arm: Array | None
    """Attachment point relative to the centre of mass, m; None for zero. (3,)"""
    offset: Array
    """Position of the tip relative to the attachment point, m. (3,)"""
    distance: Array
    """Length of the offset, m. (1,)"""
    direction: Array
    """Unit vector along the offset; zero where the offset is zero. (3,)"""
    vel: Array
    """Velocity of the tip relative to the attachment, m/s. (3,)"""


def link_geometry(state: SimState, pos: Array, vel: Array, attach: Array | None) -> LinkGeometry:
    """Return the geometry of the link from a body to a tip at ``pos`` with the velocity ``vel``, world frame."""
    rot, arm = rotation.matrix(state.quat), None
    offset, rel_vel = pos - state.pos, vel - state.vel
    if attach is not None:
        arm = matvec(rot, attach)
        offset, rel_vel = offset - arm, matvec(rot, -cross(state.ang_vel, attach), rel_vel)
    squared_distance = dot(offset, offset)
    inverse_distance = lax.rsqrt(squared_distance + MIN_SQUARED_LENGTH)
    return LinkGeometry(rot, arm, offset, squared_distance * inverse_distance, offset * inverse_distance, rel_vel)


class LinkedMotion(NamedTuple):
    """Result of ``couple_bodies``."""

    deriv: SimStateDeriv
    """Derivative of the body under the reaction of the link."""
    pos_rate: Array
    """Rate of the position of the tip, m/s: its velocity and the correction of its distance. (3,)"""
    acc: Array
    """Acceleration of the tip, m/s^2. (3,)"""


class UnitPull(NamedTuple):
    """A unit force on the tip along a direction, and the opposite force on the body."""

    direction: Array
    """Direction, world frame. (3,)"""
    lever: Array | None
    """Torque on the body per unit force, body frame, m; None without torque. (3,)"""
    ang_acc: Array | None
    """Angular acceleration of the body per unit force, body frame, 1/(kg m); None without torque. (3,)"""

    @staticmethod
    def create(direction: Array, rot: Array, J_inv: Array, point: Array | None) -> UnitPull:
        """Return the pull at a point relative to the body's centre of mass, body frame, m; None for the centre."""
        if point is None:
            return UnitPull(direction, None, None)
        lever = cross(point, to_body_frame(rot, direction))
        return UnitPull(direction, lever, matvec(J_inv, lever))

    def response(self, other: UnitPull, mass: Array) -> Array:
        """Return the acceleration of the body where this pull acts, along its direction, due to another pull. (1,)"""
        linear_response = dot(self.direction, other.direction) / mass
        if self.lever is None or other.ang_acc is None:
            return linear_response
        return linear_response + dot(self.lever, other.ang_acc)


def couple_bodies(
    state: SimState, deriv: SimStateDeriv, mass: Array, J_inv: Array, link: LinkParams, pos: Array, vel: Array,
    free_acc: Array, dt: float | None, freq: int,
) -> LinkedMotion:  # fmt: skip
    """Return the derivative of a body and a tip that a link joins.

    For schemes of order 1 the result is the mean over a step. The tension then includes the impulse that ends all
    relative motion along the link: for a rod in every step, for a cable if it would be longer than ``length`` at the
    end of the step. It includes half the effect of the constraint's change of direction. The other half follows as an
    impulse in the next step, which makes the swing time-reversible (the two kicks of RATTLE, Andersen 1983). The tip
    moves with its new velocity, relative to the attachment. Errors in length are removed from positions only.

    Args:
        state: State of the body. Leaves (k,)
        deriv: Derivative of the free body.
        mass: Mass of the body, kg. (1,)
        J_inv: Inverse of the body's inertia, 1/(kg m^2). (3, 3)
        pos: Position of the tip, world frame, m. (3,)
        vel: Velocity of the tip, world frame, m/s. (3,)
        free_acc: Acceleration of the tip without the link, world frame, m/s^2. (3,)
        dt: Duration of the step, s; None for the derivative at an instant.
        freq: Steps per second, Hz.
    """
    geometry, m = link_geometry(state, pos, vel, link.attach), link.mass
    radial_speed = dot(geometry.direction, geometry.vel)
    attach_acc = acceleration_at(state, deriv, geometry.rot, link.attach, 1.0 if dt is None else 0.5)
    rel_acc = free_acc - attach_acc

    link_pull = UnitPull.create(geometry.direction, geometry.rot, J_inv, link.attach)
    # This is ``m * link_pull.response(link_pull, mass)``, where the product of the equal directions is 1.
    link_ratio = m / mass
    if link_pull.lever is not None and link_pull.ang_acc is not None:
        link_ratio = m / mass + m * dot(link_pull.lever, link_pull.ang_acc)
    # Tension along the link, without the hinge.
    swing_square = dot(geometry.vel, geometry.vel) - radial_speed * radial_speed
    rhs = dot(geometry.direction, rel_acc) + (1.0 if dt is None else 0.5) / link.length * swing_square
    rhs = rhs + _radial_term(geometry, radial_speed, rhs, link, dt, freq)
    pulls = [link_pull]
    if link.is_hinge:
        hinge_pull, hinge_rhs = _hinge_pull(state, deriv, geometry, rel_acc, J_inv, link, dt, freq)
        cross_ratio = dot(link_pull.direction, hinge_pull.direction) + m * link_pull.response(hinge_pull, mass)
        hinge_ratio = m * hinge_pull.response(hinge_pull, mass)
        inverse_determinant = 1 / ((1 + link_ratio) * (1 + hinge_ratio) - cross_ratio * cross_ratio)
        tension = ((1 + hinge_ratio) * rhs - cross_ratio * hinge_rhs) * inverse_determinant
        hinge_tension = ((1 + link_ratio) * hinge_rhs - cross_ratio * rhs) * inverse_determinant
        tensions, pulls = [tension, hinge_tension], [link_pull, hinge_pull]
    else:
        tension = rhs * (1 / (1 + link_ratio))
        tensions = [jnp.maximum(tension, 0.0) if link.is_cable else tension]
    if link.is_attached is not None:
        tensions = [jnp.where(link.is_attached, t, 0.0) for t in tensions]
    # Damping of the swing.
    damping = None
    if link.damping is not None:  # damping acts against the swing across the link
        damping_rate, swing = _damping_rate(link, dt, freq), _swing_velocities(state, geometry)[1]
        damping = damping_rate * swing
        tensions[0] = tensions[0] - damping_rate * radial_speed
    parts = [t * p.direction for t, p in zip(tensions, pulls, strict=True)]
    pull = sum(parts[1:], parts[0])
    # Products of constants come first: they are computed once, and multiply-adds remain.
    mass_ratio, new_deriv = m / mass, deriv
    if damping is not None:
        pull = pull + damping
        # A force on the tip turns the body as if the tip were part of the body: along the link the lever is the same.
        torque = to_body_frame(geometry.rot, cross(pos - state.pos, pull))
        new_deriv = _add_torque(deriv, m * J_inv, torque, dt)
    elif any(p.ang_acc is not None for p in pulls):
        angular_terms = [m * t * p.ang_acc for t, p in zip(tensions, pulls, strict=True) if p.ang_acc is not None]
        new_deriv = _add_torque(deriv, None, sum(angular_terms[1:], angular_terms[0]), dt)
    # Accelerations of tip and body.
    tip_acc = free_acc - pull
    new_deriv = new_deriv.replace(acc=deriv.acc + mass_ratio * pull)
    new_deriv = new_deriv if dt is None else new_deriv.replace(vel=deriv.vel + dt * mass_ratio * pull)
    pos_rate = _tip_pos_rate(state, deriv, geometry, link, vel, tip_acc, attach_acc, dt, freq)
    return LinkedMotion(new_deriv, pos_rate, tip_acc)


def _add_torque(deriv: SimStateDeriv, factor: Array | None, torque: Array, dt: float | None) -> SimStateDeriv:
    if factor is None:
        result = deriv.replace(ang_acc=deriv.ang_acc + torque)
        return result if dt is None else result.replace(ang_vel=deriv.ang_vel + dt * torque)
    result = deriv.replace(ang_acc=matvec(factor, torque, deriv.ang_acc))
    return result if dt is None else result.replace(ang_vel=matvec(dt * factor, torque, deriv.ang_vel))


def to_body_frame(rot: Array, vector: Array) -> Array:
    """Return a world vector in the frame of a body. (3,)"""
    return matvec(jnp.swapaxes(rot, -1, -2), vector)


def acceleration_at(
    state: SimState, deriv: SimStateDeriv, rot: Array, point: Array | None, centripetal_factor: float
) -> Array:
    """Return the acceleration of a point of the body, with a fraction of its centripetal part, m/s^2. (3,)"""
    if point is None:
        return deriv.acc
    centripetal = cross(state.ang_vel, centripetal_factor * cross(state.ang_vel, point))
    return matvec(rot, add_cross(centripetal, deriv.ang_acc, point), deriv.acc)


def _swing_velocities(state: SimState, geometry: LinkGeometry) -> tuple[Array, Array]:
    ang_vel = matvec(geometry.rot, state.ang_vel)
    return ang_vel, add_cross(geometry.vel, geometry.offset, ang_vel)


def correction_rate(freq: int) -> float:
    """Return the rate at which a scheme of higher order removes errors in length, 1/s."""
    return min(CORRECTION_RATE, MAX_CORRECTION_FRACTION * freq)


def drag_rate(coefficient: Array, mass: Array, dt: float | None, freq: int) -> Array:
    """Return the deceleration by a linear drag divided by the speed, 1/s, which cannot reverse a motion in a step. (1,)

    In a step of a scheme of order 1 the drag is implicit in time. In the derivative at an instant, the rate is exact up
    to one per step, and limited to this value.

    Args:
        coefficient: Drag per speed, N s/m. (1,)
        mass: Mass, kg. (1,)
        dt: Duration of the step, s; None for the derivative at an instant.
        freq: Steps per second, Hz.
    """
    effective_mass = jnp.maximum(mass, coefficient / freq) if dt is None else mass + coefficient / freq
    return coefficient / (effective_mass + MIN_MASS)


def _damping_rate(link: LinkParams, dt: float | None, freq: int) -> Array:
    rate = drag_rate(link.damping / (link.length * link.length), link.mass, dt, freq)  # type: ignore[operator]
    return rate if link.is_attached is None else jnp.where(link.is_attached, rate, 0.0)


def _radial_term(
    geometry: LinkGeometry, radial_speed: Array, radial_acc: Array, link: LinkParams, dt: float | None, freq: int
) -> Array:
    if dt is None:
        if not link.is_cable:
            return 2 * correction_rate(freq) * radial_speed
        # A faster tip gets the impulse of ``end_relative_motion`` before the next step.
        is_taut = (geometry.distance > (1 - TAUT_BAND) * link.length) & (radial_speed < BOUNCE_SPEED)
        return jnp.where(is_taut, 2 * correction_rate(freq) * radial_speed, -SLACK_ACCELERATION)
    if not link.is_cable:
        return freq * radial_speed
    # Within the band a cable is taut, and smooth in its parameters like a rod.
    slack = link.length - geometry.distance
    gap = jnp.where(slack > TAUT_BAND * link.length, freq * slack, 0.0)
    if link.restitution is None:
        return freq * (radial_speed - gap)
    # The tip bounces in the step at whose end the cable would be taut, with its speed when the cable became taut.
    overshoot = jnp.maximum(geometry.distance - link.length, 0.0)
    rebound_speed = link.restitution * rotation.safe_sqrt(
        radial_speed * radial_speed - 2 * overshoot * jnp.maximum(radial_acc, 0.0)
    )
    is_bouncing = (link.restitution > 0) & (radial_speed > BOUNCE_SPEED) & (radial_speed + dt * radial_acc > gap)
    return freq * (radial_speed - jnp.where(is_bouncing, -rebound_speed, gap))


def _hinge_pull(
    state: SimState, deriv: SimStateDeriv, geometry: LinkGeometry, rel_acc: Array, J_inv: Array, link: LinkParams,
    dt: float | None, freq: int,
) -> tuple[UnitPull, Array]:  # fmt: skip
    y = geometry.rot[..., 1]
    ang_vel, swing = _swing_velocities(state, geometry)
    offset = to_body_frame(geometry.rot, geometry.offset)
    pull = UnitPull.create(y, geometry.rot, J_inv, offset if link.attach is None else offset + link.attach)
    turning_acc = matvec(geometry.rot, cross(deriv.ang_acc, offset))
    coriolis = cross(ang_vel, cross(ang_vel, geometry.offset) - 2 * geometry.vel)
    hinge_speed = dot(y, swing)
    correction = freq * hinge_speed if dt is not None else 2 * correction_rate(freq) * hinge_speed
    return pull, dot(y, rel_acc - turning_acc + (1.0 if dt is None else 0.5) * coriolis) + correction


def _tip_pos_rate(
    state: SimState, deriv: SimStateDeriv, geometry: LinkGeometry, link: LinkParams, vel: Array, tip_acc: Array,
    attach_acc: Array, dt: float | None, freq: int,
) -> Array:  # fmt: skip
    is_attached, stretch = link.is_attached, geometry.distance - link.length
    if link.is_cable:
        stretch = jnp.where(stretch > -TAUT_BAND * link.length, stretch, 0.0)
    correction = freq if dt is not None else correction_rate(freq)
    correction = correction if is_attached is None else jnp.where(is_attached, correction, 0.0)
    # The integrator has the same expression, so the compiler computes it once.
    pos_rate = vel if dt is None else vel + dt * tip_acc
    pos_rate = pos_rate - correction * stretch * geometry.direction
    if link.is_hinge:
        pos_rate = pos_rate - correction * dot(geometry.rot[..., 1], geometry.offset) * geometry.rot[..., 1]
    if dt is None:
        return pos_rate
    # The scheme moves the body with ``deriv.vel``, and the tip with the new velocity of the tip relative to the body.
    attach_motion = attach_acc
    if deriv.vel is not state.vel:  # it is the new velocity of the body
        attach_motion = attach_motion - deriv.acc
        if link.attach is not None:
            attach_motion = attach_motion - matvec(geometry.rot, cross(deriv.ang_acc, link.attach))
    return pos_rate - (dt if is_attached is None else jnp.where(is_attached, dt, 0.0)) * attach_motion


def end_relative_motion(
    state: SimState, mass: Array, J_inv: Array, link: LinkParams, pos: Array, vel: Array
) -> tuple[SimState, Array]:
    """Return the body and the tip's velocity after the impulse that ends relative motion along the link.

    A cable exerts this impulse only if it is taut and the tip moves outwards. Above ``BOUNCE_SPEED`` the tip bounces
    with the restitution of the link. Momentum is conserved, and no energy is gained.

    Args:
        state: State of the body. Leaves (k,)
        mass: Mass of the body, kg. (1,)
        J_inv: Inverse of the body's inertia, 1/(kg m^2). (3, 3)
        pos: Position of the tip, world frame, m. (3,)
        vel: Velocity of the tip, world frame, m/s. (3,)
    """
    geometry = link_geometry(state, pos, vel, link.attach)
    radial_speed = dot(geometry.direction, geometry.vel)
    pull = UnitPull.create(geometry.direction, geometry.rot, J_inv, link.attach)
    speed_change = radial_speed / (1 + link.mass * pull.response(pull, mass))
    if link.is_cable:
        bounce_factor = 1.0 if link.restitution is None else 1 + link.restitution
        is_taut = (geometry.distance > (1 - TAUT_BAND) * link.length) & (radial_speed > 0)
        speed_change = jnp.where(
            is_taut, jnp.where(radial_speed > BOUNCE_SPEED, bounce_factor, 1.0) * speed_change, 0.0
        )
    speed_change = speed_change if link.is_attached is None else jnp.where(link.is_attached, speed_change, 0.0)
    state = state.replace(vel=state.vel + link.mass / mass * speed_change * pull.direction)
    if pull.ang_acc is not None:
        state = state.replace(ang_vel=state.ang_vel + link.mass * speed_change * pull.ang_acc)
    return state, vel - speed_change * pull.direction
