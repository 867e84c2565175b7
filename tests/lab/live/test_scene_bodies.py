"""Bodies that viewers pick and follow: their names, their parts, and rays through them."""

import numpy as np
import pytest

from crazysim import Cars, Hook, Sim
from crazysim.errors import ConfigError
from crazysim.lab.live import Live
from crazysim.lab.live.picture import PictureSource
from crazysim.lab.live.scene_bodies import MARK_RADIUS, SceneBodies
from crazysim.scene.visual_geoms import visual_geoms


@pytest.fixture(scope="module")
def sim():
    """Two drones with hooked loads, two cars with trailers, a ball, and a gate whose name begins like the ball's."""
    sim = Sim(n_worlds=2, n_drones=2, drone="bumblebee", control="state")
    sim.add(Hook.bumblebee(0.1))
    sim.add(Cars(2, vehicle="aiml_head", trailer=True))
    sim.scene.add("sphere", "ball", pos=[0, 0, 3], radius=0.5)
    sim.scene.add("box", "ball_gate", pos=[0, 2, 3], size=(0.2, 0.4, 0.6))
    return sim


@pytest.fixture(scope="module")
def bodies(sim):
    sim.scene.compile_if_edited()
    sim.sync(0)
    return SceneBodies(sim, visual_geoms(sim.mj_model, sim.mj_data))


def test_bodies_have_kinds_numbers_and_names(bodies):
    listed = [(body.kind, body.index, body.name) for body in bodies.items]
    assert listed == [
        ("drone", 0, "Bumblebee_0"), ("drone", 1, "Bumblebee_1"), ("load", 0, "load 0"), ("load", 1, "load 1"),
        ("cars", 0, "Fleet1Tenth_0"), ("cars", 1, "Fleet1Tenth_1"), ("ball", 0, "ball"), ("ball_gate", 0, "ball_gate"),
    ]  # fmt: skip


def test_parts_belong_to_their_bodies(sim, bodies):
    """Wheels, drawbars and trailers of the second car, and the hook of the second drone."""
    names = {name: int(k) for name, k in zip(sim.data.objects.names, sim.data.objects.mocap_ids, strict=True)}
    car, load = bodies.items.index(bodies.find("cars", 1)), bodies.items.index(bodies.find("load", 1))
    for part in ("cars_wheel:4", "cars_wheel:7", "cars_drawbar:1", "cars_trailer:1", "cars_trailer_wheel:4"):
        assert bodies.owner[names[part]] == car
    for part in ("load_link:1", "load_hook:1"):
        assert bodies.owner[names[part]] == load
    assert bodies.owner[names["cars_wheel:3"]] == car - 1


def test_bodies_have_boxes_radii_and_trails(bodies):
    gate, drone = bodies.find("ball_gate", 0).mocap, bodies.find("drone", 0).mocap
    np.testing.assert_allclose([bodies.low[gate], bodies.high[gate]], [[-0.1, -0.2, -0.3], [0.1, 0.2, 0.3]], atol=1e-6)
    assert bodies.mark_radius(gate) == pytest.approx(np.sqrt(0.01 + 0.04 + 0.09))
    assert bodies.mark_radius(drone) == MARK_RADIUS
    assert bodies.mark_radius(bodies.find("load", 0).mocap) >= MARK_RADIUS
    assert len(bodies.trail_mocap_ids) == len(bodies.items)
    assert bodies.trail_mocap_ids[:2].tolist() == [bodies.items[0].mocap, bodies.items[1].mocap]


def test_the_followed_body(sim):
    live = Live(sim)
    assert live.followed == (0, "drone", 0)
    live.follow(1, "cars", 1)
    assert (live.followed, live.selected) == ((1, "cars", 1), (0, 0))
    live.follow(1, "drone", 1)
    assert (live.followed, live.selected) == ((1, "drone", 1), (1, 1))
    live.follow(0, "load", 0)
    live.select(0, 1)
    assert live.followed == (0, "drone", 1)
    with pytest.raises(ConfigError, match=r"got 'cars' 2. Use one of 'drone' \(0 to 1\), 'load' \(0 to 1\)"):
        live.follow(0, "cars", 2)
    with pytest.raises(ConfigError, match="a world below 2, got 2"):
        live.follow(2, "cars", 0)
    with pytest.raises(ConfigError, match="a drone below 2"):
        live.follow(0, "drone", 2)


def test_trails_follow_bodies_and_restart_after_a_reset(sim, bodies):
    live, ball = Live(sim), bodies.find("ball", 0)
    source, k = PictureSource(sim, [1], trail=0.2), bodies.trail_mocap_ids.tolist().index(ball.mocap)

    def take_trail(step, x):
        live.step, objects = step, sim.data.objects
        pos = objects.pos.at[..., np.asarray(objects.mocap_ids).tolist().index(ball.mocap), 0].set(x)
        sim.data = sim.data.replace(objects=objects.replace(pos=pos))
        return source.take_picture(live).trail[:, 0, k, 0]

    for step in range(5):
        trail = take_trail(6 * step, 0.1 * step)
    np.testing.assert_allclose(trail, [0.1, 0.2, 0.3, 0.4, 0.4], atol=1e-6)
    np.testing.assert_allclose(take_trail(0, 9.0), 9.0)
