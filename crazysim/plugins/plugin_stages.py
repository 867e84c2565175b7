"""The pipelines of a simulation as a function of its plugins and of the user's edits, in the order of both."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Collection, Iterable, Sequence
from operator import is_
from typing import Any, NamedTuple

from crazysim.core.integration import Integration
from crazysim.core.pipeline import Pipeline, insert_fn_after, insert_fn_before
from crazysim.core.plugin import BoundMethod, Plugin, Simulation, StagePlacement
from crazysim.engine.stage import Stage, is_first_step
from crazysim.errors import ConfigError, expect, require


class Edit(NamedTuple):
    """Edits of the pipelines of step and reset by the user, between two changes of the plugins."""

    before: Sequence[Pipeline]
    after: Sequence[Pipeline]


class MadeStages(NamedTuple):
    """Stages of a plugin."""

    placements: Sequence[StagePlacement]
    """Stages of a step with their positions."""
    wrapped: Sequence[Callable[..., Any] | None]
    """Functions that the stages replace, and may call."""
    reset: Stage | None
    """Function of a reset."""
    reads_scene: bool
    """Whether the stages depend on the scene."""


class PluginStages:
    """Both pipelines of a simulation: those without plugins, changed by every plugin and every edit in turn."""

    def __init__(self, sim: Simulation):
        self._sim = sim
        self.plugins: dict[str, Plugin] = {}
        """The plugins by name, in the order in which they were added."""
        self._history: list[str | Edit] = []  # names of the plugins, and edits
        self._made: dict[str, MadeStages] = {}
        self._base: Sequence[Pipeline] = ()  # before the first plugin
        self._bare: Sequence[Pipeline] = ()  # of the last build, without influences in the integration
        self._built: Sequence[Pipeline] = ()

    @property
    def scene_readers(self) -> set[str]:
        """Names of the plugins whose stages depend on the scene."""
        return {name for name, made in self._made.items() if made.reads_scene}

    def set_plugin(self, name: str, plugin: Plugin | None) -> None:
        """Add, replace or remove a plugin, after ``begin_change``; ``build`` makes it take effect."""
        if plugin is None:
            del self.plugins[name]
            self._history.remove(name)
            self._made.pop(name, None)
            return
        if name not in self.plugins:
            self._history.append(name)
        self.plugins[name] = plugin.with_companions(self.plugins)

    def build(self, remake: Collection[str] = (), changed: Plugin | None = None) -> None:
        """Set the simulation's pipelines, after ``begin_change``; the dicts stay, because a user may hold them to edit.

        Args:
            remake: Names of plugins whose stages must be made again, as when the stages that they replace are others.
            changed: Plugin that has just been added or replaced, for messages.
        """
        sim, live = self._sim, self._pipelines()
        pipelines: Sequence[Pipeline] = [dict(x) for x in self._base]
        renewed: set[str] = set()  # stages that edits may have replaced, since only what they read has changed
        for k, entry in enumerate(self._history):
            if isinstance(entry, Edit):
                edited = [replay_edit(*x, renewed) for x in zip(*entry, pipelines, strict=True)]
                self._history[k] = Edit(pipelines, edited)
                pipelines = [dict(x) for x in edited]
                continue
            plugin, made = self.plugins[entry], self._made.get(entry)
            sim.step_pipeline = pipelines[0]
            is_changed = entry in remake
            if made is None or is_changed or not all(map(is_, made.wrapped, _replaced(pipelines[0], made.placements))):
                if made is not None and (changed is None or not is_changed):
                    renewed |= {entry, *(placement.name or entry for placement in made.placements)}
                made = self._made[entry] = _make_stages(plugin, sim)
            self._insert_stages(pipelines[0], plugin, made.placements)
            if made.reset is not None:
                insert_fn_after(pipelines[1], [*pipelines[1]][0 if _draws(plugin) else -1], made.reset, entry)
        self._bare = pipelines
        self._built = [_with_influences(pipelines[0], list(self.plugins.values()), changed), dict(pipelines[1])]
        self._set_stages(zip(live, self._built, strict=True))

    def _insert_stages(self, pipeline: Pipeline, plugin: Plugin, placements: Sequence[StagePlacement]) -> None:
        measurements = {
            placement.name or name
            for name, made in self._made.items()
            for placement in made.placements
            if placement.before == "increment_steps"
        }
        for placement in placements:
            name = placement.name or plugin.name
            replaced = placement.replaces if placement.replaces in pipeline else None
            if name in pipeline and name != replaced:
                raise ConfigError(f"the step pipeline already has a stage {name!r}. Use sim.add(..., name=...).")
            before = replaced or placement.before
            if before == "measurements":
                before = next((x for x in pipeline if x in measurements), "increment_steps")
            if name != replaced:
                insert_fn_before(pipeline, before, placement.stage, name)
                pipeline.pop(replaced or "", None)
            pipeline[name] = placement.stage

    def begin_change(self) -> Callable[[], None]:
        """Note what the user has edited; return a function that restores pipelines and plugins as they are now."""
        live = self._pipelines()
        if not self._built:
            self._base = self._bare = self._built = [dict(x) for x in live]
        after = [
            {name: bare[name] if fn is built.get(name) else fn for name, fn in pipeline.items()}
            for pipeline, bare, built in zip(live, self._bare, self._built, strict=True)
        ]
        last = self._history[-1] if self._history else None
        before = self._history.pop().before if isinstance(last, Edit) else self._bare  # type: ignore[union-attr]
        if not all(
            list(a) == list(b) and all(map(is_, a.values(), b.values())) for a, b in zip(before, after, strict=True)
        ):
            self._history.append(Edit(before, after))
        attributes = {name: x if x is self._sim else copy.copy(x) for name, x in vars(self).items()}
        stages = [(x, dict(x)) for x in live]

        def restore() -> None:
            vars(self).update(attributes)
            self._set_stages(stages)

        return restore

    def _set_stages(self, stages: Iterable[tuple[Pipeline, Pipeline]]) -> None:
        pipelines = []
        for pipeline, new_stages in stages:
            pipeline.clear()
            pipeline.update(new_stages)
            pipelines.append(pipeline)
        self._sim.step_pipeline, self._sim.reset_pipeline = pipelines

    @property
    def reset_stages(self) -> tuple[str, ...]:
        """Names of the stages that repeat in the first step what ``reset_episode`` did in the reset pipeline."""
        resets = self._sim.reset_pipeline
        return tuple([_reset_stage_name(p) for p in self.plugins.values() if _is_in_resets(p) and p.name in resets])

    def _pipelines(self) -> list[Pipeline]:
        return [self._sim.step_pipeline, self._sim.reset_pipeline]


def replay_edit(before: Pipeline, after: Pipeline, pipeline: Pipeline, renewed: Collection[str] = ()) -> Pipeline:
    """Return a pipeline with the edit that has made ``after`` out of ``before``, and with the user's order of stages.

    Args:
        pipeline: A pipeline like ``before``, with more, fewer or other stages.
        renewed: Names of stages that the pipeline may have in another version.
    """
    changed = {name: fn for name, fn in after.items() if before.get(name) is not fn}
    for name in changed.keys() & before.keys():
        require(
            name in pipeline and (pipeline[name] is before[name] or name in renewed),
            f"expected stage {name!r} as it was when you replaced it, got another or none. Undo that edit first.",
        )
    old_names, names, order = list(before), list(pipeline), list(after)
    for k, name in reversed([*enumerate(names)]):
        if name not in before:  # it takes the place of a stage that is gone, or precedes the one that it precedes
            old_index = old_names.index(names[k - 1]) + 1 if k and names[k - 1] in before else len(old_names)
            places = [x for x in old_names[old_index : old_index + 1] if x not in pipeline]
            place = next((x for x in [*places, *names[k + 1 :]] if x in order), None)
            order.insert(len(order) if place is None else order.index(place), name)
    return {x: changed[x] if x in changed else pipeline[x] for x in order if x in changed or x in pipeline}


def _is_in_resets(plugin: Plugin) -> bool:
    return plugin.resets_episode and plugin.reset_before is None


def _draws(plugin: Plugin) -> bool:
    return type(plugin).with_drawn_numbers is not Plugin.with_drawn_numbers


def _reset_stage_name(plugin: Plugin) -> str:
    return f"{plugin.name}_begin"


def _replaced(pipeline: Pipeline, placements: Sequence[StagePlacement]) -> list[Callable[..., Any] | None]:
    return [pipeline.get(placement.replaces) for placement in placements if placement.replaces]


def _make_stages(plugin: Plugin, sim: Simulation) -> MadeStages:
    pipeline, n_reads = sim.step_pipeline, sim.scene.n_reads
    placements = plugin.stages(sim)
    expect(
        isinstance(placements, (list, tuple)) and all(isinstance(x, StagePlacement) for x in placements),
        f"stages of plugin {plugin.name!r} to return a list of StagePlacement",
        placements,
        "Use [StagePlacement(stage, before='increment_steps')].",
    )
    for placement in placements:
        expect(
            not isinstance(getattr(placement.stage, "__self__", None), Plugin),
            f"methods of plugin {plugin.name!r} as stages, which see its arrays",
            placement.stage,
            f"Use StagePlacement(self.stage(self.{getattr(placement.stage, '__name__', 'method')})).",
        )
    placements = [dataclasses.replace(x, stage=_as_method(plugin, x.stage)) for x in placements]
    if plugin.resets_episode:
        begin, before = plugin.stage(plugin.reset_episode, when=is_first_step), plugin.reset_before
        if before is None:  # after the stages that begin an episode for other plugins, before all other stages
            before = next(
                name
                for name, fn in pipeline.items()
                if _draws(plugin) or getattr(fn, "when", None) is not is_first_step
            )
        placements = [StagePlacement(begin, before=before, name=_reset_stage_name(plugin)), *placements]
    reset = plugin.stage(plugin.reset_episode) if _is_in_resets(plugin) else None
    return MadeStages(placements, _replaced(pipeline, placements), reset, sim.scene.n_reads != n_reads)


def _as_method(plugin: Plugin, stage: Callable[..., Any]) -> Callable[..., Any]:
    if not isinstance(stage, Stage) or isinstance(stage.fn, BoundMethod):
        return stage
    fn, method_stage = stage.fn, copy.copy(stage)
    method_stage.fn = BoundMethod(plugin, lambda _, data: fn(data))
    return method_stage


def _with_influences(pipeline: Pipeline, plugins: list[Plugin], added: Plugin | None) -> Pipeline:
    dynamic_plugins = tuple(sorted((p for p in plugins if p.is_dynamic), key=lambda p: (p.order, p.name)))
    constraining_names = [p.name for p in dynamic_plugins if p.constrains]
    require(
        len(constraining_names) <= 1,
        f"expected at most one plugin that joins bodies to the drones, got {' and '.join(constraining_names)}. Use "
        f"one plugin for all drones; its parameters can differ between them.",
    )
    integration = getattr(pipeline.get("integration"), "fn", None)
    if isinstance(integration, Integration):
        return pipeline | {"integration": dataclasses.replace(integration, plugins=dynamic_plugins).stage()}
    if added is not None and added.is_dynamic:
        raise ConfigError(
            f"{added.name} acts on the time derivative within the stage 'integration', which is "
            f"{pipeline.get('integration')!r} here. Add it before you replace or remove that stage."
        )
    return dict(pipeline)
