"""The tracker of motion capture: frames that are late, lost, repeated, wrong or out of order."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazysim.errors import ConfigError
from crazysim.lab.live.mocap import Frame, Rules, Tracker

LEVEL_QUAT = (0.0, 0.0, 0.0, 1.0)


def create_frame(t, received=None, quat=LEVEL_QUAT, **positions):
    return Frame.of(t, {name: (pos, quat) for name, pos in positions.items()}, received)


def create_tracker(n=40, freq=100.0):
    """Return a tracker that has followed a body at 1 m/s and a resting body."""
    tracker = Tracker(["a", "b"])
    for k in range(n):
        assert tracker.accept(create_frame(k / freq, a=(k / freq, 0, 1), b=(0, 5, 0)))
        tracker.advance(k / freq)
    assert not tracker.reports.latest
    return tracker, n / freq


def report_kinds(tracker):
    return [(report.kind, report.name) for report in tracker.reports.latest]


def test_poses_and_velocities():
    tracker, t = create_tracker()
    np.testing.assert_allclose(tracker.pos, [[t - 0.01, 0, 1], [0, 5, 0]])
    np.testing.assert_allclose(tracker.vel, [[1, 0, 0], [0, 0, 0]], atol=1e-9)
    assert tracker.n_frames == 40


def test_repeated_and_old_frames_are_refused():
    tracker, t = create_tracker()
    assert not tracker.accept(create_frame(t - 0.01, a=(9, 0, 1)))
    assert not tracker.accept(create_frame(t - 0.05, a=(9, 0, 1)))
    assert report_kinds(tracker) == [("repeated", "mocap"), ("backwards", "mocap")]
    assert tracker.reports.latest[1].time == t - 0.05
    np.testing.assert_allclose(tracker.pos[0], [t - 0.01, 0, 1])


def test_restarted_clock_is_accepted():
    tracker, _ = create_tracker(150)
    assert tracker.accept(create_frame(0.0, a=(3, 0, 1), b=(0, 5, 0)))
    assert report_kinds(tracker) == [("restarted", "mocap")]
    np.testing.assert_array_equal(tracker.pos[0], [3, 0, 1])
    np.testing.assert_array_equal(tracker.vel, 0)
    assert tracker.accept(create_frame(0.01, a=(3.02, 0, 1)))
    np.testing.assert_allclose(tracker.vel[0], [2, 0, 0])


def test_dropped_frames_are_counted():
    tracker, t = create_tracker()
    tracker.accept(create_frame(t + 0.03, a=(t + 0.03, 0, 1)))
    (report,) = tracker.reports.latest
    assert (report.kind, report.text) == ("dropped", "3 frames missing in 0.0400 s")
    np.testing.assert_allclose(tracker.vel[0], [1, 0, 0])


def test_late_frames_are_used():
    tracker, t = create_tracker()
    tracker.accept(create_frame(t, received=t + 0.1, a=(t, 0, 1)))
    assert report_kinds(tracker) == [("late", "mocap")]
    np.testing.assert_allclose(tracker.pos[0], [t, 0, 1])


def test_the_clock_of_the_source_may_differ():
    tracker = Tracker(["a"])
    for k in range(100):
        tracker.accept(create_frame(1e6 + k / 100, received=k / 100, a=(0, 0, 0)))
    assert not tracker.reports.latest


def test_invalid_bodies_keep_their_pose_and_others_do_not():
    tracker, t = create_tracker()
    tracker.accept(create_frame(t, a=(math.nan, 0, 1), b=(0, 5, 0.02)))
    assert report_kinds(tracker) == [("invalid", "a")]
    np.testing.assert_allclose(tracker.pos, [[t - 0.01, 0, 1], [0, 5, 0.02]])
    tracker.accept(create_frame(t + 0.01, quat=(0, 0, 0, 0), a=(t, 0, 1)))
    assert not tracker.accept(create_frame(math.inf, a=(0, 0, 0)))
    assert report_kinds(tracker)[1:] == [("invalid", "a"), ("invalid", "mocap")]


def test_a_jump_is_refused_once_and_accepted_when_it_stays():
    tracker, t = create_tracker()
    tracker.accept(create_frame(t, a=(7, 0, 1)))
    tracker.accept(create_frame(t + 0.01, a=(t + 0.01, 0, 1)))
    assert report_kinds(tracker) == [("jumped", "a")]
    np.testing.assert_allclose(tracker.pos[0], [t + 0.01, 0, 1])
    for k in range(2, 5):
        tracker.accept(create_frame(t + k / 100, a=(7, 0, 1)))
    assert report_kinds(tracker)[1:] == [("jumped", "a")] * 2 + [("relocated", "a")]
    np.testing.assert_array_equal(tracker.pos[0], [7, 0, 1])
    np.testing.assert_array_equal(tracker.vel[0], 0)


def test_frames_in_a_burst_do_not_make_a_body_fast():
    tracker, t = create_tracker()
    tracker.accept(create_frame(t, a=(t, 0, 1)))
    tracker.accept(create_frame(t + 1e-6, a=(t + 0.03, 0, 1)))
    np.testing.assert_allclose(tracker.vel[0], [10, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(tracker.pos[0], [t + 0.03, 0, 1])


def test_unknown_and_duplicate_names():
    tracker, t = create_tracker()
    frame = Frame(
        t, ("a", "ghost", "a", "b"), np.array([[9, 9, 9.0]] * 3 + [[0, 5, 0.01]]), np.tile(LEVEL_QUAT, (4, 1)), t
    )
    tracker.accept(frame)
    tracker.accept(create_frame(t + 0.01, ghost=(1, 1, 1), a=(t + 0.01, 0, 1)))
    assert report_kinds(tracker) == [("unknown", "ghost"), ("duplicate", "a")]
    np.testing.assert_allclose(tracker.pos, [[t + 0.01, 0, 1], [0, 5, 0.01]])


def test_lost_bodies_rest_until_they_are_found():
    tracker, t = create_tracker()
    for k in range(40):
        tracker.accept(create_frame(t + k / 100, b=(0, 5, 0)))
    assert report_kinds(tracker) == [("lost", "a")]
    np.testing.assert_array_equal(tracker.vel[0], 0)
    tracker.accept(create_frame(t + 0.4, a=(t + 0.4, 0, 1), b=(0, 5, 0)))
    assert report_kinds(tracker) == [("lost", "a"), ("found", "a")]
    np.testing.assert_allclose(tracker.pos[0], [t + 0.4, 0, 1])


def test_a_source_that_stalls_or_ends_is_reported():
    tracker, t = create_tracker()
    tracker.advance(t + 0.5)
    tracker.advance(t + 0.6, ended="unplugged")
    tracker.advance(t + 0.7, lost=3, ended="unplugged")
    assert [k for k, _ in report_kinds(tracker)] == ["stalled", "ended", "overrun"]
    assert tracker.stalled
    np.testing.assert_array_equal(tracker.vel, 0)
    tracker.accept(create_frame(t + 0.8, a=(t, 0, 1)))
    assert not tracker.stalled


def test_a_name_twice_is_an_error():
    with pytest.raises(ConfigError, match="different names"):
        Tracker(["a", "a"])


any_float = st.floats(allow_nan=True, allow_infinity=True)
any_frames = st.lists(
    st.tuples(
        any_float,
        st.lists(st.tuples(st.sampled_from(["a", "b", "c", ""]), st.tuples(*[any_float] * 7)), max_size=4),
    ),
    max_size=12,
)


@settings(max_examples=200, deadline=None)
@given(frames=any_frames)
def test_poses_stay_finite_whatever_arrives(frames):
    tracker = Tracker(["a", "b"], Rules())
    for stamp, bodies in frames:
        poses = np.array([p for _, p in bodies], float).reshape(-1, 7)
        tracker.accept(Frame(stamp, tuple(n for n, _ in bodies), poses[:, :3], poses[:, 3:], 0.0))
        tracker.advance(0.0)
    for x in (tracker.pos, tracker.quat, tracker.vel):
        assert np.isfinite(x.astype(np.float32)).all()
    assert np.linalg.norm(tracker.vel, axis=1).max() <= Rules().max_speed * (1 + 1e-9)
    np.testing.assert_allclose(np.linalg.norm(tracker.quat, axis=1), 1)
