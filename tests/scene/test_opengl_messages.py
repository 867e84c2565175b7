"""What MuJoCo reports: how it draws is chosen at its import, and where that fails, the message has the remedy."""

import os
import subprocess
import sys

import pytest
from mujoco.rendering.classic import gl_context

from crazysim import Sim, startup
from crazysim.errors import RenderError


def test_a_way_to_draw_that_mujoco_does_not_have_is_named(monkeypatch):
    """``tests/test_info.py`` imports crazysim with such a variable, after which MuJoCo has no context."""
    monkeypatch.setitem(startup.refused_variables, "MUJOCO_GL", "osmesa")
    monkeypatch.delattr(gl_context, "GLContext")
    with pytest.raises(RenderError, match=r"with which MuJoCo can draw, got 'osmesa'\. Use MUJOCO_GL=egl"):
        Sim().render("rgb_array", width=32, height=24)


PROGRAM = """
import mujoco
from crazysim import Sim
sim = Sim()
box = mujoco.MjSpec.from_string('<mujoco><worldbody><body name="box"><geom size="0.1"/></body></worldbody></mujoco>')
sim.spec.worldbody.add_frame().attach_body(box.body("box"), "", ":0")
sim.build_mjx()
for fail in (lambda: Sim(xml_path="scene"), lambda: sim.render("rgb_array")):
    try:
        fail()
    except (ValueError, RuntimeError) as error:
        print(error)
"""
"""Imports MuJoCo first, attaches a body without a prefix, as in Crazyflow's documentation, and reads a file that MuJoCo
cannot name."""


@pytest.mark.long("a process that imports JAX")
def test_a_program_that_imports_mujoco_first_gets_the_remedy_and_no_log_in_its_folder(tmp_path):
    environment = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")}
    (tmp_path / "scene").write_text("<mujoco/>")
    command = [sys.executable, "-W", "ignore", "-c", PROGRAM]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "expected a scene that MuJoCo can read" in done.stdout
    assert "Import crazysim before mujoco, or set MUJOCO_GL=egl before Python starts." in done.stdout
    assert done.stderr.startswith("MuJoCo: ")
    assert "prefix" not in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
