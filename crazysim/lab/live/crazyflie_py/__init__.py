"""Crazyswarm2's Python API for simulated drones: scripts run with their import changed.

    from crazysim.lab.live.crazyflie_py import Crazyswarm      # instead of: from crazyflie_py import Crazyswarm

Names, arguments, units and the meaning of commands are as in ``crazyflie_py``. Time is simulated:
``timeHelper.sleep`` advances the simulation as fast as possible, so that a run can be repeated bit for bit.
"""

from crazysim.lab.live.crazyflie_py import uav_trajectory
from crazysim.lab.live.crazyflie_py.crazyflie import Crazyflie, CrazyflieServer, TimeHelper
from crazysim.lab.live.crazyflie_py.crazyswarm_py import Crazyswarm, use

__all__ = ["Crazyflie", "CrazyflieServer", "Crazyswarm", "TimeHelper", "uav_trajectory", "use"]
