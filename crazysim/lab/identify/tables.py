"""Log files as tables of columns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.errors import ConfigError, require
from crazysim.lab.identify.bags import is_bag, read_bag
from crazysim.lab.identify.blackbox import find_header, read_blackbox
from crazysim.lab.identify.columns import KNOWN_COLUMNS, Columns, stack_columns, unsigned_name
from crazysim.lab.identify.delimited import read_delimited
from crazysim.lab.identify.readers import read_crazyflie
from crazysim.lab.identify.repairs import check_period
from crazysim.lab.identify.ulog import read_ulog
from crazysim.storage import check_file, read_arrays, wrap_read_errors

MAX_LOG_BYTES = 2**31
"""Largest log file, bytes. ROS bags have no limit, since they are not read into memory as a whole."""
OTHER_FORMATS = {
    b"\x1f\x8b": ("a gzipped file", "Unpack it with gunzip."),
    b"BZh": ("a file packed by bzip2", "Unpack it with bunzip2."),
    b"\xfd7zXZ": ("a file packed by xz", "Unpack it with unxz."),
    b"\x28\xb5\x2f\xfd": ("a file packed by zstd", "Unpack it with unzstd."),
    b"\xff\xfe": ("text in UTF-16", "Save it as UTF-8."),
    b"\xfe\xff": ("text in UTF-16", "Save it as UTF-8."),
}
"""First bytes of files that are no logs, but may contain one, what they are, and the remedy."""


def read_table(
    source: str | Path | Mapping[str, NDArray], repairs: list[str], columns: Columns | None
) -> tuple[str, Mapping[str, NDArray]]:
    """Return the name of a log and its columns, with the time in s, and angles converted to a quaternion.

    Args:
        source: File, or columns by name.
        repairs: List that descriptions of repairs are appended to.
        columns: Names of the columns; None for the default names.

    Raises:
        ConfigError: If the file cannot be read, or its samples are too close or too far apart for a flight.
    """
    name, table = _read_source(source, repairs, columns)
    if columns is None or not columns.rpy or any(unsigned_name(x) not in table for x in columns.rpy):
        return name, table
    angles = stack_columns(name, table, columns.rpy, columns.rad_per_angle)
    if (max_angle := np.nanmax(np.abs(angles[:, 1]), initial=0.0)) > 1.01 * np.pi / 2:
        raise ConfigError(
            f"{name}: expected a pitch of at most pi/2 rad, got {max_angle:.3g}. Name roll, pitch and yaw in this "
            f"order, and give rad_per_angle={np.pi / 180:.6g} for degrees."
        )
    quat = np.asarray(rotation.from_rpy(jnp.asarray(angles)))
    return name, {**table, **dict(zip(columns.quat, quat.T.astype(np.float64), strict=True))}


def _read_source(
    source: str | Path | Mapping[str, NDArray], repairs: list[str], columns: Columns | None
) -> tuple[str, Mapping[str, NDArray]]:
    if isinstance(source, Mapping):
        return "log", _convert_time("log", source, columns)
    path = Path(source)
    if path.is_file() and not is_bag(path) and (size := path.stat().st_size) > MAX_LOG_BYTES:
        raise ConfigError(
            f"{path.name}: expected a log of at most {MAX_LOG_BYTES} bytes, got {size}. Cut it into flights."
        )
    if path.exists() and not path.is_dir():
        check_file(path)
    # Bags, which may be folders.
    if is_bag(path) and path.exists():
        with wrap_read_errors(path.name, "a ROS bag", "Record it again, or run ros2 bag reindex."):
            return path.stem, read_bag(path, repairs, columns)
    require(path.is_file(), f"expected an existing file, or the folder of a ROS bag, got {str(path)!r}")
    require(
        path.suffix.lower() not in (".bbl", ".bfl"),
        f"{path.name}: expected a blackbox log as .csv, got a raw log. Convert it with blackbox_decode, or export it "
        f"from the Blackbox Explorer.",
    )
    # Files that are no logs, by their first bytes.
    with path.open("rb") as file:
        start = file.read(8)
    for first_bytes, (got, remedy) in OTHER_FORMATS.items():
        require(not start.startswith(first_bytes), f"{path.name}: expected a log, got {got}. {remedy}")
    is_text = path.suffix.lower() == ".csv"
    require(not is_text or b"\0" not in start, f"{path.name}: expected a log, got text in UTF-16. Save it as UTF-8.")
    with wrap_read_errors(path.name, "a log of a flight", "Copy or export it again."):
        if path.suffix.lower() == ".ulg":
            return path.stem, read_ulog(path, repairs)
        if path.suffix.lower() == ".npz":
            with path.open("rb") as file:
                table = read_arrays(file, path.name)
        elif not is_text:
            return path.stem, read_crazyflie(path, repairs, columns)
        elif find_header(path) is not None:
            return path.stem, read_blackbox(path, repairs)
        else:
            table = read_delimited(path, repairs)
    return path.stem, _convert_time(path.stem, table, columns)


def _convert_time(name: str, table: Mapping[str, NDArray], columns: Columns | None) -> Mapping[str, NDArray]:
    names = columns or KNOWN_COLUMNS["crazysim"]
    if names.time not in table:
        return table
    t = stack_columns(name, table, [names.time], names.seconds_per_unit)[:, 0]
    check_period(name, t)
    return {**table, names.time: t}
