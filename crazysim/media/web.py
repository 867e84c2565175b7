"""Recorded flights in a browser: a self-contained page with playback controls."""

from __future__ import annotations

import contextlib
import http.server
import io
import socket
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_arguments
from crazysim.errors import ConfigError, RenderError, address_message, optional_import
from crazysim.media.access import LOOPBACK_ADDRESSES, Access, is_own_name, start_guarded_server, wrong_name_message
from crazysim.media.browser_scene import BrowserScene, rgb
from crazysim.media.flight import Flight
from crazysim.media.picture import Picture, light_spheres, setpoint_spheres
from crazysim.media.trail import choose_drone_colors

FPS = 30
"""Samples per second of a page."""
FOV = 50.0
"""Initial vertical field of view, degrees."""

CAPTION_HEIGHT = 0.35
"""Height of a caption above the middle of the flight, as a multiple of the distance of the camera."""


@check_arguments
def page(
    flight: Flight,
    world: int | None = None,
    lights: ArrayLike | None = None,
    caption: Callable[[float], str] | None = None,
) -> str:
    """Make an HTML page of one world of a flight with drones, obstacles, setpoints and trails.

    The page contains the viewer and the flight, so that it can be opened as a file, without server or network.

    Args:
        world: Index of the world in the simulation; None for the first recorded world.
        lights: Colour of the light on each drone at each of the flight's times, 0 to 1; None for no lights.
            (n, n_drones, 3)
        caption: Function from a time, s, to a text above the scene; None for no text.

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
            return _record_scene(server, flight, k, lights, caption).as_html()
        finally:
            server.stop()


def create_server(html: str, port: int, host: str = "127.0.0.1") -> http.server.ThreadingHTTPServer:
    """Return a server of one page; ``serve_forever`` starts it.

    Args:
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


def _record_scene(
    server: Any, flight: Flight, k: int, lights: NDArray | None, caption: Callable[[float], str] | None
) -> Any:
    scene = server.scene
    scene.set_up_direction("+z")
    camera, (camera_pos, middle) = server.initial_camera, initial_camera_pose(flight, k)
    camera.fov, camera.position, camera.look_at = np.deg2rad(FOV), camera_pos, middle

    colors = choose_drone_colors(flight.n_drones, None)
    for drone in range(flight.n_drones):
        path = flight.pos[:, k, drone]
        path = path[np.isfinite(path).all(-1)]
        if len(path) > 1:
            segments = np.stack([path[:-1], path[1:]], axis=1).astype(np.float32)
            scene.add_line_segments(
                f"/trails/{drone}", segments, rgb(colors[drone]), thickness=1.5, thickness_units="screen"
            )
    end = float(flight.time[-1])
    times = np.linspace(0, end, int(np.ceil(FPS * end)) + 1)  # viser does not interpolate
    pictures = (_take_picture(flight, k, float(time), lights, colors) for time in times)
    browser_scene = BrowserScene(server, list(flight.shapes), next(pictures))
    if caption is not None:
        above = middle + CAPTION_HEIGHT * np.array([0.0, 0.0, np.linalg.norm(camera_pos - middle)])
        label = scene.add_label("/caption", caption(0.0), position=above, anchor="bottom-center")
    recording = server.get_scene_serializer()
    for picture, duration in zip(pictures, np.diff(times), strict=True):
        recording.insert_sleep(float(duration))
        browser_scene.update(picture)
        if caption is not None:
            label.text = caption(picture.time)
    return recording


def _take_picture(flight: Flight, k: int, time: float, lights: NDArray | None, colors: NDArray) -> Picture:
    poses, ids = flight.at(time), np.concatenate([flight.drone_ids, flight.body_ids])
    pos, quat = (np.zeros((1, len(ids), n)) for n in (3, 4))
    pos[0, ids] = np.concatenate([poses["pos"][k], poses["body_pos"][k]])
    quat[0, ids] = np.concatenate([poses["quat"][k], poses["body_quat"][k]])
    drone_pos = poses["pos"][k][None]
    if lights is None:
        led_colors = np.zeros((1, flight.n_drones, 3))
    else:
        led_colors = lights[None, min(int(np.searchsorted(flight.time, time)), len(lights) - 1)]
    spheres = {
        "setpoints": setpoint_spheres(poses["setpoint"][k][None], colors),
        "lights": light_spheres(drone_pos, led_colors),
    }
    return Picture(flight.worlds[k, None], time, pos, quat, spheres, led_colors)


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
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
