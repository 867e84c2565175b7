"""Settings of images that a CPU draws, on machines whose OpenGL has no GPU."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterator

import mujoco
from mujoco.rendering.classic import gl_context

from crazysim.errors import ConfigError

QUALITY_VARIABLE = "CRAZYSIM_RENDERING"
"""Environment variable: ``full`` for the scene's quality on every machine, ``fast`` for the quality of CPUs."""
CPU_RENDERERS = ("llvmpipe", "softpipe", "swrast", "software rasterizer")
"""Parts of the names of OpenGL renderers that run on CPUs, in lower case."""
QUALITY_LIMITS = {"offsamples": 0, "shadowsize": 0, "numslices": 16, "numstacks": 8}
"""Largest settings of MuJoCo's quality where a CPU draws.

Samples of a pixel; width of the map of shadows, pixels, 0 for no shadows; meridians and parallels of round shapes. With
llvmpipe an image of 640 x 360 pixels takes less than a third of the time that it takes with 4 samples and a map of
4096, and four Crazyflies a third less than with MuJoCo's 28 meridians. With smaller maps, small images show false
shadows.
"""


def is_fast() -> bool:
    """Return True where images are drawn with the settings of CPUs."""
    quality = os.environ.get(QUALITY_VARIABLE, "")
    if quality not in ("", "full", "fast"):
        raise ConfigError(f"expected full or fast in {QUALITY_VARIABLE}, got {quality!r}. Correct it, or unset it.")
    return quality == "fast" or (not quality and is_software())


@functools.cache
def is_software() -> bool:
    """Return True where OpenGL draws on the CPU; False where there is no OpenGL."""
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
    return any(x in name for x in CPU_RENDERERS)


@contextlib.contextmanager
def rendering_quality(model: mujoco.MjModel) -> Iterator[None]:
    """Give a model the settings for this machine while a context is created, which reads them only then."""
    if not is_fast():
        yield
        return
    settings = model.vis.quality
    before = [getattr(settings, name) for name in QUALITY_LIMITS]
    for (name, limit), value in zip(QUALITY_LIMITS.items(), before, strict=True):
        setattr(settings, name, min(value, limit))
    try:
        yield
    finally:
        for name, value in zip(QUALITY_LIMITS, before, strict=True):
            setattr(settings, name, value)


def film_size(width: int, height: int) -> tuple[int, int]:
    """Return the size of a film, pixels: two thirds of the given one, in even numbers, where a CPU draws."""
    return (width // 3 * 2, height // 3 * 2) if is_fast() else (width, height)
