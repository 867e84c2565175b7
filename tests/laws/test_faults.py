"""Faults of Crazyflow 0.4.0 that crazysim does not have; each test describes its fault."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import (
    CHOSEN_PAIRS,
    FITTED_DYNAMICS,
    INTEGRATORS,
    hover_command,
    hover_rotor_state,
    hover_thrust,
    repeat_command,
    send,
    shared_sim,
    trees_equal,
    with_states,
    zero_thrust_command,
)

from crazysim import Sim
from crazysim.core.integration import FLOOR_HEIGHT


@functools.cache
def build_program(dynamics="first_principles", control="attitude", **settings):
    sim = shared_sim(n_worlds=3, n_drones=2, dynamics=dynamics, control=control, **settings)
    return sim.default_data, sim.build_step_fn(), sim.build_reset_fn()


def run_steps(step, data, n_steps):
    # An edit may have committed arrays to another device, for which the step would be compiled again.
    return step(jax.device_put(data, jax.devices()[0]), jnp.int32(n_steps))


def test_fault_01_attitude_freq_holds_for_fitted_dynamics():
    """At 50 Hz of 500 Hz, a command takes effect at every tenth step; in Crazyflow it does so at once."""
    sim = Sim(dynamics="so_rpy_rotor_drag", attitude_freq=50, engine="interpret")
    hover = hover_thrust(sim.data)
    first, second = np.array([[[0.1, 0, 0, hover]]]), np.array([[[-0.2, 0, 0.3, hover]]])
    sim.data = with_states(sim.data, pos=[0, 0, 1.0])
    sim.attitude_control(first)
    sim.step()
    np.testing.assert_allclose(sim.data.controls.attitude.cmd, first, rtol=1e-6)  # float32 of a float64 command
    assert not sim.controllable.any()
    data_before = sim.data
    sim.attitude_control(second)
    sim.step(9)
    np.testing.assert_allclose(sim.data.controls.attitude.cmd, first, rtol=1e-6)
    commanded, sim.data = sim.data, data_before
    sim.step(9)
    assert trees_equal(commanded.states, sim.data.states), "the held command moved the drone before its tick"
    sim.data = commanded
    assert sim.controllable.all()
    sim.step()
    np.testing.assert_allclose(sim.data.controls.attitude.cmd, second, rtol=1e-6)


@pytest.mark.parametrize("dynamics", ["first_principles", "so_rpy"])
def test_fault_02_a_zero_quaternion_means_yaw_zero(dynamics):
    """A setpoint of zeros, as from ``np.zeros``, means: fly to the origin with yaw zero."""
    data, step, _ = build_program(dynamics, "state")
    half_yaw = 0.4
    hover_speeds = hover_rotor_state(data)
    data = with_states(data, pos=[0, 0, 0.2], quat=[0, 0, np.sin(half_yaw), np.cos(half_yaw)], rotor_vel=hover_speeds)
    zeros = np.zeros((3, 2, 16))
    level = zeros.copy()
    level[..., 12] = 1.0
    from_zeros, from_level = (run_steps(step, send(data, cmd), 250) for cmd in (zeros, level))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(from_zeros.states))
    assert not from_zeros.core.nonfinite.any()
    assert trees_equal(from_zeros.states, from_level.states)
    if dynamics in FITTED_DYNAMICS:
        attitude = from_zeros.controls.attitude.cmd
        np.testing.assert_allclose(attitude[..., 2], 0.0, atol=1e-4)  # float32, and a small drift
    yaw = 2 * np.arctan2(from_zeros.states.quat[..., 2], from_zeros.states.quat[..., 3])
    assert np.all(np.abs(yaw) < 0.5), "after half a second at 0.8 rad it must be on its way to zero"


@pytest.mark.parametrize("dynamics, control", CHOSEN_PAIRS)
def test_fault_03_nan_commands_are_refused_flagged_and_healed(dynamics, control):
    data, step, reset = build_program(dynamics, control)
    data = with_states(data, pos=[0, 0, 1.0], rotor_vel=hover_rotor_state(data))
    good = repeat_command(data, hover_command(data)).astype(np.float32)
    # Fitted dynamics contain the attitude controller and ignore the last three numbers, the desired body rates.
    used = 13 if dynamics in FITTED_DYNAMICS and control == "state" else good.shape[-1]
    clean = run_steps(step, send(data, jnp.asarray(good)), 20)
    assert not clean.core.nonfinite.any()
    for component in range(used):
        bad = good.copy()
        bad[1, 0, component] = np.nan
        if component == 0:
            with pytest.raises(ValueError, match=r"NaN or infinite.* in world\(s\) \[1\]"):
                send(data, bad)
        poisoned = run_steps(step, send(data, jnp.asarray(bad)), 20)
        np.testing.assert_array_equal(poisoned.core.nonfinite[:, 0], [False, True, False], err_msg=f"{component}")
        for x, y in zip(jax.tree.leaves(poisoned.states), jax.tree.leaves(clean.states), strict=True):
            np.testing.assert_array_equal(x[::2], y[::2])  # the other worlds are not affected
    flagged = run_steps(step, send(poisoned, good), 1)
    assert flagged.core.nonfinite[1, 0], "only a reset clears the flag"
    healed = reset(flagged, data, jnp.asarray([False, True, False]))
    assert not healed.core.nonfinite.any()
    healed = run_steps(step, send(healed, good), 20)
    assert not healed.core.nonfinite.any()
    for x, y in zip(jax.tree.leaves(healed.states), jax.tree.leaves(clean.states), strict=True):
        np.testing.assert_array_equal(x[1], y[1])


def simulate_fall(data, n_steps, command_rotors=lambda r: 0.0):
    """Return height, vertical velocity and rotor state of a level drone that falls, by explicit Euler in float64.

    ``command_rotors(r)`` returns rotor speeds, rpm, or for fitted dynamics the thrust, N. 0 stops the motors.
    """
    dt, z, v = 1 / data.core.freq, 100.0, 0.0
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), data.params)
    r = hover_rotor_state(data)
    for _ in range(n_steps):
        if hasattr(p, "rpm2thrust"):
            (k0, k1, k2), (_, _, a, b) = p.rpm2thrust[0], p.rotor_dyn_coef[0]
            cmd = command_rotors(r)
            thrust, r_dot = np.sum(k0 + k1 * r + k2 * r**2), a * (cmd - r) + b * (cmd**2 - r**2)
        elif p.thrust_dyn_coef is None:
            thrust, r_dot = p.acc_coef[0] + p.cmd_f_coef[0] * command_rotors(r), 0 * r
        else:
            thrust, r_dot = p.acc_coef[0] + p.cmd_f_coef[0] * r[0], p.thrust_dyn_coef[0] * (command_rotors(r) - r)
        drag = 0.0 if p.drag_matrix is None else p.drag_matrix[2, 2]
        acc = (thrust + drag * v) / p.mass[0] - 9.81
        z, v, r = z + dt * v, v + dt * acc, r + dt * r_dot
    return z, v, r


def fly_without_force(step, data):
    """Return the data after 250 steps with setpoints at the current position and velocity, which need no force."""
    for _ in range(50):
        cmd = np.broadcast_to(zero_thrust_command(data), (3, 2, 16)).copy()
        cmd[..., 0:3], cmd[..., 3:6] = data.states.pos, data.states.vel
        data = run_steps(step, send(data, cmd), 5)
    return data


def assert_falls(states, z, v, r):
    # 250 float32 additions near 100 m (half an ulp is 4e-6 m), and near 4 m/s
    np.testing.assert_allclose(states.pos[..., 2], z, atol=1e-3, rtol=0)
    np.testing.assert_allclose(states.vel[..., 2], v, atol=1e-4, rtol=0)
    np.testing.assert_allclose(states.rotor_vel, np.broadcast_to(r, states.rotor_vel.shape), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(states.vel[..., :2], 0.0, atol=1e-4)


@pytest.mark.parametrize("dynamics, control", CHOSEN_PAIRS)
def test_fault_06_zero_thrust_stops_the_motors_at_every_level(dynamics, control):
    """Crazyflow keeps the rotors at their minimum speed, with a fifth of the weight: 3.6 m/s after 0.5 s, not 4.3.

    From hover the rotors slow down with their lag, and the drone falls with drag only. At the level ``state`` the test
    uses Crazyflow's cascade, which has no command for motors that are on but give no thrust.
    """
    data, step, _ = build_program(dynamics, control, **({"controller": "crazyflow"} if control == "state" else {}))
    data = with_states(data, pos=[0, 0, 100.0], rotor_vel=hover_rotor_state(data))
    if control == "state":
        data = fly_without_force(step, data)
    else:
        data = run_steps(step, send(data, repeat_command(data, zero_thrust_command(data))), 250)
    commanded = data.controls.attitude.cmd[..., 3] if dynamics in FITTED_DYNAMICS else data.controls.rotor_vel
    np.testing.assert_array_equal(commanded, 0.0)
    z, v, r = simulate_fall(data, 250)
    assert_falls(data.states, z, v, r)
    assert v < -3.5, "gravity gives 4.905 m/s; thrust of the slowing rotors and drag reduce it"


def test_fault_06_a_drone_dropped_with_its_motors_off_falls_freely():
    """The speed from rest is the exact solution with linear drag: v = -g tau (1 - exp(-t / tau))."""
    data, step, _ = build_program("first_principles", "attitude")
    data = run_steps(step, send(with_states(data, pos=[0, 0, 100.0]), np.zeros((3, 2, 4))), 250)
    tau = float(data.params.mass[0]) / -float(data.params.drag_matrix[2, 2])
    expected = -9.81 * tau * (1 - np.exp(-0.5 / tau))
    assert -4.3 < expected < -4.2
    # explicit Euler: half a step of the change of acceleration, 0.001 s * (9.81 - 7.4) m/s^2
    np.testing.assert_allclose(data.states.vel[..., 2], expected, atol=3e-3)
    np.testing.assert_array_equal(data.states.rotor_vel, 0.0)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_fault_13_a_drone_on_the_floor_neither_slides_nor_turns_and_takes_off(integrator):
    data, step, _ = build_program("first_principles", "rotor_vel", integrator=integrator)
    hover, m = hover_rotor_state(data), float(data.params.mass[0])
    tilt = [0.1, -0.05, np.sin(0.3), 0.0]
    tilt[3] = np.sqrt(1 - np.sum(np.square(tilt)))
    data = with_states(
        data,
        pos=[0.3, -0.2, FLOOR_HEIGHT],
        quat=tilt,
        rotor_vel=0.7 * hover,
        force=[0.5 * m * 9.81, 0.1 * m * 9.81, 0],
        torque=[1e-5, 2e-5, 1e-4],
    )
    landed = run_steps(step, send(data, repeat_command(data, 0.7 * hover)), 500)
    for name in ("pos", "quat", "vel", "ang_vel"):
        before, after = getattr(data.states, name), getattr(landed.states, name)
        # at most the rounding of a quaternion that is normalised 500 times
        np.testing.assert_allclose(after, before, atol=1e-5 if name == "quat" else 0, rtol=0, err_msg=name)

    level = with_states(landed, quat=[0, 0, 0, 1], force=0.0, torque=0.0)
    flying = run_steps(step, send(level, repeat_command(level, 1.2 * hover)), 500)
    assert np.all(flying.states.pos[..., 2] > 0.5)
    np.testing.assert_allclose(flying.states.pos[..., :2], data.states.pos[..., :2], atol=0.02)
    assert not flying.core.nonfinite.any()


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_fault_13_a_drone_that_has_fallen_stays_where_it_came_down(integrator):
    data, step, _ = build_program("first_principles", "rotor_vel", integrator=integrator)
    thrown = with_states(data, pos=[0, 0, 0.2], vel=[1.0, 0, -1.0], ang_vel=[0.5, 0.2, 3.0], torque=[0, 0, 1e-4])
    down = run_steps(step, send(thrown, np.zeros((3, 2, 4))), 250)
    later = run_steps(step, down, 250)
    assert np.all(down.states.pos[..., 2] == np.float32(FLOOR_HEIGHT))
    assert np.all(down.states.pos[..., 0] > 0.05), "it has flown"
    np.testing.assert_array_equal(later.states.pos, down.states.pos)
    np.testing.assert_allclose(later.states.quat, down.states.quat, atol=1e-5)  # rounding of 250 normalisations
    np.testing.assert_array_equal(later.states.ang_vel, 0.0)
