"""Checked calls of the methods of plugins that the integration uses: influences, derivatives and constraints."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData, SimStateDeriv
from crazysim.core.plugin import Plugin
from crazysim.engine.pytree import scopes
from crazysim.errors import ConfigError

T = TypeVar("T")


def apply_influence(plugin: Plugin, data: SimData) -> SimData:
    """Return the data with the plugin's ``influence`` applied, for the dynamics only.

    An influence may change the inputs of the dynamics: ``states.force``, ``states.torque``, the rotor command
    (``controls.attitude.cmd`` in fitted dynamics) and ``params``. Other changes are refused. They would be lost without
    an effect, or the derivative would be evaluated at a state that the drone does not have.
    """
    title = f"influence of plugin {plugin.name!r} ({type(plugin).__name__})"
    changed_data = _call_method(title, plugin.bound(data).influence, data)
    if not isinstance(changed_data, SimData):
        raise ConfigError(f"expected {title} to return SimData, got {type(changed_data).__name__}. Use 'return data'.")
    paths, treedef = jax.tree_util.tree_flatten_with_path(data)
    if jax.tree.structure(changed_data) != treedef:
        raise ConfigError(
            f"expected {title} to keep the structure of SimData, but a field became None, or a record was added or "
            f"removed. Add records with sim.add."
        )
    # Only forces, the command and parameters may change.
    command = "controls.attitude.cmd" if data.controls.rotor_vel is None else "controls.rotor_vel"
    writable_fields = ("states.force", "states.torque", command)
    for (path, old), new in zip(paths, jax.tree.leaves(changed_data), strict=True):
        if new is old:
            continue
        field = jax.tree_util.keystr(path).lstrip(".")
        if field in writable_fields:
            if jnp.shape(new) != jnp.shape(old):
                raise ConfigError(f"expected {title} to return {field} of shape {old.shape}, got {jnp.shape(new)}")
        elif not field.startswith("params."):
            raise ConfigError(
                f"expected {title} to write only {', '.join(writable_fields)} and params, got other values of "
                f"{field}. Use a stage of the plugin to change states, records or other commands, and 'derivative' for "
                f"the rates of its own states."
            )
    _check_params(title, data.params, changed_data.params)
    return changed_data


def plugin_rates(plugin: Plugin, data: SimData) -> dict[str, Array]:
    """Return the time derivatives of a plugin's states, by field of its record, after checking them."""
    title = f"derivative of plugin {plugin.name!r} ({type(plugin).__name__})"
    rates = _call_method(title, plugin.bound(data).derivative, data, plugin.scope)
    if not isinstance(rates, Mapping):
        raise ConfigError(
            f"expected {title} to return a dict of fields of its record to rates, got {type(rates).__name__}. "
            f"Use 'return {{}}' for none."
        )
    # States of the record, which may have rates.
    record = data.plugins.get(plugin.name)
    field_scopes = None if record is None else scopes(record)
    fields = [] if record is None else [f.name for f in dataclasses.fields(record) if not f.metadata.get("static")]
    state_names = [name for name in fields if getattr(field_scopes, name) == plugin.scope]
    for field, rate in rates.items():
        if field not in state_names:
            owner = "drone" if plugin.scope == "drone" else "member"
            remedy = f"{field}: Array = state((3,))" if isinstance(record, Plugin) else f"leaf({owner!r}, ...)"
            raise ConfigError(
                f"expected {title} to return rates of states of {owner}s in its record, which are "
                f"{', '.join(map(repr, state_names)) or 'none'}, got one of {field!r}. Declare such a state with "
                f"{remedy}."
            )
        x = getattr(record, field)
        has_same_type = jnp.issubdtype(x.dtype, jnp.floating) and jnp.result_type(x, rate) == x.dtype
        if jnp.shape(rate) != x.shape or not has_same_type:
            raise ConfigError(
                f"expected {title} to return a rate of {field!r} with its shape {x.shape} and floating type "
                f"{x.dtype}, got shape {jnp.shape(rate)} and type {jnp.result_type(rate)}"
            )
    return dict(rates)


def apply_constraint(plugin: Plugin, data: SimData, deriv: SimStateDeriv, dt: float | None) -> SimStateDeriv:
    """Return the derivative with the constraint of a plugin applied."""
    title = f"constrain of plugin {plugin.name!r} ({type(plugin).__name__})"
    return _call_method(
        title, lambda scope_data: plugin.bound(scope_data).constrain(scope_data, deriv, dt), data, plugin.coupling
    )


def _call_method(title: str, method: Callable[[SimData], T], data: SimData, scope: str = "drone") -> T:
    try:
        return method(data)
    except Exception as error:
        shape = "(3,)" if scope == "drone" else "(n_drones, 3)"
        error.add_note(f"in {title}, which is written for one {scope}: data.states.pos is {shape}")
        raise


def _check_params(title: str, before: Any, after: Any) -> None:
    for f in dataclasses.fields(before):
        old, new = getattr(before, f.name), getattr(after, f.name)
        if new is old:
            continue
        core = f.metadata.get("core")
        if jnp.ndim(new) != jnp.ndim(old) or (core is not None and jnp.shape(new)[-len(core) :] != core):
            raise ConfigError(
                f"expected {title} to return params.{f.name} of shape {core or jnp.shape(old)}, got {jnp.shape(new)}"
            )
