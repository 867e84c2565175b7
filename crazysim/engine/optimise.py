"""The passes that make of a lowered program the one that a backend runs, in order."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable

from crazysim.engine.ir import dump, listing
from crazysim.engine.ir.program import Program
from crazysim.engine.ir.verify import verify
from crazysim.engine.passes.layout import pack_rows, pack_shared
from crazysim.engine.passes.schedule import fuse, hoist, join_ticks

Pass = Callable[[Program], Program]

VERIFY_VARIABLE = "CRAZYSIM_VERIFY"
"""Environment variable that, set to 1, has every program verified after every pass."""


def optimise(program: Program, rows: Callable[[list[int]], list[int]] | None = None, pack: bool = True) -> Program:
    """Return a lowered program after all passes, ready for a backend.

    Args:
        program: The program, from ``lower_stages``.
        rows: From the written leaves to the leaves that are stored as rows, each of one number of all drones.
        pack: True to read shared numbers from one leaf.
    """
    passes: list[Pass] = [fuse, join_ticks, hoist, *([pack_shared] if pack else [])]
    if rows is not None:
        stored = functools.partial(pack_rows, select=rows)
        passes.append(functools.update_wrapper(stored, pack_rows))
    return apply(program, passes)


def apply(program: Program, passes: Iterable[Pass]) -> Program:
    """Return a program after some passes, verified and dumped after each where the environment variables say so."""
    _inspect(program, "lowered")
    for compiler_pass in passes:
        program = compiler_pass(program)
        _inspect(program, getattr(compiler_pass, "__name__", "pass"))
    return program


def _inspect(program: Program, name: str) -> None:
    if os.environ.get(VERIFY_VARIABLE) == "1":
        verify(program)
    if dump.is_enabled():
        dump.write(f"program.{name}", listing.list_program(program))
