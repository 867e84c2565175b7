"""The state estimator on logs: errors of known size are found, and crashed flights are left out."""

import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.lab.validate.logged_filter import compare_filter, estimate_errors, read_filter_log

RNG = np.random.default_rng(0)


TILT_QUAT = np.array([0.02, -0.03, 0.0, 0.9993])
"""Attitude of the tracked body of a level drone, xyzw: 4.1 degrees off."""


def write_log(path, height_error=0.0, n=600):
    """Write a log of a hover whose filter on board is 3 cm and 10 degrees off; motion capture scatters by 1 mm.

    The tracked body is tilted against the drone. The setpoint is ``height_error``, m, above the drone.
    """
    columns = {k: np.zeros(n) for k in ("sp_ctrltarget_x", "sp_ctrltarget_y", "imu_acc_x", "imu_acc_y")}
    columns |= {f"imu_gyro_{k}": np.zeros(n) for k in "xyz"} | {
        f"q{k}": np.full(n, v) for k, v in zip("xyzw", TILT_QUAT, strict=True)
    }
    columns |= {
        f"att_stateEstimate_q{k}": np.full(n, v)
        for k, v in zip("xyzw", (0, 0, np.sin(np.radians(5)), np.cos(np.radians(5))), strict=True)
    }
    columns |= {f"p{k}": v + 0.001 * RNG.normal(size=n) for k, v in zip("xyz", (0.0, 0.0, 1.0), strict=True)}
    columns |= {f"est_stateEstimate_{k}": columns[f"p{k}"] + (0.03 if k == "x" else 0.0) for k in "xyz"}
    columns |= {"imu_acc_z": np.ones(n), "sp_ctrltarget_z": np.ones(n) + height_error}
    np.savez(path, **columns)


def test_a_hover_is_estimated_better_than_by_a_filter_that_is_off(tmp_path):
    write_log(tmp_path / "hover.npz")
    write_log(tmp_path / "crashed.npz", height_error=3.0)
    log = read_filter_log(tmp_path / "hover.npz")
    # The scatter moves the mean thrust by 1 mm / (2 * 0.01 s) / 4 s, 0.1 degrees.
    np.testing.assert_allclose(estimate_errors(log, log["est_pos"], log["est_quat"]), [0.03, 10.0], rtol=1e-3)
    np.testing.assert_allclose(np.degrees(2 * log["quat"][:, :3]), 0, atol=0.2)
    position, attitude = compare_filter(tmp_path)
    assert "hover" in position.quantity
    assert position.figure < 0.1  # scatter of sqrt(3) mm at most, of 30
    assert attitude.figure < 0.1


def test_a_log_without_a_flight_is_a_row(tmp_path):
    write_log(tmp_path / "hover.npz")
    write_log(tmp_path / "rest.npz", height_error=-1.0)
    *flown, failed = sorted(compare_filter(tmp_path), key=lambda row: row.failed)
    assert "expected a setpoint above the floor" in failed.problem
    assert len(flown) == 2


def test_other_logs_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", t=0.01 * np.arange(9))
    with pytest.raises(ConfigError, match="got no imu_acc_x"):
        read_filter_log(tmp_path / "other.npz")
