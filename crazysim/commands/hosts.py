"""Commands that run on several hosts, connected by ``jax.distributed``. JAX ends a host when another one is lost."""

from __future__ import annotations

import argparse
import os
import re
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from crazysim.commands.options import MAX_WAIT, number
from crazysim.errors import ConfigError, DivergedError, require

if TYPE_CHECKING:
    from crazysim.engine.jaxcompat import Hosts

MAX_PORT = 65535
"""Largest TCP port."""
STOP_KEY = "crazysim/stop"
"""Prefix of the keys in the coordinator's store under which hosts write why they stop."""
STOP_SECONDS = 10
"""Time for which a host that stops waits for the other hosts, s."""
POLL_SECONDS = 0.5
"""Time between two checks whether another host stops, s."""
END_SECONDS = 24 * 3600
"""Time for which hosts wait until the last host ends, s: host 0 draws and films when the others have finished."""


def add_options(add: Callable[..., Any]) -> None:
    coordinator_help = "address of host 0, with which the other hosts connect; auto to read it from SLURM or Open MPI"
    add("--coordinator", metavar="HOST:PORT|auto", help=coordinator_help)
    add("--host-id", type=number(0, example=0), metavar="I", help="number of this host, from 0")
    add("--hosts", type=number(example=2), metavar="N", help="number of hosts")
    heartbeat_help = "time without a sign of life after which a host counts as lost, s"
    add("--heartbeat-timeout", type=number(1, MAX_WAIT, 60), default=100, metavar="SECONDS", help=heartbeat_help)
    connect_help = "time within which all hosts must have connected, s"
    add("--connect-timeout", type=number(1, MAX_WAIT, 60), default=300, metavar="SECONDS", help=connect_help)


def has_several_hosts(options: argparse.Namespace) -> bool:
    require(
        options.coordinator is not None or (options.host_id is None and options.hosts is None),
        "expected --coordinator with --host-id and --hosts, got none. Use the address of host 0, such as "
        "--coordinator 10.0.0.1:1234.",
    )
    return options.coordinator is not None


def run_on_hosts(command: Callable[[argparse.Namespace], int | None], options: argparse.Namespace) -> int:
    """Run a command on this host together with other hosts, and return the exit status.

    Args:
        options: Options of the command, including those of ``add_options``.
    """
    addresses = _host_addresses(options)

    import jax

    from crazysim.engine.jaxcompat import connected_hosts
    from crazysim.train.hosts import require_same_versions

    try:
        jax.distributed.initialize(
            **addresses,
            initialization_timeout=options.connect_timeout,
            heartbeat_timeout_seconds=options.heartbeat_timeout,
            shutdown_timeout_seconds=END_SECONDS,
        )
    except (RuntimeError, ValueError) as error:
        expected, remedy = (
            (f"an address to listen at as {options.coordinator}", "Use another port, for example.")
            if addresses
            else (
                "the variables of SLURM or Open MPI for --coordinator auto",
                "Start the command with srun or mpirun, or use --coordinator HOST:PORT, --hosts and --host-id.",
            )
        )
        raise ConfigError(f"expected {expected}, got: {str(error).rstrip('.')}. {remedy}") from error
    host: Any = connected_hosts()
    signal.signal(signal.SIGINT, _stop_all)
    threading.Thread(target=_stop_with_others, args=(host,), daemon=True).start()
    try:
        require_same_versions()
        devices = jax.local_devices()
        print(f"host {host.host_id} of {host.n_hosts}: {len(devices)} {devices[0].device_kind}", flush=True)
        status = command(options) or 0
    except SystemExit as end:  # all hosts have agreed on it
        status = int(end.code or 0)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):  # probably a host is lost: JAX's runtime then ends this process
            time.sleep(options.heartbeat_timeout + STOP_SECONDS)
        _stop_others(host, error)
    except BaseException as error:
        _stop_others(host, error)
    sys.stdout.flush()
    jax.distributed.shutdown()
    return status


def _stop_all(number: int, frame: object) -> None:
    del frame
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGTERM)


def _host_addresses(options: argparse.Namespace) -> dict[str, Any]:
    address, n, i = options.coordinator, options.hosts, options.host_id
    if address == "auto":
        return {}
    require(
        n is not None and i is not None and 0 <= i < n,
        f"expected --hosts N, and --host-id from 0 to N - 1, got --hosts {n} --host-id {i}. Use for example "
        f"--hosts 2 --host-id 0 on the host of the coordinator, and --hosts 2 --host-id 1 on the other.",
    )
    _check_coordinator(address)
    print(f"host {i} of {n} connects with {address}", flush=True)
    hosts = {"coordinator_address": address, "num_processes": n, "process_id": i}
    return hosts | {"cluster_detection_method": "deactivate"}


def _check_coordinator(text: str) -> None:
    match = re.fullmatch(r"(.+):(\d{1,5})", text)
    if match is None or not 1 <= int(match[2]) <= MAX_PORT:
        raise ConfigError(
            f"expected HOST:PORT or auto as --coordinator, with a port from 1 to {MAX_PORT}, got {text!r}. Use for "
            f"example 10.0.0.1:1234."
        )
    try:
        socket.getaddrinfo(match[1].strip("[]"), int(match[2]))
    except (OSError, UnicodeError) as error:
        raise ConfigError(
            f"expected a host that this machine knows as --coordinator, got {match[1]!r}: {error}. Use its IP address, "
            f"such as 10.0.0.1:{match[2]}."
        ) from error


def _stop_others(host: Hosts, error: BaseException) -> None:
    is_expected = isinstance(error, (ValueError, ImportError, OSError, DivergedError))
    text = str(error) if is_expected else f"{type(error).__name__}: {error}"
    if not is_expected:
        import traceback

        traceback.print_exception(error)
    _end_process(host, f"crazysim: {text}" if host.host_id == 0 else f"crazysim: host {host.host_id}: {text}", text)


_end_lock = threading.Lock()
"""Held by the thread that ends the process."""


def _end_process(host: Hosts, line: str, reason: str | None) -> None:
    if not _end_lock.acquire(blocking=False):
        time.sleep(2 * STOP_SECONDS)
    print(line, file=sys.stderr)
    with suppress(Exception):  # the process ends in any case
        if reason is not None:
            host.client.key_value_set(f"{STOP_KEY}/{host.host_id}", reason)
        host.client.wait_at_barrier(STOP_KEY, 1000 * STOP_SECONDS)
        if host.host_id == 0:  # the coordinator ends last
            time.sleep(2 * POLL_SECONDS)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(2)


def _stop_with_others(host: Hosts) -> None:
    while True:
        time.sleep(POLL_SECONDS)
        with suppress(Exception):  # the coordinator has gone: JAX's runtime ends this process
            for name, reason in host.client.key_value_dir_get(STOP_KEY):
                other = int(name.rpartition("/")[2])
                if other != host.host_id:
                    _end_process(host, f"crazysim: host {host.host_id} stops: host {other} ended: {reason}", None)
