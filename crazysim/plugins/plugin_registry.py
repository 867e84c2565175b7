"""Registry of a simulation's plugins, the only place where they are added, replaced and removed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.cache import keep_programs
from crazysim.core.data import Objects, SimData, object_names
from crazysim.core.integration import Integration
from crazysim.core.pipeline import Pipeline, append_fn, insert_fn_before
from crazysim.core.plugin import Plugin, Simulation, StagePlacement, with_measured_states
from crazysim.core.population import Population
from crazysim.core.settings import collect_settings
from crazysim.core.stage import Axes, is_first_step, vmap_drones, vmap_worlds
from crazysim.eager import jit_eager_calls
from crazysim.errors import ConfigError, UnknownNameError, short_repr
from crazysim.plugins.sensors.sensor import Sensor
from crazysim.pytree import PyTree, n_batch_axes, watched_flags

P = TypeVar("P", bound=Plugin)

_SETTING_SCOPES = ("parameter", "shared")
"""Scopes of leaves that contain settings. Leaves of all other scopes contain states."""


@dataclasses.dataclass
class _InstalledPlugin:
    """A plugin with the stages that it put into the step pipeline."""

    plugin: Plugin
    stages: dict[str, Callable[..., Any]] = dataclasses.field(default_factory=dict)
    """The stages by name."""
    replaced: dict[str, tuple[str, Callable[..., Any]]] = dataclasses.field(default_factory=dict)
    """Name and function of the stage that was replaced, by the name of the stage that replaced it."""
    before: dict[str, str] = dataclasses.field(default_factory=dict)
    """Name of the stage before which a stage was inserted, by the name of the inserted stage."""
    reads_in_record: bool = False
    """True if the record depends on the scene."""
    reads_in_stages: bool = False
    """True if the stages depend on the scene."""
    version: tuple[int, int] = (0, 0)
    """``PluginRegistry.version`` for which the plugin last read the scene."""


class PluginRegistry(Mapping[str, Plugin]):
    """The plugins of one simulation by name, in the order in which they were added."""

    def __init__(self, sim: Simulation):
        self._sim = sim
        self._installed: dict[str, _InstalledPlugin] = {}
        self._move_objects: dict[str, tuple[Plugin, Callable[..., Any]]] = {}
        self._last_moved: tuple[list[Any], Any] = [], None
        """Arrays that plugins moved objects by last, and these objects."""
        self._observe_fn: tuple[tuple[Plugin, ...], Callable[..., Any]] = (), _no_observations
        self._is_checked = True
        self._is_changing = False
        self._n_changes = 0
        self._last_revision = 0  # of the scene at the last refresh
        self.is_stale = False
        """True if scene or plugins have changed since ``refresh``."""

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
            record, default, reads_in_record = self._make_records(plugin)
            _require_numbers(plugin, default)
            pipeline, installed = self._make_stages(dict(self._sim.step_pipeline), plugin)
            installed.reads_in_record = reads_in_record
            pipeline = _with_influences(pipeline, [*self.values(), plugin], plugin)
            resets = dict(self._sim.reset_pipeline)
            if _is_in_reset_pipeline(plugin):
                append_fn(resets, plugin.stage(plugin.reset_episode), name)
            self._put_records(name, record, default)
            self._installed[name] = installed
            self._build(pipeline, resets)
            installed.version = self.version
        return plugin

    def remove(self, plugin: Plugin | str) -> None:
        """Remove a plugin; see ``Sim.remove``."""
        name = plugin.name if isinstance(plugin, Plugin) else plugin
        removed_plugin, sim = self[name], self._sim
        others = [other for other in self.values() if other.name != name and self._unmet_need(other) is None]
        with self._restore_on_error():
            pipeline = _remove_stages(dict(sim.step_pipeline), self._installed[name])
            pipeline = _with_influences(pipeline, [p for p in self.values() if p.name != name])
            resets = dict(sim.reset_pipeline)
            if _is_in_reset_pipeline(removed_plugin):
                resets.pop(name, None)
            if removed_plugin.moves_objects:
                self._leave_objects(name)
            self._put_records(name, None, None)
            del self._installed[name]
            for other in others:
                if error := self._unmet_need(other):
                    raise ConfigError(
                        f"expected no plugin that needs {name!r}, got {type(other).__name__} {other.name!r}. "
                        f"Use sim.remove({other.name!r}) first."
                    ) from error
            self._build(pipeline, resets)
            self._move_objects.pop(name, None)

    def _unmet_need(self, plugin: Plugin) -> ConfigError | None:
        """Return the error of a plugin that needs another one."""
        try:
            plugin.check_plugins(self._sim)
        except ConfigError as error:
            return error
        return None

    def _leave_objects(self, name: str) -> None:
        """Put the objects of a plugin where it has moved them, as ordinary objects."""
        sim, default = self._sim, self._sim.default_data
        if default.objects is not None and not sim.data.objects.recorded:  # type: ignore[union-attr]
            sim.default_data = default.replace(objects=self._moved_objects(name, default))
            sim.data = sim.data.replace(objects=self._moved_objects(name, sim.data))

    # The scene --------------------------------------------------------------------------------------------------------

    @property
    def version(self) -> tuple[int, int]:
        """Numbers of the changes of the scene and of the plugins so far."""
        return self._sim.scene.revision, self._n_changes

    def mark_changed(self) -> None:
        """Let plugins that read the scene read it again at the next use of the simulation."""
        self._n_changes += 1
        self.is_stale = True

    def refresh(self) -> None:
        """Make records and stages that depend on the scene again, if it or the plugins have changed since.

        States, and numbers that were set in a record, stay as they are, as do edits of the pipeline.
        """
        if self._is_changing or not self.is_stale:
            return
        sim = self._sim
        with self._restore_on_error():
            pipeline = sim.step_pipeline
            stages = dict(pipeline)
            changed = [x for x in self._installed.values() if self._reads_scene(x) and x.version != self.version]
            for installed in changed:
                stages = self._read_scene(installed, stages)
            # Functions of plugins, too, may read the scene while the step is traced.
            if changed or (self._installed and self._last_revision != sim.scene.revision):
                sim.step_pipeline = stages
                sim.build_step_fn()
                pipeline.clear()  # a user may hold the dict to edit it
                pipeline.update(stages)
                sim.step_pipeline = pipeline
            for installed in self._installed.values():
                installed.version = self.version
            self._last_revision = sim.scene.revision
        self.is_stale = False

    @staticmethod
    def _reads_scene(installed: _InstalledPlugin) -> bool:
        return installed.reads_in_record or installed.reads_in_stages

    def _read_scene(self, old: _InstalledPlugin, pipeline: Pipeline) -> Pipeline:
        """Return the pipeline with new stages of a plugin, whose record is made again, too."""
        sim, plugin, name = self._sim, old.plugin, old.plugin.name
        if old.reads_in_record:
            record, default, _ = self._make_records(plugin)
            present = sim.data.plugins.get(name), sim.default_data.plugins.get(name)
            self._put_records(
                name, *[_carry_over(plugin, *xs, ()) for xs in zip((record, default), present, strict=True)]
            )
        edited = {stage: pipeline.get(stage) for stage, fn in old.stages.items() if pipeline.get(stage) is not fn}
        for other in self._installed.values():
            if any(old.stages[k] is fn for k in edited for _, fn in other.replaced.values()):
                raise ConfigError(
                    f"expected no edit of the scene after {other.plugin.name!r} has replaced a stage of {name!r}, "
                    f"which reads the scene. Use sim.scene.add before sim.add({type(other.plugin).__name__}(...))."
                )
        sim.step_pipeline = _remove_stages({k: fn for k, fn in pipeline.items() if k not in edited}, old)
        new_pipeline, new = self._make_stages(dict(sim.step_pipeline), plugin)
        new.reads_in_record = old.reads_in_record
        new.replaced |= {k: x for k, x in old.replaced.items() if k in edited}
        self._installed[name] = new
        present_stages = {k: fn for k, fn in (new_pipeline | edited).items() if fn is not None}
        return _in_order(present_stages, list(pipeline), old, new)

    def adapt_records(self, data: SimData, reference: SimData) -> SimData:
        """Return data with records for the present scene, where they are for an earlier one.

        Args:
            data: The data.
            reference: Data of the present scene.
        """
        for name, installed in self._installed.items() if not self._is_changing else ():
            record, present = data.plugins.get(name), reference.plugins.get(name)
            if installed.reads_in_record and record is not None and _signature(record) != _signature(present):
                data = _with_record(data, name, _carry_over(installed.plugin, present, record, ()))
        return data

    def scene_check(self, reference: SimData) -> Callable[[SimData], None] | None:
        """Return a function that raises an error for data of another scene; None if no plugin reads the scene.

        Args:
            reference: Data of the present scene.
        """
        if not any(map(self._reads_scene, self._installed.values())):
            return None
        scene, revision, names = self._sim.scene, self._sim.scene.revision, object_names(reference)
        layouts = {
            name: _layout(reference.plugins[name])
            for name, installed in self._installed.items()
            if installed.reads_in_record and name in reference.plugins
        }

        def check(data: SimData) -> None:
            is_same = scene.revision == revision and object_names(data) == names
            if is_same and all(_layout(data.plugins.get(name)) == layout for name, layout in layouts.items()):
                return
            raise ConfigError(
                "expected the scene for which the step was built, which its plugins have read, got one that was edited "
                "since, or data of another one. Use sim.step_fn and sim.data after sim.scene.add, or make the "
                "environment then."
            )

        return check

    def _make_records(self, plugin: Plugin) -> tuple[PyTree | None, PyTree | None, bool]:
        """Return record and default record of a plugin, and whether they depend on the scene."""
        n_reads = self._sim.scene.n_reads
        plugin.check_simulation(self._sim)
        record, default = plugin.record(self._sim), plugin.default_record(self._sim)
        return record, default, self._sim.scene.n_reads != n_reads

    def _make_stages(self, pipeline: Pipeline, plugin: Plugin) -> tuple[Pipeline, _InstalledPlugin]:
        """Return the pipeline with the stages of a plugin, and the plugin with its changes to the pipeline."""
        n_reads = self._sim.scene.n_reads
        placements = _stage_placements(plugin, self._sim)
        pipeline, installed = _add_stages(pipeline, plugin, placements)
        installed.reads_in_stages = self._sim.scene.n_reads != n_reads
        return pipeline, installed

    # Changes ----------------------------------------------------------------------------------------------------------

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
        old_record, (record, default, reads_in_record) = sim.data.plugins.get(name), self._make_records(plugin)
        if _have_same_code(old_plugin, plugin) and jax.tree.structure(old_record) == jax.tree.structure(record):
            self._put_records(name, _carry_over(plugin, record, old_record), default)
            self._installed[name] = dataclasses.replace(self._installed[name], plugin=plugin)
            self._is_checked = False
            return plugin
        # The plugin's stages must be created for a pipeline without the plugin.
        sim.step_pipeline = _remove_stages(dict(sim.step_pipeline), self._installed[name])
        pipeline, installed = self._make_stages(dict(sim.step_pipeline), plugin)
        installed.reads_in_record = reads_in_record
        pipeline = _with_influences(pipeline, [plugin if p.name == name else p for p in self.values()], plugin)
        resets = dict(self._sim.reset_pipeline)
        if _is_in_reset_pipeline(plugin) and (name in resets or not _is_in_reset_pipeline(old_plugin)):
            resets[name] = plugin.stage(plugin.reset_episode)
        elif _is_in_reset_pipeline(old_plugin):
            resets.pop(name, None)
        self._put_records(name, _carry_over(plugin, record, old_record), default)
        self._installed[name] = installed
        self._build(pipeline, resets)
        installed.version = self.version
        return plugin

    @contextlib.contextmanager
    def _restore_on_error(self) -> Iterator[None]:
        """Restore the simulation and its scene if an error ends the block."""
        sim, installed, was_changing = self._sim, dict(self._installed), self._is_changing
        self._is_changing = True  # plugins read the scene again after the change
        try:
            data, default, steps, resets = sim.data, sim.default_data, sim.step_pipeline, sim.reset_pipeline
            try:
                with sim.scene.restore_on_error():
                    yield
            except BaseException:
                self._installed = installed
                sim.step_pipeline, sim.reset_pipeline = steps, resets
                sim.data, sim.default_data = data, default
                raise
        finally:
            self._is_changing = was_changing

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
        movers = {name: plugin for name, plugin in self.items() if plugin.moves_objects}
        if data.objects is None or data.objects.recorded or not movers:
            return data
        # The same objects for the same arrays: the scene knows by identity that nothing has moved.
        arrays = [*movers.values(), *jax.tree.leaves((data.states, data.plugins, data.objects))]
        last_arrays, objects = self._last_moved
        if len(arrays) != len(last_arrays) or any(a is not b for a, b in zip(arrays, last_arrays, strict=True)):
            for name in movers:
                data = data.replace(objects=self._moved_objects(name, data))
            objects = data.objects
            self._last_moved = arrays, objects
        return data.replace(objects=objects)

    def _moved_objects(self, name: str, data: SimData) -> Objects:
        plugin = self[name]
        if self._move_objects.get(name, (None, None))[0] is not plugin:
            self._move_objects[name] = plugin, jax.jit(vmap_worlds(lambda data: plugin.bound(data).move_objects(data)))
        return self._move_objects[name][1](data)

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
        self.mark_changed()
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
    episode_stage = plugin.stage(plugin.reset_episode, when=is_first_step)
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
    installed = _InstalledPlugin(plugin)
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
        installed.before[name] = placement.before
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


def _require_numbers(plugin: Plugin, record: Any) -> None:
    """Check that the leaves in which NaN flags a world begin without NaN."""
    flags = zip(jax.tree_util.tree_leaves_with_path(record), jax.tree.leaves(watched_flags(record)), strict=True)
    for (path, x), is_watched in flags:
        if is_watched and x.dtype.kind == "f" and np.isnan(x).any():
            raise ConfigError(
                f"{type(plugin).__name__} {plugin.name!r}: expected numbers in {jax.tree_util.keystr(path)}, got NaN, "
                f"by which worlds are flagged as nonfinite. Use infinity, or a flag of its own."
            )


def _in_order(pipeline: Pipeline, names: list[str], old: _InstalledPlugin, new: _InstalledPlugin) -> Pipeline:
    """Return a pipeline with the stages of a plugin in the order of an earlier one.

    Stages that the plugin did not have are beside its stages that are inserted before the same stage.

    Args:
        pipeline: The pipeline.
        names: Names of the earlier pipeline, in order.
        old: The plugin in the earlier pipeline.
        new: The plugin in the pipeline.
    """
    moved = {name for name in new.stages if (name in new.replaced) != (name in old.replaced)}
    order, previous = [name for name in names if name in pipeline and name not in moved], None
    for name in pipeline:
        if name not in order:
            anchor = new.before.get(name, "")
            beside = [x for x in new.stages if (x == name or x in order) and new.before.get(x) == anchor]
            k = beside.index(name) if beside else 0
            index = 0 if previous is None else order.index(previous) + 1
            if len(beside) > 1:
                index = order.index(beside[k - 1]) + 1 if k else order.index(beside[1])
            order.insert(index, name)
        previous = name
    return {name: pipeline[name] for name in order}


def _carry_over(
    plugin: Plugin, record: PyTree | None, old_record: PyTree | None, setting_scopes: Sequence[str] = _SETTING_SCOPES
) -> PyTree | None:
    """Return a record with the states of the previous record, as far as possible.

    Args:
        plugin: The plugin.
        record: The new record.
        old_record: The previous record.
        setting_scopes: Scopes of leaves that are not states; empty to carry over settings, too.
    """
    carried_record = _carry_over_states(record, old_record, setting_scopes)
    is_same_kind = carried_record is not None and type(carried_record) is type(old_record)
    return plugin.carry_over(carried_record, old_record) if is_same_kind else carried_record


def _carry_over_states(
    record: PyTree | None, old_record: PyTree | None, setting_scopes: Sequence[str]
) -> PyTree | None:
    """Return a record with the states of the previous record, wherever structure, shape and type agree."""
    if record is None or type(record) is not type(old_record):
        return record
    states = {}
    for f in dataclasses.fields(record):  # type: ignore[arg-type]
        new, old = getattr(record, f.name), getattr(old_record, f.name)
        if isinstance(new, PyTree):
            states[f.name] = _carry_over_states(new, old, setting_scopes)
        elif not f.metadata.get("static") and f.metadata.get("scope") not in setting_scopes:
            states[f.name] = old if _signature(old) == _signature(new) else new
    return record.replace(**states)


def _signature(tree: object) -> tuple[object, list[tuple[object, ...]]]:
    """Return the structure of a tree, and the shapes and types of its leaves."""
    return jax.tree.structure(tree), [(jnp.shape(x), jnp.result_type(x)) for x in jax.tree.leaves(tree)]


def _layout(record: PyTree | None) -> tuple[object, list[tuple[int, ...]]]:
    """Return the structure of a record, and the shapes of its leaves without their first axis."""
    return jax.tree.structure(record), [jnp.shape(x)[1:] for x in jax.tree.leaves(record)]


def _no_observations(_data: SimData, **_: Any) -> dict[str, Array]:
    return {}


def _observations(plugins: Sequence[Plugin], data: SimData, measured: bool) -> dict[str, Array]:
    def observe_drone(drone: SimData) -> dict[str, Array]:
        measured_drone = with_measured_states(plugins, drone) if measured else drone
        sources = [(p, drone if isinstance(p, Sensor) else measured_drone) for p in plugins]
        return {
            f"{p.name}.{key}": x for p, values in sources for key, x in p.bound(values).observations(values).items()
        }

    leaves, axes = jax.tree.leaves(data), Axes(data)
    world_axes = [0 if n_batch_axes(scope) == 2 else None for scope in axes.scopes]
    observe_drones = vmap_drones(observe_drone)
    world_leaves = [x[:, 0] if scope == "world" else x for scope, x in zip(axes.scopes, leaves, strict=True)]
    return jax.vmap(lambda values: observe_drones(axes.treedef.unflatten(values)), (world_axes,))(world_leaves)
