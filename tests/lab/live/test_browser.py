"""A live simulation in a real browser: pictures, clicks, piloting, and browsers that disconnect."""

import logging
import socket
import threading
import time
from http.client import HTTPConnection
from urllib.parse import urlsplit

import numpy as np
import pytest
from browsing import MAX_PIXEL_DISTANCE
from waiting import wait_for

from crazysim import SlungLoad, Wind
from crazysim.errors import ConfigError, RenderError
from crazysim.lab.live import Browser, Live, Pilot
from crazysim.lab.live.picture import PictureSource, list_quantities, read_quantity
from crazysim.media.browser_scene import grid_offsets
from crazysim.media.web import FOV
from crazysim.plugins.vehicles import Cars
from crazysim.sim import Sim

MAGENTA = (1, 0, 1)


@pytest.fixture(scope="module")
def sim(plain_scene):
    """Return a simulation of two magenta drones that hover at 1 m, 2 m apart."""
    sim = Sim(n_drones=2, control="state", xml_path=plain_scene)
    sim.mj_model.mat_rgba[:] = [1, 0, 1, 1]
    pos = np.array([[[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]]])
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    sim.build_default_data()
    return sim


@pytest.fixture
def live(sim):
    """Return a paused loop without a viewer."""
    sim.reset()
    live = Live(sim, fps=10)  # the browser of the tests draws without a GPU
    live.command[..., 2] = 1.0
    live.selected = None
    live.paused = True
    return live


class LoopThread:
    """A loop that runs in a thread while a test uses the page."""

    def __init__(self, live):
        self.live, self._thread = live, threading.Thread(target=live.run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.live.post(lambda live: live.stop())
        self._thread.join(300)
        self.live.close()


def project_point(chromium, point, size):
    """Return column and row of a point as the page's camera shows it at first, for worlds of a size, m."""
    position, target = np.array([0.0, -0.9 * size, 0.6 * size + 0.5]), np.array([0, 0, 0.5])
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    left, top, width, height = chromium.box("canvas")
    focal = 0.5 * height / np.tan(np.deg2rad(FOV / 2))
    x, y, z = (np.asarray(point) - position) @ np.stack([right, np.cross(right, ahead), ahead]).T
    return np.array([left + 0.5 * width + focal * x / z, top + 0.5 * height - focal * y / z])


def click(chromium, pixel_pos):
    mouse = {"x": float(pixel_pos[0]), "y": float(pixel_pos[1]), "button": "left", "clickCount": 1}
    chromium.call("Input.dispatchMouseEvent", type="mouseMoved", x=mouse["x"], y=mouse["y"])
    for event in ("mousePressed", "mouseReleased"):
        chromium.call("Input.dispatchMouseEvent", type=event, **mouse)


def press(chromium, text):
    """Wait for the button with a text, and press it."""
    find = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === {text!r})"
    wait_for(lambda: chromium.value(f"!!{find}"))
    chromium.value(f"{find}.click()")


SIZE = 4.0
"""Extent of the worlds of these tests, m: 2 m between the drones, and 1 m of margin on both sides."""


MARKUP = "<img src=x onerror='window.hit = 1'> **bold** [link](javascript:alert())"
"""A name that a page must show as plain text."""


def test_a_page_shows_the_simulation_and_commands_it(chromium, live, caplog):
    pilot, clicked, values = Pilot(), [], []
    live.add(pilot)
    live.on_click = lambda live, world, point: clicked.append((world, point))
    live.button("Shoot", lambda live: values.append("shot"))
    live.slider(f"slider {MARKUP}", 0.0, 10.0, 5.0, lambda live, value: values.append(value))
    live.quantities[f"quantity {MARKUP}"] = lambda live: 1.0
    page = live.show(Browser(port=0, trail=0.5, plot=f"quantity {MARKUP}"))
    with LoopThread(live):
        chromium.open(page.url, 1100, 360)
        wait_for(lambda: page.n_clients == 1 and chromium.box("canvas"))

        # The left drone is drawn at its position.
        live.post(lambda live: live.select(0, 0))
        left, right = project_point(chromium, [-1, 0, 1], SIZE), project_point(chromium, [1, 0, 1], SIZE)
        wait_for(lambda: len(chromium.mask(MAGENTA)[0]) > 40)
        columns = np.sort(chromium.mask(MAGENTA)[1])
        assert abs(columns[0] - left[0]) < 4 * MAX_PIXEL_DISTANCE
        np.testing.assert_allclose(columns[-1], right[0], atol=4 * MAX_PIXEL_DISTANCE)

        # A click on the right drone selects it; a click on the ground is reported in the world's frame.
        wait_for(lambda: (click(chromium, right), time.sleep(0.3), live.selected == (0, 1))[-1])
        click(chromium, project_point(chromium, [-0.5, -1.0, 0.0], SIZE))
        wait_for(lambda: clicked)
        assert clicked[0][0] == 0
        np.testing.assert_allclose(clicked[0][1], [-0.5, -1.0, 0.0], atol=0.05)

        # Buttons: single steps, events, pause, reset.
        initial_step = live.step
        press(chromium, "step")
        wait_for(lambda: live.step == initial_step + 1)
        press(chromium, "Shoot")
        wait_for(lambda: values == ["shot"])
        press(chromium, "pause")
        wait_for(lambda: live.step > 50)
        text = "document.body.innerText"
        wait_for(lambda: "real time" in chromium.value(text) and "paused" not in chromium.value(text))

        # Names are text, in labels and in the title of the plot.
        wait_for(lambda: f"slider {MARKUP}" in chromium.value(text) and f"quantity {MARKUP}" in chromium.value(text))
        assert chromium.value("!window.hit && !document.querySelector('img[src=x]')")

        # A key of the page flies the selected drone, upwards.
        last_height = float(live.command[0, 1, 2])
        for kind in ("keyDown", "keyUp"):
            chromium.call("Input.dispatchKeyEvent", type=kind, key="w", code="KeyW", windowsVirtualKeyCode=87)
        wait_for(lambda: live.command[0, 1, 2] > last_height + 0.05)
        press(chromium, "pause")
        wait_for(lambda: live.paused)

        # The browser disconnects, which is reported, and connects again; the loop continues.
        with caplog.at_level(logging.INFO):
            chromium.call("Page.navigate", url="about:blank")
            wait_for(lambda: page.n_clients == 0 and "disconnected" in caplog.text)
        assert f"browser 0 disconnected at {live.time:.2f} s" in caplog.text
        last_step = live.step
        live.post(lambda live: live.advance(5))
        wait_for(lambda: live.step == last_step + 5)
        chromium.call("Page.navigate", url=page.url)
        wait_for(lambda: page.n_clients == 1 and len(chromium.mask(MAGENTA)[0]) > 40)
    assert not page.is_open


def test_cars_and_loads_are_picked_and_lights_are_drawn(chromium, plain_scene):
    """Two worlds side by side, each with a drone, its load and a car."""
    sim = Sim(n_worlds=2, control="state", xml_path=plain_scene)
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[...].set(np.array([0.0, 0.0, 1.5]))))
    load = sim.add(SlungLoad(0.005, length=0.5))
    sim.add(Cars(["Fleet1Tenth_0"], pos=(1.0, -0.5)))
    live = Live(sim, fps=10)
    live.paused = True
    page = live.show(Browser(port=0, spacing=3.0, trail=0.5))
    size = 3.0 + 2.0  # extent of the grid, m: the distance of the worlds, and a margin of 1 m on both sides
    with LoopThread(live):
        chromium.open(page.url, 1100, 360)
        wait_for(lambda: page.n_clients == 1 and chromium.box("canvas"))

        def pick(point, expected):
            pixel_pos = project_point(chromium, point, size)
            wait_for(lambda: (click(chromium, pixel_pos), time.sleep(0.3), live.followed == expected)[-1])

        pick([2.5, -0.5, 0.08], (1, "cars", 0))
        wait_for(lambda: page._scene._label.text == "Fleet1Tenth_0")
        np.testing.assert_allclose(load.read(sim.data).pos[0, 0], [0.0, 0.0, 1.0], atol=1e-6)
        pick([-1.5, 0.0, 1.0], (0, "load", 0))
        assert live.selected == (0, 0), "the drone stays selected"
        pick([1.5, 0.0, 1.5], (1, "drone", 0))
        assert live.selected == (1, 0)

        # The light of the right drone is magenta, and then off again.
        assert len(chromium.mask(MAGENTA)[0]) == 0
        live.selected = None  # without the mark around it
        live.lights[1, 0] = [1.0, 0.0, 1.0]
        pixel_pos = project_point(chromium, [1.5, 0.0, 1.5], size)
        np.testing.assert_allclose(chromium.find(MAGENTA, pixel_pos), pixel_pos, atol=MAX_PIXEL_DISTANCE)
        live.lights[:] = 0.0
        wait_for(lambda: len(chromium.mask(MAGENTA)[0]) == 0)


def test_a_port_in_use_is_named(viser, live, caplog):
    with socket.create_server(("127.0.0.1", 0)) as busy_socket:
        port = busy_socket.getsockname()[1]
        with pytest.raises(RenderError, match=f"expected a free address, got 127.0.0.1:{port}"):
            live.show(Browser(port=port))
    with pytest.raises(RenderError, match="Choose another port"):
        live.show(Browser(port=99_999))
    assert "every machine" not in caplog.text
    with caplog.at_level(logging.WARNING), live:
        live.show(Browser(port=0, host="0.0.0.0"))
    assert "listening at 0.0.0.0" in caplog.text
    assert "every machine of that network" in caplog.text


def test_closing_does_not_wait_for_unused_connections(viser, live, monkeypatch):
    """Browsers open connections in advance, and viser's ``stop`` waits until they are closed."""
    page = live.show(Browser(port=0))
    connections_closed, finished_waits = threading.Event(), []

    def stop(real=page._server.stop):
        finished_waits.append(connections_closed.wait(300))
        real()

    monkeypatch.setattr(page._server, "stop", stop)
    live.close()
    assert not finished_waits
    assert not page.is_open
    connections_closed.set()


@pytest.fixture
def page(viser, live):
    with live:
        yield live.show(Browser(port=0))


def connect(page, path=None, **headers):
    """Return a connection to a page, as its script opens it, with changed headers."""
    from websockets.sync.client import connect as open_websocket

    parts = urlsplit(page.url)
    address = f"ws://{parts.netloc}{parts.path if path is None else path}"
    origin = headers.pop("origin", f"http://{parts.netloc}")
    options = {"subprotocols": ["viser-v0"], "additional_headers": headers, "open_timeout": 300, "ping_interval": None}
    return open_websocket(address, origin=origin, **options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"origin": "http://example.org"}, "got one of 'http://example.org'"),
        ({"origin": "null"}, "got one of 'null'"),
        ({"origin": "http://127.0.0.1:1"}, "got one of 'http://127.0.0.1:1'"),
        ({"path": ""}, "address with its token"),
        ({"path": "/"}, "address with its token"),
        ({"path": "/AAAAAAAAAAAAAAAAAAAAAA"}, "address with its token"),
    ],
)
def test_a_page_of_another_site_cannot_connect(page, caplog, change, message):
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus) as refused:
        connect(page, **change)
    assert refused.value.response.status_code == 403
    assert message in refused.value.response.body.decode()
    assert message in caplog.text
    assert page.n_clients == 0


def test_the_page_and_other_programs_connect(page):
    for origin in (f"http://{urlsplit(page.url).netloc}", None):
        with connect(page, origin=origin) as connection:
            assert connection.subprotocol == "viser-v0"


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("example.org", 403),  # a name that its owner resolves to this machine
        ("127.0.0.1.example.org", 403),
        ("", 403),
        ("[::1", 403),
        ("localhost:9000", 200),  # a port that is forwarded
        ("192.168.1.5:8080", 200),
        ("[fe80::1]:8080", 200),
        (f"{socket.gethostname()}:8080", 200),
    ],
)
def test_the_page_is_served_under_names_of_this_machine(page, host, status):
    parts = urlsplit(page.url)
    connection = HTTPConnection(parts.netloc, timeout=300)
    connection.putrequest("GET", parts.path, skip_host=True)
    connection.putheader("Host", host)
    connection.endheaders()
    assert connection.getresponse().status == status
    connection.close()


def test_every_page_has_a_new_token():
    assert Browser(port=1).url != Browser(port=1).url
    assert Browser(port=1, host="0.0.0.0").url.startswith("http://127.0.0.1:1/")
    assert Browser(port=1, host="::1").url.startswith("http://[::1]:1/")


def test_wrong_settings(viser, live):
    with pytest.raises(ConfigError, match="trail of 0 or more"):
        Browser(trail=-1)
    with pytest.raises(ConfigError, match="spacing of 0 or more"):
        Browser(spacing=float("nan"))
    with pytest.raises(ConfigError, match="a world from 0 to 0, got 3"):
        live.show(Browser(port=0, worlds=[3]))


def test_worlds_stand_in_a_grid():
    np.testing.assert_allclose(grid_offsets(1, 3.0), [[0, 0, 0]])
    np.testing.assert_allclose(grid_offsets(4, 2.0), [[-1, 1, 0], [1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    assert len(np.unique(grid_offsets(7, 1.0), axis=0)) == 7


def test_a_picture_contains_all_that_viewers_draw():
    sim = Sim(n_worlds=3, n_drones=2, control="state")
    sim.scene.add("sphere", "ball", pos=[0, 0, 3])
    sim.add(Wind(velocity=(1.0, 2.0, 0.0)))
    pos = sim.data.states.pos.at[1, 0].set(np.array([0.3, 0.2, 1.0], np.float32)).at[2, :, 2].set(5.0)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    live = Live(sim)
    live.command[1, 0, :3] = [1, 2, 3]
    live._commands.stage()
    live.select(1, 0)
    live.quantities["double"] = lambda live: 2.0
    live.lights[1] = [[2.0, 0.5, 0.0], [0.0, 0.0, 0.0]]
    source = PictureSource(sim, [1, 2], contacts=True, trail=0.1)
    picture = source.take_picture(live, "states.pos")
    drone_pos = picture.pos[:, np.asarray(sim.data.core.drone_mocap_ids)]
    np.testing.assert_allclose(drone_pos[0, 0], [0.3, 0.2, 1.0], atol=1e-6)
    np.testing.assert_allclose(picture.pos[:, np.asarray(sim.data.objects.mocap_ids)], [[[0, 0, 3]]] * 2)
    np.testing.assert_allclose(picture.spheres["setpoints"].pos[0, 0], [1, 2, 3])
    np.testing.assert_allclose(picture.wind[:, :, 0], drone_pos, atol=1e-6)
    np.testing.assert_allclose(np.diff(picture.wind, axis=2), np.full((2, 2, 1, 3), [0.1, 0.2, 0]), atol=1e-6)
    contacts = picture.spheres["contacts"].is_shown
    np.testing.assert_array_equal(contacts, [[False, True], [False, False]])  # one stands on the floor
    np.testing.assert_allclose(picture.plot, [0.3, 0.2, 1.0], atol=1e-6)
    np.testing.assert_allclose(source.take_picture(live, "double").plot, [2.0])
    assert "0.00 s" in picture.status
    assert (picture.focus.shown_index, picture.focus.name) == (0, sim.drone_names[0])
    np.testing.assert_allclose(picture.focus.pos, drone_pos[0, 0], atol=1e-6)
    assert picture.spheres["followed"].is_shown.tolist() == [[True], [False]]
    np.testing.assert_allclose(picture.lights[0], [[1.0, 0.5, 0.0], [0.0, 0.0, 0.0]])
    assert picture.spheres["lights"].is_shown.tolist() == [[True, False], [False, False]]
    live.follow(2, "ball", 0)
    picture = source.take_picture(live, "states.pos")
    assert (picture.focus.shown_index, picture.focus.name) == (1, "ball")
    np.testing.assert_allclose(picture.focus.pos, [0, 0, 3])
    assert picture.selected == (1, 0)
    np.testing.assert_allclose(picture.plot, [0.3, 0.2, 1.0], atol=1e-6)  # of the selected drone
    live.select(0, 0)
    assert source.take_picture(live).focus is None, "world 0 is not shown"
    assert {"states.pos", "states.rotor_vel", "controls.state.cmd", "core.steps"} <= set(list_quantities(sim))
    np.testing.assert_allclose(read_quantity(sim.data, "states.pos", 2, 1)[2], 5.0)
    with pytest.raises(KeyError):
        read_quantity(sim.data, "states.nothing", 0, 0)


def test_quantities_of_members():
    """With two cars and two drones, scopes distinguish their leaves, although the counts are equal."""
    sim = Sim(n_drones=2, control="state")
    sim.add(Cars(["Fleet1Tenth_0", "Fleet1Tenth_1"]))
    names = list_quantities(sim)
    assert "plugins.cars.pos[1]" in names
    assert "plugins.cars.pos" not in names
    pos = np.asarray(sim.data.plugins["cars"].pos)[0, 1]
    np.testing.assert_allclose(read_quantity(sim.data, "plugins.cars.pos[1]", 0, 0), pos)
