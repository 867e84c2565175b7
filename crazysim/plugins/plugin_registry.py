"""Registry of a simulation's plugins, the only place where they are added, replaced and removed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.cache import keep_programs
from crazysim.core.data import SimData
from crazysim.core.integration import Integration
from crazysim.core.pipeline import Pipeline, append_fn, insert_fn_before
from crazysim.core.plugin import Plugin, Simulation, StagePlacement, with_measured_states
from crazysim.core.population import Population
from crazysim.core.settings import collect_settings
from crazysim.core.stage import Axes, Stage, is_first_step, vmap_drones, vmap_worlds
from crazysim.eager import jit_eager_calls
from crazysim.errors import ConfigError, UnknownNameError, short_repr
from crazysim.plugins.sensors.sensor import Sensor
from crazysim.pytree import PyTree, n_batch_axes

P = TypeVar("P", bound=Plugin)

_SETTING_SCOPES = ("parameter", "shared")
"""Scopes of leaves that contain settings. Leaves of all other scopes contain states."""


class _InstalledPlugin(NamedTuple):
    """A plugin with the stages that it put into the step pipeline."""

    plugin: Plugin
    stages: dict[str, Callable[..., Any]]
    """The stages by name."""
    replaced: dict[str, tuple[str, Callable[..., Any]]]
    """Name and function of the stage that was replaced, by the name of the stage that replaced it."""


class PluginRegistry(Mapping[str, Plugin]):
    """The plugins of one simulation by name, in the order in which they were added."""

    def __init__(self, sim: Simulation):
        self._sim = sim
        self._installed: dict[str, _InstalledPlugin] = {}
        self._move_objects: dict[str, tuple[Plugin, Callable[..., Any]]] = {}
        self._observe_fn: tuple[tuple[Plugin, ...], Callable[..., Any]] = (), _no_observations
        self._is_checked = True

    def __getitem__(self, name: str) -> Plugin:
        """Return a plugin."""
        if name not in self._installed:
            raise UnknownNameError(
                f"expected the name of an added plugin, got {name!r}. Added are: {', '.join(self) or 'none'}."
            )
        return self._installed[name].plugin

    def __iter__(self) -> Iterator[str]:
        return iter(self._installed)

    def __len__(self) -> int:
        return len(self._installed)

    def __contains__(self, name: object) -> bool:
        return name in self._installed

    def add(self, plugin: P, name: str | None = None) -> P:
        """Add a plugin; see ``Sim.add``."""
        if not isinstance(plugin, Plugin):
            raise ConfigError(f"expected a plugin, got {plugin!r}. Use sim.add(Wind(...)), or your subclass of Plugin.")
        plugin = plugin if name is None else dataclasses.replace(plugin, name=name)  # type: ignore[type-var]
        name, kind = plugin.name, type(plugin).__name__
        if not isinstance(name, str) or not name:
            raise ConfigError(f"expected a non-empty string as name of a {kind}, got {name!r}")
        if name in self:
            raise ConfigError(
                f"{name} is already enabled. Use sim.replace({kind}(...)) to change it, or "
                f"sim.add({kind}(...), name=...) to add another one."
            )
        if name in self._sim.data.plugins:
            raise ConfigError(f"data.plugins already has a record {name!r}. Use sim.add(..., name=...).")
        self._require_unused_names(plugin, self._sim.names)
        self._require_unique_terms(plugin, self.values())
        with self._restore_on_error():
            record, default = plugin.record(self._sim), plugin.default_record(self._sim)
            pipeline, installed = _add_stages(
                dict(self._sim.step_pipeline), plugin, _stage_placements(plugin, self._sim)
            )
            pipeline = _with_influences(pipeline, [*self.values(), plugin], plugin)
            resets = dict(self._sim.reset_pipeline)
            if _is_in_reset_pipeline(plugin):
                append_fn(resets, Stage(plugin.reset_episode, plugin.scope), name)
            self._put_records(name, record, default)
            self._installed[name] = installed
            self._build(pipeline, resets)
        return plugin

    def remove(self, plugin: Plugin | str) -> None:
        """Remove a plugin; see ``Sim.remove``."""
        name = plugin.name if isinstance(plugin, Plugin) else plugin
        removed_plugin = self[name]
        pipeline = _remove_stages(dict(self._sim.step_pipeline), self._installed[name])
        pipeline = _with_influences(pipeline, [p for p in self.values() if p.name != name])
        resets = dict(self._sim.reset_pipeline)
        if _is_in_reset_pipeline(removed_plugin):
            resets.pop(name, None)
        self._put_records(name, None, None)
        del self._installed[name]
        self._build(pipeline, resets)

    def replace(self, plugin: P) -> P:
        """Replace the settings of a plugin; see ``Sim.replace``."""
        with self._restore_on_error():
            return self._replace_plugin(plugin)

    def _replace_plugin(self, plugin: P) -> P:
        if not isinstance(plugin, Plugin):
            raise ConfigError(f"expected a plugin, got {short_repr(plugin)}. Use sim.replace(Wind(...)), for example.")
        old_plugin = self[plugin.name]
        if type(old_plugin) is not type(plugin):
            raise ConfigError(
                f"expected a {type(old_plugin).__name__} to replace {plugin.name!r}, got a {type(plugin).__name__}. "
                f"Use sim.remove({plugin.name!r}) first, or another name=."
            )
        sim, name = self._sim, plugin.name
        self._require_unused_names(plugin, [other for other in sim.names if other not in self.members_of(old_plugin)])
        self._require_unique_terms(plugin, [other for other in self.values() if other is not old_plugin])
        old_record, record, default = sim.data.plugins.get(name), plugin.record(sim), plugin.default_record(sim)
        if _have_same_code(old_plugin, plugin) and jax.tree.structure(old_record) == jax.tree.structure(record):
            self._put_records(name, _carry_over_states(record, old_record), default)
            self._installed[name] = self._installed[name]._replace(plugin=plugin)
            self._is_checked = False
            return plugin
        # The plugin's stages must be created for a pipeline without the plugin.
        sim.step_pipeline = _remove_stages(dict(sim.step_pipeline), self._installed[name])
        pipeline, installed = _add_stages(dict(sim.step_pipeline), plugin, _stage_placements(plugin, sim))
        pipeline = _with_influences(pipeline, [plugin if p.name == name else p for p in self.values()], plugin)
        resets = dict(self._sim.reset_pipeline)
        if _is_in_reset_pipeline(plugin) and (name in resets or not _is_in_reset_pipeline(old_plugin)):
            resets[name] = Stage(plugin.reset_episode, plugin.scope)
        elif _is_in_reset_pipeline(old_plugin):
            resets.pop(name, None)
        self._put_records(name, _carry_over_states(record, old_record), default)
        self._installed[name] = installed
        self._build(pipeline, resets)
        return plugin

    @contextlib.contextmanager
    def _restore_on_error(self) -> Iterator[None]:
        """Restore the simulation and its scene if an error ends the block."""
        sim, installed = self._sim, dict(self._installed)
        data, default, steps, resets = sim.data, sim.default_data, sim.step_pipeline, sim.reset_pipeline
        with sim.scene.restore_on_error():
            try:
                yield
            except BaseException:
                self._installed = installed
                sim.step_pipeline, sim.reset_pipeline = steps, resets
                sim.data, sim.default_data = data, default
                raise

    @staticmethod
    def members_of(plugin: Plugin) -> tuple[str, ...]:
        """Return the names of the members of a population; empty for other plugins."""
        return plugin.names if isinstance(plugin, Population) else ()

    @property
    def reset_stages(self) -> tuple[str, ...]:
        """Names of the stages that repeat in the first step what ``reset_episode`` did in the reset pipeline."""
        resets = self._sim.reset_pipeline
        return tuple([_reset_stage_name(p) for p in self.values() if _is_in_reset_pipeline(p) and p.name in resets])

    @property
    def members(self) -> tuple[str, ...]:
        """Names of the members of all populations."""
        return tuple([name for plugin in self.values() for name in self.members_of(plugin)])

    def _require_unused_names(self, plugin: Plugin, used_names: Collection[str]) -> None:
        """Check that the names of a population's members are not in use."""
        used_names = set(used_names)
        duplicates = [name for name in self.members_of(plugin) if name in used_names]
        if duplicates:
            raise ConfigError(
                f"expected names that are not in use, got {duplicates[0]!r} again. Use "
                f"{type(plugin).__name__}([...]) with other names."
            )

    @staticmethod
    def _require_unique_terms(plugin: Plugin, others: Iterable[Plugin]) -> None:
        """Check that no other plugin replaces the same term of the model."""
        for other in others:
            if shared_terms := set(plugin.replaced_terms) & set(other.replaced_terms):
                raise ConfigError(
                    f"expected one plugin for {' and '.join(sorted(shared_terms))}, got {type(other).__name__} "
                    f"{other.name!r} and {type(plugin).__name__} {plugin.name!r}, which would both provide it. "
                    f"Use one of the two: sim.remove({other.name!r}) removes the first."
                )

    def check(self) -> None:
        """Check the plugins that each plugin requires, if the plugins have changed since the last check."""
        if not self._is_checked:
            for plugin in self.values():
                plugin.check_plugins(self._sim)
            self._is_checked = True

    def build_records(self) -> None:
        """Put a new record of every plugin into the simulation's data."""
        for name, plugin in self.items():
            self._set_record(name, plugin.record(self._sim))

    def observations(self, data: SimData, measured: bool = False) -> dict[str, Array]:
        """Return the observations of all plugins, as ``"plugin.name"``. (n_worlds, n_drones, k) each

        Args:
            data: The data of all worlds.
            measured: True for observations that are calculated from the states as sensors measure them.
        """
        plugins = tuple(self.values())
        is_changed = [*map(id, plugins)] != [*map(id, self._observe_fn[0])]
        if is_changed:
            self._observe_fn = plugins, jit_eager_calls("measured")(functools.partial(_observations, plugins))
        with keep_programs(enabled=is_changed):
            return self._observe_fn[1](data, measured=measured)

    def measured_states(self, data: SimData) -> SimData:
        """Return the data of one world with the states that sensors measure in place of the true ones."""
        plugins = tuple(self.values())
        return data.replace(states=vmap_drones(lambda drone: with_measured_states(plugins, drone).states)(data))

    def with_moved_objects(self, data: SimData) -> SimData:
        """Return the data with the objects of plugins at their poses, unless recorded poses are shown."""
        if data.objects is None or data.objects.recorded:
            return data
        for name, plugin in self.items():
            if plugin.moves_objects:
                if self._move_objects.get(name, (None, None))[0] is not plugin:
                    self._move_objects[name] = plugin, jax.jit(vmap_worlds(plugin.move_objects))
                data = data.replace(objects=self._move_objects[name][1](data))
        return data

    def draw(self, world: int) -> None:
        """Draw the overlays of all plugins into the next image of a world."""
        for plugin in self.values():
            plugin.draw(self._sim, world)

    def _put_records(self, name: str, record: PyTree | None, default: PyTree | None) -> None:
        """Put a record into the data and the default data, or remove it, without other changes.

        Each record is first assigned to ``sim.data``, which moves it to the simulation's devices.
        """
        self._set_record(name, default)
        current = self._sim.data.plugins.get(name)
        self._sim.default_data = _with_record(self._sim.default_data, name, current)
        self._set_record(name, record)

    def _set_record(self, name: str, record: PyTree | None) -> None:
        if record is not None and not isinstance(record, PyTree):
            raise ConfigError(
                f"expected record of plugin {name!r} to return a PyTree or None, got {type(record).__name__}. Use a "
                f"subclass of PyTree that declares its arrays with leaf(...)."
            )
        self._sim.data = _with_record(self._sim.data, name, record)

    def _build(self, pipeline: Pipeline, resets: Pipeline) -> None:
        """Set the pipelines of step and reset, and build the step function."""
        self._is_checked = False
        if resets != self._sim.reset_pipeline:
            self._sim.reset_pipeline = resets
        self._sim.step_pipeline = pipeline
        self._sim.build_step_fn()


def _with_record(data: SimData, name: str, record: PyTree | None) -> SimData:
    others = {key: value for key, value in data.plugins.items() if key != name}
    return data.replace(plugins=others if record is None else others | {name: record})


def _stage_placements(plugin: Plugin, sim: Simulation) -> object:
    """Return the placements of a plugin's stages, led by the stage that calls ``reset_episode``, if there is one."""
    placements = plugin.stages(sim)
    if not plugin.resets_episode or not isinstance(placements, (list, tuple)):
        return placements
    episode_stage = Stage(plugin.reset_episode, plugin.scope, is_first_step)
    before = plugin.reset_before
    if before is None:  # after the stages that begin an episode for other plugins, before all other stages
        before = next(name for name, fn in sim.step_pipeline.items() if getattr(fn, "when", None) is not is_first_step)
    return [StagePlacement(episode_stage, before=before, name=_reset_stage_name(plugin)), *placements]


def _is_in_reset_pipeline(plugin: Plugin) -> bool:
    return plugin.resets_episode and plugin.reset_before is None


def _reset_stage_name(plugin: Plugin) -> str:
    return f"{plugin.name}_begin"


def _add_stages(pipeline: Pipeline, plugin: Plugin, placements: object) -> tuple[Pipeline, _InstalledPlugin]:
    """Return the pipeline with the stages of a plugin, and the plugin with its changes to the pipeline."""
    if not isinstance(placements, (list, tuple)) or not all(isinstance(x, StagePlacement) for x in placements):
        raise ConfigError(
            f"expected stages of plugin {plugin.name!r} to return a list of StagePlacement, got {placements!r}. Use "
            f"[StagePlacement(stage, before='increment_steps')]."
        )
    installed = _InstalledPlugin(plugin, {}, {})
    for placement in placements:
        pipeline = _add_stage(pipeline, placement, placement.name or plugin.name, installed)
    return pipeline, installed


def _add_stage(pipeline: Pipeline, placement: StagePlacement, name: str, installed: _InstalledPlugin) -> Pipeline:
    """Return the pipeline with one more stage, and add the change to ``installed``."""
    replaced = placement.replaces if placement.replaces in pipeline else None
    if name in pipeline and name != replaced:
        raise ConfigError(f"the step pipeline already has a stage {name!r}. Use sim.add(..., name=...).")
    installed.stages[name] = placement.stage
    if replaced is None:
        insert_fn_before(pipeline, placement.before, placement.stage, name)
        return pipeline
    installed.replaced[name] = (replaced, pipeline[replaced])
    return {
        name if key == replaced else key: placement.stage if key == replaced else fn for key, fn in pipeline.items()
    }


def _remove_stages(pipeline: Pipeline, installed: _InstalledPlugin) -> Pipeline:
    """Return the pipeline without the stages of a plugin, and with the stages that it had replaced."""
    for name, stage in installed.stages.items():
        if pipeline.get(name, stage) is not stage:
            raise ConfigError(
                f"stage {name!r} of plugin {installed.plugin.name!r} has been replaced since it was added. Undo that "
                f"first, or remove the plugin that did it."
            )
    items = [(name, installed.replaced.get(name) if name in installed.stages else (name, fn))
             for name, fn in pipeline.items()]  # fmt: skip
    return dict(item for _, item in items if item is not None)


def _with_influences(pipeline: Pipeline, plugins: list[Plugin], added: Plugin | None = None) -> Pipeline:
    """Return the pipeline whose integration applies the influences and derivatives of plugins."""
    dynamic_plugins = tuple(sorted((p for p in plugins if p.is_dynamic), key=lambda p: (p.order, p.name)))
    constraining_names = [p.name for p in dynamic_plugins if p.constrains]
    if len(constraining_names) > 1:
        raise ConfigError(
            f"expected at most one plugin that joins bodies to the drones, got {' and '.join(constraining_names)}. Use "
            f"one plugin for all drones; its parameters can differ between them."
        )
    integration = getattr(pipeline.get("integration"), "fn", None)
    if isinstance(integration, Integration):
        return pipeline | {"integration": dataclasses.replace(integration, plugins=dynamic_plugins).stage()}
    if added is not None and added.is_dynamic:
        raise ConfigError(
            f"{added.name} acts on the time derivative within the stage 'integration', which is "
            f"{pipeline.get('integration')!r} here. Add it before you replace or remove that stage."
        )
    return pipeline


def _have_same_code(old_plugin: Plugin, new_plugin: Plugin) -> bool:
    """Return True if two plugins of one class differ at most in numbers of their records."""
    static_settings = [name for name, setting in collect_settings(type(old_plugin)).items() if not setting.is_parameter]
    return all(_are_equal(getattr(old_plugin, name), getattr(new_plugin, name)) for name in static_settings)


def _are_equal(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if isinstance(a, (np.ndarray, jax.Array)) or isinstance(b, (np.ndarray, jax.Array)):
        return type(a) is type(b) and np.array_equal(a, b)
    try:
        return bool(a == b)
    except ValueError:  # sequences of arrays have no truth value: assume a difference, and compile the step again
        return False


def _carry_over_states(record: PyTree | None, old_record: PyTree | None) -> PyTree | None:
    """Return a record with the states of the previous record, wherever structure, shape and type agree."""
    if record is None or type(record) is not type(old_record):
        return record
    states = {}
    for f in dataclasses.fields(record):  # type: ignore[arg-type]
        new, old = getattr(record, f.name), getattr(old_record, f.name)
        if isinstance(new, PyTree):
            states[f.name] = _carry_over_states(new, old)
        elif not f.metadata.get("static") and f.metadata.get("scope") not in _SETTING_SCOPES:
            states[f.name] = old if _signature(old) == _signature(new) else new
    return record.replace(**states)


def _signature(tree: object) -> tuple[object, list[tuple[object, ...]]]:
    """Return the structure of a tree, and the shapes and types of its leaves."""
    return jax.tree.structure(tree), [(jnp.shape(x), jnp.result_type(x)) for x in jax.tree.leaves(tree)]


def _no_observations(_data: SimData, **_: Any) -> dict[str, Array]:
    return {}


def _observations(plugins: Sequence[Plugin], data: SimData, measured: bool) -> dict[str, Array]:
    def observe_drone(drone: SimData) -> dict[str, Array]:
        measured_drone = with_measured_states(plugins, drone) if measured else drone
        sources = [(p, drone if isinstance(p, Sensor) else measured_drone) for p in plugins]
        return {f"{p.name}.{key}": x for p, values in sources for key, x in p.observations(values).items()}

    leaves, axes = jax.tree.leaves(data), Axes(data)
    world_axes = [0 if n_batch_axes(scope) == 2 else None for scope in axes.scopes]
    observe_drones = vmap_drones(observe_drone)
    world_leaves = [x[:, 0] if scope == "world" else x for scope, x in zip(axes.scopes, leaves, strict=True)]
    return jax.vmap(lambda values: observe_drones(axes.treedef.unflatten(values)), (world_axes,))(world_leaves)
