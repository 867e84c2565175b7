"""Groups of stages whose populations do not depend on each other. Each group becomes a program."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import jax

from crazysim.engine.lowering.tracing import TracedStage, Tracer
from crazysim.engine.pytree import has_members
from crazysim.engine.record import Record
from crazysim.engine.stage import Axes, Stage


class Group(NamedTuple):
    """Stages that run together, step by step."""

    population: str
    """Population whose members the engine computes in lanes. Members of other populations are unrolled."""
    stages: tuple[Stage, ...]
    """The stages, in order."""
    owned_leaves: frozenset[int] | None
    """Indices of the leaves whose new values are taken from this group; None for all leaves that it writes."""


class _Access(NamedTuple):
    """Indices of the leaves that a stage reads and writes, and the populations that it acts on."""

    read_leaves: frozenset[int]
    written_leaves: frozenset[int]
    populations: frozenset[str]

    @property
    def used_leaves(self) -> frozenset[int]:
        return self.read_leaves | self.written_leaves


def independent_groups(stages: Sequence[Stage], data: Record, tracer: Tracer) -> list[Group]:
    """Return the groups of populations that do not depend on each other. The first group is that of the
    record's population, whose members are called drones here.

    Two stages depend on each other if they act on the same population, or if one reads or writes a leaf that the other
    writes. Stages that only use leaves of worlds, called clocks here, are repeated in every group that reads their
    results.

    Args:
        stages: Stages of a step, in order.
        data: Data of the simulation, or its shapes and types.
    """
    axes, leaves, drones = Axes(data), jax.tree.leaves(data), data.roles().population
    if all(scope == drones or not has_members(scope) for scope in axes.scopes):
        return [Group(drones, tuple(stages), None)]
    accesses = [_find_access(tracer(stage, axes, leaves), stage, axes) for stage in stages]
    clocks = _find_clocks(accesses, axes)
    n_members = {scope: x.shape[1] for scope, x in zip(axes.scopes, leaves, strict=True) if has_members(scope)}
    components = _find_components([k for k in range(len(stages)) if k not in clocks], accesses, drones)
    components = [(indices, frozenset().union(*(accesses[k].populations for k in indices))) for indices in components]
    components.sort(key=lambda component: drones not in component[1])
    if not components or drones not in components[0][1]:
        components.insert(0, (set(), frozenset({drones})))
    components = [(_add_clocks(indices, clocks, accesses), populations) for indices, populations in components]
    (drone_stages, drone_populations), *other_components = components
    components = [(drone_stages | clocks, drone_populations), *other_components]  # the drones run all clocks
    groups, owned_leaves = [], frozenset()
    for indices, populations in components:
        written_leaves = frozenset().union(*(accesses[k].written_leaves for k in indices))
        main_population = drones if drones in populations else max(sorted(populations), key=n_members.__getitem__)
        groups.append(
            Group(main_population, tuple([stages[k] for k in sorted(indices)]), written_leaves - owned_leaves)
        )
        owned_leaves |= written_leaves
    return groups


def _find_access(traced: TracedStage, stage: Stage, axes: Axes) -> _Access:
    populations = {axes.scopes[i] for i in traced.written_leaves if has_members(axes.scopes[i])}
    populations |= {stage.scope} if stage.scope in axes.scopes and has_members(stage.scope) else set()
    return _Access(frozenset(traced.input_leaves), frozenset(traced.written_leaves), frozenset(populations))


def _find_clocks(accesses: Sequence[_Access], axes: Axes) -> set[int]:
    clocks = {k for k, a in enumerate(accesses) if not any(has_members(axes.scopes[i]) for i in a.used_leaves)}
    while True:
        other_leaves = frozenset().union(*(a.written_leaves for k, a in enumerate(accesses) if k not in clocks))
        dependent_stages = {k for k in clocks if accesses[k].used_leaves & other_leaves}
        if not dependent_stages:
            return clocks
        clocks -= dependent_stages


def _find_components(stages: Iterable[int], accesses: Sequence[_Access], drones: str) -> list[set[int]]:
    # A stage without a population is treated as a stage of the drones.
    components: list[set[int]] = []
    for k in stages:
        joined_component, other_components = {k}, []
        for component in components:
            if any(_are_dependent(accesses[k], accesses[j], drones) for j in component):
                joined_component |= component
            else:
                other_components.append(component)
        components = [*other_components, joined_component]
    return components


def _are_dependent(a: _Access, b: _Access, drones: str) -> bool:
    populations = (a.populations or {drones}) & (b.populations or {drones})
    return bool(populations or a.written_leaves & b.used_leaves or b.written_leaves & a.used_leaves)


def _add_clocks(stages: Collection[int], clocks: Collection[int], accesses: Sequence[_Access]) -> set[int]:
    result = set(stages)
    while True:
        read_leaves = frozenset().union(*(accesses[k].read_leaves for k in result))
        new_clocks = {k for k in clocks if accesses[k].written_leaves & read_leaves} - result
        if not new_clocks:
            return result
        result |= new_clocks
