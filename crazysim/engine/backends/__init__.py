"""Backends: XLA on vectors (lanes), kernels in C++ and CUDA (fused), NumPy (interpret), batched XLA (plain).

``lanes``, ``fused`` and ``interpret`` run programs, and each has a function ``build``, which is a ``Build``. ``plain``,
the reference, runs stages.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from jax import Array

from crazysim.core.sharding import Location
from crazysim.engine.ir.program import Program

Run = Callable[[list[Any], int | Array], tuple[list[Any], Array]]
"""Leaves of all worlds and a number of steps to the written leaves after them, and True for worlds that are flagged as
not finite, (n_worlds, 1).

A step count that is a Python number makes a loop that can be differentiated in reverse.
"""


class Build(Protocol):
    """Builder of the function that runs a program."""

    def __call__(self, program: Program, location: Location) -> Run:
        """Return the function that runs a program on some devices.

        Raises:
            UnsupportedError: If the backend cannot run it.
        """
        ...
