"""Errors of planning, for stages that the engine does not support."""

from __future__ import annotations

from collections.abc import Sequence

import jax

from crazysim.errors import ConfigError, EngineWarning, UnsupportedError, warn


class LimitError(UnsupportedError):
    """A documented limit of the engine: a stage runs unfused, or a derivative on lanes, without a warning."""


class KernelError(UnsupportedError):
    """A kernel that could not be compiled, loaded or launched."""


def report_unsupported(problems: Sequence[str], strict: bool, reported: set[str], remedy: str) -> None:
    """Warn once about operations that the engine does not support, so that they run more slowly, or raise an error.

    Args:
        problems: Unsupported operations, each with the reason. Without any, there is no warning.
        strict: True to raise an error instead of the warning.
        reported: Warnings that were given before; the new one is added.
        remedy: Remedy for the error: the beginning of a sentence that ends with ``or use strict=False``.
    """
    if not problems:
        return
    text = "; ".join(problems) + f" (JAX {jax.__version__})"
    if strict:
        raise ConfigError(f"{text}. {remedy}, or use strict=False.")
    if text not in reported:
        reported.add(text)
        warn(f"{text}. strict=True raises an error instead.", EngineWarning)
