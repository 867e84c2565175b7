"""Live operation: commands that reach a running simulation over TCP."""

from crazysim.live.client import DroneClient, StreamClient
from crazysim.live.commands import Hover, Land, LoadShow, SetParameter, Start, StartShow, TakeOff, Upload
from crazysim.live.fleet import Fleet
from crazysim.live.server import CommandServer, StreamListener

__all__ = [
    "CommandServer",
    "DroneClient",
    "Fleet",
    "Hover",
    "Land",
    "LoadShow",
    "SetParameter",
    "Start",
    "StartShow",
    "StreamClient",
    "StreamListener",
    "TakeOff",
    "Upload",
]
