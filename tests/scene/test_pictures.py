"""Pictures show what they should: checked by what is in them, not by their shape."""

import numpy as np
import pytest

from crazysim import Sim
from crazysim.scene.render import RenderError
from crazysim.sim.visualize import change_material, draw_capsule, draw_line, draw_points

DOWN = {"lookat": [0, 0, 0], "distance": 3.0, "azimuth": 90, "elevation": -90}
SIZE = {"width": 320, "height": 240}


@pytest.fixture(scope="module")
def sim(opengl):
    """Two worlds: in the first the drone is at the origin, in the second 0.6 m to the side, both at 0.5 m."""
    sim = Sim(n_worlds=2, n_drones=1)
    pos = np.array([[[0, 0, 0.5]], [[0.6, 0, 0.5]]], np.float32)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    yield sim
    sim.close()


def picture(sim, **kwargs):
    return sim.render("rgb_array", **({"cam_config": DOWN} | SIZE | kwargs)).astype(int)


def dark(image):
    """Return the centre of the dark pixels, which on this floor are a drone and its shadow, in pixels (x, y)."""
    rows, columns = np.nonzero(image.sum(axis=2) < 330)
    return np.array([columns.mean(), rows.mean()])


def test_the_world_that_is_asked_for_is_shown(sim):
    """Seen from above with x to the right, the second world's drone is right of the first's."""
    first, second = dark(picture(sim, world=0)), dark(picture(sim, world=1))
    np.testing.assert_allclose(first, [160, 120], atol=12)
    # 0.6 m at a distance of 2.5 m with 50 degrees over 240 pixels: 0.6 / 2.5 * 120 / tan(25 deg) = 62 pixels
    np.testing.assert_allclose(second - first, [62, 0], atol=12)


def test_only_the_drawn_world_is_synced(sim):
    picture(sim)
    assert sim._mjx_data is None


def test_fault_12_every_argument_counts_at_every_call(sim):
    """The peer keeps camera and size of the first call for all others."""
    above = picture(sim)
    assert picture(sim, width=64, height=48).shape == (48, 64, 3)
    aside = picture(sim, cam_config=DOWN | {"elevation": -10})
    assert np.mean(np.abs(above - aside)) > 5
    by_name, by_id = picture(sim, camera="fpv_cam:0"), picture(sim, camera=1)
    np.testing.assert_array_equal(by_name, by_id)
    assert np.mean(np.abs(by_name - above)) > 5
    np.testing.assert_array_equal(picture(sim), above)


def test_depth_is_metres_to_the_floor(sim):
    """Looking straight down from 3 m the floor is 3 m away in every corner: depth is along the camera's axis."""
    color, depth = sim.render("rgbd_tuple", cam_config=DOWN, **SIZE)
    assert color.dtype == np.uint8
    corners = depth[[0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_allclose(corners, 3.0, atol=0.01)  # 24 bits of depth between 1.5 cm and 180 m
    assert 2.4 < depth.min() < 2.52  # the drone, 0.5 m up
    np.testing.assert_array_equal(depth, sim.render("depth_array", cam_config=DOWN, **SIZE))


def test_the_first_person_camera_sees_the_sky_above_the_floor(sim):
    view = picture(sim, camera="fpv_cam:0")
    top, bottom = view[60:100, 140:180].mean(axis=(0, 1)), view[-20:, 140:180].mean(axis=(0, 1))
    assert top[2] - top[0] > 20, "the sky is blue"
    assert abs(bottom[2] - bottom[0]) < 20, "the floor is grey"


def test_marks_are_drawn_where_they_are_told_and_once(sim):
    """A blue line from left to right, a red point and a green capsule; the next picture is without them."""
    plain = picture(sim)
    draw_line(sim, [[-1, 0.5, 0.2], [1, 0.5, 0.2]], rgba=[0, 0, 1, 1], start_size=6, end_size=6)
    draw_points(sim, [[-0.6, -0.5, 0.2]], size=0.05)
    draw_capsule(sim, [0.6, -0.6, 0.2], [0.6, -0.4, 0.2], radius=0.05, rgba=[0, 1, 0, 1])
    marked = picture(sim)
    changed = np.abs(marked - plain).sum(axis=2) > 60

    def centre(channel):
        others = [c for c in range(3) if c != channel]
        rows, columns = np.nonzero(changed & (marked[..., channel] > marked[..., others].max(axis=-1) + 40))
        assert len(rows) > 20
        return np.array([columns.mean(), rows.mean()])

    metre = 120 / np.tan(np.radians(25)) / 2.8  # pixels a metre, 2.8 m below the camera
    np.testing.assert_allclose(centre(2), [160, 120 - 0.5 * metre], atol=8)
    np.testing.assert_allclose(centre(0), [160 - 0.6 * metre, 120 + 0.5 * metre], atol=8)
    np.testing.assert_allclose(centre(1), [160 + 0.6 * metre, 120 + 0.5 * metre], atol=8)
    np.testing.assert_array_equal(picture(sim), plain)


def test_an_led_is_of_one_drone(opengl):
    """Two drones; the second's LED turns green, the first keeps its looks."""
    sim = Sim(n_drones=2)
    sim.data = sim.data.replace(
        states=sim.data.states.replace(pos=np.array([[[-0.3, 0, 0.5], [0.3, 0, 0.5]]], np.float32))
    )
    close = {"cam_config": DOWN | {"distance": 1.3}}
    before = picture(sim, **close)
    change_material(sim, "led_top", [1], rgba=[0, 1, 0, 1], emission=1.0)
    change = np.abs(picture(sim, **close) - before).sum(axis=2)
    sim.close()
    assert change[:, 160:].max() > 100
    assert change[:, :160].max() < 30


@pytest.mark.parametrize(
    "wrong",
    [{"mode": "ascii"}, {"world": 2}, {"world": -1}, {"camera": "nobody"}, {"camera": 99}, {"width": 0},
     {"cam_config": {"zoom": 3}}],
)  # fmt: skip
def test_wrong_input_is_told(sim, wrong):
    with pytest.raises(ValueError, match=r"[a-z]"):
        sim.render(**({"mode": "rgb_array"} | wrong))


def test_without_a_screen_a_window_is_refused_in_one_line(sim, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RenderError) as error:
        sim.render("human")
    assert "\n" not in str(error.value)


def test_too_many_marks_are_refused(sim):
    with pytest.raises(ValueError, match="marks"):
        draw_points(sim, np.zeros((sim.max_visual_geom + 1, 3)))
    sim.marks.clear()
