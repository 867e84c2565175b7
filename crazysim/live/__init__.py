"""Live operation: commands over TCP, motion capture, scripts of real drones, links to real drones, ROS."""

from crazysim.live.client import DroneClient, StreamClient
from crazysim.live.commands import Hover, Land, LoadShow, SetParameter, Start, StartShow, TakeOff, Upload
from crazysim.live.crtp import CrtpDevice, CrtpServer, add_cflib_driver, remove_cflib_driver
from crazysim.live.fleet import Fleet
from crazysim.live.link import Link, SimLink, TrainedPolicy, fly_policy
from crazysim.live.mocap import (
    Convention,
    Frame,
    FunctionSource,
    MocapSource,
    MotionCaptureSource,
    Playback,
    RealTimeSource,
    ReplaySource,
    Rules,
    ThreadSource,
    Twin,
    Twins,
    discover,
    show_source,
)
from crazysim.live.radio import Radio
from crazysim.live.ros import RosBridge
from crazysim.live.server import CommandServer, StreamListener
from crazysim.live.swarm import Commander, DroneState, Swarm

__all__ = [
    "CommandServer",
    "Commander",
    "Convention",
    "CrtpDevice",
    "CrtpServer",
    "DroneClient",
    "DroneState",
    "Fleet",
    "Frame",
    "FunctionSource",
    "Hover",
    "Land",
    "Link",
    "LoadShow",
    "MocapSource",
    "MotionCaptureSource",
    "Playback",
    "Radio",
    "RealTimeSource",
    "ReplaySource",
    "RosBridge",
    "Rules",
    "SetParameter",
    "SimLink",
    "Start",
    "StartShow",
    "StreamClient",
    "StreamListener",
    "Swarm",
    "TakeOff",
    "ThreadSource",
    "TrainedPolicy",
    "Twin",
    "Twins",
    "Upload",
    "add_cflib_driver",
    "discover",
    "fly_policy",
    "remove_cflib_driver",
    "show_source",
]
