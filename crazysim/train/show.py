"""Plots of learning curves and of episodes, and films of policies."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.envs.env import Env
from crazysim.envs.phases import select_states
from crazysim.envs.random import check_key
from crazysim.envs.rendering import view_of
from crazysim.envs.state import EnvState, Obs, terms_of
from crazysim.errors import not_installed
from crazysim.media import Film, View
from crazysim.plugins.sensors.image_sensor import COLORS
from crazysim.scene.software import film_size
from crazysim.sim.sim import Sim
from crazysim.sim.visualize import draw_text
from crazysim.storage import MAX_TEXT_BYTES, as_path, open_file, wrap_read_errors, write_figure
from crazysim.train.evaluation import crashed_drones, fly_episodes, held_out_key
from crazysim.train.interface import check_policy
from crazysim.train.networks import Policy
from crazysim.train.policies import act, as_tree, initial_memory
from crazysim.train.training import CURVE_FILE

DEPTH_COLORS = ((10, 8, 30), (90, 20, 110), (200, 60, 70), (250, 160, 40), (255, 250, 190))
"""Colours of depths from far to near, RGB."""
SUCCESS_LIMITS = (-2, 102)
"""Limits of axes with a success, %."""


def plot_curve(curves: dict[str, list[dict[str, float]]], path: Path, unit: str) -> None:
    """Plot success, error and reward terms in the evaluations of trainings.

    Args:
        curves: Contents of ``curve.json`` of each run, by the name of the run. Reward terms are plotted for the
            first run only.
        path: Image to write, such as a ``.png``.
        unit: Unit of the error, ``task.unit``.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    first_curve = next(iter(curves.values()))
    rewards = {**terms_of(first_curve[-1]), "sum": 0.0}
    figure, axes = _make_figure(3 + len(rewards))
    for name, curve in curves.items():
        steps = np.array([point["env_steps"] for point in curve]) / 1e6
        success = [100 * point["success"] for point in curve]
        axes[0].plot(steps, success, label=name)
        axes[1].plot([point["seconds"] for point in curve], success)
        axes[2].plot(steps, [point["error"] for point in curve], marker=".")  # there is no error if all drones crash
    _use_log_scale(axes[2])
    steps = np.array([point["env_steps"] for point in first_curve]) / 1e6
    for axis, name in zip(axes[3:], rewards, strict=True):
        axis.plot(steps, [terms_of(point).get(name, point["reward"]) for point in first_curve])
    labels = ("success, %", "success, %", f"mean error, {unit}", *(f"reward, {name}" for name in rewards))
    for axis, y in zip(axes, labels, strict=True):
        axis.set(xlabel="environment steps, millions", ylabel=y)
    axes[1].set_xlabel("time with compilation, s")
    for axis in axes[:2]:
        axis.set_ylim(SUCCESS_LIMITS)
    if len(curves) > 1:
        axes[0].legend()
    _save_figure(figure, path)


def plot_spread(groups: dict[str, list[list[dict[str, float]]]], path: Path, unit: str) -> None:
    """Plot median, quartiles and extremes of success, error and reward of several trainings over environment steps.

    Args:
        groups: Contents of ``curve.json`` of the trainings of each group, such as all seeds of one learning rate. The
            curve of a training that diverged ends earlier; it is included up to its end.
        path: Image to write, such as a ``.png``.
        unit: Unit of the error, ``task.unit``.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    figure, axes = _make_figure(3)
    for name, curves in groups.items():
        longest = max(curves, key=len)
        steps = np.array([point["env_steps"] for point in longest]) / 1e6
        for axis, metric in zip(axes, ("success", "error", "reward"), strict=True):
            values = np.full((len(curves), len(steps)), np.nan)
            for row, curve in zip(values, curves, strict=True):
                row[: len(curve)] = [point[metric] for point in curve]
            has_value = ~np.isnan(values).all(axis=0)
            if not has_value.any():  # if all drones crash in all evaluations, there is no mean error
                continue
            values, plotted_steps = values[:, has_value] * (100 if metric == "success" else 1), steps[has_value]
            minimum, quartile_1, median, quartile_3, maximum = np.nanquantile(values, (0, 0.25, 0.5, 0.75, 1), axis=0)
            (line,) = axis.plot(
                plotted_steps, median, label=f"{name}, {len(curves)} seeds" if metric == "success" else None
            )
            axis.fill_between(plotted_steps, quartile_1, quartile_3, color=line.get_color(), alpha=0.3, linewidth=0)
            axis.fill_between(plotted_steps, minimum, maximum, color=line.get_color(), alpha=0.12, linewidth=0)
    _use_log_scale(axes[1])
    for axis, label in zip(axes, ("success, %", f"mean error, {unit}", "reward in an episode"), strict=True):
        axis.set(xlabel="environment steps, millions", ylabel=label)
    axes[0].set_ylim(SUCCESS_LIMITS)
    axes[0].legend(fontsize="small")
    axes[0].set_title("median, quartiles and extremes", fontsize=9)
    _save_figure(figure, path)


def plot_search(values: dict[str, list[float]], success: list[float], best: int, path: Path) -> None:
    """Plot the success of all candidates of a search, %, over each of their settings.

    Args:
        values: Value of each candidate, by the name of the setting.
        success: Success of each candidate, %.
        best: Index of the candidate that was chosen, which gets a cross.
        path: Image to write, such as a ``.png``.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    figure, axes = _make_figure(len(values))
    for axis, (name, x) in zip(axes, values.items(), strict=True):
        axis.scatter(x, success, s=12)
        axis.plot(x[best], success[best], "rx")
        axis.set(xlabel=name, ylabel="success, %", ylim=SUCCESS_LIMITS)
        axis.locator_params(axis="x", nbins=4)
    _save_figure(figure, path)


def plot_episode(
    env: Env, policy: Callable[[Obs], Array], path: str | Path, key: Array | None = None
) -> dict[str, np.ndarray]:
    """Plot the mean reward terms and quantiles of the error over an episode in all worlds, and return the terms.

    Args:
        env: Environment without automatic resets; each world flies from one initial state.
        policy: Trained policy, or any function from observations to actions.
        path: Image to write, such as a ``.png``.
        key: Random key of the initial states; None for the held-out ones.

    Returns:
        Mean of each term at each step, by name; zero where an episode is over. (n_steps,) each

    Raises:
        ImportError: If matplotlib is not installed.
    """
    check_policy(policy, env)
    path, key = as_path(path), held_out_key() if key is None else key
    check_key(key)
    flight = jax.device_get(fly_episodes(env, as_tree(policy), key))
    terms, is_over = {name: x[:, 0] for name, x in flight["terms"].items()}, flight["over"]
    t = env.task.seconds * (1 + np.arange(len(is_over))) / len(is_over)
    end = t[min((~is_over).any(axis=-1).sum(), len(t) - 1)]
    rewards = {**terms, "sum": sum(terms.values())}
    figure, axes = _make_figure(1 + len(rewards))
    error = flight["error"].reshape(len(is_over), -1)
    axes[0].plot(t, np.nanquantile(error, (0.1, 0.5, 0.9), axis=1).T, label=["best tenth", "median", "worst tenth"])
    if "succeeded" not in flight:  # otherwise the tolerance does not decide
        axes[0].axhline(env.task.tolerance, color="grey", linestyle=":", label="tolerance")
    axes[0].legend(fontsize="small")
    for axis, x in zip(axes[1:], rewards.values(), strict=True):
        axis.plot(t, np.cumsum(x))
    for axis, y in zip(axes, (f"error, {env.task.unit}", *(f"reward until then, {k}" for k in rewards)), strict=True):
        axis.set(xlabel="time in the episode, s", ylabel=y, xlim=(0, end))
    has_succeeded = flight["succeeded"].all(axis=-1) if "succeeded" in flight else np.zeros_like(is_over[-1])
    figure.suptitle(
        f"{is_over.shape[1]:,} worlds: {(~is_over[-1]).mean():.1%} fly until the end, "
        + f"{has_succeeded.mean():.0%} succeed, " * ("succeeded" in flight)
        + f"{crashed_drones(env, flight).any(axis=-1).mean():.1%} crash",
        fontsize=9,
    )
    _save_figure(figure, path)
    return terms


def _use_log_scale(axis: Any) -> None:
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in axis.lines] or [np.zeros(0)])
    values = values[np.isfinite(values)]
    if len(values) and (values > 0).all():
        axis.set_yscale("log")
    elif not len(values):
        axis.text(0.5, 0.5, "all drones crashed", ha="center", transform=axis.transAxes)


def _make_figure(n: int) -> Any:
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError(not_installed("plots need", "matplotlib", "train")) from error
    n_rows = -(-n // 5)
    n_columns = -(-n // n_rows)
    size = (4 * n_columns, 3.5 * n_rows)
    figure, grid = plt.subplots(n_rows, n_columns, figsize=size, constrained_layout=True, squeeze=False)
    for axis in grid.flat[n:]:
        axis.remove()
    axes = grid.flatten()[:n]
    for axis in axes:
        axis.grid(alpha=0.3)
    return figure, axes


def _save_figure(figure: Any, path: Path) -> None:
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    write_figure(figure, path, dpi=110)
    plt.close(figure)


def read_curve(folder: Path) -> list[dict[str, float]]:
    """Return the learning curve of a run, one point per evaluation.

    Raises:
        ConfigError: If the file does not exist.
        DamagedFileError: If it is damaged.
    """
    path = as_path(folder) / CURVE_FILE
    remedy = "Write it again with 'crazysim train TASK --resume'."
    with wrap_read_errors(path, "a learning curve", remedy), open_file(path, MAX_TEXT_BYTES) as file:
        return [dict(point) for point in json.load(file)]


def color_depth(depth: np.ndarray, far: float) -> np.ndarray:
    """Return a depth image in colours, from black at the largest depth over red to pale yellow at the lens.

    Args:
        depth: Depths, m. (height, width)
        far: Largest depth, m.

    Returns:
        (height, width, 3), uint8
    """
    nearness = np.clip((1 / (1 + depth) - 1 / (1 + far)) / (1 - 1 / (1 + far)), 0, 1)
    channels = [np.interp(np.sqrt(nearness), np.linspace(0, 1, len(x)), x) for x in zip(*DEPTH_COLORS, strict=True)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def film(env: Env, policy: Policy, path: str | Path, worlds: int = 4, seed: int = 1, progress: bool = False) -> int:
    """Film one episode of a policy in several worlds side by side, and return the number of frames.

    A world whose episode is over stands still from then on, and its text says how it ended: ``success``, ``crashed``
    or, at the time limit, ``late``, or how many drones succeeded. The film ends a second after the last of them. Drones
    that would be smaller than 25 pixels have a ring of that width.

    If the policy observes images, the first depth image of the first drone, or else its first segmentation of the
    target or colours, is drawn into each world. Near pixels, or pixels of the target, are bright. Worlds with obstacles
    then also show a map from above.

    Args:
        path: Film to write, ``.mp4`` or ``.gif``.
        worlds: Number of worlds in the film.
        seed: Seed of the initial states.

    Raises:
        ImportError: If imageio-ffmpeg is not installed.
        RenderError: If this machine cannot render.
    """
    check_policy(policy, env)
    sim, freq = env.sim, env.base.freq
    frame_steps = max(freq // 25, 1)

    formats = env.image_formats()
    depths = [name for name, x in formats.items() if x["unit"] == "m"]
    masks = [name for name, x in formats.items() if x["unit"] == "1" and x.get("output") == "segmentation"]
    colors = [name for name, x in formats.items() if x.get("output") in COLORS]

    def draw_image(_: Sim, world: int) -> np.ndarray | None:
        for name in depths + masks + colors:
            image = formats[name]
            pixels = np.asarray(state.obs[name][world, 0]).reshape(image["height"], image["width"], -1)
            if name in colors:
                return (255 * np.broadcast_to(pixels, (*pixels.shape[:2], 3))).round().astype(np.uint8)
            pixels = pixels[..., 0]
            return color_depth(pixels, image["far"]) if name in depths else color_depth(1 - pixels, 1.0)
        return None

    find_success = jax.jit(env.succeeded)

    @jax.jit
    def step(state: EnvState, memory: Any) -> tuple[EnvState, Any]:
        action, memory = act(policy, state.obs, memory)
        return select_states(~state.done, env.step(state, action), state), memory

    def find_outcome(world: int) -> str:
        if not state.done[world]:
            return ""
        succeeded, is_terminated = find_success(state), bool(state.terminated[world])
        if succeeded is not None and 0 < (n := int(succeeded[world].sum())) < sim.n_drones:
            return f": {n} of {sim.n_drones} succeeded"
        has_succeeded = n_steady_steps[world] >= n_hold_steps and not is_terminated
        if has_succeeded if succeeded is None else bool(succeeded[world].all()):
            return ": success"
        return ": crashed" if is_terminated else ": late"

    def draw_time(sim: Sim, world: int) -> None:
        draw_text(sim, f"{int(state.data.core.steps[world, 0]) / sim.freq:.1f} s{find_outcome(world)}")

    state, memory = jax.jit(env.reset)(jax.random.key(seed)), initial_memory(policy, env)
    n_shown = min(worlds, sim.n_worlds)
    # Steps for which the error of all drones has been below the tolerance, and those that a success takes.
    n_steady_steps = np.zeros(sim.n_worlds, int)
    n_hold_steps = max(round(env.task.hold * env.max_steps / env.task.seconds), 1)
    rows, columns = View(worlds=range(n_shown)).grid
    width, height = film_size(960, 2 * round(360 * rows / columns))  # 4:3 for each world
    view = view_of(
        env,
        lambda: state,
        worlds=range(n_shown),
        width=width,
        height=height,
        trail=1.5,
        lag=0.6,
        draw=draw_time,
        inset=draw_image,
        top_view=bool(depths + masks + colors),
    )
    n_frames = (env.max_steps + freq) // frame_steps + 1
    with Film(path, view, fps=freq / frame_steps, progress=progress, total=n_frames) as recording:
        last_step = env.max_steps + freq
        for i in range(last_step + 1):
            if i % frame_steps == 0:
                core = state.data.core
                steps = jnp.full_like(core.steps, i * (sim.freq // freq))  # the clock of the film does not stand still
                sim.data = state.data.replace(core=core.replace(steps=steps))
                recording.add(sim)
                if state.done[:n_shown].all():
                    last_step = min(last_step, i + freq)
            if i >= last_step:
                break
            was_over = np.asarray(state.done)
            state, memory = step(state, memory)
            is_steady = (np.asarray(state.info["error"]) < env.task.tolerance).all(axis=-1)
            n_steady_steps = np.where(was_over, n_steady_steps, np.where(is_steady, n_steady_steps + 1, 0))
        sim.data = state.data
        return recording.n_frames
