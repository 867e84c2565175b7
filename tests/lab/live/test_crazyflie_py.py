"""Scripts of Crazyswarm2 with their import changed."""

import math

import numpy as np
import pytest

from crazysim import Sim
from crazysim.errors import ConfigError
from crazysim.lab.live import Live, Viewer
from crazysim.lab.live.crazyflie_py import Crazyswarm, use
from crazysim.lab.live.crazyflie_py.uav_trajectory import Trajectory
from crazysim.lab.live.swarm import Swarm
from crazysim.plugins.effects import Battery

MAX_DISTANCE = 0.02
"""Largest distance of a drone from its setpoint shortly after a move, m."""


@pytest.fixture(scope="module")
def swarm():
    return Swarm(Sim(n_drones=2, control="state"), ["cf231", "cf5"])


@pytest.fixture
def script(swarm):
    swarm.sim.reset()
    swarm.advance(0.02)
    for commander in swarm.commanders:
        commander.group = 0
    use(swarm)
    return Crazyswarm()


def write_csv(path, durations, starts):
    """Write a trajectory along x with constant speed 0.5 m/s at a height of 1 m."""
    rows = ["duration," + ",".join(f"c{k}" for k in range(32))]
    for duration, x in zip(durations, starts, strict=True):
        c = np.zeros((4, 8))
        c[0, :2], c[2, 0] = [x, 0.5], 1.0
        rows.append(",".join(map(str, [duration, *c.ravel()])))
    path.write_text("\n".join(rows))
    return path


def test_names_and_numbers(script):
    allcfs = script.allcfs
    assert [cf.prefix for cf in allcfs.crazyflies] == ["/cf231", "/cf5"]
    assert allcfs.crazyfliesByName["cf5"] is allcfs.crazyflies[1]
    assert allcfs.crazyfliesById[231] is allcfs.crazyflies[0]
    np.testing.assert_allclose(allcfs.crazyflies[0].initialPosition[:2], [-0.5, -0.5])


def test_hover_and_land(script):
    timeHelper, cf = script.timeHelper, script.allcfs.crazyflies[0]
    cf.arm(True)
    cf.takeoff(targetHeight=1.0, duration=2.5)
    timeHelper.sleep(2.5 + 1.0)
    assert cf.position()[2] == pytest.approx(1.0, abs=MAX_DISTANCE)
    assert cf.get_status()["supervisor"] & 16
    cf.goTo(cf.initialPosition + [0, 0.5, 1.0], yaw=0.0, duration=2.0)
    timeHelper.sleep(3.0)
    np.testing.assert_allclose(cf.get_position()[:2], cf.initialPosition[:2] + [0, 0.5], atol=0.05)
    cf.land(targetHeight=0.04, duration=2.5)
    timeHelper.sleep(3.0)
    assert cf.get_pose()["position"][2] < 0.02
    assert script.timeHelper.time() == pytest.approx(9.52)


def test_uploaded_trajectories(script, tmp_path):
    timeHelper, allcfs = script.timeHelper, script.allcfs
    trajectory = Trajectory()
    trajectory.loadcsv(write_csv(tmp_path / "line.csv", [1.0, 1.0], [0.0, 0.5]))
    assert (trajectory.n_pieces(), trajectory.duration) == (2, 2.0)
    point = trajectory.eval(1.5)
    np.testing.assert_allclose([*point.pos, *point.vel], [0.75, 0, 1, 0.5, 0, 0])
    for cf in allcfs.crazyflies:
        cf.uploadTrajectory(0, 0, trajectory)
    allcfs.takeoff(targetHeight=1.0, duration=2.0)
    timeHelper.sleep(2.5)
    allcfs.startTrajectory(0, timescale=2.0)
    timeHelper.sleep(2.0)
    for cf in allcfs.crazyflies:
        np.testing.assert_allclose(cf.position()[:2], cf.initialPosition[:2] + [0.5, 0.0], atol=0.1)
    timeHelper.sleep(3.0)
    allcfs.startTrajectory(0, reverse=True, relative=True)
    timeHelper.sleep(3.5)
    for cf in allcfs.crazyflies:
        np.testing.assert_allclose(cf.position()[:2], cf.initialPosition[:2], atol=0.1)


def test_streamed_full_states(script):
    timeHelper, cf = script.timeHelper, script.allcfs.crazyflies[0]
    cf.takeoff(targetHeight=0.8, duration=2.0)
    timeHelper.sleep(2.5)
    start, home = timeHelper.time(), cf.initialPosition
    while timeHelper.time() - start < 2.0:
        a = 1.5 * (timeHelper.time() - start)
        pos = home + [0.3 * math.sin(a), 0, 0.8]
        cf.cmdFullState(pos, [0.45 * math.cos(a), 0, 0], [-0.675 * math.sin(a), 0, 0], 0.0, [0, 0, 0])
        timeHelper.sleepForRate(30)
    np.testing.assert_allclose(cf.position()[0], pos[0], atol=0.1)
    cf.notifySetpointsStop()
    cf.land(targetHeight=0.03, duration=1.5)
    timeHelper.sleep(2.5)
    assert cf.position()[2] < 0.02


def test_streamed_hover_setpoints(script):
    timeHelper, cf = script.timeHelper, script.allcfs.crazyflies[0]
    for _ in range(40):
        cf.cmdHover(0.0, 0.0, 0.0, 0.6)
        timeHelper.sleep(0.1)
    assert cf.position()[2] == pytest.approx(0.6, abs=MAX_DISTANCE)
    for _ in range(20):
        cf.cmdHover(0.3, 0.0, 0.0, 0.6)
        timeHelper.sleep(0.1)
    np.testing.assert_allclose(cf.position()[:2] - cf.initialPosition[:2], [0.6, 0.0], atol=0.1)
    for _ in range(10):
        cf.cmdHover(0.0, 0.0, 0.5, 0.6)  # rad/s
        timeHelper.sleep(0.1)
    assert script.swarm.state(0).rpy[2] == pytest.approx(0.5, abs=0.1)


def test_a_landing_ends_on_the_floor_although_the_controller_has_an_offset(script):
    """The default controller has an offset, as controllers with a load do."""
    timeHelper, cf = script.timeHelper, script.allcfs.crazyflies[0]
    cf.takeoff(targetHeight=0.5, duration=1.5)
    timeHelper.sleep(2.0)
    cf.land(targetHeight=0.04, duration=1.5)
    heights = []
    while script.swarm["cf231"].motors_on:
        timeHelper.sleep(0.02)
        heights.append(cf.position()[2])
    assert heights[-1] < 0.06  # 1 cm above, and a control step of sinking
    assert timeHelper.time() < 0.02 + 3.5 + 1.5


def test_the_status_has_a_battery(script):
    assert script.allcfs.crazyflies[1].get_status()["battery"] == 4.0
    sim = Sim(control="state", drone="cf21B_500")
    battery = sim.add(Battery(capacity=0.35, resistance=0.1, n_cells=1))
    sim.build_default_data()
    script = Crazyswarm(Swarm(sim))
    cf = script.allcfs.crazyflies[0]
    resting = cf.get_status()
    cf.takeoff(targetHeight=0.5, duration=1.5)
    script.timeHelper.sleep(2.0)
    flying = cf.get_status()
    assert flying["battery"] < resting["battery"] - 0.1  # sags
    assert (flying["pm_state"], flying["rssi"], flying["num_rx_unicast"]) == (0, 0, 0)
    record = battery.read(sim.data)
    sim.data = battery.write(sim.data, record.replace(voltage=record.voltage.at[:].set(3.1)))
    assert cf.get_status()["pm_state"] == 3


def test_groups_parameters_and_lights(script):
    timeHelper, allcfs = script.timeHelper, script.allcfs
    first, second = allcfs.crazyflies
    first.setGroupMask(1)
    second.setParam("hlCommander.groupmask", 2)
    allcfs.takeoff(targetHeight=0.5, duration=1.0, groupMask=2)
    timeHelper.sleep(1.5)
    assert first.position()[2] < 0.02
    assert second.position()[2] == pytest.approx(0.5, abs=MAX_DISTANCE)
    first.setLEDColor(1, 0.5, 2)
    allcfs.setParam("ring.solidBlue", 51)
    np.testing.assert_allclose(script.swarm.colors[0], [1, 127 / 255, 0.2])
    assert second.getParam("ring.solidBlue") == 51
    assert first.getParam("ring.effect") == 7
    script.swarm.reports.latest.clear()
    first.setParam("stabilizer.controller", 2)
    first.setParam("no.thing", 2)
    assert ["controller" in r.text or "no.thing" in r.text for r in script.swarm.reports.latest] == [True, True]
    with pytest.raises(ConfigError, match=r"no\.thing"):
        first.getParam("no.thing")
    assert not timeHelper.isShutdown()


def test_refused_commands_are_reported_and_the_rest_continues(script):
    script.swarm.reports.latest.clear()
    first, second = script.allcfs.crazyflies
    first.startTrajectory(99)
    first.goTo([math.nan, 0, 0], 0.0, 1.0)
    second.takeoff(0.5, 1.0)
    script.timeHelper.sleep(1.5)
    assert [(r.kind, r.name) for r in script.swarm.reports.latest] == [("refused", "cf231")] * 2
    assert second.position()[2] > 0.3
    script.allcfs.emergency()
    second.takeoff(1.0, 1.0)
    script.timeHelper.sleep(2.0)
    assert second.position()[2] < 0.1


def test_a_configuration_sets_names_and_positions(tmp_path):
    robots = {
        "cf1": {"enabled": True, "initial_position": [0.0, 1.0, 0.0]},
        "cf2": {"enabled": False, "initial_position": [5.0, 5.0, 0.0]},
        "cf9": {"initial_position": [1.0, -1.0, 0.0]},
    }
    swarm = Crazyswarm({"robots": robots})
    assert swarm.swarm.names == ("cf1", "cf9")
    np.testing.assert_allclose(swarm.allcfs.crazyflies[1].position(), [1, -1, 0])
    with pytest.raises(ConfigError, match="initial_position"):
        Crazyswarm({"robots": {"cf1": {}}})
    with pytest.raises(ConfigError, match="at least one enabled"):
        Crazyswarm({"robots": {}})
    with pytest.raises(ConfigError, match="expected"):
        Crazyswarm(tmp_path / "none.yaml")


def test_wrong_files(tmp_path):
    (tmp_path / "a.csv").write_text("x\n1,2,3\n")
    with pytest.raises(ConfigError, match="33 columns"):
        Trajectory().loadcsv(tmp_path / "a.csv")
    with pytest.raises(ConfigError, match="durations of at least"):
        Trajectory().loadcsv(write_csv(tmp_path / "b.csv", [0.0], [0.0]))
    with pytest.raises(ConfigError, match="got 0 pieces"):
        Trajectory().host_trajectory()


class LightRecorder(Viewer):
    """A viewer that records the lights."""

    is_open = True

    def __init__(self):
        self.lights = []

    def open(self, live):
        pass

    def update(self, live):
        self.lights.append(live.lights[0].copy())

    def close(self):
        pass


def test_scripts_advance_a_live_loop_whose_viewers_show_the_lights():
    swarm = Swarm(Sim(n_drones=2, control="state"))
    with Live(swarm.sim, speed="max") as live:
        recorder = live.show(LightRecorder())
        swarm.run_in(live)
        script = Crazyswarm(swarm)
        cfs, clock = script.allcfs.crazyflies, script.timeHelper
        cfs[0].setLEDColor(1.0, 0.5, 0.0)
        script.allcfs.takeoff(targetHeight=1.0, duration=2.0)
        clock.sleep(3.0)
        cfs[0].setParam("ring.solidRed", 0)
        cfs[0].setParam("ring.solidGreen", 255)
        clock.sleep(0.5)
        clock.sleep(0.0)
        np.testing.assert_allclose(cfs[1].position()[2], 1.0, atol=MAX_DISTANCE + 0.05)
        assert clock.time() == pytest.approx(3.5)
        assert live.time == pytest.approx(3.5)
    assert len(recorder.lights) > 5
    np.testing.assert_allclose(recorder.lights[1], [[1.0, 127 / 255, 0.0], [0, 0, 0]])
    np.testing.assert_allclose(live.lights[0], [[0.0, 1.0, 0.0], [0, 0, 0]])
    with pytest.raises(ConfigError, match="loop of the swarm's simulation"):
        swarm.run_in(Live(Sim(control="state")))


def test_either_a_thread_or_a_live_loop_advances_a_swarm():
    swarm = Swarm(Sim(control="state"))
    with Live(swarm.sim, speed="max") as live:
        with swarm.start(), pytest.raises(ConfigError, match="no thread advances"):
            swarm.run_in(live)
        swarm.run_in(live)
        with pytest.raises(ConfigError, match="Use advance or sleep"):
            swarm.start()
