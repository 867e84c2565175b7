"""The compiled step: parameters, stages of the user, transformations, rollouts and the choice of the engine."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import (
    COMPILED_ENGINES,
    build_stagewise_step,
    hover_command,
    repeat_command,
    send,
    shared_sim,
    with_params,
    with_states,
)

from crazysim import ConfigError, Sim
from crazysim.control import Control, command_size
from crazysim.core import functional as F
from crazysim.core.pipeline import insert_fn_before
from crazysim.core.random import drone_key
from crazysim.dynamics import Dynamics
from crazysim.engine import Step, explain
from crazysim.engine.backends import cuda, kernel, lanes
from crazysim.engine.lowering.stages import MAX_UNROLLED_DRONES
from crazysim.engine.pytree import PyTree, leaf
from crazysim.engine.sharding import put_on_device
from crazysim.engine.stage import stage
from crazysim.sim import rollout


def scatter_drones(sim, extreme=False, dtype=np.float32):
    """Return the data with a random state and command of each drone, and a random step count of each world.

    If ``extreme``, heights, velocities and most commands are 20 times as large.
    """
    rng = np.random.default_rng(1)
    shape = (sim.n_worlds, sim.n_drones)
    scale = 20.0 if extreme else 1.0
    n_rotors = sim.data.states.rotor_vel.shape[-1]
    quat = rng.normal(size=(*shape, 4))
    rotors = 0.1 * rng.uniform(size=(*shape, n_rotors)) if "rotor" in sim.dynamics else None
    rotors = rng.uniform(0, 22000, (*shape, n_rotors)) if sim.dynamics == Dynamics.first_principles else rotors
    data = sim.data
    states = data.states.replace(
        pos=dtype(rng.uniform(-1, 2, (*shape, 3)) * [1, 1, scale]),
        quat=dtype(quat / np.linalg.norm(quat, axis=-1, keepdims=True)),
        vel=dtype(scale * rng.normal(size=(*shape, 3))),
        ang_vel=dtype(scale * rng.normal(size=(*shape, 3))),
        force=dtype(0.1 * rng.normal(size=(*shape, 3))),
        torque=dtype(1e-4 * rng.normal(size=(*shape, 3))),
        **({} if rotors is None else {"rotor_vel": dtype(rotors)}),
    )
    core = data.core.replace(steps=jnp.asarray(rng.integers(0, 10, (sim.n_worlds, 1)), jnp.int32))
    data = put_on_device(data.replace(states=states, core=core), sim.device)
    size = command_size(sim.control, n_rotors)
    command = scale * 0.2 * rng.normal(size=(*shape, size))
    if sim.control == Control.rotor_vel:
        command = rng.uniform(-1000, 30000, (*shape, size))
    elif sim.control != Control.state:
        command[..., 0 if sim.control == Control.force_torque else 3] = rng.uniform(-0.1, 0.8, shape)
    if sim.control == Control.force_torque:
        command[..., 1:] *= 1e-2
    return getattr(F, f"{sim.control.value}_control")(data, dtype(command))


@pytest.mark.long("compiles every engine, in float64")
def test_long_runs_agree_in_float64(x64):
    """In 200 steps, rounding of 2e-16 a step grows to at most 1e-9 through the gains of the closed loop."""
    sim = Sim(n_worlds=3, n_drones=2, control="state")
    data = scatter_drones(sim, dtype=np.float64)
    expected = Step(sim.step_pipeline, "plain")(data, jnp.int32(200))
    for engine in COMPILED_ENGINES:
        result = Step(sim.step_pipeline, engine)(data, jnp.int32(200))
        for name in ("pos", "quat", "vel"):
            a, b = getattr(result.states, name), getattr(expected.states, name)
            assert a.dtype == np.float64
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9, err_msg=f"{engine} {name}")


def test_a_parameter_of_each_drone_is_its_own():
    sim = shared_sim(n_worlds=3, n_drones=2, control="rotor_vel")
    g = np.float32(-9.81 * np.linspace(0.5, 1.5, 6).reshape(3, 2, 1) * [0, 0, 1.0])
    data = with_params(sim.data, gravity_vec=g, drag_matrix=np.zeros((3, 3), np.float32))
    data = with_states(data, pos=[0.0, 0.0, 9.0])
    vel = np.asarray(Step(sim.step_pipeline)(data, jnp.int32(10)).states.vel)
    np.testing.assert_allclose(vel[..., 2], 0.02 * g[..., 2], rtol=1e-5)  # ten roundings
    assert len(np.unique(vel[..., 2])) == 6


def test_zeros_of_parameters_are_found_again_when_a_parameter_changes():
    """Terms of a diagonal inertia are left out only as long as the inertia is diagonal."""
    sim = shared_sim(n_worlds=1, n_drones=1, control="rotor_vel")
    step = Step(sim.step_pipeline)
    data = with_states(sim.data, pos=[0.0, 0.0, 1.0], torque=[1e-5, 0.0, 0.0])
    assert pitch_rate(step(data, jnp.int32(1))) == 0.0
    J_inv = np.array(data.params.J_inv)
    J_inv[1, 0] = 1e4
    coupled = with_params(data, J_inv=J_inv)
    np.testing.assert_allclose(pitch_rate(step(coupled, jnp.int32(1))), 0.002 * 1e4 * 1e-5, rtol=1e-5)
    inside = jax.jit(lambda d: step(d, jnp.int32(1)))(coupled)
    np.testing.assert_allclose(pitch_rate(inside), 0.002 * 1e4 * 1e-5, rtol=1e-5)


def test_a_parameter_that_a_stage_writes_is_not_taken_for_zero():
    """Gravity turns in every step, so its component along x is zero only at the beginning of a call."""
    sim = shared_sim(n_worlds=2, n_drones=1, control="rotor_vel")

    def turn(data):
        return data.replace(params=data.params.replace(gravity_vec=data.params.gravity_vec.at[0].add(0.1)))

    data = with_states(sim.data, pos=[0.0, 0.0, 9.0])
    after = Step({"turn": turn, **sim.step_pipeline})(data, jnp.int32(5))
    np.testing.assert_allclose(after.params.gravity_vec[0], 0.5, rtol=1e-6)
    np.testing.assert_allclose(after.states.vel[..., 0], 0.002 * (0.1 + 0.2 + 0.3 + 0.4 + 0.5), rtol=0.01)


def test_arrays_of_numpy_are_read_again_in_every_call():
    """Law 11: the owner of an array may write into it between calls."""
    sim = shared_sim(n_worlds=1, n_drones=1, control="rotor_vel")
    gravity = np.zeros(3, np.float32)
    data = with_states(sim.data, pos=[0.0, 0.0, 9.0])
    data = data.replace(params=data.params.replace(gravity_vec=gravity))
    step = Step(sim.step_pipeline, "auto")
    assert np.all(step(data, jnp.int32(5)).states.vel == 0)
    gravity[0] = 3.0
    np.testing.assert_allclose(step(data, jnp.int32(5)).states.vel[..., 0], 0.03, rtol=0.01)


def pitch_rate(data):
    return np.asarray(data.states.ang_vel)[0, 0, 1]


# Stages of the user -------------------------------------------------------------------------------------------------


class Gust(PyTree):
    force: jax.Array = leaf("drone", 1)
    """Force, world frame, N. (3,)"""
    strength: jax.Array = leaf("world", 0)
    """Standard deviation of the change of the force per step, N. ()"""
    is_on: jax.Array = leaf("world", 0)
    """True where the force acts. ()"""
    was_strong: jax.Array = leaf("drone", 0)
    """True where the x component of the force has ever exceeded 0.001 N. ()"""
    count: jax.Array = leaf("drone", 0)
    """Number of steps at which that component exceeded 0.001 N. ()"""


@stage("drone")
def gust(data):
    record = data.plugins["gust"]
    noise = jax.random.normal(drone_key(data, "gust"), (3,))
    force = jnp.where(record.is_on, 0.9 * record.force + record.strength * noise, 0.0)
    strong = force[0] > 0.001
    record = record.replace(force=force, was_strong=record.was_strong | strong, count=record.count + strong)
    states = data.states.replace(force=record.force)
    return data.replace(plugins=data.plugins | {"gust": record}, states=states)


@stage("world")
def separation(data):
    offsets = data.states.pos[:, None] - data.states.pos[None, :]
    squared = jnp.sum(offsets**2, axis=-1, keepdims=True) + 0.1
    force = 1e-3 * jnp.sum(offsets / squared, axis=1)
    return data.replace(states=data.states.replace(force=force))


def undeclared_stage(data):
    mean = jnp.mean(data.states.pos, axis=(0, 1))
    return data.replace(states=data.states.replace(torque=0 * data.states.torque + 1e-6 * mean))


def make_sim_with_stages(n_drones, *stages):
    sim = Sim(n_worlds=3, n_drones=n_drones, control="attitude", rng_key=4)
    shape = (3, n_drones)
    record = Gust(
        np.zeros((*shape, 3), np.float32),
        np.linspace(0.001, 0.003, 3, dtype=np.float32)[:, None],
        np.array([[True], [False], [True]]),
        np.zeros(shape, bool),
        np.zeros(shape, np.int32),
    )
    sim.data = sim.data.replace(plugins={"gust": record})
    for fn in stages:
        insert_fn_before(sim.step_pipeline, "integration", fn)
    return sim, scatter_drones(sim)


@pytest.mark.parametrize("stages, n_segments", [
    ((gust,), 1), ((separation,), 3), ((undeclared_stage,), 3), ((gust, separation, undeclared_stage), 4),
])  # fmt: skip
def test_a_stage_of_one_drone_or_one_world_fuses_and_an_undeclared_one_splits_the_step(stages, n_segments):
    sim, data = make_sim_with_stages(4, *stages)
    step = Step(sim.step_pipeline)
    assert len(step.plan(data).program.segments) == n_segments
    text = explain(step, data)
    assert ("'undeclared_stage' is not fused: it is not declared for one drone or one world" in text) == (
        undeclared_stage in stages
    )


def test_a_stage_of_one_world_is_in_the_kernel():
    _, data = make_sim_with_stages(MAX_UNROLLED_DRONES, separation)
    step = Step({"separation": separation})
    assert step.plan(data).program.fused
    result = step(data, jnp.int32(1)).states.force
    assert np.abs(result).max() > 1e-4
    np.testing.assert_allclose(result, separation(data).states.force, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("fn, words", [
    (lambda d: d.replace(params=d.params.replace(mass=2 * d.params.mass)), "writes params.mass, which is shared"),
    (lambda d: d.replace(core=d.core.replace(steps=d.core.steps + 1)), "writes core.steps, which is world"),
    (lambda d: d.replace(states=d.states.replace(pos=d.states.pos[:2])), "of shape (3,) and type float32 into"),
])  # fmt: skip
def test_law_09_a_stage_writes_within_its_scope(fn, words):
    sim = shared_sim(n_worlds=3, n_drones=2, control="rotor_vel")
    with pytest.raises(ConfigError) as error:
        Step(sim.step_pipeline | {"mine": stage("drone")(fn)})(sim.data, jnp.int32(1))
    assert "stage 'mine'" in str(error.value)
    assert words in str(error.value)


# Transformations -----------------------------------------------------------------------------------------------------


def assert_gradients_equal(computed, expected):
    """Assert equality to 1e-9 of the largest component of each gradient."""
    for x, y in zip(jax.tree.leaves(computed), jax.tree.leaves(expected), strict=True):
        scale = float(np.abs(y).max())
        assert scale > 1e-3
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9 * scale)


@pytest.mark.long("compiles gradients in both directions")
def test_long_and_forward_gradients_and_those_of_parameters(x64, monkeypatch):
    """From ``MIN_CHECKPOINTED_STEPS`` on, few carries are stored; a zero of an inertia still has a derivative."""
    monkeypatch.setattr(lanes, "MIN_CHECKPOINTED_STEPS", 16)
    sim = Sim(n_worlds=2, n_drones=1, control="rotor_vel")
    data = scatter_drones(sim, dtype=np.float64)
    data = data.replace(states=data.states.replace(pos=data.states.pos + 5.0))  # off the floor
    inputs = (data.controls.rotor_vel, data.params.J)

    def energy(step, command, J):
        ready = F.rotor_vel_control(data.replace(params=data.params.replace(J=J)), 1e4 * command)
        return jnp.sum(step(ready, 36).states.ang_vel ** 2)

    inputs = 1e-4 * inputs[0], inputs[1]
    unfused, fast = (
        functools.partial(energy, step)
        for step in (build_stagewise_step(sim), Step(sim.step_pipeline, COMPILED_ENGINES[-1]))
    )
    expected = jax.jit(jax.jacfwd(unfused, (0, 1)))(*inputs)
    assert abs(float(expected[1][0, 1])) > 0
    assert_gradients_equal(jax.jit(jax.grad(fast, (0, 1)))(*inputs), expected)
    slope = jax.jit(lambda *x: jax.jvp(fast, x, x)[1])(*inputs)
    assert_gradients_equal(slope, sum(np.sum(gradient * x) for gradient, x in zip(expected, inputs, strict=True)))


@pytest.mark.parametrize("engine", ["plain", "lanes"])
def test_values_without_a_derivative_may_cross_barriers_in_a_loop(engine):
    """The stage is longer than the interval of barriers, and values that it does not differentiate cross them."""

    def swing(data):
        x, frozen = data.states.vel, jax.lax.stop_gradient(data.states.pos)
        x = jax.lax.fori_loop(0, 20, lambda _, x: x + 0.1 * jnp.sin(x * frozen), x) + frozen * x[..., ::-1]
        for _ in range(8):
            x, frozen = x + 0.1 * jnp.sin(x * frozen), frozen + jax.lax.stop_gradient(x)
        return data.replace(states=data.states.replace(vel=x + frozen, pos=frozen))

    sim = shared_sim(n_worlds=2, n_drones=1)
    step, n_steps = Step({"swing": stage("drone")(swing)}, engine), 3
    vel = 0.3 + 0.1 * np.arange(6, dtype=np.float32).reshape(2, 1, 3)

    def energy(advance, vel):
        return jnp.sum(advance(sim.data.replace(states=sim.data.states.replace(vel=vel))).states.vel ** 2)

    def repeat(data):
        for _ in range(n_steps):
            data = swing(data)
        return data

    gradient = jax.grad(lambda vel: energy(lambda data: step(data, n_steps), vel))(vel)
    np.testing.assert_allclose(gradient, jax.jacfwd(functools.partial(energy, repeat))(vel), rtol=1e-4)


@pytest.mark.parametrize("n", [1, 15, 16, 18, 25])
def test_a_loop_has_the_derivative_of_its_steps(monkeypatch, n):
    """Numbers of steps below and above ``MIN_CHECKPOINTED_STEPS``, square numbers and others."""
    monkeypatch.setattr(lanes, "MIN_CHECKPOINTED_STEPS", 16)

    def power(x, y):
        (product, _) = lanes.repeat(lambda c: (c[0] * x, c[1] + 1), (y, 0), n)
        return product

    value, slopes = jax.jit(jax.value_and_grad(power, (0, 1)))(1.1, 2.0)
    np.testing.assert_allclose([value, *slopes], [2 * 1.1**n, 2 * n * 1.1 ** (n - 1), 1.1**n], rtol=1e-5)


# Leaves that share an array ------------------------------------------------------------------------------------------


class Twins(PyTree):
    flags: jax.Array = leaf("world")
    speeds: jax.Array = leaf("drone", 1)
    synced: jax.Array = leaf("shared")


@stage("drone")
def speed_up(data):
    twins = data.plugins["twins"]
    return data.replace(plugins={"twins": twins.replace(speeds=twins.speeds + jnp.inf)})


def test_leaves_that_share_an_array_are_not_confused():
    sim = shared_sim(n_worlds=3, n_drones=2, control="rotor_vel")
    data = with_states(sim.data, pos=np.array([0.0, np.nan, 0.0])[:, None, None])
    data = data.replace(core=data.core.replace(mjx_synced=jnp.asarray(True)))
    twins = Twins(flags=data.core.nonfinite, speeds=data.states.vel, synced=data.core.mjx_synced)
    after = Step({"speed_up": speed_up})(data.replace(plugins={"twins": twins}), jnp.int32(1))
    np.testing.assert_array_equal(after.core.nonfinite, [[False], [True], [False]])
    assert not after.core.mjx_synced
    assert not np.any(after.plugins["twins"].flags)
    assert np.all(np.isinf(after.plugins["twins"].speeds))
    assert after.plugins["twins"].synced
    np.testing.assert_array_equal(after.states.vel, data.states.vel)


# Rollouts ------------------------------------------------------------------------------------------------------------


def climb_policy(gain, data):
    thrust = 0.4258 + gain * (1.0 - data.states.pos[..., 2:]) - 0.2 * data.states.vel[..., 2:]
    return jnp.concatenate([jnp.zeros_like(data.states.pos), thrust], axis=-1)


def test_a_rollout_equals_its_loop_of_steps(capfd):
    """The kept values equal those of a loop, at the requested interval, and the simulation goes on from the end."""
    sim = Sim(n_worlds=3, n_drones=2, control="attitude", attitude_freq=100)
    start, gain = sim.data, jnp.float32(0.3)
    records = sim.rollout(climb_policy, gain, 40, keep=lambda d: {"z": d.states.pos[..., 2]}, every=10)
    assert records["z"].shape == (4, 3, 2)
    step, data = sim.build_step_fn(), start
    for k in range(1, 41):
        data = step(F.attitude_control(data, climb_policy(gain, data)), jnp.int32(5))
        if k % 10 == 0:
            np.testing.assert_allclose(records["z"][k // 10 - 1], data.states.pos[..., 2], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sim.data.states.pos, data.states.pos, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(sim.data.core.steps, np.full((3, 1), 200))
    assert not start.states.pos.is_deleted()  # law 11
    again = sim.rollout(climb_policy, gain, 40, keep=lambda d: d.states.pos, every=20, progress=True)
    assert again.shape == (2, 3, 2, 3)
    assert "control steps" not in capfd.readouterr().err  # no bar without a terminal


@pytest.mark.parametrize("offset", [0, 1, 4])
def test_a_rollout_begins_at_a_tick_of_the_controller(offset):
    """Between two ticks its first command would have no effect for some steps, and the last one hardly any."""
    sim = Sim(n_worlds=2, control="attitude", attitude_freq=100)
    period, commands = sim.freq // sim.control_freq, jnp.asarray([0.3, 0.4, 0.5])

    def policy(commands, data):
        command = commands[(data.core.steps[0, 0] - first_tick) // period]
        return jnp.zeros((2, 1, 4)).at[..., 3].set(command)

    def keep(data):
        return data.core.steps[0, 0], data.controls.attitude.cmd[0, 0, 3]

    sim.step(period + offset)
    first_tick = period * (2 if offset else 1)
    steps, applied = sim.rollout(policy, commands, 3, keep=keep)
    np.testing.assert_array_equal(steps, first_tick + period * np.arange(1, 4))
    np.testing.assert_array_equal(applied, commands)
    # Worlds between different ticks have none in common.
    sim.data = sim.data.replace(core=sim.data.core.replace(steps=jnp.asarray([[3], [4]], jnp.int32)))
    first_tick = 0
    steps, _ = sim.rollout(policy, commands, 1, keep=keep)
    np.testing.assert_array_equal(steps, [3 + period])


def test_a_rollout_returns_its_last_command_where_leaves_share_an_array():
    sim = shared_sim(n_worlds=3, n_drones=2, control="attitude")
    attitude = sim.data.controls.attitude.replace(cmd=sim.data.controls.attitude.staged_cmd)
    data = sim.data.replace(controls=sim.data.controls.replace(attitude=attitude))
    after, _ = rollout(sim.step_fn, data, climb_policy, jnp.float32(0.3), 1, 5)
    np.testing.assert_array_equal(after.controls.attitude.staged_cmd, climb_policy(jnp.float32(0.3), data))


def test_a_rollout_stages_commands_like_the_setter():
    sim = shared_sim(n_worlds=2, n_drones=1, control="state")
    feedforward = np.random.default_rng(0).normal(size=(2, 1, 8))
    before = F.state_control(sim.data, pos=(0, 0, 1), feedforward=feedforward)
    command = repeat_command(before, hover_command(before, (0.2, 0, 1))).copy()
    command[..., -1] += 0.5  # for a setpoint, its yaw rate
    command, n = jnp.asarray(command, jnp.float32), sim.freq // sim.control_freq
    expected = before
    for _ in range(2):
        expected = sim.step_fn(send(expected, command), jnp.int32(n))
    sim.data = before
    sim.rollout(lambda command, _: command, command, 2)
    result, sim.data = sim.data, sim.default_data
    for x, y in zip(jax.tree.leaves(result.controls), jax.tree.leaves(expected.controls), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(result.states.pos, expected.states.pos, rtol=1e-5)


# Choice --------------------------------------------------------------------------------------------------------------


def select_controller(state, setpoint, time):
    return jnp.where(time < 1.0, 0, 1)


@pytest.mark.parametrize(
    "settings",
    [
        {"control": "state", "state_freq": 100},
        {"control": "rotor_vel"},
        {"dynamics": "so_rpy_rotor_drag", "control": "state", "state_freq": 100},
        {"control": "state", "controller": ("pid", "mellinger"), "switch": select_controller},
    ],
    ids=lambda settings: "-".join(str(s) for s in settings.values() if isinstance(s, (str, tuple))),
)
def test_every_pipeline_compiles_for_a_gpu(settings):
    """NVRTC compiles without a GPU."""
    sim = shared_sim(n_worlds=2, n_drones=3, **settings)
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here; CI has it")
    step = Step(sim.step_pipeline, "fused", "gpu")
    plan = step.plan(sim.data)
    assert plan.engine == "fused"
    source = kernel.write_kernel(plan.program, "cuda")
    text = cuda.ptx(source, cuda.DEFAULT_ARCHITECTURE)
    parameters = text.split(".entry advance(")[1].split(")")[0]
    assert parameters.count(".param") == 2 + len(source.inputs) + len(source.outputs) + 1  # sizes, count, ..., flags
    assert text.count("st.global") >= sum(plan.program.leaves[i].size for i in source.outputs)  # nothing is lost
    inputs = step.flatten(sim.data).inputs()
    lowered = plan.traced_count_step.trace(inputs, jnp.int32(3)).lower(lowering_platforms=("cuda",))
    assert lowered.as_text().count(cuda.PTX_TARGET) == 1  # one kernel for all stages and steps


def test_vmap_over_commands_and_parameters_is_a_loop():
    sim = shared_sim(n_worlds=3, n_drones=2, control="attitude")
    data, step = scatter_drones(sim), Step(sim.step_pipeline)
    commands = (
        np.asarray(data.controls.attitude.staged_cmd) * np.linspace(0.5, 1.5, 4, dtype=np.float32)[:, None, None, None]
    )
    masses = np.asarray(data.params.mass) * np.linspace(0.9, 1.1, 4, dtype=np.float32)[:, None]

    def fly(command, mass):
        ready = F.attitude_control(data.replace(params=data.params.replace(mass=mass)), command)
        return step(ready, jnp.int32(7)).states

    cases = [(jax.vmap(fly), masses), (jax.vmap(fly, (0, None)), np.asarray(data.params.mass))]
    compiled = jax.jit(fly)
    for batched_fly, mass in cases:
        many = jax.device_get(jax.jit(batched_fly)(commands, mass))
        for k in range(4):
            single = compiled(commands[k], mass[k] if mass.ndim > 1 else mass)
            for name in ("pos", "vel"):
                np.testing.assert_allclose(getattr(many, name)[k], getattr(single, name), rtol=1e-5, atol=1e-6)
