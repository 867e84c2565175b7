"""Live operation: the real-time loop, its viewers and pilots, and commands over TCP."""

from crazysim.live.browser import Browser
from crazysim.live.client import DroneClient, StreamClient
from crazysim.live.commands import Hover, Land, LoadShow, SetParameter, Start, StartShow, TakeOff, Upload
from crazysim.live.fleet import Fleet
from crazysim.live.gamepad import Gamepad
from crazysim.live.keyboard import Keyboard
from crazysim.live.loop import Live
from crazysim.live.pace import LiveReport
from crazysim.live.piloting import Pilot, keyboard_sticks
from crazysim.live.remote import RemoteCommands
from crazysim.live.server import CommandServer, StreamListener
from crazysim.live.viewer import Viewer
from crazysim.live.window import Window

__all__ = [
    "Browser",
    "CommandServer",
    "DroneClient",
    "Fleet",
    "Gamepad",
    "Hover",
    "Keyboard",
    "Land",
    "Live",
    "LiveReport",
    "LoadShow",
    "Pilot",
    "RemoteCommands",
    "SetParameter",
    "Start",
    "StartShow",
    "StreamClient",
    "StreamListener",
    "TakeOff",
    "Upload",
    "Viewer",
    "Window",
    "keyboard_sticks",
]
