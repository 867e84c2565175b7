"""Help texts and options of several commands, and the policy of a run with its environment."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crazysim.dynamics import Dynamics
from crazysim.errors import require

if TYPE_CHECKING:
    from crazysim.envs.env import Env
    from crazysim.train.config import TrainConfig
    from crazysim.train.networks import Policy


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


def count(at_most: int = MAX_COUNT) -> Callable[[str], int]:
    """Return the type of an option that is a whole number; what it counts checks its lower bound."""

    def whole_number(text: str) -> int:
        n = int(text)
        require(
            n <= at_most, f"expected at most {at_most:,}, got {text}. Use a smaller number.", argparse.ArgumentTypeError
        )
        return n

    return whole_number


def duration(text: str) -> int:
    """Return an option that is a time to wait, s."""
    seconds = int(text)
    require(
        1 <= seconds <= MAX_WAIT,
        f"expected 1 to {MAX_WAIT} s, got {text}. Use for example 60.",
        argparse.ArgumentTypeError,
    )
    return seconds


MAX_WAIT = 86400
"""Longest time of an option to wait for something, s."""


def add_page_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a command that serves a page."""
    parser.add_argument("--port", type=int, default=8080, help="port of the page; 0 for any free port")
    parser.add_argument("--host", default="127.0.0.1", help="address of the page; 0.0.0.0 to accept other machines")


SIMULATION_OPTIONS = ("drone", "dynamics", "controller", "device")
"""Names of the options that ``add_simulation_options`` adds."""


def add_simulation_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a command that are settings of ``Sim``."""
    add = parser.add_argument
    add("--drone", help="airframe: a name or the path of a TOML file; by default cf21B_500")
    add("--dynamics", choices=[x.value for x in Dynamics], help="dynamics model; by default first_principles")
    add("--controller", help="controller that follows the setpoints, such as mellinger; by default auto")
    add("--device", help="device: cpu, gpu; by default cpu")


def specified_options(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the values of the options that a command line sets, by name."""
    return {name: x for name in names if (x := getattr(options, name)) is not None}


def has_screen() -> bool:
    """Return True if there may be a screen for a window; on Linux, if an environment variable names one."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def require_screen(remedy: str) -> None:
    """Check that there may be a screen for ``--window``.

    Args:
        remedy: Options to use instead, for the message.

    Raises:
        ConfigError: If there is none.
    """
    require(has_screen(), f"expected a screen for --window, got none. Use {remedy}.")


def load_policy_and_env(
    folder: Path, device: str | None, n_worlds: int, task: str | None = None
) -> tuple[Policy, TrainConfig, Env]:
    """Return the policy of a run, its configuration, and an environment with the observations of the policy.

    Args:
        folder: Folder of the run.
        device: Device of the environment; None for the device of the training.
        n_worlds: Number of worlds of the environment.
        task: Reference of the task, if it has moved since training; None for the reference in the run.

    Raises:
        ConfigError: If the run is damaged, or if the task has other observations.
    """
    from crazysim.train.interface import check_policy
    from crazysim.train.training import load_policy

    policy, config, _ = load_policy(folder, task)
    env = config.with_device(device).make_env(n_worlds)
    check_policy(policy, env)
    return policy, config, env
