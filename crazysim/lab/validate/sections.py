"""Sections of the validation page."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from crazysim.lab.validate import (
    any_airframe,
    by_sight,
    closed_forms,
    commonroad_cars,
    firmware_controllers,
    firmware_filters,
    flights,
    logged_filter,
    peers,
    rotorpy_flights,
    sim_to_sim,
)
from crazysim.lab.validate.rows import Section

NAMES = (
    "closed", "mujoco", "firmware", "crazyflow", "rotorpy", "commonroad", "idsia", "nanobench", "filter", "any",
    "sim2sim", "sight",
)  # fmt: skip
"""Names of the sections."""
RAPTOR = {"foundation_policy": "foundation-policy==1.0.2"}
"""Package of the foundation policy."""


def sections(data: Path | None = None, policy: Path | None = None) -> Sequence[Section]:
    """Return the sections of the page.

    Args:
        data: Folder with logs in ``idsia`` and ``nanobench``; None for no logs.
        policy: Policy of the section ``any``, see ``any_airframe.checks``, or run of ``forest`` for ``sight``.
    """
    forest_runs = by_sight.find_runs(data, policy)
    policy = None if policy in forest_runs else policy
    idsia, nanobench = ((data or Path()) / name for name in ("idsia", "nanobench"))

    def data_problem(folder: Path) -> str:
        if data is None:
            return "give `--data FOLDER`"
        return "" if folder.is_dir() else f"FOLDER has no folder {folder.name}"

    return (
        Section(
            "closed", "Closed forms and orders",
            "In float64, at 500 Hz; orders of integrators are estimated from several rates.", closed_forms.CHECKS,
        ),
        Section(
            "mujoco", "C MuJoCo", "In float64, steps of 1 ms.", (peers.compare_with_mujoco,),
        ),
        Section(
            "firmware", "The Crazyflie's firmware",
            "Recorded outputs of its compiled C sources, on the same inputs, in float32; the recordings are in "
            "tests/control and tests/plugins/estimators of a checkout. Figures are the largest differences: of motors "
            "in 8 flights, where full thrust is 65,535, and of filters over whole flights, in which rounding adds up. "
            "Those of the Kalman filter last 4 s, with up to 5.4 m/s and tilts of up to 62 degrees, except on the "
            "ground; `flow` has no other sensor, `range` has flow and time of flight. Differences of covariances are "
            "relative to their size plus 1e-5.",
            (firmware_controllers.compare_controllers, firmware_filters.compare_filters),
            data_problem="" if firmware_controllers.RECORDINGS.is_dir() else "run it in a checkout of the sources",
        ),
        Section(
            "crazyflow", "Crazyflow", "In float32, Crazyflow's controllers in both programs.",
            (peers.compare_with_crazyflow,),
            packages={"crazyflow": "crazyflow==0.4.0"},
        ),
        Section(
            "rotorpy", "RotorPy",
            "RotorPy's Crazyflie 2.0, in float64, with commands of the rotors within 2% of hover that change every 0.1 "
            "s. In moving air crazysim's drone has `RotorAerodynamics` with RotorPy's coefficients. Forces across the "
            "rotors are the same. Along the rotors RotorPy's thrust falls linearly with the velocity, and crazysim's "
            "thrust follows momentum theory, with the lift of forward flight. The wind is (3, -1, 0.5) m/s.",
            (rotorpy_flights.compare_with_rotorpy,), packages={"rotorpy": "rotorpy==3.0.0"},
        ),
        Section(
            "commonroad", "CommonRoad",
            "The single-track car of CommonRoad's vehicle models, in float64: `commonroad_single_track` has the same "
            "equations above 0.5 m/s (slower, CommonRoad's model becomes kinematic at 0.1 m/s). `single_track` is the "
            "model of our cars, whose tyres have limited grip and loads that do not shift. The lane changes begin at "
            "15 m/s.",
            (commonroad_cars.compare_with_commonroad,), packages={"vehiclemodels": "commonroad-vehicle-models==3.0.2"},
        ),
        Section(
            "idsia", "Real flights, open loop",
            "A Crazyflie 2.1 Brushless of 45 g predicted from its measured rotor speeds: flight melon of IDSIA's "
            "benchmark, starts every 0.05 s, mean distances and angles. The published figures are of the same measure, "
            "over three such flights, from `results/model_comparison.ipynb` of the benchmark's repository at commit "
            "2d921b5. Its rigid body keeps the body rates of the start, since `models/models.py` multiplies the "
            "angular acceleration by zero: compare it with our rows at constant body rates, where the airframe gives "
            "the forces alone.\n\n"
            "With its own torques `cf21B_500` loses the attitude within 0.25 s. Below 1 Hz, the torque of the rotors "
            "about x and y is 15 to 27 times the torque that the angular acceleration needs; in flights of squares it "
            "is 2 to 3 times that torque. It balances a torque of the air that grows with the velocity. The airframe "
            "does not have this torque of the air, so its prediction turns over. "
            "docs/results.md of the sources has the details.",
            (partial(flights.open_loop, idsia),), data_problem=data_problem(idsia), needs_logs=True,
            axes=("prediction over, s", "mean error"),
        ),
        Section(
            "nanobench", "Real flights, closed loop",
            "A Crazyflie 2.1: NanoBench. The simulated drone `cf2x_L250` follows the logged setpoints with the "
            "firmware's controller and filter. The figure is the RMS distance of the simulated drone from the "
            "setpoint, divided by the RMS distance of the real drone.",
            (partial(flights.closed_loop, nanobench),), data_problem=data_problem(nanobench), needs_logs=True,
            axes=("", "error of the simulation over that of the flight"),
        ),
        Section(
            "filter", "Real flights, the filter",
            "The firmware's Kalman filter, with its default deviations of motion capture (0.01 m, 0.0045 rad), on the "
            "logged accelerometer, gyroscope and motion capture of NanoBench. The figure is its RMS error against "
            "motion capture, divided by the RMS error of the filter on board, whose deviations are not published. Here "
            "the attitude of motion capture is a measurement, too. Flights more than 2 m from their setpoint are left "
            "out.\n\n"
            "The z axis of the tracked body is off the axis of the thrust by 0.4 to 4.2 degrees, 1.1 in the median, "
            "differently in each flight. Attitudes of motion capture are turned by this angle before the filter "
            "measures them and before both filters are compared with them. This lowers the attitude error of the "
            "filter on board in each flight, from 2.1 to 1.6 degrees in the median. The angle is computed from the "
            "mean thrust over the whole flight, which no filter has in flight. With the thrust of the first 3 s in the "
            "air the largest ratio is 1.17.",
            (partial(logged_filter.compare_filter, nanobench),), data_problem=data_problem(nanobench), needs_logs=True,
            axes=("", "error over that of the filter on board"),
        ),
        Section(
            "any", "Policies for any airframe", any_airframe.SECTION_TEXT, any_airframe.checks(policy), packages=RAPTOR,
            peers=any_airframe.PEERS,
        ),
        Section(
            "sim2sim", "Sim to sim", sim_to_sim.SECTION_TEXT, sim_to_sim.checks(data),
            packages={"onnx": "onnx", "onnxruntime": "onnxruntime", "optax": "optax"}, peers=sim_to_sim.PEERS,
        ),
        Section(
            "sight", "Sim to sim, by sight", by_sight.SECTION_TEXT, by_sight.checks(forest_runs),
            packages={"optax": "optax"},
            data_problem="" if forest_runs else "give `--policy` with a run of the task `forest`",
        ),
    )  # fmt: skip
