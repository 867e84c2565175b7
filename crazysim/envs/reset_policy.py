"""When and how new episodes begin within a step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from jax import Array

from crazysim.envs.state import EnvState


class AutoresetMode(StrEnum):
    """When a new episode begins; the names are Gymnasium's."""

    next_step = "NextStep"
    """In the step after the last one of an episode. That step ignores its action and gives no reward."""
    same_step = "SameStep"
    """At the end of the last step itself: ``obs`` belongs to the new episode, reward and ``info`` to that step, and the
    last observation is in ``info["final_obs"]``, with the images of the step before."""
    disabled = "Disabled"
    """When the user calls ``restart``."""


@dataclass(frozen=True)
class ResetPolicy:
    """Rule by which new episodes begin within a step; all functions take one world or all."""

    must_reset: Callable[[Array, EnvState], Array]
    """``must_reset(was_done, ended)``: true where a new episode begins; ``was_done`` is ``done`` before the step. ()"""
    after_step: Callable[[EnvState], EnvState]
    """``after_step(state)``: the state after a step, whether a new episode begins or not."""
    keeps_final_obs: bool
    """True if ``after_step`` adds ``info["final_obs"]``."""
    after_reset: Callable[[EnvState, EnvState], EnvState]
    """``after_reset(ended, new)``: the state that begins a new episode, from those before and after the reset."""


def _add_final_obs(state: EnvState) -> EnvState:
    # Within a step these are images of an earlier step, until new ones are taken.
    images = {name: state.info.get("final_obs", state.obs)[name] for name in state.record.images}
    return state.replace(info=state.info | {"final_obs": state.record.obs | images})


def _keep_results(final_state: EnvState, new_state: EnvState) -> EnvState:
    return new_state.replace(
        **{name: getattr(final_state, name) for name in ("reward", "terminated", "truncated", "info")}
    )


POLICIES: dict[AutoresetMode, ResetPolicy | None] = {
    AutoresetMode.disabled: None,
    AutoresetMode.next_step: ResetPolicy(lambda was_done, _: was_done, lambda state: state, False, lambda _, new: new),
    AutoresetMode.same_step: ResetPolicy(lambda _, ended: ended.done, _add_final_obs, True, _keep_results),
}
"""Reset policy of each mode; None for no automatic resets."""
