"""The errors that a wrong configuration raises."""


class ConfigError(ValueError):
    """A simulation that cannot be: settings that contradict each other or lack something."""


class UnknownNameError(ConfigError, KeyError):
    """A name that does not exist: an airframe, a mode, a body, a camera or a stage."""

    def __str__(self) -> str:
        """Return the message itself; ``KeyError`` would show its quoted form."""
        return str(self.args[0])
