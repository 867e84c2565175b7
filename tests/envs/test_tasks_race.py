"""The race: its rules, its levels of difficulty, observations of the course, and its courses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazysim import ConfigError, Sim
from crazysim.engine.stage import vmap_worlds
from crazysim.envs import DroneEnv, make
from crazysim.envs.tasks import race as task
from crazysim.envs.tasks import race_rules as rules
from crazysim.envs.tracks import Track, ranks
from crazysim.train.evaluation import evaluate

TRACK = Track()
CASES = {
    # Gate, position in its frame, m, speed along its axis, m/s, and gates passed before. The frame is the world's if
    # the gate is None.
    "forwards": (0, (-0.01, 0.1, -0.1), 2.0, 0),
    "backwards": (0, (0.01, 0.0, 0.0), -2.0, 0),
    "beside": (0, (-0.01, 0.45, 0.0), 2.0, 0),
    "above": (0, (-0.01, 0.0, 0.6), 2.0, 0),
    "another": (1, (-0.01, 0.0, 0.0), 2.0, 0),
    "last": (3, (-0.01, 0.0, 0.0), 2.0, 3),
    "not there yet": (0, (-0.2, 0.0, 0.0), 2.0, 0),
    "frame": (0, (-0.01, 0.22, 0.0), 2.0, 0),
    "post": (0, (-0.01, 0.0, -0.45), 2.0, 0),
    "obstacle": (None, (0.05, 0.75, 1.0), 0.0, 0),
    "floor": (None, (-2.0, 0.0, 0.06), 0.0, 0),
    "outside": (None, (2.51, 0.0, 1.0), 0.0, 0),
    "over the top": (None, (0.0, 0.0, 2.01), 0.0, 0),
}
"""Cases, each in its own world."""


def make_env(n_worlds, n_drones=1, engine="interpret", **options):
    """Return an environment, interpreted by default, as compiling would take longer than a few steps."""
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="attitude", engine=engine)
    race = task.Race(**options)
    race.install(sim)
    return DroneEnv(sim, race)


def place_drones(state, pos, vel=0.0, **changes):
    """Return the state with drones at other positions, and other fields of the race's record."""
    data = state.data
    pos, vel, quat = (jnp.asarray(np.broadcast_to(np.float32(x), (*data.states.pos.shape[:2], n)))
                      for x, n in ((pos, 3), (vel, 3), ([0, 0, 0, 1], 4)))  # fmt: skip
    record = data.plugins["task"].replace(last_pos=pos, **changes)
    states = data.states.replace(pos=pos, vel=vel, quat=quat)
    return state.replace(data=data.replace(states=states, plugins=data.plugins | {"task": record}))


@pytest.fixture(scope="module")
def cases():
    """Return an environment of all cases, the world of each case, the states before and after a step, and the step."""
    env = make_env(len(CASES))
    pos, vel = np.zeros((len(CASES), 1, 3)), np.zeros((len(CASES), 1, 3))
    passed = np.zeros((len(CASES), 1), np.int32)
    gate_rotations = Rotation.from_euler("xyz", TRACK.gates_rpy)
    for world, (gate, offset, speed, before) in enumerate(CASES.values()):
        passed[world] = before
        pos[world] = offset
        if gate is not None:
            pos[world] = np.asarray(TRACK.gates_pos[gate]) + gate_rotations[gate].apply(offset)
            vel[world] = speed * gate_rotations[gate].apply([1.0, 0.0, 0.0])
    before = place_drones(jax.jit(env.reset)(jax.random.key(0)), pos, vel, passed=jnp.asarray(passed))
    step = jax.jit(env.step)
    return env, {name: k for k, name in enumerate(CASES)}, before, step(before, before.action), step


def test_only_crossing_the_next_gate_forwards_within_its_opening_passes_it(cases):
    _, world, before, after, _ = cases
    new = np.asarray(after.data.plugins["task"].passed) - before.data.plugins["task"].passed
    assert {name for name, k in world.items() if new[k, 0]} == {"forwards", "last"}
    target = np.asarray(after.obs["target_gate"])[:, 0, 0]
    assert target[world["forwards"]] == 1
    assert target[world["last"]] == -1


def test_contacts_and_the_edge_of_the_arena_disable_and_end(cases):
    _, world, _, after, _ = cases
    disabled = np.asarray(after.info["disabled"])[:, 0]
    hit = {"frame", "post", "obstacle", "floor", "outside", "over the top"}
    assert {name for name, k in world.items() if disabled[k]} == hit
    ended = np.asarray(after.terminated)
    assert {name for name, k in world.items() if ended[k]} == hit | {"last"}
    assert not np.any(after.truncated)


def test_the_last_gate_ends_the_race_as_a_success(cases):
    env, world, _, after, _ = cases
    succeeded, info = np.asarray(env.succeeded(after)), jax.tree.map(np.asarray, after.info)
    assert {name for name, k in world.items() if succeeded[k, 0]} == {"last"}
    assert info["error"][world["last"], 0] == 0
    assert info["gates_passed"][world["last"], 0] == 4


def test_rewards_contain_progress_and_each_gate_and_crash_once(cases):
    _, world, _, after, step = cases
    reward = np.asarray(after.reward)[:, 0]
    moved = 2.0 * 0.02  # m in one step, to the gate at twice a metre
    np.testing.assert_allclose(reward[world["not there yet"]], 2 * moved, atol=0.01)
    assert reward[world["forwards"]] > 1.9
    assert reward[world["obstacle"]] < -1.9
    terms = jax.jit(vmap_worlds(lambda data: rules.sparse(data, None, None)))(after.data)
    sparse = np.asarray(terms["gates"])[:, 0] + np.asarray(terms["disabled"])[:, 0]
    assert sparse[world["forwards"]] == 1
    assert sparse[world["obstacle"]] == -1
    assert sparse[world["not there yet"]] == sparse[world["backwards"]] == 0
    again = step(after, after.action)
    reward = np.asarray(again.reward)[:, 0]
    assert reward[world["obstacle"]] == 0
    assert reward[world["last"]] == 0
    assert np.asarray(again.terminated)[world["obstacle"]]


def test_observations_in_the_drones_frame_are_those_of_the_course(cases):
    _, world, before, after, _ = cases
    k = world["forwards"]
    pos, quat = np.asarray(after.data.states.pos)[k, 0], np.asarray(after.data.states.quat)[k, 0]
    corners = np.asarray(after.obs["gate_corners"])[k, 0].reshape(2, 4, 3)
    # The next gates of this drone are gates 1 and 2.
    for corner, gate in zip(corners, (1, 2), strict=True):
        middle = pos + Rotation.from_quat(quat).apply(corner.mean(axis=0))
        np.testing.assert_allclose(middle, TRACK.gates_pos[gate], atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(corner - corner.mean(axis=0), axis=-1), 0.225 * np.sqrt(2), atol=1e-5)
    drone_pos = np.asarray(before.data.states.pos)[world["obstacle"], 0]
    poles = np.asarray(after.obs["obstacles_near"])[world["obstacle"], 0].reshape(2, 3)
    np.testing.assert_allclose(poles[0], [-0.05, 0, 0], atol=2e-3)
    assert np.linalg.norm(poles[1]) > 0.5, drone_pos


def test_drones_out_of_the_race_do_not_matter_to_others():
    env = make_env(4, n_drones=2)
    offset = np.broadcast_to([[-1.5, 0.6, 1.0], [-1.5, 0.65, 1.0]], (4, 2, 3)).copy()
    offset[3, 1] += [0.5, 0, 0]
    passed = jnp.array([[0, 0], [0, 0], [4, 0], [4, 0]])
    disabled = jnp.array([[False, False], [True, False], [False, False], [False, True]])
    step = jax.jit(env.step)
    state = place_drones(
        jax.jit(env.reset)(jax.random.key(0)), offset, passed=passed, success=passed == 4, failure=disabled
    )
    after = step(state, state.action)
    #           both collide     one is out already      one has finished      one finished, one out
    expected = [[True, True], [True, False], [False, False], [False, True]]
    np.testing.assert_array_equal(after.info["disabled"], expected)
    np.testing.assert_array_equal(after.terminated, [True, False, False, True])
    assert np.all(np.asarray(after.reward)[1:, 0] == 0)
    observed_drones = np.asarray(after.obs["drones_near"])[2]
    assert np.linalg.norm(observed_drones[0]) > 0.04  # the drone that has finished observes the other one
    np.testing.assert_array_equal(observed_drones[1], 0)  # which does not observe it


@pytest.fixture(scope="module")
def data_of_levels():
    """Return an environment of each level, and data at the start of episodes in many worlds."""
    data_of_levels = {}
    for level, n_worlds, n_drones in ((0, 64, 1), (1, 64, 2), (2, 2048, 1), (3, 2048, 2)):
        env = make_env(n_worlds, n_drones, level=level)
        data_of_levels[level] = env, jax.jit(lambda key, env=env: env.reset(key).data)(jax.random.key(5))
    return data_of_levels


def test_levels_draw_starts_parameters_poses_and_courses(data_of_levels):
    varies = {}  # by level: starts, masses, poses of objects, and nominal poses
    for level, (_, data) in data_of_levels.items():
        shared = data.params.mass.ndim == 1
        pos, objects, nominal = data.states.pos, data.objects.pos, data.plugins["task"].nominal_pos
        varies[level] = (
            bool(np.ptp(np.asarray(pos)[:, 0], axis=0).min() > 0.05),
            not shared and bool(np.ptp(data.params.mass) > 0.005),
            bool(np.ptp(np.asarray(objects)[:, 0], axis=0).max() > 0.05),
            nominal is not None and bool(np.ptp(np.asarray(nominal)[:, 0], axis=0).max() > 0.05),
        )
    assert varies == {
        0: (True, False, False, False),
        1: (True, True, False, False),
        2: (True, True, True, False),
        3: (True, True, True, True),
    }


def test_drawn_inertias_have_their_inverses_and_masses_their_range(data_of_levels):
    env, data = data_of_levels[1]
    product = np.einsum("...ij,...jk->...ik", data.params.J, data.params.J_inv)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-5)
    mass = np.asarray(data.params.mass) / 0.0434
    assert 1 - task.MASS_DEVIATION <= mass.min() < 0.95
    assert 1.05 < mass.max() <= 1 + task.MASS_DEVIATION
    assert not np.allclose(mass[:, 0], mass[:, 1])
    np.testing.assert_allclose(env.actions.centre[3], 0.0434 * 9.81, rtol=1e-3)  # hover is the nominal drone's


def test_level_two_moves_gates_by_up_to_the_jitter(data_of_levels):
    _, data = data_of_levels[2]
    moved = np.asarray(data.objects.pos)[:, 0, :4] - np.asarray(TRACK.gates_pos)
    assert np.all(np.abs(moved) <= np.array(task.GATE_JITTER[:3]) + 1e-6)
    assert np.all(np.abs(moved).max(axis=(0, 1)) > 0.9 * np.array(task.GATE_JITTER[:3]))
    np.testing.assert_allclose(np.linalg.norm(data.objects.quat, axis=-1), 1, atol=1e-5)


@pytest.mark.parametrize("level", [2, 3])
def test_starts_are_clear_of_contact(data_of_levels, level):
    env, data = data_of_levels[level]
    env.sim.data = data
    report = env.sim.contact_report()
    assert not np.any(report.any)
    assert report.object_distance.min() > 0.1
    assert level != 3 or report.drone_distance.min() > 0.01


def test_random_courses_have_gaps_between_gates_and_poles(data_of_levels):
    _, data = data_of_levels[3]
    pos = np.asarray(data.objects.pos)[:, 0, :, :2]
    gates, poles = pos[:, :4], pos[:, 4:]
    distances = np.linalg.norm(gates[:, :, None] - gates[:, None], axis=-1) + 9 * np.eye(4)
    assert distances.min() > 0.55
    assert np.linalg.norm(gates[:, :, None] - poles[:, None], axis=-1).min() > 0.3
    assert np.all(np.abs(pos) < np.array(TRACK.high[:2]) - 0.05)
    used = np.unique(np.round(np.asarray(data.plugins["task"].nominal_pos)[:, 0, :4, 0] / 1.0 - 0.5), axis=0)
    assert len(used) > 100


def test_poses_are_nominal_until_the_drone_was_near(data_of_levels):
    env, data = data_of_levels[2]
    gate = np.asarray(data.objects.pos)[:, :, 0]
    observe = jax.jit(vmap_worlds(env.task.observe))
    nominal, far = np.asarray(TRACK.gates_pos[0]), np.array([-2.0, 1.0, 1.0])

    def move_drones(data, pos):
        return data.replace(states=data.states.replace(pos=jnp.asarray(np.broadcast_to(np.float32(pos), gate.shape))))

    def observe_gate(data):
        obs = observe(data)
        return np.asarray(obs["gates_pos"])[..., :3], np.asarray(obs["gates_visited"])[..., 0]

    observed, visited = observe_gate(move_drones(data, far))
    np.testing.assert_allclose(observed, np.broadcast_to(nominal, observed.shape), atol=1e-6)
    assert not visited.any()
    # A drone high above a gate is near it, too: distances are horizontal.
    near = move_drones(data, gate + [0.6, 0.3, 0.5])
    observed, visited = observe_gate(near)
    np.testing.assert_allclose(observed, gate, atol=1e-6)
    assert visited.all()
    observed, _ = observe_gate(move_drones(data, gate + [0.6, 0.4, 0.0]))
    np.testing.assert_allclose(observed, np.broadcast_to(nominal, observed.shape), atol=1e-6)
    observed, visited = observe_gate(move_drones(jax.jit(vmap_worlds(env.task.before_step))(near), far))
    np.testing.assert_allclose(observed, gate, atol=1e-6)
    assert visited.all()


def test_the_way_leads_around_a_gate_from_behind_and_back_from_beside_it():
    beside = np.array([[1e-7, 0.45, 0.0], [-1e-7, 0.45, 0.0]])
    places = [[-1.0, 0.0, 0.0], [-4.0, 3.0, 0.0], [-3.0, 4.0, 0.0], [0.5, 0.0, 0.0], [0.3, 0.9, 0.0], *beside]
    before_the_frame = np.array([-0.01, 0.38, 0.1])
    way_and_slope = jax.jit(lambda places, pos: (rules.way_to_gate(places), jax.grad(rules.way_to_gate)(pos)))
    ahead, slope = way_and_slope(jnp.asarray(places), jnp.asarray(before_the_frame))
    around = 2 * 0.45 - 0.15  # from beside the frame, where both ways are the same
    expected = [1.0, 5.0, 5.0 + 0.85, np.hypot(0.5, 0.45) + around, np.hypot(0.3, 0.45) + around]
    np.testing.assert_allclose(ahead, [*expected, around, around], rtol=1e-6)
    assert slope[0] > 0.9, "beside the frame the way is shorter further back"


def test_practice_begins_episodes_behind_gates():
    env = make("race", 400, practice=True, engine="interpret")
    data = jax.jit(lambda key: env.reset(key).data)(jax.random.key(0))
    passed = np.asarray(rules.race_of(data).passed)[:, 0]
    assert np.bincount(passed, minlength=4).min() > 60, "each gate as often as the others"
    drone, gates = np.asarray(data.states.pos)[:, 0], jax.tree.map(np.asarray, rules.gates_of(data))
    for k in (1, 2, 3):
        is_behind_gate = passed == k
        pos, quat = (x[is_behind_gate, 0, k - 1] for x in gates)
        inside = Rotation.from_quat(quat).inv().apply(drone[is_behind_gate] - pos)
        assert np.all((inside[:, 0] > 0.14) & (inside[:, 0] < 0.31)), "behind it, and clear of it"
        np.testing.assert_allclose(inside[:, 1:], 0, atol=1e-5)
    env.sim.data = data
    assert not np.any(env.sim.contact_report().any)


def test_practice_places_drones_of_a_world_behind_different_gates():
    env = make("multi_race", 200, practice=True, n_drones=3, engine="interpret")
    data = jax.jit(lambda key: env.reset(key).data)(jax.random.key(0))
    passed = np.asarray(rules.race_of(data).passed)
    assert np.bincount(passed[:, 0], minlength=4).min() > 30, "each gate as often as the others"
    assert np.all((passed == 0).all(axis=1) | (np.sort(passed, axis=1) == [1, 2, 3]).all(axis=1))
    offsets = np.asarray(data.states.pos)[:, :, None] - np.asarray(data.states.pos)[:, None]
    assert np.linalg.norm(offsets + np.eye(3)[..., None], axis=-1).min() > 0.2
    env.sim.data = data
    assert not np.any(env.sim.contact_report().any)


def test_ranks_are_a_draw_without_replacement():
    x = jnp.array([[0.5, 0.5, 0.1, 0.9, 0.5], [0.9, 0.8, 0.7, 0.6, 0.5]])
    np.testing.assert_array_equal(ranks(x, 5), [[1, 2, 0, 4, 3], [4, 3, 2, 1, 0]])
    np.testing.assert_array_equal(ranks(x, 2), [[1, 2], [4, 3]])


def test_a_track_of_the_user_can_be_raced():
    """Two gates in a row, and drones that start with a velocity through both, or away from them."""
    track = Track(
        gates_pos=[(-1, 0, 1), (0.0, 0, 1)], gates_rpy=[(0, 0, 0)] * 2, obstacles_pos=[(1, 1, 1.5)], start=(-2, 0, 1)
    )
    env = make_env(3, engine="auto", track=track, seconds=1.2)

    class Thrown(task.Race):
        """Start in flight towards the gates; the third world away from them."""

        def spawn(self, data, key):
            data = super().spawn(data, key)
            vel = jnp.array([[3.0, 0.0, 0.0]]) * jnp.array([1.0, 1.0, -1.0])[data.core.world_id]
            pos = jnp.array([[-1.5, 0.0, 1.0]])
            record = data.plugins["task"].replace(last_pos=pos)
            states = data.states.replace(pos=pos, vel=vel, quat=jnp.array([[0.0, 0.0, 0.0, 1.0]]))
            return data.replace(states=states, plugins=data.plugins | {"task": record})

    env = DroneEnv(env.sim, Thrown(track=track, seconds=1.2))
    metrics = evaluate(env, jax.tree_util.Partial(lambda obs: jnp.zeros((3, 1, 4))))
    np.testing.assert_allclose(metrics["success"], 2 / 3, rtol=1e-6)
    np.testing.assert_allclose(metrics["crashed"], 1 / 3, rtol=1e-6)
    assert metrics["error"] == 0


# Tracks with other gates, and laps ------------------------------------------------------------------------------------

HALF = 0.225
SQUARES = tuple([((HALF, HALF), (HALF, -HALF), (-HALF, -HALF), (-HALF, HALF))] * 4)


def test_openings_of_the_default_size_follow_the_rules_of_the_default_track():
    """The same ways, corners and gates passed for squares that a track states, with drones at and off their gates."""
    rng, rots = np.random.default_rng(0), Rotation.from_euler("xyz", TRACK.gates_rpy)
    pos, vel = np.float32(rng.uniform([-2, -1, 0.3], [2, 1, 1.9], (32, 1, 3))), np.zeros((32, 1, 3), np.float32)
    for k in range(0, 32, 2):
        pos[k] = np.array(TRACK.gates_pos[k % 4]) + rots[k % 4].apply([-0.01, *rng.uniform(-0.1, 0.1, 2)])
        vel[k] = 2 * rots[k % 4].apply([1, 0, 0])
    results = []
    for track in (TRACK, Track(openings=SQUARES)):
        env = make_env(32, track=track)
        passed = jnp.asarray(np.arange(32)[:, None] % 4, jnp.int32)
        before = place_drones(jax.jit(env.reset)(jax.random.key(0)), pos, vel, passed=passed)
        ways = jax.jit(vmap_worlds(rules.remaining_way))(before.data)
        after = jax.jit(env.step)(before, before.action)
        results.append((np.asarray(ways), np.asarray(after.info["gates_passed"]) - passed, after.obs))
    np.testing.assert_allclose(results[0][0], results[1][0], rtol=1e-5)
    np.testing.assert_array_equal(results[0][1], results[1][1])
    np.testing.assert_array_equal(results[0][1][::2], 1)
    for name, value in results[0][2].items():
        np.testing.assert_allclose(value, results[1][2][name], atol=1e-5, err_msg=name)


def test_laps_lead_through_the_same_gates_again_and_balls_are_passed_in_any_direction():
    """A gate at the origin along x and a ball 2 m ahead of it, two laps, without obstacles."""
    track = Track(
        gates_pos=[(0, 0, 1), (2, 0, 1)], gates_rpy=[(0, 0, 0)] * 2, openings=[SQUARES[0], 0.3], obstacles_pos=(),
        start=(-2, 0, 1), low=(-9, -9, 0), high=(9, 9, 9),
    )  # fmt: skip
    env = make_env(4, track=track, laps=2)
    pos = np.float32([[[-0.01, 0, 1]], [[-0.01, 0, 1]], [[2, 0.31, 1]], [[2, -0.31, 1]]])
    vel = np.float32([[[2, 0, 0]], [[2, 0, 0]], [[0, -2, 0]], [[0, 2, 0]]])
    passed = jnp.array([[0], [2], [1], [3]])
    before = place_drones(jax.jit(env.reset)(jax.random.key(0)), pos, vel, passed=passed)
    after = jax.jit(env.step)(before, before.action)
    np.testing.assert_array_equal(after.info["gates_passed"], passed + 1)
    np.testing.assert_array_equal(np.asarray(after.obs["target_gate"])[:, 0, 0], [1, 1, 0, -1])
    np.testing.assert_array_equal(after.info["finished"][:, 0], [False, False, False, True])
    assert "obstacles_pos" not in after.obs
    # From the ball back to the gate, which the way leads around: 2 (0.45) - 0.15 m and the distance to a side.
    back = 0.75 + min(np.hypot(2, 0.45), np.hypot(2, 0.45))
    ways = np.asarray(jax.jit(vmap_worlds(rules.remaining_way))(before.data))[:, 0]
    np.testing.assert_allclose(ways, [0.01 + 2 + back + 2, 0.01 + 2, 0.31 + back + 2, 0.31], atol=1e-4)


def test_touched_and_missed_gates_cost_seconds_with_a_penalty(cases):
    _, world, before, _, _ = cases
    env = make_env(len(CASES), penalty=2.0)
    pos, vel = (getattr(before.data.states, name) for name in ("pos", "vel"))
    passed = before.data.plugins["task"].passed
    state = place_drones(jax.jit(env.reset)(jax.random.key(0)), pos, vel, passed=passed)
    step = jax.jit(env.step)
    after = step(state, state.action)
    again = step(after, after.action)
    for result in (after, again):  # a contact that lasts counts once
        penalty = np.asarray(result.info["penalty"])[:, 0]
        assert {name: penalty[k] for name, k in world.items() if penalty[k]} == {
            "frame": 2.0,
            "post": 2.0,
            "another": 2.0,
        }
    disabled = np.asarray(after.info["disabled"])[:, 0]
    assert {name for name, k in world.items() if disabled[k]} == {"obstacle", "floor", "outside", "over the top"}
    gained = np.asarray(after.data.plugins["task"].passed - passed)[:, 0]
    assert {name: gained[k] for name, k in world.items() if gained[k]} == {
        "forwards": 1,
        "last": 1,
        "frame": 1,
        "another": 2,
    }
    terms = jax.jit(vmap_worlds(lambda data: rules.dense(data, state.action[0], state.action[0])))
    for result, cost in ((after, -20.0), (again, 0.0)):
        np.testing.assert_allclose(terms(result.data)["penalty"][world["frame"]], cost)


def test_a_track_file_is_raced_and_tunnels_are_refused():
    race = task.Race(track="split_s_gates")
    assert race.course.n_gates == 19
    with pytest.raises(ConfigError, match="got tunnels"):
        make_env(1, track="split_s_shapes")
