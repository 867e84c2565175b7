"""Machines without a GPU are recognised, and draw the same scene with less work."""

import mujoco
import numpy as np
import pytest

from crazysim import ConfigError, Sim
from crazysim.scene import software


@pytest.fixture
def set_renderer(monkeypatch):
    """Return a function that sets the name of OpenGL's renderer, and clears what was concluded from the last name."""
    from OpenGL import GL

    def rename(name):
        monkeypatch.setattr(GL, "glGetString", lambda _: name)
        software.has_software_renderer.cache_clear()

    monkeypatch.delenv(software.QUALITY_VARIABLE, raising=False)
    yield rename
    software.has_software_renderer.cache_clear()


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (b"llvmpipe (LLVM 15.0.6, 256 bits)", True),
        (b"softpipe", True),
        (b"NVIDIA H200/PCIe/SSE2", False),
        (b"Mesa Intel(R) UHD Graphics 630 (CFL GT2)", False),
        (None, False),
    ],
)
def test_the_name_of_the_renderer_tells_a_cpu_from_a_gpu(opengl, set_renderer, name, expected):
    set_renderer(name)
    assert software.uses_cpu_quality() == expected
    assert software.film_size(960, 544) == ((640, 362) if expected else (960, 544))


def test_the_variable_takes_precedence_over_the_renderer(opengl, set_renderer, monkeypatch):
    set_renderer(b"llvmpipe")
    monkeypatch.setenv(software.QUALITY_VARIABLE, "full")
    assert not software.uses_cpu_quality()
    set_renderer(b"NVIDIA H200/PCIe/SSE2")
    monkeypatch.setenv(software.QUALITY_VARIABLE, "fast")
    assert software.uses_cpu_quality()


def test_a_wrong_variable_is_an_error(monkeypatch):
    monkeypatch.setenv(software.QUALITY_VARIABLE, "quick")
    with pytest.raises(ConfigError, match=r"expected full or fast in CRAZYSIM_RENDERING, got 'quick'"):
        Sim().render("rgb_array", width=32, height=24)


def test_quality_settings_change_only_while_a_context_is_made(monkeypatch):
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><visual><quality offsamples='8' shadowsize='512'/></visual></mujoco>"
    )
    monkeypatch.setenv(software.QUALITY_VARIABLE, "fast")
    with software.rendering_quality(model):
        assert (model.vis.quality.offsamples, model.vis.quality.numslices) == (0, 16)
    assert (model.vis.quality.offsamples, model.vis.quality.numslices) == (8, 28)


def test_a_fast_image_shows_the_same_scene_with_jagged_edges(opengl, monkeypatch):
    images = {}
    for quality in ("full", "fast"):
        monkeypatch.setenv(software.QUALITY_VARIABLE, quality)
        sim = Sim()
        sim.scene.add("pole", count=1, pos=[[0.0, 0.5, 0.0]], height=1.0, radius=0.05)
        config = {"lookat": [0, 0, 0.3], "distance": 1.5, "azimuth": 90, "elevation": -20}
        images[quality] = sim.render("rgb_array", cam_config=config, width=240, height=180).astype(int)
        sim.close()
    difference = np.abs(images["full"] - images["fast"]).max(-1)
    assert np.mean(difference > 24) < 0.05, "edges and shadows differ, and nothing else"
    n_colors = {quality: len(np.unique(image.reshape(-1, 3), axis=0)) for quality, image in images.items()}
    assert n_colors["fast"] < n_colors["full"], "samples of a pixel mix the colours at edges"
