"""Flights by sight in C MuJoCo: its images agree with ours, and are as slow and late as they should be."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import Camera
from crazysim.__main__ import main
from crazysim.envs import make
from crazysim.envs.statistics import RunningStats
from crazysim.lab.validate import by_sight
from crazysim.lab.validate.by_sight import Condition, Pilot, add_errors, fill_holes, fly_forest, image_source
from crazysim.lab.validate.simulators import COMMAND_PERIOD, MujocoWithDrag, Simulator
from crazysim.plugins.sensors import StereoNoise
from crazysim.train import checkpoint
from crazysim.train.config import TrainConfig
from crazysim.train.export import describe
from crazysim.train.networks import Policy
from crazysim.train.training import POLICY_FILE

N = 4
CAMERA = Camera(16, 12, noise=StereoNoise())


class Gliding(Simulator):
    """Drones that move ahead at 2 m/s, and have jumped over the goal line after one second."""

    def __init__(self, start):
        self.states, self.n_steps = start, 0

    def fly_period(self, commands):
        self.n_steps += 1
        x = 2.0 * COMMAND_PERIOD if self.n_steps < 50 else 1000.0
        self.states = self.states | {"pos": self.states["pos"] + np.array([x, 0, 0])}
        return self.states


class Sinking(Gliding):
    def fly_period(self, commands):
        self.states = self.states | {"pos": self.states["pos"] - np.array([0, 0, 0.1])}
        return self.states


@pytest.fixture(autouse=True)
def simulators(monkeypatch):
    monkeypatch.setitem(by_sight.SIMULATORS, "gliding", Gliding)
    monkeypatch.setitem(by_sight.SIMULATORS, "sinking", Sinking)


def watch(condition):
    """Return the images that a pilot sees, (n_steps, n, 12 * 16), and the shares of success and failure."""
    seen = []

    def act(obs, memory):
        seen.append(np.asarray(obs["depth"])[:, 0])
        return jnp.zeros((N, 1, 4)), memory

    outcome = fly_forest(Pilot(act, lambda *_: (), CAMERA), condition, N)
    return np.stack(seen), outcome


@pytest.mark.long("compiles the task and the rays of the kernel, once for all tests of this file")
def test_images_of_c_mujoco_are_those_of_the_kernel():
    """Rays differ by rounding of float32; the renderer's trunks have 28 sides: 0.6% of at most 0.3 m, 2 mm."""
    data, draw = by_sight.make_forests(N).data, np.random.default_rng(0)
    quat = np.array([0, 0, 0, 1]) + 0.2 * draw.normal(size=(N, 4))
    pos = np.asarray(data.states.pos, np.float64)[:, 0] + [3.0, 0, 0]
    states = {"pos": pos, "quat": quat / np.linalg.norm(quat, axis=-1, keepdims=True)}
    images = {name: image_source(name, N, CAMERA).take(states, np.ones(N, bool)) for name in by_sight.IMAGES}
    own, is_hidden = (np.minimum(x, CAMERA.far) for x in images["crazysim"])
    assert np.ptp(own) > 9
    assert is_hidden.any()
    for name, share in (("mj_multiRay", 1.0), ("renderer", 0.98)):
        depth, hidden = images[name]
        assert np.mean(np.abs(np.minimum(depth, CAMERA.far) - own) < (1e-4 if share == 1 else 0.05)) >= share, name
        assert np.mean(hidden == is_hidden) > 0.995, name  # at edges rounding decides


@pytest.mark.parametrize(("freq", "latency"), [(50, 0), (50, 40), (30, 20), (15, 60)])
def test_images_are_slow_and_late(freq, latency):
    """Images are those that a camera without latency takes at the time, or between those of the steps beside it."""
    seen, outcome = watch(Condition("gliding", "crazysim", freq, latency))
    truth, _ = watch(Condition("gliding", "crazysim"))
    for step in range(0, 50, 7):
        time = max(np.floor((step / 50 - latency / 1000) * freq + 1e-6), 0) / freq
        beside = truth[[int(50 * time + 1e-6), int(np.ceil(50 * time - 1e-6))]]
        is_between = (seen[step] > beside.min(axis=0) - 1e-3) & (seen[step] < beside.max(axis=0) + 1e-3)
        assert np.mean(is_between) > 0.99
    assert np.abs(np.diff(truth, axis=0)).max(axis=(1, 2)).min() > 0.01
    assert outcome[0] > 0
    assert sum(outcome) == 1


def test_drones_on_the_floor_have_failed():
    assert watch(Condition("sinking", "crazysim"))[1] == (0, 1)


def test_the_command_flies_a_run_of_forest(tmp_path, monkeypatch, capsys):
    """Drones that sink touch the ground whatever the policy of zeros commands; the run of another task is left out."""
    config = TrainConfig.create("forest", config={"hidden": [], "convolution": []})
    env = make("forest")
    policy = Policy(RunningStats.create(n := sum(env.observation_sizes.values())), [(jnp.zeros((n, 4)), jnp.zeros(4))])
    for run, task in ((tmp_path / "policies" / "a", "forest"), (tmp_path / "policies" / "b", "hover")):
        meta = describe(env) | {"settings": dataclasses.asdict(config), "task": task}
        run.mkdir(parents=True)
        checkpoint.save(run / POLICY_FILE, policy, meta)
    monkeypatch.setattr(by_sight, "N_FORESTS", N)
    monkeypatch.setattr(by_sight, "CONDITIONS", (Condition("sinking", "crazysim", 30, 20, "stereo, filled"),))
    out = str(tmp_path / "page.md")
    assert main(["validate", "--only", "sight", "--out", out]) == 0
    assert "left out sight: give `--policy`" in capsys.readouterr().out
    for options in (["--data", str(tmp_path)], ["--policy", str(tmp_path / "policies" / "a")]):
        assert main(["validate", "--only", "sight", *options, "--out", out]) == 0
        (row,) = (line for line in Path(out).read_text().splitlines() if "30 Hz" in line)
        assert "20 ms late, noise: stereo, filled | a, sinking | 0 %" in row
        assert "100 % touched or left" in row
    assert main(["validate", "--only", "sight", "--policy", str(tmp_path / "policies" / "b"), "--out", out]) == 2
    assert "expected a policy of forest that commands attitudes at 50 Hz" in capsys.readouterr().err


def test_holes_are_filled_with_the_largest_depth_beside_them():
    depth = jnp.array([[2.0, 0.0, 5.0, 5.0], [2.0, 0.0, 0.0, 5.0], [0.0, 2.0, 3.0, 5.0]])
    filled = np.asarray(fill_holes(depth))
    np.testing.assert_array_equal(filled, [[2, 5, 5, 5], [2, 5, 5, 5], [2, 2, 3, 5]])


def test_errors_are_those_of_the_camera():
    depth, hidden = np.full((500, 12, 16), 4.0), np.zeros((500, 12, 16), bool)
    hidden[:, 3, 4], depth[:, 0, 0] = True, np.inf
    seen = {noise: np.asarray(add_errors(depth, hidden, jax.random.key(0), CAMERA, noise)) for noise in by_sight.NOISES}
    np.testing.assert_array_equal(seen["none"], np.minimum(depth, 10.0).astype(np.float32))
    stereo = seen["stereo"]
    assert (stereo[:, 3, 4] == 0).all()
    assert (seen["stereo, filled"] > 0).all()
    assert (stereo[:, 0, 0] == 10).all()
    deviation = 16 * 0.08 / (424 * 0.05)
    assert stereo[:, 5:].std() == pytest.approx(deviation, rel=4 / np.sqrt(2 * stereo[:, 5:].size))


def test_drag_slows_a_body_in_mujoco():
    """v exp(-D t / m) of a level drone that hovers, with D = 0.0216 N s/m and m = 43.4 g."""
    start = {"pos": np.array([[0, 0, 9.0]]), "quat": np.array([[0, 0, 0, 1.0]]), "vel": np.array([[2.0, 0, 0]])}
    drones = MujocoWithDrag(start | {"ang_vel": np.zeros((1, 3))})
    for _ in range(10):
        vel = drones.fly_period(np.array([[0, 0, 0, 0.0434 * 9.81]]))["vel"][0, 0]
    assert vel == pytest.approx(2 * np.exp(-0.02164 * 0.2 / 0.0434), rel=5e-3)  # and tilts of the controller
