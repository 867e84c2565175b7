"""Contact response: floor and objects push, brake and bounce drones. Without it the floor only stops them.

Time stepping on velocities (Moreau 1988; the convex form of Todorov 2014): after a step, impulses at the contact points
change the velocity into one that no longer approaches. An overlap is pushed out with a time constant, so that the
ground is soft and no drone is thrown out of it. The points are those of ``contact_points``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData, SimState
from crazysim.core.plugin import Placement, Plugin, Simulation, parameter
from crazysim.core.stage import Stage
from crazysim.deprecation import warn_renamed
from crazysim.errors import ConfigError
from crazysim.geometry.linear import solve
from crazysim.pytree import PyTree, leaf
from crazysim.scene.contact_points import Surface, contact_points, surfaces_of
from crazysim.scene.report import Objects

SLOW = 0.1
"""Approach speed below which nothing bounces, m/s: five steps of free fall at 500 Hz."""
STIFFNESS = 300.0
"""Penalty on the speed into a surface, in masses: costs a third of a percent of a bounce, solvable in float32."""
STICKING = 1e-4
"""Slip speed treated as zero, m/s."""
FASTEST_PUSH = 0.25
"""Largest speed at which an overlap is pushed out, m/s."""


class ContactResponseData(PyTree):
    """Parameters of the surfaces, and the last impulse on each drone."""

    friction: Array = leaf("parameter", 1, (1,))
    """Coulomb's coefficient between drone and surface. (1,)"""
    restitution: Array = leaf("parameter", 1, (1,))
    """Ratio of the speeds after and before a bounce. (1,)"""
    softness: Array = leaf("parameter", 1, (1,))
    """Time constant with which an overlap is pushed out, s. (1,)"""
    impulse: Array = leaf("drone", 1)
    """Impulse of all surfaces in the last step, world frame, N s. (n_worlds, n_drones, 3)"""


class ContactResponse(Plugin):
    """Response of floor and objects to contacts with drones; replaces the stage ``clip_floor_pos``.

    Drones do not push each other, and objects do not move. A drone that stands on the floor has its centre half its
    collision box above it.
    """

    objects: Objects = None
    """Handles, or names of bodies; None for all at the time of adding, () for the floor alone."""
    friction: float = parameter(default=0.6)
    """Coulomb's coefficient."""
    restitution: float = parameter(default=0.2)
    """Ratio of the speeds after and before a bounce, 0 to 1."""
    softness: float = parameter(default=0.03)
    """Time constant with which an overlap is pushed out, s; at least two steps."""
    iterations: int = 8
    """Iterations of the solver, for simultaneous contact points."""
    name: str = "contact_response"

    def record(self, sim: Simulation) -> ContactResponseData:
        """Return the parameters, and no impulse."""
        for name, most in (("friction", np.inf), ("restitution", 1), ("softness", 10)):
            if not 0 <= getattr(self, name) <= most:
                raise ConfigError(f"expected {name} to be from 0 to {most}, got {getattr(self, name)}")
        dt = 1 / sim.data.core.freq
        if self.softness < 2 * dt:
            raise ConfigError(f"expected softness to be two steps at least, {2 * dt:.4g} s, got {self.softness} s")
        ones = jnp.ones(1)
        return ContactResponseData(
            friction=self.friction * ones,
            restitution=self.restitution * ones,
            softness=self.softness * ones,
            impulse=jnp.zeros((sim.n_worlds, sim.n_drones, 3)),
        )

    def stages(self, sim: Simulation) -> Sequence[Placement]:
        """Return the stage that applies the impulses."""
        box = np.asarray(sim.airframe.value("shape.collision_box"), np.float64)
        surfaces = surfaces_of(sim, self.objects)

        def respond(data: SimData) -> SimData:
            states, record = _respond(data, self.read(data), surfaces, box, self.iterations)
            return self.write(data.replace(states=states), record)

        return [Placement(Stage(respond, "drone"), before="increment_steps", replaces="clip_floor_pos")]


def add_contact_response(
    sim: Simulation,
    objects: Objects = None,
    friction: float = 0.6,
    restitution: float = 0.2,
    softness: float = 0.03,
    iterations: int = 8,
) -> None:
    """Add the contact response. Deprecated: use ``sim.add(ContactResponse(...))``."""
    warn_renamed("scene.response.add_contact_response(sim, ...)", "sim.add(ContactResponse(...))")
    sim.add(ContactResponse(objects, friction, restitution, softness, iterations))


def _respond(
    data: SimData, record: ContactResponseData, surfaces: list[Surface], box: np.ndarray, iterations: int
) -> tuple[SimState, ContactResponseData]:
    """Return the states with the velocity after contact, and the record with the impulse.

    First compression: the velocity u = (vel, ang_vel) that minimises the kinetic energy of the change, plus a stiff
    penalty on the speed into a surface and on slip; the penalty on slip grows no faster than the friction force allows
    (iteratively reweighted least squares). Every iteration solves one linear system of six unknowns. Then restitution:
    a share of the normal impulses again (Poisson). Energy that friction and bounces at several points would create
    (Kane 1984), or points that push against each other, is removed.
    """
    states, params = data.states, data.params
    points = contact_points(data, surfaces, box)
    n, p, s = points.normal, points.point, points.vel
    active = points.gap < 0
    before = jnp.concatenate([rotation.rotate_inverse(states.quat, states.vel), states.ang_vel], axis=-1)
    inertia = _inertia(params.mass, params.J)
    stiff = STIFFNESS * params.mass
    row = jnp.concatenate([n, rotation.cross(p, n)], axis=-1)
    along = jnp.sum(n * s, axis=-1)

    def slip(u: Array) -> tuple[Array, Array]:
        """Return the speed of each point out of its surface, and its slip speed, m/s."""
        vel = u[..., None, :3] + rotation.cross(u[..., None, 3:], p) - s
        out = jnp.sum(vel * n, axis=-1)
        return out, rotation.safe_norm(vel - out[..., None] * n)[..., 0]

    fast = active & (-slip(before)[0] > SLOW)
    wanted = jnp.where(fast, 0.0, jnp.minimum(-points.gap / record.softness, FASTEST_PUSH))

    def turn(k: Any, u: Array) -> Array:
        out, aside = slip(u)
        pressed = active & (out < wanted)
        push = jnp.where(pressed, stiff * (wanted - out), 0.0)
        w_n = jnp.where(pressed, stiff, 0.0)
        # The first push stops the whole fall at every point: the friction force is known from the second on.
        w_t = jnp.where(k == 0, 0.0, jnp.minimum(w_n, record.friction * push / (aside + STICKING)))
        rest = w_n - w_t
        steep = jnp.sum(rest[..., None, None] * row[..., None] * row[..., None, :], axis=-3)
        matrix = inertia + _tangential(w_t, p) + steep
        held = w_t[..., None] * jnp.concatenate([s, rotation.cross(p, s)], axis=-1)
        driven = (rest * along + w_n * wanted)[..., None] * row
        return solve(matrix, rotation.matvec(inertia, before) + jnp.sum(held + driven, axis=-2))

    after = jax.lax.fori_loop(0, iterations, turn, before)
    push = jnp.where(active, stiff * jnp.maximum(wanted - slip(after)[0], 0.0), 0.0)
    after = after + record.restitution * solve(inertia, jnp.sum(jnp.where(fast, push, 0.0)[..., None] * row, axis=-2))
    # Energy is measured relative to the surfaces that push.
    total = jnp.sum(push, axis=-1, keepdims=True)
    moves = jnp.sum(push[..., None] * s, axis=-2) / jnp.where(total > 0, total, 1.0)
    seen = jnp.concatenate([moves, jnp.zeros_like(moves)], axis=-1)
    had, has = (rotation.dot(u - seen, rotation.matvec(inertia, u - seen)) for u in (before, after))
    most = had + params.mass * FASTEST_PUSH**2
    after = jnp.where(
        has > most, seen + (after - seen) * rotation.safe_sqrt(most / jnp.where(has > 0, has, 1.0)), after
    )
    after = jnp.where(jnp.any(active, axis=-1, keepdims=True), after, before)
    impulse = params.mass * rotation.rotate(states.quat, after[..., :3] - before[..., :3])
    states = states.replace(vel=rotation.rotate(states.quat, after[..., :3]), ang_vel=after[..., 3:])
    return states, record.replace(impulse=impulse)


def _inertia(mass: Array, inertia: Array) -> Array:
    """Return mass and moment of inertia as one matrix. (..., 6, 6)"""
    zero = jnp.zeros_like(inertia)
    upper = jnp.concatenate([mass[..., None] * jnp.eye(3, dtype=mass.dtype) + zero, zero], axis=-1)
    return jnp.concatenate([upper, jnp.concatenate([zero, inertia], axis=-1)], axis=-2)


def _tangential(weight: Array, p: Array) -> Array:
    """Return the sum of ``weight * B^T B``; ``B`` maps a body's velocity to that of its point ``p``. (..., 6, 6)"""
    total = jnp.sum(weight, axis=-1)[..., None, None] * jnp.eye(3, dtype=p.dtype)
    x, y, z = (jnp.sum(weight * p[..., k], axis=-1) for k in range(3))
    o = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack(r, axis=-1) for r in ((o, -z, y), (z, o, -x), (-y, x, o))], axis=-2)
    square = jnp.sum(weight * jnp.sum(p * p, axis=-1), axis=-1)[..., None, None] * jnp.eye(3, dtype=p.dtype)
    turned = square - jnp.sum(weight[..., None, None] * p[..., None] * p[..., None, :], axis=-3)
    upper = jnp.concatenate([total, -cross], axis=-1)
    return jnp.concatenate([upper, jnp.concatenate([cross, turned], axis=-1)], axis=-2)
