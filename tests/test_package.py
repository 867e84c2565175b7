"""The package as its users get it: what it needs, what it exports, what the wheel holds."""

import ast
import importlib
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import crazysim

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SOURCES = sorted((ROOT / "crazysim").rglob("*.py"))


def test_runtime_needs_exactly_five_packages():
    names = {requirement.split(">")[0].split("[")[0].strip() for requirement in PROJECT["dependencies"]}
    assert names == {"jax", "mujoco", "mujoco-mjx", "numpy", "gymnasium"}


def test_public_names_exist_once():
    assert len(crazysim.__all__) == len(set(crazysim.__all__))
    assert all(hasattr(crazysim, name) for name in crazysim.__all__)
    assert crazysim.__version__ == PROJECT["version"]


@pytest.mark.parametrize(
    "path", ["sim.Sim", "sim.data.SimData", "sim.functional.state_control", "sim.pipeline.append_fn",
             "sim.sim.sync_sim2mjx", "sim.sim.use_box_collision", "sim.visualize.draw_line", "sim.sharding.world_mesh",
             "sim.sensors.depth.render_depth",
             "control.Control", "dynamics.Dynamics", "drones.Drone",
             "dynamics.supported_drones", "dynamics.supported_dynamics", "exception.ConfigError"],
)  # fmt: skip
def test_the_peers_import_paths_lead_somewhere(path):
    module, _, name = path.rpartition(".")
    assert hasattr(importlib.import_module(f"crazysim.{module}"), name)


def test_extras_are_never_imported_at_module_level():
    extras = {"matplotlib", "imageio_ffmpeg", "tqdm", "casadi", "viser", "trimesh", "onnx", "pettingzoo", "brax"}
    extras |= {"stable_baselines3", "torch"}
    for source in SOURCES:
        for node in ast.parse(source.read_text()).body:
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not extras & {name.split(".")[0] for name in names}, source


def test_every_module_and_public_function_has_a_docstring():
    for source in SOURCES:
        tree = ast.parse(source.read_text())
        assert ast.get_docstring(tree), source
        for node in tree.body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                assert ast.get_docstring(node), f"{source}: {node.name}"


def test_the_wheel_holds_scene_airframes_and_type_marker(tmp_path):
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path], cwd=ROOT, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    for needed in ("crazysim/scene.xml", "crazysim/py.typed", *(f"crazysim/drones/{d}.toml" for d in crazysim.Drone)):
        assert needed in names
    assert not [name for name in names if name.startswith("tests")]


def test_the_readme_begins_with_what_it_is_and_is_not():
    lines = (ROOT / "README.md").read_text().split("\n## ")[0]
    assert "drone simulator" in lines
    assert "not the firmware-in-the-loop simulator of the same name" in lines.replace("\n", " ")


def test_the_fast_tests_exist():
    """A file that was moved would end ``make test-fast`` before its first test."""
    commands = subprocess.run(["make", "-n", "test-fast"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    paths = [word for word in commands.split() if word.startswith("tests/")]
    assert len(paths) > 20
    assert [path for path in paths if not (ROOT / path).exists()] == []
