"""Real Crazyflies over ``cflib``, with the commands of the simulator.

Nothing is sent without ``Radio(..., arm=True)``. A link that is not armed opens no radio; it checks commands, and then
refuses them.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crazysim.control import Control
from crazysim.drones import load_airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.errors import ConfigError, optional_import, require
from crazysim.lab.live.mocap.frames import Frame
from crazysim.lab.live.swarm import DroneState
from crazysim.storage import Closeable
from crazysim.tables import TIMEOUT_RANGE, read_number

LOG_VARIABLES = {
    "pos": ("stateEstimate.x", "stateEstimate.y", "stateEstimate.z"),
    "vel": ("stateEstimate.vx", "stateEstimate.vy", "stateEstimate.vz"),
    "quat": ("stateEstimate.qx", "stateEstimate.qy", "stateEstimate.qz", "stateEstimate.qw"),
    "ang_vel": ("gyro.x", "gyro.y", "gyro.z"),
    "acc": ("acc.x", "acc.y", "acc.z"),
}
"""Log variables of each part of the state."""
UNIT_FACTORS = {"ang_vel": math.pi / 180, "acc": GRAVITY_MAGNITUDE}
"""Factors from the units of log variables (degrees/s, multiples of standard gravity) to the units of ``DroneState``."""

log = logging.getLogger(__name__)


class Radio(Closeable):
    """``Link`` to a real Crazyflie, which must stand on the ground when the link is created.

    | Level | Packet of cflib | |
    | --- | --- | --- |
    | ``state`` | ``send_full_state_setpoint`` | position and velocity in steps of 1 mm and 1 mm/s |
    | ``attitude`` | ``send_setpoint``, absolute roll, pitch and yaw | thrust in 65535 steps up to the largest thrust |
    | ``body_rate`` | ``send_setpoint`` with rates | thrust as for ``attitude`` |
    """

    def __init__(
        self,
        uri: str,
        arm: bool = False,
        airframe: str = "cf21B_500",
        period_ms: int = 10,
        max_height: float = 2.0,
        crazyflie: Any = None,
        timeout: float = 10.0,
    ):
        read_number("timeout", timeout, TIMEOUT_RANGE)
        self.name, self.armed, self.max_height = uri, bool(arm), max_height
        loaded_airframe = load_airframe(airframe)
        self._max_thrust = loaded_airframe.n_rotors * float(np.max(loaded_airframe.value("rotors.thrust_max")))
        self._lock, self._state_arrived = threading.Lock(), threading.Event()
        self._values = {part: np.zeros(len(names)) for part, names in LOG_VARIABLES.items()}
        self._received_parts: set[str] = set()
        self._state_time, self._flight_mode = 0.0, None
        self._sync_crazyflie: Any = None
        self._log_configs: list[Any] = []
        if self.armed:
            self._connect(uri, period_ms, crazyflie, timeout)
        else:
            log.info("%s is not armed: nothing is sent, and the drone is not connected", uri)

    def _connect(self, uri: str, period_ms: int, crazyflie: Any, timeout: float) -> None:
        with optional_import("real Crazyflies need", "cflib", "radio", ConfigError):
            import cflib.crtp
            from cflib.crazyflie import Crazyflie
            from cflib.crazyflie.log import LogConfig
            from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
        if not cflib.crtp.CLASSES:
            cflib.crtp.init_drivers()
        self._sync_crazyflie = SyncCrazyflie(uri, cf=crazyflie or Crazyflie())
        try:
            self._sync_crazyflie.open_link()
        except Exception as error:
            raise ConfigError(f"expected a Crazyflie at {uri}, got: {error}. Check its address and battery.") from error
        self._cf = self._sync_crazyflie.cf
        for parts in (("pos", "vel"), ("quat",), ("ang_vel", "acc")):
            config = LogConfig("-".join(parts), period_ms)
            for name in (name for part in parts for name in LOG_VARIABLES[part]):
                config.add_variable(name, "float")
            config.data_received_cb.add_callback(self._receive_block)
            self._cf.log.add_config(config)
            config.start()
            self._log_configs.append(config)
        if not self._state_arrived.wait(timeout):
            self.close()
            raise ConfigError(f"expected log variables of {uri} within {timeout:g} s, got none. Use a newer firmware.")
        self._cf.supervisor.send_arming_request(True)
        self._cf.commander.send_setpoint(0, 0, 0, 0)  # crtp_commander_rpyt.c ignores thrust until it has been zero once

    def state(self) -> DroneState:
        """Return the latest state that the drone has sent, with the time on the drone's clock."""
        self._require_armed()
        with self._lock:
            parts = {part: UNIT_FACTORS.get(part, 1.0) * x for part, x in self._values.items()}
            norm = np.linalg.norm(parts["quat"])
            quat = parts["quat"] / norm if norm > 0.1 else np.array([0.0, 0.0, 0.0, 1.0])
            return DroneState(self._state_time, parts["pos"], quat, parts["vel"], parts["ang_vel"], parts["acc"])

    def command(self, level: Control | str, values: ArrayLike) -> None:
        """Send a command of level state, (16,), attitude, (4,), or body rate, (4,), with the numbers for one drone."""
        level = Control(level)
        sizes = {Control.state: 16, Control.attitude: 4, Control.body_rate: 4}
        require(level in sizes, f"expected a command of level state, attitude or body_rate, got {level.value!r}")
        x = np.asarray(values, float)
        if x.shape != (sizes[level],) or not np.isfinite(x).all():
            raise ConfigError(f"expected {sizes[level]} finite numbers for {level.value}, got {x.tolist()}")
        if level == Control.state:
            if x[2] > self.max_height or np.abs(x[:9]).max() > 32:
                raise ConfigError(
                    f"expected a setpoint below {self.max_height} m and within 32 m, got {x[:3].tolist()}"
                )
            if np.linalg.norm(x[9:13]) < 1e-3:
                raise ConfigError(f"expected a unit quaternion, xyzw, got {x[9:13].tolist()}")
        self._require_armed()
        commander = self._cf.commander
        if level == Control.state:
            # The firmware reads mrad/s, although the docstring of cflib 0.1.34 states degrees/s.
            commander.send_full_state_setpoint(x[0:3], x[3:6], x[6:9], x[9:13], *np.clip(x[13:16], -32, 32))
            return
        self._set_flight_mode(level)
        thrust = round(65535 * min(max(x[3] / self._max_thrust, 0.0), 1.0))
        roll, pitch, yaw = np.degrees(x[:3])
        # In this packet, positive yaw rates turn right, but positive absolute yaw turns left.
        commander.send_setpoint(roll, pitch, yaw if level == Control.attitude else -yaw, thrust)

    def send_pose(self, frame: Frame, body: str) -> None:
        """Send the pose of a body, measured by motion capture, to the drone's estimator."""
        self._require_armed()
        if body not in frame.names:
            raise ConfigError(f"expected one of the bodies {list(frame.names)}, got {body!r}")
        k = frame.names.index(body)
        if np.isfinite(frame.pos[k]).all() and np.isfinite(frame.quat[k]).all():
            self._cf.loc.send_extpose(frame.pos[k], frame.quat[k])

    def sleep(self, seconds: float) -> None:
        """Wait for a time, s."""
        time.sleep(seconds)

    def stop(self) -> None:
        """Stop the motors; a link that is not armed sends nothing."""
        if self._sync_crazyflie is not None:
            self._cf.commander.send_stop_setpoint()

    def close(self) -> None:
        if self._sync_crazyflie is not None:
            self.stop()
            for config in self._log_configs:
                config.stop()
            self._sync_crazyflie.close_link()
            self._sync_crazyflie = None

    def _require_armed(self) -> None:
        require(
            self.armed, f"expected a link that is armed, got one to {self.name} that is not. Use Radio(..., arm=True)."
        )

    def _set_flight_mode(self, level: Control) -> None:
        if self._flight_mode != level:
            value = "1" if level == Control.attitude else "0"
            for axis in ("Roll", "Pitch", "Yaw"):
                self._cf.param.set_value(f"flightmode.stabMode{axis}", value)
            self._flight_mode = level

    def _receive_block(self, stamp: int, data: dict[str, float], config: Any) -> None:
        with self._lock:
            for part, names in LOG_VARIABLES.items():
                if names[0] in data:
                    x = np.array([data[name] for name in names])
                    if np.isfinite(x).all():
                        self._values[part], self._state_time = x, stamp / 1000
                        self._received_parts.add(part)
        if len(self._received_parts) == len(LOG_VARIABLES):
            self._state_arrived.set()
