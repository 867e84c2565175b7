"""Folders of kernels are private to the user, and files that killed processes left in them are removed."""

import os
import stat
import subprocess
import sys
import time
import warnings

import pytest

from crazysim import storage
from crazysim.engine.backends import kernel_cache
from crazysim.errors import ConfigError
from crazysim.storage import untrusted_reason
from crazysim.utils import enable_cache

OTHER_USER = 12345
"""User that the tests do not run as."""
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Return an empty folder as JAX's compilation cache; no folder has been refused or swept before."""
    monkeypatch.setattr("crazysim.engine.jaxcompat.cache_folder", lambda: str(tmp_path))
    kernel_cache._warn_once.cache_clear()
    kernel_cache._remove_abandoned_files_once.cache_clear()
    return tmp_path


# Linux has no process with an id above 2**22; the id of a finished one may soon be that of another, or of a thread.
NO_PROCESS = 2**22 + 1


def permissions(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_the_folder_is_made_for_this_user_only(cache):
    mask = os.umask(0)
    try:
        assert kernel_cache.folder() == cache / "crazysim"
    finally:
        os.umask(mask)
    assert permissions(cache / "crazysim") == 0o700
    assert permissions(kernel_cache.temporary_folder()) == 0o700


@pytest.mark.parametrize("bits", [0o777, 0o775, 0o702])
def test_a_folder_that_others_can_write_is_refused_once(cache, bits):
    shared = cache / "crazysim"
    shared.mkdir()
    shared.chmod(bits)
    with pytest.warns(UserWarning, match=r"only this user can write, got .*crazysim'.* Remove it"):
        assert kernel_cache.folder() == kernel_cache.temporary_folder()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert kernel_cache.folder() == kernel_cache.temporary_folder()
    shared.chmod(0o755)
    assert kernel_cache.folder() == shared


def test_a_folder_that_others_can_replace_is_refused(cache):
    shared = cache / "crazysim"
    assert kernel_cache.folder() == shared
    cache.chmod(0o777)
    assert str(cache) in untrusted_reason(shared)
    cache.chmod(0o1777)  # as of /tmp: others can add files, but rename and remove only their own
    assert not untrusted_reason(shared)


@needs_root
def test_a_folder_of_another_user_is_refused(cache):
    shared = cache / "crazysim"
    shared.mkdir(mode=0o700)
    os.chown(shared, OTHER_USER, OTHER_USER)
    with pytest.warns(UserWarning, match=f"belongs to the user {OTHER_USER}"):
        assert kernel_cache.folder() == kernel_cache.temporary_folder()


@needs_root
def test_a_file_of_another_user_is_not_loaded(cache):
    """Such a file may have been written before the folder became private."""
    folder = kernel_cache.folder()
    library = kernel_cache.store_file(folder, "key", b"library", ".so")
    assert list(kernel_cache.find_files(folder, "key")) == [library]
    os.chown(library, OTHER_USER, OTHER_USER)
    assert not list(kernel_cache.find_files(folder, "key"))
    assert library.exists()


def test_enable_cache_checks_its_folder_at_once(tmp_path):
    mask = os.umask(0)
    try:
        shared_folder = tmp_path / "open"
        shared_folder.mkdir()
    finally:
        os.umask(mask)
    with pytest.raises(ConfigError, match=r"only this user can write, got .*open': other users can write to it"):
        enable_cache(shared_folder)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"expected a folder for compiled programs, got .*file'"):
        enable_cache(tmp_path / "file")


@pytest.fixture
def make_remains(tmp_path):
    def make(name, age=0.0):
        path = tmp_path / name
        if name.endswith(storage.UNFINISHED_SUFFIX):
            path.write_text("")
        else:
            path.mkdir()
            (path / "kernel.so").write_text("")
        os.utime(path, (time.time() - age,) * 2)
        return path

    return make


def test_the_folders_are_swept_at_the_next_start(cache, make_remains):
    (cache / "crazysim").mkdir(mode=0o700)
    machine = storage.process_name().split("-")[0]
    remains = make_remains(f"crazysim/key.{machine}-{NO_PROCESS}-1{storage.UNFINISHED_SUFFIX}")
    assert kernel_cache.folder() == cache / "crazysim"
    assert not remains.exists()


FORK = """
import os, sys
from crazysim.engine.backends import kernel_cache
mine = kernel_cache.temporary_folder()
child = os.fork()
if not child:
    own = kernel_cache.temporary_folder()
    sys.exit(0 if own != mine and own.is_dir() else 3)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), mine.is_dir())
print(mine)
"""


def test_a_child_that_ends_leaves_the_folder_of_its_parent(tmp_path):
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FORK], capture_output=True, text=True, env=environment, check=True
    )
    status, folder = done.stdout.splitlines()
    assert status == "0 True"
    assert folder.startswith(str(tmp_path))
    assert not list(tmp_path.iterdir()), "each process removes its own folder"
