"""How tests run: in as many processes as fit the machine or container; slow tests state a reason."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import conftest
import machine
import pytest


@pytest.mark.parametrize(
    ("cores", "memory", "expected"),
    [(2, 24e9, 2), (2, 6e9, 1), (4, 16.4e9, 4), (64, 40e9, 10), (1.5, 64e9, 1), (0.5, 1e9, 1)],
)
def test_processes_fit_into_cores_and_memory(cores, memory, expected):
    assert machine.n_workers(cores, memory) == expected


def test_processes_keep_the_limits_of_a_container(tmp_path):
    free = machine.cores(tmp_path), machine.memory(tmp_path)
    assert min(free) >= 1
    (tmp_path / "cpu.max").write_text("max 100000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert (machine.cores(tmp_path), machine.memory(tmp_path)) == free
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    (tmp_path / "memory.max").write_text("1000000\n")
    assert (machine.cores(tmp_path), machine.memory(tmp_path)) == (0.5, 1e6)


def test_a_process_knows_the_memory_that_it_takes():
    """A process of its own, in which nothing else frees memory meanwhile."""
    if sys.platform != "linux":
        assert machine.process_memory() == 0
        return
    code = """import jax, machine, numpy as np
before = machine.process_memory(); block = np.ones(25_000_000); print(before, machine.process_memory() - before)"""
    folder = Path(machine.__file__).parent
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    before, taken = map(int, done.stdout.split())
    assert 5e7 < before < machine.memory()
    assert taken == pytest.approx(200e6, rel=0.1)


def test_long_tests_are_listed_with_their_reason():
    def report(name, seconds, **reason):
        return SimpleNamespace(nodeid=name, user_properties=[("processor_s", seconds), *reason.items()])

    lines = []
    ended = [report("quick", 4.9), report("long", 6.0), report("longer", 12.34, reason="compiles much")]
    reporter = SimpleNamespace(stats={"": ended, "error": ["no report"]}, section=lines.append, write_line=lines.append)
    conftest.pytest_terminal_summary(reporter)
    assert lines == [
        "tests over 5 s of processor time",
        " 12.3 s  longer: compiles much",
        "  6.0 s  long: no reason given: share what it builds, or mark it long",
    ]
