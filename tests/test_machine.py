"""The number of processes that run tests follows the cores and the memory of the machine, or of its container."""

import machine
import pytest


@pytest.mark.parametrize(
    ("cores", "memory", "expected"),
    [(2, 24e9, 2), (2, 6e9, 1), (4, 16.4e9, 4), (64, 40e9, 10), (1.5, 64e9, 1), (0.5, 1e9, 1)],
)
def test_processes_fit_into_cores_and_memory(cores, memory, expected):
    assert machine.n_workers(cores, memory) == expected


def test_limits_of_a_container_count(tmp_path):
    free = machine.cores(tmp_path), machine.memory(tmp_path)
    assert min(free) >= 1
    (tmp_path / "cpu.max").write_text("max 100000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert (machine.cores(tmp_path), machine.memory(tmp_path)) == free
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    (tmp_path / "memory.max").write_text("1000000\n")
    assert (machine.cores(tmp_path), machine.memory(tmp_path)) == (0.5, 1e6)
