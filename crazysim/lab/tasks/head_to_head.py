"""Race against other drones, to be the first behind the last gate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import state
from crazysim.core.settings import setting
from crazysim.envs import terms
from crazysim.envs.tasks.goals import flight_over, nearest_drones
from crazysim.envs.tasks.race import Race, Rewards
from crazysim.envs.tasks.race_rules import dense, race_of, remaining_way
from crazysim.errors import require
from crazysim.plugins.effects.downwash import Downwash
from crazysim.sim.sim import Sim

NEAR = 0.2
"""Distance at which the closeness of another drone is half of that at a distance of zero, m."""


def against_others(data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
    """Return the terms of ``race_rules.dense``, and rewards of leaving others behind and costs of collisions.

    ``ahead`` is the progress minus the mean progress of the other drones, and ``place`` the share of drones that have
    not finished before. The sum of ``ahead`` over all drones is zero.
    """
    record = race_of(data)
    own_terms, n_others = dense(data, action, last_action), len(record.success) - 1
    is_active = ~record.flight_over_before
    progress = jnp.where(is_active, record.remaining_way_before - remaining_way(data), 0)
    place = (len(record.success) - jnp.sum(record.success, dtype=np.int32)) / n_others
    others = {
        "ahead": 1.0 * (progress - (jnp.sum(progress) - progress) / n_others),
        "place": 4.0 * record.success * place,
        "collided": -1.0 * record.collided,
    }
    return own_terms | terms.only_where(is_active, {"ahead": others.pop("ahead"), **others})


class HeadToHead(Race):
    """Race against the other drones of the world, in their downwash and without touching them.

    The course and the rules are those of ``race``. Drones draw their places at the start. A drone whose flight is over
    switches its motors off and falls, so that it is neither in the way of others nor pushes air at them. The first
    drone behind the last gate has won.

    The additional observations are

    - ``rivals``: direction of each other drone in the race and its relative velocity, m/s, nearest first, body frame,
      both divided by the distance plus 0.2 m, so that they are zero for drones that are far away or out (18);
    - ``lead``: the way that is left to the best of them minus the drone's own, m (1).
    """

    name = "head_to_head"
    n_drones = 4
    shuffles: ClassVar[bool] = True
    recipe: ClassVar[Mapping[str, Any]] = {
        "iterations": 400,
        "discount": 0.99,
        "opponents": 3,
        "evaluate_every": 50,
        "practice": {"practice": True, "ends_with": 1},
    }

    reward: Rewards = against_others
    """Function that returns the terms of the reward."""
    seconds: float = 6.0
    """Length of an episode, s."""
    ends_with: int = setting(default=0, low=0)
    """Number of drones, the first ones, with whose flights the episode ends, so that a training does not wait for its
    opponents; 0 for all."""
    downwash: bool = True
    """Whether drones push air at those below."""
    collided: Array = state((), dtype=bool)
    """Whether the drone has touched another one."""
    finish_step: Array = state((), dtype=np.int32)
    """Physics step in which the drone passed its last gate; 0 before."""

    def install(self, sim: Sim) -> None:
        require(sim.n_drones > 1, f"expected several drones in a race, got {sim.n_drones}. Use n_drones=2 or more.")
        if self.downwash:
            sim.add(Downwash())
        super().install(sim)

    def judge(self, data: SimData, succeeds: Array, fails: Array) -> SimData:
        data = super().judge(data, succeeds, fails)
        record, s = self.read(data), data.states
        finishes = record.success & (record.finish_step == 0)
        step = jnp.where(finishes, 1 + data.core.steps.reshape(()), record.finish_step)
        # Motors of drones that are out stand still.
        states = s.replace(rotor_vel=jnp.where(flight_over(record), 0, s.rotor_vel))
        return self.write(data.replace(states=states), finish_step=step)

    def terminated(self, data: SimData) -> Array:
        return jnp.all(flight_over(race_of(data))[: self.ends_with or None])

    def observe(self, data: SimData) -> dict[str, Array]:
        record, s = race_of(data), data.states
        is_over = flight_over(record)
        to_body = jnp.swapaxes(rotation.matrix(s.quat), -1, -2)[:, None]
        pos, vel = (rotation.matvec(to_body, x) for x in nearest_drones(data, len(is_over) - 1, ~is_over))
        distance = rotation.safe_norm(pos)
        closeness = 1 / (NEAR + distance)
        rivals = jnp.concatenate([pos * closeness / jnp.maximum(distance, 1e-3), vel * closeness], axis=-1)
        # The way that the best other drone in the race has left.
        way = remaining_way(data)
        is_rival = ~is_over & ~np.eye(len(is_over), dtype=bool)
        best = jnp.min(jnp.where(is_rival, way, jnp.inf), axis=-1)
        lead = jnp.where(is_rival.any(axis=-1), best - way, 0)
        return super().observe(data) | {"rivals": rivals.reshape(len(is_over), -1), "lead": lead[:, None]}

    def info(self, data: SimData) -> dict[str, Array]:
        record = race_of(data)
        first = jnp.min(jnp.where(record.success, record.finish_step, np.iinfo(np.int32).max))
        won = record.success & (record.finish_step == first)
        return super().info(data) | {"collided": record.collided, "won": won}
