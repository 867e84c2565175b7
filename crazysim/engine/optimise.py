"""The passes that turn a lowered program into the program that a backend runs, in order."""

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
"""Function from a program to an equivalent program."""

VERIFY_VARIABLE = "CRAZYSIM_VERIFY"
"""Environment variable; if it is 1, every program is verified after every pass."""


def optimise(
    program: Program, select_rows: Callable[[list[int]], list[int]] | None = None, pack: bool = True
) -> Program:
    """Return a lowered program after all passes, ready for a backend.

    Args:
        program: The program, from ``lower_stages``.
        select_rows: Function from the indices of the written leaves to the indices of the leaves to store as rows. A
            row holds one number of all drones. None to store no leaf as rows.
        pack: Whether to pack shared numbers in one leaf.
    """
    passes: list[Pass] = [fuse, join_ticks, hoist, *([pack_shared] if pack else [])]
    if select_rows is not None:
        pack_selected_rows = functools.partial(pack_rows, select_rows=select_rows)
        passes.append(functools.update_wrapper(pack_selected_rows, pack_rows))
    return apply_passes(program, passes)


def apply_passes(program: Program, passes: Iterable[Pass]) -> Program:
    """Apply passes to a program, and verify and dump it after each pass if the environment variables are set."""
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
