"""The functional API stages commands for their own level, and reports ticks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import PAIRS, send, shared_sim, trees_equal

from crazysim.core import functional as F
from crazysim.core.data import command_shape
from crazysim.errors import ConfigError


def get_sim(dynamics, control):
    return shared_sim(n_worlds=2, n_drones=2, dynamics=dynamics, control=control)


@pytest.mark.parametrize("dynamics, control", PAIRS)
def test_a_command_is_staged_and_nothing_else_changes(dynamics, control):
    data = get_sim(dynamics, control).data
    command = np.arange(np.prod(command_shape(data, control)), dtype=np.float32).reshape(command_shape(data, control))
    after = send(data, command)
    if control == "rotor_vel":
        staged, old = after.controls.rotor_vel, {"rotor_vel": data.controls.rotor_vel}
    else:
        ctrl = getattr(after.controls, control)
        staged, old = ctrl.staged_cmd, {control: getattr(data.controls, control)}
        changed = {"staged_cmd"} | ({"staged_feedforward"} if control == "state" else set())
        assert trees_equal(ctrl.replace(**{name: getattr(old[control], name) for name in changed}), old[control])
    np.testing.assert_array_equal(staged, command)
    assert trees_equal(after.replace(controls=after.controls.replace(**old)), data)


SETPOINT_PARTS = [
    {"pos": (0.0, 1.0, 2.0)},
    {"pos": [[0, 1, 2], [3, 4, 5]], "yaw": 0.3},
    {"pos": np.arange(6.0).reshape(2, 1, 3), "vel": (1, 0, 0), "acc": np.ones((2, 2, 3)), "yaw": [0.1, -2.0]},
    {"pos": np.zeros((2, 2, 3)), "yaw": [[1.0], [2.0]]},
]


@pytest.mark.parametrize("on_device", [False, True])
@pytest.mark.parametrize("parts", SETPOINT_PARTS, ids=lambda parts: "-".join(parts))
def test_a_setpoint_in_parts_is_the_vector_of_these_parts(parts, on_device):
    data = get_sim("first_principles", "state").data
    expected = np.zeros((2, 2, 16))
    for name, indices in (("pos", slice(0, 3)), ("vel", slice(3, 6)), ("acc", slice(6, 9))):
        expected[..., indices] = parts.get(name, 0.0)
    yaw = np.broadcast_to(parts.get("yaw", 0.0), (2, 2))
    expected[..., 11], expected[..., 12] = np.sin(yaw / 2), np.cos(yaw / 2)
    setpoint_parts = {name: jnp.asarray(x) for name, x in parts.items()} if on_device else parts
    staged = F.state_control(data, **setpoint_parts).controls.state.staged_cmd
    np.testing.assert_allclose(staged, expected, atol=2e-7)  # rounding of float32
    sim = get_sim("first_principles", "state")
    sim.state_control(**parts)
    np.testing.assert_allclose(sim.data.controls.state.staged_cmd, expected, atol=2e-7)
    sim.data = data


def test_a_setpoint_in_parts_has_a_gradient():
    data = get_sim("first_principles", "state").data
    gradient = jax.grad(lambda x: F.state_control(data, pos=x).controls.state.staged_cmd.sum())(jnp.zeros(3))
    np.testing.assert_array_equal(gradient, [4.0, 4.0, 4.0])  # four drones


@pytest.mark.parametrize(
    "parts, message",
    [
        ({}, "expected a state command, got no position"),
        ({"vel": (1, 0, 0)}, "expected a state command, got no position"),
        ({"controls": np.zeros((2, 2, 16)), "pos": (0, 0, 1)}, "or its parts, got both, with pos"),
        ({"controls": np.zeros((2, 2, 16)), "yaw": 0.0}, "or its parts, got both, with yaw"),
        ({"pos": 1.0}, r"expected pos as numbers that broadcast to shape \(2, 2, 3\), got 1.0"),
        ({"pos": [[0], [1]]}, "expected pos as numbers that broadcast"),
        ({"pos": np.zeros((3, 3))}, "expected pos as numbers that broadcast"),
        ({"pos": np.zeros((1, 2, 2, 3))}, "expected pos as numbers that broadcast"),
        ({"pos": [[0, 0, 0], [1]]}, "expected pos as numbers that broadcast"),
        ({"pos": "up"}, "expected pos as numbers that broadcast .* got 'up'"),
        ({"pos": (True, False, True)}, "expected pos as numbers"),
        ({"pos": (0, 0, 1), "yaw": (0, 0, 1)}, r"expected yaw as numbers that broadcast to shape \(2, 2\)"),
        ({"pos": (0, 0, np.nan)}, "expected finite numbers as pos"),
        ({"pos": jnp.zeros(3), "acc": (0, 0, np.inf)}, "expected finite numbers as acc"),
    ],
)
def test_law_09_wrong_parts_of_a_setpoint_are_named(parts, message):
    data = get_sim("first_principles", "state").data
    with pytest.raises(ConfigError, match=message):
        F.state_control(data, **parts)
    with pytest.raises(ValueError, match="takes 'attitude' commands, not 'state'"):
        F.state_control(get_sim("first_principles", "attitude").data, pos=(0, 0, 1))


def test_check_finite_does_nothing_inside_jit():
    data = get_sim("first_principles", "attitude").data
    command = jnp.full((2, 2, 4), jnp.nan)
    staged = jax.jit(lambda c: F.attitude_control(data, c, check_finite=True).controls.attitude.staged_cmd)(command)
    assert np.all(np.isnan(staged))


def test_controllable_works_inside_jit():
    data = get_sim("first_principles", "state").data
    np.testing.assert_array_equal(jax.jit(F.controllable)(data), [[True], [True]])
