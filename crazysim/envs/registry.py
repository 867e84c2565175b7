"""Registry of tasks by name, their registration with Gymnasium, and ``make``, which creates their environments."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import importlib.metadata
import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium

from crazysim.control import Control
from crazysim.core.plugin import Plugin, check_plugin_list
from crazysim.core.settings import enum_member, positive_integer
from crazysim.envs.actions import Actions
from crazysim.envs.env import DroneEnv, Env
from crazysim.envs.references import is_reference, load_listed_task, load_task
from crazysim.envs.task import Task
from crazysim.envs.wrappers.images import CameraImages
from crazysim.errors import ConfigError, UnknownNameError, expect, require
from crazysim.plugins.effects.randomize import Randomize
from crazysim.plugins.sensors.camera import Camera
from crazysim.plugins.sensors.image_sensor import ImageSensor
from crazysim.sim.sim import Sim


@dataclass(frozen=True)
class Entry:
    """A registered task."""

    source: type[Task] | str
    """Class of the task, or ``MODULE:NAME`` of a class that is imported at its first use."""
    id: str
    """Id in Gymnasium's registry; empty if it is not registered there."""
    control: str | None = None
    """Default command level; None for that of the class."""
    n_drones: int | None = None
    """Default number of drones; None for that of the class."""

    @property
    def task(self) -> type[Task]:
        if not isinstance(self.source, str):
            return self.source
        module, _, name = self.source.partition(":")
        return getattr(importlib.import_module(module), name)

    @property
    def defaults(self) -> dict[str, Any]:
        """Options of the simulation, by name, unless others are given."""
        drone = {} if self.task.drone is None else {"drone": self.task.drone}
        return drone | {"control": self.control or self.task.control, "n_drones": self.n_drones or self.task.n_drones}

    @property
    def options(self) -> tuple[str, ...]:
        return tuple(f.name for f in dataclasses.fields(self.task))


TASKS: dict[str, Entry] = {
    "hover": Entry("crazysim.envs.tasks.hover:Hover", "crazysim/Hover-v0"),
    "reach_vel": Entry("crazysim.envs.tasks.reach_vel:ReachVel", "crazysim/ReachVel-v0"),
    "recover": Entry("crazysim.envs.tasks.recover:Recover", "crazysim/Recover-v0"),
    "track": Entry("crazysim.envs.tasks.track:TrackTrajectory", "crazysim/Track-v0"),
    "land": Entry("crazysim.envs.tasks.land:Land", "crazysim/Land-v0"),
    "land_on_marker": Entry("crazysim.lab.tasks.land_on_marker:LandOnMarker", "crazysim/LandOnMarker-v0"),
    "chase": Entry("crazysim.lab.tasks.chase:Chase", "crazysim/Chase-v0"),
    "follow_car": Entry("crazysim.lab.tasks.follow_car:FollowCar", "crazysim/FollowCar-v0"),
    "deliver": Entry("crazysim.lab.tasks.deliver:Deliver", "crazysim/Deliver-v0"),
    "race": Entry("crazysim.envs.tasks.race:Race", "crazysim/Race-v0"),
    "multi_race": Entry("crazysim.envs.tasks.race:Race", "crazysim/MultiRace-v0", n_drones=2),
    "head_to_head": Entry("crazysim.lab.tasks.head_to_head:HeadToHead", "crazysim/HeadToHead-v0"),
    "time_trial": Entry("crazysim.lab.tasks.time_trial:TimeTrial", "crazysim/TimeTrial-v0"),
    "race_by_camera": Entry("crazysim.envs.tasks.race_by_camera:RaceByCamera", "crazysim/RaceByCamera-v0"),
    "avoid": Entry("crazysim.envs.tasks.avoid:Avoid", "crazysim/Avoid-v0"),
    "forest": Entry("crazysim.envs.tasks.forest:Forest", "crazysim/Forest-v0"),
    "transport": Entry("crazysim.lab.tasks.transport:Transport", "crazysim/Transport-v0"),
    "any": Entry("crazysim.lab.tasks.any_airframe:AnyAirframe", "crazysim/Any-v0"),
    "swarm": Entry("crazysim.envs.tasks.swarm:Swarm", "crazysim/Swarm-v0"),
}
"""All registered tasks, by name. Those that show a feature are in the laboratory."""

BUILT_IN_TASKS = frozenset(TASKS)
"""Names of the tasks of this package."""
ENTRY_POINTS = "crazysim.tasks"
"""Group of entry points in which an installed package lists its task classes by name."""

RANDOMIZATIONS = {"crazyflie": Randomize.crazyflie, "generic": Randomize.generic}
"""Ready-made ranges of randomisation, by name."""
SIM_OPTIONS = tuple(name for name in inspect.signature(Sim).parameters if name not in ("n_worlds", "freq"))
"""Options of ``make`` that are passed to ``Sim``."""


def make(
    task: str | Task,
    n_worlds: int = 1,
    freq: int | None = None,
    actions: Actions | None = None,
    sensors: Sequence[Plugin] = (),
    effects: Sequence[Plugin] = (),
    randomize: str | float | None = None,
    camera: ImageSensor | Sequence[ImageSensor] | None = None,
    depth_image: Sequence[int] | None = None,
    sim_freq: int = 500,
    **options: Any,
) -> Env:
    """Make an environment of many worlds of a task, with a new simulation.

    Args:
        task: One of ``TASKS``, the reference of your class, ``FILE.py:NAME`` or ``MODULE:NAME``, or a task.
        freq: Environment steps per second, Hz; None for that of the task's class, 50 unless it has another.
        actions: Meaning of an action; None for the default of the command level, ``actions_of``.
        sensors: Sensors, such as ``MotionCapture``; the task observes the states that they measure. Without sensors,
            it observes the true states, or the estimated states with the setting ``estimator`` of ``Sim``.
        effects: Other plugins of the simulation, such as ``Wind`` and ``Randomize``. If plugins are added later
            by ``env.sim.add``, ``reset`` raises an error.
        randomize: Ranges of ``Randomize`` from which the parameters of the drones are drawn in every episode:
            ``"crazyflie"``, ``"generic"``, or a fraction for ``Randomize.within``. None for the parameters of the
            airframe.
        camera: One or several cameras or lidars; their images are additional observations, see ``CameraImages``. None
            for the camera of the task if it has one, with images named by their output, such as ``"depth"``; ``()`` for
            no images.
        depth_image: Width and height in pixels of depth images, which are an additional observation ``"depth"``. A
            ``Camera`` takes them in every step, instead of the camera of the task. None for no such images.
        sim_freq: Physics steps per second, Hz, the ``freq`` of ``Sim``.
        options: Settings of ``crazysim.Sim``, such as ``n_drones``, ``control``, ``drone``, ``dynamics``, ``device``,
            and settings of the task, such as ``seconds``, which ``help(crazysim.envs.TASKS[name].task)`` lists.
    """
    entry = entry_of(task)
    name = task if isinstance(task, str) else entry.task.name or entry.task.__name__
    # Options of the task or of the simulation.
    for option in options:
        if option not in SIM_OPTIONS + entry.options:
            make_options = [name for name in inspect.signature(make).parameters if name not in ("task", "options")]
            close_names = difflib.get_close_matches(option, [*SIM_OPTIONS, *entry.options, *make_options], 1)
            hint = f"; did you mean {close_names[0]}?" if close_names else "."
            raise ConfigError(
                f"task {name!r} has no option {option!r}{hint} It has {', '.join(entry.options)}; every task has "
                f"{', '.join(make_options)}; the simulation has {', '.join(SIM_OPTIONS)}"
            )
    settings = entry.defaults | {k: v for k, v in options.items() if k in SIM_OPTIONS}
    task_options = {k: v for k, v in options.items() if k in entry.options}
    task = entry.task(**task_options) if isinstance(task, str) else dataclasses.replace(task, **task_options)
    # Plugins, with ready-made ranges if they are requested.
    plugins = [*check_plugin_list("effects", effects), *check_plugin_list("sensors", sensors)]
    if isinstance(randomize, float) and 0 <= randomize < 1:
        plugins.append(Randomize.within(randomize))
    elif randomize is not None:
        expect(
            isinstance(randomize, str) and randomize in RANDOMIZATIONS,
            f"randomize as one of {', '.join(map(repr, RANDOMIZATIONS))}, or a fraction from 0 to 1",
            randomize,
            "Use effects=[Randomize(...)] for other ranges.",
        )
        plugins.append(RANDOMIZATIONS[str(randomize)]())
    # Simulation, task, plugins, in this order.
    sim = Sim(n_worlds=n_worlds, freq=sim_freq, **settings)
    repeated_name = next((plugin.name for plugin in plugins if plugin.name in sim.plugins), None)
    require(
        repeated_name is None,
        f"expected no plugin {repeated_name!r} besides those that the simulation's settings add, got another. "
        f"Leave it out, give it another name=, or use estimator=Kalman([...]) with your own sensors.",
    )
    task.install(sim)
    for plugin in plugins:
        sim.add(plugin)
    # Environment, with images of cameras.
    env = DroneEnv(
        sim, task, task.freq if freq is None else freq, actions, bool(sensors) or settings.get("estimator") is not None
    )
    if camera is not None:
        for image_sensor in [camera] if isinstance(camera, ImageSensor) else check_plugin_list("camera", camera):
            env = CameraImages(env, image_sensor)  # type: ignore[arg-type]  # checked there
    if depth_image is None:
        task_camera = task.policy_camera() if camera is None else None
        return env if task_camera is None else CameraImages(env, task_camera, {x: x for x in task_camera.outputs})
    expect(
        isinstance(depth_image, (tuple, list)) and len(depth_image) == 2,
        "depth_image as width and height in pixels",
        depth_image,
        "Try (16, 12).",
    )
    return CameraImages(env, Camera(*depth_image), {"depth": "depth"})


def register(name: str, task: type[Task], control: str | None = None, n_drones: int | None = None) -> str:
    """Register a custom task by name, for ``make``, training and Gymnasium, and return its Gymnasium id.

    Registering a name again, such as by executing a notebook cell again, replaces the class of the name.

    Args:
        name: Name, such as ``"two_hoops"``: lower case letters, digits and underscores.
        control: Default command level; None for that of the class.
        n_drones: Default number of drones; None for that of the class.

    Returns:
        Id in Gymnasium's registry, such as ``"crazysim/TwoHoops-v0"``, for ``gymnasium.make_vec``.
    """
    require(
        isinstance(name, str) and re.fullmatch(r"[a-z][a-z0-9_]*", name) and name not in BUILT_IN_TASKS,
        f"expected a name of lower case letters, digits and underscores that no built-in task has, got {name!r}. "
        f"Use for example 'two_hoops'.",
    )
    entry = Entry(
        _check_class(task),
        f"crazysim/{''.join(part.capitalize() for part in name.split('_'))}-v0",
        control and enum_member(Control, "control", control).value,
        n_drones if n_drones is None else positive_integer("n_drones", n_drones),
    )
    TASKS[name] = entry
    _register_with_gymnasium(name, entry)
    return entry.id


def entry_of(task: str | Task, is_named: bool = True) -> Entry:
    """Return the registered entry of a task, or a new entry with default values for a class that is not registered.

    Args:
        task: One of ``TASKS``, a name from the entry points of an installed package, the reference of your class, or
            a task.
        is_named: True if this user has named the task; False for a reference from the files of a run, which other
            people may have written, see ``crazysim.envs.references``.

    Raises:
        ConfigError: If there is no such file, module or class, or it may not be executed.
    """
    if isinstance(task, Task):
        sources = (type(task), f"{type(task).__module__}:{type(task).__name__}")
        entries = (entry for entry in TASKS.values() if entry.source in sources)
        return next(entries, Entry(_check_class(type(task)), ""))
    require(
        isinstance(task, str), f"expected the name of a task or a task, got {task!r}. A class has to be called: Task()."
    )
    if task in TASKS:
        return TASKS[task]
    if is_reference(task):
        loaded = load_task(task, TASKS) if is_named else load_listed_task(task, TASKS)
        return TASKS[loaded] if isinstance(loaded, str) else Entry(_check_class(loaded), "")
    entry_points = importlib.metadata.entry_points(group=ENTRY_POINTS)
    if task in entry_points.names:
        register(task, entry_points[task].load())
        return TASKS[task]
    raise UnknownNameError(
        f"task {task!r} does not exist; there are {', '.join([*TASKS, *sorted(entry_points.names)])}. Name a custom "
        f"task as FILE.py:CLASS."
    )


def _check_class(task: object) -> type[Task]:
    if not inspect.isclass(task) or not issubclass(task, Task) or task is Task:
        raise ConfigError(f"expected a subclass of Task, got {task!r}. docs/guides/tasks.md has an example.")
    return task


def _register_with_gymnasium(name: str, entry: Entry) -> None:
    if entry.id not in gymnasium.registry:
        gymnasium.register(
            entry.id,
            entry_point="crazysim.envs.single:make_single",
            vector_entry_point="crazysim.envs.vector:make_vector",
            kwargs={"task": name},
        )


for _name, _entry in TASKS.items():
    _register_with_gymnasium(_name, _entry)
