"""What is wrong with a task, before minutes of training are lost: flights without training, and ten iterations."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.envs.state import Obs, terms_of
from crazysim.envs.task import Task
from crazysim.train.config import TrainConfig
from crazysim.train.evaluation import describe_flight, evaluate
from crazysim.train.ppo import check_demonstration
from crazysim.train.runs import run
from crazysim.train.show import read_curve

N_WORLDS, ITERATIONS = 256, 10
"""Worlds of the flights, and iterations of the training."""
HOVER, RANDOM, DEMONSTRATION = "zero actions", "random actions", "the demonstration"
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
    flights: dict[str, Callable[[Obs], Array]] = {
        HOVER: lambda obs: 0.0 * _noise(obs, env.actions.size),
        RANDOM: lambda obs: _noise(obs, env.actions.size),
    }
    if demonstrate := getattr(env.task, "demonstrate", None):
        flights[DEMONSTRATION] = demonstrate
        check_demonstration(env)
    metrics = {name: evaluate(env, policy) for name, policy in flights.items()}
    for name, flown in metrics.items():
        log(f"{name}: {describe_flight(flown, env.task.unit)}")
    if demonstrate is None:
        log("define demonstrate(obs) in the class, observations to actions, to see whether success can be reached")
    findings = check_flights(metrics, env.task)
    with tempfile.TemporaryDirectory() as folder:
        settings["config"] = dict(settings.get("config") or {}) | {"iterations": ITERATIONS}
        run(task, Path(folder) / "run", film=False, log=lambda _: None, progress=False, **settings)
        before, *_, after = read_curve(Path(folder) / "run")
    start = f" from the policy of {config.config['start']}" if config.config.get("start") else ""
    log(
        f"after {ITERATIONS} iterations{start}, the return has changed from {before['reward']:.3g} to "
        f"{after['reward']:.3g}"
    )
    if after["reward"] > before["reward"] and after["error"] > 1.5 * before["error"]:
        findings.append(
            f"The return rises, but the error does, too, from {before['error']:.3g} to {after['error']:.3g} "
            f"{env.task.unit}: compute the reward from error(data)."
        )
    for finding in findings:
        log(f"- {finding}")
    if not findings:
        log("nothing was found" + (", but the return does not rise yet" if after["reward"] <= before["reward"] else ""))
    return findings


def _noise(obs: Obs, n_actions: int) -> Array:
    # Actions in [-1, 1] from the last digits of the observations, since policies have no random keys.
    digits = jnp.sum(jnp.concatenate(jax.tree.leaves(obs), axis=-1), axis=-1, keepdims=True) * 1e4
    return 2 * ((digits * jnp.arange(1.0, 2.0 * n_actions, 2.0)) % 1.0) - 1


def check_flights(metrics: Metrics, task: Task) -> list[str]:
    """Return what the metrics of the flights without training say about a task, a sentence with its remedy each."""
    hovering, crashing, by_hand = metrics[HOVER], metrics[RANDOM], metrics.get(DEMONSTRATION)
    findings = [
        f"{flown['nonfinite']:.0%} of the worlds of {name} became non-finite: look at observations and states."
        for name, flown in metrics.items()
        if flown["nonfinite"]
    ]
    # Hovering must fail, and the demonstration must succeed.
    if hovering["success"] > 0.5:
        findings.append(
            f"Zero actions succeed from {hovering['success']:.0%} of the starts: start farther away, or use a smaller "
            f"tolerance."
        )
    if by_hand is not None and by_hand["success"] < 0.9:
        findings.append(f"The demonstration succeeds from {by_hand['success']:.0%} of the starts: " + (
            f"it is terminated after {by_hand['length']:.2g} s on average. If that is the goal, define "
            f"succeeded(data); else "
            f"terminated(data) is too strict, or spawn starts there."
            if by_hand["crashed"] > 0.5
            else f"at the end its error is {by_hand['error']:.2g} {task.unit} on average, and must be below "
            f"{task.tolerance:g} for the last {task.hold:g} s of {task.seconds:g} s, unless succeeded(data) says "
            f"otherwise. seconds may be too short."
        ))  # fmt: skip
    elif by_hand is not None:
        gains = {term: x - terms_of(hovering)[term] for term, x in terms_of(by_hand).items()}
        lost = min(gains, key=gains.__getitem__)
        if by_hand["reward"] <= hovering["reward"] or -gains[lost] > 0.3 * sum(x for x in gains.values() if x > 0):
            findings.append(
                f"The demonstration succeeds, but loses {-gains[lost]:.3g} by the term {lost!r} against hovering: "
                f"is its sign right, and is it small enough?"
            )
    # Crashing early must not pay.
    if crashing["crashed"] > 0.5 > hovering["crashed"] and crashing["reward"] > hovering["reward"]:
        terms, others = terms_of(crashing), terms_of(hovering)
        term = max(terms, key=lambda name: terms[name] - others[name])
        findings.append(
            f"Crashing after {crashing['length']:.1f} s returns {crashing['reward']:.3g}, and hovering for "
            f"{hovering['length']:.1f} s {hovering['reward']:.3g}, mostly by the term {term!r} ({terms[term]:.3g} and "
            f"{others[term]:.3g}): a policy learns to crash. Is the term's sign right, and does failing cost enough?"
        )
    # Every term must distinguish the flights.
    for name in terms_of(hovering):
        rates = [terms_of(flown)[name] / flown["length"] for flown in metrics.values()]
        if max(rates) - min(rates) <= 1e-3 * max(map(abs, rates)) and max(map(abs, rates)) > 0:
            findings.append(f"The term {name!r} is {rates[0]:.3g} a second in every flight: it teaches nothing.")
    return findings
