"""Drones and clock of Crazyswarm2 scripts, in simulation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.errors import ConfigError
from crazysim.lab.live.attitude import from_yaw
from crazysim.lab.live.crazyflie_py.uav_trajectory import Trajectory
from crazysim.lab.live.swarm import Commander, Swarm
from crazysim.lab.live.swarm.parameters import LED_SOLID
from crazysim.lab.live.swarm.sensors import read_battery


class TimeHelper:
    """Simulated time of a script."""

    def __init__(self, node: Swarm):
        self.node = node
        self.rateHz: float | None = None
        self.nextTime: float | None = None

    def time(self) -> float:
        """Return the time, s."""
        return self.node.time

    def sleep(self, duration: float) -> None:
        """Wait for a time, s."""
        self.node.sleep(duration)

    def sleepForRate(self, rateHz: float) -> None:
        """Wait until the next iteration of a loop that runs at a rate, Hz."""
        if self.nextTime is None or self.rateHz != rateHz:
            self.rateHz, self.nextTime = rateHz, self.time() + 1 / rateHz
        self.sleep(max(self.nextTime - self.time(), 0.0))
        self.nextTime += 1 / rateHz

    def isShutdown(self) -> bool:
        """Return False: simulated time does not end."""
        return False


class Crazyflie:
    """One drone."""

    def __init__(self, swarm: Swarm, name: str):
        self._swarm, self._index = swarm, swarm.index(name)
        self.prefix, self.uri = f"/{name}", f"sim://{name}"
        self.initialPosition = swarm.home(name)
        self.status: dict[str, Any] = {}

    @property
    def _commander(self) -> Commander:
        return self._swarm.commanders[self._index]

    def setGroupMask(self, groupMask: int) -> None:
        """Make the drone a member of the groups whose bits are set."""
        self._commander.group = int(groupMask)

    def emergency(self) -> None:
        """Stop the motors, and refuse all commands."""
        self._run_command(lambda c: c.emergency())

    def takeoff(self, targetHeight: float, duration: float, groupMask: int = 0) -> None:
        """Rise to a height, m, within a time, s."""
        self._run_command(lambda c: c.take_off(targetHeight, duration), groupMask)

    def land(self, targetHeight: float, duration: float, groupMask: int = 0) -> None:
        """Descend to a height, m, within a time, s, and stop the motors."""
        self._run_command(lambda c: c.land(targetHeight, duration), groupMask)

    def goTo(self, goal: ArrayLike, yaw: float, duration: float, relative: bool = False, groupMask: int = 0) -> None:
        """Move to a position, m, and yaw, rad, within a time, s."""
        self._run_command(lambda c: c.go_to(goal, yaw, duration, relative), groupMask)

    def uploadTrajectory(self, trajectoryId: int, pieceOffset: int, trajectory: Trajectory) -> None:
        """Store a trajectory; the offset is ignored, since each trajectory is stored under its number."""
        self._run_command(lambda c: c.upload(trajectoryId, trajectory.host_trajectory()))

    def startTrajectory(
        self,
        trajectoryId: int,
        timescale: float = 1.0,
        reverse: bool = False,
        relative: bool = True,
        groupMask: int = 0,
    ) -> None:
        """Follow a stored trajectory, stretched by ``timescale``, from the present setpoint if relative."""
        self._run_command(lambda c: c.start_trajectory(trajectoryId, timescale, relative, reverse), groupMask)

    def notifySetpointsStop(self, remainValidMillisecs: float = 100, groupMask: int = 0) -> None:
        """Return from streamed setpoints to high-level commands after a time, ms."""
        self._run_command(lambda c: c.notify_setpoints_stop(remainValidMillisecs / 1000), groupMask)

    def arm(self, arm: bool = True) -> None:
        """Arm or disarm."""
        self._commander.arm(arm)

    def cmdFullState(self, pos: ArrayLike, vel: ArrayLike, acc: ArrayLike, yaw: float, omega: ArrayLike) -> None:
        """Stream a state: position, m, velocity, m/s, acceleration, m/s^2, yaw, rad, body rates, rad/s."""
        self._run_command(lambda c: c.full_state(pos, vel, acc, from_yaw(float(yaw)), omega))

    def cmdPosition(self, pos: ArrayLike, yaw: float = 0.0) -> None:
        """Stream a position, m, and yaw, rad."""
        self._run_command(lambda c: c.position(pos, yaw))

    def cmdVelocityWorld(self, vel: ArrayLike, yawRate: float) -> None:
        """Stream a velocity, world frame, m/s, and yaw rate, degrees/s."""
        self._run_command(lambda c: c.velocity(vel, float(np.deg2rad(yawRate))))

    def cmdHover(self, vx: float, vy: float, yaw_rate: float, z_distance: float) -> None:
        """Stream a horizontal velocity in the axes of the drone's yaw, m/s, yaw rate, rad/s, and height, m."""
        self._run_command(lambda c: c.hover(vx, vy, yaw_rate, z_distance))

    def setLEDColor(self, r: float, g: float, b: float) -> None:
        """Set the colour of the LEDs, 0 to 1, and choose the solid-colour effect by ``ring.effect``."""
        self.setParam("ring.effect", LED_SOLID)
        for color, value in zip(("Red", "Green", "Blue"), np.clip([r, g, b], 0.0, 1.0).tolist(), strict=True):
            self.setParam(f"ring.solid{color}", int(255 * value))

    def getParam(self, name: str) -> float:
        """Return a parameter."""
        return self._swarm.parameters[self._index].get_value(name)

    def setParam(self, name: str, value: float) -> None:
        """Set a parameter; a parameter that the simulation lacks or does not simulate is reported."""
        self._run_command(lambda _: self._swarm.set_parameter(self._index, name, value))

    def position(self) -> NDArray:
        """Return the position, m. (3,)"""
        return self._swarm.state(self._index).pos.copy()

    def get_position(self) -> list[float]:
        """Return the position, m, as a list."""
        return self.position().tolist()

    def get_pose(self) -> dict[str, NDArray]:
        """Return position, m, and attitude, xyzw, as arrays."""
        state = self._swarm.state(self._index)
        return {"position": state.pos.copy(), "orientation": state.quat.copy()}

    def get_status(self) -> dict[str, Any]:
        """Return name, time, supervisor bits, battery voltage, V, battery state, signal strength and packet counts.

        The battery's values are those of the plugin ``Battery``; without it the battery is never empty. There is no
        radio: the signal is perfect, and no packets are counted.
        """
        now, c = self._swarm.time, self._commander
        supervisor = (0 if c.locked else 1) | c.armed << 1 | c.armed << 3 | c.motors_on << 4 | c.locked << 6
        seconds, battery = int(now), read_battery(self._swarm.sim, self._index)
        return {
            "id": self.prefix[1:],
            "timestamp_sec": seconds,
            "timestamp_nsec": round((now - seconds) * 1e9),
            "supervisor": supervisor,
            "battery": battery.voltage,
            "pm_state": battery.state,
            "rssi": 0,
            **dict.fromkeys(("num_rx_broadcast", "num_tx_broadcast", "num_rx_unicast", "num_tx_unicast"), 0),
        }

    def _run_command(self, command: Callable[[Commander], object], group: int = 0) -> None:
        with self._swarm.lock:
            if not self._commander.in_group(group):
                return
            try:
                command(self._commander)
            except ConfigError as error:
                self._swarm.reports.add("refused", self.prefix[1:], self._swarm.time, str(error))


class CrazyflieServer:
    """All drones of a swarm, and commands to all of them."""

    crazyflies: list[Crazyflie]
    """Drones, in the order of the swarm."""
    crazyfliesByName: dict[str, Crazyflie]
    """Drones by name."""
    crazyfliesById: dict[int, Crazyflie]
    """Drones by the number at the end of their names; a name without a number gets its position from 1 on."""

    def __init__(self, swarm: Swarm):
        self._swarm = swarm
        self.crazyflies = [Crazyflie(swarm, name) for name in swarm.names]
        self.crazyfliesByName = {cf.prefix[1:]: cf for cf in self.crazyflies}
        self.crazyfliesById = {
            _id_from_name(name, k + 1): cf for k, (name, cf) in enumerate(self.crazyfliesByName.items())
        }

    def emergency(self) -> None:
        """Stop all motors, and refuse all commands."""
        self._call_all(lambda cf: cf.emergency())

    def takeoff(self, targetHeight: float, duration: float, groupMask: int = 0) -> None:
        """Make all drones rise to a height, m, within a time, s."""
        self._call_all(lambda cf: cf.takeoff(targetHeight, duration, groupMask))

    def land(self, targetHeight: float, duration: float, groupMask: int = 0) -> None:
        """Make all drones descend to a height, m, within a time, s, and stop their motors."""
        self._call_all(lambda cf: cf.land(targetHeight, duration, groupMask))

    def goTo(self, goal: ArrayLike, yaw: float, duration: float, groupMask: int = 0) -> None:
        """Move all drones by an offset, m, and turn them by an angle, rad, within a time, s."""
        self._call_all(lambda cf: cf.goTo(goal, yaw, duration, True, groupMask))

    def startTrajectory(
        self,
        trajectoryId: int,
        timescale: float = 1.0,
        reverse: bool = False,
        relative: bool = True,
        groupMask: int = 0,
    ) -> None:
        """Start the trajectory that each drone has stored under a number."""
        self._call_all(lambda cf: cf.startTrajectory(trajectoryId, timescale, reverse, relative, groupMask))

    def arm(self, arm: bool = True) -> None:
        """Arm or disarm all drones."""
        self._call_all(lambda cf: cf.arm(arm))

    def setParam(self, name: str, value: float) -> None:
        """Set a parameter of all drones."""
        self._call_all(lambda cf: cf.setParam(name, value))

    def cmdFullState(self, pos: ArrayLike, vel: ArrayLike, acc: ArrayLike, yaw: float, omega: ArrayLike) -> None:
        """Stream the same state to all drones."""
        self._call_all(lambda cf: cf.cmdFullState(pos, vel, acc, yaw, omega))

    def _call_all(self, function: Callable[[Crazyflie], object]) -> None:
        with self._swarm.lock:
            for cf in self.crazyflies:
                function(cf)


def _id_from_name(name: str, default: int) -> int:
    digits = name[len(name.rstrip("0123456789")) :]
    return int(digits) if digits else default
