"""All stages of a step: every engine computes the same as ``plain``, and worlds do not depend on each other.

``tests/envs/test_env_step.py`` has the sweep over environments.
"""

import importlib
import pkgutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sweep
from cases import COMPILED_ENGINES, leaf_on_host

import crazysim.lab.bodies
import crazysim.lab.estimators
import crazysim.lab.plugins
import crazysim.lab.vehicles
from crazysim import Plugin, plugins
from crazysim.control.controllers import CONTROLLERS
from crazysim.engine import Step, plan
from crazysim.engine.backends import kernel
from crazysim.engine.lowering.stages import lower_stages
from crazysim.engine.pytree import scopes
from crazysim.plugins.sensors.image_sensor import ImageSensor

ENGINES = ("interpret", *COMPILED_ENGINES)
N_STEPS = 20
"""Number of steps of each simulation; all sensors and controllers have ticks within them."""
FEWER = 3
"""Number of worlds of the engines; ``plain`` has more."""
ON_LANES = (
    *[f"first_principles-{control}" for control in ("state-euler", "rotor_vel-symplectic_euler")],
    "so_rpy_rotor_drag-attitude-symplectic_euler",
    *("randomize", "shared", "vehicles", "scenery", "objects", "distances", "populations", "many members"),
    *("stages of all scopes", "pairs of 17"),
)
"""Simulations that together have every kind of loop, table, reduction and scope; ``lanes`` steps only these, since XLA
compiles it the longest."""
NOT_ON_LANES = ("kalman", "eskf", "terrain")
"""Simulations that take XLA more than 30 s to compile for ``lanes``."""
CONTACTS_OF_WORLDS = ("bodies", "collisions")
"""Simulations whose contacts every engine leaves to XLA, which compiles them again for each: one compiled engine."""
OTHER_WORLDS = ("stages of all scopes",)
"""Simulations whose worlds depend on each other."""
ONE_SIZE = ("randomize", "fleet", "populations", "populations of equal sizes", "many members", *OTHER_WORLDS)
"""Simulations with a fixed number of worlds."""


@pytest.fixture(autouse=True)
def _lower_once(monkeypatch):
    """Lower the stages of a test once: their program does not depend on the engine, which only writes it."""
    programs = {}

    def lower(stages, data, zeros=(), **options):
        key = tuple(stage.__name__ for stage in stages), data.core.n_worlds, zeros, options["population"]
        if key not in programs:
            programs[key] = lower_stages(stages, data, zeros, **options)
        return programs[key]

    monkeypatch.setattr(plan, "lower_stages", lower)


@pytest.mark.long("compiles every stage of the package for every engine")
@pytest.mark.parametrize("name", sweep.CASES)
def test_every_engine_agrees_with_plain(name):
    """Law 10 too: engines have fewer worlds, which draw the same numbers."""
    left_out = {*(() if name in ON_LANES else ("lanes",)), *(("interpret",) if name in CONTACTS_OF_WORLDS else ())}
    sim, step = compare(name, [engine for engine in ENGINES if engine not in left_out] or ["lanes"])
    assert (step.plan(sim.data).program.unfused_stages == ()) == (name not in sweep.SPLIT_CASES)
    if name not in OTHER_WORLDS:
        assert_bad_worlds_change_no_other(sim, step)


@pytest.mark.slow("XLA compiles for minutes; lanes of the other simulations have the same operations")
@pytest.mark.parametrize("name", [name for name in sweep.CASES if name not in (*ON_LANES, *NOT_ON_LANES)])
def test_other_programs_on_lanes_agree_with_plain(name):
    compare(name, ["lanes"])


@pytest.mark.long("lowers contacts of loads, and a height field")
@pytest.mark.parametrize("name", ["load", "terrain"])
def test_counters_and_indices_have_a_kernel_in_float64(name, x64):
    """Kernels have no integers of 64 bits, which JAX counts with where float64 is enabled: a warning is an error."""
    sim = sweep.CASES[name]()
    data = jax.tree.map(lambda x: x.astype(np.float64) if x.dtype == np.float32 else x, sim.data)
    program = Step(sim.step_pipeline, "lanes").plan(data).program
    kernel.write_kernel(program, "host")
    assert program.fused, program.unfused_stages


def compare(name, engines):
    """Compare a flight on some engines with the flight on the reference; return simulation and step of the last."""
    sim = sweep.CASES[name]()
    expected = Step(sim.step_pipeline, "plain")(sim.data, jnp.int32(N_STEPS))
    if name not in ONE_SIZE:
        sim = sweep.CASES[name](n_worlds=FEWER)
    expected = select_worlds(expected, np.arange(sim.n_worlds))
    for engine in engines:
        step = Step(sim.step_pipeline, engine)
        assert step.plan(sim.data).engine == engine
        result = step(sim.data, jnp.int32(N_STEPS))
        actual = select_worlds(result, np.arange(sim.n_worlds))
        sweep.assert_agree(actual, expected, sweep.TOLERANCES.get(name, sweep.ROUNDING), engine)
    return sim, step


def select_worlds(data, worlds):
    leaves = zip(jax.tree.leaves_with_path(data), jax.tree.leaves(scopes(data)), strict=True)
    leaves = [(path, leaf_on_host(x)) for (path, x), scope in leaves if scope not in ("shared", "opaque")]
    return {jax.tree_util.keystr(path): x[worlds] for path, x in leaves}


def assert_bad_worlds_change_no_other(sim, step):
    """Law 7: NaN in the velocities of world 1 flags this world, and changes no bit of another one."""
    good, states = step(sim.data, jnp.int32(N_STEPS)), sim.data.states
    is_bad = np.arange(sim.n_worlds)[:, None, None] == 1
    bad_states = states.replace(vel=jax.device_put(np.where(is_bad, np.nan, states.vel).astype(np.float32)))
    bad = step(sim.data.replace(states=bad_states), jnp.int32(N_STEPS))
    others = np.flatnonzero(np.arange(sim.n_worlds) != 1)
    assert not good.core.nonfinite.any()
    np.testing.assert_array_equal(np.flatnonzero(bad.core.nonfinite), [1])
    for name, x in select_worlds(bad, others).items():
        np.testing.assert_array_equal(x, select_worlds(good, others)[name], err_msg=name)


def test_every_plugin_and_controller_is_in_the_sweep():
    swept = {type(plugin) for factory in sweep.PLUGINS.values() for plugin in factory()}
    found = [
        m
        for x in (plugins, crazysim.lab.bodies, crazysim.lab.estimators, crazysim.lab.plugins, crazysim.lab.vehicles)
        for m in pkgutil.walk_packages(x.__path__, f"{x.__name__}.")
    ]
    modules = [importlib.import_module(module.name) for module in found]
    classes = {x for module in modules for x in vars(module).values() if isinstance(x, type) and issubclass(x, Plugin)}
    # Images are taken between kernels of the step: tests/plugins/sensors/test_depth_errors.py compares the engines.
    classes = {x for x in classes if not issubclass(x, ImageSensor)}
    assert len(swept) > 30
    assert not {x.__name__ for x in classes if not any(issubclass(y, x) for y in swept)}
    assert set(sweep.NAMED_CONTROLLERS) | {"auto", "crazyflow", "load_lqr", "tracking_lqr"} == set(CONTROLLERS)
