"""Errors and warnings of the package."""

from __future__ import annotations

import contextlib
import errno
import socket
import sys
import warnings
from collections.abc import Iterator

import jax

MAX_REPR_LENGTH = 60
"""Largest number of characters of a value in a message. A list or dict with this many entries is not shown at all."""
SKIPPED_PACKAGES = ("crazysim", "jax", "contextlib", "functools", "importlib")
"""Packages that are skipped in the search for the user's line that caused a warning."""


def short_repr(value: object) -> str:
    """Return the representation of a value for a message, cut to ``MAX_REPR_LENGTH`` characters.

    A long list or dict is described by its type, as "a list".
    """
    try:
        text = (
            repr(value)
            if not isinstance(value, (list, dict)) or len(value) < MAX_REPR_LENGTH
            else _describe_type(value)
        )
    except RecursionError:
        text = _describe_type(value)
    return text if len(text) <= MAX_REPR_LENGTH else f"{text[: MAX_REPR_LENGTH - 3]}..."


def _describe_type(value: object) -> str:
    return f"a {type(value).__name__}"


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Issue a warning at the user's line: the line of the nearest caller outside of ``SKIPPED_PACKAGES``."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in SKIPPED_PACKAGES:
        frame = frame.f_back
    module_globals = frame.f_globals
    registry = module_globals.setdefault("__warningregistry__", {})
    warnings.warn_explicit(
        text, category, frame.f_code.co_filename, frame.f_lineno, module_globals.get("__name__"), registry
    )


def not_installed(use: str, package: str, extra: str) -> str:
    """Return the message about a package that is missing.

    Args:
        use: Subject and verb of the sentence, such as ``"films need"``.
        package: Name of the package.
        extra: Extra of crazysim that installs it.
    """
    return f"{use} {package}, which is not installed. Run pip install 'crazysim[{extra}]'."


@contextlib.contextmanager
def optional_import(use: str, package: str, extra: str, error: type[Exception] = ImportError) -> Iterator[None]:
    """Raise the message of ``not_installed`` for a package that is imported in the block."""
    try:
        yield
    except ImportError as reason:
        raise error(not_installed(use, package, extra)) from reason


def address_message(host: str, port: int, error: Exception, prefix: str = "") -> str:
    """Return the message about an address at which a server cannot listen.

    Args:
        error: The error that was raised when the server tried to listen.
        prefix: Text before the name of the setting, such as ``"--"`` for an option of a command.
    """
    is_host_wrong = isinstance(error, socket.gaierror) or getattr(error, "errno", None) == errno.EADDRNOTAVAIL
    return (
        f"expected a free address, got {host}:{port}: {str(error).rstrip('.')}. "
        f"Choose another {prefix}{'host' if is_host_wrong else 'port'}."
    )


class ConfigError(ValueError):
    """Settings that are invalid, incomplete or contradict each other."""


def require(ok: object, message: str, error: type[Exception] = ConfigError) -> None:
    """Raise an error unless a condition holds: ``assert`` for what users write.

    The message is formatted in any case, so it holds nothing that takes time. ``expect`` shows a value of any size.
    """
    if not ok:
        raise error(message)


def expect(ok: object, what: str, got: object, remedy: str = "") -> None:
    """Raise a ConfigError that shows a value, as "expected ..., got ...", unless a condition holds."""
    if not ok:
        raise ConfigError(f"expected {what}, got {short_repr(got)}{remedy and f'. {remedy}'}")


def require_type(value: object, kind: type, remedy: str) -> None:
    expect(isinstance(value, kind), kind.__name__, value, remedy)


def require_callable(name: str, value: object) -> None:
    """Check that an argument is a function, or None."""
    expect(value is None or callable(value), f"{name} as a function or None", value, "Use a function.")


class UnknownNameError(ConfigError, KeyError):
    """A name that does not exist, such as one of an airframe, a controller, a mode, a body, a camera or a stage."""

    def __str__(self) -> str:
        return str(self.args[0])


class DamagedFileError(ConfigError):
    """A file that is damaged, cut off, or of another kind than expected."""


class DivergedError(RuntimeError):
    """Training in which weights or losses became non-finite."""


class RenderError(RuntimeError):
    """A screen or OpenGL library that is missing or broken."""


class AirframeWarning(UserWarning):
    """Warning about numbers of an airframe that no real drone can have, but that can still be simulated."""


class EngineWarning(UserWarning):
    """Warning that a step runs on a slower engine, because the chosen engine does not support all of it."""


class UnsupportedError(Exception):
    """A primitive, or a use of a primitive, that the engine cannot lower.

    Rules raise the error with its cause only. Lowering adds the names of the primitive and the stage.
    """

    def __init__(self, cause: str, primitive: str = "", stage: str = ""):
        super().__init__(cause, primitive, stage)
        self.cause, self.primitive, self.stage = cause, primitive, stage

    @property
    def jax_version(self) -> str:
        """Version of JAX that traced the jaxpr."""
        return jax.__version__

    def with_location(self, primitive: str = "", stage: str = "") -> UnsupportedError:
        """Return a copy of the error that also names a primitive and a stage; names that it has already stay."""
        return type(self)(self.cause, self.primitive or primitive, self.stage or stage)

    @property
    def reason(self) -> str:
        """Cause, with the name of the primitive if it is known."""
        is_complete = not self.primitive or f"'{self.primitive}'" in self.cause
        return self.cause if is_complete else f"primitive {self.primitive!r}: {self.cause}"

    def __str__(self) -> str:
        return f"{self.reason} (stage {self.stage!r}, jax {self.jax_version})" if self.stage else self.reason
