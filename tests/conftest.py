"""Shared by all tests: four host devices, a persistent compilation cache, and simulations built once."""

import ctypes
import gc
import os

import compiling
import machine

os.environ.setdefault("MUJOCO_GL", "egl")
# Threads of NumPy's linear algebra spin while they wait: a tenth of the processor time of fits and plans.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# XLA logs an error of 3,000 characters for every program from the cache that could use another vector width.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.update(compiling.environment(os.environ))

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from crazysim.engine.backends import cuda

cuda.nvrtc()  # loaded first: a process full of other libraries may have no room left for its thread-local storage

# Compilation inside an example must not count as slowness. `make test` tries the same examples every time, and `make
# test-all` new ones, with health checks.
settings.register_profile(
    "same", deadline=None, derandomize=True, max_examples=30, suppress_health_check=list(HealthCheck)
)
settings.register_profile("explore", deadline=None, max_examples=200)
settings.load_profile(os.environ.get("CRAZYSIM_HYPOTHESIS", "same"))


def pytest_xdist_auto_num_workers():
    return machine.n_workers(machine.cores(), machine.memory())


def pytest_collection_finish():
    """Collect garbage less often: tracing makes millions of objects, and collections took a tenth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 100)


@pytest.fixture(scope="module", autouse=True)
def _drop_programs():
    """Drop compiled programs after a file of tests if there are many, and return their memory, which glibc keeps."""
    yield
    if machine.process_memory() > machine.KEPT_MEMORY:
        jax.clear_caches()
        gc.collect()
        getattr(ctypes.CDLL(None), "malloc_trim", lambda _: None)(0)


MAX_UNEXPLAINED_S = 5
"""Processor time above which a test needs a reason, s."""
REASONS = ("long", "slow")
"""Markers whose argument is the reason."""
START_TIME = pytest.StashKey[float]()


def _processor_time():
    return sum(os.times()[:4])  # of this process and of its children that have ended


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item):
    """Store the processor time at which a test begins."""
    item.stash[START_TIME] = _processor_time()
    yield


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    outcome = yield
    report = outcome.get_result()
    if report.skipped and os.environ.get("CRAZYSIM_NO_SKIP"):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid} was skipped where CRAZYSIM_NO_SKIP forbids it: {report.longrepr}"
    if report.when == "teardown":
        report.user_properties.append(("processor_s", round(_processor_time() - item.stash[START_TIME], 2)))
        report.user_properties += [("reason", mark.args[0]) for mark in item.iter_markers() if mark.name in REASONS]


def pytest_terminal_summary(terminalreporter):
    reports_with_times = (
        r for reports in terminalreporter.stats.values() for r in reports if getattr(r, "user_properties", None)
    )
    properties = {report.nodeid: dict(report.user_properties) for report in reports_with_times}
    slow_tests = sorted(
        (-entry["processor_s"], name) for name, entry in properties.items() if entry["processor_s"] > MAX_UNEXPLAINED_S
    )
    if slow_tests:
        terminalreporter.section(f"tests over {MAX_UNEXPLAINED_S} s of processor time")
    for seconds, name in slow_tests:
        reason = properties[name].get("reason", "no reason given: share what it builds, or mark it long")
        terminalreporter.write_line(f"{-seconds:5.1f} s  {name}: {reason}")


@pytest.fixture
def x64():
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
    return np.random.default_rng(20261121)


@pytest.fixture(scope="session")
def plain_scene(tmp_path_factory):
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
    """Return a browser that leaves its page when the test ends; pages of flights have simple lights."""
    from browsing import use_simple_lights

    use_simple_lights(monkeypatch.setattr)
    yield _chromium
    _chromium.call("Page.navigate", url="about:blank")


def can_render():
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
