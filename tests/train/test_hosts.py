"""Trainings of two processes with two devices each, which act as two hosts."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from shutil import copytree

import numpy as np
import pytest
from waiting import wait_for

from crazysim.__main__ import main
from crazysim.train import checkpoint
from crazysim.train.training import CHECKPOINT_FILE, CURVE_FILE, POLICY_FILE

pytestmark = pytest.mark.usefixtures("shared_environments")
SMALL = "--worlds 64 --no-film --set seconds=0.2 --config n_steps=4 minibatches=2 epochs=1 hidden=[8]".split()
HEARTBEAT_TIMEOUT = 20
"""Time without a heartbeat after which a host is lost, s; it is long, as other processes use the processor too."""


def free_address():
    """Return an address at which nothing listens."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{s.getsockname()[1]}"


def process_environment(**others):
    flags = re.sub(r"device_count=\d+", "device_count=2", os.environ["XLA_FLAGS"])
    return os.environ | {"XLA_FLAGS": flags} | others


class Process:
    """A command in a process of its own, whose output goes into a file."""

    def __init__(self, folder, name, *command, **variables):
        self._path = folder / f"{name}.txt"
        with self._path.open("wb") as file:
            self._process = subprocess.Popen(command, env=process_environment(**variables), stdout=file, stderr=file)

    @property
    def text(self):
        return self._path.read_text()

    def wait_for(self, text):
        """Wait until the output contains a text."""
        wait_for(lambda: text in self.text or self.has_ended)
        assert text in self.text, self.text

    def end(self):
        """Wait for the end, and return the exit status and the output."""
        return self._process.wait(timeout=300), self.text

    def signal(self, number):
        self._process.send_signal(number)

    @property
    def has_ended(self):
        return self._process.poll() is not None


def start(folder, arguments):
    """Return the processes of two hosts that run ``HOST``."""
    common = f"--coordinator {free_address()} --hosts 2 --heartbeat-timeout {HEARTBEAT_TIMEOUT}".split()
    return [
        Process(folder, f"host{i}", sys.executable, "-c", HOST, *arguments, *common, "--host-id", str(i))
        for i in range(2)
    ]


def training_arguments(out, *further):
    return ["train", "hover", *SMALL, "--out", str(out), *further]


def iteration(out):
    """Return the last iteration in the checkpoint of a run; -1 without one."""
    path = out / CHECKPOINT_FILE
    return int(checkpoint.read(path)[0]["['learner'].iteration"]) if path.exists() else -1


def assert_same_files(actual_folder, expected_folder):
    """Assert that the checkpoints and policies of two runs agree to rounding."""
    for name in (CHECKPOINT_FILE, POLICY_FILE):
        (x, _), (y, _) = (checkpoint.read(out / name) for out in (actual_folder, expected_folder))
        assert x.keys() == y.keys()
        for key in x:
            np.testing.assert_allclose(x[key], y[key], rtol=1e-4, atol=1e-5, err_msg=key)


HOST = """
import functools, sys
from crazysim.__main__ import main
from crazysim.commands import training
from crazysim.train import config, runs, training as trainings

for module, name in ((config, "make"), (trainings, "AutoReset")):  # compiled once, as by shared_environments
    setattr(module, name, functools.cache(getattr(module, name)))
runs.plot_curve = runs.plot_episode = lambda *_: None
train = training._train

def train_in_turn(options, **settings):
    train(options, **settings)
    print("trained to the end", flush=True)
    options.resume, options.iterations, options.checkpoint_every = True, 100_000, 0.01
    try:
        train(options, **settings)
    except SystemExit as end:
        print(f"stopped with {end.code}", flush=True)
    train(options, **settings)

training._train = train_in_turn
sys.exit(main(sys.argv[1:]))
"""
"""A host that trains to the end, continues until a host is told to stop, and continues again."""


@pytest.mark.long("two processes import JAX and compile a training")
def test_two_hosts_train_the_policy_of_one_stop_together_and_can_lose_one(tmp_path):
    """One process with all devices trains the same policy. A host that was killed leaves a whole checkpoint."""
    out, one_process_folder = tmp_path / "two", tmp_path / "one"
    first, second = start(tmp_path, training_arguments(out, "--iterations", "3"))
    first.wait_for("trained to the end")
    copytree(out, tmp_path / "ended")
    wait_for(lambda: iteration(out) > 3 or first.has_ended)
    second.signal(signal.SIGINT)
    first.wait_for(f"stopped with {128 + signal.SIGTERM}")
    second.wait_for(f"stopped with {128 + signal.SIGTERM}")
    stopped_iteration = int(re.search(r"interrupted after iteration (\d+)", first.text)[1])
    wait_for(lambda: iteration(out) > stopped_iteration or first.has_ended)
    second.signal(signal.SIGKILL)
    (status, text), (other_status, other_text) = first.end(), second.end()
    assert (status, other_status) == (-signal.SIGABRT, -signal.SIGKILL)
    assert "16 on each of 4 devices" in text
    assert f"continues after iteration {stopped_iteration}" in text
    assert "host 1 of 2: 2 cpu" in other_text
    assert "success" not in other_text, "only host 0 reports"

    assert main(training_arguments(one_process_folder, "--iterations", "3", "--devices", "4")) == 0
    assert_same_files(tmp_path / "ended", one_process_folder)
    assert len(json.loads((tmp_path / "ended" / CURVE_FILE).read_text())) == 2
    left, ended = (set(checkpoint.read(x / CHECKPOINT_FILE)[0]) for x in (out, tmp_path / "ended"))
    assert left == ended, "a checkpoint with which any number of devices continues, as in test_devices.py"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--hosts 2 --host-id 0", "expected --coordinator with --host-id and --hosts"),
        ("--coordinator here --hosts 2 --host-id 0", "expected HOST:PORT or auto as --coordinator"),
        ("--coordinator here:1 --hosts 2 --host-id 2", "got --hosts 2 --host-id 2"),
        ("--coordinator here:1 --hosts 2", "got --hosts 2 --host-id None"),
    ],
)
def test_options_of_hosts_are_checked(options, message, capsys):
    assert main(["train", "hover", *options.split()]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.long("three processes import JAX")
def test_hosts_of_a_scheduler_with_other_settings_stop_together_and_without_one_there_is_an_error(tmp_path):
    """JAX finds the hosts by SLURM's variables. Without a scheduler the options name the hosts, and a coordinator that
    does not answer is an error with its address."""
    out, address = tmp_path / "out", free_address()
    arguments = training_arguments(out, "--iterations", "1")
    auto = [*arguments, "--coordinator", "auto"]
    slurm = {"JOB_ID": "1", "STEP_NODELIST": "localhost", "NTASKS": "2"}
    variables = {f"SLURM_{name}": value for name, value in slurm.items()}
    variables |= {"JAX_COORDINATOR_PORT": address.rpartition(":")[2]}
    hosts = [
        Process(tmp_path, f"host{i}", sys.executable, "-m", "crazysim", *auto, "--seed", str(i),
                SLURM_PROCID=str(i), SLURM_LOCALID=str(i), **variables)
        for i in range(2)
    ]  # fmt: skip
    silent = f"--coordinator {free_address()} --hosts 2 --host-id 1 --connect-timeout 1".split()
    program = f"from crazysim.__main__ import main; print(main({auto})); main({arguments + silent})"
    alone = Process(tmp_path, "alone", sys.executable, "-c", program)
    for i, host in enumerate(hosts):
        status, text = host.end()
        assert status == 2
        assert f"host {i} of 2: 2 cpu" in text
        assert "expected the same settings on all hosts, got seed = 0 on host 0 and 1 on host 1" in text
    assert not (out / CHECKPOINT_FILE).exists()
    status, text = alone.end()
    assert status == -signal.SIGABRT
    assert "expected the variables of SLURM or Open MPI" in text
    assert "--hosts and --host-id" in text
    assert "\n2\n" in text
    assert f"host 1 of 2 connects with {silent[1]}" in text
