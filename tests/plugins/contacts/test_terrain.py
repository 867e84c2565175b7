"""Terrain: heights and normals against MuJoCo and by hand, landing, response, loads, images, and wrong input."""

import zlib

import mujoco
import numpy as np
import pytest
from cases import with_states
from pictures import encode_png

from crazysim import ConfigError, ContactResponse, GroundEffect, Hook, Sim, SlungLoad, Terrain, Wind
from crazysim.core.integration import FLOOR_HEIGHT, Integrator
from crazysim.core.pipeline import remove_fn
from crazysim.plugins.effects.ground import ground_at, ground_height

SIZE = (4.0, 3.0)


def hills(n_rows=16, n_columns=21):
    x, y = np.meshgrid(np.linspace(-2, 2, n_columns), np.linspace(-1.5, 1.5, n_rows))
    return 0.5 + 0.3 * np.sin(2 * x) * np.cos(1.5 * y) + 0.1 * x


def flat(height):
    """Return equal heights on as many nodes as the hills have, so that both use the same kernels."""
    return np.full_like(hills(), height)


def build(heights=None, n_worlds=2, n_drones=2, pos=(0.3, 0.2, 2.0), control="rotor_vel", **kwargs):
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control=control)
    sim.data = with_states(sim.data, pos=pos)
    sim.build_default_data()
    return sim, sim.add(Terrain(hills() if heights is None else heights, SIZE, **kwargs))


def test_height_and_normal_are_those_of_mujoco(rng):
    """Vertical rays of MuJoCo hit the surface at the same height; normals agree with differences of heights."""
    sim, plugin = build()
    model, data = sim.scene.mj_model, mujoco.MjData(sim.scene.mj_model)
    mujoco.mj_forward(model, data)
    points = np.column_stack([rng.uniform(-1.99, 1.99, 200), rng.uniform(-1.49, 1.49, 200), np.full(200, 3.0)])
    geom = model.geom("terrain").id
    expected = np.array([
        3.0 - mujoco.mj_rayHfield(model, data, geom, p, np.array([0, 0, -1.0]), None) for p in points
    ])  # fmt: skip
    height, normal = map(np.asarray, plugin.read(sim.data).surface_at(np.float32(points)))
    np.testing.assert_allclose(height[:, 0], expected, atol=2e-6)  # float32
    h = 1e-4
    slopes = []
    for axis in np.eye(3)[:2]:
        ends = [plugin.read(sim.data).surface_at(np.float32(points + s * h * axis))[0] for s in (-1, 1)]
        slopes.append((np.asarray(ends[1]) - np.asarray(ends[0]))[:, 0] / (2 * h))
    expected_normal = np.stack([-slopes[0], -slopes[1], np.ones(200)], axis=-1)
    expected_normal /= np.linalg.norm(expected_normal, axis=-1, keepdims=True)
    error = np.abs(normal - expected_normal).max(axis=-1)
    assert np.quantile(error, 0.95) < 5e-3, "except for differences across an edge"
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, rtol=1e-6)


def test_beyond_the_border_is_the_floor_or_the_height_of_the_border():
    sim, plugin = build()
    far = np.float32([[5.0, 0.0, 1.0], [0.0, -9.0, 1.0]])
    height, normal = ground_at(sim.data, far)
    np.testing.assert_array_equal(height, 0)
    np.testing.assert_array_equal(normal, [[0, 0, 1], [0, 0, 1]])
    sim_without_floor, plugin = build(floor=False, pos=(0, 0, 2.0))
    edge = plugin.read(sim_without_floor.data).surface_at(np.float32([2.0, 0.0, 0.0]))[0]
    np.testing.assert_allclose(ground_height(sim_without_floor.data, np.float32([7.0, 0.0, 0.0])), edge)
    assert not any(g.type == mujoco.mjtGeom.mjGEOM_PLANE for g in sim_without_floor.scene.spec.worldbody.geoms)
    np.testing.assert_array_equal(ground_height(Sim().data, far), 0)


def test_drones_land_on_terrain_and_take_off():
    sim, plugin = build(control="attitude")
    sim.step(1000)
    ground = np.asarray(ground_height(sim.data, sim.data.states.pos))
    np.testing.assert_allclose(np.asarray(sim.data.states.pos)[..., 2:], ground + FLOOR_HEIGHT, atol=1e-6)
    assert float(ground.min()) > 0.4
    np.testing.assert_array_equal(sim.data.states.vel, 0)
    np.testing.assert_allclose(plugin.read(sim.data).height_below, ground)
    np.testing.assert_allclose(
        sim.contact_report(drones=False).floor_distance, -0.086, atol=0.02
    )  # sunk by its sphere's radius
    sim.attitude_control(np.tile(np.float32([0, 0, 0, 0.6]), (2, 2, 1)))
    sim.step(300)
    assert float(np.asarray(sim.data.states.pos)[..., 2].min()) > 0.7
    sim.reset()
    np.testing.assert_allclose(
        plugin.read(sim.data).height_below, ground_height(sim.data, sim.data.states.pos), rtol=1e-6
    )


@pytest.mark.parametrize("integrator", list(Integrator))
def test_a_drone_stands_where_the_terrain_is_and_falls_where_it_is_lower(integrator):
    sim = Sim(integrator=integrator)
    sim.data = with_states(sim.data, pos=[0.3, 0.2, 0.0], force=[0.1, 0, 0])
    sim.build_default_data()
    sim.add(Terrain(flat(0.0), SIZE, floor=False))
    sim.step(50)
    np.testing.assert_array_equal(sim.data.states.pos, sim.default_data.states.pos)
    sim.replace(Terrain(flat(-2.0), SIZE, floor=False))
    sim.step(100)
    assert float(sim.data.states.pos[0, 0, 2]) < -0.15  # g t^2 / 2 = 0.196 m, less drag


def test_law_07_nothing_breaks_at_the_border_of_the_terrain():
    sim, _ = build(flat(0.5), n_worlds=1, n_drones=1, pos=(1.8, 0.2, 0.6))
    sim.add(ContactResponse(friction=0.0))
    sim.data = with_states(sim.data, vel=[1.0, 0.0, 0.0])
    sim.step(1000)
    pos = np.asarray(sim.data.states.pos)[0, 0]
    assert pos[0] > 2.2
    np.testing.assert_allclose(pos[2], 0.02, atol=2e-3)  # it fell off, onto the flat floor


def test_a_drone_on_a_slope_rests_with_contact_response_where_friction_holds_it():
    """On a slope of 0.3 the drone lies in the plane and rests with a friction of 0.6, and slides with 0.05."""
    slope = 0.3 * np.linspace(0, 4, 21)[None].repeat(16, axis=0)
    for friction, holds in ((0.6, True), (0.05, False)):
        sim, _ = build(slope, n_worlds=1, n_drones=1, pos=(0.5, 0.2, 0.83))
        sim.add(ContactResponse(friction=friction))
        sim.step(700)
        pos_before = np.asarray(sim.data.states.pos)[0, 0]
        sim.step(300)
        moved = np.asarray(sim.data.states.pos)[0, 0] - pos_before
        if holds:
            assert np.abs(moved).max() < 2e-3
            q = np.asarray(sim.data.states.quat)[0, 0]
            z = np.array(
                [2 * (q[0] * q[2] + q[1] * q[3]), 2 * (q[1] * q[2] - q[0] * q[3]), 1 - 2 * (q[0] ** 2 + q[1] ** 2)]
            )
            np.testing.assert_allclose(z, np.array([-0.3, 0, 1]) / np.sqrt(1.09), atol=0.01)
            np.testing.assert_allclose(
                (pos_before - [pos_before[0], pos_before[1], 0.3 * (pos_before[0] + 2)]) @ z, 0.02, atol=1e-3
            )
        else:
            assert moved[0] < -0.05


def test_loads_rest_on_terrain():
    sim = Sim(control="rotor_vel")
    sim.data = with_states(sim.data, pos=[0.5, 0.0, 2.0])
    sim.add(Terrain(flat(0.4), SIZE))
    load = sim.add(SlungLoad(0.01, 0.5, size=0.03))
    sim.data = load.release(sim.data)
    sim.step(600)
    np.testing.assert_allclose(np.asarray(load.read(sim.data).pos)[0, 0, 2], 0.43, atol=1e-5)
    sim.data = with_states(sim.data, pos=[-0.5, 0.0, 2.0], vel=0.0)
    sim.add(ContactResponse())
    remove_fn(sim.step_pipeline, "contact_response")  # of the drones, which touch nothing here
    sim.build_step_fn()
    sim.step(100)
    np.testing.assert_allclose(np.asarray(load.read(sim.data).pos)[0, 0, 2], 0.43, atol=1e-3)
    hook_sim = Sim(control="rotor_vel")
    hook_sim.data = with_states(hook_sim.data, pos=[0.5, 0.0, 2.0])
    hook_sim.add(Terrain(flat(0.4), SIZE))
    hook = hook_sim.add(Hook(0.01, load_at=(0.5, 0, 1.0), size=0.03, ring=0.05))
    hook_sim.step(600)
    np.testing.assert_allclose(np.asarray(hook.read(hook_sim.data).pos)[0, 0, 2], 0.48, atol=1e-5)


def test_ground_effect_and_wind_use_the_height_above_ground():
    sim, _ = build(flat(1.0), pos=(0, 0, 1.05))
    plain = Sim(n_worlds=2, n_drones=2, control="rotor_vel")
    plain.data = with_states(plain.data, pos=[0, 0, 0.05])
    vels = []
    for s in (sim, plain):
        s.data = with_states(s.data, rotor_vel=15000.0)
        s.rotor_vel_control(np.full((2, 2, 4), 15000.0))
        s.add(GroundEffect())
        s.add(Wind((5.0, 0, 0), speed_20ft=5.0, roughness=0.01))
        s.step(10)
        vels.append(np.asarray(s.data.states.vel))
    np.testing.assert_allclose(vels[0], vels[1], rtol=1e-4, atol=1e-6)
    assert abs(vels[0][..., 0]).min() > 1e-3


def test_the_upper_edge_of_an_image_is_at_the_largest_y(tmp_path):
    pixels = np.zeros((3, 4), np.uint8)
    pixels[0, 3] = 200  # the upper right corner
    pixels[2, 0] = 100  # the lower left corner
    (tmp_path / "hill.png").write_bytes(encode_png(pixels))
    sim = Sim()
    plugin = sim.add(Terrain(tmp_path / "hill.png", (4, 3, 2.0), pos=(1.0, 0.0, 0.0)))
    corners = np.float32([[3.0, 1.5, 0], [-1.0, -1.5, 0], [3.0, -1.5, 0]])
    height = np.asarray(plugin.read(sim.data).surface_at(corners)[0])
    np.testing.assert_allclose(height[:, 0], [2.0, 1.0, 0.0], atol=1e-6)


def test_law_09_files_that_are_no_images_are_errors_before_memory_is_allocated(tmp_path):
    huge = bytearray(encode_png(np.zeros((8, 8), np.uint8)))
    huge[16:24] = (20_000).to_bytes(4, "big") * 2  # 20,000 x 20,000 pixels, which would take 12 GB
    huge[29:33] = zlib.crc32(huge[12:29]).to_bytes(4, "big")
    path = tmp_path / "hill.png"
    for content, message in (
        (None, "expected an existing file"),
        (b"", "expected a PNG image"),
        (b"no image", "expected a PNG image"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "expected a PNG image"),
        (bytes(huge), "at most 16777216 pixels, got .* of 20000 x 20000"),
        (encode_png(np.zeros((8, 8), np.uint8))[:60], "expected a PNG image of heights, got"),
    ):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ConfigError, match=message):
            Sim().add(Terrain(path, (4, 3, 2.0)))
