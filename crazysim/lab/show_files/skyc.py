"""Shows of Skybrush, ``.skyc`` files: zip archives of ``show.json``, ``cues.json``, trajectories and lights.

The format follows Skybrush's own reader (skybrush.js, ``packages/show-format``), with the additions of the
AIMotionLab: yaw as a fourth coordinate, the trajectory types of the Crazyflie, parameters, and ``colors``.
"""

from __future__ import annotations

import base64
import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.arguments import check_arguments
from crazysim.errors import require, short_repr
from crazysim.lab.show_files.archive import Archive, write_archive
from crazysim.lab.show_files.led import MAX_REPEATED_COMMANDS, decode_lights, encode_lights
from crazysim.lab.show_files.lights import Lights
from crazysim.lab.show_files.show import Cue, ParameterChange, Show
from crazysim.lab.show_files.show_trajectory import format_trajectory, parse_trajectory
from crazysim.lab.trajectory_files import checks
from crazysim.storage import read_bytes
from crazysim.trajectories.trajectory import Trajectory

MAX_DRONES = 5000
"""Largest number of drones in a show, Skybrush's limit."""
MAX_PIECES = 2_000_000
"""Largest number of pieces of all trajectories together, or of all lights, after padding to the longest."""
MAX_LOOPED_COMMANDS = 10_000_000
"""Largest number of commands that the loops of all light programs may repeat."""

log = logging.getLogger(__name__)


def load_show(path: str | Path) -> Show:
    """Load the show in a ``.skyc`` file.

    Lights come from the byte code in ``data``, or else from AIMotionLab's ``colors``; a drone without either is white,
    as in Skybrush. A drone without a name is named after its index.

    Raises:
        ConfigError: If the file is not a valid show; the message names the location.
    """
    return parse_show(read_bytes(path, checks.MAX_FILE_BYTES), str(path))


def parse_show(content: bytes, location: str = "a show") -> Show:
    """Return the show in the contents of a ``.skyc`` file; see ``load_show``.

    Args:
        location: Name of the file, for messages.

    Raises:
        ConfigError: If the file is not a valid show; the message names the location.
    """
    archive = Archive(content, location)
    file_location = f"{location}: show.json"
    show = checks.require_object(archive.json("show.json"), file_location)
    checks.require_version_one(show, file_location)
    settings, _ = archive.resolve(show.get("settings", {}), file_location)
    settings = checks.require_object(settings, f"{file_location}, settings")
    swarm, swarm_location = archive.resolve(show.get("swarm"), f"{file_location}, swarm")
    drones = checks.require_array(
        checks.require_object(swarm, swarm_location).get("drones"), MAX_DRONES, f"{swarm_location}, drones"
    )
    if not drones:
        checks.raise_error("at least one drone", "none", swarm_location)
    # Trajectories of all drones, then their lights.
    parsed_drones = []
    for i, drone in enumerate(drones):
        parsed_drones.append(_parse_drone(archive, drone, f"{swarm_location}, drone {i}", i))
        _check_piece_count(len(drones) * parsed_drones[-1]["trajectory"].n_pieces, parsed_drones[-1]["location"])
    trajectories = [drone["trajectory"] for drone in parsed_drones]
    duration = max(float(x.duration) for x in trajectories)
    lights, decoded_programs = [], {}
    for drone in parsed_drones:
        lights.append(
            _decode_lights(archive, drone, duration, MAX_LOOPED_COMMANDS // len(parsed_drones), decoded_programs)
        )
        _check_piece_count(len(parsed_drones) * len(lights[-1].times), f"{drone['location']}, lights")
    # Names and environment.
    names = [drone["name"] for drone in parsed_drones]
    if len(set(names)) < len(names):
        checks.raise_error("different names of the drones", f"{short_repr(sorted(names))}", swarm_location)
    environment = show.get("environment") or {}
    environment_kind = checks.require_object(environment, f"{file_location}, environment").get("type", "outdoor")
    if environment_kind not in ("indoor", "outdoor"):
        checks.raise_error("environment indoor or outdoor", short_repr(environment_kind), file_location)
    return Show(
        names=tuple(names),
        trajectories=Trajectory.stack(trajectories),
        lights=Lights.stack(lights),
        cues=_parse_cues(archive, settings.get("cues"), f"{file_location}, cues"),
        settings={name: value for name, value in settings.items() if name != "cues"},
        homes=np.stack([drone["home"] for drone in parsed_drones]),
        landings=np.stack([drone["landing"] for drone in parsed_drones]),
        parameters=tuple(drone["parameters"] for drone in parsed_drones),
        encodings=tuple(drone["encoding"] for drone in parsed_drones),
        environment=environment_kind,
        meta=checks.require_object(show.get("meta") or {}, f"{file_location}, meta"),
    )


def _check_piece_count(n_pieces: int, location: str) -> None:
    if n_pieces > MAX_PIECES:
        checks.raise_error(f"at most {MAX_PIECES} pieces, padded to the longest", str(n_pieces), location)


def _parse_drone(archive: Archive, value: object, location: str, index: int) -> dict[str, Any]:
    value, location = archive.resolve(value, location)
    settings, location = archive.resolve(
        checks.require_object(value, location).get("settings"), f"{location}, settings"
    )
    settings = checks.require_object(settings, location)
    data, file_location = archive.resolve(settings.get("trajectory"), f"{location}, trajectory")
    yaw_control, _ = archive.resolve(settings.get("yawControl"), f"{location}, yawControl")
    if isinstance(yaw_control, dict) and yaw_control.get("autoYaw"):
        log.warning("%s: autoYaw is ignored; the drone keeps the yaw of the setpoints", location)
    trajectory, encoding = parse_trajectory(data, file_location, yaw_control)
    c = np.asarray(trajectory.coefficients, float)
    start, end = c[0, :, 0], c[-1].sum(-1)
    if settings.get("startYaw") is not None:
        checks.require_number(
            settings["startYaw"], f"{location}, startYaw", -checks.MAX_COORDINATE, checks.MAX_COORDINATE
        )
    name = settings.get("name")
    return {
        "location": location,
        "name": f"drone_{index}" if name is None else checks.require_text(name, f"{location}, name"),
        "trajectory": trajectory,
        "encoding": encoding,
        "home": _parse_position(settings.get("home"), start[:3], f"{location}, home"),
        "landing": _parse_position(settings.get("landAt"), end[:3], f"{location}, landAt"),
        "parameters": _parse_parameters(settings.get("parameters"), f"{location}, parameters"),
        "lights": settings.get("lights"),
    }


def _parse_position(value: object, default: NDArray, location: str) -> NDArray:
    return default if value is None else checks.require_numbers(value, [3], checks.MAX_COORDINATE, location)


def _parse_parameters(value: object, location: str) -> tuple[ParameterChange, ...]:
    changes = []
    for i, entry in enumerate(checks.require_array(value, checks.MAX_POINTS, location) if value is not None else []):
        if not isinstance(entry, list) or len(entry) != 3:
            checks.raise_error("[time, name, value]", short_repr(entry), f"{location}, entry {i}")
        entry_location = f"{location}, entry {i}"
        time = checks.require_number(entry[0], entry_location, 0.0, checks.MAX_TIME)
        changes.append(
            ParameterChange(
                time, checks.require_text(entry[1], entry_location), checks.require_number(entry[2], entry_location)
            )
        )
    return tuple(changes)


def _parse_cues(archive: Archive, value: object, location: str) -> tuple[Cue, ...]:
    if value is None:
        return ()
    value, location = archive.resolve(value, location)
    value = checks.require_object(value, location)
    checks.require_version_one(value, location)
    cues = []
    for i, item in enumerate(checks.require_array(value.get("items", []), checks.MAX_POINTS, location)):
        item_location = f"{location}, item {i}"
        item = checks.require_object(item, item_location)
        time = checks.require_number(item.get("time"), item_location, 0.0, checks.MAX_TIME)
        cues.append(Cue(time, checks.require_text(item.get("name", ""), item_location)))
    return tuple(sorted(cues, key=lambda cue: cue.time))


def _decode_lights(
    archive: Archive, drone: dict[str, Any], until: float, max_looped: int, decoded_programs: dict[str, Lights]
) -> Lights:
    if drone["lights"] is None:
        return Lights.constant()
    value, location = archive.resolve(drone["lights"], f"{drone['location']}, lights")
    value = checks.require_object(value, location)
    checks.require_version_one(value, location)
    if value.get("data") is not None:
        data = checks.require_text(value["data"], f"{location}, data", 2**22)
        if data not in decoded_programs:
            decoded_programs[data] = decode_lights(data, until, location, min(max_looped, MAX_REPEATED_COMMANDS))
        return decoded_programs[data]
    if value.get("colors") is not None:
        return parse_colors(value["colors"], f"{location}, colors")
    return Lights.constant()


def parse_colors(value: object, location: str) -> Lights:
    """Return the lights of AIMotionLab's ``colors``, in either form.

    The newer form is ``[[time, [red, green, blue]], ...]``, with the start time of each colour. The older form is
    ``[["red, green, blue", duration], ...]``. Colours are 0 to 255, times are in s.

    Args:
        value: The JSON array.
        location: File and location in it, for messages.
    """
    entries = checks.require_array(value, MAX_REPEATED_COMMANDS, location)
    times, colors, now = [], [], 0.0
    for i, entry in enumerate(entries):
        entry_location = f"{location}, entry {i}"
        if not isinstance(entry, list) or len(entry) != 2:
            checks.raise_error(
                "[time, [red, green, blue]] or ['red, green, blue', duration]", short_repr(entry), entry_location
            )
        first, second = entry
        if isinstance(first, str):
            channels: Any = [_parse_integer(x, entry_location) for x in first.split(",")[:4]]
            times.append(now)
            now += checks.require_number(second, entry_location, 0.0, checks.MAX_TIME)
        else:
            channels = second
            times.append(checks.require_number(first, entry_location, 0.0, checks.MAX_TIME))
        colors.append(checks.require_numbers(channels, [3], 255.0, entry_location) / 255)
        if colors[-1].min() < 0:
            checks.raise_error("colours from 0 to 255", short_repr(channels), entry_location)
    if not entries:
        return Lights.constant((0.0, 0.0, 0.0))
    checks.require_ascending(np.array(times), 0.0, location)
    if times[0] > 0:
        times, colors = [0.0, *times], [np.zeros(3), *colors]
    return Lights.of_pieces(times, colors)


def _parse_integer(text: str, location: str) -> int:
    text = text.strip()
    if not (text.isascii() and text.isdigit() and len(text) <= 3):
        checks.raise_error("colours as 'red, green, blue', 0 to 255", short_repr(text), location)
    return int(text)


@check_arguments
def save_show(show: Show, path: str | Path) -> None:
    """Write a show as a ``.skyc`` file, which Skybrush reads too.

    Skybrush itself accepts curves of degree 1 to 3 and no yaw: a yaw that is zero throughout is left out, and curves
    have the lowest degree of their encoding that reproduces them. Lights are byte code; lights without fades are
    written as ``colors`` as well.

    Args:
        path: File to write; its name ends with ``.skyc``.

    Raises:
        ConfigError: If the name has another ending, the folder does not exist, or a trajectory has a degree above 7.
    """
    require(
        Path(path).suffix == ".skyc",
        f"expected the name of a show to end with .skyc, got {str(path)!r}. Rename the file.",
    )
    files: dict[str, Any] = {}
    # Files of each drone.
    drones = []
    for i, name in enumerate(show.names):
        folder = f"drones/drone_{i}"
        trajectory = show.trajectory(i)
        c = np.asarray(trajectory.coefficients, float)
        has_yaw = bool(np.any(c[:, 3] != 0))
        files[f"{folder}/trajectory.json"] = format_trajectory(trajectory, show.encodings[i], has_yaw)
        files[f"{folder}/lights.json"] = _format_lights(show.light(i))
        settings = {
            "trajectory": {"$ref": f"./{folder}/trajectory.json#"},
            "lights": {"$ref": f"./{folder}/lights.json#"},
            "home": np.round(show.homes[i], 6).tolist(),
            "startYaw": round(float(np.rad2deg(c[0, 3, 0])), 6),
            "landAt": np.round(show.landings[i], 6).tolist(),
            "name": name,
        }
        if show.parameters[i]:
            settings["parameters"] = [[x.time, x.name, x.value] for x in show.parameters[i]]
        drones.append({"type": "generic", "settings": settings})
    # Files of the show.
    head = {
        "version": 1,
        "settings": {**show.settings, "cues": {"$ref": "./cues.json"}},
        "swarm": {"drones": drones},
        "environment": {"type": show.environment},
        "meta": dict(show.meta),
        "media": {},
    }
    cues = {"version": 1, "items": [{"time": cue.time, "name": cue.name} for cue in show.cues]}
    texts = {name: json.dumps(x) for name, x in {"show.json": head, "cues.json": cues, **files}.items()}
    write_archive(path, texts)


def _format_lights(lights: Lights) -> dict[str, Any]:
    value: dict[str, Any] = {"version": 1, "data": base64.b64encode(encode_lights(lights)).decode()}
    times, starts, ends = (np.asarray(x, float) for x in (lights.times, lights.starts, lights.ends))
    if np.array_equal(starts, ends):
        has_length = np.diff(times, append=np.inf) > 0
        colors = np.round(255 * starts[has_length]).astype(int).tolist()
        value["colors"] = [
            [float(str(t)), color] for t, color in zip(np.asarray(lights.times)[has_length], colors, strict=True)
        ]
    return value
