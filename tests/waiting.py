"""Waiting for events of other threads and processes."""

import time


def wait_for(condition, seconds=300.0):
    """Wait until a condition holds; the time limit is for events that never happen, not a test of speed."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the condition did not hold in time"
        time.sleep(0.01)
