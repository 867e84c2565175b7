"""Plugins within the integration: fields that they may write, and errors that name plugin, method and field."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from crazysim import ConfigError, Plugin, PyTree, Sim, Wind, leaf
from crazysim.core.plugin import FunctionPlugin
from crazysim.errors import UnknownNameError


class TiltData(PyTree):
    angle: Array = leaf("drone", 1)
    """Angle, rad. (n_worlds, n_drones, 2)"""
    count: Array = leaf("drone", 1)
    """Counter. (n_worlds, n_drones, 1)"""
    gain: Array = leaf("parameter", 1, (1,))
    """Gain, 1. (1,)"""


class Tilt(Plugin):
    act: object = None
    rates: object = None
    name: str = "tilt"

    def record(self, sim):
        shape = sim.data.states.pos.shape[:2]
        return TiltData(jnp.zeros((*shape, 2)), jnp.zeros((*shape, 1), jnp.int32), jnp.ones(1))

    def influence(self, data):
        return data if self.act is None else self.act(data)

    def derivative(self, data):
        return {} if self.rates is None else self.rates(data)


def with_fields(**parts):
    """Return an influence that replaces fields of parts of the data, ``states={"force": fn}``."""

    def act(data):
        for part, fields in parts.items():
            old = getattr(data, part)
            data = data.replace(**{part: old.replace(**{k: fn(getattr(old, k)) for k, fn in fields.items()})})
        return data

    return act


def with_record_fields(**fields):
    def act(data):
        record = data.plugins["tilt"]
        new = record.replace(**{k: fn(getattr(record, k)) for k, fn in fields.items()})
        return data.replace(plugins=data.plugins | {"tilt": new})

    return act


def halve_staged_command(data):
    attitude = data.controls.attitude
    attitude = attitude.replace(staged_cmd=0.5 * attitude.staged_cmd)
    return data.replace(controls=data.controls.replace(attitude=attitude))


REFUSED_INFLUENCES = {
    "pos": (with_fields(states={"pos": lambda x: x + 1}), "got other values of states.pos. Use a stage"),
    "vel": (with_fields(states={"vel": lambda x: x + 1}), "got other values of states.vel"),
    "rotor_vel": (with_fields(states={"rotor_vel": lambda x: 2 * x}), "got other values of states.rotor_vel"),
    "steps": (with_fields(core={"steps": lambda x: x + 1}), "got other values of core.steps"),
    "own record": (with_record_fields(angle=lambda x: x + 1), r"got other values of plugins\['tilt'\].angle"),
    "higher command": (halve_staged_command, "got other values of controls.attitude.staged_cmd"),
    "force of three drones": (with_fields(states={"force": lambda x: jnp.zeros((3, 3))}), r"to return states.force of"),
    "mass of each axis": (with_fields(params={"mass": lambda x: x * jnp.ones(3)}), r"to return params.mass of shape"),
    "flat curve": (with_fields(params={"rpm2thrust": lambda x: x[0]}), r"to return params.rpm2thrust of shape \(1,"),
    "nothing": (lambda data: None, "to return SimData, got NoneType. Use 'return data'"),
    "structure": (lambda data: data.replace(plugins={}), "to keep the structure of SimData"),
}
"""Influences that are refused, and words of the error."""


@pytest.mark.parametrize("case", REFUSED_INFLUENCES)
def test_law_09_an_influence_may_only_write_inputs_of_the_dynamics(case):
    act, words = REFUSED_INFLUENCES[case]
    sim = Sim(control="attitude")
    sim.add(Tilt(act))
    with pytest.raises(ConfigError, match=rf"expected influence of plugin 'tilt' \(Tilt\) .*{words}"):
        sim.step()


def test_an_influence_may_write_forces_commands_and_parameters():
    """Without thrust, a force of 2 N carries a drone that weighs 2 N."""
    replace_inputs = with_fields(
        states={"force": lambda x: x + jnp.array([0, 0, 2.0]), "torque": lambda x: x * 1.0},
        params={"mass": lambda x: 2.0 / 9.81 * jnp.ones_like(x), "rpm2thrust": lambda x: jnp.zeros((4, 3))},
        controls={"rotor_vel": lambda x: 0 * x},
    )
    sim = Sim(control="rotor_vel")
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=jnp.ones((1, 1, 3))))
    sim.add(Tilt(replace_inputs))
    sim.step(50)
    np.testing.assert_allclose(sim.data.states.vel, 0.0, atol=1e-5)
    fitted = Sim(control="attitude", dynamics="so_rpy")
    level = with_fields(controls={"attitude": lambda x: x.replace(cmd=jnp.array([0, 0, 0, 0.5]))})
    fitted.add(Tilt(level))
    fitted.step(50)
    assert fitted.data.states.vel[0, 0, 2] > 0.01


REFUSED_DERIVATIVES = {
    "shape": (lambda data: {"angle": jnp.zeros(3)}, r"a rate of 'angle' with its shape \(2,\) .*, got shape \(3,\)"),
    "number": (lambda data: {"angle": 0.0}, r"a rate of 'angle' with its shape \(2,\) .*, got shape \(\)"),
    "type": (lambda data: {"count": jnp.ones(1)}, "a rate of 'count' with .* floating type int32, got .* float32"),
    "no field": (lambda data: {"angel": jnp.zeros(2)}, "which are 'angle', 'count', got one of 'angel'"),
    "parameter": (lambda data: {"gain": jnp.zeros(1)}, "which are 'angle', 'count', got one of 'gain'"),
    "no dict": (lambda data: jnp.zeros(2), "a dict of fields of its record to rates, got"),
}
"""Derivatives that are refused, and words of the error."""


@pytest.mark.parametrize("case", REFUSED_DERIVATIVES)
def test_law_09_a_wrong_rate_names_plugin_and_field(case):
    rates, words = REFUSED_DERIVATIVES[case]
    sim = Sim(control="attitude", integrator="rk4")
    sim.add(Tilt(rates=rates))
    with pytest.raises(ConfigError, match=rf"expected derivative of plugin 'tilt' \(Tilt\) to return .*{words}"):
        sim.step()


def test_law_09_rates_without_a_record():
    class Recordless(Plugin):
        name: str = "recordless"

        def derivative(self, data):
            return {"angle": jnp.zeros(2)}

    sim = Sim()
    sim.add(Recordless())
    with pytest.raises(ConfigError, match="in its record, which are none, got one of 'angle'"):
        sim.step()


@pytest.mark.parametrize("method", ["influence", "derivative"])
def test_errors_in_a_method_name_plugin_and_method(method):
    def broken(data):
        return data.states.force[5, 5]

    sim = Sim()
    sim.add(Tilt(broken if method == "influence" else None, broken if method == "derivative" else None))
    with pytest.raises(IndexError) as info:
        sim.step()
    assert f"in {method} of plugin 'tilt' (Tilt), which is written for one drone" in info.value.__notes__[0]


def test_errors_in_an_influence_function_name_the_plugin():
    sim = Sim()
    sim.add(FunctionPlugin("push", influence_fn=lambda data: data.wind))
    with pytest.raises(AttributeError) as info:
        sim.step()
    assert "in influence of plugin 'push' (FunctionPlugin)" in info.value.__notes__[0]


def test_law_09_reading_a_plugin_that_was_removed():
    sim = Sim()
    wind = sim.add(Wind((1.0, 0, 0)))
    sim.add(Tilt())
    sim.remove(wind)
    with pytest.raises(UnknownNameError, match=r"record of plugin 'wind', got records of 'tilt'. The plugin was not"):
        wind.read(sim.data)
