"""Check that an airframe has the gains that a controller needs."""

from __future__ import annotations

from collections.abc import Iterable

from crazysim.drones import Airframe
from crazysim.drones.keys import GUIDE
from crazysim.errors import ConfigError


def require_gains(airframe: Airframe, paths: Iterable[str], controller: str) -> None:
    """Check that an airframe has all values that a controller needs.

    Args:
        airframe: The airframe.
        paths: Dotted paths of the values, such as ``controller.pwm_max``.
        controller: Name of the controller, for the message.
    """
    missing_paths = [path for path in dict.fromkeys(paths) if path not in airframe.values]
    if not missing_paths:
        return
    tables: dict[str, list[str]] = {}
    for path in missing_paths:
        table, _, key = path.rpartition(".")
        tables.setdefault(table, []).append(key)
    missing_text = "; ".join(f"[{table}] {', '.join(keys)}" for table, keys in tables.items())
    reason = next(filter(None, map(airframe.missing_reason, missing_paths)), "")
    raise ConfigError(
        f"airframe {airframe.name!r} lacks {missing_text}, which controller {controller!r} needs. {reason}Use "
        f"controller='auto', which needs no gains, or add them to the airframe; {GUIDE} lists all keys."
    )
