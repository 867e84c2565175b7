"""Files of trajectories: CSV, and the Crazyflie's trajectory memory."""

from typing import TYPE_CHECKING

from crazysim.names import lazy_getattr

if TYPE_CHECKING:
    from crazysim.lab.trajectory_files.csv import load_csv, save_csv, save_samples
    from crazysim.lab.trajectory_files.polynomials import (
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

__getattr__ = lazy_getattr(__name__)
