"""Radars: the lobe against its parametric outline, detection in flight, gradients, overlays, wrong input."""

import numpy as np
import pytest
from cases import with_states

from crazysim import Radar, Sim
from crazysim.lab.plugins.radar import lobe_curves, lobe_margin

LOBES = [(10.0, 1.3, 1.0, 0.0), (6.0, 2.5, 0.6, 0.3), (8.0, 0.0, 1.0, 0.0), (8.0, 2.0, 0.7, -0.2)]


@pytest.mark.parametrize("lobe", LOBES)
def test_the_outline_is_where_the_margin_changes_sign(lobe, x64):
    """The parametric curve that is drawn is the boundary of the region of detection."""
    size, tilt = lobe[0] / 2, lobe[3]
    outline = lobe_curves(*lobe)[0]
    middle = np.array([size * np.cos(tilt), 0.0, size * np.sin(tilt)])  # on the axis of the lobe
    for scale, inside in ((0.98, True), (1.02, False)):
        points = (middle + scale * (outline - middle))[2:-2]
        np.testing.assert_array_equal(np.asarray(lobe_margin(points, *lobe)) > 0, inside)
    np.testing.assert_allclose(lobe_margin(outline[2:-2], *lobe), 0, atol=1e-6 * size)


def test_the_lobe_by_hand_and_its_symmetry(rng):
    """At half the range, u = 1: |z| <= h a 2^(-e / 2)."""
    margin = lobe_margin(np.float32([[3.0, 4.0, 1.0], [-4.0, 3.0, -1.0]]), 10.0, 1.3, 0.8, 0.0)
    np.testing.assert_allclose(margin, 0.8 * 5 * 2**-0.65 - 1, rtol=1e-6)
    up = lobe_margin(np.float32([[5.0, 0.0, 1.5], [5.0, 0.0, -1.5]]), 10.0, 1.3, 0.5, 0.3)
    np.testing.assert_array_equal(np.asarray(up) > 0, [True, False])  # positive tilt raises the lobe
    assert float(lobe_margin(np.float32([10.1, 0, 0]), 10.0, 1.3, 1.0, 0.0)) < 0


def test_exposure_is_the_time_of_detection_since_the_reset():
    sim = Sim(n_worlds=3, n_drones=2, control="rotor_vel")
    sim.data = with_states(
        sim.data, pos=np.array([[[5, 0, 4.0], [6, 0, 9.3]], [[9, 0, 4.0], [11, 0, 4]], [[0, 2, 4], [0, 2, 9]]])
    )
    sim.build_default_data()
    radar = sim.add(Radar([[0, 0, 4.0], [5.0, 0.0, 9.0]], max_range=[10.0, 4.0], exponent=1.3))
    expected = [[[1, 0], [0, 1]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]]
    np.testing.assert_array_equal(radar.detects(sim.data), expected)
    sim.step(5)
    np.testing.assert_allclose(radar.read(sim.data).exposure, np.array(expected) * 5 / sim.freq, rtol=1e-5)
    assert sim.plugins.observations(sim.data)["radar.margin"].shape == (3, 2, 2)
    sim.reset(np.array([True, False, False]))
    assert not np.asarray(radar.read(sim.data).exposure)[0].any()
    assert "radar" in str(sim.explain()).split("fused, for one drone:")[1].splitlines()[0]


def test_the_lobe_is_drawn_in_red_where_it_detects():
    sim = Sim(n_worlds=2, control="rotor_vel")
    sim.data = with_states(sim.data, pos=np.array([[[5, 0, 4.0]], [[50, 0, 4.0]]]))
    radar = sim.add(Radar((0, 0, 4.0), visible=True))
    for world, is_red in ((0, True), (1, False)):
        overlays = sim.scene.renderer.overlays
        radar.draw(sim, world)
        assert len(overlays) > 500
        color = overlays._geoms[0][4]
        assert (color[0] > color[2]) == is_red
        overlays.clear()
    sim.add(Radar((0, 0, 4.0)), name="hidden").draw(sim, 0)
    assert len(sim.scene.renderer.overlays) == 0
