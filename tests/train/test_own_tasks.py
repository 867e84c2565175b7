"""Tasks of users: from a file to a trained policy, by their file, by name and as objects."""

import importlib.metadata
import os
import subprocess
import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, envs, train
from crazysim.__main__ import main
from crazysim.envs import TASKS, references, registry
from crazysim.envs.tasks.hover import Hover
from crazysim.errors import UnknownNameError
from crazysim.train.config import RECIPES, TrainConfig
from crazysim.train.show import film
from crazysim.train.training import load_policy

SOURCE = """
from __future__ import annotations

from dataclasses import dataclass
from helpers import HEIGHT
import crazysim.envs as envs
from crazysim.envs.tasks.hover import Hover


class High(Hover):
    'Hover high.'

    name = "high"
    extra: float = HEIGHT
    sides: tuple[float, ...] = (1.0, 2.0)
"""
SMALL = {"iterations": 2, "n_steps": 8, "minibatches": 2, "epochs": 1, "hidden": (8,)}
QUIET = {"evaluation_worlds": 8, "progress": False, "film": False, "n_worlds": 4, "config": SMALL}


@pytest.fixture(autouse=True)
def own_list(tmp_path_factory, monkeypatch):
    """Give each test its own list of named tasks, and remove the tasks that it registers."""
    path = tmp_path_factory.mktemp("user") / "crazysim" / "tasks"
    monkeypatch.setattr(references, "_list_path", lambda: path)
    monkeypatch.setattr(references, "_CLASSES_BY_REFERENCE", {})
    monkeypatch.setattr(references, "_NAMED_REFERENCES", set())
    tasks, ids = dict(TASKS), dict(gymnasium.registry)
    yield path
    TASKS.clear()
    TASKS.update(tasks)
    gymnasium.registry.clear()
    gymnasium.registry.update(ids)


@pytest.fixture
def file(tmp_path):
    (tmp_path / "helpers.py").write_text("HEIGHT = 0.5")
    (tmp_path / "my_tasks.py").write_text(SOURCE)
    return tmp_path / "my_tasks.py"


def forget_tasks(monkeypatch):
    """Forget the tasks that this process has named, as in another process."""
    monkeypatch.setattr(references, "_CLASSES_BY_REFERENCE", {})
    monkeypatch.setattr(references, "_NAMED_REFERENCES", set())


def test_a_file_is_trained_evaluated_resumed_and_exported(file, tmp_path, monkeypatch, capsys):
    """By commands only, from the folder of the run."""
    monkeypatch.chdir(tmp_path)
    small_options = " ".join(f"{k}={[*v] if isinstance(v, tuple) else v}" for k, v in SMALL.items())
    options = f"--worlds 4 --set seconds=0.4 --no-film --config {small_options}"
    assert main(["train", "my_tasks.py:High", *options.split()]) == 0
    assert "high by ppo, seed 0: 2 iterations" in capsys.readouterr().out
    forget_tasks(monkeypatch)
    folder = str(tmp_path / "out" / "high")
    assert main(["evaluate", folder, "--worlds", "4"]) == 0
    assert "high, 4 starts (error below" in capsys.readouterr().out
    assert main(["export", folder, "--c", "policy.h"]) == 0
    file.write_text(SOURCE + "\n# a comment\n")
    assert main(["train", "my_tasks.py", "--resume", "--iterations", "3", "--no-film"]) == 0
    out = capsys.readouterr().out
    assert "3 iterations of 32 steps in 4 worlds" in out
    assert "the file of the task has changed" in out
    assert main(["train", "my_tasks.py:High", "--resume", "--set", "extra=0.7"]) == 2
    assert "expected extra = 'its default' as in" in capsys.readouterr().err


def test_code_that_only_a_run_names_is_not_executed(file, tmp_path, monkeypatch, own_list):
    """A run of somebody else may name any file, which is executed only if the user names it."""
    train.run(f"{file}:High", tmp_path / "run", log=list, options={"seconds": 0.4}, **QUIET)
    own_list.unlink()
    forget_tasks(monkeypatch)
    (tmp_path / "my_tasks.py").write_text("raise SystemExit('executed')")
    policy, config, _ = load_policy(tmp_path / "run")
    assert policy({name: np.zeros(n) for name, n in policy.interface.sizes.items()}).shape == (4,)
    for _ in range(2):
        with pytest.raises(ConfigError, match=r"task that you have named .*my_tasks\.py:High.*--task FILE\.py:High"):
            config.make_env(1)
    (tmp_path / "moved.py").write_text(SOURCE)
    moved = load_policy(tmp_path / "run", task=f"{tmp_path / 'moved.py'}:High")[1]
    assert moved.make_env(1).task.extra == 0.5
    assert f"{tmp_path / 'moved.py'}:High" in own_list.read_text()
    forget_tasks(monkeypatch)
    assert moved.make_env(1).task.extra == 0.5  # named before
    (tmp_path / "moved.py").chmod(0o666)
    forget_tasks(monkeypatch)
    with pytest.raises(ConfigError, match=r"only you can write.*other users can write to it"):
        moved.make_env(1)


def test_a_list_that_others_can_write_is_not_used(file, own_list, monkeypatch):
    envs.make(f"{file}:High")
    assert own_list.stat().st_mode & 0o077 == 0
    forget_tasks(monkeypatch)
    own_list.chmod(0o666)
    with pytest.raises(ConfigError, match="task that you have named"):
        TrainConfig(f"{file}:High", "ppo", 0, 4, {}, {}).make_env(1)


class Low(Hover):
    """Hover low."""

    name = "low"
    depth: float = 0.1


def test_an_object_is_trained_with_its_settings(tmp_path, monkeypatch):
    """What differs from the defaults is in the checkpoint; resuming with another value is refused."""
    result = train.run(Low(depth=0.3, seconds=0.4), tmp_path / "run", log=list, **QUIET)
    assert result.env.task == Low(depth=0.3, seconds=0.4)
    config = load_policy(tmp_path / "run")[1]
    assert config.options == {"depth": 0.3, "seconds": 0.4}
    assert config.title == "low"
    forget_tasks(monkeypatch)
    assert config.make_env(2).task.depth == 0.3  # from this file, which another process finds by its path
    with pytest.raises(ConfigError, match=r"depth = 0\.3 as in .*, got 0\.1"):
        train.run(Low(seconds=0.4), tmp_path / "run", resume=True)
    state = result.env.reset(jax.random.key(0))
    drone_obs = {name: np.asarray(x)[0, 0] for name, x in state.obs.items()}
    np.testing.assert_allclose(result.policy(drone_obs), result.policy(state.obs)[0, 0], rtol=1e-5, atol=1e-6)

    class Local(Low):
        """Low, in a function."""

    local_config = TrainConfig.create(Local(seconds=0.4))
    forget_tasks(monkeypatch)
    with pytest.raises(ConfigError, match="task that you have named"):
        local_config.make_env(1)


def test_a_registered_task_is_made_trained_and_vectorised_by_name():
    assert envs.register("low_hover", Low, control="body_rate") == "crazysim/LowHover-v0"
    assert envs.make("low_hover", depth=0.2).task.depth == 0.2
    assert envs.make("low_hover").sim.control.value == "body_rate"
    assert envs.make(Low(depth=0.5)).sim.control.value == "body_rate"
    vector = gymnasium.make_vec("crazysim/LowHover-v0", num_envs=3, depth=0.4)
    assert vector.unwrapped.env.task.depth == 0.4
    config = TrainConfig.create("low_hover", options={"seconds": 0.4})
    assert config.task == "low_hover"
    assert type(config.make_training_env().task) is Low

    class Lower(Low):
        """Low again, as from a cell that is executed again."""

    envs.register("low_hover", Lower)
    assert type(envs.make("low_hover").task) is Lower


def test_a_file_that_registers_is_named_by_that_name(file):
    file.write_text(SOURCE + "\nenvs.register('higher', High, n_drones=2)")
    assert envs.make(f"{file}:higher").sim.n_drones == 2
    assert envs.make("higher", n_drones=1).sim.n_drones == 1


def test_a_class_is_found_by_its_own_name(file):
    assert type(envs.make(f"{file}:high").task) is type(envs.make(f"{file}:High").task)


def test_a_file_that_was_edited_is_loaded_again(file):
    assert envs.make(f"{file}:High").task.extra == 0.5
    assert type(envs.make(f"{file}:High").task) is type(envs.make(f"{file}:High").task)
    file.write_text(SOURCE.replace("= HEIGHT", "= 0.75"))
    assert envs.make(str(file)).task.extra == 0.75


@pytest.mark.long("trains in a process of its own")
def test_a_script_trains_its_own_class(file, tmp_path, own_list, capsys):
    """A class of the module that runs is found by its file; the command evaluates it in another process."""
    run = f"train(TrainConfig.create(High(seconds=0.4), n_worlds=4, config={SMALL!r}), 'run')"
    imports = "from crazysim.train import TrainConfig\nfrom crazysim.train.training import train\n"
    file.write_text(SOURCE + f"\n{imports}\nif __name__ == '__main__':\n    {run}\n")
    environment = os.environ | {"XDG_CACHE_HOME": str(own_list.parents[1])}
    subprocess.run([sys.executable, "my_tasks.py"], cwd=tmp_path, check=True, env=environment)
    assert main(["evaluate", str(tmp_path / "run"), "--worlds", "4"]) == 0
    assert "high, 4 starts (error below" in capsys.readouterr().out


def test_a_film_shows_several_marks_of_a_drone(view_of_film):

    class Ringed(Low):
        """Low, in a ring."""

        def target(self, data):
            angle = jnp.linspace(0, 2 * jnp.pi, 24)
            ring = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.full(24, 1.2)], axis=-1)
            return jnp.broadcast_to(ring, (data.core.n_drones, 24, 3))

    env = envs.make(Ringed(seconds=0.04))
    assert view_of_film(env, 1).marks(env.sim, 0).shape == (24, 3)


def test_a_film_stands_still_where_an_episode_has_ended_and_says_so(monkeypatch):
    heights, texts = [], []

    class Frames:
        """Film that stores the height of the first drone and the text of each frame."""

        n_frames = 0

        def __init__(self, path, view, **_):
            self.view = view

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def add(self, sim):
            heights.append(float(sim.data.states.pos[0, 0, 2]))
            self.view.draw(sim, 0)

    monkeypatch.setattr("crazysim.train.show.Film", Frames)
    monkeypatch.setattr("crazysim.train.show.draw_text", lambda sim, text: texts.append(text))
    env = envs.make("hover")
    film(env, lambda obs: jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, -1.0]), (1, 1, 4)), "fall.mp4", worlds=1)
    n_crashed = sum(text.endswith("crashed") for text in texts)
    assert texts[0] == "0.0 s"
    assert n_crashed == 26, "the frame of the crash and a second of 25 frames"
    assert len(set(texts[-n_crashed:])) == 1
    assert len(set(heights[-n_crashed:])) == 1
    assert len(set(heights[:-n_crashed])) == len(heights) - n_crashed > 5

    def to_goal(obs):
        ax, ay, az = jnp.moveaxis(4 * obs["difference_to_goal"] - 3 * obs["vel"], -1, 0)
        return jnp.stack([-0.13 * ay, 0.13 * ax, 0 * ax, 0.15 * az], axis=-1)

    for policy, outcome in ((to_goal, "success"), (lambda obs: jnp.zeros((1, 1, 4)), "late")):
        texts.clear()
        film(env, policy, "hover.mp4", worlds=1)
        assert texts[-1] == f"5.0 s: {outcome}"
        assert sum(text.endswith(outcome) for text in texts) == 26

    class OneOfTwo(envs.TASKS["hover"].task):
        """Hover of two drones, the first of which succeeds."""

        n_drones = 2

        def succeeded(self, data):
            return jnp.array([True, False])

    film(envs.make(OneOfTwo(seconds=0.2)), lambda obs: jnp.zeros((1, 2, 4)), "two.mp4", worlds=1)
    assert texts[-1] == "0.2 s: 1 of 2 succeeded"


class StoppedError(Exception):
    """Raised instead of filming."""


@pytest.fixture
def view_of_film(monkeypatch, opengl):
    """Return a function that returns the view with which a film of an environment begins."""
    views = []

    def open_film(path, view, **_):
        views.append(view)
        raise StoppedError

    monkeypatch.setattr("crazysim.train.show.Film", open_film)

    def begin_film(env, worlds):
        with pytest.raises(StoppedError):
            film(env, lambda obs: jnp.zeros((env.sim.n_worlds, 1, 4)), "film.gif", worlds=worlds)
        return views[-1]

    return begin_film


@pytest.mark.parametrize("camera", [None, {"elevation": -30}, {"lookat": (0, 0, 1), "distance": 2.0}])
def test_a_film_holds_targets_and_subjects_in_view_unless_the_task_has_a_distance(view_of_film, camera):
    class Wide(Low):
        """Low, with a target far away."""

        def target(self, data):
            return jnp.array([[-3.0, -3.0, 1.0]])

        def subjects(self, data):
            return jnp.array([[0.0, 4.0, 0.0], [0.0, 5.0, 0.0]])

        def camera(self, n_drones):
            return camera

    env = envs.make(Wide(seconds=0.04))
    view = view_of_film(env, 1)
    assert view.cam_config == (camera or {"elevation": -20})
    if camera and "distance" in camera:
        assert view.hold is None
    else:
        np.testing.assert_array_equal(view.hold(env.sim, 0), [[-3.0, -3.0, 1.0], [0.0, 4.0, 0.0], [0.0, 5.0, 0.0]])


def test_the_worlds_of_a_film_are_wider_than_high(view_of_film):
    env = envs.make(Low(seconds=0.04), n_worlds=6)
    for worlds in range(1, 7):
        width, height = view_of_film(env, worlds).tile_size
        assert 1.3 < width / height < 1.4


@pytest.mark.parametrize("options", [{}, {"depth_image": (5, 4)}])
def test_a_film_has_maps_from_above_if_policies_observe_images(view_of_film, options):
    assert view_of_film(envs.make("hover", engine="interpret", **options), 1).top_view == bool(options)


def test_an_installed_package_lists_its_tasks(monkeypatch):
    class Point(importlib.metadata.EntryPoint):
        def load(self):
            return Low

    points = importlib.metadata.EntryPoints([Point("of_a_package", "package.tasks:Low", registry.ENTRY_POINTS)])
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points.select(group=group))
    with pytest.raises(
        UnknownNameError, match=r"task 'of' does not exist; there are hover.*of_a_package.*FILE\.py:CLASS"
    ):
        envs.make("of")
    assert type(envs.make("of_a_package").task) is Low
    assert TASKS["of_a_package"].id in gymnasium.registry


def test_law_09_wrong_places_names_and_settings_are_errors(file, tmp_path):
    text_file = tmp_path / "task.txt"
    text_file.touch()
    (tmp_path / "broken.py").write_text("import nothing_of_this_name")
    for call, message in (
        (lambda: envs.make(f"{tmp_path / 'no.py'}:High"), "a file with a task, got .*no.py': No such file"),
        (lambda: envs.make(f"{file}:Hihg"), "got 'Hihg'; it defines High"),
        (lambda: envs.make(f"{text_file}:High"), "end with .py, got .*task.txt'. Rename it"),
        (lambda: envs.make("no_such_module:High"), "a module with a task, got 'no_such_module'"),
        (lambda: envs.make(Hover), r"a task, got <class.*Task\(\)"),
        *((lambda n=n: envs.register(n, Low), "lower case letters") for n in ("hover", "Two Hoops", "a:b", 3)),
        (lambda: envs.register("low", int), "a subclass of Task, got <class 'int'>"),
        (lambda: train.run("hover", tmp_path / "x", options={"pos": jnp.zeros(3)}), "options that a checkpoint can"),
        (lambda: train.run("hover", tmp_path / "x", iterations=1), r"got iterations\. .* belong in config="),
    ):
        with pytest.raises(ConfigError, match=message):
            call()
    with pytest.raises(ModuleNotFoundError, match="nothing_of_this_name"):
        envs.make(f"{tmp_path / 'broken.py'}:Any")
    assert not (tmp_path / "x").exists()


RECIPE_SOURCE = """
from crazysim.envs.tasks.hover import Hover

class Pair(Hover):
    name, control, n_drones = "pair", "body_rate", 2
    recipe = {"discount": 0.9, "n_worlds": 64, "practice": {"reach": 0.5}}
"""


def test_a_class_says_its_level_its_drones_and_its_recipe(tmp_path):
    (tmp_path / "pair.py").write_text(RECIPE_SOURCE)
    config = TrainConfig.create(f"{tmp_path / 'pair.py'}:Pair", config={"entropy": 0.01})
    assert (config.n_worlds, config.config["discount"], config.config["entropy"]) == (64, 0.9, 0.01)
    assert config.config["learning_rate"] == RECIPES["hover"].config["learning_rate"]  # of the task that it extends
    assert (config.make_training_env().task.reach, config.make_env().task.reach) == (0.5, 1.0)
    assert TrainConfig.create(config.task, config={"discount": 0.8}, n_worlds=8).config["discount"] == 0.8
    sim = envs.make(config.task, 2).sim
    assert (sim.control.value, sim.n_drones) == ("body_rate", 2)
    (tmp_path / "pair.py").write_text(RECIPE_SOURCE.replace('"discount": 0.9', '"discont": 0.9'))
    with pytest.raises(ConfigError, match="discont"):
        TrainConfig.create(f"{tmp_path / 'pair.py'}:Pair")
    (tmp_path / "pair.py").write_text(RECIPE_SOURCE.replace('"discount"', '"algorithm": "pppo", "discount"'))
    with pytest.raises(UnknownNameError, match="an algorithm of ppo, apg, dagger, got 'pppo'"):
        TrainConfig.create(f"{tmp_path / 'pair.py'}:Pair")


def test_a_training_without_terminal_prints_a_line_at_each_evaluation(file, tmp_path):
    lines = []
    train.run(
        f"{file}:High", tmp_path / "run", log=lines.append, options={"seconds": 0.4}, **QUIET | {"progress": True}
    )
    assert any(line.startswith("iteration 2 of 2: ") and "success 0." in line for line in lines)
