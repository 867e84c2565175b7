"""Simulated Crazyflies that speak CRTP, the protocol of ``cflib``: scripts run unchanged, except for the URI.

``CrtpServer`` answers on UDP: ``cflib`` in any process connects to ``udp://127.0.0.1:19850``. ``add_cflib_driver`` adds
``sim://`` to ``cflib`` in the present process.
"""

from crazysim.lab.live.crtp.device import CrtpDevice
from crazysim.lab.live.crtp.driver import add_cflib_driver, remove_cflib_driver
from crazysim.lab.live.crtp.server import CrtpServer

__all__ = ["CrtpDevice", "CrtpServer", "add_cflib_driver", "remove_cflib_driver"]
