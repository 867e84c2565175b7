"""The cache of compiled programs: its location, its contents, and messages about it."""

import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from disks import full_disk
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from jax._src import compilation_cache

from crazysim.engine import cache
from crazysim.engine.backends import kernel_cache
from crazysim.engine.cache import (
    announce,
    announce_if_slow,
    default_folder,
    enable_cache,
    enable_for_command,
    keep_programs,
    trim,
)


@pytest.fixture
def settings(monkeypatch):
    """Restore JAX's settings after the test, which begins without a cache and without the variables that choose one."""
    names = ("min_entry_size_bytes", "min_compile_time_secs", "enable_xla_caches")
    names = ("jax_compilation_cache_dir", *(f"jax_persistent_cache_{name}" for name in names))
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    for name in (cache.CACHE_VARIABLE, "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_the_folder_is_that_of_the_variable_or_in_the_folder_of_caches(settings, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_folder().parent == tmp_path / ".cache" / "crazysim" / "jax"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # ignored, as the specification of XDG says
    assert default_folder().parent == tmp_path / ".cache" / "crazysim" / "jax"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert default_folder().parent == tmp_path / "xdg" / "crazysim" / "jax"
    monkeypatch.setenv(cache.CACHE_VARIABLE, "~/mine")
    assert enable_cache() == default_folder()
    assert default_folder().parent == tmp_path / "mine"
    assert jax.config.jax_compilation_cache_dir == str(default_folder())


def test_a_relative_folder_does_not_follow_the_working_directory(settings, monkeypatch, tmp_path):
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(cache.CACHE_VARIABLE, "kept")
    used = cache.folder()
    assert enable_cache("own") == tmp_path / "own"
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.chdir(tmp_path / "other")
    assert cache.folder() == used == tmp_path / "kept" / used.name


def test_each_kind_of_cpu_has_a_folder_of_its_own(settings, monkeypatch, tmp_path):
    """XLA's programs are machine code, but their key does not include the features of the CPU."""
    info = tmp_path / "cpuinfo"
    monkeypatch.setattr(cache, "CPU_INFO", info)
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "kept"))
    folders = set()
    for features in ("fpu avx512f", "fpu avx2", "fpu avx512f"):
        info.write_text(f"flags : {features}\n")
        folders.add(default_folder())
    assert len(folders) == 2


def test_programs_of_a_block_are_kept_and_jax_is_left_as_it_was(settings, monkeypatch, tmp_path):
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path))
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = [getattr(jax.config, name) for name in names]

    def kept_programs():
        return {path.name.split("-")[0] for path in default_folder().glob("*-cache")}

    with keep_programs():
        with keep_programs():
            jax.jit(_inner)(jnp.ones(7))
        jax.jit(_after)(jnp.ones(7))
    jax.jit(_outside)(jnp.ones(7))
    assert {"jit__inner", "jit__after"} <= kept_programs()
    assert "jit__outside" not in kept_programs()
    assert [getattr(jax.config, name) for name in names] == before
    user_folder = tmp_path / "own"
    jax.config.update("jax_compilation_cache_dir", str(user_folder))  # JAX opens a cache once a process
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    with keep_programs():
        jax.jit(_of_user)(jnp.ones(7))
    assert [path.name.split("-")[0] for path in user_folder.glob("jit__of_user*-cache")] == ["jit__of_user"]
    assert "jit__of_user" not in kept_programs()


def test_a_block_leaves_the_cache_of_a_block_of_another_thread_open(settings, monkeypatch, tmp_path):
    """JAX closes its cache without a lock: another thread that opens it meanwhile would fail."""
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path))

    def enter():
        with keep_programs():
            pass

    with keep_programs():
        jax.jit(_shared)(jnp.ones(7))
        opened = compilation_cache._cache
        thread = threading.Thread(target=enter)
        thread.start()
        thread.join()
        assert opened is not None
        assert compilation_cache._cache is opened
    assert compilation_cache._cache is None


def _shared(x):
    return jnp.cos(x) * 6


def _inner(x):
    return jnp.cos(x) * 2


def _after(x):
    return jnp.cos(x) * 3


def _outside(x):
    return jnp.cos(x) * 4


def _of_user(x):
    return jnp.cos(x) * 5


def _compute():
    """Compile a function that is in the cache, or is not there yet, and return its result and the cache's file."""

    def damaged(x):  # a new function, so that JAX finds nothing in memory
        return jnp.sin(x) @ x + 7

    with keep_programs():
        result = jax.jit(damaged)(X)
    return np.asarray(result), next(default_folder().glob("jit_damaged-*-cache"), None)


X = np.linspace(0.0, 1.0, 9, dtype=np.float32).reshape(3, 3)
damages = st.one_of(
    st.tuples(st.just("cut"), st.floats(0, 1, exclude_max=True)),
    st.tuples(st.just("flip"), st.floats(0, 1, exclude_max=True)),
    st.sampled_from([("append", 1), ("mode", 0o622), ("mode", 0o660), ("other program", 0), ("older", 0), ("link", 0)]),
    st.sampled_from([("full disk", 0), ("full disk", 4000), *([("owner", 12345)] if os.geteuid() == 0 else [])]),
)
"""Kinds of damage to a file of the cache, with a number: a fraction of its length, permissions, bytes or a user."""


def _damage(path, kind, x):
    content = path.read_bytes()
    k = int(x * len(content)) if kind in ("cut", "flip") else 0
    if kind == "cut":
        path.write_bytes(content[:k])
    elif kind == "flip":
        path.write_bytes(content[:k] + bytes([content[k] ^ 0x10]) + content[k + 1 :])
    elif kind == "append":
        path.write_bytes(content + bytes(x))
    elif kind == "mode":
        path.chmod(x)
    elif kind == "owner":
        os.chown(path, x, x)
    elif kind == "older":  # as JAX's own cache writes it
        path.write_bytes(content[: -cache.CHECKSUM_BYTES])
    elif kind == "other program":
        with keep_programs():
            jax.jit(lambda x: jnp.cos(x) - 3)(X)
        path.write_bytes(next(path.parent.glob("jit__lambda*-cache")).read_bytes())
    elif kind == "link":
        path.unlink()
        path.symlink_to(path.parent / "nothing")
    else:
        path.unlink()
        with full_disk(x), pytest.warns(UserWarning, match="expected room for compiled programs in"):
            np.testing.assert_allclose(_compute()[0], RESULT, rtol=1e-6)
        assert not path.exists()


RESULT = np.sin(X) @ X + 7


@pytest.mark.long("compiles its program after each damage")
@examples(max_examples=examples.default.max_examples // 3)
@given(st.lists(damages, min_size=1, max_size=3))
def test_a_damaged_program_is_compiled_again_and_replaced(chosen):
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setenv(cache.CACHE_VARIABLE, folder)
        configured = jax.config.jax_compilation_cache_dir
        jax.config.update("jax_compilation_cache_dir", None)
        try:
            path = _compute()[1]
            for damage in chosen:
                _damage(path, *damage)
                before = path.lstat().st_ino if os.path.lexists(path) else None
                result, path = _compute()
                np.testing.assert_allclose(result, RESULT, rtol=1e-6)
                status = path.stat()
                assert status.st_ino != before, "the file is replaced"
                assert (status.st_uid, status.st_mode & 0o077) == (os.geteuid(), 0)
                np.testing.assert_array_equal(_compute()[0], result)
                assert path.stat().st_ino == status.st_ino, "it is loaded"
                assert not list(path.parent.glob("*.part"))
        finally:
            jax.config.update("jax_compilation_cache_dir", configured)


PROGRAM = """
import jax
from crazysim import MotionCapture, Sim
sim = Sim(n_worlds=2, control="rotor_vel", plugins=[MotionCapture()])
sim.step()
print(sim.data.states.pos[0, 0], sim.plugins.observations(sim.data).keys())
print(jax.config.jax_compilation_cache_dir)

import jax.numpy as jnp
from crazysim.__main__ import main
from crazysim.commands import training
training.train = lambda options: print(jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((3, 3)))[0, 0])
main(["train", "hover"])
"""
"""A script that compiles a step and observations, and a command that compiles something else."""


@pytest.mark.long("two processes import JAX and compile")
def test_a_second_process_reads_the_programs_of_the_first_one_and_prints_nothing(tmp_path):
    """For each program that it reads, XLA writes errors about features of the CPU unless its log level is set."""
    script = tmp_path / "bin" / "g++"
    script.parent.mkdir()
    script.write_text(f'#!/bin/sh\necho "$@" >> {script.parent}/compiled\nexec {shutil.which("g++")} "$@"\n')
    script.chmod(0o755)
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "TF_CPP", "CRAZYSIM"))}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu", "CXX": str(script)}
    environment["TF_CPP_MIN_LOG_LEVEL"] = "1"  # as JAX sets it, for the children of a process that has imported it
    folder = tmp_path / "crazysim" / "jax"

    def run():
        command = [sys.executable, "-c", PROGRAM]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
        n_kernels = (script.parent / "compiled").read_text().count("kernel.cpp")
        return done.stdout, done.stderr, n_kernels, sorted(folder.glob("cpu-*/*-cache"))

    first, _, n_kernels, programs = run()
    assert first.splitlines()[-2] == "None", "JAX's own configuration is not changed"
    assert n_kernels >= 1
    assert {"jit__observations", "jit__lambda"} <= {path.name.split("-")[0] for path in programs}
    assert folder.stat().st_mode & 0o077 == 0
    assert run() == (first, "", n_kernels, programs)


@pytest.mark.parametrize("fault", ["file", "full", "homeless"])
def test_without_a_usable_folder_there_is_one_line_and_everything_works(settings, monkeypatch, tmp_path, capsys, fault):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    if fault == "file":
        (tmp_path / "caches").write_text("")
    elif fault == "full":
        monkeypatch.setattr(cache.shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10**9, 10**9, 0))
    else:
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.delenv("HOME")
        monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as for a user without an entry in passwd
    cache._prepared_default_folder.cache_clear()
    for _ in range(2):
        with keep_programs():
            jax.jit(_inner)(jnp.ones(3))
        assert kernel_cache.folder() == kernel_cache.temporary_folder()
        assert enable_cache() is None
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert printed.startswith("compiled programs are not kept: expected ")
    assert cache.CACHE_VARIABLE in printed
    cache._prepared_default_folder.cache_clear()


def test_off_keeps_nothing_unless_a_folder_is_named(settings, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv(cache.CACHE_VARIABLE, "off")
    enable_for_command()
    assert enable_cache() is None
    assert jax.config.jax_compilation_cache_dir is None
    assert enable_cache(tmp_path) == tmp_path
    assert capsys.readouterr().err == ""


def test_the_least_recently_used_programs_are_removed_and_no_other_file(tmp_path):
    autotuning = "xla_gpu_per_fusion_autotune_cache_dir"  # folder of XLA's measurements on GPUs
    for folder in ("crazysim", autotuning):
        (tmp_path / folder).mkdir()
    names = ("jit_a-cache", f"{autotuning}/b", "crazysim/c.so", "letter.txt", "jit_d-cache", "jit_e-cache")
    for age, name in enumerate(reversed(names)):
        (tmp_path / name).write_bytes(bytes(10))
        os.utime(tmp_path / name, (time.time() - 1000 * age,) * 2)

    def remaining():
        return {name for name in names if (tmp_path / name).exists()}

    trim(tmp_path, 50)
    assert remaining() == set(names)
    trim(tmp_path, 49)  # down to 0.8 of it: 39 bytes, three programs
    assert remaining() == {"crazysim/c.so", "letter.txt", "jit_d-cache", "jit_e-cache"}


def test_work_that_lasts_is_announced_and_work_that_ends_at_once_is_not(settings, capsys, monkeypatch):
    with announce_if_slow("compiling what is cached", "5 s", delay=3600.0):
        pass
    assert capsys.readouterr().err == ""
    shown = threading.Event()
    monkeypatch.setattr(cache, "announce", lambda *args: (announce(*args), shown.set()))
    with announce_if_slow("compiling what lasts", "5 s", delay=0.0):
        assert shown.wait(300), "the notice comes while the work is done"
    assert capsys.readouterr().err.startswith("compiling what lasts: 5 s on two cores")


def test_a_command_prints_its_cache_once_and_keeps_the_cache_of_jax(settings, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "kept"))
    enable_for_command()
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert str(tmp_path / "kept") in printed
    assert "1 GB" in printed
    jax.config.update("jax_compilation_cache_dir", None)
    enable_for_command()
    kept = str(default_folder())
    assert jax.config.jax_compilation_cache_dir == kept
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path / "other"))
    enable_for_command()
    assert jax.config.jax_compilation_cache_dir == kept
    assert capsys.readouterr().err == ""
