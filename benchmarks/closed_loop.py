"""Closed loop compared with logs: tracking errors of simulated flights, divided by the errors of the real flights.

    python benchmarks/closed_loop.py FOLDER --drone cf2x_L250 --quat-deviation 0.06

FOLDER has logs of NanoBench (Ullah and Baca 2026, arXiv 2603.09908) as .npz files. Each simulated drone follows the
logged setpoint with the firmware's PID controller on the estimate of its filter; with ``--truth`` it uses the true
state. There is one JSON line for each log, with root mean square distances from the setpoint in m, and lags in s.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from crazysim.lab.validate.closed_loop import compare_tracking, laboratory_estimator, read_flight


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder with logs")
    parser.add_argument("--names", nargs="+", default=["circle", "figure8", "trefoil"], help="parts of names of logs")
    parser.add_argument("--drone", default="cf2x_L250", help="airframe")
    parser.add_argument("--quat-deviation", type=float, default=0.06, help="deviation of attitudes in the filter, rad")
    parser.add_argument("--truth", action="store_true", help="fly on the true state")
    args = parser.parse_args()
    paths = [path for path in sorted(args.folder.glob("*.npz")) if any(name in path.name for name in args.names)]
    if not paths:
        raise SystemExit(
            f"expected .npz files with {' or '.join(args.names)} in their names in {args.folder}, got none"
        )
    estimator = None if args.truth else laboratory_estimator(args.quat_deviation)
    for row in compare_tracking([read_flight(path) for path in paths], args.drone, estimator):
        numbers = {
            "logged_m": round(row.logged_error, 3),
            "simulated_m": round(row.simulated_error, 3),
            "ratio": round(row.ratio, 2),
            "logged_lag_s": row.logged_lag,
            "simulated_lag_s": row.simulated_lag,
            "failed": row.failed,
        }
        print(json.dumps({"benchmark": "closed_loop", "log": row.name, **numbers}), flush=True)


if __name__ == "__main__":
    main()
