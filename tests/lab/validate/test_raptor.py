"""RAPTOR's interface: what the policy observes, and when its recurrent state advances."""

import sys
import types

import numpy as np

from crazysim.lab.validate import raptor


class FakePolicy:
    def __init__(self):
        self.state, self.observed_actions = 0, []
        self.layers = [object(), self]

    def reset(self):
        self.state = 0

    def evaluate_step(self, observation):
        self.observed_actions.append(observation[0, 18])
        self.state += 1
        return np.full((1, 4), float(len(self.observed_actions)))


def test_raptor_advances_its_state_at_the_rate_of_its_training_and_observes_mean_actions(monkeypatch):
    network = FakePolicy()
    monkeypatch.setitem(sys.modules, "foundation_policy", types.SimpleNamespace(Raptor=lambda: network))
    raptor_policy = raptor.RaptorPolicy(2, np.full((1, 4), 7.0))
    states = []
    for _ in range(11):
        raptor_policy.action(np.zeros((1, 18)))
        states.append(network.state)
    assert states == [1] * 5 + [2] * 5 + [3]  # by calls 0, 5 and 10
    # the action before the first call; then means of the actions since the last advance
    np.testing.assert_allclose(network.observed_actions, [7, 1, 1.5, 2, 2.5, 3, 6, 6.5, 7, 7.5, 8])
