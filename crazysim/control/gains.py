"""Records of gains that an airframe has for one controller, and the check that it has them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, ClassVar, Self

from crazysim.drones import Airframe
from crazysim.drones.keys import GUIDE
from crazysim.dynamics.models import AirframeParams
from crazysim.errors import ConfigError


class Gains(AirframeParams):
    """Base class of parameters from an airframe's table of gains. All gains that it lacks are listed in one message."""

    controller: ClassVar[str] = ""
    """Name of the controller, for the message, declared as ``class MellingerParams(Gains, controller="mellinger")``."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Paths of the values that are needed beside those that leaves declare, declared like ``controller``."""

    def __init_subclass__(cls, controller: str = "", needs: tuple[str, ...] = (), **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.controller, cls.needs = controller or cls.controller, (*cls.needs, *needs)

    @classmethod
    def create(cls, airframe: Airframe, **values: Any) -> Self:
        require_gains(airframe, cls)
        return super().create(airframe, **values)


def require_gains(airframe: Airframe, *records: type[Gains]) -> None:
    """Check that an airframe has all values that records of a controller need."""
    paths = [path for record in records for path in (*_declared_paths(record), *record.needs)]
    missing_paths = [path for path in dict.fromkeys(paths) if path not in airframe.values]
    if not missing_paths:
        return
    tables: dict[str, list[str]] = {}
    for path in sorted(missing_paths, key=lambda path: -path.count(".")):
        table, _, key = path.rpartition(".")
        tables.setdefault(table, []).append(key)
    missing_text = "; ".join(f"[{table}] {', '.join(keys)}" for table, keys in tables.items())
    reason = next(filter(None, map(airframe.missing_reason, missing_paths)), "")
    raise ConfigError(
        f"airframe {airframe.name!r} lacks {missing_text}, which controller {records[0].controller!r} needs. {reason}"
        f"Use controller='auto', which needs no gains, or add them to the airframe; {GUIDE} lists all keys."
    )


def _declared_paths(record: type[AirframeParams]) -> Iterator[str]:
    for field in dataclasses.fields(record):
        source = field.metadata.get("airframe")
        if isinstance(source, str):
            yield source
        elif isinstance(source, type):
            yield from _declared_paths(source)
