"""Backends: XLA on vectors (lanes), kernels in C++ and CUDA (fused), NumPy (interpret), batched XLA (plain).

``lanes``, ``fused`` and ``interpret`` run programs, and each has a function ``build`` of the type ``Build``. ``plain``,
the reference, runs stages.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from jax import Array

from crazysim.engine.ir.program import Program
from crazysim.engine.sharding import Location

Run = Callable[[list[Any], int | Array], tuple[list[Any], Array]]
"""Function that takes the leaves of all worlds and a number of steps. It returns the written leaves after these steps,
and True for worlds that are flagged as not finite, (n_worlds, 1).

If the number of steps is a Python number, the loop can be differentiated in reverse mode, except in ``interpret``.
"""


class Build(Protocol):
    """Builder of the function that runs a program."""

    def __call__(self, program: Program, location: Location) -> Run: ...
