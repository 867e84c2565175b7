"""Swarms of simulated drones that take the commands of Crazyflies."""

from crazysim.live.swarm.commander import Commander
from crazysim.live.swarm.plan import Plan
from crazysim.live.swarm.state import DroneState
from crazysim.live.swarm.swarm import Swarm

__all__ = ["Commander", "DroneState", "Plan", "Swarm"]
