"""The step exported to CasADi equals the step and its Jacobian, at random states of all dynamics and command levels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import CHOSEN_PAIRS, INTEGRATORS, build_stagewise_step, hover_command, hover_rotor_state

from crazysim import Battery, ConfigError, Downwash, Sim
from crazysim.core import functional as F
from crazysim.core.pipeline import append_fn, insert_fn_before
from crazysim.engine.stage import Axes, stage
from crazysim.lab.export.casadi import STATES, to_casadi

pytestmark = pytest.mark.usefixtures("casadi", "x64")

N_WORLDS, N_DRONES = 6, 2
OTHER_INTEGRATORS = [
    ("first_principles", "rotor_vel", "rk4"),
    ("so_rpy_rotor_drag", "attitude", "rk4"),
    ("first_principles", "attitude", "symplectic_euler"),
]
"""Dynamics, command level and integrator."""
assert all(integrator in INTEGRATORS for *_, integrator in OTHER_INTEGRATORS)


def fields(data, names):
    leaves = dict(zip(Axes(data).names, jax.tree.leaves(data), strict=True))
    return [leaves[name] for name in names]


def with_fields(data, changes):
    leaves, treedef = jax.tree.flatten(data)
    return treedef.unflatten([changes.get(name, x) for name, x in zip(Axes(data).names, leaves, strict=True)])


def with_random_states(sim, step):
    """Return the simulation's data with random values of x and u for every drone.

    Some drones are on or under the floor, some rotors off, some commands beyond what the motors can give.
    """
    rng = np.random.default_rng(7)
    hover, command = hover_rotor_state(sim.data)[0], hover_command(sim.data)
    sizes = {"states.pos": 1.0, "states.quat": 1.0, "states.vel": 2.0, "states.ang_vel": 3.0, "states.rotor_vel": hover}
    changes = {}
    for name in (*step.x.sizes, *step.u.sizes):
        (old,) = fields(sim.data, [name])
        new = sizes.get(name, 0.1) * rng.normal(size=old.shape)
        if name == "core.steps":
            new = rng.integers(0, 10, old.shape)
            new[0] = 0  # a tick of every controller
        elif name == "states.quat":
            new /= np.linalg.norm(new, axis=-1, keepdims=True)
        elif name in step.u.sizes or name == f"controls.{sim.control.value}.cmd":
            new = command + np.where(command == 0, 0.2, 0.7 * command) * rng.normal(size=old.shape)
        elif name == "states.rotor_vel":
            new = np.abs(new)
        changes[name] = np.asarray(new, old.dtype)
    changes["states.pos"][:2, :, 2] = [[-0.001, -0.01], [-0.002, 0.0]]
    return on_host(with_fields(sim.data, changes))


def on_host(data):
    """Return the data with NumPy arrays; random keys stay."""
    return jax.tree.map(lambda x: x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else np.asarray(x), data)


def compare(sim, step, data):
    """Compare the exported step with the reference, drone by drone, each field to 1e-12 of its size."""
    data = F.stage_command(data, F.staged_leaves(data)[0])
    after = on_host(jax.jit(build_stagewise_step(sim), static_argnums=1)(data, 1))
    for world in range(sim.n_worlds):
        for drone in range(sim.n_drones):
            index = world, drone
            parts = [part.of(data, *index) for part in (step.x, step.u, step.p) if len(part)]
            result = np.asarray(step(*parts)).ravel()
            expected = step.x.of(after, *index)
            assert len(result) == len(step.x)
            for name in step.x.sizes:
                a, b = result[step.x[name]], expected[step.x[name]]
                scale = max(1.0, np.abs(b).max())
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * scale, err_msg=f"{name} of {index}")


@pytest.mark.parametrize(
    ("dynamics", "control", "integrator"), [(*pair, "euler") for pair in CHOSEN_PAIRS] + OTHER_INTEGRATORS
)
def test_the_exported_step_is_the_step(dynamics, control, integrator):
    sim = Sim(N_WORLDS, N_DRONES, dynamics=dynamics, control=control, integrator=integrator)
    step = to_casadi(sim)
    assert step.function.name_in() == ["x", "u"]
    assert list(step.x.sizes)[: len(STATES)] == list(STATES)
    assert step.dt == 1 / sim.freq
    compare(sim, step, with_random_states(sim, step))


@pytest.mark.parametrize("dynamics", ["first_principles", "so_rpy"])
def test_the_jacobian_is_that_of_jax(dynamics):
    """By x and u, at a state where nothing switches."""
    sim = Sim(dynamics=dynamics, control="attitude")
    exported, step = to_casadi(sim), build_stagewise_step(sim)
    rng = np.random.default_rng(1)
    start = exported.x.of(sim.data)
    x = start + 0.05 * rng.normal(size=len(exported.x))
    for name in exported.x.sizes:
        if ".memory." in name:  # such torques would saturate the rotors
            x[exported.x[name]] = start[exported.x[name]]
    x[exported.x["states.pos"]] = [0.1, 0.2, 1.0]
    x[exported.x["states.quat"]] /= np.linalg.norm(x[exported.x["states.quat"]])
    x[exported.x["states.rotor_vel"]] = hover_rotor_state(sim.data) * [0.9, 0.92, 0.94, 0.96]
    u = hover_command(sim.data) * 1.02 + 0.01

    def advance(x, u):
        changes = {name: x[exported.x[name]] for name in exported.x.sizes} | {next(iter(exported.u.sizes)): u}
        data = with_fields(sim.data, {name: value[None, None] for name, value in changes.items()})
        return jnp.concatenate([value[0, 0] for value in fields(step(data, 1), exported.x.sizes)])

    expected = jax.jit(jax.jacfwd(advance, argnums=(0, 1)))(x, u)
    result = exported.function.jacobian()(x, u, 0)
    for a, b in zip(result, expected, strict=True):
        largest = np.abs(b).max(axis=1, keepdims=True)  # of each number of the next state
        assert (largest > 0).sum() >= 4
        size = np.where(largest > 0, largest, 1.0)
        np.testing.assert_allclose(np.asarray(a) / size, b / size, rtol=1e-10, atol=1e-11)


def test_parameters_are_an_input():
    sim = Sim(N_WORLDS, N_DRONES, control="rotor_vel")
    names = ("states.force", "params.mass", "params.rpm2thrust")
    step = to_casadi(sim, names)
    assert step.function.name_in() == ["x", "u", "p"]
    assert step.p.sizes == {"states.force": 3, "params.mass": 1, "params.rpm2thrust": 3}
    rng = np.random.default_rng(2)
    data = with_random_states(sim, step)
    changes = {
        "states.force": rng.normal(size=(N_WORLDS, N_DRONES, 3)),
        "params.mass": rng.uniform(0.02, 0.06, (N_WORLDS, N_DRONES, 1)),
        "params.rpm2thrust": 1.1 * data.params.rpm2thrust,
    }
    compare(sim, step, with_fields(data, changes))


@pytest.mark.long("exports a step twice, and compiles its stages")
def test_the_feedforward_follows_from_the_setpoint_or_is_a_parameter():
    """A feedforward that was staged before is no constant of the step: that of the command replaces it."""
    sim, name = Sim(N_WORLDS, N_DRONES, control="state"), "controls.state.staged_feedforward"
    feedforward = np.random.default_rng(3).normal(size=(N_WORLDS, N_DRONES, 8))
    sim.state_control(pos=(0, 0, 1), feedforward=feedforward)
    step = to_casadi(sim)
    compare(sim, step, with_random_states(sim, step))
    assert to_casadi(sim, [name]).p.sizes == {name: 8}


def test_constants_are_those_of_the_selected_drone():
    sim = Sim(2, 2, control="rotor_vel")
    mass = np.array([[0.03, 0.04], [0.05, 0.06]])[..., None]
    sim.data = with_fields(sim.data, {"params.mass": mass})
    x, u = (part.of(sim.data) for part in (to_casadi(sim).x, to_casadi(sim).u))
    x[2], x[13:] = 1.0, 15_000.0
    climbs = [to_casadi(sim, world=w, drone=d)(x, u)[9] for w, d in ((0, 0), (1, 1))]
    thrust = [(float(v) / to_casadi(sim).dt + 9.81) * m for v, m in zip(climbs, (0.03, 0.06), strict=True)]
    np.testing.assert_allclose(thrust[0], thrust[1], rtol=1e-9)


@pytest.mark.parametrize("dynamics", ["first_principles", "so_rpy"])
def test_every_constant_that_is_nan_is_named(dynamics):
    """Numbers that the step does not read, and states, which are no constants, may be NaN."""
    sim = Sim(1, 2, dynamics=dynamics)
    usual, names, refused = sim.data, Axes(sim.data).names, []
    constants = [x for x, a in zip(names, jax.tree.leaves(usual), strict=True) if x.startswith("params.") and a.size]
    for name in constants:
        (old,) = fields(usual, [name])
        sim.data = with_fields(usual, {name: np.full(old.shape, np.nan, old.dtype)})
        try:
            step = to_casadi(sim)
        except ConfigError as error:
            refused.append(str(error).partition("got NaN in ")[2].partition(" of world 0 and drone 0.")[0])
            step = to_casadi(sim, [name])
            assert refused[-1] == repr(name)
            assert list(step.p.sizes) == [name]
        else:
            assert np.isfinite(np.asarray(step(step.x.of(usual), step.u.of(usual)))).all()
    assert "'params.mass'" in refused


def test_stages_of_the_user_are_exported_with_their_memory():
    """A battery, and a stage with a bounded loop and a branch, of one drone."""
    sim = Sim(N_WORLDS, N_DRONES, control="rotor_vel")
    sim.add(Battery(capacity=0.35, resistance=0.1))

    @stage("drone", when=lambda data: data.states.vel[2] > 0)
    def brake(data):
        vel = jax.lax.fori_loop(0, 3, lambda k, v: v * (1 - 1e-3 * k), data.states.vel)
        return data.replace(states=data.states.replace(vel=jnp.where(vel[0] > 0, vel, 0.9 * vel)))

    append_fn(sim.step_pipeline, brake)
    step = to_casadi(sim)
    assert set(step.x.sizes) > set(STATES), "a battery remembers its charge"
    data = with_random_states(sim, step)
    charge = {name: x for name, x in zip(Axes(data).names, jax.tree.leaves(sim.data), strict=True) if "plugins" in name}
    compare(sim, step, with_fields(data, charge))


def undeclared_stage(data):
    return data.replace(states=data.states.replace(vel=0.99 * data.states.vel))


@stage("drone")
def random_gust(data):
    return data.replace(states=data.states.replace(force=jax.random.normal(data.core.rng_key, (3,))))


@stage("drone")
def slow_down(data):
    vel = jax.lax.while_loop(lambda v: jnp.sum(v * v) > 1.0, lambda v: 0.9 * v, data.states.vel)
    return data.replace(states=data.states.replace(vel=vel))


@pytest.mark.parametrize(
    ("fn", "words"),
    [
        (undeclared_stage, "not declared for one drone"),
        (random_gust, "random numbers"),
        (slow_down, "until a condition fails"),
    ],
)
def test_a_stage_that_cannot_be_exported_is_named(fn, words):
    sim = Sim(control="rotor_vel")
    insert_fn_before(sim.step_pipeline, "integration", fn)
    with pytest.raises(ValueError, match=f"(?s)'{fn.__name__}'.*{words}"):
        to_casadi(sim)


def test_a_stage_of_all_drones_of_a_world_is_named():
    sim = Sim(n_drones=2, control="rotor_vel")
    sim.add(Downwash())
    with pytest.raises(ValueError, match=r"(?s)'downwash'.*all drones of its world"):
        to_casadi(sim)
