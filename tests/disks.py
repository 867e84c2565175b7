"""A full disk for the tests of what writes files."""

import resource
from contextlib import contextmanager


@contextmanager
def full_disk():
    """Let every file end at 100 bytes, as the system does for a quota."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
