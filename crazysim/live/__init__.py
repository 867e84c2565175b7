"""Live operation: the real-time loop, viewers and pilots, commands over TCP, motion capture, real drones, ROS."""

from crazysim.live.browser import Browser
from crazysim.live.client import DroneClient, StreamClient
from crazysim.live.commands import Hover, Land, LoadShow, SetParameter, Start, StartShow, TakeOff, Upload
from crazysim.live.crtp import CrtpDevice, CrtpServer, add_cflib_driver, remove_cflib_driver
from crazysim.live.fleet import Fleet
from crazysim.live.gamepad import Gamepad
from crazysim.live.keyboard import Keyboard
from crazysim.live.link import Link, SimLink, TrainedPolicy, fly_policy
from crazysim.live.loop import Live
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
from crazysim.live.pace import LiveReport
from crazysim.live.piloting import Pilot, keyboard_sticks
from crazysim.live.radio import Radio
from crazysim.live.remote import RemoteCommands
from crazysim.live.ros import RosBridge
from crazysim.live.server import CommandServer, StreamListener
from crazysim.live.swarm import Commander, DroneState, Swarm
from crazysim.live.viewer import Viewer
from crazysim.live.window import Window

__all__ = [
    "Browser",
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
    "Gamepad",
    "Hover",
    "Keyboard",
    "Land",
    "Link",
    "Live",
    "LiveReport",
    "LoadShow",
    "MocapSource",
    "MotionCaptureSource",
    "Pilot",
    "Playback",
    "Radio",
    "RealTimeSource",
    "RemoteCommands",
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
    "Viewer",
    "Window",
    "add_cflib_driver",
    "discover",
    "fly_policy",
    "keyboard_sticks",
    "remove_cflib_driver",
    "show_source",
]
