"""Dynamics of vehicles: limits with closed forms, invariants, and finite values and gradients everywhere."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazysim.lab.vehicles.single_track import drive_force, tyre_force
from crazysim.plugins.vehicles import CarParams, CarState, ackermann, kinematic, load_vehicle, single_track

MODELS = {"single_track": single_track, "kinematic": kinematic}
RATES = {name: jax.jit(model) for name, model in MODELS.items()}
"""Functions from state, command and parameters of a vehicle to the time derivatives of its state."""


@functools.cache
def params(name="f1tenth_ros", trailer=False):
    return CarParams.create(load_vehicle(name), 500, trailer)


def create_state(speed=0.0, side=0.0, yaw_rate=0.0, steer=0.0, yaw=0.0, joints=None) -> CarState:
    """Return the state of a vehicle at the origin; ``side`` is its speed to the left, m/s."""
    vel = np.array([speed, side], float)
    yaw, yaw_rate, steer, zero = (np.array([x], float) for x in (yaw, yaw_rate, steer, 0.0))
    return CarState(np.zeros(3), yaw, vel, yaw_rate, steer, zero, joints)


def after_step(name, car, s, command, freq):
    def advance(rate, dt):
        return jax.tree.map(lambda a, b: a + dt * b, s, rate)

    model = MODELS[name]
    k1 = model(s, command, car)
    k2 = model(advance(k1, 0.5 / freq), command, car)
    k3 = model(advance(k2, 0.5 / freq), command, car)
    k4 = model(advance(k3, 1 / freq), command, car)
    return jax.tree.map(lambda a, b, c, d, e: a + (b + 2 * c + 2 * d + e) / (6 * freq), s, k1, k2, k3, k4)


@functools.partial(jax.jit, static_argnums=0)
def _end(name, car, start, command, n_steps):
    start = jax.tree.map(jnp.asarray, start)
    return jax.lax.fori_loop(0, n_steps, lambda _, s: after_step(name, car, s, command, 500.0), start)


def end_of(name, car, start, command, duration):
    return jax.tree.map(np.asarray, _end(name, car, start, np.array(command), round(500 * duration)))


def test_for_small_slip_the_model_tends_to_the_published_one():
    """The equations of the lab's simulator assume small slip angles: the difference is of order three."""
    with jax.enable_x64(True):
        car = jax.tree.map(lambda x: np.asarray(x, np.float64), CarParams.create(load_vehicle("f1tenth_ros"), 500))
        car = car.replace(grip=np.full(2, np.inf), slip_speed=np.full(1, 1e-9))
        rng, errors, sizes = np.random.default_rng(0), [], 0.1 * 0.5 ** np.arange(4)
        d, side, delta, turn = rng.uniform(-1, 1, 4)
        for size in sizes:
            vx, vy, steer, w = 3.0, 3.0 * size * side, size * delta, 5 * size * turn
            m, inertia, lf, lr, front, rear = 2.923, 0.0796, 0.163, 0.168, 41.7372, 29.4662
            force = 41.796 * d - 2.0152 * vx - 0.4328
            f_y, r_y = front * (steer - (w * lf + vy) / vx), rear * (w * lr - vy) / vx
            theirs = [
                (force + force * np.cos(steer) - f_y * np.sin(steer)) / m + vy * w,
                (r_y + force * np.sin(steer) + f_y * np.cos(steer)) / m - vx * w,
                (f_y * lf * np.cos(steer) + force * lf * np.sin(steer) - r_y * lr) / inertia,
            ]
            rate = RATES["single_track"](create_state(vx, vy, w, steer), np.array([d, steer]), car)
            errors.append(np.concatenate([rate.body_vel, rate.yaw_rate]) - theirs)
        slopes = np.polyfit(np.log(sizes), np.log(np.abs(errors)), 1)[0]
        assert np.all(slopes > 2.7), (slopes, errors)


@pytest.mark.parametrize("model", MODELS)
def test_slow_vehicles_roll_on_the_circle_of_their_wheels(model):
    """At 0.2 m/s tyres hardly slip: the yaw rate is v tan(d) / L."""
    car = params()
    reference = (4.0304 * 0.2 + 0.8656 * 0.2 / np.hypot(0.2, 0.1)) / 83.592
    end = end_of(model, car, create_state(), [reference, 0.3], 8.0)
    expected = float(end.body_vel[0]) * np.tan(0.3) / 0.331
    # 2 % for slip angles m v^2 / (R C) of 0.001 rad, and for the lateral part of the force of the drive.
    assert float(end.yaw_rate[0]) == pytest.approx(expected, rel=0.02)


def test_steady_cornering_has_the_understeer_gradient():
    """``d = L / R + (m / L) (l_r / C_f - l_f / C_r) v^2 / R`` for small angles, with the drive's lateral share."""
    car = params().replace(front_share=np.zeros(1, np.float32), slip_speed=np.full(1, 1e-3, np.float32))
    speed, steer = 2.0, 0.01
    reference = (4.0304 * speed + 0.8656) / 83.592
    end = end_of("single_track", car, create_state(speed), [reference, steer], 6.0)
    gradient = 2.923 / 0.331 * (0.168 / 41.7372 - 0.163 / 29.4662)
    v = float(end.body_vel[0])
    assert float(end.yaw_rate[0]) == pytest.approx(steer * v / (0.331 + gradient * v**2), rel=5e-3)


def test_wheels_lock_at_the_friction_coefficient():
    """At full brake the deceleration is the friction coefficient times g."""
    car = params()
    single_track_acc, kinematic_acc = (
        np.asarray(RATES[name](create_state(5.0), np.array([-100.0, 0.0]), car).body_vel)[0] for name in MODELS
    )
    assert single_track_acc == pytest.approx(-1.0489 * 9.81, rel=1e-3)
    assert abs(kinematic_acc + 1.0489 * 9.81) < 0.02


force_of = jax.jit(tyre_force)


@given(st.floats(-50, 50), st.floats(-20, 20), st.floats(-20, 20), st.floats(0.1, 100))
@settings(deadline=None, max_examples=50)
def test_forces_stay_in_the_friction_circle_and_oppose_slip(drive, along, across, grip):
    force = np.asarray(force_of(*(np.array(x) for x in ([drive], [along, across], [40.0], [grip], [0.1]))))
    assert np.hypot(*force[:, 0]) <= grip * (1 + 1e-5)
    assert force[1, 0] * across <= 0


@pytest.mark.parametrize("name", ["f1tenth_ros", "aiml_head"])
def test_a_sliding_vehicle_loses_energy(name):
    """Tyres and losses take energy from a vehicle without drive, forwards, backwards and sideways."""
    car = params(name)
    rng = np.random.default_rng(0)
    for _ in range(20):
        speed, side, turn, steer = rng.uniform(-1, 1, 4) * [8, 8, 20, 0.5]
        s = create_state(speed, side, turn, steer)
        rate = jax.tree.map(np.asarray, RATES["single_track"](s, np.array([0.0, steer]), car))
        mass, inertia = np.asarray(car.mass)[0], np.asarray(car.yaw_inertia)[0]
        power = mass * np.sum(s.body_vel * rate.body_vel) + inertia * turn * rate.yaw_rate[0]
        assert power < 0


@functools.partial(jax.jit, static_argnums=0)
def slopes_of(model, s, command, car):
    def total(s, command):
        return sum(jnp.sum(x) for x in jax.tree.leaves(MODELS[model](s, command, car)))

    return jax.grad(total, argnums=(0, 1))(s, command)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", ["f1tenth_ros", "aiml_head", "bicycle"])
def test_rest_stays_at_rest_with_finite_gradients(model, name):
    if model == "single_track" and name == "bicycle":
        model = "kinematic"
    car = params(name, trailer=name == "aiml_head")
    rest = create_state(0, 0, joints=np.zeros(2) if name == "aiml_head" else None)
    rate = RATES[model](rest, np.zeros(2), car)
    assert all(np.all(np.asarray(x) == 0) for x in jax.tree.leaves(rate))
    for speed, side, turn, steer, d in ((0, 0, 0, 0, 0), (-3, 2, 1, 0.4, 0.3), (9, -9, 30, -0.5, -1), (0, 5, 0, 0, 0)):
        s = create_state(speed, side, turn, steer, joints=rest.joints)
        slopes = slopes_of(model, s, np.array([d, 0.1]), car)
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slopes))


@pytest.mark.parametrize("model", MODELS)
def test_gradients_equal_central_differences(model):
    with jax.enable_x64(True):
        car = jax.tree.map(lambda x: np.asarray(x, np.float64), params())
        command, h = np.array([0.1, 0.15]), 1e-6

        @jax.jit
        def end(command):
            def step(s, _):
                return after_step(model, car, s, command, 500.0), None

            last, _ = jax.lax.scan(step, create_state(1.0), None, length=200)
            return last.pos @ np.array([1.0, 2.0, 0.0]) + last.yaw[0]

        slope = np.asarray(jax.jit(jax.grad(end))(command))
        for k, step in enumerate(h * np.eye(2)):
            assert slope[k] == pytest.approx(float(end(command + step) - end(command - step)) / (2 * h), rel=1e-6)


def test_the_drive_holds_the_speed_at_which_its_forces_are_balanced():
    """``gain d = damping v + friction`` at constant speed."""
    end = end_of("single_track", params(), create_state(1.0), [0.1, 0.0], 12.0)
    assert float(end.body_vel[0]) == pytest.approx((8.3592 - 0.8656) / 4.0304, rel=2e-3)
    # At full reference the lab's motors give their largest torque, most of which accelerates their own rotors.
    one = np.ones(1, np.float32)
    force = np.asarray(jax.jit(drive_force)(one, one, params("aiml_head")))[0]
    motors, losses = 4 * 2.0 / 0.052388, 4 * 1e-5 / 0.052388**2 + 4 * 0.01 / 0.052388 / np.hypot(1, 0.1)
    assert force == pytest.approx((motors - losses) * 3.4 / (3.4 + 4 * (0.05 / 0.052388**2 + 0.05)), rel=1e-5)


def test_steering_keeps_its_limits():
    rate = RATES["single_track"](create_state(), np.array([0.0, 9.0]), params()).steer
    np.testing.assert_allclose(rate, [3.2], rtol=1e-6)
    end = end_of("single_track", params(), create_state(), [0.0, 9.0], 1.0)
    np.testing.assert_allclose(end.steer, [0.5], rtol=1e-5)


wheels_of = jax.jit(ackermann)


@given(st.floats(-0.6, 0.6, allow_subnormal=False))
@settings(deadline=None, max_examples=30)
def test_ackermann_axes_meet_on_the_rear_axle(steer):
    """Each front wheel is perpendicular to the line to the centre of the turn."""
    left, right = np.asarray(wheels_of(np.array([steer]), 0.331, 0.24))
    centre = 0.331 / np.tan(steer) if steer else np.inf
    np.testing.assert_allclose(np.tan(left), 0.331 / (centre - 0.12), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(np.tan(right), 0.331 / (centre + 0.12), rtol=1e-4, atol=1e-6)


def test_ackermann_of_the_fact_sheet():
    left, right = np.asarray(wheels_of(np.array([0.3]), 0.32226, 0.24477))
    assert (round(float(left), 3), round(float(right), 3)) == (0.337, 0.270)


def test_a_trailer_follows_on_its_own_circle():
    """In steady cornering hitch, front and rear axle are on circles: each radius and its rod make a right angle."""
    car, steer = params("aiml_head", True), 0.2
    end = end_of("kinematic", car, create_state(joints=np.zeros(2)), [0.05, steer], 30.0)
    hitch, drawbar, axles = np.asarray(car.trailer)
    radius = 0.32226 / np.tan(steer)  # of the middle of the rear axle
    at_hitch = np.hypot(radius, hitch - 0.16113)
    at_front = np.sqrt(at_hitch**2 - drawbar**2)
    bar, deck = float(end.yaw[0] - end.joints[0]), float(end.joints[0] - end.joints[1])
    assert bar == pytest.approx(np.arctan((hitch - 0.16113) / radius) + np.arcsin(drawbar / at_hitch), rel=1e-3)
    assert deck == pytest.approx(np.arcsin(axles / at_front), rel=1e-3)
