"""Time trials: the phase of a flight along the plan, the finish, missed gates, and what is observed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, rotation
from crazysim.drones.body import body_shape
from crazysim.envs import Track, make
from crazysim.lab.tasks.time_trial import AHEAD, MAX_BODY_RATES, MISSED, START_PHASE, STEP, Reference

TRACK = Track(
    gates_pos=[(4.0, 1.0, 2.0), (8.0, -1.0, 1.5)], gates_rpy=[(0, 0, 0)] * 2, openings=[0.3, 0.3], start=(0, 0, 1),
    finish=(11.0, 0.0, 1.5), obstacles_pos=(), low=(-5, -5, 0), high=(16, 5, 5),
)  # fmt: skip
N_GATES = 3
"""Two gates and the finish."""
WORLDS = {"on the plan": 0, "missed": 1, "away": 2, "stays": 3}


@pytest.fixture(scope="module")
def env():
    return make("time_trial", len(WORLDS), track=TRACK, engine="interpret")


@pytest.fixture(scope="module")
def flown(env):
    """States along the plan, judged without dynamics: beside the second gate, away from the plan, and at the start."""
    task, start = env.task, env.reset(jax.random.key(0))
    reference = task.read(start.data).reference
    times = np.arange(START_PHASE, reference.duration + 0.4, 1 / start.data.core.freq)
    pos, vel = (np.asarray(x) for x in reference.at(jnp.asarray(times[:, None], jnp.float32))[:2])
    pos, vel = (np.repeat(x[:, None, None], len(WORLDS), axis=1) for x in (pos, vel))
    beside = np.clip(np.minimum(times - reference.passes[0], 0.3), 0, None)[:, None]
    pos[:, WORLDS["missed"], :, 2] += 2.5 * beside
    pos[:, WORLDS["away"], :, 1] += (4.0 * np.clip(times - 0.3, 0, None))[:, None]
    pos[:, WORLDS["stays"]], vel[:, WORLDS["stays"]] = pos[0, WORLDS["stays"]], 0.0
    no = jnp.zeros((len(WORLDS), 1), bool)

    @jax.jit
    def fly(data, pos, vel):
        s = data.states.replace(pos=pos, vel=vel)
        n_before = task.read(data).passed
        data = data.replace(states=s, core=data.core.replace(steps=data.core.steps + 1))
        gates = jnp.asarray(task.course.gates_pos)
        near = jnp.linalg.norm(gates[jnp.minimum(n_before, N_GATES - 1)] - pos, axis=-1) < 0.3
        passed = n_before + (near & (n_before < N_GATES))
        data = task.write(data, passed=passed.astype(n_before.dtype), last_pos=pos)
        return task.judge(data, passed >= N_GATES, no)

    data, records = start.data, []
    for x, v in zip(pos.astype(np.float32), vel.astype(np.float32), strict=True):
        data = fly(data, x, v)
        records.append(jax.tree.map(np.asarray, task.read(data)))
    return task, reference, times, records, data


def world(records, name, field):
    return np.array([np.ravel(getattr(r, field)[WORLDS[name]])[0] for r in records])


def test_the_phase_of_a_flight_on_the_plan_is_its_time(flown):
    """Lines between rows of the table and the speeds near the ends, where the phase lags, leave hundredths."""
    _, reference, times, records, _ = flown
    phase = world(records, "on the plan", "phase")
    inner = (times > 0.3) & (times < reference.duration - 0.3)
    assert np.abs(phase - times)[inner].max() < 2 * STEP
    assert not world(records, "on the plan", "failure").any()


def test_a_flight_succeeds_at_the_finish_and_its_error_is_the_time_behind_the_plan(flown):
    task, reference, times, records, data = flown
    success = world(records, "on the plan", "success")
    arrived = times[np.argmax(success)]
    assert success[-1]
    # The ball of the finish is larger than that of the plan, by 0.1 m of some metres per second.
    assert reference.passes[-1] - 0.1 < arrived <= reference.passes[-1] + STEP
    flight = len(times) / data.core.freq  # all steps count
    np.testing.assert_allclose(task.error(data)[WORLDS["on the plan"]], flight - reference.passes[-1], atol=1e-4)
    assert bool(task.succeeded(data)[WORLDS["on the plan"], 0]) == (flight < 1.03 * reference.passes[-1])


def test_flights_that_miss_a_gate_or_leave_the_plan_fail(flown):
    _, reference, times, records, _ = flown
    missed = times[np.argmax(world(records, "missed", "failure"))]
    np.testing.assert_allclose(missed, reference.passes[1] + MISSED, atol=0.1)
    away = times[np.argmax(world(records, "away", "failure"))]
    assert 0.3 + 1.0 / 4.0 <= away < reference.passes[0] + MISSED, "1 m from the plan at 4 m/s sideways"
    assert world(records, "stays", "phase")[-1] < 0.3
    assert not world(records, "stays", "failure").any()


def test_points_of_the_plan_ahead_are_observed_in_the_body_frame(env, flown):
    task, reference, _, _, _ = flown
    state = env.step(env.reset(jax.random.key(3)), jnp.zeros((len(WORLDS), 1, 4)))
    obs, data, record = state.obs, state.data, task.read(state.data)
    assert obs["plan_pos"].shape == (len(WORLDS), 1, 3 * len(AHEAD))
    times = jnp.minimum(record.phase[..., None] + jnp.asarray(AHEAD)[:, None], reference.duration)
    points = obs["plan_pos"].reshape(len(WORLDS), 1, -1, 3)
    in_world = rotation.rotate(data.states.quat[..., None, :], points) + data.states.pos[..., None, :]
    np.testing.assert_allclose(in_world, reference.at(times)[0], atol=1e-4)


def test_practice_begins_on_the_plan_with_its_gates_passed():
    env = make("time_trial", 64, track=TRACK, practice=True, engine="interpret")
    data = env.reset(jax.random.key(1)).data
    record = jax.tree.map(np.asarray, env.task.read(data))
    phase, reference = record.phase[:, 0, 0], env.task.read(data).reference
    np.testing.assert_array_equal(record.passed[:, 0], (phase[:, None] > reference.passes).sum(axis=1))
    assert np.ptp(phase) > 0.5 * reference.duration
    deviation = np.asarray(data.states.pos)[:, 0] - np.asarray(reference.at(jnp.asarray(phase[:, None]))[0])
    drawn = phase > np.float32(START_PHASE)
    assert 0.05 < np.abs(deviation[drawn]).max() <= 0.2 + 1e-4


def test_a_plan_with_a_margin_passes_inside_the_openings():
    reference = Reference.of(
        TRACK, make("time_trial", 1, track=TRACK, engine="interpret").sim.airframes[0], 0.1, 0.4, 1
    )
    pos = reference.rows[:, :3]
    for gate in TRACK.gates_pos:
        # Rows are 20 ms apart: between two of them the plan moves up to 0.3 m past the point nearest to the gate.
        k = np.argmin(np.linalg.norm(pos - gate, axis=-1))
        a, b = pos[max(k - 1, 0)], pos[k + 1]
        share = np.clip((np.asarray(gate) - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        assert np.linalg.norm(a + share * (b - a) - gate) < 0.2 + 0.01


def test_a_plan_keeps_the_drone_above_the_floor():
    # Along a straight line to a waypoint that is as low as the start, drones sink when they lean.
    low = Track(gates_pos=[(6.0, 0.0, 0.5)], gates_rpy=[(0, 0, 0)], start=(0.0, 0.0, 0.5), openings=[0.3], frames=[0.3])
    env = make("time_trial", 1, track=low, engine="interpret")
    radius = body_shape(env.sim.airframes[0])["collision_sphere"][3]
    heights = env.task.read(env.reset(jax.random.key(0)).data).reference.rows[:, 2]
    assert heights.min() > radius + env.task.margin - 1e-3
    lower = dataclasses.replace(low, gates_pos=[(6.0, 0.0, 0.2)])
    env = make("time_trial", 1, track=lower, engine="interpret")
    assert env.task.read(env.reset(jax.random.key(0)).data).reference.rows[:, 2].min() > 0.2 - 1e-3


def test_a_track_may_end_where_it_starts():
    closed = dataclasses.replace(TRACK, finish=TRACK.start)
    assert make("time_trial", 1, track=closed, engine="interpret").task.course.n_gates == N_GATES


def test_law_09_a_margin_that_leaves_no_opening_is_an_error():
    with pytest.raises(ConfigError, match=r"a margin below 0\.3 m"):
        make("time_trial", 1, track=TRACK, margin=0.31, engine="interpret")


@pytest.mark.parametrize("drones", [["uzh_cpc"], ["uzh_cpc", "uzh_5inch"]])
def test_commands_of_body_rates_reach_beyond_those_of_the_plan(drones):
    env = make("time_trial", 1, len(drones), drone=drones, track=TRACK, control="body_rate", engine="interpret")
    command = env.actions.command(jnp.ones((1, len(drones), 4)))
    np.testing.assert_array_less(np.broadcast_to(MAX_BODY_RATES, (1, len(drones), 3)), command[..., :3])
