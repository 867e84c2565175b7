"""Law 9 for controllers: each row has the settings of a simulation and the setting, or the remedy, of its error."""

import re

import jax
import numpy as np
import pytest

from crazysim import Sim
from crazysim.control import INDI, LQR, Geometric, LoadLQR, Mellinger, Setpoint
from crazysim.lab.control.tracking_lqr import TrackingLQR


def tracking(dt, *shape):
    setpoint = Setpoint(*[np.zeros(3)] * 5, *[np.zeros(1)] * 3)
    return TrackingLQR(setpoints=jax.tree.map(lambda x: np.broadcast_to(x, (*shape, *x.shape)), setpoint), dt=dt)


ROWS = [
    ({"controller": "pd"}, "got 'pd'"),
    ({"controller": "mine.so"}, "Use CFirmware('mine.so')"),
    ({"controller": 3}, "a controller as a name or a Controller"),
    ({"controller": "mellinger", "control": "body_rate"}, "state or attitude"),
    ({"controller": "pid", "dynamics": "so_rpy"}, "dynamics with rotors"),
    ({"controller": Mellinger(freq=300)}, "freq of controller 'mellinger'"),
    ({"controller": "pid", "drone": "bumblebee"}, "controller='auto'"),
    ({"controller": ["pid", "mellinger"]}, "a switch for several controllers"),
    ({"controller": "pid", "switch": 0}, "a list of controllers for a switch"),
    ({"controller": [], "switch": 0}, "at least one controller"),
    ({"controller": ["crazyflow"], "switch": 0}, "attitude or body_rate"),
    ({"controller": ["pid"], "switch": 1}, "integers from 0 to 0"),
    ({"controller": ["pid"], "switch": lambda state, setpoint, time: time}, "one integer"),
    ({"controller": ["pid"], "switch": np.zeros((3, 4), int)}, "(n_worlds, n_drones) = (1, 1)"),
    ({"controller": "load_lqr"}, "a load 'load'"),
    ({"controller": LoadLQR(length=0.0)}, "positive length"),
    ({"controller": INDI(cutoff=-1.0)}, "cutoff"),
    ({"controller": Geometric(integral=-1.0)}, "integral"),
    ({"controller": Geometric(integral=np.inf)}, "integral"),
    ({"controller": LQR(Q=[1, 2, 3])}, "weights Q of shape (12,) or (12, 12)"),
    ({"controller": LQR(Q=np.triu(np.ones((12, 12))))}, "positive semidefinite"),
    ({"controller": LQR(R=[1, np.nan, 1, 1])}, "R of LQR"),
    ({"controller": LQR(Q=[1] * 11 + [-1])}, "positive semidefinite"),
    ({"controller": LQR(Q=np.eye(12) - 0.1)}, "the eigenvalue -0.2"),
    ({"controller": LQR(R=[1, 1, 1, 0])}, "positive definite"),
    ({"controller": LQR(Q=[0] * 3 + [1] * 9)}, "stabilising solution"),
    ({"controller": "tracking_lqr"}, "setpoints of one drone"),
    ({"controller": tracking(0.1)}, "positions of shape (3,) and 0.1"),
    ({"controller": tracking(np.nan, 4)}, "dt of TrackingLQR"),
]


@pytest.mark.parametrize(("settings", "words"), ROWS, ids=[row[1] for row in ROWS])
def test_a_wrong_setting_is_named(settings, words):
    drone = "cf2x_L250" if isinstance(settings["controller"], list) or "dynamics" in settings else "bumblebee"
    with pytest.raises(ValueError, match=re.escape(words)):
        Sim(**({"control": "state", "drone": drone} | settings)).step()
