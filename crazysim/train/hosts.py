"""Checks and decisions for a training on several hosts, which run the same program in lockstep."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from typing import Any

import jax

import crazysim
from crazysim.engine import jaxcompat
from crazysim.errors import require

SETTINGS_TIMEOUT = 300
"""Time that a host waits for the settings of the other hosts, s; JAX waits as long for their connections."""
_exchange_numbers = itertools.count()
"""Counter that numbers the exchanges of texts. All hosts make the same exchanges in the same order."""


def is_first_host() -> bool:
    """Return True on the host that writes files and lines of output: host 0, or the only one."""
    return jax.process_index() == 0


def require_same_versions() -> None:
    """Check that all hosts have the same versions of crazysim and JAX; call it before a backend starts."""
    versions = {"crazysim": crazysim.__version__, "JAX": jaxcompat.versions()}
    _require_same_values("versions", versions, "Install the same versions on all hosts.")


def require_same_settings(settings: Mapping[str, Any]) -> None:
    """Check that all hosts have the same settings of a training, which JSON can represent."""
    _require_same_values("settings", settings, "Start all hosts with the same settings, files and checkpoint.")


def _require_same_values(kind: str, values: Mapping[str, Any], remedy: str) -> None:
    hosts = jaxcompat.connected_hosts()
    if hosts is None:
        return
    first_values, *other_hosts = (json.loads(text) for text in _exchange_texts(json.dumps(dict(values)), hosts))
    for host, other_values in enumerate(other_hosts, 1):
        for name in {**first_values, **other_values}:
            require(
                first_values.get(name) == other_values.get(name),
                f"expected the same {kind} on all hosts, got {name} = {first_values.get(name)!r} on host 0 and "
                f"{other_values.get(name)!r} on host {host}. {remedy}",
            )


def _exchange_texts(text: str, hosts: jaxcompat.Hosts) -> list[str]:
    client, host_id, n_hosts = hosts
    folder = f"crazysim/exchange-{next(_exchange_numbers)}"
    client.key_value_set(f"{folder}/{host_id}", text)
    return [client.blocking_key_value_get(f"{folder}/{i}", 1000 * SETTINGS_TIMEOUT) for i in range(n_hosts)]


def must_stop(iteration: int) -> bool:
    """Return True on all hosts, after the same iteration, if one has received SIGTERM; always False for a single host.

    Args:
        iteration: Number of the iteration that has ended.
    """
    return jax.process_count() > 1 and jaxcompat.is_stop_requested(iteration)


def broadcast_decision(decision: bool) -> bool:
    """Return the decision of host 0 on all hosts, after waiting for the devices of all hosts."""
    return decision if jax.process_count() == 1 else jaxcompat.broadcast_from_first(decision)
