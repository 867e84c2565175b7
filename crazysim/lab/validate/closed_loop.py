"""Closed-loop simulations against flight logs: the firmware's controller and filter track the logged setpoints."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazysim.core.airframes import AirframeSource
from crazysim.errors import ConfigError, require
from crazysim.lab.identify.tables import read_table
from crazysim.plugins.estimators import Estimator, Kalman
from crazysim.plugins.sensors import IMU, MotionCapture
from crazysim.sim.sim import Sim

FREQ = 100
"""Rate of the samples of a flight, and of commanded setpoints, Hz."""
COLUMNS = ("t", "px", "py", "pz", "sp_ctrltarget_x", "sp_ctrltarget_y", "sp_ctrltarget_z", "sp_ctrltarget_yaw")
"""Columns of a log of NanoBench (arXiv 2603.09908): time, s; position from motion capture, m; setpoint of the
position, m, and of the yaw, degrees."""
AIRBORNE_SHARE, SETTLING_TIME, LANDING_TIME = 0.9, 2.0, 0.5
"""Samples of a flight that are compared. A drone counts as airborne while its setpoint is above ``AIRBORNE_SHARE`` of
the median height. This median is over the setpoints above half of the largest height. The comparison starts
``SETTLING_TIME`` seconds after the drone is first airborne, and ends ``LANDING_TIME`` seconds before it is last."""
MAX_DISTANCE = 2.0
"""Distance from the setpoint, m, beyond which a flight has failed; setpoints jump by up to 1.2 m."""
MAX_LAG = 1.2
"""Longest lag that is considered, s."""


@dataclasses.dataclass(frozen=True, eq=False)
class Flight:
    """A logged flight at ``FREQ``, from its first setpoint to its last."""

    name: str
    """Name of the log."""
    setpoint: NDArray
    """Commanded position, m, and yaw, rad. Heights are relative to the tracked body at rest on the floor. (n, 4)"""
    pos: NDArray
    """Measured position, with heights as in ``setpoint``, m. (n, 3)"""

    @property
    def compared_samples(self) -> slice:
        """Samples in which errors are computed."""
        height = self.setpoint[:, 2]
        airborne = np.flatnonzero(height > AIRBORNE_SHARE * np.median(height[height > 0.5 * height.max()]))
        return slice(airborne[0] + round(SETTLING_TIME * FREQ), airborne[-1] - round(LANDING_TIME * FREQ))

    def rmse(self, pos: NDArray) -> float:
        """Return the root mean square distance of positions, (n, 3), from the setpoint, m."""
        error = (pos - self.setpoint[:, :3])[self.compared_samples]
        return float(np.sqrt(np.mean(np.sum(error**2, axis=-1))))

    def lag(self, pos: NDArray) -> float:
        """Return the lag, s: the delay of the setpoint that brings it horizontally closest to the positions, (n, 3)."""
        first, last = self.compared_samples.start, self.compared_samples.stop

        def distance(k: int) -> float:
            return float(np.mean((pos[first + k : last, :2] - self.setpoint[first : last - k, :2]) ** 2))

        return min(range(round(MAX_LAG * FREQ)), key=distance) / FREQ


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Tracking errors of a flight and of its simulation."""

    name: str
    """Name of the log."""
    logged_error: float
    """Root mean square distance from the setpoint in the log, m."""
    simulated_error: float
    """Root mean square distance from the setpoint in the simulation, m."""
    logged_lag: float
    """Lag behind the setpoint in the log, s."""
    simulated_lag: float
    """Lag behind the setpoint in the simulation, s."""
    failed: bool
    """Whether the real drone was farther than ``MAX_DISTANCE`` from its setpoint in a compared sample."""

    @property
    def ratio(self) -> float:
        """Simulated error divided by the logged error."""
        return self.simulated_error / self.logged_error


def read_flight(path: str | Path) -> Flight:
    """Return the flight of a log of NanoBench, a table with ``COLUMNS``."""
    path = Path(path)
    columns = read_columns(path, COLUMNS)
    t, logged_pos, setpoints = columns[0], columns[1:4], columns[4:]
    height_at_rest, commanded = logged_pos[2, 0], commanded_samples(path.name, setpoints[2])
    grid = np.arange(float(t[commanded[0]]), float(t[commanded[-1]]), 1 / FREQ)
    pos = np.stack([np.interp(grid, t, x) for x in logged_pos], axis=-1)
    nearest_index = np.searchsorted((t[1:] + t[:-1]) / 2, grid)
    setpoint = setpoints[:, nearest_index].T * [1, 1, 1, np.pi / 180]
    pos[:, 2], setpoint[:, 2] = pos[:, 2] - height_at_rest, setpoint[:, 2] - height_at_rest
    return Flight(path.stem, setpoint, pos)


def read_columns(path: Path, names: Sequence[str]) -> NDArray:
    """Return columns of a log of NanoBench. (len(names), n)"""
    _, table = read_table(path, [], None)
    if missing := [name for name in names if name not in table]:
        raise ConfigError(
            f"{path.name}: expected columns {', '.join(names)}, got no {', '.join(missing)}. Give a log of NanoBench."
        )
    return np.stack([table[name] for name in names]).astype(np.float64)


def commanded_samples(name: str, height: NDArray) -> NDArray:
    """Return the indices of samples with a setpoint above the floor.

    Args:
        height: Height of the setpoint, m. (n,)
    """
    commanded = np.flatnonzero(height > 0)
    require(len(commanded), f"{name}: expected a setpoint above the floor, got none. Give the log of a flight.")
    return commanded


def laboratory_estimator(quat_deviation: float = 0.06) -> Estimator:
    """Return the firmware's Kalman filter with the settings of a laboratory with motion capture.

    The noise of positions is 0.1 mm, their largest scatter at rest in NanoBench's logs. The default of
    ``quat_deviation``, rad, is the value in Bitcraze's examples for motion capture (crazyflie-lib-python,
    examples/mocap/qualisys_hl_commander.py).
    """
    sensors = [IMU.crazyflie(), MotionCapture(noise=1e-4)]
    return Kalman(sensors, deviations={"quat": quat_deviation})


def simulate_flights(
    flights: Sequence[Flight], drone: AirframeSource = "cf2x_L250", estimator: Estimator | None = None
) -> NDArray:
    """Return the positions of simulated drones that follow the setpoints of flights, m. (n, n_flights, 3)

    The controller is the firmware's ``"pid"``. Each drone starts on the floor, at the horizontal position at which the
    real drone started. Shorter flights continue with their last setpoint until the longest flight ends.

    Args:
        estimator: Filter whose estimates the controllers use; None for the true state.
    """
    sim = Sim(len(flights), drone=drone, control="state", controller="pid", estimator=estimator)
    start = np.stack([flight.pos[0] * [1, 1, 0] for flight in flights])[:, None]
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=start.astype(np.float32)))
    n = max(len(flight.pos) for flight in flights)
    setpoints = np.stack([f.setpoint[np.minimum(np.arange(n), len(f.pos) - 1)] for f in flights], axis=1)[:, :, None]
    pos = np.empty((n, len(flights), 3))
    for k, setpoint in enumerate(setpoints):
        pos[k] = np.asarray(sim.data.states.pos)[:, 0]
        sim.state_control(pos=setpoint[..., :3], yaw=setpoint[..., 3])
        sim.step(sim.freq // FREQ)
    return pos


def compare_tracking(
    flights: Sequence[Flight], drone: AirframeSource = "cf2x_L250", estimator: Estimator | None = None
) -> list[Comparison]:
    """Return the tracking errors of flights and of their simulations; see ``simulate_flights`` for the arguments."""
    comparisons, simulated_pos = [], simulate_flights(flights, drone, estimator)
    for k, flight in enumerate(flights):
        pos = simulated_pos[: len(flight.pos), k]
        distance = np.linalg.norm(flight.pos - flight.setpoint[:, :3], axis=-1)[flight.compared_samples]
        errors = flight.rmse(flight.pos), flight.rmse(pos)
        lags = flight.lag(flight.pos), flight.lag(pos)
        comparisons.append(Comparison(flight.name, *errors, *lags, bool(np.max(distance) > MAX_DISTANCE)))
    return comparisons
