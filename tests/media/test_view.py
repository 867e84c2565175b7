"""Views: which world is in which tile, what the camera follows, and what is drawn over the image."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from cases import CAMERA_HEIGHT
from pictures import HEIGHT, WIDTH, has_colour, pixel

from crazysim.errors import ConfigError
from crazysim.media import View, render_worlds
from crazysim.sim import Sim
from crazysim.sim.visualize import draw_points

POSITIONS = np.array([[0.4, 0.2, 0.5], [-0.4, 0.2, 0.5], [-0.4, -0.2, 0.5], [0.4, -0.2, 0.5]])
"""Position of the drone of each world, m. (4, 3)"""
RED, GREEN, BLUE = ([1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1])


@pytest.fixture(scope="module")
def sim(opengl, plain_scene):
    """Return four worlds over a plain floor, each with a drone in another corner, and a camera that looks down."""
    sim = Sim(n_worlds=4, control="state", xml_path=plain_scene)
    place(sim, POSITIONS, 0.0)
    yield sim
    sim.close()


def place(sim, pos, time):
    states = sim.data.states.replace(pos=jnp.asarray(pos, jnp.float32)[:, None])
    core = sim.data.core.replace(steps=jnp.full_like(sim.data.core.steps, round(time * sim.freq)))
    sim.data = sim.data.replace(states=states, core=core)


def center_of_dark_pixels(tile):
    """Return the mean row and column of the pixels that are darker than the floor."""
    rows, columns = np.nonzero(tile.astype(int).max(-1) < 100)
    assert len(rows) > 5
    return rows.mean() + 0.5, columns.mean() + 0.5


def make_view(**options):
    return View(**{"camera": "down", "width": WIDTH, "height": HEIGHT} | options)


# The grid -------------------------------------------------------------------------------------------------------


def test_each_tile_shows_its_world(sim):
    """Tile k of a grid equals the image of the k-th requested world; there are borders between tiles."""
    worlds = [2, 0, 3, 1]
    grid = make_view(worlds=worlds, width=2 * WIDTH + 4, height=2 * HEIGHT + 4, border=4)
    picture = grid.render(sim)
    assert picture.shape == (2 * HEIGHT + 4, 2 * WIDTH + 4, 3)
    assert picture.dtype == np.uint8
    upper, lower, left, right = slice(HEIGHT), slice(HEIGHT + 4, None), slice(WIDTH), slice(WIDTH + 4, None)
    for k, tile in enumerate([(upper, left), (upper, right), (lower, left), (lower, right)]):
        np.testing.assert_allclose(center_of_dark_pixels(picture[tile]), pixel(POSITIONS[worlds[k]]), atol=1.5)
        single = sim.render("rgb_array", worlds[k], "down", None, WIDTH, HEIGHT)
        np.testing.assert_array_equal(picture[tile], single)
        np.testing.assert_array_equal(picture[grid.tile(k)], single)
    assert (picture[HEIGHT : HEIGHT + 4] == 40).all()
    assert (picture[:, WIDTH : WIDTH + 4] == 40).all()


@pytest.mark.parametrize(
    ("n", "columns", "grid", "size"),
    [
        (1, None, (1, 1), (100, 60)),
        (2, None, (1, 2), (49, 60)),
        (3, 1, (3, 1), (100, 18)),
        (5, None, (2, 3), (32, 29)),
        (5, 8, (1, 5), (18, 60)),
    ],
)
def test_grids_are_filled_row_by_row(n, columns, grid, size):
    shown = View(worlds=range(n), width=100, height=60, columns=columns)
    assert (shown.grid, shown.tile_size) == (grid, size)
    seen = np.zeros((60, 100), int)
    for k in range(n):
        seen[shown.tile(k)] += 1
    assert seen.max() == 1
    assert seen.sum() == n * size[0] * size[1]


def test_overlays_are_in_every_tile_of_one_image(sim):
    grid = make_view(worlds=[0, 1], width=2 * WIDTH, border=0)
    draw_points(sim, [[0, 0, 1.0]], rgba=GREEN, size=0.05)
    picture = grid.render(sim)
    for k in range(2):
        rows, columns = np.nonzero(has_colour(picture[grid.tile(k)], GREEN))
        np.testing.assert_allclose([rows.mean() + 0.5, columns.mean() + 0.5], [HEIGHT / 2, WIDTH / 2], atol=0.5)
    assert not has_colour(grid.render(sim), GREEN).any()


def test_overlays_are_kept_when_an_image_fails(sim):
    draw_points(sim, [[0, 0, 1.0]], rgba=GREEN, size=0.05)
    with pytest.raises(ConfigError, match="got 'up'"):
        make_view(camera="up", text="failed").render(sim)
    picture = make_view().render(sim)
    assert has_colour(picture, GREEN).any()
    np.testing.assert_array_equal(make_view().render(sim), sim.render("rgb_array", 0, "down", None, WIDTH, HEIGHT))


# Cameras --------------------------------------------------------------------------------------------------------


def test_a_batch_holds_an_image_of_each_world_in_the_requested_order(sim):
    batch = render_worlds(sim, [2, 0, 3], "down", width=WIDTH, height=HEIGHT)
    assert batch.shape == (3, HEIGHT, WIDTH, 3)
    assert batch.dtype == np.uint8
    for picture, world in zip(batch, (2, 0, 3), strict=True):
        np.testing.assert_allclose(center_of_dark_pixels(picture), pixel(POSITIONS[world]), atol=2)
    all_images = render_worlds(sim, camera="down", width=WIDTH, height=HEIGHT)
    np.testing.assert_array_equal(all_images[[2, 0, 3]], batch)
    free = {"lookat": [0, 0, 0], "distance": CAMERA_HEIGHT, "azimuth": 90, "elevation": -90}
    draw_points(sim, np.array([[0, 0, 0.5]]), rgba=RED, size=0.05)
    marked = render_worlds(sim, [1, 1], cam_config=free, width=WIDTH, height=HEIGHT)
    for picture in marked:
        rows, columns = np.nonzero(has_colour(picture, RED))
        np.testing.assert_allclose([rows.mean() + 0.5, columns.mean() + 0.5], [HEIGHT / 2, WIDTH / 2], atol=1)
    assert not has_colour(render_worlds(sim, [1], "down"), RED).any()


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"worlds": []}, "at least one world, got none"),
        ({"worlds": [4]}, "got 4"),
        ({"height": 0}, "height"),
        ({"width": 1.5}, "width"),
        ({"camera": "nose"}, "got 'nose'"),
    ],
)
def test_law_09_invalid_batches_are_refused(sim, wrong, message):
    with pytest.raises(ConfigError, match=message):
        render_worlds(sim, **wrong)


def test_a_camera_that_follows_keeps_each_worlds_drone_in_its_middle(sim):
    """Without lag every drone is in the middle of its tile; a camera that stands still sees it elsewhere."""
    down = {"distance": 1.5, "azimuth": 90, "elevation": -90}
    follow = make_view(worlds=[0, 2], camera=-1, cam_config=down, follow=0, lag=0, width=2 * WIDTH, border=0)
    fixed = make_view(worlds=[0, 2], camera=-1, cam_config=down | {"lookat": [0, 0, 0.5]}, width=2 * WIDTH, border=0)
    for k in range(2):
        np.testing.assert_allclose(
            center_of_dark_pixels(follow.render(sim)[follow.tile(k)]), [HEIGHT / 2, WIDTH / 2], atol=2
        )
        assert abs(center_of_dark_pixels(fixed.render(sim)[fixed.tile(k)])[1] - WIDTH / 2) > 20


def test_a_camera_holds_drones_and_points_of_each_world_in_view(sim):
    """The points of every world are in its tile, near its edges; a second image without lag is the same."""
    goal = {0: [0.9, 0.3, 0.5], 2: [-0.2, 1.0, 0.8]}
    place(sim, POSITIONS, 0.0)
    held = make_view(
        worlds=[0, 2],
        camera=-1,
        cam_config={"azimuth": 90, "elevation": -90},
        hold=lambda _, world: goal[world],
        draw=lambda sim, world: draw_points(sim, np.array([goal[world]]), (1, 0, 0, 1), 0.1),
        lag=0,
        width=2 * WIDTH,
        border=0,
    )
    image = held.render(sim)
    for k in range(2):
        tile = image[held.tile(k)]
        spots = np.array([center_of_dark_pixels(tile), np.argwhere(has_colour(tile, RED)).mean(axis=0)])
        distance = np.linalg.norm(spots - [HEIGHT / 2, WIDTH / 2], axis=-1)
        assert (distance > 0.25 * HEIGHT).all()
        assert (distance < 0.45 * HEIGHT).all()
    np.testing.assert_array_equal(held.render(sim), image)


def test_a_camera_that_lags_goes_back_so_far_that_its_points_stay_in_view(sim):
    place(sim, POSITIONS, 0.0)
    goal = np.array([0.5, 0.0, 0.5])
    held = make_view(
        camera=-1,
        cam_config={"azimuth": 90, "elevation": -90},
        hold=lambda _, world: goal,
        draw=lambda sim, world: draw_points(sim, goal[None], (1, 0, 0, 1), 0.2),
        lag=10.0,
    )
    assert has_colour(held.render(sim), RED).any()
    goal += [3.0, 0.0, 0.0]
    place(sim, POSITIONS, 0.1)
    assert has_colour(held.render(sim), RED).any()


def test_a_camera_that_follows_lags_behind(sim):
    """After a jump of 0.2 m the camera has moved by the fraction 1 - exp(-t / lag); after a reset by the whole way."""
    config = {"distance": 1.5, "azimuth": 90, "elevation": -90}
    follow = make_view(camera=-1, cam_config=config, follow=0, lag=0.5)
    place(sim, POSITIONS, 1.0)
    follow.render(sim)
    place(sim, POSITIONS + [0.2, 0, 0], 1.5)
    moved = center_of_dark_pixels(follow.render(sim))[1] - WIDTH / 2
    place(sim, POSITIONS + [0.1, 0, 0], 0.0)
    after_reset = center_of_dark_pixels(follow.render(sim))[1] - WIDTH / 2
    place(sim, POSITIONS, 0.0)
    focal = 0.5 * HEIGHT / np.tan(np.deg2rad(sim.mj_model.vis.global_.fovy / 2))
    np.testing.assert_allclose(moved, focal * 0.2 * np.exp(-1) / 1.5, atol=1.5)
    np.testing.assert_allclose(after_reset, 0, atol=1.5)


def test_an_inset_is_drawn_enlarged_at_the_bottom_right_of_each_world(sim):
    """Each pixel of a picture of 2 x 3 is a block of whole pixels, and the rest of the image stays."""
    pictures = np.random.default_rng(0).integers(0, 255, (4, 2, 3, 3)).astype(np.uint8)
    options = {"worlds": [1, 3], "width": 2 * WIDTH, "border": 0}
    place(sim, POSITIONS, 0.0)
    shown = make_view(**options, inset=lambda sim, world: pictures[world] if world == 3 else None).render(sim)
    plain, scale = make_view(**options).render(sim), WIDTH // 12
    block = slice(HEIGHT - 2 * scale, HEIGHT), slice(2 * WIDTH - 3 * scale, 2 * WIDTH)
    np.testing.assert_array_equal(shown[block], pictures[3].repeat(scale, axis=0).repeat(scale, axis=1))
    frame = slice(block[0].start - 2, None), slice(block[1].start - 2, None)
    assert not shown[frame][:2].any()
    shown[frame], plain[frame] = 0, 0
    np.testing.assert_array_equal(shown, plain)


def test_a_top_view_shows_obstacles_paths_and_headings_of_each_world(opengl, plain_scene):
    """The posts are 6.2 m wide together. With the margins of 1 m, a pixel of the map, 80 x 45, is 8.2 / 80 m."""
    sim = Sim(n_worlds=2, control="state", xml_path=plain_scene)
    start = [[-3, 0.9, 0.5], [3, -0.9, 0.5], [0, 0, -100]]
    posts = sim.scene.add("box", "post", count=3, pos=start, size=(0.2, 0.6, 1.0), rgba=BLUE)
    sim.scene.add("box", "marker", pos=[0, 0.8, 0.02], size=(0.4, 0.4, 0.04))
    options = {"worlds": [0, 1], "width": 2 * WIDTH, "border": 0}
    shown, plain, scale = make_view(**options, top_view=True, rgba=RED), make_view(**options), 8.2 / 80
    north = jnp.broadcast_to(jnp.array([0, 0, 0.5**0.5, 0.5**0.5], jnp.float32), (2, 1, 4))
    for k, x in enumerate(np.linspace(-2, 1, 7)):
        place(sim, [[x, 0.0, 1], [x, 0.4, 1]], 0.1 * k)
        sim.data = sim.data.replace(states=sim.data.states.replace(quat=north))
        if k == 6:  # in the second world, after maps without it
            sim.data = posts[2].set_pose(sim.data, pos=[-1.5, -0.9, 0.5], mask=[False, True])
        picture = shown.render(sim)
    without = plain.render(sim)
    y, x = scale * (22.5 - np.arange(45)[:, None] - 0.5), scale * (np.arange(80) - 40 + 0.5)
    for k, places in enumerate([[(-3, 0.9), (3, -0.9)], [(-3, 0.9), (3, -0.9), (-1.5, -0.9)]]):
        path_y, tile = 0.4 * k, picture[shown.tile(k)].copy()
        chart = tile[-45:, :80].copy()
        assert not tile[-47:-45, :82].any()
        assert not tile[-47:, 80:82].any()
        tile[-47:, :82] = without[shown.tile(k)][-47:, :82]
        np.testing.assert_array_equal(tile, without[shown.tile(k)], err_msg="beside the map")
        gaps = [np.maximum(abs(x - post_x) - 0.1, abs(y - post_y) - 0.3) for post_x, post_y in places]
        gap = np.min(gaps, axis=0)  # to the posts, m
        is_clear = abs(gap) > 1.2 * scale
        np.testing.assert_array_equal(has_colour(chart, BLUE)[is_clear], (gap < 0)[is_clear])
        for post_x, post_y in places:
            assert has_colour(chart, BLUE)[(abs(y - post_y) < scale) & (abs(x - post_x) < scale)].any()
        rows, columns = np.nonzero(has_colour(chart, RED))
        np.testing.assert_allclose(y[np.median(rows).astype(int), 0], path_y, atol=0.1)
        np.testing.assert_allclose([x[columns.min()], x[columns.max()]], [-2, 1.2], atol=0.2)
        ahead, behind = (chart[(abs(y - path_y - y_nose) < 0.1) & (abs(x - 1) < 0.1)] for y_nose in (0.5, -0.5))
        assert (ahead.max(-1) < 100).any(), "a line points ahead"
        assert not (behind.max(-1) < 100).any()
    sim.close()


def test_a_top_view_of_a_large_area_moves_along_with_the_first_drone(opengl, plain_scene):
    """The map shows 24 of 60 m, around the drone and not beyond the ends; a scene without obstacles has no map."""
    sim = Sim(control="state", xml_path=plain_scene)
    shown, plain = make_view(top_view=True, rgba=RED), make_view()
    np.testing.assert_array_equal(shown.render(sim), plain.render(sim))
    start = [[0, 0, 0], [30, 0, 0], [60, 0, 0]]
    sim.scene.add("cylinder", "post", count=3, pos=start, radius=0.5, height=2.0, rgba=BLUE)
    for x, drone, post in [(1, 2.5, 1.5), (25, 12.0, 17.0), (55, 17.5, 22.5)]:  # m from the left edge
        sim.reset()  # which begins the path again
        sim.data = sim.data.replace(states=sim.data.states.replace(pos=jnp.array([[[x, 3.0, 1.0]]])))
        chart = shown.render(sim)[-45:, :80]
        spots = [np.nonzero(has_colour(chart, color))[1].mean() for color in (RED, BLUE)]
        np.testing.assert_allclose((np.array(spots) + 0.5) * 24 / 80, [drone, post], atol=0.3)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=jnp.array([[[1e30, 3.0, 1.0]]])))
    chart = shown.render(sim)[-45:, :80]
    assert not has_colour(chart, RED).any()
    assert has_colour(chart, BLUE).any()
    assert make_view(top_view=True, width=3, height=2).render(sim).shape == (2, 3, 3)
    sim.close()


def test_small_drones_have_rings_of_a_width(sim):
    """A ring of 20 pixels around the drone 8 m away; the drone 0.4 m away is larger than that."""
    place(sim, POSITIONS, 0.0)
    for distance, width in ((8.0, 20), (0.4, 0)):
        config = {"lookat": POSITIONS[0], "distance": distance, "azimuth": 30, "elevation": -40}
        shown = make_view(camera=-1, cam_config=config, ring_width=20, rgba=RED)
        rows, columns = np.nonzero(has_colour(shown.render(sim), RED))
        assert [np.ptp(x) + 1 if len(x) else 0 for x in (rows, columns)] == pytest.approx([width, width], abs=2)
        if width:
            np.testing.assert_allclose([rows.mean(), columns.mean()], [HEIGHT / 2, WIDTH / 2], atol=1.5)


def test_rings_of_drones_on_the_floor_are_whole(sim):
    place(sim, POSITIONS * [1, 1, 0], 0.0)
    config = {"lookat": POSITIONS[0] * [1, 1, 0], "distance": 8.0, "azimuth": 30, "elevation": -10}
    rows, columns = np.nonzero(
        has_colour(make_view(camera=-1, cam_config=config, ring_width=20, rgba=RED).render(sim), RED)
    )
    assert [np.ptp(x) + 1 for x in (rows, columns)] == pytest.approx([20, 20], abs=2)


@pytest.mark.parametrize("distance", [1.5, 3.0])
def test_marks_have_one_width_and_hoops_their_own_size_and_axis(sim, distance):
    """A mark that is not finite is left out. Seen from above, a hoop around z is round, and one around x a line."""
    place(sim, POSITIONS, 0.0)
    config = {"lookat": [0, 0, 0.5], "distance": distance, "azimuth": 90, "elevation": -90}
    shown = make_view(camera=-1, cam_config=config, marks=lambda *_: [[0, 0, 0.5], [np.nan] * 3])
    assert [np.ptp(x) + 1 for x in np.nonzero(has_colour(shown.render(sim), GREEN))] == pytest.approx([12, 12], abs=2)
    scale = 0.5 * HEIGHT / np.tan(np.deg2rad(sim.mj_model.vis.global_.fovy / 2)) / distance
    for axis, size in (([0, 0, 1], [1, 1]), ([1, 0, 0], [1, 0])):
        shown = make_view(camera=-1, cam_config=config, hoops=lambda *_, axis=axis: [[0, 0, 0.5, *axis, 0.3]])
        widths = [np.ptp(x) + 1 for x in np.nonzero(has_colour(shown.render(sim), [1, 1, 0]))]
        assert widths == pytest.approx(0.6 * scale * np.array(size), abs=0.05 * scale + 2)


def test_a_camera_may_move_with_time(sim):
    """Its settings may be a function of time: here the camera goes east by 0.1 m/s, and the drone west."""
    moving = make_view(
        camera=-1,
        cam_config=lambda time: {"lookat": [0.1 * time, 0, 0.5], "distance": 1.5, "azimuth": 90, "elevation": -90},
    )
    columns = []
    for time in (0.0, 2.0):
        place(sim, POSITIONS, time)
        columns.append(center_of_dark_pixels(moving.render(sim))[1])
    place(sim, POSITIONS, 0.0)
    focal = 0.5 * HEIGHT / np.tan(np.deg2rad(sim.mj_model.vis.global_.fovy / 2))
    np.testing.assert_allclose(columns[0] - columns[1], focal * 0.2 / 1.5, atol=1.5)


# What is drawn over the image ----------------------------------------------------------------------------------


def test_a_trail_follows_the_way_of_each_worlds_drone(sim):
    """Its pixels lie on the flown path, from end to end, in its own world only, and fade towards its beginning."""
    shown = make_view(worlds=[0, 1], width=2 * WIDTH, border=0, trail=5.0, rgba=BLUE)
    x = np.linspace(-0.5, 0.5, 11)
    for k in range(11):
        pos = POSITIONS.copy()
        pos[0], pos[1] = [x[k], 0.1, 1.0], [0.3, 0.6 * x[k], 1.0]
        place(sim, pos, 0.1 * k)
        picture = shown.render(sim)
    place(sim, POSITIONS, 0.0)
    east, north = (has_colour(picture[shown.tile(k)], BLUE) for k in range(2))
    rows, columns = np.nonzero(east)
    assert np.abs(rows + 0.5 - pixel([0, 0.1, 1])[0]).max() < 3
    # The drone hides the end of its way, and the faint beginning is no longer blue enough.
    assert columns.min() < pixel([-0.25, 0.1, 1])[1]
    assert columns.max() > pixel([0.4, 0.1, 1])[1]
    rows, columns = np.nonzero(north)
    assert np.abs(columns + 0.5 - pixel([0.3, 0, 1])[1]).max() < 3
    blueness = picture[shown.tile(0)].astype(int) @ [-1, 0, 1]
    row = int(pixel([0, 0.1, 1])[0])
    old, new = (blueness[row - 2 : row + 3, int(pixel([east, 0.1, 1])[1])].max() for east in (-0.35, 0.35))
    assert 20 < old < new - 60


def test_setpoints_are_drawn_at_the_commanded_positions(sim):
    """Each world's tile has a green sphere at its own setpoint."""
    command = np.zeros((4, 1, 16))
    command[..., 12] = 1
    command[:, 0, :3] = -POSITIONS + [0, 0, 1.5]
    data = sim.data
    sim.state_control(command)
    shown = make_view(worlds=[0, 1, 2, 3], width=2 * WIDTH, height=2 * HEIGHT, border=0, setpoints=True, rgba=GREEN)
    picture = shown.render(sim)
    sim.data = data
    for k in range(4):
        rows, columns = np.nonzero(has_colour(picture[shown.tile(k)], GREEN))
        np.testing.assert_allclose([rows.mean() + 0.5, columns.mean() + 0.5], pixel(command[k, 0, :3]), atol=1.0)


def test_text_changes_its_corner_and_nothing_else(sim):
    """Text stands at the top left of each tile, names its world, and changes no other pixel."""
    options = {"worlds": [0, 1], "width": 2 * WIDTH, "border": 0}
    plain, shown = make_view(**options), make_view(**options, text="world {world}  {time:.2f} s")
    before, after = plain.render(sim), shown.render(sim)
    tiles = []
    for k in range(2):
        changed = (before != after)[shown.tile(k)].any(-1)
        rows, columns = np.nonzero(changed)
        assert len(rows) > 200
        assert rows.max() < 30
        assert columns.max() < 0.75 * WIDTH
        tiles.append(after[shown.tile(k)][:30, :120])
    assert (tiles[0] != tiles[1]).any(), "the number of the world is another"
    bright = tiles[0].min(-1) > 230
    assert 30 < bright.sum() < 600, "letters are bright on a dark ground"
    np.testing.assert_array_equal(shown.render(sim), after)
    np.testing.assert_array_equal(plain.render(sim), before)


# Wrong input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"worlds": []}, "expected worlds of View as a number or array, got an empty one"),
        ({"worlds": [0, 4]}, "expected a world from 0 to 3, got 4"),
        ({"worlds": [0.5]}, "got 0.5"),
        ({"worlds": range(100), "width": 20}, "expected an image that 100 worlds fit into, got 20 x 120"),
        ({"width": 0}, "width is 0; it must be a positive"),
        ({"height": -2}, "height is -2; it must be a positive"),
        ({"border": -1}, "border of View to be finite and at least 0, got -1"),
        ({"columns": 0}, "columns is 0"),
        ({"camera": "up"}, "got 'up'"),
        ({"follow": 0}, "to follow a drone or hold points in view, got 'down'"),
        ({"camera": -1, "follow": 1}, "expected a drone from 0 to 0 to follow, got 1"),
        ({"camera": -1, "follow": 0, "lag": -1.0}, "lag of View to be finite and at least 0, got -1.0"),
        ({"trail": -1.0}, "trail of View to be finite and at least 0, got -1.0"),
        ({"text": "{drone}"}, "only, got '{drone}'"),
        ({"cam_config": 3}, "expected cam_config of View as a dict or a function, got 3"),
        ({"camera": -1, "cam_config": lambda time: time}, "expected cam_config to return a dict, got "),
        ({"camera": -1, "hold": 3}, "expected hold of View as a function, got 3"),
        ({"camera": -1, "hold": lambda sim, world: [1.0, 2.0]}, "to return points of shape (n, 3), got shape (2,)"),
        ({"draw": "drones"}, "expected draw of View as a function, got 'drones'"),
        ({"text": "Zürich"}, "expected ASCII text, got 'Zürich' with 'ü'"),
    ],
)
def test_invalid_views_are_refused(sim, wrong, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make_view(**wrong).render(sim)
    assert len(sim.overlays) == 0


# Many worlds at once ----------------------------------------------------------------------------------------------


def test_warp_draws_the_image_of_the_plain_renderer(opengl, plain_scene):
    """The same places, colours and shapes; edges and shadows are drawn in other ways."""
    pytest.importorskip("warp")
    sim = Sim(n_worlds=4, control="state", xml_path=plain_scene)
    sim.scene.add("box", "lamp", pos=[0.0, 0.1, 0.2], size=(0.1, 0.1, 0.1), rgba=(1, 0, 0, 1))
    place(sim, POSITIONS, 0.0)
    size = {"camera": "down", "width": WIDTH, "height": HEIGHT}
    plain, warp = (render_worlds(sim, [2, 0, 3], renderer=name, **size) for name in ("plain", "warp"))
    assert warp.shape == plain.shape
    assert warp.dtype == plain.dtype
    for picture, expected, world in zip(warp, plain, (2, 0, 3), strict=True):
        np.testing.assert_allclose(center_of_dark_pixels(picture), pixel(POSITIONS[world]), atol=2)
        places = [np.argwhere(has_colour(x, RED)).mean(axis=0) for x in (picture, expected)]
        np.testing.assert_allclose(*places, atol=1)
    assert np.abs(warp.astype(int) - plain).mean() < 6, "of 255: floor and sky are the same"
    moved = render_worlds(sim, [0, 0, 0], renderer="warp", **size)
    np.testing.assert_array_equal(moved[0], moved[2])
    np.testing.assert_array_equal(moved[0], warp[1])
    with pytest.raises(ConfigError, match="got the free camera"):
        render_worlds(sim, [0], renderer="warp")
    with pytest.raises(ConfigError, match="got 'nose'"):
        render_worlds(sim, [0], "nose", renderer="warp")
    with pytest.raises(ConfigError, match="got 0 x 8 pixels"):
        render_worlds(sim, [0], "down", width=0, height=8, renderer="warp")
    with pytest.raises(ConfigError, match="got 'cycles'"):
        render_worlds(sim, [0], "down", renderer="cycles")


def test_an_image_of_a_single_world_needs_no_mjx(opengl):
    near = {"lookat": [0.0, 0.0, 0.1], "distance": 0.8}  # else the drone is smaller than a pixel
    sim, near_view = Sim(control="rotor_vel", engine="interpret"), View(width=32, height=24, cam_config=near)
    first = near_view.render(sim)
    sim.rotor_vel_control(np.full((1, 1, 4), 25_000.0))
    sim.step(100)
    second = near_view.render(sim)
    assert not sim.scene.is_allocated
    assert not sim.data.core.mjx_synced
    assert (first != second).any()
    settings = {"mode": "rgb_array", "camera": "track_cam:0", "width": 32, "height": 24}
    before = sim.render(**settings)
    sim.contacts()
    assert sim.scene.is_allocated
    np.testing.assert_array_equal(sim.render(**settings), before)
    with pytest.raises(ValueError, match="world from 0 to 0, got 1"):
        sim.render("rgb_array", world=1)
    sim.close()
