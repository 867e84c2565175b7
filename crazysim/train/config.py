"""Configurations of training runs, and recipes that are known to solve the tasks."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from crazysim.core.settings import find_device, positive_integer
from crazysim.drones.loading import is_airframe_file
from crazysim.envs.env import Env
from crazysim.envs.references import absolute_reference, is_reference, reference_of, split_reference
from crazysim.envs.registry import TASKS, entry_of, make
from crazysim.envs.task import Task
from crazysim.errors import ConfigError, UnknownNameError, expect, require, short_repr
from crazysim.train import apg, dagger, ppo
from crazysim.train.devices import Devices, device_options, evaluation_device
from crazysim.train.hyperparameters import SWEEPABLE, check_seed
from crazysim.train.networks import Network, choose_network

ALGORITHMS: dict[str, Any] = {"ppo": ppo, "apg": apg, "dagger": dagger}
"""Algorithms by name: modules with ``Config``, ``init`` and ``iterate``."""


WORLDS = {"cpu": 2048, "gpu": 4096}
"""Default number of parallel worlds, by platform."""
FIRST_ITERATIONS = 80
"""Default of PPO's ``value_iterations`` with ``start``, or else of its ``demonstrations`` if the task has
``demonstrate``; at most half of the iterations."""


@dataclass(frozen=True)
class Recipe:
    """Algorithm and hyperparameters that are known to solve a task."""

    algorithm: str = "ppo"
    """Name of the algorithm, a key of ``ALGORITHMS``."""
    n_worlds: int | None = None
    """Number of parallel worlds; None for ``WORLDS`` of the device."""
    config: dict[str, Any] = field(default_factory=dict)
    """Hyperparameters that differ from the defaults of the algorithm."""
    practice: dict[str, Any] = field(default_factory=dict)
    """Options of the training environment that the evaluation environment does not have."""
    evaluate_every: int = 20
    """Iterations between evaluations; a checkpoint is written at each evaluation."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of ``crazysim.envs.make`` for a teacher, in addition to the options of its student."""
    teacher: Recipe | None = None
    """Recipe of the teacher that ``run`` trains first; None if the recipe needs none."""


_SHORT_ROLLOUTS = {"n_steps": 32, "minibatches": 8, "discount": 0.98, "gae_lambda": 0.95, "entropy": 0.0}
"""Hyperparameters of tasks in which rewards follow their actions at once."""
_LONG_ROLLOUTS = {"hidden": (128, 128), "gae_lambda": 0.95, "entropy": 0.0}
"""Hyperparameters of tasks in which rewards follow seconds after the actions, found before the present defaults."""
_CAMERA_POLICY = {**_LONG_ROLLOUTS, "entropy": 0.003, "convolution": (8, 16), "critic": "privileged"}
"""Hyperparameters with which PPO learns to fly from camera images."""

RECIPES: dict[str, Recipe] = {
    "hover": Recipe(
        n_worlds=1024, config={**_SHORT_ROLLOUTS, "iterations": 80, "minibatches": 16, "learning_rate": 2e-3}
    ),
    "reach_vel": Recipe(n_worlds=1024, config={**_SHORT_ROLLOUTS, "iterations": 100}),
    "recover": Recipe(n_worlds=1024, config={**_SHORT_ROLLOUTS, "iterations": 150, "minibatches": 16}),
    "race": Recipe(
        n_worlds=2048,
        config={
            "iterations": 150,
            "minibatches": 16,
            "discount": 0.98,
            "gae_lambda": 0.95,
            "init_std": 0.7,
        },
        practice={"practice": True},
    ),
    "multi_race": Recipe(
        n_worlds=2048,
        config={
            "iterations": 250,
            "gae_lambda": 0.95,
            "entropy": 0.003,
            "init_std": 0.7,
        },
        practice={"practice": True},
    ),
    "race_by_camera": Recipe(
        "dagger",
        n_worlds=256,
        config={
            "iterations": 600,
            "minibatches": 8,
            "learning_rate": 1.5e-3,
            "hidden": (128, 128),
            "convolution": (8, 16, 16),
        },
        practice={"practice": True},
        evaluate_every=100,
        teacher=Recipe(
            n_worlds=2048,
            config={
                "iterations": 300,
                "minibatches": 16,
                "discount": 0.95,
                "gae_lambda": 0.95,
                "init_std": 0.7,
            },
            options={"gates_observed": True, "camera": ()},
        ),
    ),
    "avoid": Recipe(n_worlds=4096, config={**_LONG_ROLLOUTS, "iterations": 400, "minibatches": 64, "entropy": 0.003}),
    "forest": Recipe(
        n_worlds=512,
        config={**_CAMERA_POLICY, "iterations": 160, "minibatches": 8},
        practice={"difficulty": (0.0, 1.0)},
    ),
    "transport": Recipe(n_worlds=4096, config={**_LONG_ROLLOUTS, "iterations": 400}),
    "deliver": Recipe(n_worlds=4096, config={**_LONG_ROLLOUTS, "iterations": 800}),
    "swarm": Recipe(
        n_worlds=2048,
        config={
            **_LONG_ROLLOUTS,
            "iterations": 200,
            "minibatches": 64,
            "discount": 0.98,
            "entropy": 0.003,
            "critic": "all_drones",
        },
    ),
    "chase": Recipe(n_worlds=2048, config={"minibatches": 16, "gae_lambda": 0.95, "entropy": 0.0}),
    "land": Recipe(
        n_worlds=2048,
        config={"iterations": 200, "gae_lambda": 0.95, "entropy": 0.003},
    ),
    "land_on_marker": Recipe(n_worlds=4096, config={**_CAMERA_POLICY, "iterations": 150}),
    "follow_car": Recipe(n_worlds=2048, config={**_CAMERA_POLICY, "iterations": 100}),
    "track": Recipe("apg", n_worlds=64, config={"iterations": 150}),
}
"""Recipes by task."""

DEFAULT_RECIPES: dict[str, Recipe] = {
    "ppo": Recipe(),
    "apg": Recipe("apg", n_worlds=64, config={"iterations": 200}, evaluate_every=40),
    "dagger": Recipe("dagger", n_worlds=256, evaluate_every=50),
}
"""Recipes by algorithm, for tasks that have no recipe for this algorithm."""


def find_recipe(task: str, algorithm: str | None = None) -> Recipe:
    """Return the recipe of a task for an algorithm.

    It is that of the built-in task, or of the one that the class of the task extends, with the changes of
    ``Task.recipe``: hyperparameters, and fields of ``Recipe``.

    Args:
        task: Name of the task, or reference of its class.
        algorithm: Name of the algorithm, a key of ``ALGORITHMS``; None for the algorithm of the task's recipe.
    """
    recipe = RECIPES.get(task) or _own_recipe(task)
    return recipe if algorithm in (None, recipe.algorithm) else DEFAULT_RECIPES.get(str(algorithm), Recipe(algorithm))


def _own_recipe(task: str) -> Recipe:
    cls = entry_of(task, is_named=False).task
    expect(isinstance(cls.recipe, Mapping), f"recipe of task {task!r} as a dict of values by name", cls.recipe)
    names = {entry.source: name for name, entry in reversed(TASKS.items()) if name in RECIPES}
    bases = (names.get(f"{base.__module__}:{base.__name__}") for base in cls.__mro__)
    recipe = next((RECIPES[name] for name in bases if name is not None), DEFAULT_RECIPES["ppo"])
    if (algorithm := cls.recipe.get("algorithm", recipe.algorithm)) != recipe.algorithm:
        recipe = DEFAULT_RECIPES.get(algorithm, Recipe(algorithm))
    fields = {f.name for f in dataclasses.fields(Recipe)} - {"config"}
    config = recipe.config | {name: value for name, value in cls.recipe.items() if name not in fields}
    given = {name: value for name, value in cls.recipe.items() if name in fields}
    return dataclasses.replace(recipe, **given, config=config)


ALTERABLE_HYPERPARAMETERS = ("iterations", *SWEEPABLE)
"""Hyperparameters that may change when a run is resumed."""


@dataclass(frozen=True)
class TrainConfig:
    """Complete configuration of a run. A resumed run may only change ``ALTERABLE_HYPERPARAMETERS`` and devices."""

    task: str
    """Name of a registered task, or the absolute reference of its class, ``FILE.py:NAME`` or ``MODULE:NAME``."""
    algorithm: str
    """Name of the algorithm, a key of ``ALGORITHMS``."""
    seed: int
    """Random seed."""
    n_worlds: int
    """Number of parallel worlds."""
    options: dict[str, Any]
    """Options of ``crazysim.envs.make``."""
    config: dict[str, Any]
    """Hyperparameters of the algorithm; omitted ones have their defaults."""
    own_network: bool = False
    """Whether the policy has a custom network instead of the built-in one."""
    network: Network | None = field(default=None, compare=False)
    """Custom network; None for the built-in one. The files of a run hold its weights, but not its functions."""
    devices: Devices | None = field(default=None, compare=False)
    """Devices over which the worlds of the training are distributed; None for the single device in ``options``. The
    files of a run do not hold them: a resumed run may use other devices."""

    def __post_init__(self) -> None:
        require(
            isinstance(self.algorithm, str) and self.algorithm in ALGORITHMS,
            f"expected an algorithm of {', '.join(ALGORITHMS)}, got {self.algorithm!r}",
            UnknownNameError,
        )
        check_seed(self.seed)
        names = [f.name for f in dataclasses.fields(ALGORITHMS[self.algorithm].Config)]
        if unknown := [name for name in self.config if name not in names]:
            raise ConfigError(
                f"expected hyperparameters of {self.algorithm}, got {', '.join(unknown)}; use {', '.join(names)}"
            )
        require(
            "mesh" not in self.options,
            f"expected no option 'mesh' of a training, got {short_repr(self.options.get('mesh'))}. Use --devices all, "
            f"or devices='all' in Python: the worlds are then distributed over a mesh of these devices.",
        )
        if self.network is not None:
            require(
                self.algorithm == "ppo",
                f"expected no custom network for {self.algorithm}, got one. Use algorithm='ppo'.",
            )
            choose_network(
                self.config.get("memory", 0),
                self.network,
                self.config.get("convolution", ()),
                shape=self.config.get("shape", "default"),
            )
            object.__setattr__(self, "own_network", True)
        config = dataclasses.asdict(self.algorithm_config())
        values = {
            "seed": int(self.seed),
            "n_worlds": positive_integer("n_worlds", self.n_worlds),
            "config": {name: list(x) if isinstance(x, tuple) else x for name, x in config.items()},
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @staticmethod
    def create(
        task: str | Task,
        algorithm: str | None = None,
        seed: int | None = None,
        n_worlds: int | None = None,
        options: dict[str, Any] | None = None,
        config: dict[str, Any] | None = None,
        resumed: TrainConfig | None = None,
        network: Network | None = None,
        devices: Devices | None = None,
    ) -> TrainConfig:
        """Complete the configuration of a run: omitted values come from the recipe of the task.

        Args:
            task: Name of a task, reference of your class (``FILE.py:NAME`` or ``MODULE:NAME``), or a ``Task``.
            algorithm: Name of the algorithm, a key of ``ALGORITHMS``.
            seed: Random seed; None for 0.
            options: Options of ``crazysim.envs.make``.
            config: Hyperparameters of the algorithm.
            resumed: Configuration of the run to continue, from which omitted values are taken; None for a new run.
            network: Custom network; None for the built-in one.
            devices: Devices over which the worlds are distributed: ``"all"``, their number, or their indices. Their
                platform is the platform of ``options["device"]``, or JAX's default platform. None for one device.
        """
        entry = entry_of(task)
        stored_options = {} if resumed is None else resumed.options
        if isinstance(task, Task):
            fields = [f for f in dataclasses.fields(task) if f.init]
            values = {f.name: getattr(task, f.name) for f in fields}
            defaults = {f.name: stored_options.get(f.name, f.default) for f in fields}
            options = {k: x for k, x in values.items() if not _is_same_setting(x, defaults[k])} | dict(options or {})
            task = next((name for name, candidate in TASKS.items() if candidate is entry), None) or reference_of(
                entry.task
            )
        elif is_reference(task):
            task = absolute_reference(task) if split_reference(task)[1] else reference_of(entry.task)
        expect(isinstance(algorithm, (str, type(None))), f"an algorithm of {', '.join(ALGORITHMS)}", algorithm)
        recipe = find_recipe(task, algorithm)
        if resumed is not None:
            seed = resumed.seed if seed is None else seed
            if algorithm in (None, resumed.algorithm):
                recipe = Recipe(resumed.algorithm, resumed.n_worlds, resumed.config)
        for name, value in (("options", options), ("config", config)):
            expect(isinstance(value, (Mapping, type(None))), f"{name} as a dict of values by name", value)
        given = config or {}
        options, config = stored_options | dict(options or {}), recipe.config | dict(given)
        if recipe.algorithm == "ppo" and (config.get("start") or hasattr(entry.task, "demonstrate")):
            n = min(FIRST_ITERATIONS, int(config.get("iterations", ppo.Config.iterations)) // 2)
            config.setdefault("value_iterations" if config.get("start") else "demonstrations", n)
            if config.get("start") and resumed is None:  # not by the task's recipe, which is for a new policy
                config["demonstrations"] = given.get("demonstrations", 0)
        if is_airframe_file(options.get("drone")):  # the run can then be flown from any folder
            options["drone"] = str(Path(options["drone"]).resolve())
        if devices is not None:
            options["device"] = evaluation_device(options.get("device"), devices)
        seed = 0 if seed is None else seed
        n_worlds = recipe.n_worlds if n_worlds is None else n_worlds
        if n_worlds is None:
            n_worlds = WORLDS["cpu" if find_device(options.get("device", "cpu")).platform == "cpu" else "gpu"]
        return TrainConfig(task, recipe.algorithm, seed, n_worlds, options, config, network=network, devices=devices)

    @property
    def title(self) -> str:
        """Name of the task in messages and in the default folder: lower case, without file or module."""
        name = split_reference(self.task)[1] if is_reference(self.task) else self.task
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.rpartition(".")[2]).lower()

    def make_training_env(self, n_seeds: int = 1) -> Env:
        """Make the training environment of some seeds, with its worlds on the devices of the training.

        Args:
            n_seeds: Number of seeds; each has ``n_worlds`` worlds.
        """
        entry_of(self.task, is_named=False)
        n_worlds = n_seeds * self.n_worlds
        devices = {} if self.devices is None else device_options(self.options["device"], self.devices, n_worlds)
        return make(self.task, n_worlds, **self.practice_options() | self.options | devices)

    def make_env(self, n_worlds: int | None = None, **defaults: Any) -> Env:
        """Make an environment of the run, on one device.

        Args:
            n_worlds: Number of worlds; None for the number of the run.
            **defaults: Options of ``crazysim.envs.make``; options of the run take precedence.

        Raises:
            ConfigError: If the task is in a file that this user has not named before; see ``load_policy``.
        """
        entry_of(self.task, is_named=False)
        return make(self.task, self.n_worlds if n_worlds is None else n_worlds, **defaults | self.options)

    def with_device(self, device: str | None) -> TrainConfig:
        """Return the same configuration on another device, such as ``"cpu"``; None keeps the device."""
        return self if device is None else self.with_options(device=device)

    def with_options(self, **options: Any) -> TrainConfig:
        """Return the same configuration with other options of ``crazysim.envs.make``."""
        return dataclasses.replace(self, options=self.options | options)

    def practice_options(self) -> dict[str, Any]:
        """Return the options of the training environment that the recipe of the task adds."""
        return dict(find_recipe(self.task).practice)

    def teacher_config(self) -> TrainConfig | None:
        """Return the configuration of the recipe's teacher; None if it has none, or if the run names a teacher."""
        recipe = find_recipe(self.task, self.algorithm).teacher
        if recipe is None or self.config["teacher"]:
            return None
        options = self.options | recipe.options
        return TrainConfig.create(self.task, recipe.algorithm, self.seed, recipe.n_worlds, options, recipe.config)

    def algorithm_config(self) -> Any:
        """Return the ``Config`` of the algorithm."""
        return ALGORITHMS[self.algorithm].Config(**self.config)


def _is_same_setting(x: Any, y: Any) -> bool:
    try:
        return json.dumps(x) == json.dumps(y)
    except (TypeError, ValueError):
        return x is y
