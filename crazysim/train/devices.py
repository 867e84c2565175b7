"""Devices of a training, and the distribution of its arrays over them."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
from jax.sharding import NamedSharding, PartitionSpec, SingleDeviceSharding

from crazysim.core.settings import find_device
from crazysim.engine.sharding import WORLD_AXIS, shardings_of, world_mesh
from crazysim.errors import ConfigError, require
from crazysim.sim.sim import Sim
from crazysim.train.seeds import are_seeds_divided

Learner = TypeVar("Learner", bound=Any)
Devices = str | int | Sequence[int]
"""Devices of a training: ``"all"``, their number, or their indices among the devices of the platform; as text also
``"2"`` and ``"0,2,3"``."""


# Patterns of the text of a compiled program, for ``exchanged_bytes``.
_COLLECTIVE_PATTERN = re.compile(
    r" = (.*?) (all-reduce|all-gather|all-to-all|reduce-scatter|collective-permute|collective-broadcast)(-start)?\("
)
_ARRAY_TYPE_PATTERN = re.compile(r"(pred|[a-z]+(\d+))\[([\d,]*)\]")
_CALLED_COMPUTATIONS_PATTERN = re.compile(r"=\{?(%[\w.-]+(?:, %[\w.-]+)*)")
_COMPUTATION_PATTERN = re.compile(r"^(?:ENTRY )?(%[\w.-]+) .*\{$")
_TRIP_COUNT_PATTERN = re.compile(r'"known_trip_count":\{"n":"(\d+)"')


def evaluation_device(device: str | None, devices: Devices) -> str:
    """Return the name of the device that evaluates the policies of a training on several devices.

    Args:
        device: Platform of the devices, or one of them, such as ``"gpu:1"``; None for JAX's default platform.
        devices: Devices of the training.
    """
    device = jax.default_backend() if device is None else device
    indices = _read_devices(devices)
    is_platform = isinstance(device, str) and ":" not in device and jax.process_count() == 1
    return f"{device}:{indices[0]}" if is_platform and isinstance(indices, tuple) and indices[0] else device


def find_devices(device: str, devices: Devices) -> list[jax.Device]:
    """Return the devices of a training.

    Args:
        device: Platform of the devices; if ``devices`` is a number, it may also be the name of the first device.
    """
    selection, first_device = _read_devices(devices), find_device(device)
    platform, available = first_device.platform, jax.devices(first_device.platform)
    if isinstance(selection, tuple):
        indices, last = selection, max(selection)
    elif selection is None:
        indices, last = range(len(available)), len(available) - 1
    else:
        start = available.index(first_device) if isinstance(device, str) and ":" in device else 0
        indices, last = range(start, start + selection), start + selection - 1
    if last >= len(available):
        hint = "" if platform != "cpu" else (
            " A CPU is one device, or N with XLA_FLAGS=--xla_force_host_platform_device_count=N in the environment."
        )  # fmt: skip
        raise ConfigError(
            f"expected devices among the {len(available)} of {platform!r}, got {platform}:{last}. Use "
            f"--devices all, and --device for another platform.{hint}"
        )
    return [available[i] for i in indices]


def device_options(device: str, devices: Devices, n_worlds: int) -> dict[str, Any]:
    """Return the options of ``Sim`` that distribute its worlds over the devices of a training.

    Args:
        device: Platform of the devices, or one of them.
        n_worlds: Number of worlds of all seeds.
    """
    training_devices = find_devices(device, devices)
    n = len(training_devices)
    require(
        n_worlds % n == 0,
        f"expected a number of worlds that {n} devices divide, got {n_worlds}. Use for example --worlds "
        f"{-(-n_worlds // n) * n}, or another number of --devices.",
    )
    n_hosts = jax.process_count()
    local_devices = [x for x in training_devices if x.process_index == jax.process_index()]
    require(
        len({x.process_index for x in training_devices}) >= n_hosts,
        f"expected devices of all {n_hosts} hosts, got {devices!r}. Use --devices all.",
    )
    return {"device": local_devices[0]} | ({"mesh": world_mesh(training_devices)} if n > 1 else {})


def learner_shardings(shapes: Learner, sim: Sim, n_seeds: int) -> Learner:
    """Return a learner with the sharding of every array in place of the array.

    Arrays over worlds are split. Networks, optimisers and statistics are split over the seeds if the number of seeds is
    a multiple of the number of devices: each device then trains its own seeds. Otherwise they are replicated.

    Args:
        sim: Simulation of the training environment.
    """
    mesh = sim.mesh
    if mesh is None:
        single_device_sharding = SingleDeviceSharding(sim.device)
        return jax.tree.map(lambda _: single_device_sharding, shapes)
    replicated, world_sharding = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(WORLD_AXIS))
    agents_sharding = world_sharding if are_seeds_divided(n_seeds, mesh) else replicated

    def field_shardings(name: str, tree: Any) -> Any:
        if name == "env":
            return jax.tree.unflatten(jax.tree.structure(tree), jax.tree.leaves(shardings_of(tree.full_data, mesh)))
        field_sharding = {"agents": agents_sharding, "memory": world_sharding}.get(name, replicated)
        return jax.tree.map(lambda _: field_sharding, tree)

    return shapes.replace(
        **{f.name: field_shardings(f.name, getattr(shapes, f.name)) for f in dataclasses.fields(shapes)}
    )


def replicated_sharding(sim: Sim) -> jax.sharding.Sharding:
    """Return the sharding of arrays that are copied to every device of a simulation."""
    return SingleDeviceSharding(sim.device) if sim.mesh is None else NamedSharding(sim.mesh, PartitionSpec())


def exchanged_bytes(program: str) -> dict[str, int]:
    """Return the bytes of the arrays that the devices exchange in one call of a compiled program, by operation.

    The bytes of a loop body are multiplied by the number of iterations if the text states it.

    Args:
        program: Text of the program, ``compiled.as_text()``.
    """
    computations: dict[str, list[str]] = {}
    entry = name = ""
    for line in program.splitlines():
        if heading := _COMPUTATION_PATTERN.match(line):
            name = heading[1]
            entry = name if line.startswith("ENTRY") else entry
        elif name:
            computations.setdefault(name, []).append(line)

    bytes_by_operation: dict[str, int] = {}

    def count_bytes(name: str, n_calls: int) -> None:
        for line in computations.get(name, ()):
            if collective := _COLLECTIVE_PATTERN.search(line):
                arrays, operation, start_suffix = collective.groups()
                sizes = [
                    math.prod(map(int, filter(None, shape.split(",")))) * max(int(bits or 8) // 8, 1)
                    for _, bits, shape in _ARRAY_TYPE_PATTERN.findall(arrays)
                ]
                # The start of a gather also lists its operands, which are smaller than its result.
                n_bytes = max(sizes) if start_suffix and operation != "all-reduce" else sum(sizes)
                bytes_by_operation[operation] = bytes_by_operation.get(operation, 0) + n_calls * n_bytes
            trip_count = _TRIP_COUNT_PATTERN.search(line) if " while(" in line else None
            for names in [] if "-done(" in line or "-update(" in line else _CALLED_COMPUTATIONS_PATTERN.findall(line):
                for computation in names.split(", "):
                    count_bytes(computation, n_calls * (int(trip_count[1]) if trip_count else 1))

    count_bytes(entry, 1)
    return bytes_by_operation


def _read_devices(devices: Devices) -> int | tuple[int, ...] | None:
    if devices == "all":
        return None
    try:
        if isinstance(devices, str):
            numbers = [int(x) for x in devices.split(",")]
            selection = tuple(numbers) if len(numbers) > 1 else numbers[0]
        else:
            selection = devices if isinstance(devices, int) else tuple([int(x) for x in devices])
    except (TypeError, ValueError):
        selection = 0
    indices = selection if isinstance(selection, tuple) else (selection - 1,)
    require(
        not isinstance(devices, bool) and indices and min(indices) >= 0 and len(set(indices)) == len(indices),
        f"expected 'all', a number of devices, or their indices, each once, got {devices!r}. Use for example "
        f"--devices 2, or --devices 0,2,3.",
    )
    return selection
