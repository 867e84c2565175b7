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

from crazysim.core.data import Objects, SimData, object_names
from crazysim.core.plugin import Plugin, Simulation, with_measured_states
from crazysim.core.population import Population
from crazysim.core.settings import collect_settings
from crazysim.eager import jit_eager_calls
from crazysim.engine.cache import keep_programs
from crazysim.engine.pytree import PyTree, n_batch_axes, watched_flags
from crazysim.engine.stage import Axes, vmap_drones, vmap_worlds
from crazysim.errors import ConfigError, UnknownNameError, expect, require
from crazysim.plugins.plugin_stages import PluginStages
from crazysim.plugins.sensors.sensor import Sensor

P = TypeVar("P", bound=Plugin)

_SETTING_SCOPES = ("parameter", "shared")
"""Scopes of leaves that contain settings. Leaves of all other scopes contain states."""


class PluginRegistry(Mapping[str, Plugin]):
    """The plugins of one simulation by name, in the order in which they were added."""

    def __init__(self, sim: Simulation):
        self._sim = sim
        self._stages = PluginStages(sim)
        self._record_readers: set[str] = set()
        """Names of the plugins whose records depend on the scene."""
        self._move_objects: dict[str, tuple[Plugin, Callable[..., Any]]] = {}
        self._last_moved: tuple[list[Any], Any] = [], None
        """Arrays that plugins moved objects by last, and these objects."""
        self._observe_fn: tuple[list[Any], Callable[..., Any]] = [], _no_observations
        self._is_checked = True
        self._is_changing = False
        self._last_revision = 0  # of the scene at the last refresh
        self.is_stale = False
        """Whether scene or plugins have changed since ``refresh``."""

    def __getitem__(self, name: str) -> Plugin:
        require(
            name in self._stages.plugins,
            f"expected the name of an added plugin, got {name!r}. Added are: {', '.join(self) or 'none'}.",
            UnknownNameError,
        )
        return self._stages.plugins[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._stages.plugins)

    def __len__(self) -> int:
        return len(self._stages.plugins)

    def __contains__(self, name: object) -> bool:
        return name in self._stages.plugins

    def __repr__(self) -> str:
        return f"<plugins {', '.join(f'{name}: {type(x).__name__}' for name, x in self.items()) or 'none'}>"

    def add(self, plugin: P, name: str | None = None) -> P:
        """Add a plugin; see ``Sim.add``."""
        expect(isinstance(plugin, Plugin), "a plugin", plugin, "Use sim.add(Wind(...)), or your subclass of Plugin.")
        plugin = plugin if name is None else dataclasses.replace(plugin, name=name)  # type: ignore[type-var]
        name, kind = plugin.name, type(plugin).__name__
        expect(isinstance(name, str) and name, f"a non-empty string as name of a {kind}", name)
        require(
            name not in self,
            f"{name} is already enabled. Use sim.replace({kind}(...)) to change it, or "
            f"sim.add({kind}(...), name=...) to add another one.",
        )
        require(
            name not in self._sim.data.plugins,
            f"data.plugins already has a record {name!r}. Use sim.add(..., name=...).",
        )
        self._require_unused_names(plugin, self._sim.names)
        self._require_unique_terms(plugin, self.values())
        with self._restore_on_error():
            record, default = self._make_records(plugin)
            _require_numbers(plugin, default)
            self._put_records(name, record, default)
            self._stages.set_plugin(name, plugin)
            self._build(plugin, [name])
        return plugin

    def remove(self, plugin: Plugin | str) -> None:
        """Remove a plugin; see ``Sim.remove``."""
        name = plugin.name if isinstance(plugin, Plugin) else plugin
        removed_plugin = self[name]
        others = [other for other in self.values() if other.name != name and self._unmet_need(other) is None]
        with self._restore_on_error():
            if removed_plugin.moves_objects:
                self._leave_objects(name)
            self._put_records(name, None, None)
            self._stages.set_plugin(name, None)
            self._record_readers = self._record_readers - {name}
            for other in others:
                if error := self._unmet_need(other):
                    raise ConfigError(
                        f"expected no plugin that needs {name!r}, got {type(other).__name__} {other.name!r}. "
                        f"Use sim.remove({other.name!r}) first."
                    ) from error
            self._build()
            self._move_objects.pop(name, None)

    def _unmet_need(self, plugin: Plugin) -> ConfigError | None:
        try:
            plugin.check_plugins(self._sim)
        except ConfigError as error:
            return error
        return None

    def _leave_objects(self, name: str) -> None:
        sim, default = self._sim, self._sim.default_data
        if default.objects is not None and not sim.data.objects.recorded:  # type: ignore[union-attr]
            sim.default_data = default.replace(objects=self._moved_objects(name, default))
            sim.data = sim.data.replace(objects=self._moved_objects(name, sim.data))

    # The scene --------------------------------------------------------------------------------------------------------

    def refresh(self) -> None:
        """Make records and stages that depend on the scene again, if it or the plugins have changed since.

        States, and numbers that were set in a record, stay as they are, as do edits of the pipeline.
        """
        if self._is_changing or not self.is_stale:
            return
        sim = self._sim
        with self._restore_on_error():
            readers = [name for name in self if name in self._scene_readers]
            for name in self._record_readers.intersection(readers):
                self._remake_records(name)
            # Functions of plugins, too, may read the scene while the step is traced.
            if readers or (len(self) and self._last_revision != sim.scene.revision):
                self._stages.build(remake=readers)
                sim.build_step_fn()
            self._last_revision = sim.scene.revision
        self.is_stale = False

    def _remake_records(self, name: str) -> None:
        records, datas = self._make_records(self[name]), (self._sim.data, self._sim.default_data)
        present = [data.plugins.get(name) for data in datas]
        self._put_records(name, *[_carry_over(self[name], *xs, ()) for xs in zip(records, present, strict=True)])

    @property
    def _scene_readers(self) -> set[str]:
        return self._record_readers | self._stages.scene_readers

    def adapt_records(self, data: SimData, reference: SimData) -> SimData:
        """Return data with records for the present scene, where they are for an earlier one.

        Args:
            reference: Data of the present scene.
        """
        for name in self._record_readers if not self._is_changing else ():
            record, present = data.plugins.get(name), reference.plugins.get(name)
            if record is not None and _signature(record) != _signature(present):
                data = _with_record(data, name, _carry_over(self[name], present, record, ()))
        return data

    def data_check(self, reference: SimData) -> Callable[[SimData], None]:
        """Return a function that checks the plugins, and raises an error for data of another scene if they read it.

        Args:
            reference: Data of the present scene.
        """
        check_plugins = self.plugin_check()
        if not self._scene_readers:
            return check_plugins
        scene, revision, names = self._sim.scene, self._sim.scene.revision, object_names(reference)
        layouts = {name: _layout(reference.plugins[name]) for name in self._record_readers if name in reference.plugins}

        def check(data: SimData) -> None:
            check_plugins(data)
            is_same = scene.revision == revision and object_names(data) == names
            if is_same and all(_layout(data.plugins.get(name)) == layout for name, layout in layouts.items()):
                return
            raise ConfigError(
                "expected the scene for which the step was built, which its plugins have read, got one that was edited "
                "since, or data of another one. Use sim.step_fn and sim.data after sim.scene.add, or make the "
                "environment then."
            )

        return check

    def _make_records(self, plugin: Plugin) -> tuple[PyTree | None, PyTree | None]:
        n_reads = self._sim.scene.n_reads
        plugin.check_simulation(self._sim)
        record, default = plugin.record(self._sim), plugin.default_record(self._sim)
        if self._sim.scene.n_reads != n_reads:
            self._record_readers = self._record_readers | {plugin.name}
        return record, default

    # Changes ----------------------------------------------------------------------------------------------------------

    def replace(self, plugin: P) -> P:
        """Replace the settings of a plugin; see ``Sim.replace``."""
        with self._restore_on_error():
            return self._replace_plugin(plugin)

    def _replace_plugin(self, plugin: P) -> P:
        expect(isinstance(plugin, Plugin), "a plugin", plugin, "Use sim.replace(Wind(...)), for example.")
        old_plugin = self[plugin.name]
        require(
            type(old_plugin) is type(plugin),
            f"expected a {type(old_plugin).__name__} to replace {plugin.name!r}, got a {type(plugin).__name__}. "
            f"Use sim.remove({plugin.name!r}) first, or another name=.",
        )
        sim, name = self._sim, plugin.name
        self._require_unused_names(plugin, [other for other in sim.names if other not in self.members_of(old_plugin)])
        self._require_unique_terms(plugin, [other for other in self.values() if other is not old_plugin])
        old_record, (record, default) = sim.data.plugins.get(name), self._make_records(plugin)
        self._put_records(name, _carry_over(plugin, record, old_record), default)
        is_new = not _have_same_code(old_plugin, plugin) or jax.tree.structure(old_record) != jax.tree.structure(record)
        self._stages.set_plugin(name, plugin)
        self._is_checked = False
        changed = [name]
        for other in self.values():  # companions come before the plugins that read them
            if other.companions.keys() & changed:
                self._stages.set_plugin(other.name, other)
                self._remake_records(other.name)
                changed.append(other.name)
        remake = changed[0 if is_new else 1 :]
        if remake and (is_new or _signature(old_record) != _signature(record)):
            self._build(plugin, remake)
        return plugin

    @contextlib.contextmanager
    def _restore_on_error(self) -> Iterator[None]:
        sim, was_changing = self._sim, self._is_changing
        self._is_changing = True  # plugins read the scene again after the change
        try:
            data, default, restore_stages = sim.data, sim.default_data, self._stages.begin_change()
            readers = self._record_readers
            try:
                with sim.scene.restore_on_error():
                    yield
            except BaseException:
                self._record_readers = readers
                restore_stages()
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
        return self._stages.reset_stages

    @property
    def members(self) -> tuple[str, ...]:
        return tuple([name for plugin in self.values() for name in self.members_of(plugin)])

    def _require_unused_names(self, plugin: Plugin, used_names: Collection[str]) -> None:
        used_names = set(used_names)
        duplicates = [name for name in self.members_of(plugin) if name in used_names]
        if duplicates:
            raise ConfigError(
                f"expected names that are not in use, got {duplicates[0]!r} again. Use "
                f"{type(plugin).__name__}([...]) with other names."
            )

    @staticmethod
    def _require_unique_terms(plugin: Plugin, others: Iterable[Plugin]) -> None:
        for other in others:
            if shared_terms := set(plugin.replaced_terms) & set(other.replaced_terms):
                raise ConfigError(
                    f"expected one plugin for {' and '.join(sorted(shared_terms))}, got {type(other).__name__} "
                    f"{other.name!r} and {type(plugin).__name__} {plugin.name!r}, which would both provide it. "
                    f"Use one of the two: sim.remove({other.name!r}) removes the first."
                )

    def check(self) -> None:
        """Check the plugins that each plugin requires, if the plugins have changed since the last check."""
        if self._is_checked or self._is_changing:
            return
        with jax.ensure_compile_time_eval():  # inside a user's trace, too
            for plugin in self.values():
                plugin.check_plugins(self._sim)
        self._is_checked = True

    def plugin_check(self) -> Callable[[SimData], None]:
        """Return ``check`` for a step or reset with the present plugins, which later ones do not concern."""
        names = [*self]
        return lambda _: self.check() if names == [*self] else None

    def build_records(self) -> None:
        """Put a new record of every plugin into the simulation's data."""
        for name, plugin in self.items():
            self._set_record(name, plugin.record(self._sim))

    def observations(self, data: SimData, measured: bool = False) -> dict[str, Array]:
        """Return the observations of all plugins, as ``"plugin.name"``. (n_worlds, n_drones, k) each

        Args:
            data: The data of all worlds.
            measured: Whether observations are calculated from the states as sensors measure them.
        """
        plugins = tuple(self.values())
        # What has arrays is read from the data; its settings are part of their structure.
        key = [(p.name, type(p)) if isinstance(data.plugins.get(p.name), type(p)) else p for p in plugins]
        is_changed = key != self._observe_fn[0]
        if is_changed:
            self._observe_fn = key, jit_eager_calls("measured")(functools.partial(_observations, plugins))
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
        # Each record is first assigned to ``sim.data``, which moves it to the simulation's devices.
        self._set_record(name, default)
        current = self._sim.data.plugins.get(name)
        self._sim.default_data = _with_record(self._sim.default_data, name, current)
        self._set_record(name, record)

    def _set_record(self, name: str, record: PyTree | None) -> None:
        require(
            record is None or isinstance(record, PyTree),
            f"expected record of plugin {name!r} to return a PyTree or None, got {type(record).__name__}. Use a "
            f"subclass of PyTree that declares its arrays with leaf(...).",
        )
        self._sim.data = _with_record(self._sim.data, name, record)

    def _build(self, changed: Plugin | None = None, remake: Collection[str] = ()) -> None:
        self._is_checked = False
        self._stages.build(remake, changed)
        self._sim.build_step_fn()
        self.is_stale = self.is_stale or not self._scene_readers <= {*remake}


def _with_record(data: SimData, name: str, record: PyTree | None) -> SimData:
    others = {key: value for key, value in data.plugins.items() if key != name}
    return data.replace(plugins=others if record is None else others | {name: record})


def _have_same_code(old_plugin: Plugin, new_plugin: Plugin) -> bool:
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
    flags = zip(jax.tree_util.tree_leaves_with_path(record), jax.tree.leaves(watched_flags(record)), strict=True)
    for (path, x), is_watched in flags:
        if is_watched and x.dtype.kind == "f" and np.isnan(x).any():
            raise ConfigError(
                f"{type(plugin).__name__} {plugin.name!r}: expected numbers in {jax.tree_util.keystr(path)}, got NaN, "
                f"by which worlds are flagged as nonfinite. Use infinity, or a flag of its own."
            )


def _carry_over(
    plugin: Plugin, record: PyTree | None, old_record: PyTree | None, setting_scopes: Sequence[str] = _SETTING_SCOPES
) -> PyTree | None:
    carried_record = _carry_over_states(record, old_record, setting_scopes)
    is_same_kind = carried_record is not None and type(carried_record) is type(old_record)
    return plugin.carry_over(carried_record, old_record) if is_same_kind else carried_record


def _carry_over_states(
    record: PyTree | None, old_record: PyTree | None, setting_scopes: Sequence[str]
) -> PyTree | None:
    if record is None or type(record) is not type(old_record):
        return record
    states = {}
    for f in dataclasses.fields(record):  # type: ignore[arg-type]
        new, old, data = getattr(record, f.name), getattr(old_record, f.name), f.metadata
        scope = "parameter" if data.get("constant") else data.get("scope")
        if isinstance(new, PyTree):
            states[f.name] = _carry_over_states(new, old, setting_scopes)
        elif not (data.get("static") or scope in setting_scopes or (data.get("optional") and scope in _SETTING_SCOPES)):
            states[f.name] = old if _signature(old) == _signature(new) else new
    return record.replace(**states)


def _signature(tree: object) -> tuple[object, list[tuple[object, ...]]]:
    return jax.tree.structure(tree), [(jnp.shape(x), jnp.result_type(x)) for x in jax.tree.leaves(tree)]


def _layout(record: PyTree | None) -> tuple[object, list[tuple[int, ...]]]:
    return jax.tree.structure(record), [jnp.shape(x)[1:] for x in jax.tree.leaves(record)]


def _no_observations(_data: SimData, **_: Any) -> dict[str, Array]:
    return {}


def _observations(plugins: Sequence[Plugin], data: SimData, measured: bool) -> dict[str, Array]:
    def observe_drone(drone: SimData) -> dict[str, Array]:
        measured_drone = with_measured_states(plugins, drone) if measured else drone
        sources = [(p, drone if isinstance(p, Sensor) else measured_drone) for p in plugins]
        observations: dict[str, Array] = {}
        for p, values in sources:
            measured_values = p.bound(values).observations(values)
            expect(
                isinstance(measured_values, Mapping), f"observations of {p.name!r} as a dict by name", measured_values
            )
            for key, x in measured_values.items():
                expect(
                    isinstance(x, (jax.Array, np.ndarray)) and x.ndim == 1,
                    f"observation {key!r} of plugin {p.name!r} of shape (k,) for one drone",
                    getattr(x, "shape", x),
                    "Use jnp.atleast_1d(x) for a number, and x.reshape(-1) for more axes.",
                )
                observations[f"{p.name}.{key}"] = x
        return observations

    leaves, axes = jax.tree.leaves(data), Axes(data)
    world_axes = [0 if n_batch_axes(scope) == 2 else None for scope in axes.scopes]
    observe_drones = vmap_drones(observe_drone)
    world_leaves = [x[:, 0] if scope == "world" else x for scope, x in zip(axes.scopes, leaves, strict=True)]
    return jax.vmap(lambda values: observe_drones(axes.treedef.unflatten(values)), (world_axes,))(world_leaves)
