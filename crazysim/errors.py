"""Errors and warnings of the package."""


class ConfigError(ValueError):
    """Settings that are invalid, incomplete or contradict each other."""


class UnknownNameError(ConfigError, KeyError):
    """A name that does not exist: an airframe, a mode, a body, a camera or a stage."""

    def __str__(self) -> str:
        """Return the message itself; ``KeyError`` would show its quoted form."""
        return str(self.args[0])


class RenderError(RuntimeError):
    """A missing or broken screen or OpenGL."""


class EngineWarning(UserWarning):
    """A step that runs on a slower engine than the one that was chosen, which does not support all of it."""
