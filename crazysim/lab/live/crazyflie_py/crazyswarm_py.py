"""Entry point of Crazyswarm2 scripts: the swarm, its clock and its drones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from crazysim.errors import ConfigError
from crazysim.lab.live.crazyflie_py.crazyflie import CrazyflieServer, TimeHelper
from crazysim.lab.live.swarm import Swarm
from crazysim.sim.sim import Sim
from crazysim.storage import MAX_TEXT_BYTES, read_text

CONFIGURATION_FILE = Path("crazyflies.yaml")
"""File in the working directory that describes the drones of ``Crazyswarm()``; optional."""

_chosen_swarm: Swarm | None = None


def use(swarm: Swarm | None) -> None:
    """Make the next ``Crazyswarm()`` of a script use this swarm; None to let it create one."""
    global _chosen_swarm
    _chosen_swarm = swarm


class Crazyswarm:
    """The swarm of a script: ``allcfs`` with the drones, and ``timeHelper`` with the clock.

    Without an argument it flies the swarm passed to ``use``, else the drones of ``crazyflies.yaml`` in the working
    directory, else one drone.
    """

    allcfs: CrazyflieServer
    """All drones."""
    timeHelper: TimeHelper
    """Clock."""

    def __init__(self, swarm: Swarm | str | Path | Mapping[str, Any] | None = None):
        global _chosen_swarm
        if swarm is None:
            swarm, _chosen_swarm = _chosen_swarm, None
        if swarm is None:
            swarm = CONFIGURATION_FILE if CONFIGURATION_FILE.is_file() else {}
        self.swarm = swarm if isinstance(swarm, Swarm) else Swarm(*_create_simulation(swarm))
        self.allcfs = CrazyflieServer(self.swarm)
        self.timeHelper = TimeHelper(self.swarm)


def _create_simulation(configuration: str | Path | Mapping[str, Any]) -> tuple[Sim, list[str]]:
    if isinstance(configuration, (str, Path)):
        try:
            import yaml
        except ImportError as error:
            raise ConfigError(
                "crazyflies.yaml needs PyYAML, which is not installed. Run pip install pyyaml."
            ) from error
        try:
            configuration = yaml.safe_load(read_text(configuration, MAX_TEXT_BYTES))
        except (OSError, yaml.YAMLError) as error:
            raise ConfigError(f"expected a crazyflies.yaml, got {str(configuration)!r}: {error}") from error
    robots = (configuration or {}).get("robots", {"cf1": {"initial_position": [0.0, 0.0, 0.0]}})  # type: ignore[union-attr]
    enabled_robots = {name: robot for name, robot in robots.items() if robot.get("enabled", True)}
    try:
        initial_pos = np.array([robot["initial_position"] for robot in enabled_robots.values()], float)
        initial_pos = initial_pos.reshape(len(enabled_robots), 3)
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"expected initial_position of three numbers for every robot, got {error!r}") from error
    if not enabled_robots or not np.isfinite(initial_pos).all():
        raise ConfigError(f"expected at least one enabled robot at finite positions, got {initial_pos.tolist()}")
    sim = Sim(n_drones=len(enabled_robots), control="state")
    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[0].set(initial_pos)))
    sim.build_default_data()
    return sim, list(enabled_robots)
