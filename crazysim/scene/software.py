"""Quality settings of images that a CPU draws, on machines without a GPU for OpenGL."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterator

import mujoco
from mujoco.rendering.classic import gl_context

from crazysim.errors import require

QUALITY_VARIABLE = "CRAZYSIM_RENDERING"
"""Environment variable: ``full`` for the scene's quality on every machine, ``fast`` for the lower quality of CPUs."""
CPU_RENDERERS = ("llvmpipe", "softpipe", "swrast", "software rasterizer")
"""Substrings of the names of OpenGL renderers that run on CPUs, in lower case."""
QUALITY_LIMITS = {"offsamples": 0, "shadowsize": 0, "numslices": 16, "numstacks": 8}
"""Largest values of MuJoCo's quality settings if a CPU draws.

Samples of a pixel; width of the shadow map, pixels, 0 for no shadows; meridians and parallels of round shapes. With
llvmpipe an image of 640 x 360 pixels takes less than a third of the time that it takes with 4 samples and a shadow map
of 4096 pixels. Four Crazyflies take a third less time than with MuJoCo's 28 meridians. Smaller shadow maps would show
false shadows in small images.
"""


def uses_cpu_quality() -> bool:
    """Whether images are drawn with the lower quality for CPUs."""
    quality = os.environ.get(QUALITY_VARIABLE, "")
    require(
        quality in ("", "full", "fast"),
        f"expected full or fast in {QUALITY_VARIABLE}, got {quality!r}. Correct it, or unset it.",
    )
    return quality == "fast" or (not quality and has_software_renderer())


@functools.cache
def has_software_renderer() -> bool:
    """Whether OpenGL draws on the CPU; False if there is no OpenGL."""
    try:
        from OpenGL import GL

        context = gl_context.GLContext(8, 8)
        try:
            context.make_current()
            name = (GL.glGetString(GL.GL_RENDERER) or b"").decode(errors="replace").lower()
        finally:
            context.free()
    except Exception:  # bindings raise errors of any type, which the renderer itself reports
        return False
    return any(part in name for part in CPU_RENDERERS)


@contextlib.contextmanager
def rendering_quality(model: mujoco.MjModel) -> Iterator[None]:
    """Apply the quality of this machine to a model while a context is created: contexts read it only then."""
    if not uses_cpu_quality():
        yield
        return
    settings = model.vis.quality
    previous_values = [getattr(settings, name) for name in QUALITY_LIMITS]
    for (name, limit), value in zip(QUALITY_LIMITS.items(), previous_values, strict=True):
        setattr(settings, name, min(value, limit))
    try:
        yield
    finally:
        for name, value in zip(QUALITY_LIMITS, previous_values, strict=True):
            setattr(settings, name, value)


def film_size(width: int, height: int) -> tuple[int, int]:
    """Return width and height of a film, pixels: as passed, or even numbers near two thirds of them if a CPU draws."""
    return (width // 3 * 2, height // 3 * 2) if uses_cpu_quality() else (width, height)
