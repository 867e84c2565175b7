"""Sources of motion capture: functions, shows, threads, programs, and recordings that stay readable."""

import json
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from waiting import wait_for

from crazysim.errors import ConfigError, DamagedFileError
from crazysim.lab.live.mocap import (
    Convention,
    Frame,
    FunctionSource,
    MocapRecorder,
    MotionCaptureSource,
    Poll,
    RealTimeSource,
    ReplaySource,
    ThreadSource,
    read_polls,
    show_source,
)
from crazysim.lab.live.mocap import source as source_module
from crazysim.media.journal import Journal
from crazysim.trajectories import Trajectory, circle, line

LEVEL_QUAT = (0.0, 0.0, 0.0, 1.0)


def poses_at(t):
    return {"a": ((t, 0.0, 1.0), LEVEL_QUAT)}


def stamps(poll):
    return [frame.stamp for frame in poll.frames]


def test_a_function_is_sampled_in_simulated_time():
    source = FunctionSource(poses_at, freq=120.0)
    assert stamps(source.poll(0, 500)) == [0.0]
    assert stamps(source.poll(4, 500)) == []
    np.testing.assert_allclose(stamps(source.poll(13, 500)), np.arange(1, 4) / 120)
    assert stamps(source.poll(0, 500)) == [0.0]  # after a reset
    with pytest.raises(ConfigError, match="frames per second"):
        FunctionSource(poses_at, freq=0)


def test_a_function_has_a_convention():
    source = FunctionSource(lambda t: {"a": ((0, 1000, 0), (1, 0, 0, 0))}, convention=Convention("y", "wxyz", 0.001))
    frame = source.poll(0, 500).frames[0]
    np.testing.assert_allclose(frame.pos, [[0, 0, 1]])
    np.testing.assert_allclose(frame.quat, [LEVEL_QUAT])


def test_a_show_is_a_source():
    source = show_source([line([0, 0, 1], [2, 0, 1], 4.0), circle(radius=0.5, period=6.0)], freq=10.0)
    source.poll(0, 100)
    frame = source.poll(200, 100).frames[-1]
    assert frame.names == ("vcf0", "vcf1")
    np.testing.assert_allclose(frame.pos[0], [1, 0, 1], atol=1e-6)
    two_trajectories = Trajectory.stack([line([0, 0, 1], [2, 0, 1], 4.0), line([0, 1, 1], [2, 1, 1], 4.0)])
    assert show_source(two_trajectories, ["x", "y"]).poll(0, 100).frames[0].names == ("x", "y")
    with pytest.raises(ConfigError, match="2 different names"):
        show_source(two_trajectories, ["x", "x"])


def test_a_thread_sends_in_real_time():
    with RealTimeSource(FunctionSource(poses_at, freq=200.0)).start() as source:
        result = []
        wait_for(lambda: result.extend(source.poll(0, 500).frames) or len(result) >= 20)
    np.testing.assert_allclose(np.diff([f.stamp for f in result]), 1 / 200)
    assert result[19].received - result[0].received > 0.05


class FailingSource(ThreadSource):
    """A source that sends one frame and fails."""

    def stream(self, stop_event):
        yield Frame.of(0.0, poses_at(0.0))
        raise OSError("unplugged")


class OverflowingSource(ThreadSource):
    """A source that sends more frames than are kept."""

    def stream(self, stop_event):
        for k in range(source_module.MAX_QUEUED_FRAMES + 100):
            yield Frame.of(k, poses_at(0.0))


def test_a_failing_source_says_why():
    with FailingSource("vicon").start() as source:
        wait_for(lambda: source.ended)
        assert source.ended == "OSError: unplugged"
        assert len(source.poll(0, 500).frames) == 1


def test_lost_frames_are_counted():
    with OverflowingSource("quick").start() as source:
        wait_for(lambda: source.ended)
        poll = source.poll(0, 500)
    assert (len(poll.frames), poll.lost) == (source_module.MAX_QUEUED_FRAMES, 100)
    assert poll.frames[-1].stamp == source_module.MAX_QUEUED_FRAMES + 99


WORKER = """
import json, sys
print(json.dumps({"t": 1.5, "bodies": [["cf1", 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]]}), flush=True)
print(json.dumps(%s), flush=True)
"""
"""Program that sends one valid frame and a second output."""


@pytest.mark.parametrize(
    "second_output, reason",
    [
        ({"error": f"no connection to {sys.platform}"}, "no connection"),
        ({"t": 2.0, "bodies": [["cf1", 1.0]]}, "a name and 7 numbers"),
        ({"t": float("nan"), "bodies": []}, "expected a finite time"),
        ([1, 2], "TypeError"),
    ],
)
def test_frames_of_a_laboratory_come_from_a_process(second_output, reason, tmp_path):
    program = tmp_path / "worker.py"
    program.write_text(WORKER % repr(second_output).replace("nan", "float('nan')"))
    with MotionCaptureSource("vicon", "127.0.0.1", Convention("y"), [sys.executable, str(program)]) as source:
        wait_for(lambda: source.ended)
        (frame,) = source.poll(0, 500).frames
    assert reason in source.ended
    assert (frame.stamp, frame.names) == (1.5, ("cf1",))
    np.testing.assert_array_equal(frame.pos, [[1, -3, 2]])


def test_a_silent_process_is_ended(tmp_path):
    program = tmp_path / "worker.py"
    ended = tmp_path / "ended"
    program.write_text(f"import time\ntime.sleep(300)\nopen({str(ended)!r}, 'w')\n")
    with MotionCaptureSource("qualisys", "127.0.0.1", command=[sys.executable, str(program)]) as source:
        assert source.poll(0, 500).frames == []
    assert not ended.exists(), "it ended by itself"


@pytest.fixture
def worker(tmp_path):
    """Return a function that starts ``worker.py`` with a stand-in for the package ``motioncapture``, given as code."""

    def start_worker(motioncapture):
        (tmp_path / "motioncapture.py").write_text(motioncapture)
        path = source_module.__file__.replace("source.py", "worker.py")
        run = f"import sys, runpy; sys.path.insert(0, {str(tmp_path)!r}); runpy.run_path({path!r}, run_name='__main__')"
        return MotionCaptureSource("optitrack", "10.0.0.1", command=[sys.executable, "-c", run])

    return start_worker


def test_the_program_says_that_the_package_is_missing(worker):
    with worker("def connect(*args): raise RuntimeError('Unknown motion capture type!')") as source:
        wait_for(lambda: source.ended)
    assert "Unknown motion capture type" in source.ended


def test_the_program_prints_frames(worker):
    fake = """
class Rotation: x, y, z, w = 0.1, 0.2, 0.3, 0.9
class Body: position, rotation = [1.0, 2.0, 3.0], Rotation
class Capture:
    n, rigidBodies = 0, {"cf1": Body}
    def waitForNextFrame(self):
        self.n += 1
        if self.n > 2: raise SystemExit
def connect(system, settings):
    assert (system, settings) == ("optitrack", {"hostname": "10.0.0.1"})
    return Capture()
"""
    with worker(fake) as source:
        wait_for(lambda: source.ended)
        frames = source.poll(0, 500).frames
    assert len(frames) == 2
    np.testing.assert_array_equal(frames[0].quat, [[0.1, 0.2, 0.3, 0.9]])


def test_unknown_systems_are_refused():
    with pytest.raises(ConfigError, match="expected one of optitrack"):
        MotionCaptureSource("kinect", "127.0.0.1")


# Recordings ---------------------------------------------------------------------------------------------------------


def create_polls():
    frames = [Frame.of(k / 3, {f"cf{i}": ((k, i, 0.1), LEVEL_QUAT) for i in range(k)}, 7 + k / 3) for k in range(5)]
    return [Poll(7.0, frames[:2]), Poll(7.1, [], 4), Poll(7.2, frames[2:])]


def assert_polls_equal(computed, expected):
    assert [(p.now, p.lost, len(p.frames)) for p in computed] == [(p.now, p.lost, len(p.frames)) for p in expected]
    for a, b in zip([f for p in computed for f in p.frames], [f for p in expected for f in p.frames], strict=True):
        assert (a.stamp, a.received, a.names) == (b.stamp, b.received, b.names)
        np.testing.assert_array_equal(a.pos, b.pos)
        np.testing.assert_array_equal(a.quat, b.quat)


def write_recording(path):
    with MocapRecorder(path) as recorder:
        for poll in create_polls():
            recorder.write(poll)
    return path


def test_a_recording_holds_every_bit(tmp_path):
    assert_polls_equal(list(read_polls(write_recording(tmp_path / "a.mocap"))), create_polls())


def test_an_unfinished_recording_is_readable(tmp_path):
    recorder = MocapRecorder(tmp_path / "a.mocap")  # never closed, as after a crash
    recorder.write(create_polls()[0])
    assert_polls_equal(list(read_polls(tmp_path / "a.mocap")), create_polls()[:1])
    recorder.close()


def test_what_is_before_a_damage_is_read(tmp_path, caplog):
    path = write_recording(tmp_path / "a.mocap")
    content = path.read_bytes()
    for k in range(len(content) - 1, len(content) - 60, -7):
        path.write_bytes(content[:k])
        assert_polls_equal(list(read_polls(path)), create_polls()[:2])
        assert "cut off or damaged" in caplog.text
    path.write_bytes(content[:-9] + b"x" + content[-8:])
    assert_polls_equal(list(read_polls(path)), create_polls()[:2])


@settings(max_examples=100, deadline=None)
@given(tail=st.binary(max_size=200))
def test_bytes_after_a_recording_are_refused_or_ignored(tail, tmp_path_factory):
    path = write_recording(tmp_path_factory.mktemp("m") / "a.mocap")
    path.write_bytes(path.read_bytes() + tail)
    assert_polls_equal(list(read_polls(path)), create_polls())


def test_wrong_files(tmp_path):
    with pytest.raises(ConfigError, match="expected an existing file with a recording"):
        list(read_polls(tmp_path / "none"))
    (tmp_path / "other").write_text("hello")
    with pytest.raises(ConfigError, match="first line is not"):
        ReplaySource(tmp_path / "other")
    for kind, content in ((b"SAMP", b""), (b"POLL", b"x"), (b"NAME", b"{")):  # intact chunks of another kind
        with Journal(tmp_path / "other", replace=True) as journal:
            journal.append(kind, content)
        with pytest.raises(DamagedFileError, match=r"expected a recording of motion capture, got .*other', which"):
            list(read_polls(tmp_path / "other"))
    with pytest.raises(ConfigError, match="can be created"):
        MocapRecorder(tmp_path / "no" / "folder")
    with pytest.raises(ConfigError, match="'poll' or 'time'"):
        ReplaySource(write_recording(tmp_path / "a.mocap"), by="day")


def test_replay_by_poll_and_by_time(tmp_path):
    path = write_recording(tmp_path / "a.mocap")
    source = ReplaySource(path)
    assert source.names == ("cf0", "cf1", "cf2", "cf3")
    assert_polls_equal([source.poll(0, 500) for _ in range(3)], create_polls())
    assert source.ended
    assert source.poll(0, 500).frames == []
    source = ReplaySource(path, by="time")
    assert source.n_frames == 5
    assert source.duration == pytest.approx(4 / 3)
    assert [len(source.poll(step, 300).frames) for step in (0, 99, 101, 399, 401)] == [1, 0, 1, 2, 1]
    assert source.ended
    assert len(source.poll(0, 300).frames) == 1  # after a reset
    assert json.dumps(source.names)
