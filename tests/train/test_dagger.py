"""A student learns the actions of its teacher from other observations, in Python and by the command."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from policies import save_steering, steer

from crazysim import ConfigError, MotionCapture
from crazysim.__main__ import main
from crazysim.envs import Observe, make
from crazysim.envs.state import flatten
from crazysim.errors import DivergedError
from crazysim.train import config as configs
from crazysim.train import dagger, imitate, run, run_many
from crazysim.train.config import Recipe, TrainConfig
from crazysim.train.runs import _train_teacher
from crazysim.train.training import load_policy, store_configs, stored_configs, train

pytestmark = pytest.mark.usefixtures("shared_environments")
STUDENT_OBSERVATIONS = ("rot", "difference_to_goal", "vel")
SMALL = {"n_steps": 4, "minibatches": 2, "epochs": 1, "hidden": (8,)}


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    return save_steering(tmp_path_factory.mktemp("teacher"))


@pytest.mark.long("trains a student")
def test_a_student_learns_the_actions_from_its_own_observations():
    """The rollouts begin with the teacher's flight, and the student's actions become those of the teacher."""
    env = Observe(make("hover", 64), lambda obs, _: {name: obs[name] for name in STUDENT_OBSERVATIONS})
    rows = []
    config = {"iterations": 60, "hidden": (16,), "n_steps": 8}
    student = imitate(env, steer, config, on_iteration=lambda i, metrics: rows.append((i, metrics)))
    assert [i for i, _ in rows] == list(range(1, 61))
    assert rows[0][1].keys() == {"reward", "crashed", "error", "difference"}
    assert rows[-1][1]["difference"] < 0.05 < 0.2 < rows[0][1]["difference"]
    assert student.stats.mean.shape == (15,)
    obs = jax.jit(env.reset)(jax.random.key(7)).obs
    assert student(obs).shape == (64, 1, 4)


def test_a_teacher_of_nan_is_named():
    """The learning rate is not to blame."""

    def teacher(obs):
        return jnp.where(obs["vel"][..., :1] > -10.0, np.nan, 0.0) * jnp.ones(4)

    with pytest.raises(DivergedError, match="a teacher whose actions are numbers, got NaN"):
        imitate(make("hover", 4, engine="interpret"), teacher, SMALL | {"iterations": 2})


def test_the_fraction_of_the_teachers_actions_decays():
    """The fraction is the decay to the power of the iteration, as a student with zero actions shows."""
    env = dagger.AutoReset(
        dagger.TeacherObservation(make("hover", 64, engine="interpret"), lambda data: {"x": data.states.pos})
    )
    config = dagger.Config(teacher_decay=0.5, n_steps=4)
    init = jax.jit(lambda key: dagger.init(env, (config,), key[None], lambda obs: jnp.ones((64, 1, 4))))
    learner = init(jax.random.key(0))
    for iteration, fraction in ((0, 1.0), (1, 0.5), (30, 0.0)):
        learner = learner.replace(iteration=jnp.int32(iteration))
        after, _ = dagger.iterate(learner, env, (config,))
        result = (np.asarray(after.env.action) == 1.0).mean()
        assert abs(result - fraction) < 0.2


def test_the_teacher_observes_true_states_and_the_student_measurements():
    env = make("hover", 2, sensors=[MotionCapture(noise=0.1)], engine="interpret")
    guided = dagger.TeacherObservation(env, env.task.observe)
    state = jax.jit(guided.step)(jax.jit(guided.reset)(jax.random.key(0)), jnp.zeros((2, 1, 4)))
    student, teacher = dagger.split_obs(state.obs)
    np.testing.assert_array_equal(teacher["pos"], state.data.states.pos)
    assert student.keys() == teacher.keys()
    difference = np.abs(student["pos"] - teacher["pos"]).max(axis=-1)
    assert (difference > 0.001).all()
    assert flatten(teacher).shape == (2, 1, 21)


@pytest.mark.long("trains and resumes by the command")
def test_the_command_trains_a_student_and_resumes(teacher, tmp_path, capsys):
    arguments = [
        "train",
        "hover",
        "--worlds",
        "4",
        "--set",
        "seconds=0.2",
        "engine=interpret",
        "--out",
        str(tmp_path / "run"),
        "--no-film",
    ]
    small_options = ["--config", "n_steps=4", "minibatches=2", "epochs=1", "hidden=[8]"]
    assert main([*arguments, "--teacher", str(teacher), "--iterations", "2", *small_options]) == 0
    assert "hover by dagger, seed 0: 2 iterations" in capsys.readouterr().out
    assert main([*arguments, "--resume", "--iterations", "3"]) == 0
    assert "continues after iteration 2" in capsys.readouterr().out
    moved = teacher.rename(tmp_path / "moved")
    assert main([*arguments, "--resume", "--iterations", "4"]) == 2
    assert f"expected the run of the teacher in '{teacher.resolve()}', got no such folder" in capsys.readouterr().err
    moved.rename(teacher)
    policy, config, meta = load_policy(tmp_path / "run")
    assert config.config["teacher"] == str(teacher.resolve())
    assert sum(meta["observations"].values()) == 21
    assert policy(jax.jit(config.make_env(2).reset)(jax.random.key(0)).obs).shape == (2, 1, 4)


@pytest.fixture
def recipe_with_teacher(monkeypatch):
    """Give hover a recipe whose teacher has shorter episodes; return the logged lines and settings of small runs."""
    teacher = Recipe(
        n_worlds=4, config=SMALL | {"iterations": 2}, options={"seconds": 0.1, "engine": "interpret"}, evaluate_every=1
    )
    recipe = Recipe("dagger", n_worlds=2, config=SMALL | {"iterations": 1}, teacher=teacher)
    monkeypatch.setitem(configs.RECIPES, "hover", recipe)
    lines = []
    return lines, {
        "evaluation_worlds": 4,
        "options": {"seconds": 0.2, "engine": "interpret"},
        "log": lines.append,
        "progress": False,
    }


@pytest.mark.long("trains a teacher and its students")
def test_a_recipe_trains_its_teacher_first(recipe_with_teacher, tmp_path):
    lines, settings = recipe_with_teacher
    iterations = []
    folder = tmp_path / "run"
    run("hover", folder, film=False, seed=3, on_iteration=lambda i, _: iterations.append(i), **settings)
    headers = [line.partition(":")[0] for line in lines if " by " in line and "engine: " in line]
    assert headers == ["hover by ppo, seed 3", "hover by dagger, seed 3"]
    assert iterations == [1]
    _, student, _ = load_policy(folder)
    _, teacher, _ = load_policy(folder / "teacher")
    assert student.config["teacher"] == str((folder / "teacher").resolve())
    assert (student.n_worlds, student.options["seconds"]) == (2, 0.2)
    assert (teacher.n_worlds, teacher.options["seconds"]) == (4, 0.1)
    run("hover", folder, film=False, resume=True, **settings)
    assert sum("by ppo" in line for line in lines) == 1
    assert any("nothing is left to train" in line for line in lines)

    with pytest.raises(ConfigError, match=r"an existing file with a checkpoint of crazysim, got .*none"):
        run("hover", tmp_path / "none", resume=True, **settings)
    students = run_many("hover", tmp_path / "many", seeds=[5, 6], **settings)
    with pytest.raises(ConfigError, match=r"the folder of one training, .* Use one of its folders: seed-5, seed-6"):
        load_policy(tmp_path / "many")
    assert students.keys() == {"seed-5", "seed-6"}
    assert load_policy(tmp_path / "many" / "teacher")[1].seed == 5
    assert load_policy(tmp_path / "many" / "seed-6")[1].config["teacher"] == str(
        (tmp_path / "many" / "teacher").resolve()
    )


@pytest.mark.long("trains a teacher")
def test_an_interrupted_teacher_continues_and_then_teaches(recipe_with_teacher, tmp_path, monkeypatch):
    lines, settings = recipe_with_teacher
    with monkeypatch.context() as context:
        context.setattr("crazysim.train.training.must_stop", lambda iteration: True)
        with pytest.raises(SystemExit):
            run("hover", tmp_path / "run", film=False, seed=3, n_worlds=6, config={"n_steps": 5}, **settings)
    options = settings["options"]
    with pytest.raises(ConfigError, match=r"a folder without a run, got .*teacher; continue the run with --resume"):
        run("hover", tmp_path / "run", film=False, **settings)
    del settings["options"]
    with pytest.raises(ConfigError, match=r"expected the seeds and the sweep of .*run, none, got seed-0"):
        run_many("hover", tmp_path / "run", resume=True, **settings)
    with pytest.raises(ConfigError, match=r"expected n_worlds = 6 as in .*, got 8; resume with the same value"):
        run("hover", tmp_path / "run", film=False, resume=True, n_worlds=8, **settings)
    run("hover", tmp_path / "run", film=False, resume=True, **settings)
    headers = [line for line in lines if " by " in line and "engine: " in line]
    assert "continues after iteration 1" in headers[1]
    assert "by dagger" in headers[2]
    _, student, _ = load_policy(tmp_path / "run")
    assert student.options == options
    assert (student.seed, student.n_worlds, student.config["n_steps"]) == (3, 6, 5)


def test_settings_of_a_student_are_checked_before_its_teacher_is_trained(recipe_with_teacher, tmp_path):
    _, settings = recipe_with_teacher
    for wrong, message in (
        ({"config": {"entropy": 0.1}}, "hyperparameters of dagger, got entropy"),
        ({"options": {"nothing": 1}}, "no option 'nothing'"),
        ({"config": {"convolution": (2,)}}, "an image among the observations"),
    ):
        with pytest.raises(ConfigError, match=message):
            run("hover", tmp_path / "run", **settings | wrong)
    assert not (tmp_path / "run").exists()


def test_a_new_run_forgets_the_settings_that_waited_for_a_teacher(tmp_path):
    config = TrainConfig.create("hover")
    store_configs({"": config}, tmp_path, resume=False)
    assert stored_configs(tmp_path) == {"": config}
    assert not _train_teacher({"": config}, tmp_path, False, {})
    with pytest.raises(ConfigError, match=r"an existing file with a checkpoint"):
        stored_configs(tmp_path)


def test_teachers_that_do_not_fit_are_errors(teacher, tmp_path):
    env, folder = make("hover", 4, engine="interpret"), str(teacher)

    def run(task, teacher, **options):
        config = SMALL | {"iterations": 2, "teacher": teacher}
        config = TrainConfig.create(task, "dagger", n_worlds=4, options=options, config=config)
        train(config, tmp_path / "run", evaluation_worlds=4, log=lambda _: None, progress=False)

    for call, message in (
        (lambda: run("hover", ""), "the folder of a teacher, got none"),
        (lambda: run("hover", str(tmp_path / "nothing")), "the run of the teacher in"),
        (lambda: run("hover", 3), "teacher as a text, got 3"),
        (lambda: run("track", folder), "a teacher whose task has the same record as 'track'"),
        (lambda: run("hover", folder, control="body_rate"), "body_rate commands in place of attitude commands"),
        (lambda: run("hover", folder, drone="cf2x_L250"), "actions have the meaning of the student's"),
        (lambda: run("hover", folder, freq=100), "100 Hz in place of 50 Hz"),
        (lambda: imitate(env, load_policy(teacher)[0], observe=lambda data: {"pos": data.states.pos}), r"no vel 3"),
        (lambda: imitate(env, lambda obs: obs["pos"]), r"actions of the teacher of shape \(4, 1, 4\)"),
        (lambda: imitate(env, None), "a policy, got None"),
        (lambda: imitate(env, "out/hover"), "a policy, got 'out/hover'"),
        (lambda: imitate(env, steer, {"rate": 1.0}), "hyperparameters of dagger, got rate"),
    ):
        with pytest.raises(ConfigError, match=message):
            call()
    assert not (tmp_path / "run").exists()
