"""Law 7: no NaN from valid input, in values or gradients, and one bad world never affects another."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import (
    INTEGRATORS,
    PAIRS,
    build_stagewise_step,
    hover_command,
    hover_rotor_state,
    send,
    trees_equal,
    with_airframes,
    with_states,
    zero_thrust_command,
)
from sweep import NAMED_CONTROLLERS

from crazysim import Drone, Sim, load_airframe
from crazysim.core.integration import FLOOR_HEIGHT
from crazysim.dynamics import supported_dynamics

SQRT_HALF = np.sqrt(0.5)
SITUATIONS = (
    "hover",
    "rest at zero",
    "rest on floor",
    "below floor",
    "pitch +90",
    "pitch -90",
    "upside down",
    "zero command",
    "saturated",
    "saturated below",
    "zero thrust, tilted",
    "falls on the floor",
)
N_STEPS = 50


def tilt_command(data):
    """Return a command without thrust for a tilted drone, or a similar wrench or rotor speeds."""
    command = np.array(zero_thrust_command(data))
    mode = data.controls.mode.value
    if mode == "attitude":
        command[:3] = 0.5, -0.3, 0.8
    elif mode in ("body_rate", "force_torque"):
        command[slice(3) if mode == "body_rate" else slice(1, 4)] = 0.01
    return command


ENGINE_CASES = [
    (*PAIRS[0], "auto"),
    (*PAIRS[1], "stages"),
    *((*pair, "auto") for pair in PAIRS[2:5]),
    ("so_rpy", "attitude", "auto"),
    ("so_rpy_rotor_drag", "state", "auto"),
    ("first_principles", "state", "controllers"),
]
"""Dynamics, command level and engine of each case: every level, and the fits with the fewest and the most terms.

Kernels compile faster than XLA, so one case alone runs the stages without an engine. In the case "controllers" each
situation is flown by every controller.
"""


@functools.cache
def make_situations(dynamics, control, engine="auto"):
    n, settings = len(SITUATIONS), {}
    if engine == "controllers":
        n *= len(NAMED_CONTROLLERS)
        settings = {"controller": NAMED_CONTROLLERS, "switch": np.arange(n)[:, None] // len(SITUATIONS)}
    engine = "plain" if engine == "stages" else "auto"
    sim = Sim(n, dynamics=dynamics, control=control, engine=engine, **settings)
    pos, vel, quat, rotor_vel = (np.zeros((n, 1, k)) for k in (3, 3, 4, 4))
    pos[..., 2], quat[..., 3] = 1.0, 1.0
    commands = np.broadcast_to(hover_command(sim.data), (n, 1, len(hover_command(sim.data)))).copy()
    world_ids = {name: np.arange(i, n, len(SITUATIONS)) for i, name in enumerate(SITUATIONS)}
    rotor_vel[world_ids["hover"]] = hover_rotor_state(sim.data)
    for name, height in (("rest at zero", 0.0), ("rest on floor", FLOOR_HEIGHT), ("below floor", -1.0)):
        pos[world_ids[name], 0, 2] = height
        commands[world_ids[name]] = 0.0
    pos[world_ids["falls on the floor"], 0, 2] = 0.05
    commands[world_ids["falls on the floor"]] = 0.0
    vel[world_ids["falls on the floor"], 0, 2] = -1.0
    quat[world_ids["pitch +90"]] = 0, SQRT_HALF, 0, SQRT_HALF
    quat[world_ids["pitch -90"]] = 0, -SQRT_HALF, 0, SQRT_HALF
    quat[world_ids["upside down"]] = 1, 0, 0, 0
    quat[world_ids["zero thrust, tilted"]] = np.sin(0.4), 0, 0, np.cos(0.4)
    commands[world_ids["zero command"]] = 0.0
    for name, sign in (("saturated", 1), ("saturated below", -1)):
        commands[world_ids[name]] = sign * (1e6 if control == "rotor_vel" else 100.0)
        if control == "attitude":  # angles do not saturate; these are the largest there are
            commands[world_ids[name], 0, :3] = sign * np.pi * np.array([1.0, 0.5, -1.0])
    commands[world_ids["zero thrust, tilted"]] = tilt_command(sim.data)
    arrays = {"pos": pos, "vel": vel, "quat": quat, "rotor_vel": rotor_vel}
    states = sim.data.states.replace(**{k: np.float32(v) for k, v in arrays.items()})
    return sim, *jax.device_put((sim.data.replace(states=states), np.float32(commands)), sim.device)


@functools.cache
def make_flight(dynamics, control, engine):
    sim = make_situations(dynamics, control, engine)[0]
    step = build_stagewise_step(sim) if engine == "stages" else sim.build_step_fn()

    @jax.jit
    @functools.partial(jax.grad, has_aux=True)
    def fly(start, data):
        states = data.states.replace(**{k: v for k, v in start.items() if k != "command"})
        data = step(send(data.replace(states=states), start["command"]), N_STEPS)
        s = data.states
        return sum(jnp.sum(x) for x in (s.pos, s.vel, s.quat, s.ang_vel)), data

    return fly


def differentiated_inputs(data, commands):
    names = ("pos", "quat", "vel", "ang_vel", "rotor_vel")
    return {"command": commands} | {name: getattr(data.states, name) for name in names}


@pytest.mark.long("compiles the gradient of every dynamics and command level")
@pytest.mark.parametrize("dynamics, control, engine", ENGINE_CASES)
def test_values_and_gradients_are_finite(dynamics, control, engine):
    """Law 7: every situation, every kind of dynamics and command, after 50 steps."""
    _, data, commands = make_situations(dynamics, control, engine)
    gradients, end = jax.device_get(make_flight(dynamics, control, engine)(differentiated_inputs(data, commands), data))
    for world in range(len(commands)):
        for leaf, x in {**vars(end.states), **{f"gradient of {k}": v for k, v in gradients.items()}}.items():
            assert np.all(np.isfinite(x[world])), f"{leaf} in {SITUATIONS[world % len(SITUATIONS)]!r}"
    assert not end.core.nonfinite.any()
    assert np.all(end.states.pos[..., 2] >= np.float32(FLOOR_HEIGHT))
    # Drones that fly have a gradient with respect to their initial position; drones on the floor have none.
    assert np.all(gradients["pos"][SITUATIONS.index("upside down"), 0, :2] != 0)
    # float32 rounding of 50 renormalisations
    np.testing.assert_allclose(np.linalg.norm(end.states.quat, axis=-1), 1.0, atol=1e-6)


HUGE_ANGLES = (20.0, 50.0, 90.0, 99.0, 150.0, 1e3, 1e6, 1e30, 3e38)
DIRECTIONS = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (-1, 1, -1), (0, -1, 0), (0.3, 1, -0.5))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_attitudes_that_no_drone_can_take_keep_a_fitted_model_bounded(integrator):
    """Law 7: angles do not saturate. Fly two seconds with angles up to the limit of float32, about several axes.

    Without a limit, the fit would turn a drone through the vertical again and again at 50 rad of pitch, ever faster.
    """
    angles = (np.array(HUGE_ANGLES)[:, None, None] * np.array(DIRECTIONS)).reshape(-1, 1, 3)
    airframes = [load_airframe(name) for name in ("cf21B_500", "cf2x_L250") for _ in angles]
    sim = Sim(len(airframes), dynamics="so_rpy_rotor", control="attitude", integrator=integrator)
    sim.data = with_states(with_airframes(sim, airframes), pos=[0.0, 0.0, 100.0])
    sim.attitude_control(np.tile(np.concatenate([angles, np.full((len(angles), 1, 1), 0.4)], axis=-1), (2, 1, 1)))
    fastest = np.zeros(2)
    for _ in range(200):
        sim.step(5)
        fastest = np.maximum(fastest, np.abs(sim.data.states.ang_vel).reshape(2, -1).max(axis=-1))
        assert np.all(np.isfinite(fastest))
    assert not np.any(sim.data.core.nonfinite)
    # rad/s for each airframe; the model limits it between 100 and 200, and a step of 2 ms may overshoot
    assert np.all((fastest > 50) & (fastest < 500))


EXTREMES = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
"""All combinations of minimum, zero and maximum of three numbers. (27, 3)"""


def extreme_commands(airframe, control):
    """Return constant valid commands of a level for one airframe, up to the limits of its rotors and beyond. (n, k)"""
    n_rotors, most = airframe.n_rotors, float(airframe.value("rotors.thrust_max"))
    hover = float(airframe.value("rigid_body.mass")) * 9.81
    if control == "rotor_vel":
        return 1e6 * np.array(list(itertools.product((0.0, 1.0), repeat=n_rotors)))
    torque = [n_rotors * most * airframe.arm] * 2 + [2 * most * float(airframe.value("controller.thrust2torque"))]
    if control == "force_torque":
        small = [hover, 0.0, 0.0, 2e-3 * hover / 0.4257]  # 2 mN m for a cf21B_500, which lets no rotor saturate
        return np.array([[force, *(torque * t)] for force in (hover, n_rotors * most) for t in EXTREMES] + [small])
    if control == "state":
        away = 100 * EXTREMES
        return np.concatenate([away, np.roll(away, 1, 0), away, np.eye(4)[np.arange(27) % 4], away[::-1]], axis=-1)
    largest = np.pi * np.array([1.0, 0.5, 1.0]) if control == "attitude" else np.full(3, 100.0)
    return np.array([[*(largest * t), force] for force in (hover, n_rotors * most) for t in EXTREMES])


CONSTANT_COMMANDS = [
    ("first_principles", "state", "euler"),
    ("first_principles", "attitude", "rk4"),
    ("first_principles", "body_rate", "symplectic_euler"),
    *(("first_principles", "force_torque", integrator) for integrator in INTEGRATORS),
    ("first_principles", "rotor_vel", "rk4"),
    ("so_rpy", "attitude", "symplectic_euler"),
    ("so_rpy_rotor_drag", "attitude", "euler"),
]


@pytest.mark.parametrize("dynamics, control, integrator", CONSTANT_COMMANDS)
def test_a_minute_of_any_constant_command_stays_finite(dynamics, control, integrator):
    """Law 7: the extremes of every command level on every airframe, as the worlds of one batch.

    Nothing damps a body rate, so a constant torque raises it to the integrators' limit of 1 rad per step and axis.
    """
    airframes = [load_airframe(name) for name in Drone if dynamics in supported_dynamics(name)]
    commands = [extreme_commands(airframe, control) for airframe in airframes]
    airframe_by_world = [
        airframe
        for airframe, commands_of_airframe in zip(airframes, commands, strict=True)
        for _ in commands_of_airframe
    ]
    sim = Sim(len(airframe_by_world), dynamics=dynamics, control=control, integrator=integrator)
    sim.data = with_states(with_airframes(sim, airframe_by_world), pos=[0.0, 0.0, 100.0])
    getattr(sim, f"{control}_control")(np.concatenate(commands)[:, None])
    fastest = np.zeros(sim.n_worlds)
    for _ in range(60):
        sim.step(sim.freq)
        fastest = np.maximum(fastest, np.abs(np.asarray(sim.data.states.ang_vel)[:, 0]).max(-1))
    for field in dataclasses.fields(sim.data.states):
        name, x = field.name, getattr(sim.data.states, field.name)
        assert np.all(np.isfinite(x)), (
            name,
            {a.name for a, ok in zip(airframe_by_world, np.isfinite(x), strict=True) if not ok.all()},
        )
    assert not sim.data.core.nonfinite.any()
    assert fastest.max() <= sim.freq
    assert (fastest == sim.freq).any() == (control in ("force_torque", "rotor_vel")), "some command reaches the limit"


@pytest.mark.parametrize("dynamics, control, engine", ENGINE_CASES)
def test_a_bad_world_changes_no_other(dynamics, control, engine):
    """Law 7: NaN in world 1 changes no bit of other worlds and of their gradients, and only world 1 is flagged."""
    _, data, commands = make_situations(dynamics, control, engine)
    fly = make_flight(dynamics, control, engine)
    good_gradients, good = fly(differentiated_inputs(data, commands), data)
    states = data.states
    for bad_numbers in (
        {"pos": (slice(None), np.nan), "quat": ((0, 2), np.nan)},
        {"vel": (slice(None), np.inf), "ang_vel": ((0, 0), -np.inf)},
    ):
        changes = {name: np.array(getattr(states, name)) for name in bad_numbers}
        for name, (index, value) in bad_numbers.items():
            changes[name][1][index] = value
        changes = jax.device_put(
            changes, jax.devices()[0]
        )  # on the device of the data, or the flight would be compiled again
        bad_gradients, bad = fly(differentiated_inputs(data.replace(states=states.replace(**changes)), commands), data)
        others = np.arange(len(commands)) != 1
        for a, b in ((good, bad), (good_gradients, bad_gradients)):
            a, b = ((x.states, x.controls) if x in (good, bad) else x for x in (a, b))
            assert trees_equal(*(drone_leaves(tree, others) for tree in (a, b)))
        assert np.asarray(bad.core.nonfinite)[:, 0].tolist() == (~others).tolist()


def drone_leaves(tree, worlds):
    return [np.asarray(x)[worlds] for x in jax.tree.leaves(tree) if x.ndim == 3 and x.shape[0] == len(worlds)]
