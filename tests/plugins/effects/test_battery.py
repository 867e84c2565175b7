"""Battery: balance of energy, voltage under load calculated by hand, and rotors that slow down with it."""

import jax
import numpy as np
import pytest
from cases import hover_rotor_state, with_states

from crazysim import Battery, ConfigError, Sim
from crazysim.dynamics import supported_drones
from crazysim.plugins.effects import battery

RAD_S = 2 * np.pi / 60


def build(n_worlds=2, n_drones=2, freq=500, **kwargs):
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="rotor_vel", freq=freq)
    sim.data = with_states(sim.data, pos=[0, 0, 10.0], rotor_vel=hover_rotor_state(sim.data))
    sim.build_default_data()
    sim.add(Battery(**{"capacity": 0.25, "resistance": 0.1} | kwargs))
    return sim


def record(sim):
    return sim.data.plugins["battery"]


def ocv(charge):
    return -1.031 * np.exp(-35 * charge) + 3.685 + 0.2156 * charge - 0.1178 * charge**2 + 0.3201 * charge**3


def rotor_power(rotor_vel):
    """Return the mechanical power of the rotors of a Crazyflie 2.1 Brushless, W."""
    r = np.asarray(rotor_vel, np.float64)
    return np.sum((1.65886356219615e-9 * r + 2.4693477924534137e-12 * r**2) * r * RAD_S, axis=-1, keepdims=True)


def test_voltage_and_current_under_load_by_hand():
    """A battery of 4 V and 0.5 ohm supplies 6 W at 3 V and 2 A. At most it supplies 8 W, at half the voltage."""
    as_arrays = lambda *x: [np.float32([v]) for v in x]  # noqa: E731
    for power, expected in ((0, (4, 0)), (6, (3, 2)), (8, (2, 4)), (100, (2, 4))):
        np.testing.assert_allclose(
            np.ravel(jax.jit(battery.voltage_under_load)(*as_arrays(power, 4.0, 0.5))), expected, rtol=1e-6
        )
    np.testing.assert_allclose(battery.open_circuit_voltage(np.ones(1, np.float32), 2), [2 * 4.1029], rtol=1e-6)
    np.testing.assert_allclose(battery.open_circuit_voltage(np.zeros(1, np.float32), 1), [2.654], rtol=1e-6)


def test_energy_is_balanced():
    """The integral of V_0 I of the cells is the energy of the rotors over their efficiency plus the heat in R."""
    sim = build(efficiency=0.6, base_power=0.5, charge=[[1.0, 0.5], [0.2, 0.05]], n_cells=1)
    sim.rotor_vel_control(np.linspace(0.7, 1.1, 16).reshape(2, 2, 4) * hover_rotor_state(sim.data))
    start = np.asarray(record(sim).charge, np.float64)
    supplied = consumed = heat = charge = 0.0
    for _ in range(250):
        power, before = rotor_power(sim.data.states.rotor_vel) / 0.6 + 0.5, np.asarray(record(sim).charge, np.float64)
        sim.step()
        v, i = (np.asarray(x, np.float64) for x in (record(sim).voltage, record(sim).current))
        supplied, consumed, heat = supplied + ocv(before) * i, consumed + power, heat + 0.1 * i**2
        charge = charge + i / 500 / 3600
        np.testing.assert_allclose(v * i, power, rtol=1e-5)  # float32
        np.testing.assert_allclose(v, ocv(before) - 0.1 * i, rtol=1e-6)
    np.testing.assert_allclose(supplied, consumed + heat, rtol=1e-5)
    # In float32 the charge is rounded once, at its last value, and not in each of the 250 steps.
    np.testing.assert_allclose(start - np.asarray(record(sim).charge, np.float64), charge / 0.25, atol=7e-8)
    assert np.min(charge / 0.25) > 1e-4


def test_a_low_voltage_slows_the_rotors_and_leaves_the_command():
    """The rotors settle at the airframe's largest speed times V / V_full, here V / 4 V."""
    sim = build(capacity=10.0, resistance=0.5, full_speed_voltage=4.0)
    max_rotor_vel = np.float32(sim.data.params.rotor_vel_max[0])
    sim.rotor_vel_control(np.full((2, 2, 4), 1.5 * max_rotor_vel))
    sim.step(600)
    speed = np.asarray(sim.data.states.rotor_vel, np.float64)
    v = np.asarray(record(sim).voltage, np.float64)
    v0 = ocv(np.asarray(record(sim).charge, np.float64))
    np.testing.assert_allclose(v, 0.5 * (v0 + np.sqrt(v0**2 - 4 * 0.5 * rotor_power(speed))), rtol=1e-4)
    np.testing.assert_allclose(
        speed, np.broadcast_to(v / 4.0 * max_rotor_vel, speed.shape), rtol=1e-4
    )  # slow discharge
    assert v.max() < 3.9
    np.testing.assert_array_equal(sim.data.controls.rotor_vel, np.full((2, 2, 4), max_rotor_vel))


def test_without_compensation_all_speeds_follow_the_voltage():
    """Speeds are the commands times V over the voltage of the commands, at full and half charge."""
    sim = build(capacity=10.0, charge=[[1.0, 0.5], [0.2, 0.5]], command_voltage=[[3.7, 3.7], [3.7, 4.0]])
    sim.rotor_vel_control(np.full((2, 2, 4), 12000.0))
    sim.step(600)
    v, command_voltage = np.asarray(record(sim).voltage), np.array([[3.7, 3.7], [3.7, 4.0]])[..., None]
    assert np.ptp(v) > 0.1
    np.testing.assert_allclose(
        sim.data.states.rotor_vel, np.repeat(12000 * v / command_voltage, 4, -1), rtol=1e-4
    )  # discharges
    with pytest.raises(ConfigError, match="command_voltage of Battery to be positive"):
        sim.replace(Battery(0.25, 0.1, command_voltage=0.0))


@pytest.mark.parametrize("name", sorted(set(supported_drones("first_principles")) - {"bumblebee_lab"}))
def test_without_arguments_a_battery_is_that_of_the_airframe(name):
    """The battery is full, its voltage falls under load, and it lasts minutes of hover. bumblebee_lab has none."""
    sim = Sim(drone=name, control="state", controller="auto")
    sim.data = with_states(sim.data, pos=[0, 0, 1.0], rotor_vel=hover_rotor_state(sim.data))
    sim.add(Battery())
    for key in ("capacity", "resistance"):
        np.testing.assert_allclose(getattr(record(sim), key), sim.airframe.value(f"battery.{key}"), rtol=1e-6)
    np.testing.assert_array_equal(record(sim).n_cells, [sim.airframe.value("battery.cells")])
    sim.state_control(pos=[0.0, 0, 1.0])
    sim.step(2 * sim.freq)
    np.testing.assert_allclose(sim.data.states.pos[0, 0], [0, 0, 1], atol=0.02)
    cells = float(sim.airframe.value("battery.cells"))
    assert 3.2 * cells < float(record(sim).voltage[0, 0, 0]) < 4.1 * cells
    minutes = 2 / 60 / (1 - float(record(sim).charge[0, 0, 0]))
    # uzh_cpc hovers shortest: its published drag torque is 0.05 m times the thrust.
    assert 2.5 < minutes < 60, "electric losses are not counted"


def test_drones_of_a_fleet_have_their_own_batteries():
    sim = Sim(n_worlds=2, drone=["cf21B_500", "bumblebee"], control="rotor_vel")
    sim.add(Battery())
    np.testing.assert_array_equal(record(sim).n_cells, [[[1], [4]]] * 2)
    np.testing.assert_allclose(record(sim).voltage[1, :, 0], [4.1029, 4 * 4.1029], rtol=1e-5)
    np.testing.assert_allclose(np.ravel(record(sim).full_speed_voltage[1]), [3.1257, 4 * 3.7], atol=1e-4)


def test_an_empty_battery_turns_no_rotor_and_a_reset_fills_it():
    """2 A for 2 s from 0.0002 A h: empty, no current, rotors run down; the other battery flies on."""
    sim = build(capacity=[[2e-4, 0.25], [0.25, 0.25]])
    sim.rotor_vel_control(np.broadcast_to(hover_rotor_state(sim.data), (2, 2, 4)))
    sim.step(1000)
    assert np.asarray(record(sim).charge)[0, 0, 0] == 0
    assert np.asarray(record(sim).current)[0, 0, 0] == 0
    assert np.asarray(sim.data.states.rotor_vel)[0, 0].max() < 300
    assert np.asarray(record(sim).charge)[0, 1, 0] > 0.9
    assert np.asarray(sim.data.states.rotor_vel)[0, 1].min() > 14000
    sim.reset(np.array([True, False]))
    charge = np.asarray(record(sim).charge)
    np.testing.assert_array_equal(charge[0], 1.0)
    assert np.all(charge[1] < 1)
