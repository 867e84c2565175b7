"""The machine that tests run on: the number of test processes for which it has cores and memory."""

import os
from pathlib import Path

WORKER_MEMORY = 4e9
"""Memory for one process of tests, B: ``KEPT_MEMORY`` and what a file of tests takes."""
KEPT_MEMORY = 2e9
"""Memory from which compiled programs are dropped after a file of tests, B; with all of them a process took 11 GB."""
LIMITS = Path("/sys/fs/cgroup")
"""Folder of a Linux container's limits."""


def n_workers(cores: float, memory: float) -> int:
    """Return the number of processes that fit into these cores and this memory, B; at least one."""
    return max(1, int(min(cores, memory / WORKER_MEMORY)))


def cores(limits: Path = LIMITS) -> float:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, period = _words(limits / "cpu.max", "max 100000")
    return count if quota == "max" else min(count, int(quota) / int(period))


def memory(limits: Path = LIMITS) -> float:
    """Return the memory that this process may use, B: the machine's, or the limit of its container."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    (limit,) = _words(limits / "memory.max", "max")
    return total if limit == "max" else min(total, int(limit))


def process_memory() -> float:
    """Return the memory that this process takes, B; zero where the system does not say it."""
    return int(_words(Path("/proc/self/statm"), "0 0")[1]) * os.sysconf("SC_PAGE_SIZE")


def _words(path: Path, default: str) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return default.split()
