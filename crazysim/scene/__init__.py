"""Everything MuJoCo: the scene is built here, synced here, asked and drawn here."""

import contextlib
import io

# MJX prints two lines when NVIDIA Warp, which nothing here needs, is not installed.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx as mjx

__all__ = ["mjx"]
