"""What training gave, to be looked at: a learning curve, and a film of the policy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from crazysim.envs.env import DroneEnv
from crazysim.media import Film, View
from crazysim.sim.sim import Sim
from crazysim.sim.visualize import draw_points
from crazysim.train.networks import Policy

TARGET_COLOR = (0.1, 0.8, 0.3, 0.6)
"""Of the place where a drone is to be."""


def plot_curve(curves: dict[str, Any], path: Path) -> None:
    """Write a picture of success and error over environment steps and over seconds.

    Args:
        curves: By name, what ``curve.json`` of a run holds.
        path: A ``.png``.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError("a learning curve needs matplotlib; pip install 'crazysim[train]'") from error
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.5), constrained_layout=True)
    for name, curve in curves.items():
        steps = np.array([p["env_steps"] for p in curve]) / 1e6
        seconds = [p["seconds"] for p in curve]
        success = [100 * p["success"] for p in curve]
        axes[0].plot(steps, success, label=name)
        axes[1].plot(seconds, success)
        axes[2].semilogy(steps, [p["error"] for p in curve])
    for axis, x, y in zip(
        axes,
        ("environment steps, millions", "time with compilation, s", "environment steps, millions"),
        ("success, %", "success, %", "mean error"),
        strict=True,
    ):
        axis.set(xlabel=x, ylabel=y)
        axis.grid(alpha=0.3)
    if len(curves) > 1:
        axes[0].legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def read_curve(folder: Path) -> Any:
    """Return the learning curve of a run."""
    return json.loads((folder / "curve.json").read_text())


def film(
    env: DroneEnv, policy: Policy, path: str | Path, worlds: int = 4, seed: int = 1, progress: bool = False
) -> int:
    """Film one episode of a policy in some worlds side by side; return the number of frames.

    Args:
        env: The environment.
        policy: Observations to actions.
        path: An ``.mp4`` or a ``.gif``.
        worlds: How many worlds are seen.
        seed: Of the starts.
        progress: Whether to show a bar.

    Raises:
        ImportError: If imageio-ffmpeg is not installed.
        RenderError: If this machine cannot draw.
    """
    sim, rate = env.sim, env.freq
    skip = max(rate // 25, 1)

    def mark(sim: Sim, world: int) -> None:
        target = targets(state)
        if target is not None:
            draw_points(sim, np.asarray(target[world]), TARGET_COLOR, 0.04)

    targets = jax.jit(env.target)
    step = jax.jit(lambda state: env.step(state, policy(state.obs)))
    state = jax.jit(env.reset)(jax.random.key(seed))
    view = View(
        worlds=range(min(worlds, sim.n_worlds)), width=960, height=720, trail=1.5, text="{time:.1f} s", draw=mark,
        cam_config=env.task.camera(sim.n_drones),
    )  # fmt: skip
    n_frames = env.max_steps // skip + 1
    with Film(path, view, fps=rate / skip, progress=progress, total=n_frames) as recording:
        for i in range(env.max_steps + 1):
            if i % skip == 0:
                sim.data = state.data
                recording.add(sim)
            state = step(state)
        return recording.n_frames
