"""Airframes drawn for each episode: their distributions, what flies, and what is refused."""

import jax
import numpy as np
import pytest
from sweep import HEXAROTOR

from crazysim import ConfigError, RandomAirframe, Randomize, Sim
from crazysim.core.plugin import drawn_data
from crazysim.lab.plugins.random_airframe import LOGARITHMIC, RANGES

N = 1000


@pytest.fixture(scope="module")
def sim():
    sim = Sim(N, control="rotor_vel", rng_key=3, engine="interpret", plugins=[RandomAirframe()])
    sim.reset()
    return sim


def test_numbers_are_uniform_in_their_ranges_and_independent(sim):
    """Means of 1000 uniform numbers agree to four standard errors."""
    plugin, drawn = sim.plugins["airframe"], np.asarray(sim.data.plugins["airframe"].drawn)[:, 0].T
    uniform = []
    for name, x in zip(RANGES, drawn, strict=True):
        low, high = getattr(plugin, name)
        u = np.log(x / low) / np.log(high / low) if name in LOGARITHMIC else (x - low) / (high - low)
        assert -1e-5 <= u.min() < u.max() <= 1 + 1e-5
        np.testing.assert_allclose(u.mean(), 0.5, atol=4 / np.sqrt(12 * N))
        uniform.append(u)
    assert np.abs(np.corrcoef(uniform) - np.eye(len(RANGES))).max() < 4.5 / np.sqrt(N)


def test_quadrotors_have_the_drawn_qualities(sim):
    drawn = dict(zip(RANGES, np.asarray(sim.data.plugins["airframe"].drawn)[:, 0].T, strict=True))
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), drawn_data(sim.data).params)
    speed = float(p.rotor_vel_max.max())
    thrust, drag_torque = (np.polyval(x[:, 0, 0, ::-1].T, speed) for x in (p.rpm2thrust, p.rpm2torque))
    np.testing.assert_allclose(4 * thrust / (9.81 * p.mass[:, 0, 0]), drawn["thrust_to_weight"], rtol=1e-3)
    np.testing.assert_allclose(drag_torque / thrust, drawn["torque"], rtol=1e-5)
    # The rotors of one side at full thrust, those of the other at rest.
    side = (p.mixing_matrix[:, 0, 0] > 0) * thrust[:, None]
    acceleration = p.L[:, 0, 0] * (p.mixing_matrix[:, 0, 0] * side).sum(-1) * p.J_inv[:, 0, 0, 0]
    np.testing.assert_allclose(acceleration, drawn["agility"], rtol=1e-5)
    moments = np.diagonal(p.J[:, 0], axis1=-2, axis2=-1)
    largest = moments.max(axis=-1)
    assert (largest <= (moments.sum(axis=-1) - largest) * (1 + 1e-5)).all(), "no body has larger ones"
    np.testing.assert_allclose(np.diagonal(p.J_inv[:, 0], axis1=-2, axis2=-1), 1 / moments, rtol=1e-5)


def test_a_drawn_quadrotor_flies_as_one_with_these_parameters(sim):
    plugins = [RandomAirframe(sag=0.0), Randomize(mass=0.1)]
    few = Sim(4, control="rotor_vel", rng_key=3, engine="interpret", plugins=plugins)
    few.reset()
    own = Sim(4, control="rotor_vel", engine="interpret")
    own.data = own.data.replace(params=drawn_data(few.data).params)
    command = np.asarray(few.data.params.rotor_vel_max).max() * np.array([[[0.6, 0.5, 0.7, 0.55]]] * 4, np.float32)
    for flown in (few, own):
        flown.data = flown.data.replace(states=flown.data.states.replace(pos=own.data.states.pos + 3.0))
        flown.rotor_vel_control(command)
        flown.step(30)
    for x, y in zip(jax.tree.leaves(few.data.states), jax.tree.leaves(own.data.states), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5)


def test_the_voltage_sags_with_the_third_power_of_the_speeds(sim):
    """The largest thrust is reached with full load; without load the voltage is ``1 / (1 - sag)`` times as high."""
    data = drawn_data(sim.data)
    sag = np.asarray(data.plugins["airframe"].drawn)[..., RANGES.index("sag")]
    for speed, voltage in ((0.0, 1 / (1 - sag)), (0.5, (1 - sag / 8) / (1 - sag)), (1.0, np.ones_like(sag))):
        rotor_vel = speed * np.asarray(data.params.rotor_vel_max).max() * np.ones_like(data.states.rotor_vel)
        at_speed = data.replace(states=data.states.replace(rotor_vel=rotor_vel))
        params = at_speed.plugins["airframe"].influence(at_speed).params
        for name in ("rpm2thrust", "rpm2torque"):
            before, after = (np.asarray(getattr(p, name))[..., 0, 2] for p in (data.params, params))
            np.testing.assert_allclose(after, voltage**2 * before, rtol=1e-5)


def test_every_episode_has_another_quadrotor():
    sim = Sim(2, control="rotor_vel", engine="interpret", plugins=[RandomAirframe()])
    drawn = []
    for _ in range(2):
        sim.reset()
        sim.step(3)
        drawn.append(np.asarray(sim.data.plugins["airframe"].drawn))
    assert (np.abs(drawn[0] - drawn[1]).max(axis=-1) > 1e-3).all()
    np.testing.assert_array_equal(sim.data.params.mass, Sim(control="rotor_vel").data.params.mass)


@pytest.mark.parametrize(
    ("settings", "plugin", "message"),
    [
        ({"drone": HEXAROTOR}, RandomAirframe(), "four rotors.*got 6"),
        ({"dynamics": "so_rpy", "control": "attitude"}, RandomAirframe(), "first_principles"),
        ({}, RandomAirframe(lag=(0.2, 0.1)), r"lag as \(low, high\)"),
    ],
)
def test_law_09_what_cannot_be_drawn_is_refused(settings, plugin, message):
    with pytest.raises(ConfigError, match=message):
        Sim(**({"control": "rotor_vel"} | settings), plugins=[plugin])
