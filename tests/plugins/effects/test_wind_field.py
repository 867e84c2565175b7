"""Wind fields: the air at drones and loads by hand, displacements, engines, gradients, and wrong input."""

import numpy as np
from cases import with_states

from crazysim import Sim, SlungLoad, Wind, WindField
from crazysim.plugins.effects import wind_field
from crazysim.plugins.effects.grid import Grid

SHEAR = Grid(np.array([[[[0.0, 0, 0], [4.0, 0, 2.0]]]]), (0, 0, 1.0), 2.0)
"""Wind along x and up that grows linearly from zero at 1 m to (4, 0, 2) m/s at 3 m."""


def build(field=SHEAR, n_worlds=2, n_drones=2, engine="interpret", **kwargs):
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="rotor_vel", rng_key=3, engine=engine)
    sim.data = with_states(sim.data, pos=[0, 0, 2.0])
    sim.build_default_data()
    sim.add(WindField(field, **kwargs))
    return sim


def test_a_field_pushes_as_a_steady_wind_of_the_same_velocity():
    """In the middle of the shear the air moves with (2, 0, 1) m/s."""
    field, steady = build(), Sim(n_worlds=2, n_drones=2, control="rotor_vel", engine="interpret")
    steady.data = with_states(steady.data, pos=[0, 0, 2.0])
    steady.add(Wind((2.0, 0.0, 1.0)))
    for sim in (field, steady):
        sim.step()
    assert float(np.asarray(steady.data.states.vel)[0, 0, 0]) > 1e-4
    np.testing.assert_allclose(field.data.states.vel, steady.data.states.vel, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(field.data.plugins["wind_field"].air_vel)[1, 1], [2, 0, 1])


def test_a_field_is_displaced_scaled_and_constant_outside():
    sim = build(offset=np.array([[[0, 0, 0], [0, 0, 0.5]], [[0, 0, 5.0], [0, 0, -5.0]]]), scale=2.0)
    sim.step()
    expected = [[[4, 0, 2], [2, 0, 1]], [[0, 0, 0], [8, 0, 4]]]  # the last two are outside, where the wind is constant
    np.testing.assert_allclose(sim.data.plugins["wind_field"].air_vel, expected, rtol=1e-6)


def test_displacements_are_drawn_for_each_world_and_episode():
    sim = build(n_worlds=4, spread=(1.0, 2.0, 0.0))
    sim.step(3)
    shift = np.asarray(sim.data.plugins["wind_field"].shift)
    np.testing.assert_array_equal(shift[:, 0], shift[:, 1])
    assert len(np.unique(shift[:, 0, 0])) == 4
    assert 1 < np.abs(shift[..., 1]).max() <= 2
    assert not shift[..., 2].any()
    sim.reset(np.array([True, False, False, False]))
    redrawn = np.asarray(sim.data.plugins["wind_field"].shift)
    np.testing.assert_array_equal(redrawn[1:], shift[1:])
    assert not np.isclose(redrawn[0], shift[0]).all(axis=-1).any()


def test_loads_feel_the_air_at_their_own_positions():
    """A load 1.6 m below drones at 3 m is at 1.4 m, in (0.8, 0, 0.4) m/s, and drones in (4, 0, 2)."""
    sim = build()
    sim.data = with_states(sim.data, pos=[0, 0, 3.0])
    load = sim.add(SlungLoad(0.01, 1.6, drag=0.05))
    sim.step()
    np.testing.assert_allclose(np.asarray(load.read(sim.data).wind_vel)[0, 0], [0.8, 0, 0.4], rtol=1e-5)
    still_sim = build(Grid(np.zeros((1, 1, 1, 3))))
    still_sim.data = with_states(still_sim.data, pos=[0, 0, 3.0])
    still_sim.add(SlungLoad(0.01, 1.6, drag=0.05))
    still_sim.step()
    # implicit: dt b / (m + dt b) of the air's velocity
    push = np.asarray(load.read(sim.data).vel) - np.asarray(still_sim.data.plugins["load"].vel)
    np.testing.assert_allclose(push[..., 0], 0.8 * 0.05 / 500 / (0.01 + 0.05 / 500), rtol=0.02)  # the cable's pull too
    sim.remove("wind_field")
    sim.step()
    assert np.abs(np.asarray(load.read(sim.data).vel)[..., 0]).max() < push[..., 0].max(), "there is no wind any more"


def test_a_large_table_is_read_outside_of_the_kernel_with_the_same_numbers(monkeypatch, rng):
    grid, ends = Grid(rng.normal(size=(6, 5, 4, 3)), (-1, -1, 0), 1.0), []
    for max_values, unfused in ((10**6, []), (1, ["wind_field"])):
        monkeypatch.setattr(wind_field, "MAX_FUSED_VALUES", max_values)
        sim = build(grid, n_worlds=3, engine="auto", spread=(0.5, 0.5, 0.5))
        assert [stage.name for stage in sim.step_fn.plan(sim.data).program.unfused_stages] == unfused
        sim.step(20)
        ends.append(sim.data)
    np.testing.assert_allclose(ends[0].states.vel, ends[1].states.vel, rtol=1e-5, atol=1e-6)  # float32
    assert np.abs(np.asarray(ends[0].plugins["wind_field"].air_vel)).min() > 0
