"""Links to drones, simulated and real, that accept the same commands and return the same states."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.control import Control
from crazysim.errors import require
from crazysim.lab.live.attitude import rotate
from crazysim.lab.live.swarm import DroneState, Swarm
from crazysim.tables import read_numbers
from crazysim.train.interface import Interface


class Link(Protocol):
    """Commands to one drone, and its state."""

    name: str
    """Name of the drone."""

    def command(self, level: Control | str, values: ArrayLike) -> None:
        """Send a command to the drone: the array that ``sim.state_control``, ... take for one drone. (k,)"""
        ...

    def state(self) -> DroneState:
        """Return the latest state."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait for a time, s: simulated time for a simulated drone."""
        ...

    def stop(self) -> None:
        """Stop the motors."""
        ...


class SimLink:
    """Link to a drone of a swarm."""

    def __init__(self, swarm: Swarm, drone: int | str = 0):
        self.swarm = swarm
        self.drone = swarm.index(drone) if isinstance(drone, str) else drone
        self.name = swarm.names[self.drone]

    def command(self, level: Control | str, values: ArrayLike) -> None:
        """Send a command to the drone."""
        with self.swarm.lock:
            self.swarm.commanders[self.drone].command(level, values)

    def state(self) -> DroneState:
        """Return the state after the last control step."""
        return self.swarm.state(self.drone)

    def sleep(self, seconds: float) -> None:
        """Advance by a simulated time, s."""
        self.swarm.sleep(seconds)

    def stop(self) -> None:
        """Stop the motors."""
        with self.swarm.lock:
            self.swarm.commanders[self.drone].stop()


def fly_policy(
    link: Link,
    policy: Callable[[DroneState], ArrayLike],
    seconds: float,
    freq: float,
    level: Control | str = Control.attitude,
) -> list[DroneState]:
    """Fly a policy over a link, and return the states that it acted on.

    Any exception, including Ctrl-C, stops the motors. After the last command the motors keep running.

    Args:
        link: Link to a simulated or a real drone.
        policy: Function of the state that returns a command of the level. (k,)
        freq: Commands per second, Hz.
    """
    if isinstance(policy, TrainedPolicy):
        policy.require_commands(Control(level).value, freq)
    states = []
    try:
        for _ in range(round(seconds * freq)):
            start_time = time.perf_counter()
            states.append(link.state())
            link.command(level, policy(states[-1]))
            elapsed = 0.0 if isinstance(link, SimLink) else time.perf_counter() - start_time
            link.sleep(max(1 / freq - elapsed, 0.0))
    except BaseException:
        link.stop()
        raise
    return states


class TrainedPolicy:
    """A trained policy as a function of the state of a drone, for ``fly_policy``.

    ``crazysim.train.load_policy`` returns the policy and its ``meta``; ``meta["actions"]["level"]`` is the command
    level. The memory of a recurrent policy is kept between calls; call ``reset`` before a new flight.
    """

    def __init__(
        self, policy: Callable[[dict[str, NDArray]], ArrayLike], meta: Mapping[str, Any], goal: ArrayLike = (0, 0, 1)
    ):
        self.policy, self.interface = policy, Interface.read(meta)
        self.goal: NDArray = read_numbers("goal", goal, shapes=((3,),), remedy="Use [x, y, z], m")
        if getattr(policy, "interface", None) is not None:
            policy.interface.require(self.interface, "a description")  # type: ignore[attr-defined]
        self.reset()
        self._names = list(self.interface.sizes)
        self._centre, self._scale = (np.asarray(meta["actions"][key], float) for key in ("centre", "scale"))
        unknown_names = sorted(set(self._names) - set(self._compute_observations(_rest_state())))
        require(
            not unknown_names,
            f"expected observations of a drone's state, got {', '.join(unknown_names)}. Use a policy without them.",
        )

    def require_commands(self, level: str, freq: float) -> None:
        """Check that a flight has the command level and the rate of the training, if they are known."""
        require(
            (level, freq) == (self.interface.level, self.interface.freq or freq),
            f"expected {self.interface.level} commands at {self.interface.freq or freq} Hz, as in the policy's "
            f"training, got {level} commands at {freq} Hz. Use fly_policy(..., freq=meta['freq'], "
            f"level=meta['actions']['level']).",
        )

    def reset(self) -> None:
        """Restore the initial memory of a recurrent policy, before a new flight."""
        has_memory = getattr(self.policy, "has_memory", False)
        self._memory: Any = self.policy.initial_memory() if has_memory else None  # type: ignore[attr-defined]

    def __call__(self, state: DroneState) -> NDArray:
        observations = self._compute_observations(state)
        obs = {name: observations[name].astype(np.float32) for name in self._names}
        if self._memory is None:
            action = self.policy(obs)
        else:
            action, self._memory = self.policy.act(obs, self._memory)  # type: ignore[attr-defined]
        return self._centre + self._scale * np.clip(np.asarray(action, float), -1.0, 1.0)

    def _compute_observations(self, state: DroneState) -> dict[str, NDArray]:
        rotation_matrix = rotate(np.tile(state.quat, (3, 1)), np.eye(3)).T
        return {
            "pos": state.pos,
            "rot": rotation_matrix.reshape(9),
            "quat": state.quat,
            "vel": state.vel,
            "ang_vel": state.ang_vel,
            "difference_to_goal": self.goal - state.pos,
        }


def _rest_state() -> DroneState:
    return DroneState(0.0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), np.zeros(3))
