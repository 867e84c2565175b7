"""Help texts and options of several commands, and the policy of a run with its environment."""

from __future__ import annotations

import argparse
import ast
import contextlib
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crazysim.dynamics import Dynamics
from crazysim.errors import require

if TYPE_CHECKING:
    from crazysim.envs.env import Env
    from crazysim.train.config import TrainConfig


class DefaultsFormatter(argparse.HelpFormatter):
    """Help that states defaults that are numbers or names, unless a help text already says "by default"."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        text, default = action.help, action.default
        has_no_default = default == [] or any(default is x for x in (None, False, argparse.SUPPRESS))
        if text is None or has_no_default or "by default" in text:
            return text
        return f"{text} (default: %(default)s)"


MAX_COUNT = 2**26
"""Largest number of worlds, iterations and so on of an option."""
MAX_DRONES = 2**16
"""Largest number of drones in a world of an option."""
MAX_WAIT = 86400
"""Longest time of an option to wait for something, s."""
MAX_SIZE = 1e9
"""Largest real number of an option, in its unit; the smallest positive one is its reciprocal."""


def number(
    low: float = 1, high: float = MAX_COUNT, example: float | str = 10, kind: type[int] | type[float] = int
) -> Callable[[str], Any]:
    """Return the type of an option that is a number from ``low`` to ``high``; by default a count."""

    def read_number(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            what, style = ("a whole number", ",") if kind is int else ("a number", "g")
            raise argparse.ArgumentTypeError(
                f"expected {what} from {low:{style}} to {high:{style}}, got {text!r}. Use for example {example}."
            )
        return value

    return read_number


def size(example: float | str) -> Callable[[str], Any]:
    """Return the type of an option that is a positive real number, such as a mass or a duration."""
    return number(1 / MAX_SIZE, MAX_SIZE, example, float)


seed = number(-(2**63), 2**63 - 1, 1)
"""Type of an option that is a random seed."""


def add_page_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--port", type=number(0, 2**16 - 1, 8080), default=8080, help="port of the page; 0 for any free port"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address of the page; 0.0.0.0 to accept other machines")


SIMULATION_OPTIONS = ("drone", "dynamics", "controller", "device")
"""Names of the options that ``add_simulation_options`` adds."""


def add_simulation_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--drone", help="airframe: a name or the path of a TOML file; by default cf21B_500")
    add("--dynamics", choices=[x.value for x in Dynamics], help="dynamics model; by default first_principles")
    add("--controller", help="controller that follows the setpoints, such as mellinger; by default auto")
    add("--device", help="device: cpu, gpu; by default cpu")


def specified_options(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the values of the options that a command line sets, by name."""
    return {name: x for name in names if (x := getattr(options, name)) is not None}


def has_screen() -> bool:
    """Whether there may be a screen for a window; on Linux, if an environment variable names one."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def require_screen(remedy: str) -> None:
    """Check that there may be a screen for ``--window``.

    Args:
        remedy: Options to use instead, for the message.
    """
    require(has_screen(), f"expected a screen for --window, got none. Use {remedy}.")


def parse_pairs(texts: Sequence[str]) -> dict[str, Any]:
    """Return the values of ``NAME=VALUE`` by name: JSON, Python's True, False, None and tuples, or else text."""
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        require(equals, f"expected NAME=VALUE, got {text!r}; write for example seconds=5", ValueError)
        try:
            pairs[name] = json.loads(value)
        except ValueError:
            pairs[name] = _parse_python(value)
    return pairs


def _parse_python(text: str) -> Any:
    # Other literals are text: 2026_12_01 is the name of a folder, not a number.
    with contextlib.suppress(ValueError, SyntaxError, TypeError):
        value = ast.literal_eval(text)
        return value if value is None or isinstance(value, (bool, tuple)) else text
    return text


def load_policy_and_env(
    folder: Path,
    device: str | None,
    n_worlds: int,
    task: str | None = None,
    drone: str | None = None,
    policies: Sequence[Path] = (),
    settings: Mapping[str, Any] = {},
) -> tuple[Any, TrainConfig, Env]:
    """Return the policy of a run, its configuration, and an environment with the observations of the policy.

    Args:
        folder: Folder of the run, or, for the task ``any``, a checkpoint of rl-tools or the name of the task for the
            policy of the package. With ``policies`` the task.
        device: Device of the environment; None for the device of the training.
        task: Reference of the task, if it has moved since training; None for the reference in the run.
        drone: Airframe that a policy for any flies; None for airframes that are drawn.
        policies: Folders of runs whose policies fly the drones of a world, in their order; empty for one policy.
        settings: Options of ``crazysim.envs.make`` that differ from those of the training, or, with ``policies``, that
            are not those that all runs share.
    """
    from crazysim.train.config import TrainConfig
    from crazysim.train.export import find_weights, raptor_policy
    from crazysim.train.interface import allow_rate_of, check_policy
    from crazysim.train.policies import MultiPolicy
    from crazysim.train.training import load_policy

    if policies:
        runs = [load_policy(x)[:2] for x in policies]
        shared = runs[0][1].options.items()
        shared = {k: x for k, x in shared if k != "device" and all(c.options.get(k) == x for _, c in runs)}
        config = TrainConfig.create(str(folder), options=shared | dict(settings)).with_device(device)
        return MultiPolicy.of([policy for policy, _ in runs]), config, config.make_env(n_worlds)
    if (weights := find_weights(folder)) is not None:
        config = TrainConfig.create("any", options={} if drone is None else {"drone": drone, "drawn": False})
        env = config.with_options(**settings).with_device(device).make_env(n_worlds)
        return raptor_policy(weights, env.sim.airframes[0]), config, env
    require(drone is None, f"expected any, or a checkpoint (.tar), for --drone, got {str(folder)!r}", ValueError)
    policy, config, _ = load_policy(folder, task)
    policy = allow_rate_of(policy, settings)
    env = config.with_options(**settings).with_device(device).make_env(n_worlds)
    check_policy(policy, env)
    return policy, config, env
