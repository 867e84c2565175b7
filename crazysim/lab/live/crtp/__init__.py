"""Simulated Crazyflies that speak CRTP, the protocol of ``cflib``: scripts run unchanged, except for the URI.

``CrtpServer`` answers on UDP, which ``cflib`` reaches by ``udp://127.0.0.1:19850``, from any process.
``add_cflib_driver`` adds ``sim://`` to ``cflib`` within this one.
"""

from crazysim.lab.live.crtp.device import CrtpDevice
from crazysim.lab.live.crtp.driver import add_cflib_driver, remove_cflib_driver
from crazysim.lab.live.crtp.server import CrtpServer

__all__ = ["CrtpDevice", "CrtpServer", "add_cflib_driver", "remove_cflib_driver"]
