"""Shows as other programs write them: the structures of the public sample shows and of Skybrush Studio."""

import base64
import copy
import io
import json
import zipfile

RED_3_S = base64.b64encode(bytes([0x04, 255, 0, 0, 0x96, 0x01, 0x00])).decode()
"""Light program of the lab's samples: red for 150 units of 20 ms, then the end."""


def pack_archive(files):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for name, value in files.items():
            file.writestr(name, value if isinstance(value, (str, bytes)) else json.dumps(value))
    return buffer.getvalue()


def create_show_json(n, **settings):
    drones = []
    for i in range(n):
        drone_settings = {
            "trajectory": {"$ref": f"./drones/drone_{i}/trajectory.json#"},
            "lights": {"$ref": f"./drones/drone_{i}/lights.json#"},
            "home": [float(i), 0.0, 0.0],
            "startYaw": 0.0,
            "landAt": [float(i), 0.0, 0.1],
            "name": f"cf{i}",
        }
        drones.append({"type": "generic", "settings": drone_settings | settings})
    validation = {"maxAltitude": 2.0, "maxVelocityXY": 2.0, "maxVelocityZ": 1.5, "minDistance": 0.8}
    return {
        "version": 1,
        "settings": {"cues": {"$ref": "./cues.json"}, "validation": validation},
        "swarm": {"drones": drones},
        "environment": {"type": "indoor"},
        "meta": {"id": "make.py", "inputs": ["make.py"]},
        "media": {},
    }


CUES = {"version": 1, "items": [{"time": 4.0, "name": "land"}, {"time": 0.0, "name": "start"}]}


def create_compressed_trajectory(x=0.0):
    """Return a trajectory of three curves of degrees 1, 3 and 7 with yaw, degrees."""
    return {
        "version": 1,
        "points": [
            [0.0, [x, 0.0, 0.0, 0.0], []],
            [1.0, [x, 0.0, 1.0, 0.0], []],
            [3.0, [x, 1.0, 1.0, 90.0], [[x, 0.0, 1.0, 0.0], [x, 1.0, 1.0, 90.0]]],
            [4.5, [x, 0.0, 1.0, 90.0], [[x, 1.0, 1.0, 90.0]] * 3 + [[x, 0.0, 1.0, 90.0]] * 3],
        ],
        "takeoffTime": 0.0,
        "landingTime": 4.5,
        "type": "COMPRESSED",
    }


def create_poly4d_trajectory(x=0.0):
    """Return a trajectory with curves of degree 5 and with the lab's tables for an onboard LQR."""
    inner = [[x, 0.0, 0.0, 0.0]] * 2 + [[x, 0.0, 1.0, 0.0]] * 2
    return {
        "version": 1,
        "points": [[0.0, [x, 0.0, 0.0, 0.0], []], [2.0, [x, 0.0, 1.0, 0.0], inner]],
        "takeoffTime": 0.0,
        "landingTime": 2.0,
        "type": "POLY4D",
        "K": [0] * 240 * 64,
        "bounds": [0.0] * 128,
    }


def create_lab_show(n=2):
    """Return a show of the lab: compressed, with yaw and the older form of colours."""
    lights = {"version": 1, "data": RED_3_S, "colors": [["255, 0, 0", 3.0]]}
    files = {"show.json": create_show_json(n), "cues.json": CUES}
    for i in range(n):
        files[f"drones/drone_{i}/trajectory.json"] = create_compressed_trajectory(float(i))
        files[f"drones/drone_{i}/lights.json"] = lights
    return files


def create_lab_poly4d_show(n=2):
    """Return a show of the lab: POLY4D, parameters, and the newer form of colours alone."""
    lights = {"version": 1, "colors": [[0.0, [0, 0, 255]], [1.0, [255, 255, 0]]]}
    files = {"show.json": create_show_json(n, parameters=[[0.5, "stabilizer.controller", 6]]), "cues.json": CUES}
    for i in range(n):
        files[f"drones/drone_{i}/trajectory.json"] = create_poly4d_trajectory(float(i))
        files[f"drones/drone_{i}/lights.json"] = lights
    return files


def create_older_lab_show(n=2):
    """Return an older show of the lab: no lights, start yaw, yaw or types."""
    files = {"show.json": create_show_json(n), "cues.json": CUES}
    for i, drone in enumerate(files["show.json"]["swarm"]["drones"]):
        del drone["settings"]["lights"], drone["settings"]["startYaw"]
        points = [
            [t, point[:3], [x[:3] for x in inner]]
            for t, point, inner in create_compressed_trajectory(float(i))["points"]
        ]
        files[f"drones/drone_{i}/trajectory.json"] = {"version": 1, "points": points}
    return files


def create_studio_show():
    """Return a show of Skybrush Studio: names by index, take-off time, yaw control, lights only as code, no cues."""
    trajectory = {
        "version": 1,
        "points": [
            [0.0, [17.5, 10.0, 1.0], []],
            [0.5, [17.5, 10.0, 1.72], []],
            [2.5, [18.5, 10.0, 2.0], [[17.5, 10.0, 2.0], [18.0, 10.0, 2.0]]],
        ],
        "takeoffTime": 11.66,
        "landingTime": 225.92,
    }
    settings = {
        "trajectory": {"$ref": "./drones/drone_01/trajectory.json#"},
        "lights": {"$ref": "./drones/drone_01/lights.json#"},
        "yawControl": {"version": 1, "setpoints": [[0, 0], [12.0, 90], [13.5, -90]]},
        "mode": "show",
        "home": [17.5, 10.0, 0.0],
    }
    return {
        "show.json": {
            "version": 1,
            "meta": {"title": "Show"},
            "swarm": {"drones": [{"type": "generic", "settings": settings}]},
        },
        "drones/drone_01/trajectory.json": trajectory,
        "drones/drone_01/lights.json": {"version": 1, "data": "DAMHBQYFDQwACAAA/zIKMgj/AAAyCjIIAP8AMgoyCw0A"},
    }


SHOW_CREATORS = {
    "lab": create_lab_show,
    "lab_poly4d": create_lab_poly4d_show,
    "lab_older": create_older_lab_show,
    "studio": create_studio_show,
}
"""Functions that return the files of a show, by kind."""


def replace_value(files, name, path, value):
    files = copy.deepcopy(files)
    holder = files[name]
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    return files
