"""Controller files of the drone racing project lsy_drone_racing: load a file unchanged, and fly it in its race."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import importlib.util
import inspect
import os
import random
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.control import Control
from crazysim.envs.env import Env
from crazysim.envs.race_clock import time_flight
from crazysim.envs.registry import make
from crazysim.envs.tasks.race_rules import gates_of, obstacles_of
from crazysim.envs.tracks import Track
from crazysim.errors import expect, require
from crazysim.lab.racing.competition import (
    ACTION_NOISE,
    DRONE_NAME,
    FREQ,
    SIM_FREQ,
    Commands,
    CompetitionRace,
    load_config,
    race_config,
)
from crazysim.lab.racing.flight import RaceFlight

os.environ.setdefault("SCIPY_ARRAY_API", "1")  # drone_models, which controllers import, needs it before SciPy

PACKAGE = "lsy_drone_racing"
"""Package that controller files import."""
OBSERVATIONS = {
    "pos": (3,), "quat": (4,), "vel": (3,), "ang_vel": (3,), "target_gate": (), "gates_pos": (-1, 3),
    "gates_quat": (-1, 4), "gates_visited": (-1,), "obstacles_pos": (-1, 3), "obstacles_visited": (-1,),
}  # fmt: skip
"""Shapes of the observations, by name."""
CRAZYFLOW_MODULES = ("", ".sim", ".sim.data", ".sim.functional", ".sim.visualize", ".control", ".dynamics", ".utils")
"""Modules of Crazyflow that crazysim has under the same path; they serve controllers if Crazyflow is not installed."""


def _do_nothing(*_: Any, **__: Any) -> None:
    pass


class Controller(ABC):
    """Base class of controllers, ``lsy_drone_racing.control.Controller`` in their files.

    A new controller is made for every run. It receives the first observation, information, which is empty, and the
    configuration of the race.
    """

    def __init__(self, obs: dict[str, NDArray], info: dict[str, Any], config: Any):
        del obs, info, config

    @abstractmethod
    def compute_control(self, obs: dict[str, NDArray], info: dict[str, Any] | None = None) -> NDArray:
        """Return the command: 13 numbers of a state, or roll, pitch, yaw, rad, and collective thrust, N."""

    def step_callback(
        self, action: NDArray, obs: dict[str, NDArray], reward: float, terminated: bool, truncated: bool, info: dict
    ) -> bool:
        """Take what a command led to, and return whether the controller wants to end the run."""
        return False

    episode_callback = episode_reset = reset = render_callback = _do_nothing
    """Methods that controllers may define: the first two are called after a run, the others never."""


@dataclass(frozen=True, eq=False)
class Run:
    """A flight of a controller through its gates."""

    time: float
    """Time of the last gate, or of the end of a run that missed one, s."""
    n_passed: int
    """Number of gates passed."""
    finished: bool
    """Whether all gates were passed."""
    pos: NDArray
    """Positions at 50 Hz, m. (n, 3)"""
    quat: NDArray
    """Attitudes, xyzw. (n, 4)"""
    track: Track
    """The track with gates and obstacles where they were."""
    reason: str
    """Why the run ended, if not by the last gate."""

    @property
    def flight(self) -> RaceFlight:
        """The run with its clock, for films and plots."""
        times = np.arange(len(self.pos)) / FREQ
        clock = time_flight(self.track, times, self.pos)
        return RaceFlight(self.track, DRONE_NAME, times, self.pos, self.quat, clock, self.reason)


@functools.cache
def competition_env(level: int, control: str) -> Env:
    """Return the environment of a level for commands of a level, ``state`` or ``attitude``."""
    task = CompetitionRace(level=level)  # type: ignore[call-arg]
    state_freq = FREQ if control == "state" else None
    return make(task, freq=FREQ, sim_freq=SIM_FREQ, state_freq=state_freq, actions=Commands(Control(control)),
                control=control, drone=DRONE_NAME, controller="crazyflow")  # fmt: skip


@contextlib.contextmanager
def loaded(path: str | Path) -> Iterator[type[Controller]]:
    """Execute a controller file and yield its class; the package that it imports exists only within this context.

    The modules beside the file are found as parts of the package, and files of a fork of lsy_drone_racing as in the
    fork. The file is code and may do anything that a program of yours may do.

    Raises:
        ConfigError: If the file has no controller or several.
    """
    path = Path(path).resolve()
    expect(path.suffix == ".py" and path.is_file(), "a controller file, .py", str(path))
    package = next((x for x in path.parents if x.name == PACKAGE and (x / "control").is_dir()), None)
    folder = path.parent if package is None else package.parent
    saved_path, saved_modules = list(sys.path), dict(sys.modules)
    sys.path.append(str(folder))
    sys.modules |= _stand_ins(path, package)
    importlib.invalidate_caches()
    try:
        spec: Any = importlib.util.spec_from_file_location("controller", path)
        module = sys.modules["controller"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        own = [x for _, x in inspect.getmembers(module, inspect.isclass) if x.__module__ == "controller"]
        classes = [x.__name__ for x in own if issubclass(x, Controller)]
        require(
            len(classes) == 1,
            f"expected one subclass of Controller in {path.name}, got {', '.join(classes) or 'none'}. Derive one class "
            f"from {PACKAGE}.control.Controller.",
        )
        yield getattr(module, classes[0])
    finally:
        sys.path[:] = saved_path
        for name, imported in list(sys.modules.items()):
            file = getattr(imported, "__file__", None) or ""
            if name.partition(".")[0] in (PACKAGE, "controller", "crazyflow") or file.startswith(f"{folder}/"):
                del sys.modules[name]
        sys.modules |= {name: x for name, x in saved_modules.items() if name not in sys.modules}


def _stand_ins(path: Path, package: Path | None) -> dict[str, ModuleType]:
    folders = {"": package, ".control": path.parent if package is None else package / "control"}
    folders[".utils"] = None if package is None else package / "utils"
    modules = {name: ModuleType(PACKAGE + name) for name in (*folders, ".control.controller", ".utils.utils")}
    for name, module in modules.items():
        if name in folders:
            module.__path__ = [] if folders[name] is None else [str(folders[name])]
        parent, _, own_name = name.rpartition(".")
        if name:
            setattr(modules[parent], own_name, module)
        if "control" in name:
            vars(module).update(Controller=Controller, BaseController=Controller)
        if "utils" in name:
            vars(module).update(draw_line=_do_nothing, load_config=load_config)
    result = {PACKAGE + name: module for name, module in modules.items()}
    if importlib.util.find_spec("crazyflow") is None:
        for name in CRAZYFLOW_MODULES:
            # A copy without the path of its submodules, which would be executed again under the other name.
            own, module = importlib.import_module(f"crazysim{name}"), ModuleType(f"crazyflow{name}")
            vars(module).update({key: x for key, x in vars(own).items() if key[:2] != "__" or key == "__getattr__"})
            module.__path__, result[module.__name__] = [], module
    return result


def control_of(controller: type[Controller], level: int) -> str:
    """Return the level of the commands of a controller, ``state`` or ``attitude``, by the length of its first one."""
    env = competition_env(level, "attitude")
    obs = _observations(_programs(env)[0](jax.random.key(0)))
    action = np.asarray(controller(obs, {}, race_config(level, "attitude")).compute_control(obs, {}))
    expect(
        action.shape in ((4,), (13,)), "a command of 4 or 13 numbers from compute_control", action.shape,
        "Return roll, pitch, yaw and thrust, or the 13 numbers of a state.",
    )  # fmt: skip
    return "state" if action.shape == (13,) else "attitude"


def fly_controller(controller: type[Controller], control: str, level: int = 2, seed: int = 1) -> Run:
    """Fly one run of a new controller; equal seeds give equal tracks, starts and disturbances.

    Args:
        controller: Class of the controller, from ``loaded``.
        control: Result of ``control_of``.
        level: Level of the race, 0 to 3.
    """
    env = competition_env(level, control)
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002  # controllers may draw from it
    rng = np.random.default_rng(seed)
    reset, step = _programs(env)
    state = reset(jax.random.key(seed))
    obs = _observations(state)
    pilot = controller(obs, {}, race_config(level, control))
    poses, n_passed, time, reason = [(obs["pos"], obs["quat"])], 0, 0.0, "the time was over"
    for k in range(1, env.max_steps + 1):
        action = np.array(pilot.compute_control(obs, {}), np.float32)
        expect(action.shape == (env.actions.size,), f"a command of {env.actions.size} numbers", action.shape)
        had_finished = int(obs["target_gate"]) == -1
        noise = ACTION_NOISE * rng.standard_normal(len(action)).astype(np.float32)
        state = step(state, (action + noise)[None, None])
        obs, info = _observations(state), {name: x.flat[0] for name, x in jax.device_get(state.info).items()}
        poses.append((obs["pos"], obs["quat"]))
        n_passed, finished = int(info["gates_passed"]), bool(info["finished"])
        time = time if had_finished else k / FREQ
        # The race ends one command after the last gate, as in the original.
        ended = had_finished or bool(info["disabled"] or info["nonfinite"])
        if pilot.step_callback(action, obs, -float(finished), ended, k == env.max_steps, {}) or ended:
            reason = "the drone touched something or left the arena" if ended else "the controller ended the run"
            break
    pilot.episode_callback()
    pilot.episode_reset()
    pos, quat = (np.array(x, float) for x in zip(*poses, strict=True))
    return Run(time, n_passed, int(obs["target_gate"]) == -1, pos, quat, _track(env, state), reason)


@functools.cache
def _programs(env: Env) -> tuple[Any, Any]:
    return jax.jit(env.reset), jax.jit(env.step)


def _observations(state: Any) -> dict[str, NDArray]:
    values = jax.device_get(state.obs)
    obs = {name: np.array(values[name][0, 0]).reshape(shape) for name, shape in OBSERVATIONS.items()}
    visited = {name: obs[name] > 0.5 for name in ("gates_visited", "obstacles_visited")}
    return obs | visited | {"target_gate": obs["target_gate"].astype(np.int32)}


def _track(env: Env, state: Any) -> Track:
    task: Any = env.task
    gates_pos, gates_quat = gates_of(state.data)
    gates_pos, gates_rpy = gates_pos.reshape(-1, 3), rotation.to_rpy(gates_quat.reshape(-1, 4))
    poles_pos = obstacles_of(state.data).reshape(-1, 3)
    pos, rpy, poles = (np.array(x, float) for x in (gates_pos, gates_rpy, poles_pos))
    return dataclasses.replace(task.course, gates_pos=pos, gates_rpy=rpy, obstacles_pos=poles)
