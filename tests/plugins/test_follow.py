"""Following trajectories in the step: setpoints at ticks, starts, rates, uploads, resets, overlays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import build_stagewise_step, with_states

from crazysim import ConfigError, Sim
from crazysim.plugins.follow import Follow
from crazysim.trajectories import Trajectory, figure_eight, hover, line

N_WORLDS, N_DRONES = 3, 2
EIGHT, UP = figure_eight(period=4.0), line([0, 0, 1], [0, 1, 2], duration=1.0)
START = np.array([[0.0, 0.1], [0.25, 0.0], [0.5, 1.0]])
RATE = np.array([[1.0, 2.0], [0.5, 1.0], [1.5, 1.0]])
"""Start times, s, and rates of the drones, which fly EIGHT and UP. (n_worlds, n_drones)"""
evaluate = jax.jit(Trajectory.evaluate)


def build(n_worlds=N_WORLDS, n_drones=N_DRONES, **settings):
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="state", **settings)
    sim.data = with_states(sim.data, pos=0.3 * np.asarray(sim.data.states.pos) + [0, 0, 1.0], rotor_vel=14000.0)
    sim.build_default_data()
    return sim


@pytest.fixture(scope="module")
def flight():
    """Return a simulation after 0.3 s, its plugin, and the setpoint of each step."""
    sim = build()
    plugin = sim.add(Follow([EIGHT, UP], start=START, rate=RATE))
    commands = []
    for _ in range(150):
        sim.step()
        commands.append(np.asarray(sim.data.controls.state.staged_cmd))
    return sim, plugin, np.stack(commands)


def expected_setpoint(world, drone, t):
    """Return the setpoint of a drone at a time of its world, from the trajectory without the plugin."""
    rate = RATE[world, drone]
    s = jax.tree.map(np.asarray, evaluate([EIGHT, UP][drone], (t - START[world, drone]) * rate))
    scaled = {"vel": 1, "acc": 2, "jerk": 3, "snap": 4, "yaw_rate": 1, "yaw_acc": 2}
    return s.replace(**{name: rate**k * getattr(s, name) for name, k in scaled.items()})


def test_setpoints_are_those_of_the_trajectory_at_each_tick(flight):
    """The state controller runs in every fifth step of 2 ms; in between the setpoint stays."""
    sim, _, commands = flight
    assert sim.data.core.freq == 5 * sim.data.controls.state.freq
    for step in (0, 4, 5, 7, 12, 149):
        t = step // 5 * 5 / sim.data.core.freq
        for world in range(N_WORLDS):
            for drone in range(N_DRONES):
                np.testing.assert_allclose(
                    commands[step, world, drone], expected_setpoint(world, drone, t).command(), rtol=1e-5, atol=2e-5
                )


def test_a_drone_waits_for_its_start_and_stays_at_the_end(flight):
    _, _, commands = flight
    np.testing.assert_array_equal(commands[:, 2, 0, 3:9], np.zeros((150, 6)))
    np.testing.assert_allclose(commands[:, 2, 0, :3], np.broadcast_to([0, 0, 1], (150, 3)), atol=1e-6)
    sim = build()
    sim.add(Follow(UP, rate=4.0))
    sim.step(200)
    np.testing.assert_allclose(
        np.asarray(sim.data.controls.state.cmd)[0, 0, :9], [0, 1, 2, 0, 0, 0, 0, 0, 0], atol=1e-6
    )


def test_one_start_per_drone_spaces_them_along_a_curve():
    """With a negative start the drone is that many seconds along the curve at the reset, times its rate."""
    start, rate = np.array([-1.5, 0.4]), np.array([2.0, 1.0])
    sim = build()
    follow = sim.add(Follow(EIGHT, start=start, rate=rate))
    sim.step(1)
    for drone, t in enumerate((3.0, 0.0)):
        s = evaluate(EIGHT, t)
        setpoint = np.asarray(sim.data.controls.state.staged_cmd)[:, drone]
        np.testing.assert_allclose(setpoint[:, :3], np.tile(s.pos, (N_WORLDS, 1)), atol=1e-5)
    follow.assign(sim, start=-start)
    np.testing.assert_array_equal(
        np.asarray(follow.read(sim.data).start)[..., 0], np.tile(-start, (N_WORLDS, 1)).astype(np.float32)
    )
    with pytest.raises(ConfigError, match="start for each of 2 drones, got 3 numbers"):
        follow.assign(sim, start=np.zeros(N_WORLDS))


def test_uploads_are_flown_and_nothing_is_compiled_again():
    sim = build()
    plugin = sim.add(Follow([EIGHT, UP], n_slots=4, max_pieces=20))
    sim.step(5)
    plan, size = sim.step_fn.plan(sim.data), _n_compiled(sim)
    other = line([0.2, 0, 1], [0.2, 2, 1.5], duration=3.0).then(hover([0.2, 2, 1.5]))
    for slot in (1, 2, 3):
        plugin.upload(sim, slot, other)
        plugin.assign(sim, index=np.array([[0, slot]] * N_WORLDS))
        sim.step(5)
    assert sim.step_fn.plan(sim.data) is plan
    assert _n_compiled(sim) == size
    s = evaluate(other, 15 / 500)
    cmd, eight = np.asarray(sim.data.controls.state.cmd), jax.tree.map(np.asarray, evaluate(EIGHT, 15 / 500))
    np.testing.assert_allclose(cmd[:, 1, :3], np.tile(s.pos, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(cmd[:, 0], np.tile(eight.command(), (3, 1)), rtol=1e-5, atol=2e-5)


def test_coefficients_that_are_zero_in_all_trajectories_are_not_looked_up():
    level = Trajectory(EIGHT.ends, EIGHT.coefficients * (np.arange(4) < 2)[:, None] * np.ones(8), EIGHT.repeats)
    lookups = {}
    for name, trajectory, settings in (("level", level, {}), ("slots", level, {"n_slots": 1}), ("turned", UP, {})):
        sim = build(engine="interpret")
        plugin = sim.add(Follow(trajectory, **settings))
        lookups[name] = _n_lookups(sim)
        sim.step(20)
        expected = jax.tree.map(np.asarray, evaluate(trajectory, 15 / 500)).command()
        np.testing.assert_allclose(np.asarray(sim.data.controls.state.cmd)[0, 0], expected, rtol=1e-5, atol=2e-5)
        if name == "level":
            assert plugin.read(sim.data).degrees == (7, 7, -1, -1)
            with pytest.raises(ConfigError, match="degrees of x, y, z and yaw"):
                plugin.upload(sim, 0, hover([0, 0, 1]))
    assert lookups["level"] <= lookups["slots"] - 16


def _n_lookups(sim):
    blocks = [s.block for s in sim.step_fn.plan(sim.data).program.segments]
    return sum(op.name == "lookup" for block in blocks for op in block.walk())


def _n_compiled(sim):
    return sim.step_fn.plan(sim.data).traced_count_step._cache_size()


def test_resets_restore_slots_starts_and_indices():
    sim = build()
    plugin = sim.add(Follow([EIGHT, UP], start=START))
    before = sim.data.plugins["follow"]
    assert before.trajectories is None
    plugin.upload(sim, 0, hover())
    record = sim.data.plugins["follow"]
    later, first = np.asarray(record.start) + 1, np.zeros_like(record.index)
    sim.data = plugin.write(sim.data, record.replace(start=jnp.asarray(later), index=jnp.asarray(first)))
    sim.reset(np.array([True, False, False]))
    masked = sim.data.plugins["follow"]
    np.testing.assert_allclose(np.asarray(masked.start)[..., 0], START + [[0], [1], [1]])
    np.testing.assert_array_equal(np.asarray(masked.index)[..., 0], [[0, 1], [0, 0], [0, 0]])
    sim.reset()
    after = sim.data.plugins["follow"]
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(a, b)


def test_trajectories_have_gradients_through_the_step():
    sim = build(n_worlds=1, n_drones=1, controller="pid")  # whose derivative compiles sooner than the default's
    plugin = sim.add(Follow(UP))
    step = build_stagewise_step(sim)

    @jax.jit
    @jax.value_and_grad
    def end(scale):
        record = sim.data.plugins["follow"]
        data = plugin.write(sim.data, record.replace(coefficients=scale * record.coefficients))
        return step(data, 100).states.pos[0, 0, 2]

    slope, h = end(1.0)[1], 2e-3
    np.testing.assert_allclose(slope, (end(1 + h)[0] - end(1 - h)[0]) / (2 * h), rtol=2e-2)
    assert slope > 1e-3


def test_the_path_ahead_and_the_setpoints_are_drawn(flight):
    sim, _, _ = flight
    overlays = sim.scene.renderer.overlays
    overlays.clear()
    sim.plugins.draw(0)
    assert len(overlays) == 2 + 40 + 40
    overlays.clear()
