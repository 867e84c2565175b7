"""Firmware in the loop: programs of Betaflight, ArduPilot and PX4 that fly simulated drones."""

from crazysim.lab.live.sitl.ardupilot import ArduPilot
from crazysim.lab.live.sitl.betaflight import Betaflight
from crazysim.lab.live.sitl.link import FirmwareLink
from crazysim.lab.live.sitl.loop import SoftwareInTheLoop
from crazysim.lab.live.sitl.measured import Measurements, Origin
from crazysim.lab.live.sitl.px4 import Px4

__all__ = ["ArduPilot", "Betaflight", "FirmwareLink", "Measurements", "Origin", "Px4", "SoftwareInTheLoop"]
