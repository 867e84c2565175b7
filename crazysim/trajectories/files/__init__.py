"""Files of trajectories: CSV, and the Crazyflie's trajectory memory."""

from crazysim.trajectories.files.csv import load_csv, save_csv, save_samples
from crazysim.trajectories.files.polynomials import (
    load_memory,
    pack_compressed,
    pack_poly4d,
    save_memory,
    unpack_compressed,
    unpack_poly4d,
)

__all__ = [
    "load_csv",
    "load_memory",
    "pack_compressed",
    "pack_poly4d",
    "save_csv",
    "save_memory",
    "save_samples",
    "unpack_compressed",
    "unpack_poly4d",
]
