"""Files of light shows: Skybrush's ``.skyc`` with its lights and cues."""

from crazysim.lab.show_files.led import decode_lights, encode_lights
from crazysim.lab.show_files.lights import Lights
from crazysim.lab.show_files.show import Cue, Show
from crazysim.lab.show_files.skyc import load_show, save_show

__all__ = ["Cue", "Lights", "Show", "decode_lights", "encode_lights", "load_show", "save_show"]
