"""Every Python block of every page runs, in the order of the page and in one namespace."""

import contextlib
import re
from pathlib import Path

import pytest
from drawing import draw_coarsely

from crazysim.engine import Step

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
ENGINE = re.compile(r"<!-- engine: (\w+) -->\n$")
"""In front of a block: engine of steps that are first taken there, as the fused one takes longer to compile.

The interpreter takes few steps, and the derivatives of ``plain`` compile soonest.
"""
PLAN = Step._plan


@contextlib.contextmanager
def planned_for(engine, monkeypatch):
    """Let steps be planned for an engine, where the page chooses none; steps behind the block are planned anew."""
    steps = []

    def plan(step, *data):
        if step.engine == "auto":
            steps.append(step)
            step.engine = engine
        return PLAN(step, *data)

    with monkeypatch.context() as patch:
        patch.setattr(Step, "_plan", plan)
        yield
    for step in steps:
        step.engine = "auto"
        step._plans.clear()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_page_runs(page, tmp_path, monkeypatch, opengl):
    monkeypatch.chdir(tmp_path)
    draw_coarsely(monkeypatch)
    text = page.read_text()
    for package, sign in (("casadi", "import casadi"), ("viser", "from crazysim.media import web")):
        if sign in text:
            pytest.importorskip(package)
    namespace = {"__name__": "page"}
    for block in BLOCK.finditer(text):
        # Blank lines in front, so that a traceback shows the line of the page.
        code = "\n" * text[: block.start()].count("\n") + "\n" + block.group(1)
        engine = ENGINE.search(text, 0, block.start())
        with planned_for(engine[1], monkeypatch) if engine else contextlib.nullcontext():
            exec(compile(code, str(page), "exec"), namespace)


SCENE_PAGES = ("docs/concepts/scene.md", "docs/guides/obstacles.md", "docs/guides/pictures.md")
PEER_CODE = (
    "sim = Sim(n_worlds=1, n_drones=1)",
    '<geom type="box" size="0.1 0.1 0.1" rgba="0.8 0.2 0.2 1"/>',
    "mujoco.MjSpec.from_string(box_xml)",
    "mujoco.MjSpec.from_file(",
    "frame = sim.spec.worldbody.add_frame()",
    'attached = frame.attach_body(body, "", f":{i}")',
    "attached.pos = pos",
    "sim.build_mjx()",
    "sim.reset()",
    "attached.mocap = True",
    "sim.mjx_data.mocap_pos",
    "if i % 5 == 0:",
    "contacts = sim.contacts()",
    "sim.data.core.mjx_synced",
    "import sync_sim2mjx",
    "_mjx_data = sim.mjx_data",
    "mjx_data = _mjx_data.replace(mocap_pos=obstacle_mocap_pos)",
    "_, mjx_data = sync_sim2mjx(sim_data, mjx_data,",
    "return mjx_data._impl.contact.dist < 0",
)
"""Scene code written for Crazyflow; each line is in an executed block of a page."""


def test_the_peers_way_with_the_scene_is_on_the_pages():
    code = "".join("".join(BLOCK.findall((ROOT / page).read_text())) for page in SCENE_PAGES)
    for line in PEER_CODE:
        assert line in code, line


def test_pages_have_code():
    assert sum(len(BLOCK.findall(page.read_text())) for page in PAGES) > 20
