"""Training runs: they learn, resume bit for bit, and refuse checkpoints of other configurations."""

import contextlib
import dataclasses
import io
import json
import re
import shutil
import signal
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from disks import full_disk
from pictures import read_frames

import crazysim
from crazysim import ConfigError, Randomize
from crazysim.__main__ import main
from crazysim.engine.pytree import PyTree
from crazysim.envs import AutoReset, DroneEnv, make
from crazysim.envs.state import flatten
from crazysim.envs.statistics import RunningStats
from crazysim.envs.tasks.hover import Hover
from crazysim.errors import DamagedFileError, DivergedError
from crazysim.storage import write_figure
from crazysim.train import apg, checkpoint, ppo
from crazysim.train import config as configs
from crazysim.train import training as runs
from crazysim.train.config import TrainConfig
from crazysim.train.critic import estimate_advantages, rescale_value, return_std
from crazysim.train.evaluation import crashed_drones, describe_outcome, evaluate
from crazysim.train.networks import MEMORYLESS_NETWORK, Policies, init_weights
from crazysim.train.optimizer import build_optimizer
from crazysim.train.runs import run
from crazysim.train.seeds import rollout_seeds, stack_configs, take_seed
from crazysim.train.show import plot_curve, plot_episode, plot_spread, read_curve
from crazysim.train.training import CHECKPOINT_FILE, POLICY_FILE, load_policy, train

pytestmark = pytest.mark.usefixtures("shared_environments")
SMALL = {"n_steps": 8, "minibatches": 2, "epochs": 1, "hidden": (16, 16)}


def small_config(iterations=4, **changes):
    config = {**SMALL, "iterations": iterations}
    settings = {"task": "hover", "n_worlds": 8, "options": {"seconds": 0.4}, "config": config} | changes
    return TrainConfig.create(**settings)


def discard_line(*_):
    pass


def train_quietly(folder, config, **options):
    return train(config, folder, evaluation_worlds=8, log=discard_line, progress=False, **options)


@pytest.fixture(scope="module")
def uninterrupted_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "whole"
    return train_quietly(folder, small_config())


def checkpoint_arrays(folder):
    with np.load(folder / CHECKPOINT_FILE) as file:
        return {name: file[name] for name in file.files if name != checkpoint.META_ENTRY}


@contextlib.contextmanager
def interrupted_after(iterations, monkeypatch, exception=KeyboardInterrupt):
    """Press Ctrl-C after some iterations, or raise another exception."""
    n_calls = [0]

    @contextlib.contextmanager
    def bar(*_):
        def show(*_):
            n_calls[0] += 1
            if n_calls[0] == iterations:
                raise exception

        yield show

    with monkeypatch.context() as patch:
        patch.setattr(runs, "_iteration_bar", bar)
        yield


def test_an_interrupted_run_resumes_bit_for_bit(uninterrupted_run, tmp_path, monkeypatch):
    """Interrupted after two of four iterations and resumed, a run ends with the arrays of an uninterrupted one."""
    lines = []
    with interrupted_after(2, monkeypatch), pytest.raises(KeyboardInterrupt):
        train(small_config(), tmp_path, evaluation_worlds=8, log=lines.append, progress=False)
    assert "interrupted after iteration 2" in lines[-1]
    assert str(tmp_path / CHECKPOINT_FILE) in lines[-1]
    assert "--resume" in lines[-1]
    train_quietly(tmp_path, small_config(), resume=True)
    actual, reference = checkpoint_arrays(tmp_path), checkpoint_arrays(uninterrupted_run.folder)
    assert actual.keys() == reference.keys()
    for name, x in actual.items():
        np.testing.assert_array_equal(x, reference[name], err_msg=name)
    assert [p["iteration"] for p in json.loads((tmp_path / "curve.json").read_text())][-1] == 4


def test_a_checkpoint_between_evaluations_resumes_bit_for_bit(uninterrupted_run, tmp_path, monkeypatch):
    """A run that is killed after three of four iterations writes nothing at its end, and goes on from the second."""
    with interrupted_after(3, monkeypatch, exception=MemoryError), pytest.raises(MemoryError):
        train_quietly(tmp_path, small_config(), checkpoint_every=1e-6)
    assert checkpoint_arrays(tmp_path)["['learner'].iteration"] == 2
    lines = []
    train(small_config(), tmp_path, resume=True, evaluation_worlds=8, log=lines.append, progress=False)
    assert "continues after iteration 2" in lines[0]
    actual, reference = checkpoint_arrays(tmp_path), checkpoint_arrays(uninterrupted_run.folder)
    for name, x in actual.items():
        np.testing.assert_array_equal(x, reference[name], err_msg=name)
    assert [p["iteration"] for p in read_curve(tmp_path)] == [0, 4]


def test_a_run_that_a_scheduler_ends_writes_its_checkpoint(tmp_path, monkeypatch, capsys):
    """Sent SIGTERM twice, as ``timeout`` does, it ends with the status of that signal and continues from there.

    The second signal arrives while the checkpoint is written.
    """
    save, seen = checkpoint.save, []

    def save_in_spite_of_signal(*arguments):
        if seen:
            signal.raise_signal(signal.SIGTERM)
        save(*arguments)

    @contextlib.contextmanager
    def bar(*_):
        def terminate(*_):
            seen.append(signal.getsignal(signal.SIGTERM))
            signal.raise_signal(signal.SIGTERM)

        yield terminate

    monkeypatch.setattr(runs.checkpoint, "save", save_in_spite_of_signal)
    monkeypatch.setattr(runs, "_iteration_bar", bar)
    small_options = [f"{k}={json.dumps(v)}" for k, v in SMALL.items()]
    with pytest.raises(SystemExit) as end:
        main(["train", "hover", "--worlds", "8", "--set", "seconds=0.4", "--out", str(tmp_path), "--no-film",
              "--config", *small_options, "iterations=4"])  # fmt: skip
    assert (end.value.code, len(seen)) == (143, 1)
    assert "interrupted after iteration 1; wrote" in capsys.readouterr().out
    assert checkpoint_arrays(tmp_path)["['learner'].iteration"] == 1
    assert signal.getsignal(signal.SIGTERM) != seen[0], "the handler is removed"


def test_a_later_policy_within_two_standard_errors_is_kept():
    """The standard error of 1,000 starts at 80% is 1.26%, by hand; at 100% it is not zero."""
    assert runs.least_kept_success(0.80, 1000) == pytest.approx(0.80 - 2 * 0.01262, abs=1e-4)
    assert runs.least_kept_success(0.80, 1000) < 0.797
    assert 0.996 < runs.least_kept_success(1.0, 1000) < 0.999
    assert runs.least_kept_success(0.0, 1000) < 0.0


def test_the_last_evaluation_of_a_resumed_run_stays_kept_where_it_is_repeated(tmp_path):
    training = runs._Training("", runs.TrainConfig.create("hover"), tmp_path, {}, [])
    for iteration, is_planned in ((120, True), (130, True), (130, False)):
        point = {"iteration": iteration, "check": 1.0}
        training.add_evaluation(point, np.int32(iteration), 1000, {}, is_planned)
        assert runs.kept_point(training.curve)["iteration"] == training.kept_policy == iteration


def test_the_policy_that_did_best_on_the_check_set_is_kept(tmp_path, monkeypatch):
    """A learning rate that ruins the policy leaves a better one. An interrupt writes the best until then, but does not
    change what an uninterrupted run keeps, which evaluates less often."""
    monkeypatch.setitem(configs.RECIPES, "hover", configs.Recipe(evaluate_every=1))
    config = small_config(
        options={"seconds": 1.2, "tolerance": 1.5, "hold": 0.1}, config=SMALL | {"iterations": 8, "learning_rate": 0.03}
    )
    lines = []
    result = train(config, tmp_path, evaluation_worlds=64, log=lines.append, progress=False)
    curve = read_curve(tmp_path)
    checks = [point["check"] for point in curve]
    smallest_kept = runs.least_kept_success(max(checks), 64)
    best = max(i for i, check in enumerate(checks) if check >= smallest_kept)
    assert best < len(checks) - 1
    assert [i for i, point in enumerate(curve) if point["kept"]][-1] == best
    assert any(f"kept the policy of iteration {best}: later ones succeeded less often on 64 " in x for x in lines)
    assert result.metrics["success"] == curve[best]["success"]
    assert result.metrics["env_steps"] == curve[-1]["env_steps"]
    for policy in (result.policy, load_policy(tmp_path)[0]):
        assert evaluate(result.env, policy, jax.random.key(runs.CHECK_SEED))["success"] == checks[best]
        assert evaluate(result.env, policy)["success"] == result.metrics["success"]
    assert 0 < best < 8
    monkeypatch.setitem(configs.RECIPES, "hover", configs.Recipe(evaluate_every=8))
    whole_folder, cut_folder = (tmp_path / name for name in ("whole", "cut"))
    train(config, whole_folder, evaluation_worlds=64, log=discard_line, progress=False)
    with interrupted_after(best, monkeypatch), pytest.raises(KeyboardInterrupt):
        train(config, cut_folder, evaluation_worlds=64, log=discard_line, progress=False)
    assert evaluate(result.env, load_policy(cut_folder)[0], jax.random.key(runs.CHECK_SEED))["success"] == checks[best]
    train(config, cut_folder, resume=True, evaluation_worlds=64, log=discard_line, progress=False)
    actual, reference = checkpoint_arrays(cut_folder), checkpoint_arrays(whole_folder)
    for name, x in actual.items():
        np.testing.assert_array_equal(x, reference[name], err_msg=name)


@pytest.mark.parametrize(
    ("changes", "resume", "message"),
    [
        ({}, False, r"a folder without a run.*--resume.*--out"),
        ({"seed": 5}, True, "seed = 0 .*, got 5"),
        ({"config": SMALL | {"hidden": (8,)}}, True, r"hidden = \[16, 16\] .*got \[8\].*may change iterations, le"),
        ({"options": {}}, True, r"seconds = 0\.4 as in .*, got 'its default'"),
    ],
)
def test_resuming_with_another_configuration_is_an_error(uninterrupted_run, changes, resume, message):
    with pytest.raises(ConfigError, match=message):
        train_quietly(uninterrupted_run.folder, small_config(**changes), resume=resume)


def test_a_finished_run_resumes_with_more_iterations(uninterrupted_run, tmp_path):
    """Settings that are passed change; all others, also the number of worlds, are those of the run."""
    shutil.copy(uninterrupted_run.folder / CHECKPOINT_FILE, tmp_path)
    lines = []
    quiet_options = {"film": False, "evaluation_worlds": 8, "progress": False, "log": lines.append}
    result = run("hover", tmp_path, resume=True, config={"iterations": 6, "learning_rate": 1e-4}, **quiet_options)
    assert [point["iteration"] for point in read_curve(tmp_path)] == [0, 4, 6]
    config = load_policy(tmp_path)[1]
    assert config == small_config(config=SMALL | {"iterations": 6, "learning_rate": 1e-4})
    assert "continues after iteration 4" in lines[0]
    assert any(
        np.any(a != b)
        for a, b in zip(jax.tree.leaves(result.policy), jax.tree.leaves(uninterrupted_run.policy), strict=True)
    )
    run("hover", tmp_path, resume=True, **quiet_options)
    assert "nothing is left to train after 6 iterations; continue with more: --iterations 12" in lines


@pytest.mark.long("compiles iterations of two algorithms")
@pytest.mark.parametrize("algorithm", ["ppo", "apg"])
def test_a_training_starts_from_the_policy_of_a_run(uninterrupted_run, algorithm):
    """First the value function learns alone, then the policy, too; another network or command level is an error."""
    folder, config = str(uninterrupted_run.folder), SMALL | {"value_iterations": 1, "entropy": 0.1}
    config = config if algorithm == "ppo" else {"n_steps": 8, "hidden": (16, 16)}
    module, policy = {"ppo": ppo, "apg": apg}[algorithm], uninterrupted_run.policy
    env = make("hover", 4, seconds=0.4, engine="plain")
    env = AutoReset(env) if algorithm == "ppo" else env
    algorithm_config = (module.Config(**config, start=folder),)
    learner = module.init(env, algorithm_config, jax.random.key(0)[None])
    jax.tree.map(np.testing.assert_array_equal, take_seed(learner.as_policy(), 0).layers, policy.layers)
    for stays in (True, False) if algorithm == "ppo" else (False,):
        old, (learner, _) = learner.agents, module.iterate(learner, env, algorithm_config)
        before, after = (jax.tree.leaves((x.policy, getattr(x, "log_std", 0))) for x in (old, learner.agents))
        assert all(np.array_equal(x, y) for x, y in zip(before, after, strict=True)) == stays
        assert not stays or not np.array_equal(old.value.layers[0][0], learner.agents.value.layers[0][0])
        np.testing.assert_array_equal(take_seed(learner.as_policy(), 0).stats.var, policy.stats.var)
    seeing = make("hover", 4, seconds=0.4, depth_image=(4, 3), engine="plain")
    seeing = AutoReset(seeing) if algorithm == "ppo" else seeing
    learner = module.init(seeing, algorithm_config, jax.random.key(0)[None])
    obs = {name: x for name, x in learner.env.obs.items() if name != "depth"}
    more = take_seed(learner.as_policy(), 0)(learner.env.obs)
    np.testing.assert_allclose(more, policy(obs), atol=1e-6, err_msg="an image that is new has no effect yet")
    for wrong_env, changes, message in (
        (env, {"hidden": (8,)}, r"\(16, 16\).*got .*\(8, .*hidden, memory"),
        (make("hover", 4, control="body_rate"), {}, "body_rate commands in place of attitude"),
        (make("reach_vel", 4), {}, "interface of the policy"),
    ):
        with pytest.raises(ConfigError, match=message):
            module.init(wrong_env, (module.Config(**config | changes, start=folder),), jax.random.key(0)[None])


def test_metrics_of_each_iteration_are_passed_on(uninterrupted_run, tmp_path, monkeypatch):
    """Metrics of evaluations are passed on too, also in interrupted and resumed runs. The run does not change."""
    recipe = dataclasses.replace(configs.RECIPES["hover"], evaluate_every=2)
    monkeypatch.setitem(configs.RECIPES, "hover", recipe)
    seen = []
    with interrupted_after(4, monkeypatch), pytest.raises(KeyboardInterrupt):  # an evaluation shows metrics as well
        train_quietly(tmp_path, small_config(), on_iteration=lambda *call: seen.append(call))
    train_quietly(tmp_path, small_config(), resume=True, on_iteration=lambda *call: seen.append(call))
    assert [i for i, _ in seen] == [1, 2, 4]
    assert {"reward", "crashed", "error", "std", "value_error", "ratio_off"} == seen[0][1].keys()
    point = read_curve(tmp_path)[-1]
    assert {"evaluation success", "evaluation kept"} < seen[1][1].keys()
    assert seen[-1][1]["evaluation reward"] == point["reward"]
    assert all(type(x) is float for _, metrics in seen for x in metrics.values())
    actual, reference = checkpoint_arrays(tmp_path), checkpoint_arrays(uninterrupted_run.folder)
    for name in (name for name in actual if "learner" in name):
        np.testing.assert_array_equal(actual[name], reference[name], err_msg=name)
    train_quietly(tmp_path, small_config(), resume=True, on_iteration=lambda *call: seen.append(call))
    assert len(seen) == 3


def test_evaluations_hold_the_terms_of_the_reward(uninterrupted_run, tmp_path, monkeypatch):
    """Terms add up to the return, and the plot of an episode returns them over time."""
    point = read_curve(uninterrupted_run.folder)[-1]
    terms = [x for name, x in point.items() if name.startswith("reward ")]
    assert len(terms) == 4
    np.testing.assert_allclose(sum(terms), point["reward"], rtol=1e-5)
    labels = []
    monkeypatch.setattr(
        "crazysim.train.show.write_figure",
        lambda *args, **kwargs: (
            labels.extend(axis.get_ylabel() for axis in args[0].axes),
            write_figure(*args, **kwargs),
        ),
    )
    over_time = plot_episode(uninterrupted_run.env, uninterrupted_run.policy, tmp_path / "episode.png")
    assert (tmp_path / "episode.png").stat().st_size > 5000
    assert (labels[0], labels[-1]) == ("error, m", "reward until then, sum")
    assert {name: x.shape for name, x in over_time.items()} == dict.fromkeys(
        ("proximity", "spin", "action_rate", "crash"), (20,)
    )
    np.testing.assert_allclose(over_time["proximity"].sum(), point["reward proximity"], rtol=1e-5)
    # A policy that falls is paid until it crashes, and never after that.
    fallen = plot_episode(make("hover", 8, seconds=2.0), ConstantPolicy(-jnp.ones(4)), tmp_path / "fallen.png")
    assert fallen["proximity"][0] > 0
    assert fallen["proximity"][-1] == 0
    np.testing.assert_allclose(fallen["crash"].sum(), -10.0, rtol=1e-6)


def test_a_checkpoint_of_another_version_is_refused(uninterrupted_run, tmp_path):
    _, meta = checkpoint.read(uninterrupted_run.folder / CHECKPOINT_FILE)
    learner = {"x": np.zeros(2, np.float32)}
    checkpoint.save(tmp_path / CHECKPOINT_FILE, learner, meta | {"crazysim": "0.0.1"})
    with pytest.raises(ConfigError, match=r"checkpoint of crazysim .*, got .* of 0\.0\.1"):
        train_quietly(tmp_path, small_config(), resume=True)
    stored, _ = checkpoint.read(tmp_path / CHECKPOINT_FILE)
    with pytest.raises(ConfigError, match="arrays of this task and version"):
        checkpoint.restore(tmp_path / CHECKPOINT_FILE, stored, {"y": np.zeros(2, np.float32)})
    with pytest.raises(ConfigError, match=r"\['x'\] in .* as float32 \(3,\), got float32 \(2,\)"):
        checkpoint.restore(tmp_path / CHECKPOINT_FILE, stored, {"x": np.zeros(3, np.float32)})


def truncate(content):
    return content[: len(content) // 2]


def flip_bit(content):
    position = content.index(b"NUMPY") + 300
    return content[:position] + bytes([content[position] ^ 1]) + content[position + 1 :]


def replace_meta(content):
    with np.load(io.BytesIO(content)) as file:
        stored_arrays = dict(file)
    changed = io.BytesIO()
    np.savez(
        changed, **stored_arrays | {checkpoint.META_ENTRY: np.array(json.dumps({"crazysim": crazysim.__version__}))}
    )
    return changed.getvalue()


@pytest.mark.parametrize("damage",
                         [truncate, flip_bit, replace_meta, lambda _: b"", lambda _: b"nothing", np.random.bytes],
                         ids=["cut", "flipped", "other", "empty", "text", "random"])  # fmt: skip
def test_a_damaged_run_is_refused_with_the_name_of_the_file(uninterrupted_run, tmp_path, damage):
    """The run is refused before anything is compiled."""
    for name in (CHECKPOINT_FILE, POLICY_FILE):
        content = (uninterrupted_run.folder / name).read_bytes()
        (tmp_path / name).write_bytes(damage(content) if damage is not np.random.bytes else damage(1000))
    with pytest.raises(DamagedFileError, match=r"checkpoint .*checkpoint\.npz', which is damaged.*train again"):
        train_quietly(tmp_path, small_config(), resume=True)
    with pytest.raises(DamagedFileError, match=r"checkpoint .*policy\.npz', which is damaged.*train again"):
        load_policy(tmp_path)


def test_a_run_without_its_learning_curve_resumes(uninterrupted_run, tmp_path):
    shutil.copy(uninterrupted_run.folder / CHECKPOINT_FILE, tmp_path)
    with pytest.raises(ConfigError, match=r"existing file with a learning curve, got .*curve\.json"):
        read_curve(tmp_path)
    (tmp_path / "curve.json").write_text('[{"iteration": 0, "env')
    with pytest.raises(DamagedFileError, match=r"learning curve, got .*curve\.json.*--resume"):
        read_curve(tmp_path)
    (tmp_path / "curve.json").write_text('[{"iteration": 4, "success": 0.5}]')
    assert read_curve(tmp_path) == [{"iteration": 4, "success": 0.5}]
    train_quietly(tmp_path, small_config(), resume=True)
    assert [point["iteration"] for point in read_curve(tmp_path)] == [0, 4]
    assert not list(tmp_path.glob("*.part"))


INVALID_HYPERPARAMETERS = [
    *(("init_std", value) for value in (-0.5, 0, 1e-60)),  # float32 rounds the last one to zero
    *(("learning_rate", value) for value in (float("nan"), float("inf"), "fast")),
    ("n_steps", 0),
    ("minibatches", 0),
    ("epochs", 1.5),
    ("iterations", -1),
    ("hidden", [0]),
    ("hidden", 64),
    ("memory", -1),
    ("memory", 0.5),
    ("critic", "all"),
    ("discount", 1.01),
    ("value_weight", -1),
    ("max_grad_norm", 0),
]


@pytest.mark.parametrize(("name", "value"), INVALID_HYPERPARAMETERS)
def test_invalid_hyperparameters_are_refused(name, value):
    for make_config in (lambda **config: small_config(config=config), ppo.Config):
        with pytest.raises(ConfigError, match=rf"{name}.*({re.escape(repr(value))}|is 0)"):
            make_config(**{name: value})


def test_invalid_settings_of_a_run_are_refused(tmp_path):
    def start(**changes):
        train_quietly(tmp_path / "run", small_config(**changes))

    (tmp_path / "file").write_text("")
    for call, message in (
        (lambda: small_config(n_worlds=0), "n_worlds is 0"),
        (lambda: small_config(seed=1.5), "integer as seed, got 1.5"),
        (lambda: small_config(seed=2**70), "64 bits"),
        (lambda: small_config(algorithm="sac"), "algorithm of ppo, apg, dagger, got 'sac'"),
        (lambda: small_config(task="juggle"), "'juggle' does not exist; there are hover"),
        (lambda: small_config(config={"learning_speed": 1}), "hyperparameters of ppo, got learning_speed; use iter"),
        (lambda: small_config().make_env(0), "n_worlds is 0"),
        (lambda: train_quietly(tmp_path / "file", small_config()), r"a folder, got .*file'.* Use another --out"),
        (lambda: train_quietly(tmp_path / "nothing", small_config(), resume=True), r"checkpoint .*crazysim train"),
        (lambda: start(config={"n_steps": 16, "minibatches": 7}), "7 minibatches .* 14 worlds, or minibatches=8"),
        (lambda: start(options={"pos": np.zeros(3)}), "options that a checkpoint can hold"),
        (lambda: start(options={"effects": [Randomize.crazyflie()]}), "add plugins in install of a custom task"),
        (lambda: train_quietly(tmp_path / "run", small_config(), checkpoint_every=0), "checkpoint_every"),
        (lambda: train(small_config(), tmp_path / "run", evaluation_worlds=0), "evaluation_worlds is 0"),
    ):
        with pytest.raises(ConfigError, match=message):
            call()
    assert not (tmp_path / "run").exists()


def test_a_training_that_diverges_stops_and_keeps_its_last_checkpoint(tmp_path):
    config = small_config(config=SMALL | {"iterations": 4, "learning_rate": 1e38})
    with pytest.raises(
        DivergedError, match=r"NaN or infinity in iteration \d of hover by ppo; .*iteration 0\. Use a sm"
    ):
        train_quietly(tmp_path, config)
    assert [point["iteration"] for point in read_curve(tmp_path)] == [0]
    policy, _, _ = load_policy(tmp_path)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(policy))
    assert all(np.isfinite(x).all() for name, x in checkpoint_arrays(tmp_path).items() if ".policy" in name)


def make_interrupt(name, count):
    """Return a function for ``sys.settrace`` that presses Ctrl-C at the ``count``-th call of a function of a name."""
    calls = [0]

    def trace(frame, event, _):
        if event == "call" and frame.f_code.co_name == name:
            calls[0] += 1
            if calls[0] == count:
                raise KeyboardInterrupt

    return trace


@pytest.fixture
def traced():
    """Return ``sys.settrace``, and remove what it set."""
    before = sys.gettrace()
    yield sys.settrace
    sys.settrace(before)


def test_an_interrupt_before_nan_is_found_keeps_the_last_checkpoint(tmp_path, traced):
    """The first iteration diverges, which is checked while the second one runs. Ctrl-C in between writes no NaN."""
    config = small_config(config=SMALL | {"iterations": 4, "learning_rate": 1e38})
    traced(make_interrupt("mark_diverged", 2))  # the first call is that of the evaluation before the training
    with pytest.raises(DivergedError, match=r"NaN or infinity in iteration 1 of hover .*iteration 0\. Use a sm"):
        train_quietly(tmp_path, config)
    assert [point["iteration"] for point in read_curve(tmp_path)] == [0]
    assert all(np.isfinite(x).all() for name, x in checkpoint_arrays(tmp_path).items() if ".policy" in name)


def test_an_interrupt_during_a_planned_evaluation_leaves_the_curve_of_an_uninterrupted_run(
    tmp_path, monkeypatch, traced
):
    """Otherwise the resumed run could end with another policy."""
    recipe = dataclasses.replace(configs.RECIPES["hover"], evaluate_every=2)
    monkeypatch.setattr(runs, "find_recipe", lambda *_: recipe)
    train_quietly(tmp_path / "whole", small_config())
    traced(make_interrupt("add_evaluation", 2))
    with pytest.raises(KeyboardInterrupt):
        train_quietly(tmp_path / "cut", small_config())
    sys.settrace(None)
    train_quietly(tmp_path / "cut", small_config(), resume=True)
    actual, reference = (
        [{k: x for k, x in point.items() if "seconds" not in k} for point in read_curve(tmp_path / name)]
        for name in ("cut", "whole")
    )
    assert [point["iteration"] for point in actual] == [0, 2, 4]
    np.testing.assert_equal(actual, reference)  # NaN equals NaN


def test_a_full_disk_leaves_the_last_checkpoint_and_nothing_else(tmp_path):
    path = tmp_path / CHECKPOINT_FILE
    checkpoint.save(path, {"x": np.zeros(2)}, {"iteration": 1})
    with full_disk(2000), pytest.raises(ConfigError, match=r"file that can be written, got .*checkpoint"):
        checkpoint.save(path, {"x": np.zeros(2000)}, {"iteration": 2})
    assert [p.name for p in tmp_path.iterdir()] == [CHECKPOINT_FILE]
    assert checkpoint.read(path)[1] == {"iteration": 1}


def test_a_policy_is_restored_unchanged(uninterrupted_run):
    policy, config, meta = load_policy(uninterrupted_run.folder)
    assert config == small_config()
    assert sum(meta["observations"].values()) == policy.layers[0][0].shape[0]
    for a, b in zip(jax.tree.leaves(policy), jax.tree.leaves(uninterrupted_run.policy), strict=True):
        np.testing.assert_array_equal(a, b)


class ConstantPolicy(PyTree):
    """Policy with the same action for all observations."""

    action: jax.Array
    """Action. (k,)"""

    def __call__(self, obs):
        return jnp.broadcast_to(self.action, (*obs["pos"].shape[:-1], *self.action.shape))


def test_evaluation_uses_tolerance_and_hold_of_the_task():
    """A policy of zeros hovers at its start, so it fails unless the goal is there."""
    idle, falling = ConstantPolicy(jnp.zeros(4)), ConstantPolicy(-jnp.ones(4))
    result = evaluate(make("hover", 16, seconds=2.0, reach=1.0), idle)
    assert result["success"] == 0
    assert 0.3 < result["error"] < 3
    assert result["crashed"] < 1
    easy = make("hover", 16, seconds=2.0, reach=1e-3, tolerance=1e3)
    assert evaluate(easy, idle)["success"] == 1
    # A crash is no success, however small the error was.
    crashed = evaluate(easy, falling)
    assert crashed["crashed"] == 1
    assert crashed["success"] == 0
    assert re.fullmatch(
        r"crashed 100\.0%, late or outside 0\.0%, on average after 0\.\d+ s, so there is no mean error",
        describe_outcome(crashed, "m"),
    )
    assert re.match(r"mean error 0\.\d+ m/s, ", describe_outcome(evaluate(easy, idle), "m/s"))
    lost = evaluate(easy, ConstantPolicy(jnp.full(4, jnp.nan)))
    assert lost["nonfinite"] == 1
    assert "of all worlds 100.0% became non-finite" in describe_outcome(lost, "m")


def test_who_arrives_too_late_has_not_crashed():
    env = types.SimpleNamespace(task=types.SimpleNamespace(outcomes=("finished", "disabled")))
    finished, succeeded = (np.array(x)[:, None] for x in ([True, True, False], [True, False, False]))
    flight = {"over": np.ones((2, 3), bool), "succeeded": succeeded, "outcomes": {"finished": finished}}
    assert crashed_drones(env, flight).ravel().tolist() == [False, False, True]


def test_a_value_at_the_horizon_is_learnt_from_rewards_until_episodes_end(rng):
    """Rewards of 1 are worth (1 - 0.9^4) / (1 - 0.9) after three of seven steps of an episode, and nothing at its end.

    Observations are the number of steps until the end, or so many that there is none.
    """
    config = apg.Config(n_steps=8, critic_epochs=40, minibatches=1, iterations=400, learning_rate=0.01, discount=0.9)
    steps = np.arange(8)[:, None, None]
    left = np.concatenate([np.full((8, 16, 1), 50.0), np.broadcast_to(7.0 - steps, (8, 16, 1))], axis=1)
    obs = jnp.asarray(left[..., None] / 10, jnp.float32)
    terminated = jnp.asarray(left[..., 0] == 1.0)
    rewards = jnp.where(left > 0, 1.0, jnp.asarray(rng.normal(0, 100, size=left.shape), jnp.float32))
    records, last_obs = (obs, rewards, terminated), obs[-1]
    value = init_weights(MEMORYLESS_NETWORK, jax.random.key(0), 1, (16, 1), 1.0)
    optimizer = build_optimizer(config.learning_rate, config.max_grad_norm, config.n_updates).init(value)
    stats, returns = RunningStats.create(1), RunningStats.create(1)
    agent = apg.Agent((), (), stats, returns, jax.random.key(1), value, optimizer, 1)
    learn = jax.jit(lambda agent, i: apg.learn_value(agent, config, records, last_obs, i)[0])
    for i in range(60):
        agent = learn(agent, i)
    estimates = agent.estimate_value(jnp.array([[0.4], [5.0]]), config)
    np.testing.assert_allclose(estimates, [(1 - 0.9**4) / 0.1, 10.0], rtol=0.1)
    # The loss counts the value of the worlds that still fly.
    loss, _ = apg.compute_loss(agent, config, records, jnp.zeros(1), last_obs, apg.STATS_ITERATIONS)
    flying = agent.estimate_value(last_obs[:1], config).item() * 0.5
    discounted = np.sum(0.9 ** np.arange(8) * np.asarray(rewards).mean(axis=(1, 2)))
    assert float(loss) == pytest.approx(-(discounted + 0.9**8 * flying) / 8, rel=1e-5)


def test_advantages_are_sums_of_discounted_errors(rng):
    """Generalised advantage: sum of (gamma lambda)^k delta_(t+k) up to the end of the episode, in NumPy."""
    config = ppo.Config(discount=0.9, gae_lambda=0.7)
    reward, value = rng.normal(size=(2, 6, 3, 1)).astype(np.float32)
    last_value = rng.normal(size=(3, 1)).astype(np.float32)
    done = np.zeros((6, 3, 1), bool)
    done[2, 0], done[5, 1] = True, True
    estimate = jax.jit(estimate_advantages, static_argnums=2)
    advantages, returns = estimate((reward, value, done), last_value, config)
    next_value = np.concatenate([value[1:], last_value[None]])
    delta = reward + 0.9 * next_value * ~done - value
    expected = np.zeros_like(delta)
    for t, world in np.ndindex(6, 3):
        for k in range(t, 6):
            expected[t, world] += (0.9 * 0.7) ** (k - t) * delta[k, world]
            if done[k, world]:
                break
    np.testing.assert_allclose(advantages, expected, atol=1e-5)
    np.testing.assert_allclose(returns, expected + value, atol=1e-5)


def test_a_truncated_episode_is_credited_with_the_value_of_its_last_state():
    """The reward of a truncated step contains the discounted value of the final observation; no other step does."""
    env = AutoReset(make("hover", 4, seconds=0.06, engine="interpret"))  # three steps an episode
    config = ppo.Config(n_steps=4, minibatches=4, discount=0.5, hidden=(8,))
    learner = jax.jit(ppo.init, static_argnums=(0, 1))(env, (config,), jax.random.key(0)[None])
    fly = jax.jit(rollout_seeds, static_argnums=(0, 2, 3, 6))
    seeds = learner.agents, stack_configs((config,))
    _, _, (samples, _, _) = fly(env, learner.env, ppo.act, ppo.record, seeds, jax.random.key(1)[None], 4, ((), ()))
    agent = take_seed(learner.agents, 0)
    state, step = learner.env, jax.jit(env.step)
    n_truncated = 0
    for k in range(4):
        state = step(state, samples.action[k, 0])
        value, _ = agent.estimate_value(agent.stats.normalize(flatten(state.info["final_obs"])), (), config)
        truncated = np.asarray(state.truncated & ~state.terminated)[:, None]
        n_truncated += truncated.sum()
        np.testing.assert_allclose(samples.reward[k, 0], state.reward + 0.5 * truncated * value, atol=1e-5)
        assert np.abs(value).min() > 1e-3
    assert n_truncated == 4


def test_values_stay_when_the_returns_that_scale_them_change(rng):
    """The last layer takes the change, so that the network predicts the same returns in other units."""
    env = AutoReset(make("hover", 4, engine="interpret"))
    config = ppo.Config(minibatches=4, hidden=(8,))
    learner = jax.jit(ppo.init, static_argnums=(0, 1))(env, (config,), jax.random.key(0)[None])
    agent = take_seed(learner.agents, 0)
    obs = jnp.asarray(rng.normal(size=(5, agent.stats.mean.shape[0])), jnp.float32)
    before = agent.estimate_value(obs, (), config)[0]
    returns = agent.returns.update(jnp.asarray(rng.normal(30.0, 7.0, (1000, 1)), jnp.float32))
    after = agent.replace(value=rescale_value(agent.value, agent.returns, returns), returns=returns)
    np.testing.assert_allclose(after.estimate_value(obs, (), config)[0], before, atol=30 * 1e-6)
    assert np.abs(agent.replace(returns=returns).estimate_value(obs, (), config)[0] - before).min() > 1
    np.testing.assert_allclose(return_std(returns), 7.0, rtol=0.1)


def test_ppo_finds_the_action_that_pays():
    """With a reward that is largest at 0.5, thirty iterations move the action from 0 to 0.5."""

    class RewardedAction(Hover):
        """Hovering with a reward for the action only."""

        def rewards(self, data, action, last_action):
            return {"action": -jnp.sum((action - 0.5) ** 2, axis=-1)}

    base = make("hover", 128, freq=500, seconds=0.1)
    env = AutoReset(DroneEnv(base.sim, RewardedAction(seconds=0.1), freq=500))
    config = ppo.Config(iterations=30, n_steps=16, minibatches=4, hidden=(16,), init_std=0.3, discount=0.5)
    learner = jax.jit(ppo.init, static_argnums=(0, 1))(env, (config,), jax.random.key(0)[None])
    assert np.abs(Policies(learner.as_policy())(learner.env.obs)).max() < 0.1
    for _ in range(config.iterations):
        learner, metrics = ppo.iterate(learner, env, (config,))
    action = np.asarray(Policies(learner.as_policy())(learner.env.obs))
    assert metrics["finite"]
    lost = learner.agents.replace(log_std=learner.agents.log_std + jnp.nan)
    _, metrics = ppo.iterate(learner.replace(agents=lost), env, (config,))
    assert not metrics["finite"]
    assert np.abs(action.mean(axis=(0, 1)) - 0.5).max() < 0.1
    assert float(jnp.exp(learner.agents.log_std).max()) < 0.3


SIGHT = """
from crazysim.envs.tasks.hover import Hover

class Sight(Hover):
    def observe(self, data):
        return {"height": data.states.pos[..., 2:]}
"""
"""Task with other observations than hover."""


def test_the_command_line_trains_evaluates_and_exports(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("crazysim.train.runs.plot_curve", plot_curve)
    monkeypatch.setattr("crazysim.train.runs.plot_episode", plot_episode)
    folder, task_file = str(tmp_path / "hover"), tmp_path / "sight.py"
    task_file.write_text(SIGHT, encoding="utf-8")
    small_options = [f"{k}={json.dumps(v)}" for k, v in SMALL.items()]
    done = main(["train", "hover", "--worlds", "8", "--iterations", "2", "--set", "seconds=0.4", "--out", folder,
                 "--no-film", "--config", *small_options])  # fmt: skip
    out = capsys.readouterr().out
    assert done == 0
    assert re.search(r"success \d+\.\d% of 1,000 held-out starts", out)
    assert (tmp_path / "hover" / "curve.png").stat().st_size > 5000
    assert (tmp_path / "hover" / "episode.png").stat().st_size > 5000
    assert main(["evaluate", folder, "--worlds", "8"]) == 0
    assert re.search(
        r"hover, 8 starts \(error below .*\): success .*, mean return \S+ \(action_rate .*, proximity \d",
        capsys.readouterr().out,
    )
    assert main(["evaluate", folder, "--worlds", "8", "--set", "hold=0.1", "--set", "tolerance=0.5", "freq=25"]) == 0
    assert "8 starts (error below 0.5 m for the last 0.1 s)" in capsys.readouterr().out
    assert main(["evaluate", folder, "--worlds", "8", "--plot", str(tmp_path / "terms.png")]) == 0
    assert (tmp_path / "terms.png").stat().st_size > 5000
    capsys.readouterr()
    assert main(["evaluate", folder, "--worlds", "8", "--device", "tpu"]) == 2
    assert "expected a device of this host" in capsys.readouterr().err
    assert main(["export", folder, "--c", str(tmp_path / "p.h")]) == 0
    assert "void policy(" in (tmp_path / "p.h").read_text()
    for arguments, message in (
        (["export", folder], "--onnx FILE, --c FILE"),
        (["export", folder, "--c", "policy.txt"], "ends with .h, got 'policy.txt'"),
        (["export", folder, "--onnx", "policy.h"], "ends with .onnx, got 'policy.h'"),
        (["evaluate", f"{folder}/policy.npz"], f"got the file '{folder}/policy.npz'. Use '{folder}'."),
        (["evaluate", folder, "--set", "secnds=1"], "did you mean seconds?"),
        (["evaluate", folder, "--task", str(task_file)], "no vel 3, height 1 in addition. Use"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
    assert main(["train", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "hover          Reach a random point and hover there."
    assert len({line[:15].rstrip() for line in lines}) == len({line[15:] for line in lines}) == len(lines)
    assert not any("`" in line for line in lines)
    assert main(["train", "hover", "--set", "secnds=1", "--out", str(tmp_path / "x")]) == 2
    assert "did you mean seconds?" in capsys.readouterr().err


def test_a_film_shows_the_drone_and_its_goal(uninterrupted_run, tmp_path):
    """The green target is in the image, and the image changes from the first frame to the last."""
    from crazysim.train.show import film

    env = small_config().make_env(2)
    path = tmp_path / "film.gif"
    assert film(env, uninterrupted_run.policy, path, worlds=1) == 11 + 25, "with a second of the last image"
    env.sim.close()  # a renderer that is collected on a thread of a later training cannot be freed there
    images = read_frames(path, 360, 480, "-vf", "scale=480:360").astype(int)
    green = (images[0][..., 1] - images[0][..., 0] > 40) & (images[0][..., 1] - images[0][..., 2] > 20)
    assert green.sum() > 20
    assert np.abs(images[-1] - images[0]).max() > 60


def test_a_run_finds_its_airframe_from_any_folder(tmp_path, monkeypatch):
    (tmp_path / "mine.toml").write_text('base = "cf2x_L250"\n', encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    config = TrainConfig.create("hover", options={"drone": "mine.toml"})
    assert config.options == {"drone": str(tmp_path / "mine.toml")}
    assert TrainConfig.create("hover", options={"drone": "cf2x_L250"}).options == {"drone": "cf2x_L250"}
    monkeypatch.chdir("/")
    assert config.make_env(1).sim.drone == "mine"


@pytest.mark.parametrize("n_crashed", [1, 2])
def test_curves_of_a_race_without_an_error_are_plotted_without_a_warning(n_crashed, tmp_path, monkeypatch):
    """The error is undefined while all drones crash, perhaps to the end, and zero once all have finished."""
    point = {"env_steps": 1.0, "seconds": 1.0, "success": 0.0, "reward": 1.0, "error": np.nan}
    finished = point | {"env_steps": 2.0, "seconds": 2.0, "success": 1.0, "error": 0.0}
    curve = [point] * n_crashed + [finished] * (2 - n_crashed)
    labels = []
    monkeypatch.setattr("matplotlib.axes.Axes.set_ylabel", lambda _, text: labels.append(text))
    plot_curve({"race": curve}, tmp_path / "curve.png", "m")
    plot_spread({"race": [curve, curve]}, tmp_path / "spread.png", "gates")
    assert {"mean error, m", "mean error, gates"} < set(labels)
    assert (tmp_path / "curve.png").stat().st_size > 1000 < (tmp_path / "spread.png").stat().st_size
