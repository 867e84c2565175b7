"""The errors of planning: what the engine does not support, and where."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import jax

from crazysim.errors import ConfigError, EngineWarning


class UnsupportedError(Exception):
    """A primitive, or a use of one, that the engine cannot lower.

    Rules raise it with the reason alone. Lowering adds the primitive and the stage, so that whoever catches it can
    name them.
    """

    def __init__(self, why: str, primitive: str = "", stage: str = ""):
        """Say why.

        Args:
            why: The reason, as a sentence without a full stop.
            primitive: Name of the JAX primitive, if it is known.
            stage: Name of the stage, if it is known.
        """
        super().__init__(why, primitive, stage)
        self.why, self.primitive, self.stage = why, primitive, stage

    @property
    def jax_version(self) -> str:
        """Version of JAX whose jaxpr was read."""
        return jax.__version__

    def located(self, primitive: str = "", stage: str = "") -> UnsupportedError:
        """Return the error with a primitive and a stage, where it has none yet."""
        return type(self)(self.why, self.primitive or primitive, self.stage or stage)

    @property
    def reason(self) -> str:
        """Reason, with the primitive."""
        named = not self.primitive or f"'{self.primitive}'" in self.why
        return self.why if named else f"primitive {self.primitive!r}: {self.why}"

    def __str__(self) -> str:
        """Return the reason, with the stage and the version of JAX where the stage is known."""
        return f"{self.reason} (stage {self.stage!r}, jax {self.jax_version})" if self.stage else self.reason


class LimitError(UnsupportedError):
    """A documented limit: the stage runs unfused, without a warning."""


class KernelError(UnsupportedError):
    """A kernel that its compiler refused, or did not finish in time."""


def report_unsupported(problems: Sequence[str], strict: bool, reported: set[str], remedy: str) -> None:
    """Warn once that a slower path computes some operations, which the engine does not support, or raise it.

    Args:
        problems: Unsupported operations, each with the reason; nothing happens if there are none.
        strict: True to raise an error instead.
        reported: Warnings that were given before; the new one is added.
        remedy: Way out of the error, as the beginning of a sentence that ends with ``use strict=False``.

    Raises:
        ConfigError: With ``strict``.
    """
    if not problems:
        return
    text = "; ".join(problems) + f" (JAX {jax.__version__})"
    if strict:
        raise ConfigError(f"{text}. {remedy}, or use strict=False.")
    if text not in reported:
        reported.add(text)
        warnings.warn(f"{text}. strict=True raises an error instead.", EngineWarning, stacklevel=2)
