"""Names of the last release in scene and media: they work, and the warning points to the line that uses them."""

import pytest

from crazysim import Sim, media
from crazysim.media import View, render_worlds


def test_the_overlays_of_a_simulation():
    sim = Sim()
    with pytest.warns(DeprecationWarning, match=r"Sim\.marks .*; use Sim\.overlays") as caught:
        assert sim.marks is sim.overlays
    assert caught[0].filename == __file__


def test_images_of_many_worlds():
    with pytest.warns(DeprecationWarning, match=r"media\.pictures_of .*; use crazysim\.media\.render_worlds") as caught:
        assert media.pictures_of is render_worlds
    assert caught[0].filename == __file__


def test_the_image_of_a_view(opengl):
    sim, view = Sim(), View(width=32, height=24)
    with pytest.warns(DeprecationWarning, match=r"View\.picture .*; use View\.render") as caught:
        assert (view.picture(sim) == view.render(sim)).all()
    assert caught[0].filename == __file__
    sim.close()
