"""Rules of when and how new episodes begin within a step. They have nothing to do with policies that choose actions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from jax import Array

from crazysim.envs.state import EnvState


class AutoresetMode(StrEnum):
    """When a new episode begins; the names are Gymnasium's."""

    next_step = "NextStep"
    """In the step after the last step of an episode. That step ignores its action and gives no reward."""
    same_step = "SameStep"
    """At the end of the last step itself. ``obs`` is of the new episode; ``reward`` and ``info`` are of the last step.
    ``info["final_obs"]`` has the last observations of the old episode, but with the images of the step before."""
    disabled = "Disabled"
    """When the user calls ``restart``."""


@dataclass(frozen=True)
class ResetPolicy:
    """Rule by which new episodes begin within a step; all functions take one world or all."""

    must_reset: Callable[[Array, EnvState], Array]
    """``must_reset(was_done, state)``: True where a new episode begins, () or (n_worlds,); ``was_done`` is ``done``
    before the step, ``state`` the state after it."""
    after_step: Callable[[EnvState], EnvState]
    """``after_step(state)``: the state at the end of any step, before a reset."""
    keeps_final_obs: bool
    """Whether ``after_step`` adds ``info["final_obs"]``."""
    after_reset: Callable[[EnvState, EnvState], EnvState]
    """``after_reset(final_state, new_state)``: the state at the start of a new episode, from the states before and
    after the reset."""


def _add_final_obs(state: EnvState) -> EnvState:
    # These are images of an earlier step; new images are taken at the end of the step.
    images = {name: state.info.get("final_obs", state.obs)[name] for name in state.record.images}
    return state.replace(info=state.info | {"final_obs": state.record.obs | images})


def _keep_results(final_state: EnvState, new_state: EnvState) -> EnvState:
    return new_state.replace(
        **{name: getattr(final_state, name) for name in ("reward", "terminated", "truncated", "info")}
    )


POLICIES: dict[AutoresetMode, ResetPolicy | None] = {
    AutoresetMode.disabled: None,
    AutoresetMode.next_step: ResetPolicy(
        must_reset=lambda was_done, _: was_done,
        after_step=lambda state: state,
        keeps_final_obs=False,
        after_reset=lambda _, new_state: new_state,
    ),
    AutoresetMode.same_step: ResetPolicy(
        must_reset=lambda _, state: state.done,
        after_step=_add_final_obs,
        keeps_final_obs=True,
        after_reset=_keep_results,
    ),
}
"""Reset policy of each mode; None for no automatic resets."""
