"""What is wrong with a task, before minutes of training are lost: flights without training, and ten iterations."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.envs.state import Obs
from crazysim.envs.task import Task
from crazysim.train.config import TrainConfig
from crazysim.train.evaluation import TERM_PREFIX, describe_outcome, evaluate
from crazysim.train.runs import run
from crazysim.train.show import read_curve

N_WORLDS, ITERATIONS = 256, 10
"""Worlds of the flights, and iterations of the training."""
HOVER, RANDOM, DEMONSTRATION = "hovering", "random actions", "the demonstration"
"""Names of the flights."""

Metrics = Mapping[str, Mapping[str, float]]
"""Metrics of ``evaluate`` by the name of the flight."""


def check_task(task: str | Task, log: Callable[[str], None] = print, **settings: Any) -> list[str]:
    """Fly a task with zero actions, with random ones and by hand, train it for ten iterations, and say what is wrong.

    Args:
        task: As for ``run``. Its class may define ``demonstrate(obs)``, a function from observations to actions.
        log: Function that is called with each line.
        settings: As for ``run``.

    Returns:
        What was found, a sentence with its remedy each.
    """
    config = TrainConfig.create(task, **settings)
    env = config.make_env(N_WORLDS)
    n_actions = env.actions.size
    flights: dict[str, Callable[[Obs], Array]] = {
        HOVER: lambda obs: 0.0 * _noise(obs, n_actions),
        RANDOM: lambda obs: _noise(obs, n_actions),
    }
    if demonstrate := getattr(env.task, "demonstrate", None):
        flights[DEMONSTRATION] = demonstrate
    metrics = {name: evaluate(env, policy) for name, policy in flights.items()}
    for name, flown in metrics.items():
        terms = ", ".join(f"{term} {x:.3g}" for term, x in _terms(flown).items())
        outcome = describe_outcome(flown, env.task.unit)
        log(f"{name}: success {flown['success']:.1%}, {outcome}; return {flown['reward']:.3g} ({terms})")
    findings = check_flights(metrics)
    with tempfile.TemporaryDirectory() as folder:
        settings["config"] = dict(settings.get("config") or {}) | {"iterations": ITERATIONS}
        run(task, Path(folder) / "run", film=False, log=lambda _: None, progress=False, **settings)
        before, *_, after = read_curve(Path(folder) / "run")
    log(
        f"{ITERATIONS} iterations: return {before['reward']:.3g} -> {after['reward']:.3g}, error {before['error']:.3g} "
        f"-> {after['error']:.3g} {env.task.unit}, success {before['success']:.1%} -> {after['success']:.1%}"
    )
    if after["reward"] > before["reward"] and after["error"] > before["error"]:
        findings.append("The return rises, but so does the error: compute the reward from error(data).")
    for finding in findings:
        log(f"- {finding}")
    if not findings:
        log("nothing was found")
    return findings


def _noise(obs: Obs, n_actions: int) -> Array:
    # Actions in [-1, 1] from the last digits of the observations, since policies have no random keys.
    digits = jnp.sum(jnp.concatenate(jax.tree.leaves(obs), axis=-1), axis=-1, keepdims=True) * 1e4
    return 2 * ((digits * jnp.arange(1.0, 2.0 * n_actions, 2.0)) % 1.0) - 1


def _terms(flown: Mapping[str, float]) -> dict[str, float]:
    return {name.removeprefix(TERM_PREFIX): x for name, x in flown.items() if name.startswith(TERM_PREFIX)}


def check_flights(metrics: Metrics) -> list[str]:
    """Return what the metrics of the flights without training say about a task, a sentence with its remedy each."""
    hovering, crashing, by_hand = metrics[HOVER], metrics[RANDOM], metrics.get(DEMONSTRATION)
    findings = [
        f"{flown['nonfinite']:.0%} of the worlds of {name} became non-finite: look at observations and states."
        for name, flown in metrics.items()
        if flown["nonfinite"]
    ]
    if hovering["success"] > 0.5:
        findings.append(
            f"Hovering succeeds from {hovering['success']:.0%} of the starts: start farther away, or use a smaller "
            f"tolerance."
        )
    if not any(flown["success"] for flown in metrics.values()):
        findings.append(
            "Success was never seen, so chance may not find it: reward progress towards it, use a larger tolerance or "
            "nearer starts, and define demonstrate(obs) in the class to see that it can be reached."
        )
    if by_hand is not None and 0 < by_hand["success"] < 0.9:
        findings.append(
            f"The demonstration succeeds from {by_hand['success']:.0%} of the starts: seconds may be too short, or "
            f"terminated(data) too strict."
        )
    if by_hand is not None and by_hand["success"] > hovering["success"] and by_hand["reward"] <= hovering["reward"]:
        findings.append(
            f"Hovering returns {hovering['reward']:.3g}, and the demonstration, which succeeds, "
            f"{by_hand['reward']:.3g}: the sum of the terms does not grow towards the goal."
        )
    if crashing["crashed"] > 0.5 > hovering["crashed"] and crashing["reward"] > hovering["reward"]:
        findings.append(
            f"Living costs more than failing: hovering for {hovering['length']:.1f} s returns "
            f"{hovering['reward']:.3g}, and crashing after {crashing['length']:.1f} s {crashing['reward']:.3g}. Use a "
            f"larger cost of failure, or smaller costs of each step."
        )
    for name in _terms(hovering):
        rates = [_terms(flown)[name] / flown["length"] for flown in metrics.values()]
        if max(rates) - min(rates) <= 1e-3 * max(map(abs, rates)) and max(map(abs, rates)) > 0:
            findings.append(f"The term {name!r} is {rates[0]:.3g} a second in every flight: it teaches nothing.")
    return findings
