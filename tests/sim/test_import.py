"""Importing the package and flying import nothing besides JAX and MuJoCo."""

import json
import os
import subprocess
import sys

import pytest

PROGRAM = """
import json, sys
import jax, mujoco
def packages():
    return {name.split(".")[0] for name in sys.modules} | {name for name in sys.modules if name == "mujoco.mjx"}
before = packages()
import crazysim
sim = crazysim.Sim(n_worlds=2)
sim.step()
sim.reset()
sim.data
sim.scene.add("gate")
sim.step()
unused = ("crazysim.lab", "crazysim.plugins.effects", "crazysim.plugins.estimators")
assert not [name for name in sys.modules if name.startswith(unused)]
print(json.dumps(sorted(packages() - before - set(sys.stdlib_module_names))))
import crazysim.lab.commands.validate  # Crazyflow, which it compares with, refuses to be imported after SciPy
assert "scipy" not in sys.modules
from crazysim.scene import mjx
assert mjx.Model is sys.modules["mujoco.mjx"].Model
assert isinstance(sim.mjx_data, mjx.Data)
assert not {"warp", "trimesh"} & sys.modules.keys()
"""


@pytest.fixture(scope="module")
def printed_lines():
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM], capture_output=True, text=True, env=os.environ, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.splitlines()


def test_flying_imports_neither_mjx_nor_anything_else(printed_lines):
    """MJX is imported for contacts only."""
    assert json.loads(printed_lines[0]) == ["crazysim"]


def test_importing_mjx_prints_nothing_and_does_not_import_warp(printed_lines):
    assert len(printed_lines) == 1


def test_an_unknown_name_of_mjx_is_an_attribute_error():
    from crazysim.scene import mjx

    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        mjx.nothing  # noqa: B018
