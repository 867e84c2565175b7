"""Kernels of the host that are compiled late, for the tests: their first calls run in Python.

Where the compiler is not the subject, what XLA and NumPy call as a kernel takes steps by ``python_steps``, until that
has taken as long as compiling does. From then on it calls the kernel.
"""

import contextlib
import ctypes
import sys
import threading
from types import SimpleNamespace
from weakref import WeakKeyDictionary, WeakValueDictionary

import ffi
import python_steps

from crazysim.engine import kernel, kernel_cache, native

HANDLER = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(ffi.Frame))
LIBRARY, TARGET, WRITE = native._library, native.target, kernel.write

active = False
"""True while a test runs whose subject is not the compiler."""
_chosen = 0
"""Number of plans that are being made for an engine that was chosen by its name."""
_programs, _kernels = WeakValueDictionary(), WeakKeyDictionary()
"""Programs by their source, and their kernels."""


def install():
    """Let kernels that are wanted while ``active`` be compiled late."""
    native._library, native.target, kernel.write = library, target, write


@contextlib.contextmanager
def chosen_by_name():
    """Compile kernels at once, in all threads."""
    global _chosen
    _chosen += 1
    try:
        yield
    finally:
        _chosen -= 1


def may_wait():
    """Return whether kernels that are wanted now may be compiled late."""
    return active and not _chosen


def write(program, target, samples=()):
    """Return what ``kernel.write`` does, and remember the program."""
    made = WRITE(program, target, samples)
    if target == "host" and not samples:
        _programs[made.text], _kernels[program] = program, made
    return made


def target(kernel):
    """Return what ``native.target`` does, with a kernel that is compiled if it may not wait."""
    name = TARGET(kernel)
    if isinstance(native._LOADED[name], Late) and not may_wait():
        native._LOADED[name].compiled()
    return name


def library(words, key, source):
    """Return what ``native._library`` does, or what compiles it late."""
    program = _programs.get(source) if may_wait() else None
    if program is None or any(kernel_cache.find(kernel_cache.folder(), key)):
        return LIBRARY(words, key, source)
    return Late(program, _kernels[program], lambda: LIBRARY(words, key, source))


class Late:
    """A kernel's library, which is compiled when it is worth it."""

    def __init__(self, program, source, compile):
        """Take a program, its kernel, and what compiles that."""
        self.program, self.source, self.compile, self.library = program, source, compile, None
        self.left, self.lock = python_steps.budget(program), threading.Lock()
        self.crazysim_advance = HANDLER(self._advance)

    def _advance(self, frame):
        """Do what a kernel does when XLA calls it."""
        try:
            if self.library is not None:
                self.library.crazysim_advance(frame)
            elif not ffi.answer(frame.contents):
                self.call(frame.contents.args.arrays(), frame.contents.rets.arrays(), frame)
        except Exception as error:  # there is nobody to catch it; pytest fails the test
            about = {"err_msg": "a kernel that was interpreted failed", "object": self}
            sys.unraisablehook(
                SimpleNamespace(exc_type=type(error), exc_value=error, exc_traceback=error.__traceback__, **about)
            )

    def call(self, given, out, frame=None):
        """Take steps from arrays to arrays; a frame of both is made if it is not given."""
        program = self.program
        if program is None or not self.is_cheap(program, given):
            self.compiled().crazysim_advance(ctypes.byref(ffi.frame(given, out)) if frame is None else frame)
            return
        _, (n_steps,), *numbers = given
        leaves = [None] * len(program.leaves)
        for i, x in zip(self.source.inputs, numbers, strict=True):
            leaves[i] = x
        written, flagged = python_steps.steps(program, leaves, int(n_steps))
        for x, y in zip(out, written, strict=False):
            x[...] = y.reshape(x.shape)
        if program.check is not None:
            out[-1][...] = flagged

    def is_cheap(self, program, given):
        """Return whether to interpret a call: if its drones are few, and of worlds as the program has them.

        Programs of worlds with two and with three drones may have one source.
        """
        (n_lanes,), (n_steps,), *numbers = given
        self.left -= python_steps.cost(program, int(n_lanes), int(n_steps))
        leaves = [program.leaves[i] for i in self.source.inputs]
        drones = [x for leaf, x in zip(leaves, numbers, strict=True) if leaf.scope == "drone" and not leaf.rows_of]
        fits = bool(drones) and all(x.shape[1] == program.n_drones for x in drones)
        return active and self.left >= 0 and fits and python_steps.are_few(program, int(n_lanes))

    def compiled(self):
        """Return the compiled library."""
        with self.lock:
            if self.library is None:
                self.library = self.compile()
                self.program = None  # libraries are kept as long as the process runs
        return self.library
