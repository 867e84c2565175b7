"""Plots of learning curves, and films of policies."""

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
"""Colour of the target of a drone, RGBA."""


def plot_curve(curves: dict[str, Any], path: Path) -> None:
    """Plot success and error over environment steps and over time.

    Args:
        curves: Contents of ``curve.json`` of each run, by the name of the run.
        path: Image to write, such as a ``.png``.

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
    """Return the learning curve of a run, one point per evaluation."""
    return json.loads((folder / "curve.json").read_text())


def film(
    env: DroneEnv, policy: Policy, path: str | Path, worlds: int = 4, seed: int = 1, progress: bool = False
) -> int:
    """Film one episode of a policy in several worlds side by side, and return the number of frames.

    Args:
        env: Environment to fly in.
        policy: Policy to fly.
        path: Film to write, ``.mp4`` or ``.gif``.
        worlds: Number of worlds in the film.
        seed: Seed of the initial states.
        progress: True to show a progress bar.

    Raises:
        ImportError: If imageio-ffmpeg is not installed.
        RenderError: If this machine cannot render.
    """
    sim, rate = env.sim, env.freq
    skip = max(rate // 25, 1)

    def draw_target(sim: Sim, world: int) -> None:
        target = targets(state)
        if target is not None:
            draw_points(sim, np.asarray(target[world]), TARGET_COLOR, 0.04)

    targets = jax.jit(env.target)
    step = jax.jit(lambda state: env.step(state, policy(state.obs)))
    state = jax.jit(env.reset)(jax.random.key(seed))
    view = View(
        worlds=range(min(worlds, sim.n_worlds)),
        width=960,
        height=720,
        trail=1.5,
        text="{time:.1f} s",
        draw=draw_target,
        cam_config=env.task.camera(sim.n_drones),
    )
    n_frames = env.max_steps // skip + 1
    with Film(path, view, fps=rate / skip, progress=progress, total=n_frames) as recording:
        for i in range(env.max_steps + 1):
            if i % skip == 0:
                sim.data = state.data
                recording.add(sim)
            state = step(state)
        return recording.n_frames
