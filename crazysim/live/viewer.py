"""Base class of viewers, and the controls that viewers show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crazysim.live.loop import Live


@dataclass(frozen=True)
class Button:
    """A button that calls a function between two steps."""

    name: str
    """Text on the button."""
    call: Callable[[Live], None]
    """Function of the loop."""
    key: str | None = None
    """Key that does the same; None for none."""


@dataclass(frozen=True)
class Slider:
    """A slider that calls a function between two steps, with its value."""

    name: str
    """Text beside the slider."""
    low: float
    """Least value."""
    high: float
    """Greatest value."""
    value: float
    """Initial value."""
    call: Callable[[Live, float], None]
    """Function of the loop and the value."""


Control = Button | Slider


class Viewer:
    """Base of viewers. The loop calls the methods in its thread; they must not wait."""

    def open(self, live: Live) -> None:
        """Show the simulation of a loop from now on, with the controls that it has.

        Raises:
            CrazysimError: If this machine cannot show it.
        """
        raise NotImplementedError

    def update(self, live: Live) -> None:
        """Show the simulation as it is now."""
        raise NotImplementedError

    @property
    def is_open(self) -> bool:
        """True until the user or ``close`` closes the viewer."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the viewer."""
        raise NotImplementedError
