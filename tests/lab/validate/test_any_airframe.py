"""Policies for any airframe: what they observe, when their memory advances, and what counts as held."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.envs import make
from crazysim.envs.statistics import RunningStats
from crazysim.lab.export.rl_tools import N_MEMORY, SHAPES, evaluate_step, to_rl_tools
from crazysim.lab.validate import any_airframe, rotor_simulators
from crazysim.lab.validate.any_airframe import Network, RecurrentPolicy, fly, load_network
from crazysim.train import checkpoint
from crazysim.train.config import TrainConfig
from crazysim.train.export import describe
from crazysim.train.networks import Policy
from crazysim.train.training import POLICY_FILE


def counting_network(observations):
    def step(observation, memory):
        observations.append(observation[0])
        return np.full((1, 4), (len(observations) - 6) / 10), memory + 1

    return Network(step, lambda n: 0)


def test_the_memory_advances_at_the_rate_of_the_training_and_mean_actions_are_observed():
    observations = []
    policy = RecurrentPolicy(counting_network(observations), 2, np.full((1, 4), 0.7))
    memories = []
    for _ in range(11):
        policy.action(np.tile(np.array([0.7, -0.7, 0, *range(9), 2, -2, 0, 5, 6, 7.0]), (1, 1)))
        memories.append(policy._memory)
    assert memories == [1] * 5 + [2] * 5 + [3]  # by calls 0, 5 and 10
    # the action before the first call; then means of the actions since the last advance; float32
    means = [0.7, -0.5, -0.45, -0.4, -0.35, 0, 0, 0.05, 0.1, 0.15, 0.2]
    np.testing.assert_allclose([x[18] for x in observations], [*means[:5], -0.3, *means[6:]], atol=1e-7)
    np.testing.assert_allclose(observations[0][:18], [0.5, -0.5, 0, *range(9), 1, -1, 0, 5, 6, 7])


def test_actions_are_limited():
    policy = RecurrentPolicy(
        Network(lambda x, memory: (np.array([[-3, -0.5, 0.5, 3]]), memory), lambda n: 0), 10, np.zeros((1, 4))
    )
    np.testing.assert_array_equal(policy.action(np.zeros((1, 18))), [[-1, -0.5, 0.5, 1]])


def test_a_checkpoint_computes_as_in_numpy(tmp_path):
    rng = np.random.default_rng(0)
    weights = {name: rng.normal(scale=0.4, size=shape).astype(np.float32) for name, shape in SHAPES.items()}
    network = load_network(to_rl_tools(weights, tmp_path / "policy.tar"))
    observation, memory = rng.normal(size=(3, 22)).astype(np.float32), network.initial_memory(3)
    assert memory.shape == (3, N_MEMORY)
    for x, expected in zip(network.step(observation, memory), evaluate_step(weights, observation, memory), strict=True):
        np.testing.assert_allclose(x, expected, atol=1e-5)  # sums of 22 products in float32


def test_a_run_of_the_task_gets_its_observations_by_name(tmp_path):
    weight = np.random.default_rng(0).normal(scale=0.2, size=(22, 4)).astype(np.float32)
    config = TrainConfig.create("any", config={"hidden": [], "memory": 0, "shape": "default"})
    policy = Policy(RunningStats.create(22), [(jnp.asarray(weight), jnp.zeros(4))])
    meta = describe(make("any", engine="interpret")) | {"settings": dataclasses.asdict(config)}
    checkpoint.save(tmp_path / POLICY_FILE, policy, meta)
    network, x = load_network(tmp_path), np.random.default_rng(1).normal(size=(3, 22)).astype(np.float32)
    pos, attitude, vel, ang_vel, last_action = np.split(x, [3, 12, 15, 18], axis=-1)
    inputs = np.concatenate([ang_vel, attitude, last_action, pos, vel], axis=-1)  # in the order of their names
    action, _ = network.step(x, network.initial_memory(3))
    np.testing.assert_allclose(action, np.tanh(inputs @ weight), atol=1e-5)


@pytest.mark.slow  # needs foundation-policy
def test_raptor_computes_as_its_package():
    package, network = pytest.importorskip("foundation_policy").Raptor(), load_network(None)
    package.reset()
    memory = network.initial_memory(8)
    for observation in np.random.default_rng(0).normal(size=(50, 8, 22)):
        action, memory = network.step(observation.astype(np.float32), memory)
        np.testing.assert_allclose(action, package.evaluate_step(observation), atol=1e-5)


class Floating:
    """Drones that stay where they are put, and note their commands."""

    def __init__(self, pos):
        self.state = np.zeros((len(pos), 18))
        self.state[:, :3] = pos
        self.hover_action, self.commands = np.zeros((len(pos), 4)), []

    def observe(self):
        return self.state.copy()

    def step(self, action):
        self.commands.append(action[:, 0])


def test_commands_are_late_and_only_drones_near_their_goal_are_held():
    drones = Floating([[0, 0, 10], [0, 0.4, 10], [0, 0, 10], [np.nan, 0, 10]])
    calls = iter(range(2000))
    network = Network(lambda x, memory: (np.full((4, 4), (next(calls) + 1) / 1000), memory), lambda n: 0)
    flight = fly(network, drones, any_airframe.MANOEUVRES["hold"].goal, np.array([0, 3, 10, 0]), 10)
    assert flight.held.tolist() == [True, False, True, False]
    np.testing.assert_allclose(flight.error[:3], [0, 0.4, 0], atol=1e-12)
    below_floor = np.array([0, 0, -0.1]), np.zeros(3)
    assert not fly(network, Floating([below_floor[0]] * 4), lambda _: below_floor, np.zeros(4, int), 10).held.any()
    commands = 1000 * np.array(drones.commands)
    assert len(commands) == 10_000
    np.testing.assert_allclose(commands[:14, 0], [1] * 10 + [2] * 4)
    np.testing.assert_allclose(commands[:14, 1], [0] * 3 + [1] * 10 + [2])
    np.testing.assert_allclose(commands[:14, 2], [0] * 10 + [1] * 4)


@pytest.mark.filterwarnings("ignore:Attaching a spec")  # Crazyflow's
@pytest.mark.parametrize(
    "simulator",
    [
        pytest.param(name, marks=[pytest.mark.slow] if drones.module else [])  # needs the package of the simulator
        for name, drones in rotor_simulators.SIMULATORS.items()
    ],
)
def test_simulators_start_and_hover_and_turn_alike(simulator):
    drones_class = rotor_simulators.SIMULATORS[simulator]
    if drones_class.module:
        pytest.importorskip(drones_class.module)
    is_crazyflow = simulator == "Crazyflow"
    fleet = np.array(["cf2x_L250", "cf21B_500"] * 2) if is_crazyflow else rotor_simulators.Quadrotors.sample(4)
    start = any_airframe.MANOEUVRES["recover"].start(4) | {"quat": np.tile([0, 0, 0, 1.0], (4, 1))}
    drones = drones_class(fleet, start)
    state = drones.observe()
    np.testing.assert_allclose(state[:, :3], start["pos"], atol=1e-6)
    np.testing.assert_allclose(state[:, 3:12], np.tile(np.eye(3).ravel(), (4, 1)), atol=1e-6)
    np.testing.assert_allclose(state[:, 12:15], start["vel"], atol=1e-6)
    # more speed of the left rotors turns right, of the rear ones forward, and of those of positive torque left
    turn = np.zeros((4, 4))
    turn[0, [2, 3]] = turn[1, [1, 2]] = turn[2, [1, 3]] = 0.1
    for _ in range(50):
        drones.step(drones.hover_action + turn)
    change = drones.observe() - state
    assert all(change[k, 15 + k] > 0.02 for k in range(3))
    assert all(np.argmax(np.abs(change[k, 15:])) == k for k in range(3))
    np.testing.assert_allclose(change[3, 15:], 0, atol=1e-5)
    np.testing.assert_allclose(change[3, 12:15], 0, atol=0.2)  # drag alone, at up to 3 m/s
