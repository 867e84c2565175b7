"""A full disk, for tests of functions that write files."""

import resource
import sys
from contextlib import contextmanager


@contextmanager
def full_disk(size=100):
    """Limit the size of every file that is written to ``size`` bytes, as a quota does.

    Python writes no bytecode meanwhile: every later import would fail at a truncated file.
    """
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    bytecode = sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        sys.dont_write_bytecode = bytecode
