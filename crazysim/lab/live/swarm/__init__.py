"""Swarms of simulated drones that accept the same commands as real Crazyflies."""

from crazysim.lab.live.swarm.commander import Commander
from crazysim.lab.live.swarm.motion import PlannedMotion
from crazysim.lab.live.swarm.state import DroneState
from crazysim.lab.live.swarm.swarm import Swarm

__all__ = ["Commander", "DroneState", "PlannedMotion", "Swarm"]
