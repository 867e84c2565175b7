"""Overlays: drawn with their colours at their positions, in one image only."""

import numpy as np
import pytest
from cases import CAMERA_HEIGHT, FOVY
from pictures import has_colour

from crazysim.sim import Sim
from crazysim.sim.visualize import (
    change_material,
    draw_capsule,
    draw_label,
    draw_line,
    draw_points,
    draw_setpoints,
    draw_text,
)

HEIGHT, WIDTH = 180, 240
FOCAL = 0.5 * HEIGHT / np.tan(np.deg2rad(FOVY / 2))
"""Focal length of the camera, pixels."""
DRONES = np.array([[0.3, 0.0, 1.4], [-0.3, 0.0, 1.4]])
"""Positions of the drones, m."""
RED, GREEN, BLUE = ([1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1])


@pytest.fixture(scope="module")
def sim(opengl, plain_scene):
    sim = Sim(n_worlds=2, n_drones=2, xml_path=plain_scene)
    pos = np.tile(np.float32(DRONES), (2, 1, 1))
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    yield sim
    sim.close()


def take_picture(sim, **options):
    picture = sim.render(**{"mode": "rgb_array", "camera": "down", "width": WIDTH, "height": HEIGHT} | options)
    return picture.astype(int)


def positions_of_pixels(mask):
    """Return metres east and north of the camera of a mask's pixels, for points one metre below it."""
    rows, columns = np.nonzero(mask)
    return (columns + 0.5 - 0.5 * WIDTH) / FOCAL, (0.5 * HEIGHT - rows - 0.5) / FOCAL


def test_points_are_spheres_of_their_radius(sim):
    """Two green points are discs of their radii at their positions, and absent from the next image."""
    plain = take_picture(sim)
    draw_points(sim, [[0.0, 0.2, 1.0], [0.0, -0.3, 1.0]], rgba=GREEN, size=0.05)
    marked = take_picture(sim)
    x, y = positions_of_pixels(has_colour(marked, GREEN))  # one metre below the camera
    for north in (0.2, -0.3):
        near = np.sign(y) == np.sign(north)
        np.testing.assert_allclose([x[near].mean(), y[near].mean()], [0, north], atol=0.01)
        area = near.sum() / FOCAL**2
        np.testing.assert_allclose(area, np.pi * 0.05**2, rtol=0.15)
    np.testing.assert_array_equal(take_picture(sim), plain)


def test_a_line_goes_through_its_points(sim):
    """Blue along an L: every pixel lies on one of its two legs, and both legs are covered end to end."""
    draw_line(sim, [[-0.4, -0.3, 1.0], [0.4, -0.3, 1.0], [0.4, 0.3, 1.0]], rgba=BLUE, start_size=3, end_size=3)
    x, y = positions_of_pixels(has_colour(take_picture(sim), BLUE))
    first, second = np.abs(y + 0.3) < 2 / FOCAL, np.abs(x - 0.4) < 2 / FOCAL
    assert (first | second).all()
    np.testing.assert_allclose([x[first].min(), x[first].max()], [-0.4, 0.4], atol=0.02)
    np.testing.assert_allclose([y[second].min(), y[second].max()], [-0.3, 0.3], atol=0.02)


@pytest.mark.parametrize("cylinder", [False, True])
def test_a_capsule_reaches_from_end_to_end(sim, cylinder):
    """A capsule is longer by its round ends than a cylinder; both are as wide as twice their radius."""
    draw_capsule(sim, [-0.2, 0.3, 1.0], [0.3, 0.3, 1.0], radius=0.06, rgba=BLUE, cylinder=cylinder)
    x, y = positions_of_pixels(has_colour(take_picture(sim), BLUE))
    end = 0.0 if cylinder else 0.06
    np.testing.assert_allclose([x.min(), x.max()], [-0.2 - end, 0.3 + end], atol=0.02)
    np.testing.assert_allclose([y.min(), y.max()], [0.24, 0.36], atol=0.02)


def test_overlays_are_kept_through_steps_and_failed_images(sim):
    """Overlays appear in the next image that succeeds."""
    data = sim.data
    draw_points(sim, [[0.0, 0.4, 1.0]], rgba=GREEN, size=0.05)
    sim.step()
    with pytest.raises(ValueError):
        take_picture(sim, camera="nobody")
    assert has_colour(take_picture(sim), GREEN).any()
    sim.data = data


# Text and setpoints ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("corner", ["top left", "top right", "bottom left", "bottom right"])
def test_text_is_in_its_corner_and_nowhere_else(sim, corner):
    """Two lines, written one after the other, change pixels of one corner only, some of them to bright letters."""
    plain = take_picture(sim)
    draw_text(sim, "height", corner)
    draw_text(sim, "1.4 m", corner)
    written = take_picture(sim)
    rows, columns = np.nonzero((written != plain).any(-1))
    down, right = corner.startswith("bottom"), corner.endswith("right")
    assert (rows > HEIGHT / 2).all() == down
    assert (rows < HEIGHT / 2).all() != down
    assert (columns > WIDTH / 2).all() == right
    assert (columns < WIDTH / 2).all() != right
    assert 24 < np.ptp(rows) < 60, "two lines of 10 to 20 pixels"
    letters = written[rows.min() : rows.max(), columns.min() : columns.max()].min(-1) > 230
    assert 30 < letters.sum() < 0.4 * letters.size
    np.testing.assert_array_equal(take_picture(sim), plain)


def test_text_is_in_the_colours_and_not_in_the_depth(sim):
    plain = sim.render("depth_array", camera="down", width=WIDTH, height=HEIGHT)
    draw_text(sim, "depth")
    color, depth = sim.render("rgbd_tuple", camera="down", width=WIDTH, height=HEIGHT)
    assert (color[:40, :80].min(-1) > 230).sum() > 20
    np.testing.assert_array_equal(depth, plain)


def test_a_label_stands_at_its_point(sim):
    """Letters begin at the point, anywhere in the image, and are bright on a dark outline."""
    plain = take_picture(sim)
    for east, north in ((-0.3, 0.3), (0.2, -0.2)):
        draw_label(sim, [east, north, 1.0], "gate 3")
        x, y = positions_of_pixels((take_picture(sim) != plain).any(-1))
        assert len(x) > 100
        assert abs(y.mean() - north) < 0.05
        assert abs(x.mean() - east) < 0.2
    np.testing.assert_array_equal(take_picture(sim), plain)


def test_a_line_may_change_its_colour(sim):
    """Each piece has its own colour: the first green, the second blue."""
    draw_line(sim, [[-0.4, 0.3, 1], [0, 0.3, 1], [0.4, 0.3, 1]], rgba=[GREEN, BLUE])
    picture = take_picture(sim)
    (green, _), (blue, _) = (
        positions_of_pixels(has_colour(picture, GREEN)),
        positions_of_pixels(has_colour(picture, BLUE)),
    )
    np.testing.assert_allclose([green.min(), green.max()], [-0.4, 0], atol=0.02)
    np.testing.assert_allclose([blue.min(), blue.max()], [0, 0.4], atol=0.02)


def test_setpoints_are_where_the_last_command_of_a_world_is(opengl, plain_scene):
    sim = Sim(n_worlds=2, n_drones=2, control="state", xml_path=plain_scene)
    command = np.zeros((2, 2, 16))
    command[..., 12] = 1
    command[1, :, :3] = [[0.2, 0.3, 1.0], [-0.2, -0.3, 1.0]]
    sim.state_control(command)
    draw_setpoints(sim, world=1, rgba=[GREEN, BLUE], size=0.05)
    picture = take_picture(sim, world=1)
    for rgba, (east, north, _) in zip((GREEN, BLUE), command[1, :, :3], strict=True):
        x, y = positions_of_pixels(has_colour(picture, rgba))
        np.testing.assert_allclose([x.mean(), y.mean()], [east, north], atol=0.01)
        np.testing.assert_allclose(len(x) / FOCAL**2, np.pi * 0.05**2, rtol=0.15)
    with pytest.raises(ValueError, match="expected a world from 0 to 1, got 2"):
        draw_setpoints(sim, world=2)
    sim.close()


# LEDs -----------------------------------------------------------------------------------------------------------


def test_an_led_lights_up_on_its_drone_only(sim):
    """Drone 1's upper LED turns red: pixels change at drone 1, none elsewhere; then it glows brighter."""
    before = take_picture(sim)
    change_material(sim, "led_top", [1], rgba=RED)
    dull = take_picture(sim)
    change_material(sim, "led_top", [1], emission=1.0)
    bright = take_picture(sim)
    change_material(sim, "led_top", [0, 1], rgba=[1, 1, 1, 0.15], emission=0.0)
    x, y = positions_of_pixels(np.abs(dull - before).sum(-1) > 30)
    assert len(x) > 3
    distance = CAMERA_HEIGHT - DRONES[1, 2]
    assert np.hypot(x * distance - DRONES[1, 0], y * distance - DRONES[1, 1]).max() < 0.02
    lit = has_colour(bright, RED)
    assert lit.any()
    assert bright[lit][:, 0].mean() > dull[lit][:, 0].mean() + 10
    np.testing.assert_array_equal(take_picture(sim), before)


def test_as_many_overlays_as_allowed_fit_into_an_image(sim):
    """Bodies of the scene do not count towards the limit."""
    limit = sim.max_visual_geom
    try:
        sim.max_visual_geom = 200
        xy = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 20), np.linspace(-0.35, 0.35, 10)), -1).reshape(-1, 2)
        draw_points(sim, np.concatenate([xy, np.ones((200, 1))], 1), rgba=GREEN, size=0.01)
        picture = take_picture(sim)
        columns = [int(0.5 * WIDTH + FOCAL * x) for x in xy[:, 0]]
        rows = [int(0.5 * HEIGHT - FOCAL * y) for y in xy[:, 1]]
        assert has_colour(picture, GREEN)[rows, columns].mean() > 0.9  # a few are hidden by the drones above them
    finally:
        sim.max_visual_geom = limit
