"""Tasks by name, and environments made from them in one call."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
from dataclasses import dataclass
from typing import Any

from crazysim.envs.actions import Actions
from crazysim.envs.env import DroneEnv
from crazysim.envs.task import Task
from crazysim.envs.tasks.avoid import Avoid
from crazysim.envs.tasks.chase import Chase
from crazysim.envs.tasks.deliver import Deliver
from crazysim.envs.tasks.hover import Hover
from crazysim.envs.tasks.land import Land
from crazysim.envs.tasks.race import Race
from crazysim.envs.tasks.reach_vel import ReachVel
from crazysim.envs.tasks.recover import Recover
from crazysim.envs.tasks.swarm import Swarm
from crazysim.envs.tasks.track import TrackTrajectory
from crazysim.envs.tasks.transport import Transport
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.sim.sim import Sim


@dataclass(frozen=True)
class Entry:
    """A registered task."""

    task: type[Task]
    """Class of the task."""
    id: str
    """Id in Gymnasium's registry."""
    control: str = "attitude"
    """Default command level."""
    n_drones: int = 1
    """Default number of drones."""

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the task's settings."""
        return tuple(f.name for f in dataclasses.fields(self.task))


TASKS: dict[str, Entry] = {
    "hover": Entry(Hover, "crazysim/Hover-v0"),
    "reach_vel": Entry(ReachVel, "crazysim/ReachVel-v0"),
    "recover": Entry(Recover, "crazysim/Recover-v0"),
    "track": Entry(TrackTrajectory, "crazysim/Track-v0"),
    "land": Entry(Land, "crazysim/Land-v0"),
    "chase": Entry(Chase, "crazysim/Chase-v0"),
    "deliver": Entry(Deliver, "crazysim/Deliver-v0"),
    "race": Entry(Race, "crazysim/Race-v0"),
    "multi_race": Entry(Race, "crazysim/MultiRace-v0", n_drones=2),
    "avoid": Entry(Avoid, "crazysim/Avoid-v0"),
    "transport": Entry(Transport, "crazysim/Transport-v0"),
    "swarm": Entry(Swarm, "crazysim/Swarm-v0", n_drones=4),
}
"""All registered tasks, by name."""

SIM_OPTIONS = tuple(inspect.signature(Sim).parameters)
"""Options of ``make`` that belong to the simulation."""


def make(name: str, n_worlds: int = 1, freq: int = 50, actions: Actions | None = None, **options: Any) -> DroneEnv:
    """Return an environment of many worlds of a task, with a simulation of its own.

    Args:
        name: One of ``TASKS``.
        n_worlds: Number of worlds.
        freq: Environment steps per second, Hz.
        actions: Meaning of an action; None for the usual one of the command level.
        options: Settings of ``crazysim.Sim``, such as ``n_drones``, ``control``, ``drone``, ``dynamics``, ``device``,
            and of the task, such as ``seconds``; ``help(crazysim.envs.TASKS[name].task)`` lists those.

    Raises:
        ConfigError: If neither the simulation nor the task has an option.
        UnknownNameError: If there is no such task.
    """
    entry = entry_of(name)
    for option in options:
        if option not in SIM_OPTIONS + entry.options:
            near = difflib.get_close_matches(option, SIM_OPTIONS + entry.options, 1)
            hint = f"; did you mean {near[0]}?" if near else "."
            raise ConfigError(
                f"task {name!r} has no option {option!r}{hint} It has {', '.join(entry.options)}; the simulation has "
                f"{', '.join(SIM_OPTIONS)}"
            )
    settings = {"control": entry.control, "n_drones": entry.n_drones}
    settings |= {k: v for k, v in options.items() if k in SIM_OPTIONS}
    task = entry.task(**{k: v for k, v in options.items() if k in entry.options})
    sim = Sim(n_worlds=n_worlds, **settings)
    task.install(sim)
    return DroneEnv(sim, task, freq, actions)


def entry_of(name: str) -> Entry:
    """Return a registered task.

    Raises:
        UnknownNameError: If there is none of that name, with those there are.
    """
    if name not in TASKS:
        raise UnknownNameError(f"task {name!r} does not exist; there are {', '.join(TASKS)}")
    return TASKS[name]
