"""Firmware in the loop: programs of Betaflight, ArduPilot and PX4 that fly simulated drones."""

from crazysim.live.sitl.ardupilot import ArduPilot
from crazysim.live.sitl.betaflight import Betaflight
from crazysim.live.sitl.link import FirmwareLink
from crazysim.live.sitl.loop import SoftwareInTheLoop
from crazysim.live.sitl.measured import Measured, Origin
from crazysim.live.sitl.px4 import Px4

__all__ = ["ArduPilot", "Betaflight", "FirmwareLink", "Measured", "Origin", "Px4", "SoftwareInTheLoop"]
