"""No option or file of a command makes it wait for ever, or takes memory without a limit."""

import json
import os
import re
import subprocess
import sys

import pytest

from crazysim.train.runs import make_variants

FILES = ("zero", "pipe", "huge", "folder")
"""A device without an end, a pipe without a writer, a file of 1 TB, and a folder."""
READS = [
    "show {0}.skyc",
    "replay {0}.npz",
    "replay {0}.journal",
    "live --headless --seconds 1 --policy run --goals {0}.txt",
    "live --headless --seconds 1 --drone {0}.toml",
    "live --headless --seconds 1 --policy {0}-run",
    "evaluate {0}-run",
    "render {0}-run",
    "export {0}-run --c policy.h",
    "train {0}.py:Task",
    "train hover --set drone={0}.toml",
    "train hover --resume --out {0}-run",
    "train hover --teacher {0}-run",
    "airframe check {0}.toml",
    "airframe new new.toml --mass 1 --propeller 0.1 --arm 0.1 --motor-table {0}.csv",
    *(f"identify --out new.toml {{0}}.{ending}" for ending in ("csv", "npz", "ulg", "bin", "bag", "mcap", "db3")),
    "identify log.csv --out new.toml --motion {0}.csv",
]
"""Commands that read a file."""
COUNTS = "100000000 1000000000000".split()
NUMBERS = {
    f"train hover --seeds 0:{COUNTS[0]}": "at most 10000 trainings",
    "train hover --seeds 0:4000 --sweep clip=0.1,0.2,0.3": "at most 10000 trainings",
    f"train hover --worlds {COUNTS[1]}": "--worlds: expected a whole number from 1 to 67,108,864, got",
    f"train hover --iterations {COUNTS[1]}": "--iterations: expected a whole number from 1 to",
    f"train hover --devices {COUNTS[1]}": "expected devices among the",
    f"train hover --config hidden=[{COUNTS[1]}]": "hidden[0] is",
    f"train hover --config n_steps={COUNTS[1]}": "n_steps is",
    "train hover --checkpoint-every nan": "--checkpoint-every: expected a number from",
    "train hover --coordinator 127.0.0.1:99999 --hosts 2 --host-id 1": "a port from 1 to 65535, got '127.0.0.1:99999'",
    "train hover --coordinator 127.0.0.1:0 --hosts 2 --host-id 1": "a port from 1 to 65535",
    "train hover --coordinator nohost.invalid:1 --hosts 2 --host-id 1": "a host that this machine knows",
    "train hover --coordinator 127.0.0.1:1 --hosts 2 --host-id 1 --connect-timeout -1": "1 to 86,400, got '-1'",
    "train hover --coordinator 127.0.0.1:1 --hosts 2 --host-id 1 --heartbeat-timeout 0": "1 to 86,400, got '0'",
    f"evaluate run --worlds {COUNTS[1]}": "--worlds: expected a whole number from 1 to",
    f"render run --worlds {COUNTS[1]}": "--worlds: expected a whole number from 1 to",
    f"demo --worlds {COUNTS[1]}": "--worlds: expected a whole number from 1 to",
    f"demo --drones {COUNTS[0]}": "--drones: expected a whole number from 1 to 65,536",
    f"live --headless --seconds 1 --drones {COUNTS[0]}": "--drones: expected a whole number from 1 to",
    f"live --headless --seconds 1 --worlds {COUNTS[1]}": "--worlds: expected a whole number from 1 to",
    f"airframe new new.toml --mass 1 --propeller 0.1 --arm 0.1 --rotors {COUNTS[1]}": "--rotors: expected",
    f"identify --out new.toml log.csv --network {COUNTS[0]}": "--network: expected a whole number from 0 to 10,000",
    "show show.skyc --browser --port 99999": "--port: expected a whole number from 0 to 65,535",
    "show show.skyc --browser --host nohost.invalid": "Choose another --host",
}
"""Commands with numbers and addresses that are refused before they are used, with a part of the message."""
PROGRAM = """
import json, os, resource, signal, sys, traceback
import crazysim.train.runs, crazysim.sim.sim, crazysim.lab.live, crazysim.lab.shows
from crazysim.__main__ import main

with open("/proc/self/statm") as file:
    used = int(file.read().split()[0]) * resource.getpagesize()
for command in json.load(sys.stdin):
    print(f"\\n{command}", flush=True)
    child = os.fork()
    if not child:
        resource.setrlimit(resource.RLIMIT_AS, (used + 2**32, resource.RLIM_INFINITY))
        signal.alarm(600)  # ends the process
        os.dup2(1, 2)
        try:
            status = main(command.split())
        except SystemExit as end:
            status = end.code
        except BaseException:
            traceback.print_exc()
            status = 99
        sys.stderr.flush()
        os._exit(status)
    print("status", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Run each command in a child of one process, with 4 GB more memory than the imports take, and for 600 s at most."""


def run(folder, commands):
    environment = os.environ | {
        "HOME": str(folder),
        "CRAZYSIM_CACHE": "off",
        "JAX_PLATFORMS": "cpu",
        "PYTHONWARNINGS": "ignore",
    }
    process = subprocess.run(
        [sys.executable, "-c", PROGRAM], input=json.dumps(commands), capture_output=True, text=True, cwd=folder,
        env=environment, check=True,
    )  # fmt: skip
    outputs = re.split(r"^status (.*)$", process.stdout, flags=re.MULTILINE)
    return dict(zip(commands, zip(outputs[1::2], outputs[::2], strict=False), strict=True))


def make(path, kind):
    if kind == "zero":
        path.symlink_to("/dev/zero")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        with path.open("wb") as file:
            file.truncate(2**40)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Return exit status and output of every command, all of which run in one folder."""
    folder = tmp_path_factory.mktemp("files")
    for kind in FILES:
        for ending in "skyc npz journal txt toml csv ulg bin bag mcap db3 py".split():
            make(folder / f"{kind}.{ending}", kind)
        (folder / f"{kind}-run").mkdir()
        for name in ("policy.npz", "checkpoint.npz"):
            make(folder / f"{kind}-run" / name, kind)
    (folder / "log.csv").write_text("t,x\n0,0\n")
    return run(folder, [*(command.format(kind) for kind in FILES for command in READS), *NUMBERS])


@pytest.mark.long("a process that imports everything runs all commands")
@pytest.mark.parametrize("kind", FILES)
def test_a_file_that_is_none_or_has_no_end_is_refused(results, kind):
    for command in (x.format(kind) for x in READS):
        status, errors = results[command]
        assert status == "2", f"{command}: {status} {errors}"
        assert "expected" in errors, f"{command}: {errors}"


def test_numbers_and_addresses_are_checked_before_they_are_used(results):
    for command, text in NUMBERS.items():
        status, errors = results[command]
        assert status == "2", f"{command}: {status} {errors}"
        assert text in errors, f"{command}: {errors}"


def test_seeds_without_an_end_are_refused():
    from itertools import count

    with pytest.raises(ValueError, match="at most 10000 trainings in one program"):
        make_variants(count(), {}, {})
