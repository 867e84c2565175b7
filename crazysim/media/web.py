"""Recorded flights in a browser: a self-contained page with playback controls."""

from __future__ import annotations

import contextlib
import http.server
import io
import socket
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_arguments
from crazysim.errors import ConfigError, RenderError, address_message, optional_import
from crazysim.media.access import LOOPBACK_ADDRESSES, Access, is_own_name, start_guarded_server, wrong_name_message
from crazysim.media.flight import Flight
from crazysim.media.trail import choose_drone_colors
from crazysim.scene.visual_geoms import VisualGeom
from crazysim.storage import check_writable, write_file

FPS = 30
"""Samples per second of a page."""
PLANE_HALF_SIZE = 20.0
"""Half size of infinite planes, m."""
LIGHT_RADIUS = 0.03
"""Radius of a light, m."""
FOV = 50.0
"""Initial vertical field of view, degrees."""


@check_arguments
def page(flight: Flight, world: int | None = None, lights: ArrayLike | None = None) -> str:
    """Return one world of a flight as an HTML page with drones, obstacles, setpoints and trails.

    The page contains the viewer and the flight, so that it can be opened as a file, without server or network.

    Args:
        flight: Flight.
        world: Index of the world in the simulation; None for the first recorded world.
        lights: Colour of the light on each drone at each of the flight's times, 0 to 1; None for no lights.
            (n, n_drones, 3)

    Raises:
        ImportError: If viser is not installed.
    """
    k = 0 if world is None else flight.index(world)
    lights, shape = None if lights is None else np.asarray(lights), (len(flight.time), flight.n_drones, 3)
    if lights is not None and lights.shape != shape:
        raise ConfigError(f"expected lights of shape {shape} = (n, n_drones, 3), got {lights.shape}")
    viser = import_viser()
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints the address of this temporary server
        server = start_guarded_server(viser, Access("127.0.0.1", free_port()))
        try:
            return _record_scene(server, flight, k, lights).as_html()
        finally:
            server.stop()


@check_arguments
def export(flight: Flight, path: str | Path, world: int | None = None) -> None:
    """Write ``page`` to a file.

    Raises:
        ConfigError: If the world was not recorded, the folder does not exist, or the name has another suffix.
        ImportError: If viser is not installed.
    """
    check_writable(path, (".html",))
    write_file(path, page(flight, world))


def create_server(html: str, port: int, host: str = "127.0.0.1") -> http.server.ThreadingHTTPServer:
    """Return a server of one page; ``serve_forever`` starts it.

    Args:
        html: Page.
        port: Port; 0 for any free port.
        host: Address to listen at; ``0.0.0.0`` for every network.

    Raises:
        RenderError: If the server cannot listen at the address.
    """
    content = html.encode()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            name = self.headers.get("Host", "")
            if not is_own_name(name, host):
                self.send_error(403, explain=wrong_name_message(name))
                return
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: Any) -> None:
            pass

    try:
        return http.server.ThreadingHTTPServer((host, port), Handler)
    except (OSError, OverflowError) as error:
        raise RenderError(address_message(host, port, error, "--")) from error


def initial_camera_pose(flight: Flight, k: int) -> tuple[NDArray, NDArray]:
    """Return the initial position of a page's camera, and the point that it looks at, m. (3,), (3,)

    The camera shows the whole flight of the k-th world.
    """
    points = flight.pos[:, k].reshape(-1, 3)
    points = points[np.isfinite(points).all(-1)]
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(3), np.ones(3))
    middle, extent = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.5)
    return middle + extent * np.array([0.0, -1.1, 0.7]), middle


def serve(flight: Flight, world: int | None = None, port: int = 8080, host: str = "127.0.0.1") -> None:
    """Serve a flight at a port until interrupted.

    Raises:
        ImportError: If viser is not installed.
        RenderError: If the server cannot listen at the address.
    """
    serve_page(page(flight, world), port, host)


def serve_page(html: str, port: int = 8080, host: str = "127.0.0.1") -> None:
    """Serve a page of a flight at a port until interrupted.

    Raises:
        RenderError: If the server cannot listen at the address.
    """
    with create_server(html, port, host) as server:
        print(f"serving the flight at http://{host}:{server.server_port}; stop with Ctrl-C", flush=True)
        if host not in LOOPBACK_ADDRESSES:
            print("every machine of that network can watch", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


def _record_scene(server: Any, flight: Flight, k: int, lights: NDArray | None) -> Any:
    scene = server.scene
    scene.set_up_direction("+z")
    camera = server.initial_camera
    camera.fov, (camera.position, camera.look_at) = np.deg2rad(FOV), initial_camera_pose(flight, k)

    frames = {
        int(mocap): scene.add_frame(f"/bodies/{mocap}", show_axes=False)
        for mocap in (*flight.drone_ids, *flight.body_ids)
    }
    shapes_by_color: dict[tuple[int, tuple], list[VisualGeom]] = defaultdict(list)
    for shape in flight.shapes:
        shapes_by_color[shape.mocap, tuple(np.round(shape.rgba, 3))].append(shape)
    for i, ((mocap, rgba), shapes) in enumerate(shapes_by_color.items()):
        parent = f"/bodies/{mocap}" if mocap in frames else "/scene"
        add_geoms(scene, f"{parent}/{i}", shapes, rgba)

    colors = choose_drone_colors(flight.n_drones, None)
    for drone in range(flight.n_drones):
        path = flight.pos[:, k, drone]
        path = path[np.isfinite(path).all(-1)]
        if len(path) > 1:
            segments = np.stack([path[:-1], path[1:]], axis=1).astype(np.float32)
            scene.add_line_segments(
                f"/trails/{drone}", segments, rgb(colors[drone]), thickness=1.5, thickness_units="screen"
            )
    setpoint_balls = [
        scene.add_icosphere(f"/setpoints/{drone}", radius=0.02, color=rgb(colors[drone]))
        for drone in range(flight.setpoint.shape[2])
    ]

    light_balls = [
        scene.add_icosphere(f"/bodies/{mocap}/light", radius=LIGHT_RADIUS, color=rgb(color), opacity=0.8)
        for mocap, color in zip(flight.drone_ids, [] if lights is None else lights[0], strict=False)
    ]

    recording = server.get_scene_serializer()
    end = float(flight.time[-1])
    times = np.linspace(0, end, int(np.ceil(FPS * end)) + 1)  # viser does not interpolate
    last_values: dict[Any, NDArray] = {}
    light_colors: dict[str, tuple[int, int, int]] = {}

    def move_handle(handle: Any, pos: NDArray, quat: NDArray | None = None) -> None:
        pose = np.concatenate([pos, [] if quat is None else np.roll(quat, 1)])
        if not np.isfinite(pose).all() or np.array_equal(last_values.get(handle.name, np.inf), pose):
            return  # unchanged poses are not sent again, and non-finite poses are never sent
        last_values[handle.name] = pose
        handle.position = pose[:3]
        if quat is not None:
            handle.wxyz = pose[3:]

    for i, time in enumerate(times):
        if i:
            recording.insert_sleep(float(time - times[i - 1]))
        flight_poses = flight.at(float(time))
        for ids, pos, quat in (
            (flight.drone_ids, flight_poses["pos"][k], flight_poses["quat"][k]),
            (flight.body_ids, flight_poses["body_pos"][k], flight_poses["body_quat"][k]),
        ):
            for mocap, p, q in zip(ids, pos, quat, strict=True):
                move_handle(frames[int(mocap)], p, q)
        for setpoint_ball, p in zip(setpoint_balls, flight_poses["setpoint"][k], strict=True):
            move_handle(setpoint_ball, p)
        if lights is not None:
            colors = lights[min(int(np.searchsorted(flight.time, time)), len(lights) - 1)]
            for light_ball, color in zip(light_balls, colors, strict=True):
                if (value := rgb(color)) != light_colors.get(light_ball.name):
                    light_colors[light_ball.name] = light_ball.color = value
    return recording


def add_geoms(scene: Any, name: str, shapes: list[VisualGeom], rgba: tuple) -> None:
    """Add the geoms of one body and colour to a viser scene: each plane as a grid, all other geoms as one mesh."""
    solid_shapes = [shape for shape in shapes if shape.kind != "plane"]
    for i, shape in enumerate(shape for shape in shapes if shape.kind == "plane"):
        width, height = (2 * PLANE_HALF_SIZE if size == 0 else 2 * float(size) for size in shape.size[:2])
        scene.add_grid(
            f"{name}/plane{i}", width, height, cell_size=1.0, cell_color=rgb(rgba, 0.9), section_size=5.0,
            section_color=rgb(rgba, 0.8), plane_color=rgb(rgba), plane_opacity=float(rgba[3]),
            infinite_grid=not shape.size[:2].any(), fade_distance=2 * PLANE_HALF_SIZE,
            position=shape.pos, wxyz=np.roll(shape.quat, 1),
        )  # fmt: skip
    if solid_shapes:
        mesh = create_mesh(solid_shapes)
        scene.add_mesh_simple(
            name,
            np.asarray(mesh.vertices, np.float32),
            np.asarray(mesh.faces, np.uint32),
            color=rgb(rgba),
            opacity=None if rgba[3] >= 1 else float(rgba[3]),
            flat_shading=True,
            side="double",
        )


def create_mesh(shapes: list[VisualGeom]) -> Any:
    """Return the geoms of one body, except planes, as one trimesh mesh in the body's frame."""
    import trimesh

    meshes = []
    for shape in shapes:
        if shape.kind == "plane":
            continue
        pose = np.eye(4)
        pose[:3, :3] = trimesh.transformations.quaternion_matrix(np.roll(shape.quat, 1))[:3, :3]
        pose[:3, 3] = shape.pos
        meshes.append(_create_geom_mesh(shape).apply_transform(pose))
    return trimesh.util.concatenate(meshes)


def _create_geom_mesh(shape: VisualGeom) -> Any:
    import trimesh

    radius, half = float(shape.size[0]), float(shape.size[1])
    if shape.kind == "box":
        return trimesh.creation.box(extents=2 * shape.size)
    if shape.kind == "cylinder":
        return trimesh.creation.cylinder(radius=radius, height=2 * half, sections=24)
    if shape.kind == "capsule":
        return trimesh.creation.capsule(radius=radius, height=2 * half, count=[12, 12])
    if shape.kind == "mesh":
        return trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    mesh = trimesh.creation.icosphere(subdivisions=2)
    return mesh.apply_scale(shape.size if shape.kind == "ellipsoid" else radius)


def rgb(rgba: Any, brightness: float = 1.0) -> tuple[int, int, int]:
    """Return red, green and blue from 0 to 255 of a colour from 0 to 1, multiplied by ``brightness``."""
    r, g, b = (round(255 * brightness * float(np.clip(channel, 0, 1))) for channel in rgba[:3])
    return r, g, b


def import_viser() -> Any:
    """Return the module ``viser``.

    Raises:
        ImportError: If viser is not installed.
    """
    with optional_import("pages need", "viser", "web"):
        import viser
    return viser


def require_free_port(host: str, port: int, prefix: str = "") -> int:
    """Return ``port`` if it is free, and any free port for 0; viser itself would silently use another port.

    Args:
        host: Host of the address.
        port: Port of the address.
        prefix: Text before the name of the setting, for the message.

    Raises:
        RenderError: If the port is in use or does not exist.
    """
    if port == 0:
        return free_port()
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            probe.listen()
    except (OSError, OverflowError) as error:
        raise RenderError(address_message(host, port, error, prefix)) from error
    return port


def free_port() -> int:
    """Return the number of a free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
