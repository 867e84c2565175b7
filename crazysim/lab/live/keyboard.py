"""Keys of a viewer: the keys that are held, and the functions that keys call."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from crazysim.errors import require

L = TypeVar("L")

KEY_NAMES = ("up", "down", "left", "right", "space", "tab", "backspace", "escape", "enter")
"""Names of keys that are not characters."""


class Keyboard(Generic[L]):
    """Keys by name: a lower-case character, or one of ``KEY_NAMES``. Viewers press and release them from any thread.

    ``L`` is the type of the loop that the functions of keys are called with.
    """

    def __init__(self) -> None:
        self._hold_times: dict[str, float] = {}
        self._pressed_keys: deque[str] = deque(maxlen=100)
        self._callbacks: dict[str, Callable[[L], object]] = {}

    def press(self, key: str) -> None:
        """Press a key."""
        self._hold_times[key] = math.inf
        self._pressed_keys.append(key)

    def hold(self, key: str, seconds: float) -> None:
        """Hold a key for a time, s, for viewers that do not report releases; the key's function is not called."""
        self._hold_times[key] = time.monotonic() + seconds

    def release(self, key: str) -> None:
        """Release a key."""
        self._hold_times.pop(key, None)

    def release_all(self) -> None:
        """Release all keys, as when a viewer closes or loses the focus."""
        self._hold_times.clear()

    def is_held(self, key: str) -> bool:
        """Whether a key is held."""
        return self._hold_times.get(key, 0.0) > time.monotonic()

    def axis(self, positive: str, negative: str) -> float:
        """Return 1, -1 or 0 for two opposite keys."""
        return float(self.is_held(positive)) - float(self.is_held(negative))

    def bind(self, key: str, callback: Callable[[L], object]) -> None:
        """Make a key call a function of the loop when it is pressed, instead of its previous function."""
        require(
            key in KEY_NAMES or (len(key) == 1 and key == key.lower()),
            f"expected a lower-case character or one of {', '.join(KEY_NAMES)} as a key, got {key!r}",
        )
        self._callbacks[key] = callback

    def run(self, live: L) -> None:
        """Call the functions of the keys that were pressed since the last call."""
        while self._pressed_keys:
            callback = self._callbacks.get(self._pressed_keys.popleft())
            if callback is not None:
                callback(live)
