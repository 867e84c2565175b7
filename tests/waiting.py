"""Waiting for events of other threads and processes, and a clock that only a test advances."""

import time


def wait_for(condition, seconds=300.0):
    """Wait until a condition holds; the time limit is for events that never happen, not a test of speed."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the condition did not hold in time"
        time.sleep(0.01)


class Clock:
    """A clock that stands in for ``time.monotonic`` and others: sleeping advances it, a busy machine does not."""

    def __init__(self):
        self.now = 10.0

    def __call__(self):
        return self.now

    monotonic = perf_counter = __call__

    def sleep(self, seconds):
        self.now += seconds
