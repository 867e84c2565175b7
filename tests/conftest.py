"""Shared by all tests: two host devices, a persistent compilation cache, and simulations built once."""

import gc
import io
import os
import socket
import subprocess
import sys
from pathlib import Path

import compiling

os.environ.setdefault("MUJOCO_GL", "egl")
# XLA logs an error of 3,000 characters for every program from the cache that could use another vector width.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.update(compiling.environment(os.environ))
# A program's operations do not carry the lines of Python that made them: writing it takes less time.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

import first_steps
import jax
import late_kernels
import numpy as np
import pytest
import quick_tracing
import small_programs
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crazysim.engine import cuda

gc.disable()  # see pytest_collection_finish
compiling.share_mlir_context()
quick_tracing.install()
first_steps.install()
late_kernels.install()
if not os.environ.get("CRAZYSIM_COMPILE"):
    small_programs.interpret()
cuda.nvrtc()  # loaded first: a process full of other libraries may have no room left for its thread-local storage

os.environ["CXXFLAGS"] = os.environ.get("CXXFLAGS", "") + compiling.precompiled_headers()
# What was compiled once is kept, in any worker, any run, and any process that a test starts.
os.environ.update(compiling.cache())
jax.config.update("jax_compilation_cache_dir", str(compiling.CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", compiling.SHORT)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

# Compilation inside an example must not count as slowness, and CI must not depend on luck.
settings.register_profile(
    "crazysim", deadline=None, derandomize=True, max_examples=30, suppress_health_check=list(HealthCheck)
)
settings.load_profile("crazysim")


LONGEST = ("engine/test_step.py", "scene/test_response.py", "train/test_run.py", "envs", "laws", "engine", "scene")
"""Files and folders that take longest, first."""
SEPARATE = "docs"
"""Folder whose tests share nothing and go last, one by one, to the worker that has no more to do."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Let one worker run what is in one file, which shares simulations and programs, and the longest files first."""

    def path(item):
        return item.path.relative_to(Path(__file__).parent).as_posix()

    def rank(item):
        first = next((i for i, name in enumerate(LONGEST) if path(item).startswith(name)), len(LONGEST))
        return first + path(item).startswith(SEPARATE)

    for item in items:
        if not path(item).startswith(SEPARATE) and item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(path(item)))
    items.sort(key=rank)


open_at_start, suspects = [], []
"""Files, sockets and processes: those open before the first test, and those open when others were frozen."""


def pytest_collection_finish():
    """Leave garbage to ``pytest_runtest_teardown``: tracing makes millions of objects, and looking took a tenth of all.

    What is imported by now stays. Hypothesis looks as well, when it runs the first example of a process.
    """
    first_example()
    gc.collect()
    open_at_start.extend(opened())
    gc.freeze()


@settings(max_examples=1, database=None)
@given(st.none())
def first_example(_):
    """Do nothing."""


IN_NUMPY = (
    "control", "core", "drones", "dynamics", "effects", "envs", "geometry", "media", "payloads", "scene", "shows",
    "sim", "test_export.py", "test_main.py", "test_rotation.py", "train", "trajectories",
)  # fmt: skip
"""Folders in which programs of JAX are interpreted: their subject is not the compiler, and their flights are short."""
KERNELS_LATE = (*IN_NUMPY, "laws")
"""Folders in which steps are taken in Python before a kernel is compiled; CI also compiles the laws at once."""


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    """Compile what a test asks for; what a fixture makes is made as the first test that uses it is run.

    CRAZYSIM_COMPILE=1 compiles everything at once.
    """
    folder = item.path.relative_to(Path(__file__).parent).parts[0]
    free = not os.environ.get("CRAZYSIM_COMPILE") and item.get_closest_marker("compiled") is None
    small_programs.active = free and folder in IN_NUMPY
    late_kernels.active = free and folder in KERNELS_LATE and item.get_closest_marker("kernels") is None
    small_programs.patience = 1 if item.get_closest_marker("steady") is None else 10
    yield


WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
MEMORY = 0.7 / WORKERS * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2e9
"""Memory of a worker, bytes, above which it looks for garbage between two files: together a part of the machine's."""
GROWTH = 1.3
"""Factor by which its memory has grown when it looks again: one look takes seconds."""
limit = MEMORY


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    """Look for garbage where a file ends: simulations hold the programs that were compiled for them.

    What is left is not looked at again. After the last test nothing is looked for, which would take 15 s; what a test
    left open fails it.
    """
    global limit
    if nextitem is None:
        known = {id(x) for x in open_at_start}
        left = [x for x in (*suspects, *opened()) if id(x) not in known and is_open(x)]
        gc.freeze()
        assert not left, "tests close what they open"
    elif nextitem.path != item.path and memory() > limit:
        gc.collect()
        suspects.extend(opened())
        gc.freeze()
        limit = max(MEMORY, GROWTH * memory())


def opened():
    """Return what is open in this process, without libraries' own files: files, sockets, and children that run."""
    objects = gc.get_objects()  # millions: asking each for its kind would take four times as long
    kinds = {kind for kind in set(map(type, objects)) if issubclass(kind, io.FileIO | socket.socket | subprocess.Popen)}
    some = [x for x in objects if type(x) in kinds]
    return [x for x in some if is_open(x) and not str(getattr(x, "name", "")).startswith(sys.prefix)]


def is_open(x):
    """Return whether a file or a socket is open, or a process runs."""
    if isinstance(x, subprocess.Popen):
        return x.poll() is None
    return x.fileno() >= 0 if isinstance(x, socket.socket) else not x.closed


def memory():
    """Return the memory of this process, bytes; 0 where the system does not say."""
    pages = Path("/proc/self/statm")
    return int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if pages.exists() else 0


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """Fail what is skipped where nothing may be: a skip in CI would hide a test that never ran."""
    outcome = yield
    report = outcome.get_result()
    if report.skipped and os.environ.get("CRAZYSIM_NO_SKIP"):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid} was skipped where CRAZYSIM_NO_SKIP forbids it: {report.longrepr}"


@pytest.fixture
def x64():
    """Run a test in float64."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def casadi():
    """Return CasADi, or skip a test where it is not installed; CI forbids the skip."""
    return pytest.importorskip("casadi")


@pytest.fixture(scope="session")
def viser():
    """Return viser, or skip a test where it is not installed; CI forbids the skip."""
    return pytest.importorskip("viser")


@pytest.fixture
def rng():
    """Return a generator that gives the same numbers in every run."""
    return np.random.default_rng(20261121)


@pytest.fixture(scope="session")
def plain_scene(tmp_path_factory):
    """Return the path of the plain scene's file."""
    from cases import PLAIN_SCENE

    path = tmp_path_factory.mktemp("scene") / "scene.xml"
    path.write_text(PLAIN_SCENE)
    return path


@pytest.fixture(scope="session")
def _chromium(tmp_path_factory):
    from browsing import start_browser

    browser = start_browser(tmp_path_factory.mktemp("browser"))
    yield browser
    browser.close()


@pytest.fixture
def chromium(_chromium, viser, monkeypatch):
    """Return a browser that leaves its page when the test ends; pages of flights are lit simply meanwhile."""
    from browsing import light_simply

    light_simply(monkeypatch.setattr)
    yield _chromium
    _chromium.call("Page.navigate", url="about:blank")


def can_render():
    """Return whether this machine can make an OpenGL context."""
    import mujoco

    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception:
        return False
    return True


@pytest.fixture(scope="session")
def opengl():
    """Skip a test where no OpenGL context can be made; CI forbids the skip."""
    if not can_render():
        pytest.skip("no working OpenGL")
