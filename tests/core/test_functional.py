"""The functional API stages commands for their own level, and reports ticks correctly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import PAIRS, send, shared_sim, trees_equal

from crazysim.core import functional as F
from crazysim.core.data import command_shape


def sim_of(dynamics, control):
    return shared_sim(n_worlds=2, n_drones=2, dynamics=dynamics, control=control)


@pytest.mark.parametrize("dynamics, control", PAIRS)
def test_a_command_is_staged_and_nothing_else_changes(dynamics, control):
    data = sim_of(dynamics, control).data
    command = np.arange(np.prod(command_shape(data, control)), dtype=np.float32).reshape(command_shape(data, control))
    after = send(data, command)
    if control == "rotor_vel":
        staged, back = after.controls.rotor_vel, {"rotor_vel": data.controls.rotor_vel}
    else:
        ctrl = getattr(after.controls, control)
        staged, back = ctrl.staged_cmd, {control: getattr(data.controls, control)}
        assert trees_equal(ctrl.replace(staged_cmd=back[control].staged_cmd), back[control])
    np.testing.assert_array_equal(staged, command)
    assert trees_equal(after.replace(controls=after.controls.replace(**back)), data)


def test_a_command_does_not_alias_the_callers_array():
    data = sim_of("first_principles", "attitude").data
    command = np.ones((2, 2, 4), np.float32)
    staged = F.attitude_control(data, command).controls.attitude.staged_cmd
    command[:] = 7.0
    np.testing.assert_array_equal(staged, np.ones((2, 2, 4)))


def test_law_09_a_number_too_large_for_the_state_is_reported_as_infinite():
    """1e300 is finite in float64 and infinite in the float32 of the state."""
    data = sim_of("first_principles", "attitude").data
    command = np.zeros((2, 2, 4))
    command[1, 0, 3] = 1e300
    with pytest.raises(ValueError, match=r"NaN or infinite in world\(s\) \[1\], as float32"):
        F.attitude_control(data, command)


def test_device_arrays_of_any_real_type_are_cast():
    data = sim_of("first_principles", "attitude").data
    for dtype in (jnp.int32, jnp.float16, jnp.bfloat16, jnp.uint8):
        staged = F.attitude_control(data, jnp.ones((2, 2, 4), dtype)).controls.attitude.staged_cmd
        assert staged.dtype == data.states.pos.dtype
        np.testing.assert_array_equal(staged, np.ones((2, 2, 4)))


def test_check_finite_does_nothing_inside_jit():
    data = sim_of("first_principles", "attitude").data
    command = jnp.full((2, 2, 4), jnp.nan)
    staged = jax.jit(lambda c: F.attitude_control(data, c, check_finite=True).controls.attitude.staged_cmd)(command)
    assert np.all(np.isnan(staged))


@pytest.mark.parametrize("dynamics, control", PAIRS)
def test_controllable_is_per_world(dynamics, control):
    data = sim_of(dynamics, control).data
    freq = 500 if control == "rotor_vel" else getattr(data.controls, control).freq
    period = 500 // freq
    for steps in ([0, 1], [period, period + 1], [7 * period, 7 * period - 1]):
        at = data.replace(core=data.core.replace(steps=jnp.asarray(steps, jnp.int32)[:, None]))
        expected = [[step % period == 0] for step in steps]
        np.testing.assert_array_equal(F.controllable(at), expected)
        assert F.controllable(at).dtype == bool


def test_controllable_works_inside_jit():
    data = sim_of("first_principles", "state").data
    np.testing.assert_array_equal(jax.jit(F.controllable)(data), [[True], [True]])
