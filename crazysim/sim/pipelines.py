"""The pipelines of a simulation, and the functions that run them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import is_
from typing import TYPE_CHECKING, Any

from crazysim.core.pipeline import Pipeline
from crazysim.engine import build_reset

if TYPE_CHECKING:
    from crazysim.engine import Step, Stepper
    from crazysim.engine.plain import ResetFn


class Pipelines:
    """The part of ``Sim`` that builds steps and resets. Both run their pipeline as it is when they are called."""

    step_pipeline: Pipeline
    """Stages of a step by name, in their order. An edit takes effect at the next step, which compiles again."""
    reset_pipeline: Pipeline
    """Functions of a reset by name, in their order. An edit takes effect at the next reset, which compiles again."""

    _stepper: Stepper
    _reset: ResetFn
    _step_stages: Sequence[Callable[..., Any]] = ()
    _reset_stages: Sequence[Callable[..., Any]] = ()

    @property
    def step_fn(self) -> Step:
        """The step of the pipeline as it is now, ``step(data, n_steps=1) -> data``, pure."""
        self._take_edits()
        return self._stepper.step

    @property
    def reset_fn(self) -> ResetFn:
        """The reset of the pipeline as it is now, ``reset(data, default_data, mask=None) -> data``, pure."""
        return self._reset if _has(self.reset_pipeline, self._reset_stages) else self.build_reset_fn()

    def build_step_fn(self) -> Step:
        """Return a new step of the pipeline as it is now, and use it; ``step(data, n_steps=1) -> data``, pure."""
        step = self._stepper.build(self.step_pipeline)
        self._step_stages = list(self.step_pipeline.values())
        return step

    def build_reset_fn(self) -> ResetFn:
        """Return a new reset of the pipeline as it is now, and use it; ``reset(data, default_data, mask=None)``."""
        self._reset = build_reset(self.reset_pipeline)
        self._reset_stages = list(self.reset_pipeline.values())
        return self._reset

    def _take_edits(self) -> None:
        """Build the step again if its pipeline was edited since."""
        if not _has(self.step_pipeline, self._step_stages):
            self.build_step_fn()


def _has(pipeline: Pipeline, stages: Sequence[Callable[..., Any]]) -> bool:
    """Return True if a pipeline consists of these functions, in their order. It runs in every step: 0.3 us."""
    return len(pipeline) == len(stages) and all(map(is_, pipeline.values(), stages))
