"""The model of the F1TENTH gym, against numbers of the gym itself."""

import jax
import numpy as np

from crazysim.lab.vehicles.car_params import CarParams
from crazysim.lab.vehicles.commonroad import CommonRoadParams, CommonRoadState, commonroad_single_track
from crazysim.plugins.vehicles import CarState, single_track

# Returned by vehicle_dynamics_st of f1tenth/f1tenth_gym, commit 4fdb9c7, with the default parameters of its
# environment: state (x, y, steering angle, speed, heading, yaw rate, slip), command (steering rate, acceleration).
GYM = [
    ([0, 0, 0, 0, 0, 0, 0], [0, 0], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
    (
        [1, 2, 0.1, 3.0, 0.4, 0.5, -0.05],
        [0.3, 1.2],
        [2.8181181385421366, 1.0286934223663542, 0.3, 1.2, 0.5, 6.659909753306486, 1.2305022299997805],
    ),
    (
        [1, 2, -0.2, 8.0, 2.4, -1.5, 0.1],
        [-4.0, 12.0],
        [-6.40914892437547, 4.787777152831652, -3.2, 8.70046125, -1.5, 15.630995430798329, 0.3442810415952444],
    ),
    (
        [0, 0, 0.4189, -2.0, -1.0, 0.7, 0.02],
        [1.0, -3.0],
        [-1.1140450935324346, 1.660994740983941, 0.0, -3.0, 0.7, 188.59490608043566, -6.257999999625065],
    ),
    (
        [0, 0, 0.3, 0.4, 1.0, 0.2, 0.1],
        [-1.0, 2.0],
        [0.2161209223472559, 0.33658839392315865, -1.0, 2.0, 0.3747259232097192, 0.546326266172706, 0.0],
    ),
    (
        [0, 0, -0.3, -0.3, 1.0, 0.2, 0.0],
        [5.0, -20.0],
        [-0.1620906917604419, -0.25244129544236893, 3.2, -9.51, 0.2810444424072894, 5.723580784608938, 0.0],
    ),
    (
        [0, 0, 0.05, 20.0, 1.0, 0.2, 0.0],
        [0.0, 2.0],
        [10.806046117362795, 16.82941969615793, 0.0, 0.0, 0.2, 14.746799290501212, -0.13666940267363883],
    ),
    (
        [0, 0, -0.4189, 0.5, 1.0, 0.2, -0.3],
        [-1.0, -2.0],
        [0.38242109364224425, 0.3221088436188455, 0.0, -2.0, 0.2, -185.54825897787782, 7.80160852009287],
    ),
    (
        [0, 0, 0.1, -5.0, 1.0, 0.2, 0.1],
        [0.0, -2.0],
        [-2.2679806071278867, -4.456036800307177, 0.0, 0.0, 0.2, 41.2669686740115, 0.3448426398360096],
    ),
]


gym_rates, own_rates = jax.jit(commonroad_single_track), jax.jit(single_track)


def state_of(x) -> CommonRoadState:
    x = np.asarray(x, jax.dtypes.canonicalize_dtype(float))
    return CommonRoadState(x[..., :2], *(x[..., k : k + 1] for k in range(2, 7)))


def test_derivatives_are_those_of_the_gym():
    with jax.enable_x64(True):
        x, u, expected = (np.array(column, float) for column in zip(*GYM, strict=True))
        rate = gym_rates(state_of(x), u, CommonRoadParams.create())
        np.testing.assert_allclose(np.concatenate(rate, axis=-1), expected, rtol=1e-12, atol=1e-12)


def test_single_track_tends_to_the_gym_at_small_angles():
    """The models agree to first order in slip, steering angle and yaw rate: the difference is of order three."""
    with jax.enable_x64(True):
        gym = jax.tree.map(np.asarray, CommonRoadParams.create())
        g, (front, rear) = 9.81, np.asarray(gym.axle_distances)
        loads = gym.mass * g * np.array([rear, front]) / (front + rear)
        car = CarParams(
            mass=gym.mass, yaw_inertia=gym.yaw_inertia, front=gym.axle_distances[:1], rear=gym.axle_distances[1:],
            stiffness=gym.friction * gym.stiffness * loads, grip=np.full(2, np.inf), drive=np.array([1.0, 0, 0]),
            drive_max=np.array([np.inf]), front_share=np.zeros(1), rolling=np.zeros(2), towed_mass=np.zeros(1),
            steer_max=np.ones(1), steer_rate_max=np.ones(1), steer_bandwidth=np.ones(1), slip_speed=np.zeros(1),
            trailer=None,
        )  # fmt: skip
        slip, steer, yaw_rate = np.random.default_rng(0).uniform(-1, 1, 3)
        speed, sizes, errors = 4.0, 0.1 * 0.5 ** np.arange(4), []
        for size in sizes:
            b, d, w = (np.array([size * x]) for x in (slip, steer, 4 * yaw_rate))
            zero = np.zeros(1)
            vel = speed * np.concatenate([np.cos(b), np.sin(b)])
            gym_state = CommonRoadState(np.zeros(2), d, zero + speed, zero, w, b)
            theirs = jax.tree.map(np.asarray, gym_rates(gym_state, np.zeros(2), gym))
            own_state = CarState(np.zeros(3), zero, vel, w, d, zero)
            ours = jax.tree.map(np.asarray, own_rates(own_state, np.zeros(2), car))
            # Rate of the angle of a velocity (x, y): (x y' - y x') / (x^2 + y^2).
            slip_rate = (vel[0] * ours.body_vel[1] - vel[1] * ours.body_vel[0]) / speed**2
            errors.append([ours.yaw_rate[0] - theirs.yaw_rate[0], slip_rate - theirs.slip[0]])
        slopes = np.polyfit(np.log(sizes), np.log(np.abs(errors)), 1)[0]
        assert np.all(slopes > 2.7), (slopes, errors)
