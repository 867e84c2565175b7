"""A pipeline together with the function that is built from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import is_
from typing import Any, Generic, TypeVar

from crazysim.core.pipeline import Pipeline, check_pipeline

F = TypeVar("F")


class BuiltPipeline(Generic[F]):
    """A pipeline, and the function that runs it, which is built again after an edit."""

    def __init__(self, name: str, stages: Pipeline, build: Callable[[Pipeline], F]):
        """Build the function for the first time.

        Args:
            name: Name of the pipeline, for messages.
            stages: Functions by name, in order; users may edit the dict.
            build: Returns the function that runs a pipeline.
        """
        self._name, self._stages, self._build = name, stages, build
        self._built: tuple[Sequence[Callable[..., Any]], F]
        self.build()

    @property
    def stages(self) -> Pipeline:
        """Functions by name, in order.

        Raises:
            ConfigError: If it is assigned something else than a dict from names to functions.
        """
        return self._stages

    @stages.setter
    def stages(self, stages: Pipeline) -> None:
        self._stages = check_pipeline(self._name, stages)

    def fn(self) -> F:
        """Return the function of the pipeline as it is now. It is called in every step: 0.3 us without an edit."""
        built, fn = self._built
        unedited = len(self._stages) == len(built) and all(map(is_, self._stages.values(), built))
        return fn if unedited else self.build()

    def build(self) -> F:
        """Return a new function of the pipeline as it is now, and keep it."""
        stages = dict(self._stages)
        fn = self._build(stages)
        self._built = list(stages.values()), fn
        return fn
