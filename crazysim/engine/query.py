"""SceneQueries to the data of all worlds, answered by one kernel for functions of one drone or one world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.stage import Axes, Stage
from crazysim.engine.fused_rollout import FusedRollout
from crazysim.pytree import PyTree, leaf

NAME = "answers"
"""Where answers are while the kernel runs, in ``data.plugins``."""

Question = tuple[Literal["drone", "world"], Callable[[SimData], Any]]
"""What a function sees, and the function: from data of one drone to any tree, of one world to a tree of its drones."""


class Answers(PyTree):
    """Answers in rows of numbers."""

    rows: dict[str, Array] = leaf("drone", 1)
    """(n_worlds, n_drones, k) each"""


def ask(questions: Sequence[Question], data: SimData, platform: str) -> list[Any]:
    """Return what is answered for every drone. (n_worlds, n_drones, ...) each

    Args:
        questions: What is asked, of stages' data: (n_drones, ...) in front for functions of one world.
        data: The simulation.
        platform: Where it runs, ``"cpu"`` or ``"gpu"``.

    Raises:
        UnsupportedError: If something of it cannot be written out.
    """
    n_worlds, n_drones = data.states.pos.shape[:2]
    leaves, axes = jax.tree.leaves(data), Axes(data)
    answers: dict[str, Array] = {}
    shapes, trees, stages = [], [], []
    for number, (scope, fn) in enumerate(questions):
        one = axes.treedef.unflatten(axes.of_one(leaves, scope))
        outs, treedef = jax.tree.flatten(jax.eval_shape(fn, one))
        names = [f"{number} {k}" for k in range(len(outs))]
        per_drone = [x.shape[1:] if scope == "world" else x.shape for x in outs]
        for name, x, shape in zip(names, outs, per_drone, strict=True):
            answers[name] = jnp.zeros((n_worlds, n_drones, *shape), x.dtype).reshape(n_worlds, n_drones, -1)
        shapes.append(dict(zip(names, per_drone, strict=True)))
        trees.append(treedef)
        stages.append(Stage(_answering(fn, names, scope), scope, name=f"question {number}"))
    asked = data.replace(plugins={NAME: Answers(answers)})
    rollout = FusedRollout((), (), stages, asked, {}, 0, platform)
    found = jax.tree.unflatten(jax.tree.structure(asked), rollout(jax.tree.leaves(asked))).plugins[NAME].rows
    return [
        tree.unflatten([found[name].reshape(n_worlds, n_drones, *shape) for name, shape in some.items()])
        for tree, some in zip(trees, shapes, strict=True)
    ]


def _answering(fn: Callable[[SimData], Any], names: list[str], scope: str) -> Callable[[SimData], SimData]:
    """Return the stage that writes down what a function answers."""

    def answer(data: SimData) -> SimData:
        rows = data.plugins[NAME].rows
        outs = jax.tree.leaves(fn(data.replace(plugins={})))
        shape = (data.core.n_drones, -1) if scope == "world" else (-1,)
        new = {name: x.reshape(shape) for name, x in zip(names, outs, strict=True)}
        return data.replace(plugins={NAME: Answers(rows | new)})

    return answer
