"""Free rigid bodies: a population of balls and boxes with contact."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import Objects, SimData
from crazysim.core.integration import Integrator, limit_ang_vel
from crazysim.core.plugin import Param, Simulation, StagePlacement, derived, param, state
from crazysim.core.population import Population, RatesFn
from crazysim.core.settings import MAX_FRICTION, MAX_ITERATIONS, MAX_SOFTNESS, as_rgba, check_softness, color, setting
from crazysim.dynamics.models import GRAVITY
from crazysim.dynamics.rigid_body import free_rotation
from crazysim.engine.pytree import device_array, host_array
from crazysim.engine.stage import Stage
from crazysim.errors import ConfigError
from crazysim.geometry import Shape
from crazysim.lab.bodies.rigid_bodies import BodyContacts, require_few_contacts
from crazysim.plugins.effects.ground import HeightField
from crazysim.plugins.payloads.colliders import load_shape
from crazysim.scene.contact_report import ObjectSelection
from crazysim.tables import MASS

MAX_BODIES = 1000
"""Largest number of bodies in a world."""
START_SPACING = 0.5
"""Distance between neighbours of the default row of bodies, m."""


class FreeBodies(Population):
    """Balls and boxes that fall, slide, roll, bounce and stack.

    They touch the ground, objects of the scene, other populations with shapes, drones and each other. Drones and bodies
    are pushed back; objects and other populations are not. A simulation has at most one ``FreeBodies``.
    """

    members: int | Sequence[str] = 1
    """Number of bodies in each world, or their names."""
    size: Any = setting(default=(0.2, 0.2, 0.2), keep=False)
    """Full lengths of a box, m (3,), or radius of a ball, m, for all bodies; or a list with an entry for each body."""
    mass: Param = param(default=0.1, scope="member", low=MASS.low, high=MASS.high, constant=True)
    """Mass, kg. (n_worlds, n_members, 1)"""
    pos: Param = param(default=None, core=(3,), scope="member")
    """Position of the centre of mass, world frame, m; None for a row along x on the floor. (n_worlds, n_members, 3)"""
    quat: Param = param(default=(0.0, 0.0, 0.0, 1.0), core=(4,), scope="member")
    """Attitude, body to world, xyzw, normalised here. (n_worlds, n_members, 4)"""
    vel: Param = param(default=(0.0, 0.0, 0.0), core=(3,), scope="member")
    """Velocity of the centre of mass, world frame, m/s. (n_worlds, n_members, 3)"""
    friction: Param = param(default=0.6, scope="member", low=0.0, high=MAX_FRICTION, constant=True)
    """Coulomb's coefficient; the larger one of two bodies is used. (n_worlds, n_members, 1)"""
    restitution: Param = param(default=0.0, scope="member", low=0.0, high=1.0, constant=True)
    """Ratio of the speeds after and before a bounce, 0 to 1; the larger one of two bodies is used. (n_worlds,
    n_members, 1)"""
    objects: ObjectSelection = None
    """Handles, or names of objects that the bodies touch; None for all in the scene, () for the ground alone."""
    drones: bool = True
    """True for contact with drones."""
    softness: float = setting(default=0.03, positive=True, high=MAX_SOFTNESS)
    """Time constant with which an overlap is pushed out, s; at least two steps."""
    iterations: int = setting(default=30, low=1, high=MAX_ITERATIONS)
    """Iterations of the solver."""
    rgba: ArrayLike | None = color(per_item=True)
    """Colour, one or one for each body; None for the default. (4,) or (n_members, 4)"""
    ang_vel: Array = state((3,), scope="member")
    """Angular velocity, body frame, rad/s. (n_worlds, n_members, 3)"""
    force: Array = state((3,), scope="member")
    """External force on the centre of mass, world frame, N; kept until it is changed. (n_worlds, n_members, 3)"""
    torque: Array = state((3,), scope="member")
    """External torque, world frame, N m; kept until it is changed. (n_worlds, n_members, 3)"""
    impulse: Array = state((3,), scope="member")
    """Impulse of all contacts in the last step, world frame, N s. (n_worlds, n_members, 3)"""
    normal_impulse: Array = state(("n_contacts",), scope="world")
    """Impulses along the normals of the contact points, N s; the initial impulses of the next step.
    (n_worlds, 1, n_contacts)"""
    friction_impulse: Array = state(("n_contacts", 3), scope="world")
    """Impulses across the normals, world frame, N s; the initial impulses of the next step.
    (n_worlds, 1, n_contacts, 3)"""
    inertia: Array = derived((3,), scope="member")
    """Moments of inertia about the axes of the body, kg m^2. (n_worlds, n_members, 3)"""
    name: str = "bodies"
    prefix: ClassVar[str] = "Box"

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Shape of each body."""
        n, size = self.n_members, self.size
        if n > MAX_BODIES:
            raise ConfigError(f"expected at most {MAX_BODIES} bodies in a world, got {n}. Use fewer, and more worlds.")
        is_list = isinstance(size, list) or np.ndim(size) == 2
        if is_list and len(size) != n:
            raise ConfigError(f"expected one size for all {n} bodies or a list of {n}, got a list of {len(size)}")
        return tuple(load_shape(tuple(s) if np.ndim(s) else s) for s in (size if is_list else [size] * n))

    @property
    def pushes_drones(self) -> bool:
        """Whether this plugin computes the contacts of its bodies with drones; ``ContactResponse`` leaves them out."""
        return self.drones

    @property
    def moved_kinds(self) -> tuple[str, ...]:
        return (self.name,)

    def bind(self, sim: Simulation) -> FreeBodies:
        shapes = self.shapes
        others = [p.name for p in sim.scene.plugins() if isinstance(p, FreeBodies) and p.name != self.name]
        if others:
            raise ConfigError(
                f"expected one FreeBodies in a simulation, got a second next to {others[0]!r}. Use "
                f"FreeBodies(n, size=[...]) with a size for each body."
            )
        check_softness(sim.data.core.freq, self.softness)
        pos = row_positions(shapes) if self.pos is None else self.pos
        quat = np.asarray(self.quat, np.float64)
        if quat.shape[-1:] != (4,) or not np.all(np.linalg.norm(quat, axis=-1) > 0):
            raise ConfigError(f"expected quat as quaternions xyzw, not zero, got {self.quat!r}")
        terrains = [name for name, x in sim.data.plugins.items() if isinstance(x, HeightField)]
        n_contacts = require_few_contacts(BodyContacts(sim, self).n_contacts(terrains), f"{len(shapes)} bodies")
        bodies = self.replace(pos=pos, quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True)).with_arrays(
            sim,
            normal_impulse=host_array(0.0, sim.n_worlds, 1, n_contacts),
            friction_impulse=host_array(0.0, sim.n_worlds, 1, n_contacts, 3),
        )
        self._add_to_scene(sim, shapes)
        inertia = np.asarray(bodies.mass) * np.stack([inertia_per_mass(shape) for shape in shapes])
        return bodies.replace(inertia=device_array(inertia))

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        body_contacts = BodyContacts(sim, self)
        name, reason = f"{self.name}_contacts", "it solves the contacts of all worlds at once"
        contact = Stage(lambda data: body_contacts.respond(data), "batch", name=name, unfused_reason=reason)
        return [*super().stages(sim), StagePlacement(contact, before="measurements", name=name)]

    def derivative(self, data: SimData) -> Mapping[str, Array]:
        torque = rotation.rotate_inverse(self.quat, self.torque)
        ang_momentum = self.inertia * self.ang_vel
        return {
            "pos": self.vel,
            "quat": 0.5 * rotation.multiply(self.quat, jnp.concatenate([self.ang_vel, 0 * self.mass])),
            "vel": jnp.asarray(GRAVITY, self.pos.dtype) + self.force / self.mass,
            "ang_vel": (torque - rotation.cross(self.ang_vel, ang_momentum)) / self.inertia,
        }

    def scheme(self, integrator: Integrator) -> Callable[..., FreeBodies]:
        scheme = super().scheme(integrator)

        def integrate_motion(body: FreeBodies, rates_fn: RatesFn, dt: float) -> FreeBodies:
            if integrator == Integrator.rk4:
                new_body = scheme(body, rates_fn, dt)
                return new_body.replace(ang_vel=limit_ang_vel(new_body.ang_vel, 1 / dt))
            new_body = scheme(body, lambda state: {name: rates_fn(state)[name] for name in ("pos", "vel")}, dt)
            torque = rotation.rotate_inverse(body.quat, body.torque)
            ang_vel = limit_ang_vel(body.ang_vel + dt * torque / body.inertia, 1 / dt)
            quat, ang_vel = free_rotation(body.quat, ang_vel, body.inertia, dt)
            return new_body.replace(quat=quat, ang_vel=ang_vel)

        return integrate_motion

    def finish(self) -> FreeBodies:
        identity = jnp.asarray([0.0, 0.0, 0.0, 1.0], self.quat.dtype)
        return self.replace(quat=rotation.safe_normalize(self.quat, identity))

    def move_objects(self, data: SimData) -> Objects:
        return data.objects.with_poses({self.name: (self.pos, self.quat)})  # type: ignore[union-attr]

    def _add_to_scene(self, sim: Simulation, shapes: Sequence[Shape]) -> None:
        rgba = (0.25, 0.5, 0.75, 1.0) if self.rgba is None else self.rgba
        colors = np.broadcast_to(as_rgba(rgba, len(shapes)), (len(shapes), 4))
        geoms = [body_geom_xml(shape, rgba) for shape, rgba in zip(shapes, colors, strict=True)]
        sim.scene.add_once(geoms, self.name, len(shapes))


FreeBodiesData = FreeBodies
"""What ``data.plugins`` has: the same class, with arrays."""


def row_positions(shapes: Sequence[Shape]) -> np.ndarray:
    """Return positions in a row along x from 1 m on, on the floor, m. (n, 3)"""
    return np.array([[1.0 + START_SPACING * k, 0.0, shape.size[-1]] for k, shape in enumerate(shapes)])


def inertia_per_mass(shape: Shape) -> np.ndarray:
    """Return the moments of inertia of a homogeneous ball or box divided by its mass, m^2. (3,)"""
    if shape.kind == "sphere":
        return np.full(3, 0.4 * shape.size[0] ** 2)
    x, y, z = np.square(shape.size)
    return np.array([y + z, z + x, x + y]) / 3


def body_geom_xml(shape: Shape, rgba: Iterable[float]) -> str:
    """Return the MJCF of a body's geom, which drones can touch."""
    size, color = (" ".join(f"{float(x):.9g}" for x in values) for values in (shape.size, rgba))
    geom = f'<geom type="{shape.kind}" size="{size}" contype="0" conaffinity="2" rgba="{color}"/>'
    return f"<mujoco><worldbody>{geom}</worldbody></mujoco>"
