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
_thread = threading.local()
_programs, _kernels = WeakValueDictionary(), WeakKeyDictionary()
"""Programs by their source, and their kernels."""


def install():
    """Let kernels that are wanted while ``active`` be compiled late."""
    native._library, native.target, kernel.write = library, target, write


@contextlib.contextmanager
def chosen_by_name():
    """Compile kernels at once: they are wanted for an engine that was chosen by its name."""
    _thread.chosen = True
    try:
        yield
    finally:
        _thread.chosen = False


def may_wait():
    """Return whether kernels that are wanted now may be compiled late."""
    return active and not getattr(_thread, "chosen", False)


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
            elif not ffi.answered(frame.contents):
                self.call(frame.contents.args.arrays(), frame.contents.rets.arrays(), frame)
        except Exception as error:  # there is nobody to catch it; pytest fails the test
            about = {"err_msg": "a kernel that was interpreted failed", "object": self}
            sys.unraisablehook(
                SimpleNamespace(exc_type=type(error), exc_value=error, exc_traceback=error.__traceback__, **about)
            )

    def call(self, given, out, frame=None):
        """Take steps from arrays to arrays; a frame of both is made if it is not given."""
        (n_lanes,), (n_steps, *_), *numbers = given
        self.left -= python_steps.CALL + int(n_steps) * python_steps.cost(self.program, int(n_lanes))
        few = active and self.left >= 0 and python_steps.are_few(self.program, int(n_lanes))
        if self.library is not None or not few or not self.is_for(numbers):
            self.compiled().crazysim_advance(ctypes.byref(ffi.frame(given, out)) if frame is None else frame)
            return
        leaves = [None] * len(self.program.leaves)
        for i, x in zip(self.source.inputs, numbers, strict=True):
            leaves[i] = x
        written, flagged = python_steps.steps(self.program, leaves, int(n_steps))
        for x, y in zip(out, written, strict=False):
            x[...] = y.reshape(x.shape)
        if self.program.check is not None:
            out[-1][...] = flagged

    def is_for(self, numbers):
        """Return whether inputs are of worlds as the program has them: its source may be that of others too."""
        drones = [
            x for i, x in zip(self.source.inputs, numbers, strict=True)
            if self.program.leaves[i].scope == "drone" and not self.program.leaves[i].rows_of
        ]  # fmt: skip
        return bool(drones) and all(x.shape[1] == self.program.n_drones for x in drones)

    def compiled(self):
        """Return the compiled library."""
        with self.lock:
            self.library = self.library or self.compile()
        return self.library
