"""The simulation: its data, its pipelines of stages, and the class ``Sim``, which holds them."""

from crazysim.control import Control
from crazysim.core.integration import Integrator
from crazysim.drones import Drone
from crazysim.dynamics import Dynamics
from crazysim.sim.reset import Reset
from crazysim.sim.rollout import rollout
from crazysim.sim.sim import Sim, sync_sim2mjx, use_box_collision
from crazysim.sim.visualize import (
    change_material,
    draw_capsule,
    draw_label,
    draw_line,
    draw_points,
    draw_setpoints,
    draw_text,
)

__all__ = [
    "Control",
    "Drone",
    "Dynamics",
    "Integrator",
    "Reset",
    "Sim",
    "change_material",
    "draw_capsule",
    "draw_label",
    "draw_line",
    "draw_points",
    "draw_setpoints",
    "draw_text",
    "rollout",
    "sync_sim2mjx",
    "use_box_collision",
]
