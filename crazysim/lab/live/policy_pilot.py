"""Trained policies in the live loop, which fly to goals that are typed, clicked or listed in a file."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from crazysim.core.data import SimData
from crazysim.envs.env import Env
from crazysim.envs.phases import vectorize_over_worlds
from crazysim.envs.state import Obs, state_of_data
from crazysim.envs.task import Task
from crazysim.envs.tasks.goals import FLOOR, GoalTask
from crazysim.errors import ConfigError, require
from crazysim.lab.live.loop import Live
from crazysim.storage import MAX_TEXT_BYTES, read_text
from crazysim.train.interface import check_policy
from crazysim.train.policies import act, initial_memory

ARRIVAL_DISTANCE = 0.15
"""Distance from a listed goal at which a drone continues to the next one, m."""
MIN_HEIGHT = 0.5
"""Least height of a clicked goal, m."""


class PolicyPilot:
    """Process that flies all drones with a policy, in the simulation of an environment.

        env = config.make_env(1)
        pilot = PolicyPilot(env, policy)
        live = Live(env.sim, env.base.freq)
        pilot.add_to(live)

    The loop starts with the first episode of the environment. The episode does not end: a drone that crashes stays
    down until the loop is reset. A policy of a task without goals flies too, but its pilot refuses goals.
    """

    def __init__(self, env: Env, policy: Callable[[Obs], Array], points: ArrayLike | None = None, seed: int = 0):
        check_policy(policy, env)
        self.env = env
        self._points = None if points is None else np.asarray(points, float)
        require(
            self._points is None or len(self._points),
            "expected at least one point, got none. Use points=None for the goal of the task.",
        )
        self._set_goal_fn = jax.jit(lambda data, pos: env.set_goal(state_of_data(data), pos).data)
        self._command_fn = jax.jit(partial(_compute_command, env, policy))
        self._memory = self._initial_memory = initial_memory(policy, env)
        self._target_fn = jax.jit(vectorize_over_worlds(env.task.target, env.task.batched))
        self._start_data = jax.jit(env.reset)(jax.random.key(seed)).data
        shape = self._start_data.states.pos.shape
        self.goals = np.full(shape, np.nan)
        """Goals of the drones, world frame, m; NaN if the task has none. (n_worlds, n_drones, 3)"""
        self.n_passed = np.zeros(shape[:2], int)
        """Number of listed points that each drone has passed. (n_worlds, n_drones)"""
        self._follows_points = np.full(shape[:2], self._points is not None)
        if type(env.task).set_goal is not Task.set_goal:
            self.goals[:] = self._target_fn(self._start_data)
        if self._points is not None:
            for i, point in enumerate(self._points):
                self._check_goal(point, f"point {i + 1}: ")
            self.goals[:] = self._points[0]
            self._start_data = self._set_goal_fn(self._start_data, self.goals)
        env.sim.data = self._start_data

    def add_to(self, live: Live) -> None:
        """Fly in a loop from now on; clicks set goals, and viewers mark them."""
        require(
            live.control_freq == self.env.base.freq,
            f"expected a loop at the rate of the environment, {self.env.base.freq} Hz, got {live.control_freq} Hz. "
            f"Use Live(env.sim, env.base.freq).",
        )
        live.add(self, name="policy")
        live.on_click, live.goals = self.click, self.goals

    def compile(self, live: Live) -> None:
        """Compile the policy for the data of the loop and for a memory that the policy has returned."""
        _, memory = self._command_fn(live.sim.data, self._memory)
        self._command_fn(live.sim.data, memory)

    def __call__(self, live: Live) -> None:
        if self._points is not None:
            self._pass_points(live)
        live.command[:], self._memory = self._command_fn(live.sim.data, self._memory)

    def reset(self, live: Live) -> None:
        """Restart the episode after a reset, or restore the goals after a jump back in time.

        The memory of the policy is reset in both cases.
        """
        self._memory = self._initial_memory
        if live.step == 0:
            live.sim.data = self._start_data
        if np.isfinite(self.goals).all():
            self.goals[:] = self._target_fn(live.sim.data)
        if self._points is not None:  # the goals of that time show how many points had been passed
            is_goal = np.isclose(self.goals[..., None, :], self._points, atol=1e-5).all(axis=-1)
            self._follows_points[:], self.n_passed[:] = is_goal.any(axis=-1), is_goal.argmax(axis=-1)

    def go_to(self, live: Live, pos: ArrayLike) -> None:
        """Set the goal of the selected drone, which then no longer follows the listed points.

        Args:
            pos: Goal, world frame, m. (3,)
        """
        require(live.selected is not None, "expected a selected drone, got none. Click on one, or press tab.")
        pos = np.asarray(pos, float)
        self._check_goal(pos)
        self._follows_points[live.selected] = False
        self.goals[live.selected] = pos
        live.sim.data = self._set_goal_fn(live.sim.data, self.goals)

    def click(self, live: Live, world: int, point: ArrayLike) -> None:
        """Set the goal of the selected drone, if it is in that world, above a point on the ground, m. (3,)"""
        if live.selected is not None and live.selected[0] == world:
            x, y, _ = np.asarray(point, float)
            self.go_to(live, [x, y, max(self.goals[live.selected][2], MIN_HEIGHT)])

    def listen(self, live: Live, lines: Iterable[str]) -> threading.Thread:
        """Read goals of the selected drone from lines, such as ``0.5 0 1.2``, in a thread, and return the thread.

        Lines that are not goals are logged and change nothing.
        """

        def read() -> None:
            for line in lines:
                if line.strip():
                    live.post(partial(self._go_to_text, text=line))

        thread = threading.Thread(target=read, name="typed goals", daemon=True)
        thread.start()
        return thread

    @property
    def arena(self) -> str:
        """Arena in which goals may lie, in words; empty if the task has none."""
        task = self.env.task
        if not isinstance(task, GoalTask):
            return ""
        return f"x and y from {-task.half_width:g} to {task.half_width:g} m, z from {FLOOR:g} to {task.height:g} m"

    def _go_to_text(self, live: Live, text: str) -> None:
        self.go_to(live, parse_point(text))

    def _check_goal(self, pos: NDArray, prefix: str = "") -> None:
        task = self.env.task
        require(
            type(task).set_goal is not Task.set_goal,
            f"{prefix}expected a policy whose goals are positions, got one of {task.name!r}. Use a policy of hover.",
        )
        high = np.array([task.half_width] * 2 + [task.height]) if isinstance(task, GoalTask) else np.full(3, np.inf)
        low = np.append(-high[:2], FLOOR if self.arena else -np.inf)
        if pos.shape != (3,) or not np.isfinite(pos).all() or not ((low <= pos) & (pos <= high)).all():
            arena_text = f" within the arena of {task.name!r}, {self.arena}" if self.arena else ""
            raise ConfigError(f"{prefix}expected x y z, m,{arena_text}, got {' '.join(f'{x:g}' for x in pos.ravel())}")

    def _pass_points(self, live: Live) -> None:
        points: Any = self._points
        distance = np.linalg.norm(self.goals - np.asarray(live.sim.data.states.pos), axis=-1)
        is_near = self._follows_points & (distance < ARRIVAL_DISTANCE) & (self.n_passed < len(points))
        if is_near.any():
            self.n_passed += is_near
            has_next = is_near & (self.n_passed < len(points))
            self.goals[has_next] = points[self.n_passed[has_next]]
            live.sim.data = self._set_goal_fn(live.sim.data, self.goals)


def typed_lines() -> Iterator[str]:
    """Yield the lines of the standard input; for use in a thread."""
    # A daemon thread that waits in sys.stdin holds its lock when Python ends, which Python reports as a fatal error.
    with contextlib.suppress(OSError), open(0, closefd=False) as lines:
        yield from lines


def parse_point(text: str, prefix: str = "") -> NDArray:
    """Return a point that is written as three numbers, m, separated by spaces or commas. (3,)

    Args:
        text: The numbers.
        prefix: Beginning of the error message.
    """
    try:
        point = np.array([float(x) for x in re.split(r"[,;\s]+", text.strip())])
    except ValueError:
        point = np.zeros(0)
    if point.shape != (3,):
        raise ConfigError(f"{prefix}expected x y z, m, got {text.strip()[:60]!r}. Write for example 0.5 0 1.2.")
    return point


def read_points(path: str | Path) -> NDArray:
    """Return the points in a text file: three numbers a line, m, with spaces or commas; # begins a comment. (n, 3)

    Raises:
        ConfigError: If the file does not exist, or a line is not a point.
    """
    points = []
    for number, line in enumerate(read_text(path, MAX_TEXT_BYTES).splitlines(), 1):
        if text := line.partition("#")[0].strip():
            points.append(parse_point(text, f"{path}, line {number}: "))
    require(points, f"expected points in {path}, got none. Write x,y,z in each line, m.")
    return np.array(points)


def _compute_command(env: Env, policy: Callable[[Obs], Array], data: SimData, memory: Any) -> tuple[Array, Any]:
    measure = env.base.measure_states
    measured_data = data if measure is None else vectorize_over_worlds(measure, env.task.batched)(data)
    obs = vectorize_over_worlds(env.task.observe, env.task.batched)(measured_data)
    for wrapper in env.wrappers:
        obs |= wrapper.look(state_of_data(data)).record.images
    action, memory = act(policy, obs, memory)
    return env.actions.command(action), memory
