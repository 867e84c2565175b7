"""Actions, which an affine map turns into commands: with an action of zero every airframe hovers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import LEVELS, PAIRS

from crazysim import ConfigError, Control, Drone, Dynamics, load_airframe
from crazysim.core.data import create_params
from crazysim.dynamics import first_principles, fitted, supported_dynamics
from crazysim.envs import Actions, actions_of, make
from crazysim.envs.actions import MAX_BODY_RATES, MAX_OFFSET, MAX_TILT, MAX_YAW, hover_thrust
from crazysim.envs.tasks.hover import Hover

CASES = [
    (drone, dynamics, control)
    for drone in Drone
    for dynamics, control in PAIRS
    if dynamics in supported_dynamics(drone)
]
LEVEL_QUAT = jnp.array([0.0, 0.0, 0.0, 1.0])
ZEROS = jnp.zeros(3)


def params_of(airframe, dynamics):
    if dynamics == "first_principles":
        return first_principles.Params.create(airframe)
    return fitted.Params.create(airframe, Dynamics(dynamics))


@pytest.mark.parametrize(("drone", "dynamics", "control"), CASES)
def test_a_zero_action_is_the_command_that_hovers(drone, dynamics, control):
    """A state command is 1 m above the origin; at other levels, the derivatives of a level drone at rest are zero."""
    params = params_of(load_airframe(drone), dynamics)
    actions = actions_of(load_airframe(drone), params, Control(control))
    command = actions.command(jnp.zeros(actions.size))
    if control == "state":
        np.testing.assert_array_equal(command, [0, 0, 1, *np.zeros(9), 1, 0, 0, 0])
        return
    if control == "rotor_vel":
        rotor_vel = command
        command_of_motors = command
    elif dynamics == "first_principles":
        thrust = command[0 if control == "force_torque" else 3]
        np.testing.assert_array_equal(np.delete(command, 0 if control == "force_torque" else 3), np.zeros(3))
        np.testing.assert_allclose(thrust, 9.81 * params.mass[0], rtol=1e-6)
        rotor_vel = command_of_motors = first_principles.hover_rotor_vel(params)
    else:
        rotor_vel, command_of_motors = command[3:], command
    model = first_principles.dynamics if dynamics == "first_principles" else fitted.dynamics
    derivatives = model(ZEROS, LEVEL_QUAT, ZEROS, ZEROS, command_of_motors, rotor_vel, params=params)
    vel, acc, ang_acc, rotor_acc = map(np.asarray, derivatives)
    np.testing.assert_array_equal(vel, np.zeros(3))
    np.testing.assert_allclose(acc, np.zeros(3), atol=2e-5)
    np.testing.assert_allclose(ang_acc, np.zeros(3), atol=1e-3)
    np.testing.assert_allclose(rotor_acc / np.abs(rotor_vel).max(), np.zeros_like(rotor_acc), atol=1e-4)


@pytest.mark.parametrize("control", LEVELS)
def test_the_map_is_affine_from_minus_one_to_one_and_clipped_beyond(control):
    airframe = load_airframe("cf21B_500")
    actions = actions_of(airframe, first_principles.Params.create(airframe), Control(control))
    n = 3 if control == "state" else 4
    assert actions.size == n

    def command_at(x):
        return np.asarray(actions.command(jnp.full(n, x)))[:n]

    np.testing.assert_allclose(command_at(0.5), (command_at(0.0) + command_at(1.0)) / 2, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(command_at(-1.0), 2 * command_at(0.0) - command_at(1.0), rtol=1e-6, atol=1e-4)
    np.testing.assert_array_equal(command_at(1.7), command_at(1.0))
    np.testing.assert_array_equal(command_at(-9.0), command_at(-1.0))
    max_thrust = 4 * airframe.value("rotors.thrust_max", ())
    upper_limits = {
        "state": np.array([0, 0, 1]) + MAX_OFFSET,
        "attitude": [MAX_TILT, MAX_TILT, MAX_YAW, max_thrust],
        "body_rate": [*MAX_BODY_RATES, max_thrust],
        "force_torque": [max_thrust, *command_at(1.0)[1:]],
        "rotor_vel": np.broadcast_to(first_principles.Params.create(airframe).rotor_vel_max, 4),
    }[control]
    np.testing.assert_allclose(command_at(1.0), upper_limits, rtol=1e-6)


def test_torques_at_one_are_a_quarter_of_the_largest_ones():
    """Roll: two rotors at full thrust on an arm of 3.5 cm, two off."""
    airframe = load_airframe("cf21B_500")
    actions = actions_of(airframe, first_principles.Params.create(airframe), Control.force_torque)
    rotor_thrust = airframe.value("rotors.thrust_max", ())
    np.testing.assert_allclose(actions.scale[1:3], 2 * rotor_thrust * airframe.arm / 4, rtol=1e-6)
    assert 0 < actions.scale[3] < actions.scale[1]


def test_any_leading_axes_and_gradients_everywhere():
    airframe = load_airframe("cf21B_500")
    actions = actions_of(airframe, first_principles.Params.create(airframe), Control.attitude)
    action = np.random.default_rng(0).uniform(-1.5, 1.5, (3, 2, 4)).astype(np.float32)
    commands = actions.command(jax.device_put(action))
    assert (commands.shape, commands.dtype) == ((3, 2, 4), jnp.float32)
    np.testing.assert_array_equal(np.asarray(commands)[1, 1], actions.command(action[1, 1]))
    values = np.float32([-2, -1, 0, 1, 2])
    jacobians = np.asarray(jax.jit(jax.vmap(jax.jacobian(actions.command)))(np.tile(values[:, None], 4)))
    assert np.isfinite(jacobians).all()
    assert not jacobians[:, ~np.eye(4, dtype=bool)].any()
    np.testing.assert_allclose(np.diag(jacobians[2]), actions.scale, rtol=1e-6)


def test_the_text_of_actions_has_their_level_and_limits():
    airframe = load_airframe("cf21B_500")
    actions = actions_of(airframe, first_principles.Params.create(airframe), Control.attitude, tilt=0.1)
    assert "attitude" in str(actions)
    assert "0.1" in str(actions)


def test_a_map_of_two_lengths_is_refused():
    with pytest.raises(ConfigError, match=r"of one shape, \(k,\) or \(n_drones, k\), got \(3,\) and \(4,\)"):
        Actions(np.zeros(3), np.ones(4), Control.attitude)


def test_hover_thrust_takes_parameters_of_every_drone():
    params = first_principles.Params.create(load_airframe("cf21B_500"))
    masses = jnp.array([[[0.03]], [[0.06]]])
    np.testing.assert_allclose(hover_thrust(params.replace(mass=masses)), 9.81 * masses, rtol=1e-6)


@pytest.mark.parametrize("control", ["attitude", "body_rate", "force_torque", "rotor_vel", "state"])
def test_drones_of_several_airframes_have_actions_of_their_own(control):
    fleet = [load_airframe(name) for name in ("cf21B_500", "bumblebee")]
    params = create_params(Dynamics.first_principles, fleet)
    actions = actions_of(fleet, params, Control(control))
    commands = actions.command(jnp.full((2, actions.size), 0.3))
    for k, airframe in enumerate(fleet):
        airframe_actions = actions_of(airframe, create_params(Dynamics.first_principles, airframe), Control(control))
        np.testing.assert_allclose(
            commands[k], airframe_actions.command(jnp.full(airframe_actions.size, 0.3)), rtol=1e-6
        )
    equal_actions = actions_of([fleet[0]] * 2, create_params(Dynamics.first_principles, fleet[0]), Control(control))
    assert equal_actions.centre.ndim == 1


def test_a_task_may_give_actions_a_meaning_of_its_own():
    class Slow(Hover):
        def actions(self, sim):
            return Actions(np.zeros(4), np.full(4, 0.1), sim.control)

    own = Actions(np.zeros(4), np.ones(4), Control.attitude)
    np.testing.assert_array_equal(make(Slow()).actions.scale, 0.1)
    assert make(Slow(), actions=own).actions is own
