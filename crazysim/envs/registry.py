"""Tasks by name, and environments made from them in one call."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from crazysim.envs.actions import Actions
from crazysim.envs.env import DroneEnv, Task
from crazysim.envs.tasks.avoid import avoid
from crazysim.envs.tasks.hover import hover
from crazysim.envs.tasks.land import land
from crazysim.envs.tasks.race import race
from crazysim.envs.tasks.reach_vel import reach_vel
from crazysim.envs.tasks.recover import recover
from crazysim.envs.tasks.swarm import swarm
from crazysim.envs.tasks.track import track
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.sim.sim import Sim


@dataclass(frozen=True)
class Entry:
    """A task that is known by name."""

    maker: Callable[..., Task]
    """``maker(sim, **options) -> Task``."""
    id: str
    """What it is called in Gymnasium's registry."""
    control: str = "attitude"
    """Its usual command level."""
    n_drones: int = 1
    """Its usual number of drones."""


TASKS: dict[str, Entry] = {
    "hover": Entry(hover, "crazysim/Hover-v0"),
    "reach_vel": Entry(reach_vel, "crazysim/ReachVel-v0"),
    "recover": Entry(recover, "crazysim/Recover-v0"),
    "track": Entry(track, "crazysim/Track-v0"),
    "land": Entry(land, "crazysim/Land-v0"),
    "race": Entry(race, "crazysim/Race-v0"),
    "multi_race": Entry(race, "crazysim/MultiRace-v0", n_drones=2),
    "avoid": Entry(avoid, "crazysim/Avoid-v0"),
    "swarm": Entry(swarm, "crazysim/Swarm-v0", n_drones=4),
}
"""Every task, by name."""

SIM_SETTINGS = tuple(inspect.signature(Sim).parameters)
"""What of the settings of ``make`` belongs to the simulation."""


def make(name: str, n_worlds: int = 1, freq: int = 50, actions: Actions | None = None, **options: Any) -> DroneEnv:
    """Return an environment of many worlds of a task.

    Args:
        name: One of ``TASKS``.
        n_worlds: Number of worlds.
        freq: Environment steps per second, Hz.
        actions: What an action means; None for the usual of the command level.
        options: Settings of ``crazysim.Sim``, such as ``n_drones``, ``control``, ``drone``, ``dynamics``, ``device``,
            and of the task, such as ``seconds``; ``help(crazysim.envs.TASKS[name].maker)`` lists those.

    Raises:
        ConfigError: If an option exists neither for the simulation nor for the task.
        UnknownNameError: If there is no such task.
    """
    entry = entry_of(name)
    of_task = tuple(inspect.signature(entry.maker).parameters)[1:]
    for option in options:
        if option not in SIM_SETTINGS and option not in of_task:
            near = difflib.get_close_matches(option, SIM_SETTINGS + of_task, 1)
            hint = f"; did you mean {near[0]}?" if near else "."
            raise ConfigError(
                f"task {name!r} has no option {option!r}{hint} It has {', '.join(of_task)}; the simulation has "
                f"{', '.join(SIM_SETTINGS)}"
            )
    settings = {"control": entry.control, "n_drones": entry.n_drones}
    settings |= {k: v for k, v in options.items() if k in SIM_SETTINGS}
    sim = Sim(n_worlds=n_worlds, **settings)
    return DroneEnv(sim, entry.maker(sim, **{k: v for k, v in options.items() if k in of_task}), freq, actions)


def entry_of(name: str) -> Entry:
    """Return what is known of a task.

    Raises:
        UnknownNameError: If there is no such task, with those there are.
    """
    if name not in TASKS:
        raise UnknownNameError(f"task {name!r} does not exist; there are {', '.join(TASKS)}")
    return TASKS[name]
