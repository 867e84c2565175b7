"""Live operation: the real-time loop, viewers and pilots, commands over TCP, motion capture, real drones, ROS."""

from crazysim.lab.live.browser import Browser
from crazysim.lab.live.commands import Hover, Land, LoadShow, SetParameter, Start, StartShow, TakeOff, Upload
from crazysim.lab.live.crtp import CrtpDevice, CrtpServer, add_cflib_driver, remove_cflib_driver
from crazysim.lab.live.fleet import Fleet, RemoteCommands
from crazysim.lab.live.gamepad import Gamepad
from crazysim.lab.live.keyboard import Keyboard
from crazysim.lab.live.link import Link, SimLink, TrainedPolicy, fly_policy
from crazysim.lab.live.loop import Live
from crazysim.lab.live.mocap import (
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
from crazysim.lab.live.pace import LiveReport
from crazysim.lab.live.piloting import Pilot, keyboard_sticks
from crazysim.lab.live.policy_pilot import PolicyPilot
from crazysim.lab.live.radio import Radio
from crazysim.lab.live.ros import RosBridge
from crazysim.lab.live.server import CommandServer, StreamListener
from crazysim.lab.live.swarm import Commander, DroneState, Swarm
from crazysim.lab.live.viewer import Viewer
from crazysim.lab.live.window import Window

__all__ = [
    "Browser",
    "CommandServer",
    "Commander",
    "Convention",
    "CrtpDevice",
    "CrtpServer",
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
    "PolicyPilot",
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
