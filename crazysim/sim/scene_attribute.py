"""Attributes of a simulation that its scene holds."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

T = TypeVar("T")


class SceneAttribute(Generic[T]):
    """An attribute of ``Sim`` that reads and writes the attribute of ``sim.scene`` at a dotted path."""

    def __init__(self, path: str, doc: str):
        """Take the path below ``sim.scene``, and the documentation of the attribute."""
        *self._owners, self._name = path.split(".")
        self.__doc__ = doc

    def __get__(self, sim: Any, _owner: type) -> T:
        """Return the value."""
        return getattr(self._holder(sim), self._name) if sim is not None else self  # type: ignore[return-value]

    def __set__(self, sim: Any, value: T) -> None:
        """Set the value."""
        setattr(self._holder(sim), self._name, value)

    def _holder(self, sim: Any) -> Any:
        holder = sim.scene
        for name in self._owners:
            holder = getattr(holder, name)
        return holder
