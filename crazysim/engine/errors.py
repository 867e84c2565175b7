"""Errors of planning, for stages that the engine does not support."""

from __future__ import annotations

from collections.abc import Sequence

import jax

from crazysim.errors import ConfigError, EngineWarning, UnsupportedError, warn


class LimitError(UnsupportedError):
    """A documented limit of the engine. The stage runs unfused, or the derivative on ``lanes``, without a warning."""


class KernelError(UnsupportedError):
    """A kernel that could not be compiled, loaded or launched."""


def report_unsupported(problems: Sequence[str], strict: bool, reported: set[str], remedy: str) -> None:
    """Warn once that operations are not supported and run more slowly; with ``strict``, raise an error instead.

    Args:
        problems: Unsupported operations, each with the reason. If empty, nothing is reported.
        strict: Whether to raise an error instead of the warning.
        reported: Texts of the warnings that were given before; the text of a new warning is added.
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
