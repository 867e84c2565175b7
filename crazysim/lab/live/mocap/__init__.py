"""Motion capture: sources of poses, rules for their measurements, recordings, and twins in the scene."""

from crazysim.lab.live.mocap.capture import SYSTEMS, MotionCaptureSource
from crazysim.lab.live.mocap.frames import Convention, Frame
from crazysim.lab.live.mocap.playback import Playback
from crazysim.lab.live.mocap.poll_recording import MocapRecorder, ReplaySource, read_polls
from crazysim.lab.live.mocap.source import FunctionSource, MocapSource, Poll, RealTimeSource, ThreadSource, show_source
from crazysim.lab.live.mocap.source_events import Report, Reports
from crazysim.lab.live.mocap.tracker import Rules, Tracker
from crazysim.lab.live.mocap.twins import Twin, Twins, discover, twin_of

__all__ = [
    "SYSTEMS",
    "Convention",
    "Frame",
    "FunctionSource",
    "MocapRecorder",
    "MocapSource",
    "MotionCaptureSource",
    "Playback",
    "Poll",
    "RealTimeSource",
    "ReplaySource",
    "Report",
    "Reports",
    "Rules",
    "ThreadSource",
    "Tracker",
    "Twin",
    "Twins",
    "discover",
    "read_polls",
    "show_source",
    "twin_of",
]
