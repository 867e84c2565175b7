"""Compiled host kernels are reused on machines that they fit, and only there."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from random import Random

import pytest
from cases import shared_sim
from waiting import wait_for

from crazysim.engine import Step
from crazysim.engine.backends import fused, kernel, kernel_cache, native
from crazysim.engine.cache import default_folder
from crazysim.engine.errors import KernelError
from crazysim.errors import ConfigError
from crazysim.sim import Sim

COMPILER = native.compiler()
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")


@pytest.fixture(scope="module")
def source():
    """Return the source of a kernel that compiles fast: only the count of steps."""
    sim = shared_sim(n_worlds=2, n_drones=1, control="rotor_vel")
    clock = {"increment_steps": sim.step_pipeline["increment_steps"]}
    return kernel.write_kernel(Step(clock, "lanes").plan(sim.data).program, "host")


@pytest.fixture
def cache_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, "folder", lambda: tmp_path)
    monkeypatch.setattr(native, "_LIBRARIES", {})
    monkeypatch.setattr("crazysim.engine.jaxcompat.register_target", lambda name, function, platform: None)
    native.toolchain.cache_clear()
    yield tmp_path
    native.toolchain.cache_clear()


@pytest.fixture
def compilations(tmp_path_factory, monkeypatch):
    """Return a function that returns the number of compiled kernels, which a fake compiler counts."""
    folder = tmp_path_factory.mktemp("bin")
    install_fake_compiler(folder, monkeypatch)
    return lambda: len((folder / "compiled").read_text()) if (folder / "compiled").exists() else 0


def register_anew(source):
    native._LIBRARIES.clear()
    native.toolchain.cache_clear()
    return native.register_kernel(source)


def install_fake_compiler(folder, monkeypatch, version="1.0", march="znver3"):
    script = folder / "c++"
    script.write_text(
        f'#!/bin/sh\ncase "$*" in *"-###"*) echo "gcc version {version} -march={march}" >&2; exit 0;;\n'
        f'*kernel.cpp*) printf x >> {folder / "compiled"};; esac\nexec {COMPILER} "$@"\n'
    )
    script.chmod(0o755)
    monkeypatch.setattr(native, "compiler", lambda: str(script))


def test_a_kernel_is_compiled_once_for_all_processes(source, cache_folder, compilations):
    name = native.register_kernel(source)
    assert register_anew(source) == name
    assert compilations() == 1
    (library,) = cache_folder.iterdir()
    assert library.name.startswith(name.removeprefix("crazysim_advance_"))


def test_the_key_holds_machine_compiler_and_versions(source, cache_folder, compilations, monkeypatch):
    folder = Path(native.compiler()).parent
    names = [register_anew(source)]

    def assert_new_name(reason):
        names.append(register_anew(source))
        assert len(set(names)) == len(names), reason
        assert compilations() == len(names), reason

    install_fake_compiler(folder, monkeypatch, march="skylake")
    assert_new_name("another instruction set")
    install_fake_compiler(folder, monkeypatch, version="2.0")
    assert_new_name("another version of the compiler")
    install_fake_compiler(folder, monkeypatch)
    info = folder / "cpuinfo"
    info.write_text("processor\t: 0\nflags\t\t: fpu sse2 avx512f\n")
    monkeypatch.setattr("crazysim.engine.cache.CPU_INFO", info)
    assert_new_name("another CPU")
    info.write_text("processor\t: 0\nflags\t\t: fpu sse2\n")
    assert_new_name("a CPU with fewer features")
    info.write_text("processor\t: 0\nFeatures\t: fp asimd\n")
    assert_new_name("an ARM CPU")
    monkeypatch.setenv("CXXFLAGS", "-O1 -DOTHER")
    assert_new_name("other options")
    monkeypatch.setattr(native, "__version__", "99.0")
    assert_new_name("another version of this package")
    monkeypatch.setattr("crazysim.engine.jaxcompat.versions", lambda: "99.0")
    assert_new_name("another JAX")
    monkeypatch.setattr(native.platform, "libc_ver", lambda: ("glibc", "9.9"))
    assert_new_name("another C library")


@pytest.mark.parametrize("damage", [lambda raw: raw[: len(raw) // 2], lambda raw: b"", lambda raw: raw[:-8] + b"x" * 8])
def test_a_damaged_file_is_compiled_again(source, cache_folder, compilations, damage):
    """Loading half of a library could end the process, so files are checked first."""
    native.register_kernel(source)
    (library,) = cache_folder.iterdir()
    raw = library.read_bytes()
    library.unlink()  # it is loaded: its memory must stay as it is
    library.write_bytes(damage(raw))
    register_anew(source)
    assert compilations() == 2
    assert [native._load_library(path) is not None for path in cache_folder.iterdir()] == [True]


def test_a_library_that_does_not_load_here_is_compiled_again(source, cache_folder, compilations):
    """The file may belong to another machine, so it is not removed."""
    key = native.register_kernel(source).removeprefix("crazysim_advance_")
    (library,) = cache_folder.iterdir()
    library.unlink()
    foreign = kernel_cache.store_file(cache_folder, key, b"\x7fELF of another machine", ".so")
    register_anew(source)
    assert compilations() == 2
    assert foreign.exists()
    register_anew(source)
    assert compilations() == 2


def test_a_kernel_that_cannot_be_written_says_so(source, cache_folder, compilations, monkeypatch):
    def raise_no_space(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(kernel_cache, "store_file", raise_no_space)
    with pytest.raises(KernelError, match=r"cannot be written: .*No space left on device; make room, or set TMPDIR"):
        native.register_kernel(source)


def test_nothing_partial_is_ever_seen(source, cache_folder, monkeypatch, tmp_path_factory):
    listed = []

    def replace(self, target, real=Path.replace):
        listed.append([p.suffix for p in cache_folder.iterdir()])
        return real(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    native.register_kernel(source)
    assert listed == [[".part"]]
    assert [p.suffix for p in cache_folder.iterdir()] == [".so"]

    monkeypatch.setenv("CXXFLAGS", "-std=c++98")
    with pytest.raises(KernelError, match="refused the kernel"):
        register_anew(source)
    assert [p.suffix for p in cache_folder.iterdir()] == [".so"]
    assert not any(p.is_dir() for p in kernel_cache.temporary_folder().iterdir())


def test_a_shared_folder_that_cannot_be_written_is_not_used(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("crazysim.engine.jaxcompat.cache_folder", lambda: str(tmp_path / "file"))
    assert kernel_cache.folder() == kernel_cache.temporary_folder()
    monkeypatch.setattr("crazysim.engine.jaxcompat.cache_folder", lambda: str(tmp_path))
    assert kernel_cache.folder() == tmp_path / "crazysim"
    monkeypatch.setattr("crazysim.engine.jaxcompat.cache_folder", lambda: None)
    monkeypatch.setenv("CRAZYSIM_CACHE", "off")
    assert kernel_cache.folder() == kernel_cache.temporary_folder()
    monkeypatch.setenv("CRAZYSIM_CACHE", str(tmp_path / "kept"))
    assert kernel_cache.folder() == default_folder() / "crazysim"


@pytest.mark.parametrize(
    ("variable", "value", "message"),
    [
        ("CXXFLAGS", "-no-such-option", "CXXFLAGS='-no-such-option'"),
        ("CXXFLAGS", "-march=none-such", "CXXFLAGS='-march=none-such'"),
        ("CXXFLAGS", "'-O2", "words in CXXFLAGS"),
        ("CXX", "no-such-compiler", "a C\\+\\+ compiler in CXX, got 'no-such-compiler'"),
        ("CXX", "'g++", "words in CXX"),
        ("CXX", "false", "CXX='false'"),
        ("CRAZYSIM_COMPILE_TIMEOUT", "soon", "seconds in CRAZYSIM_COMPILE_TIMEOUT, got 'soon'"),
        ("CRAZYSIM_COMPILE_TIMEOUT", "0", "CRAZYSIM_COMPILE_TIMEOUT, got '0'"),
        ("CRAZYSIM_COMPILE_TIMEOUT", "nan", "CRAZYSIM_COMPILE_TIMEOUT, got 'nan'"),
    ],
)
def test_wrong_settings_of_the_compiler_are_errors_that_name_them(cache_folder, monkeypatch, variable, value, message):
    """The settings are errors even with the default engine, which otherwise falls back to a slower one."""
    native.compiler.cache_clear()
    monkeypatch.setenv(variable, value)
    try:
        with pytest.raises(ConfigError, match=message):
            Sim(n_worlds=2, control="rotor_vel").step()
    finally:
        native.compiler.cache_clear()


def test_a_kernel_that_would_take_longer_than_the_limit_is_refused_by_its_size(
    source, cache_folder, compilations, monkeypatch
):
    native.toolchain(tuple(native.compiler_command()))
    monkeypatch.setenv("CRAZYSIM_COMPILE_TIMEOUT", "0.001")
    with pytest.raises(KernelError, match=r"a kernel of [\d,]+ lines takes .* longer than 0.001 s; use loops"):
        native.register_kernel(source)
    assert not list(cache_folder.iterdir())
    assert compilations() == 0


def test_ziglang_compiles_where_there_is_no_other_compiler(source, cache_folder, monkeypatch, tmp_path_factory):
    """Without the libraries of ziglang this takes 1 s instead of 20 s. The key ignores the working directory."""
    pytest.importorskip("ziglang")
    monkeypatch.setenv("CXXFLAGS", "")  # the tests have options of g++
    which = shutil.which
    monkeypatch.setattr(native.shutil, "which", lambda name, path=None: path and which(name, path=path))
    monkeypatch.delenv("CXX", raising=False)
    native.compiler.cache_clear()
    try:
        assert Path(native.compiler_command()[0]).name.startswith("zig")
        name = native.register_kernel(source)
        monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
        assert register_anew(source) == name
        assert len(list(cache_folder.iterdir())) == 1
        assert not any(p.is_dir() for p in kernel_cache.temporary_folder().iterdir()), "zig keeps nothing"
    finally:
        native.compiler.cache_clear()


def test_without_any_compiler_one_line_names_the_remedy(monkeypatch, capsys):
    monkeypatch.setattr(native, "compiler", lambda: None)
    fused._announce_missing_compiler.cache_clear()
    assert fused.unavailable_reason("cpu") == fused.unavailable_reason("cpu") == native.MISSING_COMPILER
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "pip install 'crazysim[compiler]'" in message


COMPILE = """
import signal, sys
from crazysim.engine.backends import native
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for what it runs in the background
slow = "constexpr long f() { long s = 0; for (long i = 0; i < 1000000000; i++) s += i; return s; }"
slow += "constexpr long x = f();"
flags = ["-fconstexpr-ops-limit=1000000000000", "-fconstexpr-loop-limit=2000000000"]
quick = 'extern "C" __attribute__((visibility("default"))) int crazysim_call = 1;'
source = quick if sys.argv[1] == "quick" else slow
compile = lambda key: native._get_library([*native.compiler_command(), *flags], key, source)
if source == slow:
    with native.compiling_threads(2) as pool:
        list(pool.map(compile, "abcd"))
else:
    compile("a")
"""


def compile_in_another_process(folder, mode):
    """Start a process that compiles one kernel into a folder, ``"quick"``, or four ``"slow"`` ones in two threads."""
    cache_folder = folder / "cache"
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "TMPDIR": str(folder),
        "JAX_COMPILATION_CACHE_DIR": str(cache_folder),
    }
    cache_folder.mkdir(exist_ok=True)
    return subprocess.Popen([sys.executable, "-c", COMPILE, mode], env=environment, stderr=subprocess.DEVNULL)


def compiler_commands(folder):
    done = subprocess.run(["ps", "-eww", "-o", "args"], capture_output=True, text=True, check=True)
    return [line for line in done.stdout.splitlines() if str(folder) in line and "kernel.cpp" in line]


@pytest.mark.parametrize("ended", [False, True])
def test_an_interrupt_at_any_time_kills_all_compilers(ended):
    slow = "constexpr long f() { long s = 0; for (long i = 0; i < 1000000000; i++) s += i; return s; }"
    slow += "constexpr long x = f();"
    flags = ["-fconstexpr-ops-limit=1000000000000", "-fconstexpr-loop-limit=2000000000"]
    command = [*native.compiler_command(), *flags]
    random = Random(1)
    for _ in range(20):
        futures = []

        def interrupt_after(seconds, futures=futures):
            with native.compiling_threads(2) as pool:
                futures.extend(pool.submit(native._compile, command, slow) for _ in range(4))
                if not ended:
                    time.sleep(seconds)
                    raise KeyboardInterrupt
                # Once more if the first is lost: callbacks of the garbage collector swallow an interrupt.
                signal.setitimer(signal.ITIMER_REAL, seconds, 30.0)

        previous = signal.signal(signal.SIGALRM, signal.default_int_handler)
        try:
            with pytest.raises(KeyboardInterrupt):
                interrupt_after(random.uniform(0.0, 0.05))
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, previous)
        for future in futures:
            assert future.cancelled() or isinstance(future.exception(), KeyboardInterrupt)
        wait_for(lambda: not native._COMPILER_PIPES)


def test_no_other_engine_compiles_after_an_interrupt(cache_folder, recwarn):
    """In a program that is to end, it would compile for minutes, and report a bug of crazysim."""
    sim = shared_sim(n_worlds=2, n_drones=1, control="rotor_vel")
    clock = {"increment_steps": sim.step_pipeline["increment_steps"]}
    was_interrupted = threading.Event()
    was_interrupted.set()
    with ThreadPoolExecutor(1, initializer=setattr, initargs=(native._THREAD, "interrupted", was_interrupted)) as pool:
        future = pool.submit(lambda: Step(clock, "auto").plan(sim.data))
        assert isinstance(future.exception(), KeyboardInterrupt)
    assert not recwarn


@pytest.mark.long("three processes import JAX")
def test_compilers_end_with_their_process(tmp_path):
    for end_signal in (signal.SIGKILL, signal.SIGINT):
        with compile_in_another_process(tmp_path, "slow") as process:
            try:
                wait_for(lambda: len(compiler_commands(tmp_path)) >= 3)  # the script, the driver and the compiler
                process.send_signal(end_signal)
                process.wait(300)
            finally:
                process.kill()
        wait_for(lambda: not compiler_commands(tmp_path))
    assert compile_in_another_process(tmp_path, "quick").wait(300) == 0
    assert [path.suffix for path in (tmp_path / "cache" / "crazysim").iterdir()] == [".so"]
    assert [path.name for path in tmp_path.iterdir()] == ["cache"]
