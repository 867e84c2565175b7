"""The record of a trajectory, against polynomials of NumPy and SciPy in float64."""

import jax
import numpy as np
import pytest
from scipy.interpolate import PPoly

from crazysim.errors import ConfigError
from crazysim.trajectories import Trajectory

pytestmark = pytest.mark.usefixtures("x64")

DERIVATIVES = ("pos", "vel", "acc", "jerk", "snap")
YAW = ("yaw", "yaw_rate", "yaw_acc")
on_device = jax.jit(jax.vmap(Trajectory.evaluate, in_axes=(None, 0)))


def evaluate(trajectory, t):
    return jax.tree.map(np.asarray, on_device(trajectory, t))


def random_pieces(n_pieces=5, degree=7, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.2, 2.0, n_pieces), rng.normal(size=(n_pieces, 4, degree + 1))


def derivatives_by_scipy(durations, c, t, order):
    """Return the derivative of all axes at times within the trajectory. (n, 4)"""
    curves = PPoly(np.moveaxis(c[..., ::-1], -1, 0), np.concatenate([[0], np.cumsum(durations)]))
    return curves.derivative(order)(t) if order else curves(t)


def check_same(setpoint, durations, c, t, rtol=1e-10):
    for order, name in enumerate(DERIVATIVES):
        np.testing.assert_allclose(
            getattr(setpoint, name), derivatives_by_scipy(durations, c, t, order)[:, :3], rtol, 1e-9, name
        )
    for order, name in enumerate(YAW):
        np.testing.assert_allclose(
            getattr(setpoint, name), derivatives_by_scipy(durations, c, t, order)[:, 3:], rtol, 1e-9, name
        )


@pytest.mark.parametrize("n_pieces", [1, 2, 3, 5, 8, 13])
@pytest.mark.parametrize("degree", [0, 1, 3, 7, 9])
def test_position_yaw_and_derivatives_equal_those_of_the_polynomials(n_pieces, degree):
    durations, c = random_pieces(n_pieces, degree)
    t = np.linspace(0, durations.sum() * (1 - 1e-9), 41)
    check_same(evaluate(Trajectory.of_pieces(durations, c), t), durations, c, t)


def test_where_two_pieces_meet_the_later_one_is_evaluated():
    trajectory = Trajectory.of_pieces([1, 2, 1], np.arange(3.0)[:, None, None] * np.ones((1, 4, 1)))
    s = evaluate(trajectory, np.array([0, 1 - 1e-9, 1, 3 - 1e-9, 3, 4, 9]))
    np.testing.assert_array_equal(s.pos[:, 0], [0, 0, 1, 1, 2, 2, 2])


def test_before_the_start_and_after_the_end_a_trajectory_is_at_rest():
    durations, c = random_pieces()
    trajectory, end = Trajectory.of_pieces(durations, c), durations.sum()
    s = evaluate(trajectory, np.array([-1e9, -1e-9, end + 1e-9, 1e9]))
    first, last = (derivatives_by_scipy(durations, c, np.array([t]), 0)[0] for t in (0, end))
    np.testing.assert_allclose(np.concatenate([s.pos, s.yaw], 1), [first, first, last, last], rtol=1e-9)
    for name in ("vel", "acc", "jerk", "snap", "yaw_rate", "yaw_acc"):
        np.testing.assert_array_equal(getattr(s, name), np.zeros_like(getattr(s, name)))


def test_a_trajectory_that_repeats_starts_again():
    durations, c = random_pieces()
    trajectory, end = Trajectory.of_pieces(durations, c, repeats=True), durations.sum()
    t = np.linspace(0.001, 0.999, 17) * end
    check_same(evaluate(trajectory, t + 3 * end), durations, c, t, rtol=1e-7)
    before = evaluate(trajectory, np.array([-0.5]))
    np.testing.assert_allclose(before.pos[0], c[0, :3, 0])
    np.testing.assert_array_equal(before.vel, np.zeros((1, 3)))


def test_stacked_trajectories_keep_their_setpoints_within_and_beyond_their_ends():
    pieces = [random_pieces(1, 7, 1), random_pieces(4, 3, 2), random_pieces(6, 5, 3)]
    trajectories = [Trajectory.of_pieces(*p, repeats=k == 1) for k, p in enumerate(pieces)]
    stacked = Trajectory.stack(trajectories)
    assert stacked.coefficients.shape == (3, 6, 4, 8)
    assert (stacked.n_pieces, stacked.degree, stacked.duration.shape) == (6, 7, (3,))
    for k, (trajectory, (durations, _)) in enumerate(zip(trajectories, pieces, strict=True)):
        end = durations.sum()
        t = np.concatenate([np.linspace(-1, end + 2, 50), [end, np.nextafter(end, 0), np.nextafter(end, 9e9)]])
        from_stack = jax.tree.map(lambda x, k=k: np.asarray(x)[k], stacked)
        expected, result = (evaluate(x, t) for x in (trajectory, from_stack))
        inside = (t < end - 1e-9) | (t > end + 1e-9) | (k == 1)  # at the end itself padding is already at rest
        for x, y in zip(jax.tree.leaves(expected), jax.tree.leaves(result), strict=True):
            np.testing.assert_allclose(x[inside], y[inside], atol=1e-9)
        np.testing.assert_allclose(expected.pos, result.pos, atol=1e-9)


def test_then_appends_a_trajectory():
    (d1, c1), (d2, c2) = random_pieces(2, 3, 1), random_pieces(3, 7, 2)
    joined = Trajectory.of_pieces(d1, c1).then(Trajectory.of_pieces(d2, c2))
    t = np.linspace(0, d1.sum() + d2.sum() - 1e-9, 60)
    c = np.concatenate([np.pad(c1, ((0, 0), (0, 0), (0, 4))), c2])
    check_same(evaluate(joined, t), np.concatenate([d1, d2]), c, t)
    endless = Trajectory.of_pieces(d1, c1, repeats=True)
    with pytest.raises(ConfigError, match=r"got a second one that repeats.*repeat\(1\) for one round"):
        joined.then(endless)
    with pytest.raises(ConfigError, match="got a first one that repeats"):
        endless.then(joined)


def test_repeat_gives_rounds_that_end():
    durations, c = random_pieces(3, 5)
    endless, end = Trajectory.of_pieces(durations, c, repeats=True), durations.sum()
    three = endless.repeat(3)
    t = np.concatenate([np.linspace(0, 3 * end, 50)[:-1], [3 * end + 1.0]])
    check_same(evaluate(three, t[:-1]), durations, c, t[:-1] % end, rtol=1e-9)
    np.testing.assert_allclose(evaluate(three, t).pos[-1], c[-1, :3] @ durations[-1] ** np.arange(6))
    np.testing.assert_array_equal(evaluate(three, t).vel[-1], np.zeros(3))
    np.testing.assert_allclose(evaluate(three.repeat(), t).pos, evaluate(endless, t).pos, atol=1e-9)
    for wrong in (0, -1, 1.5, True):
        with pytest.raises(ConfigError, match="number of rounds of at least 1"):
            endless.repeat(wrong)


@pytest.mark.parametrize("turns", [-3, 0, 2])
def test_a_transition_connects_two_trajectories_smoothly_and_turns_the_shorter_way(turns):
    (d1, c1), (d2, c2) = random_pieces(2, 3, 1), random_pieces(3, 7, 2)
    c2[:, 3, 0] += 2 * np.pi * turns
    first, second = Trajectory.of_pieces(d1, c1).padded(4, 3), Trajectory.of_pieces(d2, c2)
    joined = first.then(second, transition=1.5)
    ends = [d1.sum(), d1.sum() + 1.5]
    assert float(joined.duration) == pytest.approx(d1.sum() + 1.5 + d2.sum())
    for t in ends:
        setpoints = evaluate(joined, np.array([t - 1e-8, t + 1e-8]))
        for name in ("pos", "vel", "acc", "jerk", "yaw", "yaw_rate", "yaw_acc"):
            before, after = getattr(setpoints, name)
            np.testing.assert_allclose(before, after, atol=2e-4, err_msg=name)  # 2e-8 s of derivatives up to 1e4
    at_start = evaluate(joined, np.array([ends[1]]))
    np.testing.assert_allclose(at_start.pos[0], c2[0, :3, 0], atol=1e-9)
    turned = evaluate(joined, np.array(ends)).yaw[:, 0]
    assert abs(turned[1] - turned[0]) <= np.pi + 1e-9
    np.testing.assert_allclose(np.exp(1j * turned[1]), np.exp(1j * c2[0, 3, 0]), atol=1e-9)
    for wrong in (-1.0, np.inf, "long"):
        with pytest.raises(ConfigError, match="transition from 0 to"):
            first.then(second, transition=wrong)


@pytest.mark.parametrize("traced", [False, True])
def test_moving_turns_and_shifts_positions_and_turns_derivatives(traced):
    durations, c = random_pieces()
    trajectory, offset, yaw = Trajectory.of_pieces(durations, c), np.array([1.0, -2.0, 3.0]), 0.7
    move = jax.jit(Trajectory.moved) if traced else Trajectory.moved
    t = np.linspace(-0.3, durations.sum() + 0.3, 30)
    before, after = (evaluate(x, t) for x in (trajectory, move(trajectory, offset, yaw)))
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    np.testing.assert_allclose(after.pos, before.pos @ turn.T + offset, atol=1e-9)
    np.testing.assert_allclose(after.yaw, before.yaw + yaw, atol=1e-12)
    for name in DERIVATIVES[1:]:
        np.testing.assert_allclose(getattr(after, name), getattr(before, name) @ turn.T, atol=1e-9)
    np.testing.assert_allclose(after.yaw_rate, before.yaw_rate, atol=1e-12)


def test_float32_keeps_a_minute_of_long_pieces_to_a_hundredth_of_a_millimetre():
    """Coefficients of seconds would reach 60^7 = 3e12 in size; coefficients of the scaled time are positions."""
    t_end, n = 60.0, 8
    c = np.zeros((1, 4, n))
    c[0, :3, :4] = np.array([0, 0, 3 / t_end**2, -2 / t_end**3]) * np.array([[5.0], [-4.0], [2.0]])
    t = np.linspace(0, t_end, 500)
    exact = derivatives_by_scipy([t_end], c, t, 0)[:, :3]
    with jax.enable_x64(False):
        trajectory = Trajectory.of_pieces([t_end], c)
        assert trajectory.coefficients.dtype == np.float32
        s = jax.jit(jax.vmap(trajectory.evaluate))(t.astype(np.float32))
        assert s.snap.dtype == np.float32
        np.testing.assert_allclose(s.pos, exact, atol=1e-5)
