"""Drones that collide: impulses by hand, laws, engines, and wrong input."""

import numpy as np
import pytest
from cases import with_params, with_states

from crazysim import ConfigError, DroneCollisions, Sim


def build(n_worlds=2, n_drones=2, engine="auto", **kwargs):
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="rotor_vel", engine=engine)
    sim.data = with_params(sim.data, drag_matrix=0 * np.asarray(sim.data.params.drag_matrix))
    sim.data = with_states(sim.data, pos=np.array([[0.2 * i, 0.0, 20.0] for i in range(n_drones)]))
    sim.build_default_data()
    return sim, sim.add(DroneCollisions(**kwargs))


@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_a_central_impact_shares_momentum(restitution):
    """Equal masses: (1 + e) / 2 of the speed goes over; the other world does not collide."""
    sim, _ = build(restitution=restitution)
    vel = np.zeros((2, 2, 3))
    vel[0, 0, 0], vel[1, 0, 0] = 2.0, -2.0
    sim.data = with_states(sim.data, vel=vel)
    sim.step(80)
    found = np.asarray(sim.data.states.vel)[..., 0]
    share = (1 + restitution) / 2
    np.testing.assert_allclose(found[0], [2 * (1 - share), 2 * share], atol=0.02)
    np.testing.assert_allclose(found[1], [-2.0, 0.0], atol=1e-6)


def test_momentum_is_kept_in_an_oblique_impact_of_three():
    sim, _ = build(n_worlds=1, n_drones=3, friction=0.8)
    sim.data = with_states(sim.data, vel=np.array([[2.0, 0.1, 0.05], [0, 0, 0], [-1.0, 0.0, 0.1]]))
    before = np.asarray(sim.data.states.vel, np.float64)[0].sum(axis=0)
    sim.step(100)
    after = np.asarray(sim.data.states.vel, np.float64)[0].sum(axis=0) + [0, 0, 3 * 9.81 * 0.2]
    np.testing.assert_allclose(after, before, atol=1e-4)
    assert np.abs(np.asarray(sim.data.states.ang_vel)).max() > 0.1, "it turns them"
    pos = np.asarray(sim.data.states.pos)[0]
    assert np.all(np.diff(pos[:, 0]) > 0.05), "none has passed through another"


def test_resets_clear_the_impulses():
    sim, plugin = build(engine="interpret", softness=0.01)
    sim.data = with_states(sim.data, pos=np.array([[0, 0, 20.0], [0.02, 0, 20.0]]))
    sim.step(2)
    assert np.abs(np.asarray(plugin.read(sim.data).impulse)).max() > 0
    sim.reset()
    assert not np.asarray(plugin.read(sim.data).press).any()
    assert np.isfinite(np.asarray(sim.data.states.pos)).all()


@pytest.mark.parametrize("kwargs, message", [
    ({"friction": -1.0}, "friction"),
    ({"restitution": 2.0}, "restitution"),
    ({"softness": 0.0}, "softness"),
])  # fmt: skip
def test_law_09_wrong_settings(kwargs, message):
    with pytest.raises(ConfigError, match=message):
        build(**kwargs)


def test_law_09_one_drone_cannot_collide():
    with pytest.raises(ConfigError, match="at least two drones"):
        Sim().add(DroneCollisions())
