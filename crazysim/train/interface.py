"""Observations and commands of a policy: its files keep them, and whatever flies, exports or imitates it compares."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import crazysim
from crazysim.envs.env import Env
from crazysim.errors import ConfigError, expect, require, require_type, short_repr, warn
from crazysim.train.task_code import task_digest

REMEDY = (
    "Use the environment of the training, config.make_env(n) with the config of load_policy, or train a policy for "
    "this one."
)


@dataclass(frozen=True)
class Interface:
    """Observations and commands of a policy. None is not compared."""

    observations: tuple[tuple[str, int], ...]
    """Name and size of each observation, in the order of the inputs: alphabetical."""
    images: tuple[tuple[str, int, int], ...]
    """Name, height and width of the observations that are images."""
    level: str
    """Command level."""
    ranges: tuple[tuple[float, float], ...]
    """Command at a zero action, and its change per unit of action, of each component of the action."""
    freq: int | None = None
    """Actions per second, Hz."""
    task: str | None = None
    """Name of the task."""
    task_code: str | None = None
    """Hash of the code of the task; None if its source is unknown."""

    @staticmethod
    def read(meta: Mapping[str, Any]) -> Interface:
        """Return the interface in a description, from ``describe`` or from the files of a run."""
        try:
            actions, images = meta["actions"], meta.get("images", {})
            centre, scale = (np.asarray(actions[name], float).ravel().tolist() for name in ("centre", "scale"))
            return Interface(
                tuple(sorted((str(name), int(size)) for name, size in meta["observations"].items())),
                tuple(sorted((name, x["height"], x["width"]) for name, x in images.items())),
                str(actions["level"]),
                tuple(zip(centre, scale, strict=True)),
                *(meta.get(name) for name in ("freq", "task", "task_code")),
            )
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise ConfigError(
                f"expected the description of a policy, got {short_repr(meta)}. Use the third result of load_policy, "
                f"or describe(env)."
            ) from error

    @property
    def sizes(self) -> dict[str, int]:
        return dict(self.observations)

    def require(self, other: Interface, source: str) -> None:
        """Check that another interface is the same, and warn of what may have changed under the same names.

        Args:
            source: Whose interface it is, for the message.
        """
        differences = _size_differences(self.sizes, other.sizes)
        differences += [
            f"another shape of image {x[0]}" for x in other.images if x[0] in self.sizes if x not in self.images
        ]
        for mine, theirs, text in (
            (self.level, other.level, "{} commands"),
            (self.freq, other.freq, "{} Hz"),
            (self.task, other.task, "task {!r}"),
        ):
            if None not in (mine, theirs) and mine != theirs:
                differences.append(f"{text.format(theirs)} in place of {text.format(mine)}")
        require(
            not differences,
            f"expected {source} with the interface of the policy, got {', '.join(differences)}. {REMEDY}",
        )
        if None not in (self.task_code, other.task_code) and self.task_code != other.task_code:
            warn(
                "the code of the task differs from that of the policy's training: observations may have other units or "
                "contents under the same names"
            )
        if not self.has_ranges_of(other):
            warn(f"actions of {source} have other ranges than in the policy's training, as of another drone")

    def has_ranges_of(self, other: Interface) -> bool:
        """Whether the actions of both are the same commands, to rounding."""
        return len(self.ranges) == len(other.ranges) and np.allclose(self.ranges, other.ranges)

    def require_observations(self, sizes: Mapping[str, int]) -> None:
        if differences := _size_differences(self.sizes, sizes):
            raise ConfigError(
                f"expected the observations of the policy, {sizes_text(self.sizes)}, got {', '.join(differences)}. "
                f"{REMEDY}"
            )


def describe_env(env: Env, sizes: Mapping[str, int] | None = None) -> dict[str, Any]:
    """Return the description of the interface of an environment, which JSON can represent.

    Args:
        sizes: Sizes of the observations; None for those of the environment.
    """
    return {
        "crazysim": crazysim.__version__,
        "task": env.task.name or type(env.task).__name__,
        "task_code": task_digest(type(env.task)),
        "freq": env.base.freq,
        "observations": env.observation_sizes if sizes is None else dict(sizes),
        "images": {
            name: {k: x for k, x in entries.items() if k != "has_gradient"}
            for name, entries in env.image_formats().items()
        },
        "actions": {
            "level": env.actions.control.value,
            "centre": env.actions.centre.tolist(),
            "scale": env.actions.scale.tolist(),
        },
    }


def check_policy(policy: Any, env: Env) -> None:
    """Check that a policy is a function, and that the interface of a trained one is that of an environment.

    A policy of a task also flies a task whose class is derived from it. Members of a ``MultiPolicy`` need no more than
    their own observations, of the task of their training.
    """
    check_callable(policy, env)
    is_multiple = hasattr(policy, "members")
    if is_multiple:
        policy.of_drones(env.sim.n_worlds, env.sim.n_drones)
    for member in policy.members if is_multiple else (policy,):
        interface = getattr(member, "interface", None)
        if not isinstance(interface, Interface):
            continue
        other = Interface.read(describe_env(env))
        if is_multiple:
            known = tuple([x for x in other.observations if x[0] in interface.sizes])
            other = dataclasses.replace(other, observations=known)
        for base in type(env.task).__mro__:
            if interface.task is not None and vars(base).get("name") == interface.task:
                code = task_digest(base) if is_multiple else other.task_code
                other = dataclasses.replace(other, task=interface.task, task_code=code)
        interface.require(other, "an environment")


def allow_rate_of(policy: Any, settings: Mapping[str, Any]) -> Any:
    """Return a trained policy that may also act at another rate if the settings of ``make`` have one."""
    interface = dataclasses.replace(policy.interface, freq=None) if "freq" in settings else policy.interface
    return policy.replace(interface=interface)


def check_callable(policy: Any, env: Env) -> None:
    require_type(env, Env, "Use crazysim.envs.make('hover', n_worlds).")
    expect(
        callable(policy),
        "a policy",
        policy,
        "Use the first result of load_policy, or a function from observations to actions.",
    )


def sizes_of(obs: Any) -> dict[str, int]:
    """Return the sizes of observations by name, after checking that they are arrays by name."""
    try:
        return {name: np.shape(x)[-1] for name, x in obs.items()}
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        raise ConfigError(
            f"expected observations as a dict of arrays (..., k) by name, got {short_repr(obs)}. Use state.obs, "
            f"for example."
        ) from error


def sizes_text(sizes: Mapping[str, int]) -> str:
    n = sum(sizes.values())
    return f"{n} number{'s' * (n != 1)} ({', '.join(f'{name} {n}' for name, n in sizes.items())})"


def _size_differences(expected: Mapping[str, int], sizes: Mapping[str, int]) -> list[str]:
    missing = [f"no {name} {n}" for name, n in expected.items() if name not in sizes]
    extra = [f"{name} {n} in addition" for name, n in sizes.items() if name not in expected]
    resized = [f"{name} {n} in place of {expected[name]}" for name, n in sizes.items() if expected.get(name, n) != n]
    return missing + extra + resized
