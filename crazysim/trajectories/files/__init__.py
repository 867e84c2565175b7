"""Files of trajectories and light shows: Skybrush's ``.skyc``, CSV, and the Crazyflie's trajectory memory."""

from crazysim.trajectories.files.csv import load_csv, save_csv, save_samples
from crazysim.trajectories.files.led import decode_lights, encode_lights
from crazysim.trajectories.files.lights import Lights
from crazysim.trajectories.files.polynomials import (
    load_memory,
    pack_compressed,
    pack_poly4d,
    save_memory,
    unpack_compressed,
    unpack_poly4d,
)
from crazysim.trajectories.files.show import Cue, Show
from crazysim.trajectories.files.skyc import load_show, save_show

__all__ = [
    "Cue",
    "Lights",
    "Show",
    "decode_lights",
    "encode_lights",
    "load_csv",
    "load_memory",
    "load_show",
    "pack_compressed",
    "pack_poly4d",
    "save_csv",
    "save_memory",
    "save_samples",
    "save_show",
    "unpack_compressed",
    "unpack_poly4d",
]
