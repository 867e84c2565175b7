"""Checks of the hyperparameters of all algorithms."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from crazysim.arguments import check_flag
from crazysim.core.data import as_key
from crazysim.core.settings import positive_integer
from crazysim.errors import ConfigError, require

SWEEPABLE = ("learning_rate", "discount", "gae_lambda", "clip", "entropy", "value_weight", "max_grad_norm")
"""Hyperparameters that may differ between the seeds of one program, and may change when a run is resumed: shapes and
counters of the learner do not depend on them."""
FRACTION_NAMES = ("discount", "gae_lambda", "teacher_decay")
"""Hyperparameters from 0 to 1."""
WEIGHT_NAMES = ("entropy", "value_weight")
"""Hyperparameters that are finite, and 0 or larger."""
LIMIT_NAMES = ("max_grad_norm",)
"""Hyperparameters that are larger than 0, and may be infinite. All other numbers are finite and larger than 0."""
COUNT_NAMES = ("memory", "demonstrations", "value_iterations", "opponents", "critic_epochs")
"""Hyperparameters that are whole numbers of at least 0. All other whole numbers are larger than 0."""
MAX_COUNT, MAX_SIZE = 2**26, 2**14
"""Largest whole number, and largest size of a layer or a memory."""
CHOICES_BY_NAME = {
    "critic": ("observations", "privileged", "all_drones", "all_drones_privileged"),
    "shape": ("default", "raptor"),
}
"""Allowed values of the hyperparameters that are a choice of words, by name."""


def check_seed(seed: object) -> None:
    """Check that a random seed is a whole number of at most 64 bits."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)):
        raise ConfigError(f"expected an integer as seed, got {seed!r}. Use for example 0.")
    as_key(int(seed))  # raises an error for more than 64 bits


def check_hyperparameters(config: Any) -> None:
    """Check the fields of a frozen ``Config``, and convert them to Python numbers and tuples."""
    for field in dataclasses.fields(config):
        value, default = getattr(config, field.name), field.default
        if field.name == "rewards":
            value = _check_factors(value)
        elif field.name == "rivals":
            value = _check_folders(field.name, value)
        elif isinstance(default, tuple):
            value = _check_sizes(field.name, value)
        elif field.name in CHOICES_BY_NAME:
            value = _check_choice(field.name, value, CHOICES_BY_NAME[field.name])
        elif isinstance(default, str):
            value = _check_text(field.name, value)
            value = str(Path(value).resolve()) if value else ""  # so that the run can be resumed from any folder
        elif isinstance(default, bool):
            value = check_flag(field.name, value)
        elif isinstance(default, int):
            is_count = field.name in COUNT_NAMES
            value = _check_count(field.name, value) if is_count else positive_integer(field.name, value, MAX_COUNT)
        else:
            value = _check_number(field.name, value, default)
        object.__setattr__(config, field.name, value)
    critic = getattr(config, "critic", "")
    require(
        not critic.startswith("all_drones") or not config.convolution,
        f"expected a critic of one drone with a convolution, got {critic!r}. Use critic='privileged'.",
    )


def _check_text(name: str, value: object) -> str:
    if not isinstance(value, str):
        raise ConfigError(f"expected {name} as a text, got {value!r}. Use for example 'out/hover'.")
    return value


def _check_folders(name: str, value: object) -> tuple[str, ...]:
    if not isinstance(value, (list, tuple)) or not all(isinstance(x, str) for x in value):
        raise ConfigError(f'expected {name} as a list of folders of runs, got {value!r}. Use for example ["out/race"].')
    return tuple([str(Path(x).resolve()) for x in value])  # so that the run can be resumed from any folder


def _check_factors(value: Any) -> tuple[tuple[str, float], ...]:
    try:
        factors = sorted((str(name), float(factor)) for name, factor in dict(value).items())
        require(all(map(math.isfinite, dict(factors).values())), "", ValueError)
    except (TypeError, ValueError):
        raise ConfigError(
            f'expected rewards as finite factors by the name of a term, got {value!r}. Use for example {{"near": 0.3}}.'
        ) from None
    return tuple(factors)


def _check_sizes(name: str, value: object) -> tuple[int, ...]:
    if not isinstance(value, (list, tuple)):
        meaning = "channels of the layers" if name == "convolution" else "sizes of the hidden layers"
        raise ConfigError(f"expected {name} as the {meaning}, got {value!r}. Use for example [64, 64].")
    return tuple(positive_integer(f"{name}[{i}]", size, MAX_SIZE) for i, size in enumerate(value))


def _check_count(name: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value <= MAX_SIZE:
        raise ConfigError(f"expected {name} as a whole number from 0 to {MAX_SIZE}, got {value!r}. Use for example 64.")
    return int(value)


def _check_choice(name: str, value: object, choices: tuple[str, ...]) -> str:
    require(
        value in choices,
        f"expected {name} as one of {', '.join(choices)}, got {value!r}. Use for example {choices[0]}.",
    )
    return str(value)


def _check_number(name: str, value: Any, default: Any) -> float:
    if name in FRACTION_NAMES:
        low, high, expected = 0.0, 1.0, "a number from 0 to 1"
    elif name in WEIGHT_NAMES:
        low, high, expected = 0.0, np.finfo(np.float32).max, "a finite number of at least 0"
    elif name in LIMIT_NAMES:
        low, high, expected = math.ulp(0.0), math.inf, "a number larger than 0"
    else:
        low, high, expected = np.finfo(np.float32).tiny, np.finfo(np.float32).max, "a finite number larger than 0"
    is_number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    require(
        is_number and low <= value <= high, f"expected {name} as {expected}, got {value!r}. Use for example {default}."
    )
    return float(value)
