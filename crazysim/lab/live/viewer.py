"""Base class of viewers, and the widgets that viewers show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

L = TypeVar("L")


@dataclass(frozen=True)
class Button:
    """A button that calls a function between two steps."""

    name: str
    """Text on the button."""
    callback: Callable[[], object]
    """Function to call."""
    key: str | None = None
    """Key that calls the same function; None if no key does."""


@dataclass(frozen=True)
class Slider:
    """A slider that calls a function with its value, between two steps."""

    name: str
    """Label of the slider."""
    low: float
    """Least value."""
    high: float
    """Greatest value."""
    value: float
    """Initial value."""
    callback: Callable[[float], object]
    """Function to call with the value."""


Widget = Button | Slider


class Viewer(Generic[L]):
    """Base class of viewers. A loop of type ``L`` calls their methods in its own thread, so they must not block."""

    def open(self, live: L) -> None:
        """Show the simulation and the widgets of a loop from now on.

        Raises:
            CrazysimError: If this machine cannot show it.
        """
        raise NotImplementedError

    def update(self, live: L) -> None:
        """Show the simulation as it is now."""
        raise NotImplementedError

    @property
    def is_open(self) -> bool:
        """Whether the viewer is open; the user or ``close`` closes it."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the viewer."""
        raise NotImplementedError
