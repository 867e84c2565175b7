"""Helpers shared by tests: pairs of dynamics and command level, hover commands, random vectors, scenes."""

import ast
import dataclasses
import functools
import inspect
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from crazysim import Sim, load_airframe, reduce_over_others, stage
from crazysim.core import functional as F
from crazysim.core.controls import SimControls
from crazysim.core.data import create_params
from crazysim.core.plugin import Plugin
from crazysim.dynamics import first_principles
from crazysim.engine.backends import native
from crazysim.engine.pytree import PyTree
from crazysim.engine.record import nonfinite_worlds
from crazysim.engine.stage import as_stages

FITTED_DYNAMICS = ("so_rpy", "so_rpy_rotor", "so_rpy_rotor_drag")
LEVELS = ("state", "attitude", "body_rate", "force_torque", "rotor_vel")
PAIRS = tuple(("first_principles", control) for control in LEVELS) + tuple(
    (dynamics, control) for dynamics in FITTED_DYNAMICS for control in ("state", "attitude")
)
"""All 11 valid pairs of dynamics and command level."""
CHOSEN_PAIRS = (*PAIRS[:5], ("so_rpy", "attitude"), ("so_rpy_rotor_drag", "state"))
"""Pairs that stand for all: every command level, and the fits with the fewest and the most terms."""
INTEGRATORS = ("euler", "symplectic_euler", "rk4")
COMPILED_ENGINES = ("lanes", "fused") if native.compiler() else ("lanes",)
"""Compiled engines that this machine can run."""
needs_compiler = pytest.mark.skipif(native.compiler() is None, reason="no C++ compiler here")

BOX = """
<mujoco>
  <worldbody>
    <body name="obstacle">
      <geom type="box" size="0.1 0.1 0.1" rgba="0.8 0.2 0.2 1"/>
    </body>
  </worldbody>
</mujoco>
"""
"""The obstacle of the documentation."""
CAMERA_HEIGHT = 2.0
"""Height of the cameras of the plain scene, m."""
FOVY = 45.0
"""Vertical fields of view, degrees."""
PLAIN_SCENE = f"""
<mujoco>
  <statistic center="0 0 0.5" extent="2"/>
  <visual><headlight ambient="0.5 0.5 0.5" diffuse="0.4 0.4 0.4" specular="0 0 0"/><quality shadowsize="0"/></visual>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" rgba="0.9 0.9 0.9 1"/>
    <camera name="down" pos="0 0 {CAMERA_HEIGHT}" fovy="{FOVY}"/>
    <camera name="aside" pos="5 0 {CAMERA_HEIGHT}" fovy="{FOVY}"/>
  </worldbody>
</mujoco>
"""
"""A floor of one colour without shadows, under two cameras that look straight down, 5 m apart."""


def vectors(n=3, max_abs=10.0, **options):
    """Return a strategy for vectors of ``n`` numbers between ``-max_abs`` and ``max_abs``."""
    return arrays(np.float64, n, elements=st.floats(-max_abs, max_abs, **options))


def unit_quats(**options):
    nonzero_vectors = vectors(4, 1.0, **options).filter(lambda q: np.linalg.norm(q) > 0.1)
    return nonzero_vectors.map(lambda q: q / np.linalg.norm(q))


def controller_params(record, **changes):
    params = record.create(load_airframe("cf21B_500"))
    return params.replace(**{k: jnp.asarray(v, float) for k, v in changes.items()})


def send(data, command, **kwargs):
    return getattr(F, f"{data.controls.mode.value}_control")(data, command, **kwargs)


def command_in_force(data):
    """Return the command that the controller of the simulation's command level currently follows."""
    mode = data.controls.mode.value
    return data.controls.rotor_vel if mode == "rotor_vel" else getattr(data.controls, mode).cmd


def with_states(data, **changes):
    """Return the data with some states replaced; values are broadcast to all drones and cast."""
    states = data.states
    return data.replace(states=states.replace(**{k: broadcast_like(v, getattr(states, k)) for k, v in changes.items()}))


def with_record(plugin, data, **changes):
    """Return the data with some fields of a plugin's record replaced; values are broadcast and cast."""
    record = plugin.read(data)
    return plugin.write(data, record.replace(**{k: broadcast_like(v, getattr(record, k)) for k, v in changes.items()}))


def broadcast_like(value, template):
    """Return a value as an array of a template's shape and type; NumPy arrays are broadcast without a compiled call."""
    if isinstance(value, jax.Array):
        return jnp.broadcast_to(value.astype(template.dtype), template.shape)
    return jax.device_put(np.array(np.broadcast_to(np.asarray(value, template.dtype), template.shape)))


def with_params(data, **changes):
    """Return the data with some parameters of the dynamics replaced, without broadcasting."""
    return data.replace(params=data.params.replace(**{k: jnp.asarray(v) for k, v in changes.items()}))


def with_airframes(sim, airframes):
    """Return the data with the parameters and gains of an airframe for each world; numbers of rotors must be equal."""

    distinct_airframes = list(dict.fromkeys(airframes))
    kind_indices = [distinct_airframes.index(airframe) for airframe in airframes]

    def stacked(shared):
        return jax.tree.map(lambda *x: jax.device_put(np.stack(x)[kind_indices][:, None]), *shared)

    params = stacked([create_params(sim.dynamics, airframe) for airframe in distinct_airframes])
    settings = sim.configuration.control_freqs, sim.configuration.controller
    per_airframe = [
        SimControls.create(1, 1, sim.control, sim.dynamics, airframe, *settings) for airframe in distinct_airframes
    ]
    controls = sim.data.controls
    for name in ("state", "attitude", "body_rate", "force_torque"):
        ctrl = getattr(controls, name)
        if ctrl is not None and ctrl.params is not None:
            airframe_params = stacked([getattr(c, name).params for c in per_airframe])
            controls = controls.replace(**{name: ctrl.replace(params=airframe_params)})
    return sim.data.replace(params=params, controls=controls)


def weight(data):
    """Return the weight of a drone whose parameters are shared, N."""
    return float(data.params.mass[0]) * 9.81


def hover_thrust(data):
    """Return the collective thrust command that carries the weight, N; a fitted model scales its command."""
    p = data.params
    return weight(data) if isinstance(p, first_principles.Params) else weight(data) / float(p.cmd_f_coef[0])


def hover_rotor_state(data):
    """Return ``states.rotor_vel`` in hover: rotor speeds, rpm, or for a fitted model the thrust, N."""
    p = data.params
    if isinstance(p, first_principles.Params):
        return np.asarray(first_principles.hover_rotor_vel(p), np.float64)
    return np.full(data.states.rotor_vel.shape[-1], hover_thrust(data))


def hover_command(data, pos=(0.0, 0.0, 1.0)):
    """Return the command with which one drone hovers; at state level, it hovers at a position. (k,)"""
    mode = data.controls.mode.value
    if mode == "state":
        return np.array([*pos, *np.zeros(6), 0, 0, 0, 1, 0, 0, 0], np.float64)
    if mode == "rotor_vel":
        return hover_rotor_state(data)
    thrust = hover_thrust(data)
    return np.array([thrust, 0, 0, 0] if mode == "force_torque" else [0, 0, 0, thrust], np.float64)


def zero_thrust_command(data):
    """Return the command of one drone for zero thrust. (k,)

    At state level: a setpoint at the origin with a downward acceleration of 9.81 m/s^2. At all other levels: zeros.
    """
    command = np.zeros_like(hover_command(data))
    if data.controls.mode.value == "state":
        command[8] = -9.81
    return command


def repeat_command(data, command):
    return np.broadcast_to(command, (*data.states.pos.shape[:2], len(command)))


def trees_equal(a, b):
    """Return True if two trees hold equal values; NaN equals NaN."""
    leaves_a, leaves_b = (jax.tree.leaves(jax.tree.map(leaf_on_host, tree)) for tree in (a, b))
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        np.array_equal(x, y, equal_nan=np.issubdtype(x.dtype, np.floating))
        for x, y in zip(leaves_a, leaves_b, strict=True)
    )


def leaf_on_host(x):
    is_key = isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(x) if is_key else x)


@stage("drone")
def repulsion(data):
    pos = data.states.pos

    def push(other_pos, is_self):
        offset = pos - other_pos
        return jnp.where(is_self, 0.0, 1e-3 * offset / (jnp.dot(offset, offset) + 0.01))

    force = reduce_over_others(push, values=pos, reduce="sum")
    return data.replace(states=data.states.replace(force=force))


@stage("drone")
def gap(data):
    """Push a drone up by the squared distance to its nearest neighbour.

    A term of value zero is added, which contains a maximum of equal numbers: a special case for gradients.
    """
    pos = data.states.pos
    square_distance = reduce_over_others(
        lambda other_pos, is_self: jnp.where(is_self, jnp.inf, jnp.sum((pos - other_pos) ** 2)), pos, "min"
    )
    equal = reduce_over_others(lambda other_pos, _: other_pos[1] - jax.lax.stop_gradient(other_pos[1]), pos, "max")
    return data.replace(states=data.states.replace(force=jnp.zeros(3).at[2].set(1e-3 * (square_distance + equal))))


@stage("world")
def centre(data):
    pos = data.states.pos
    return data.replace(states=data.states.replace(force=1e-2 * (jnp.mean(pos, axis=0) - pos)))


def build_stagewise_step(sim):
    """Return a step that runs the stages without an engine; its derivative compiles fastest."""
    stages = as_stages(sim.step_pipeline)

    def step(data, n_steps):
        def advance(data, _):
            for stage_fn in stages:
                data = stage_fn(data)
            return data, None

        data, _ = jax.lax.scan(advance, data, length=n_steps)
        return data.replace(core=data.core.replace(nonfinite=nonfinite_worlds(data)))

    return step


def make_hovering_sim(n_worlds=3, n_drones=2, **kwargs):
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, rng_key=4, **kwargs)
    grid = 0.1 * np.arange(n_worlds * n_drones * 3).reshape(n_worlds, n_drones, 3) + [0, 0, 1.0]
    sim.data = with_states(sim.data, pos=grid, rotor_vel=hover_rotor_state(sim.data))
    sim.build_default_data()
    return sim


@functools.cache
def shared_sim(**settings):
    """Return a simulation that several tests share; it is compiled once, and tests must restore its data."""
    return Sim(**settings)


def count_documented_arrays(record, **sizes):
    """Check that the docstring of every array of a record ends with its shape, and return the number of arrays."""
    shapes, n_arrays = _documented_shapes(type(record)), 0
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        for part in value if isinstance(value, tuple) else (value,):
            if isinstance(part, PyTree):
                n_arrays += count_documented_arrays(part, **sizes)
            elif isinstance(part, (jax.Array, np.ndarray)):
                words, title = shapes[field.name], f"{type(record).__name__}.{field.name}"
                assert words is not None, f"{title} has no shape in its docstring"
                assert tuple(sizes.get(w) or int(w) for w in re.findall(r"\w+", words)) == part.shape, title
                n_arrays += 1
    return n_arrays


def _documented_shapes(record):
    """Return the shape that the docstring of every field of a record ends with, None where it has none."""
    base = record.__bases__[-1]
    shapes = {} if base in (PyTree, Plugin) else _documented_shapes(base)
    body = ast.parse(inspect.getsource(record)).body[0].body
    for field, text in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign):
            if field.target.id in ("_", "name") or "ClassVar" in ast.unparse(field.annotation):
                continue
            assert isinstance(text, ast.Expr), f"{record.__name__}.{field.target.id} has no docstring"
            shape = re.search(r"\(([\w, ]*)\)$", text.value.value)
            shapes[field.target.id] = None if shape is None else shape[1]
    return shapes
