"""Landing on a target that stands still or moves, such as a pad or a roof: outcome, observations and rewards."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.engine.stage import Stage, stage
from crazysim.envs import terms
from crazysim.envs.tasks.goals import OutcomeTask, ProgressTask, state_of
from crazysim.scene.contact_report import ContactFn

MAX_TOUCH_DOWN_SPEED = 0.5
"""Largest speed relative to the target at touch-down, m/s."""
MIN_UP_AXIS_Z = np.cos(np.pi / 9)
"""Smallest vertical component of the body z axis at touch-down, 1; it corresponds to a tilt of 20 degrees."""


class TouchDown(ProgressTask, OutcomeTask):
    """Base of tasks in which every drone lands on its own target, which may move.

    Subclasses define ``install``, ``spawn``, ``target_motion`` and ``has_left_arena``.
    """

    outcomes = ("landed", "crashed")
    target_name: ClassVar[str] = "place"
    """Name of the target in observations: ``difference_to_{target_name}``."""
    progress_reward: ClassVar[float] = 2.0
    """Reward of a metre of progress towards the target."""
    crash_cost: ClassVar[float] = 10.0
    """Cost of a crash."""

    seconds: float = 6.0
    """Length of an episode, s."""

    def target_motion(self, data: SimData, steps_ahead: int = 0) -> tuple[Array, Array]:
        """Return position, m, and velocity, m/s, of each drone's target, world frame. (..., 3) each

        Args:
            data: Data of one drone or one world.
            steps_ahead: Physics steps to add to ``data.core.steps``, for targets that move as a function of time. It is
                1 in a stage after the integration and before ``increment_steps``.
        """
        raise NotImplementedError(self._undefined("target_motion(data)"))

    def has_left_arena(self, data: SimData) -> Array:
        """Whether a drone has left its arena. (...)"""
        raise NotImplementedError(self._undefined("has_left_arena(data)"))

    def touch_down_stage(self, contacts: ContactFn, radius: float, scope: str = "drone") -> Stage:
        """Return the stage that records landings and crashes, to be placed before ``increment_steps``.

        Args:
            contacts: Contacts with floor and objects; object i is the target of drone i.
            radius: Largest horizontal distance from the middle of the target at touch-down, m.
            scope: Scope of the stage: ``drone``, or ``world`` for objects that a population moves.
        """

        @stage(scope)
        def touch(data: SimData) -> SimData:
            s, report = data.states, contacts(data)
            pos, vel = self.target_motion(data, steps_ahead=1)
            if report.objects is None or report.floor is None:
                raise TypeError("expected contacts with objects and floor, got None")
            is_own_target = np.arange(data.core.n_drones, dtype=np.int32) == data.core.drone_id[..., None]
            touches_target = jnp.any(report.objects & is_own_target, axis=-1)
            touches_other = jnp.any(report.objects & ~is_own_target, axis=-1) | report.floor
            offset, relative_vel = s.pos - pos, s.vel - vel
            is_centred = offset[..., 0] * offset[..., 0] + offset[..., 1] * offset[..., 1] < radius**2
            is_soft = (rotation.dot(relative_vel, relative_vel)[..., 0] <= MAX_TOUCH_DOWN_SPEED**2) & (
                rotation.z_axis(s.quat)[..., 2] >= MIN_UP_AXIS_Z
            )
            has_landed = touches_target & (offset[..., 2] > 0) & is_centred & is_soft & ~touches_other
            has_crashed = (touches_target & ~has_landed) | touches_other | self.has_left_arena(data)
            return self.judge(data, has_landed, has_crashed)

        return touch

    def observe(self, data: SimData) -> dict[str, Array]:
        return state_of(data) | self.relative_target_motion(data)

    def relative_target_motion(self, data: SimData) -> dict[str, Array]:
        """Return the vector to each drone's target, m, and the target's relative velocity, m/s, as observations."""
        pos, vel = self.target_motion(data)
        return {
            f"difference_to_{self.target_name}": pos - data.states.pos,
            f"difference_to_{self.target_name}_vel": vel - data.states.vel,
        }

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        record, distance = self.read(data), self.error(data)
        relative_speed = rotation.safe_norm(self.target_motion(data)[1] - data.states.vel)[..., 0]
        reward_terms = {
            "progress": self.progress_reward * self.progress(data),
            "speed": -0.1 * relative_speed * jnp.exp(-4 * distance),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "landed": 10.0 * record.success,
            "crashed": -self.crash_cost * record.failure,
        }
        return terms.only_where(~record.flight_over_before, reward_terms)

    def error(self, data: SimData) -> Array:
        return rotation.safe_norm(self.target(data) - data.states.pos)[..., 0]

    def target(self, data: SimData) -> Array:
        return self.target_motion(data)[0]
