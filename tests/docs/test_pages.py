"""Every Python block of every page runs, in the order of the page, and prints its output."""

import sys

import pytest
from pages import FIRST_PAGES, PAGES, ROOT, outputs, run


@pytest.mark.long("runs every block of a page as a reader would")
@pytest.mark.parametrize(
    "page", [page for page in PAGES if page not in FIRST_PAGES], ids=lambda page: str(page.relative_to(ROOT))
)
def test_page_runs(page, tmp_path, monkeypatch, opengl):
    monkeypatch.chdir(tmp_path)
    run(page)


SCENE_PAGES = ("docs/concepts/scene.md", "docs/coming-from-crazyflow.md")
"""Pages with scene code written for Crazyflow."""
CRAZYFLOW_LINES = (
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


def test_scene_code_of_crazyflow_is_on_the_pages():
    code = "".join(block.code for page in SCENE_PAGES for block in outputs.blocks((ROOT / page).read_text()))
    for line in CRAZYFLOW_LINES:
        assert line in code, line


def test_pages_have_code():
    assert sum(len(list(outputs.blocks(page.read_text()))) for page in PAGES) > 20


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("[0.5 1.]\n", "[0.5   1.]\n", True),
        ("[0.50 1.25]", "[0.51 1.23]", True),
        ("0.500", "0.515", False),
        ("(64, 2)", "(65, 2)", False),
        ("3.1e-08", "-4.9e-08", True),
        ("3.1e-03", "4.9e-03", False),
        ("-0.001", "0.001", True),
        ("-0.01", "0.02", False),
        ("True False", "True True", False),
        ("0.5 0.5", "0.5", False),
        ("engine: fused, ... steps", "engine: fused, 12 of 13 steps", True),
        ("engine: fused, ... steps", "engine: lanes, 12 of 13 steps", False),
        ("a ... b ... c", "a 1 b c", True),
        ("a ... b ... c", "a 1 c", False),
    ],
)
def test_outputs_are_compared_to_the_digits_that_a_page_shows(shown, printed, same):
    assert outputs.is_same_output(shown, printed) is same


def test_numbers_of_the_first_pages_are_compared_more_closely():
    assert outputs.is_same_output("[0.49969438]", "[0.49951503]")
    assert not outputs.is_same_output("[0.49969438]", "[0.49951503]", tolerance=outputs.CLOSE_TOLERANCE)


def test_an_example_output_may_differ_in_its_numbers():
    text = '```python\nprint(1)\n```\n\n```text title="for example"\nsuccess 0.5% in 12 s\n```\n'
    (block,) = outputs.blocks(text)
    assert block.example
    assert outputs.is_same_output(block.output, "success 100% in 3.2 s", block.example)
    assert not outputs.is_same_output(block.output, "crashed 100% in 3.2 s", block.example)
    assert not outputs.is_same_output(block.output, "success 100% in 3.2 s")


def test_an_output_belongs_to_the_block_before_it():
    text = "```python\nprint(1)\n```\n\n```text\n1\n```\n\n```python\nx = 1\n```\n\nPlan:\n\n```text\nx\n```\n"
    assert [block.output for block in outputs.blocks(text)] == ["1\n", None]


def test_a_block_with_a_title_is_a_separate_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (
        '```python title="mine.py"\nx = 1\nif __name__ == "__main__":\n    print("main")\n```\n\n'
        "```python\ny = 2\n```\n\n"
        '```python title="other.py"\nfrom mine import x\nprint(x, "y" in globals())\n```\n\n'
        '```python title="wrong.py"\nprint(x)\n```\n'
    )
    first, plain, other, wrong = outputs.blocks(text)
    namespace = {"__name__": "page"}
    assert outputs.run_block(first, tmp_path / "page.md", namespace) == "main\n"
    assert outputs.run_block(plain, tmp_path / "page.md", namespace) == ""
    assert outputs.run_block(other, tmp_path / "page.md", namespace) == "1 False\n"
    with pytest.raises(NameError, match="'x' is not defined"):
        outputs.run_block(wrong, tmp_path / "page.md", namespace)
    assert "mine" not in sys.modules
    assert (tmp_path / "mine.py").read_text().startswith("x = 1\n")
