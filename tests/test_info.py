"""Output of ``crazysim info``, on complete and incomplete installations."""

import importlib.metadata
import os
import shutil
import subprocess
import sys

import jax
import pytest

import crazysim
from crazysim.__main__ import main
from crazysim.commands.info import OPTIONAL_PACKAGES, REQUIRED_PACKAGES, VARIABLES
from crazysim.engine.cache import default_folder


def lines(text):
    return {name: value.strip() for name, _, value in (line.partition(":") for line in text.splitlines())}


def test_it_prints_versions_devices_compiler_and_caches(capsys):
    assert main(["info"]) == 0
    result = lines(capsys.readouterr().out)
    assert result["crazysim"].startswith(crazysim.__version__)
    assert result["Python"].startswith(".".join(map(str, sys.version_info[:3])))
    assert "CPU cores" in result["system"]
    for name in REQUIRED_PACKAGES:
        assert result[name] == importlib.metadata.version(name)
    assert result["devices"].count("cpu") >= len(jax.devices("cpu"))
    if shutil.which("g++"):
        assert "g++" in result["C++ compiler"]
        assert "-O2" in result["C++ compiler"]
    assert jax.config.jax_compilation_cache_dir in result["cache"].replace("~", os.path.expanduser("~"))
    assert " MB in " in result["cache"]
    assert result["rendering"].startswith(os.environ["MUJOCO_GL"])


def test_missing_parts_are_lines_with_the_reason(tmp_path):
    """The process has no compiler, OpenGL or cache. Other variables stay, since Python may need them to find JAX."""
    other_variables = {name: value for name, value in os.environ.items() if name not in (*VARIABLES, "DISPLAY")}
    environment = other_variables | {
        "PATH": str(tmp_path), "HOME": str(tmp_path), "MUJOCO_GL": "disable", "JAX_PLATFORMS": "cpu"
    }  # fmt: skip
    program = "import sys; sys.modules['ziglang'] = None; from crazysim.__main__ import main; sys.exit(main(['info']))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=True)
    result = lines(done.stdout)
    assert result["C++ compiler"].startswith("none")
    assert result["cache"] == f"~/.cache/crazysim/jax/{default_folder().name}: not there yet"
    assert result["rendering"].startswith("disable, fails: ")
    assert "JAX_PLATFORMS=cpu" in result["variables"]


@pytest.mark.parametrize("missing", [OPTIONAL_PACKAGES, (*OPTIONAL_PACKAGES, "mujoco-mjx")])
def test_missing_packages_are_named(monkeypatch, capsys, missing):
    def version(name, real=importlib.metadata.version):
        if name in missing:
            raise importlib.metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert main(["info"]) == 0
    result = lines(capsys.readouterr().out)
    assert result["extras"] == "none"
    assert (result["mujoco-mjx"] == "not installed") == ("mujoco-mjx" in missing)


def test_broken_settings_are_lines_with_the_reason(monkeypatch, capsys):
    monkeypatch.setenv("CXXFLAGS", "'-O2")
    assert main(["info"]) == 0
    assert "words in CXXFLAGS" in lines(capsys.readouterr().out)["C++ compiler"]


@pytest.mark.parametrize("package", ["jax", "mujoco"])
def test_a_broken_package_is_a_line_and_no_traceback(tmp_path, package):
    (tmp_path / f"{package}.py").write_text("raise ImportError('libbroken.so: no such file')")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}

    def run(*words):
        done = subprocess.run([sys.executable, *words], capture_output=True, text=True, env=environment)
        return done.returncode, done.stderr

    words = (
        f"expected the package '{package}' to be importable, got ImportError: libbroken.so: no such file. Install it "
        f"again: pip install --force-reinstall {package}\n"
    )
    assert run("-m", "crazysim", "info") == (2, f"crazysim: {words}")
    status, text = run("-c", "import crazysim")
    assert status == 1
    assert text.endswith(f"ImportError: {words}")


def test_a_backend_that_cannot_be_used_is_a_line():
    """MuJoCo ends its import at a ``MUJOCO_GL`` that it does not have, or whose library is missing."""
    done = subprocess.run(
        [sys.executable, "-m", "crazysim", "info"],
        capture_output=True,
        text=True,
        env=os.environ | {"MUJOCO_GL": "nope"},
    )
    assert done.returncode == 0
    assert "expected a MUJOCO_GL that MuJoCo can use, got 'nope'" in done.stderr
    result = lines(done.stdout)
    assert result["rendering"].startswith("nope, fails: RuntimeError: invalid value")
    assert "MUJOCO_GL=nope" in result["variables"]
