"""A fleet in a running simulation: every command takes effect at once and without compilation."""

import numpy as np
import pytest
from tcp_clients import DroneClient, StreamClient

from crazysim import Sim
from crazysim.errors import ConfigError
from crazysim.lab.live import (
    CommandServer,
    Fleet,
    Hover,
    Land,
    LoadShow,
    SetParameter,
    Start,
    StartShow,
    TakeOff,
    Upload,
)
from crazysim.lab.show_files import Lights, Show
from crazysim.trajectories import Trajectory, hover, line

RED, BLUE, OFF = (1, 0, 0), (0, 0, 1), (0, 0, 0)
MAX_DISTANCE = 0.12
"""Largest distance from the setpoint 2 s after a move, m: the integral of the default controller grows on the floor and
decays slowly."""


@pytest.fixture(scope="module")
def sim_and_data():
    sim = Sim(n_drones=3, control="state")
    pos = sim.data.states.pos.at[0].set(np.array([[0, 0, 0.03], [1, 0, 0.03], [2, 0, 0.03]]))
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    sim.build_default_data()
    return sim, sim.data, sim.default_data


@pytest.fixture
def sim(sim_and_data):
    sim, data, default_data = sim_and_data
    for name in list(sim.plugins):
        sim.plugins.remove(name)
    sim.data, sim.default_data = data, default_data
    return sim


def read_positions(sim):
    return np.asarray(sim.data.states.pos[0], float)


def test_flight_by_commands(sim):
    fleet = Fleet(sim, ids={7: 2}, max_pieces=8)
    sim.step(10)
    step, plan = sim.step_fn, sim.step_fn.plan(sim.data)
    assert fleet.apply([TakeOff(None, 0.8)]) == 1
    sim.step(1500)
    np.testing.assert_allclose(read_positions(sim)[:, 2], 0.8, atol=MAX_DISTANCE)

    start = read_positions(sim)[2]
    fleet.apply([Upload(7, line((5, 5, 5), (5, 6, 5), 2.0)), Start(7, relative=True)])
    sim.step(1500)
    np.testing.assert_allclose(read_positions(sim)[2] - start, [0, 1, 0], atol=MAX_DISTANCE)
    np.testing.assert_allclose(read_positions(sim)[:2], [[0, 0, 0.8], [1, 0, 0.8]], atol=MAX_DISTANCE)

    fleet.apply([Upload(7, line((2, 1, 0.8), (2, 0, 0.8), 2.0)), Start(7)])
    sim.step(500)
    staged_pos = np.asarray(sim.data.controls.state.staged_cmd[0, 2, :3])
    fleet.apply([Hover(7)])
    setpoint = fleet.setpoint(2)
    np.testing.assert_allclose(staged_pos, setpoint[:3], atol=0.03)  # at most a control step apart
    assert 0.2 < setpoint[1] < 0.8
    sim.step(1000)
    np.testing.assert_allclose(read_positions(sim)[2], setpoint[:3], atol=MAX_DISTANCE)
    fleet.apply([Land(None), SetParameter(7, "stabilizer.controller", 2.0)])
    assert fleet.parameters == [{}, {}, {"stabilizer.controller": 2.0}]
    sim.step(1500)
    assert np.all(read_positions(sim)[:, 2] < MAX_DISTANCE)
    assert sim.step_fn is step
    assert sim.step_fn.plan(sim.data) is plan


def test_show_by_commands(sim):
    lines = [line((k, 0, 0.5), (k, 1, 1.0), 2.0) for k in range(2)]
    show = Show(("a", "b"), Trajectory.stack(lines), Lights.stack([Lights.of_pieces([0, 1], [RED, BLUE])] * 2))
    fleet = Fleet(sim, max_pieces=8)
    assert fleet.apply([StartShow()]) == 0  # nothing to start
    fleet.apply([LoadShow(show)])
    np.testing.assert_allclose(
        read_positions(sim)[:2], [[0, 0, 0.5], [1, 0, 0.5]]
    )  # loading a show moves its drones, as in the lab's simulator
    sim.step(250)
    np.testing.assert_array_equal(fleet.colors(), np.zeros((3, 3)))  # the show has not started
    assert fleet.apply([StartShow()]) == 1
    np.testing.assert_array_equal(fleet.colors(), [RED, RED, OFF])
    np.testing.assert_allclose(fleet.setpoint(0)[:3], [0, 0, 0.5])
    sim.step(600)
    np.testing.assert_array_equal(fleet.colors(), [BLUE, BLUE, OFF])  # 1.2 s later
    sim.step(900)
    np.testing.assert_allclose(read_positions(sim)[:2], [[0, 1, 1], [1, 1, 1]], atol=MAX_DISTANCE)
    assert read_positions(sim)[2, 2] < MAX_DISTANCE
    fleet.reset()
    np.testing.assert_array_equal(fleet.colors(), np.zeros((3, 3)))


def test_commands_that_cannot_be_carried_out_change_nothing(sim, caplog):
    fleet = Fleet(sim, ids={1: 0, 2: 1, 3: 2}, max_pieces=2, teleport=False)
    last_data = sim.data
    long_trajectory = Trajectory.of_pieces([1.0] * 3, np.zeros((3, 4, 1)))
    high_degree = Trajectory.of_pieces([1.0], np.zeros((1, 4, 9)))
    large_show = Show(tuple("abcd"), Trajectory.stack([hover()] * 4), Lights.stack([Lights.constant()] * 4))
    long_show = Show(("a",), Trajectory.stack([long_trajectory]), Lights.stack([Lights.constant()]))
    uploads = [Upload(1, long_trajectory), Upload(1, high_degree), Upload(None, Trajectory.stack([hover()]))]
    wrong = [*uploads, Start(1), Start(None), Land(4), LoadShow(large_show), LoadShow(long_show)]
    assert fleet.apply(wrong) == 0
    assert caplog.text.count("refused: expected") == len(wrong)
    assert sim.data is last_data
    assert fleet.apply([Upload(1, line((9, 9, 9), (9, 9, 8), 2.0))]) == 1
    np.testing.assert_allclose(read_positions(sim), np.asarray(last_data.states.pos[0]))  # not moved


def test_new_ids_get_the_next_free_drone(sim):
    fleet = Fleet(sim, ids={5: 1}, max_pieces=2)
    fleet.apply([SetParameter(9, "a", 1.0), SetParameter(8, "a", 2.0), SetParameter(9, "b", 3.0)])
    assert fleet.ids == {5: 1, 9: 0, 8: 2}
    assert fleet.parameters == [{"a": 1.0, "b": 3.0}, {}, {"a": 2.0}]
    assert fleet.apply([SetParameter(4, "a", 1.0)]) == 0


def test_wrong_fleets(sim):
    with pytest.raises(ConfigError, match="one world"):
        Fleet(Sim(n_worlds=2, control="state"))
    with pytest.raises(ConfigError, match="state"):
        Fleet(Sim())
    for ids in ({1: 0, 2: 0}, {1: 3}):
        with pytest.raises(ConfigError, match="one drone of 3"):
            Fleet(sim, ids=ids)


def test_commands_over_the_network_while_the_simulation_runs(sim):
    with CommandServer(drone_port=0, stream_port=0) as server:
        fleet = Fleet(sim, max_pieces=8)
        with DroneClient(1, port=server.drone_port) as drone, StreamClient(port=server.stream_port) as stream:
            drone.command("takeoff_0.6")
            stream.command(2, "takeoff_0.4")
            with pytest.raises(ConfigError):
                stream.send(b"garbage: the fleet flies on")
            heights = []
            for _ in range(30):
                fleet.apply(server.commands())
                sim.step(50)
                heights.append(read_positions(sim)[:, 2])
    np.testing.assert_allclose(heights[-1][:2], [0.6, 0.4], atol=MAX_DISTANCE)
    assert heights[-1][2] < MAX_DISTANCE
