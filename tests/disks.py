"""A full disk, for tests of functions that write files."""

import resource
import sys
from contextlib import contextmanager


@contextmanager
def full_disk(size=100):
    """Let every file end at `size` bytes, as the system does for a quota.

    Python writes no bytecode meanwhile: it would keep the cut file and fail to import it ever after.
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
