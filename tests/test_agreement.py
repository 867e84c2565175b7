"""All stages of a step: every engine computes the same as ``plain``.

``tests/envs/test_env_step.py`` has the sweep over environments.
"""

import importlib
import pkgutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sweep
from cases import COMPILED_ENGINES

import crazysim.lab.plugins
from crazysim import Plugin, plugins
from crazysim.control.controllers import CONTROLLERS
from crazysim.engine import Step
from crazysim.engine.backends import kernel
from crazysim.plugins.sensors.image_sensor import ImageSensor

ENGINES = ("interpret", *COMPILED_ENGINES)
N_STEPS = 20
"""Number of steps of each simulation; all sensors and controllers have ticks within them."""
LONG_ON_LANES = ("sensors", "load", "bodies", "controllers", "complementary", "impact")
"""Simulations that take XLA more than 5 s to compile for ``lanes``."""
NOT_ON_LANES = ("kalman", "eskf", "terrain")
"""Simulations that take XLA more than 30 s to compile for ``lanes``."""


@pytest.mark.long("compiles every stage of the package for every engine")
@pytest.mark.parametrize("name", sweep.CASES)
def test_every_engine_agrees_with_plain(name):
    compare(name, [engine for engine in ENGINES if engine != "lanes" or name not in LONG_ON_LANES + NOT_ON_LANES])


@pytest.mark.slow("XLA compiles a minute in all; lanes of the other simulations have the same operations")
@pytest.mark.parametrize("name", LONG_ON_LANES)
def test_long_programs_on_lanes_agree_with_plain(name):
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
    """Compare a flight on some engines with the flight on the reference."""
    sim = sweep.CASES[name]()
    expected = Step(sim.step_pipeline, "plain")(sim.data, jnp.int32(N_STEPS))
    for engine in engines:
        step = Step(sim.step_pipeline, engine)
        assert step.plan(sim.data).engine == engine
        result = step(sim.data, jnp.int32(N_STEPS))
        sweep.assert_agree(result, expected, sweep.TOLERANCES.get(name, sweep.ROUNDING), engine)


def test_every_plugin_and_controller_is_in_the_sweep():
    swept = {type(plugin) for factory in sweep.PLUGINS.values() for plugin in factory()}
    found = [m for x in (plugins, crazysim.lab.plugins) for m in pkgutil.walk_packages(x.__path__, f"{x.__name__}.")]
    modules = [importlib.import_module(module.name) for module in found]
    classes = {x for module in modules for x in vars(module).values() if isinstance(x, type) and issubclass(x, Plugin)}
    # Images are taken between kernels of the step: tests/plugins/sensors/test_depth_errors.py compares the engines.
    classes = {x for x in classes if not issubclass(x, ImageSensor)}
    assert len(swept) > 30
    assert not {x.__name__ for x in classes if not any(issubclass(y, x) for y in swept)}
    assert set(sweep.NAMED_CONTROLLERS) | {"auto", "crazyflow", "load_lqr", "tracking_lqr"} == set(CONTROLLERS)
