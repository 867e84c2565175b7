"""Variables of the environment that are set before JAX and MuJoCo are imported."""

import os
import subprocess
import sys

import pytest

from crazysim import startup

VARIABLES = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
PROGRAM = """
import os
from crazysim import Sim
print(os.environ["MUJOCO_GL"], Sim().render("rgb_array", width=64, height=48).shape)
"""


@pytest.fixture
def bare_environment(monkeypatch):
    """Remove the variables of screens and backends, and return ``monkeypatch``."""
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


@pytest.mark.skipif(sys.platform != "linux", reason="EGL is how Linux draws without a screen")
def test_images_need_no_setting_without_a_screen():
    environment = {key: value for key, value in os.environ.items() if key not in VARIABLES}
    result = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
    assert result.stdout.split() == ["egl", "(48,", "64,", "3)"], result.stderr


@pytest.mark.parametrize("variable", VARIABLES)
def test_a_screen_or_a_choice_is_kept(bare_environment, variable):
    bare_environment.setenv(variable, "osmesa")
    before = dict(os.environ)
    startup.set_variables()
    assert dict(os.environ) == before


def test_without_egl_nothing_is_chosen(bare_environment):
    def missing(name):
        raise OSError(name)

    bare_environment.setattr(startup.ctypes, "CDLL", missing)
    startup.set_variables()
    assert "MUJOCO_GL" not in os.environ


def test_the_log_of_xla_is_quiet_unless_chosen(monkeypatch):
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
    startup.set_variables()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    startup.set_variables()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "0"


def test_warnings_as_errors_blame_the_variable_and_no_package():
    environment = os.environ | {"MUJOCO_GL": "nope"}
    program = [sys.executable, "-W", "error::UserWarning", "-c", "import crazysim"]
    result = subprocess.run(program, env=environment, capture_output=True, text=True)
    assert "expected a MUJOCO_GL that MuJoCo can use, got 'nope'" in result.stderr
    assert "Install it again" not in result.stderr
