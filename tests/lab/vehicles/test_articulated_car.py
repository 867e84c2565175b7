"""Vehicles against an articulated car in C MuJoCo: circles, a step of the steering, braking, and a trailer.

MuJoCo's wheels have Coulomb friction, regularised by its solver: they hardly slip below the limit. The models differ
in slip, so the tests compare yaw rates, radii, distances and angles of joints, and not states over time. They use the
kinematic model, and the single-track model with tyres so stiff that they hardly slip either.
"""

import functools

import jax
import numpy as np
import pytest
from articulated import WHEELS, ArticulatedCar

from crazysim.plugins.vehicles import CarParams, CarState, kinematic, load_vehicle, single_track

STIFF = 2000.0
"""Cornering stiffness of an axle that slips by less than 0.01 rad up to the largest forces here, N/rad."""


@functools.cache
def vehicle(friction=2.5, armature=0.05):
    return load_vehicle({"base": "aiml_head", "tyres": {"friction": friction}, "wheels": {"armature": armature}})


def simulate(model, command, duration, speed=0.0, trailer=False, **changes):
    """Return the states of crazysim's vehicle at 1000 Hz, by Euler's method."""
    car = CarParams.create(vehicle(), 1000, trailer)
    car = car.replace(stiffness=np.full(2, STIFF), slip_speed=np.full(1, 0.2)).replace(**changes)
    zero, joints = np.zeros(1, np.float32), np.zeros(2, np.float32) if trailer else None
    start = CarState(np.zeros(3, np.float32), zero, np.array([speed, 0.0]), zero, zero, zero, joints)
    return jax.tree.map(np.asarray, _path(model, start, np.array(command), car, round(1000 * duration)))


@functools.partial(jax.jit, static_argnums=(0, 4))
def _path(model, start, command, car, n_steps):
    def step(s, _):
        s = jax.tree.map(lambda a, b: a + b / 1000, s, model(s, command, car))
        return s, s

    return jax.lax.scan(step, start, length=n_steps)[1]


@pytest.mark.parametrize(("reference", "steer"), [(0.2, 0.3), (0.3, -0.2)])
def test_steady_circles_agree(reference, steer):
    """Speed, yaw rate and radius agree within 1%: MuJoCo's slip is about 0.01 rad at 3 m/s^2."""
    car = ArticulatedCar(vehicle())
    car.steer(steer)
    while car.time < 4:
        car.drive(reference)
        car.step()
    for model in (kinematic, single_track):
        end = simulate(model, [reference, steer], 4.0)
        speed, yaw_rate = float(end.body_vel[-1, 0]), float(end.yaw_rate[-1, 0])
        assert speed == pytest.approx(car.body_vel[0], rel=0.01)
        assert yaw_rate == pytest.approx(car.yaw_rate, rel=0.012)
        assert speed / yaw_rate == pytest.approx(car.body_vel[0] / car.yaw_rate, rel=0.012)


def test_yaw_rates_after_a_step_of_the_steering_agree():
    """The yaw rate reaches 90% at the same time within 30 ms, and ends at the same value within 1%.

    The servos differ: MuJoCo's servo turns the wheels at once, ours at 3.2 rad/s at most.
    """
    car = ArticulatedCar(vehicle())
    while car.time < 3:
        car.drive(0.15)
        car.step()
    speed, start_time, yaw_rates = car.body_vel[0], car.time, []
    while car.time < start_time + 1.0:
        car.drive(0.15)
        car.steer(0.2)
        car.step()
        yaw_rates.append(car.yaw_rate)
    path = simulate(single_track, [0.15, 0.2], 1.0, speed)
    expected, result = np.array(yaw_rates), np.asarray(path.yaw_rate)[:, 0]
    assert result[-1] == pytest.approx(expected[-1], rel=0.01)
    rise_time, expected_time = (np.argmax(x > 0.9 * x[-1]) / 1000 for x in (result, expected))
    assert rise_time == pytest.approx(expected_time, abs=0.03)


@pytest.mark.parametrize("torque", [-0.5, -2.0])
def test_braking_with_the_motors_agrees(torque):
    """Distance and time agree within 0.5%: wheels roll, with the inertia of wheels and motors."""
    car = ArticulatedCar(vehicle())
    while car.body_vel[0] < 1.5:
        car.torque(2.0)
        car.step()
    speed, start_time, start = car.body_vel[0], car.time, car.pos[0]
    while car.body_vel[0] > 0.3:
        car.torque(torque)
        car.step()
    # The drive has neither damping nor friction: only the torque determines its force.
    path = simulate(single_track, [4 * torque / 0.052388, 0.0], 3.5, speed, drive=np.array([1.0, 0.0, 0.0]))
    stop = int(np.argmax(np.asarray(path.body_vel)[:, 0] < 0.3))
    assert float(path.pos[stop, 0]) == pytest.approx(car.pos[0] - start, rel=5e-3)
    assert stop / 1000 == pytest.approx(car.time - start_time, rel=5e-3)


def test_braking_with_locked_wheels_agrees():
    """On ground of friction 0.3 distances agree within 2%: ``v^2 / (2 friction g)``, and the lock takes 20 ms."""
    slippery = vehicle(friction=0.3, armature=1e-4)
    car = ArticulatedCar(slippery)
    while car.body_vel[0] < 2.0:
        car.torque(0.03)
        car.step()
    speed, start = car.body_vel[0], car.pos[0]
    car.torque(0.0)
    for name in WHEELS:
        car.model.joint(name).damping[0] = 0.05  # holds the wheels far below the speed at which they would roll
    while car.body_vel[0] > 0.3:
        car.step()
    params = CarParams.create(slippery, 1000)
    path = simulate(single_track, [-1e4, 0.0], 1.0, speed, grip=params.grip, towed_mass=params.towed_mass,
                drive=np.array([1.0, 0.0, 0.0]), drive_max=np.full(1, np.inf))  # fmt: skip
    stop = int(np.argmax(np.asarray(path.body_vel)[:, 0] < 0.3))
    assert float(path.pos[stop, 0]) == pytest.approx(car.pos[0] - start, rel=0.02)
    assert float(path.pos[stop, 0]) == pytest.approx((speed**2 - 0.3**2) / (2 * 0.3 * 9.81), rel=0.01)


def test_joint_angles_of_a_trailer_agree():
    """Angles of both joints agree within 0.004 rad, in the turn-in and in steady cornering.

    Trailer axles roll without slip in both. MuJoCo's trailer has little mass, as only its kinematics are compared.
    """
    car = ArticulatedCar(vehicle(), trailer=True)
    car.steer(0.2)
    angles = []
    while car.time < 6:
        car.drive(0.1)
        car.step()
        angles.append((car.yaw, car.yaw_of("bar"), car.yaw_of("deck")))
    yaw, bar, deck = np.unwrap(np.array(angles), axis=0).T
    towed_mass = CarParams.create(vehicle(), 1000).towed_mass + 0.05 + 0.3 + 4 * (0.1 + 5e-5 / 0.0315**2)
    path = simulate(kinematic, [0.1, 0.2], 6.0, trailer=True, towed_mass=towed_mass)
    hitch, joint = path.yaw[:, 0] - path.joints[:, 0], path.joints[:, 0] - path.joints[:, 1]
    n = min(len(yaw), len(path.yaw))
    for k in (1500, 3000, n - 1):
        assert float(hitch[k]) == pytest.approx(yaw[k] - bar[k], abs=0.004)
        assert float(joint[k]) == pytest.approx(bar[k] - deck[k], abs=0.004)
    assert float(path.yaw_rate[n - 1, 0]) == pytest.approx(car.yaw_rate, rel=0.01)
