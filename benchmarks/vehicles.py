"""Steps of cars per second: under commands, along paths, with trailers, and beside a drone.

    python benchmarks/vehicles.py [--device gpu] [--worlds 1048576] [--cases drive kinematic path] [--steps 20]
    python benchmarks/vehicles.py --errors

``alone`` is true if the pipeline of the case has no stages of drones. Cars drive on circles all the time. If they stop
or leave their circles, the script ends with an error.

With ``--errors`` it prints errors instead: the largest distances of cars from a figure eight of 6 m by 2 m in one
round, by controller, vehicle and largest speed of the path. Cars start at the speed of the path.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from measure import engine_name, medians, report, round_digits, seconds

from crazysim import Sim
from crazysim.plugins.vehicles import LPV, Cars, PathController, PathLQR, PurePursuit, Stanley
from crazysim.trajectories import circle, figure_eight

DEFAULT_WORLDS = {"cpu": 16384, "gpu": 1048576}
"""Default number of worlds on each platform."""
CASES: dict[str, dict[str, Any]] = {
    "drive": {},
    "speed": {"level": "speed"},
    "kinematic": {"vehicle": {"base": "f1tenth_ros", "model": "kinematic"}},
    "trailer": {"trailer": True},
    "path": {"path": circle(2.0, speed=1.5, height=0.0), "controller": PurePursuit()},
    "stanley": {"path": circle(2.0, speed=1.5, height=0.0), "controller": Stanley()},
    "lqr": {"path": circle(2.0, speed=1.5, height=0.0), "controller": PathLQR()},
    "beside_drone": {},
}
"""Settings of the cars in each case."""
WIDTH, DEPTH = 6.0, 2.0
"""Size of the figure eight for errors, m."""
SPEEDS = (1.2, 1.9, 3.0)
"""Largest speeds along the figure eight, m/s."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int)
    parser.add_argument("--cars", type=int, default=1, help="cars in each world")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--steps", type=int, default=100, help="physics steps of a call")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--errors", action="store_true", help="measure errors of path controllers instead of rates")
    args = parser.parse_args()
    if args.errors:
        for controller in (PurePursuit(), Stanley(), LPV(), PathLQR()):
            measure_errors(controller, args.device)
        return
    for case in args.cases:
        measure(case, args)


def measure(case: str, args: argparse.Namespace) -> None:
    n_worlds = args.worlds or DEFAULT_WORLDS["cpu" if args.device == "cpu" else "gpu"]
    sim = Sim(n_worlds, control="rotor_vel", device=args.device, engine=args.engine)
    cars = sim.add(Cars(args.cars, in_scene=False, **CASES[case]))
    if cars.path is None:
        # Speed, m/s, or at the other level the motor reference, 1; and the steering angle, rad.
        command: Any = [1.5 if cars.level == "speed" else 0.08, 0.2]
        sim.data = cars.with_command(sim.data, np.tile(np.asarray(command, np.float32), (n_worlds, args.cars, 1)))
    if case != "beside_drone":
        car_stages = {k: fn for k, fn in sim.step_pipeline.items() if k.startswith("cars") or k == "increment_steps"}
        sim.step_pipeline = type(sim.step_pipeline)(car_stages)
        sim.build_step_fn()

    def step() -> Any:
        sim.step(args.steps)
        return sim.data.plugins["cars"].pos

    compile_s = seconds(step)
    for _ in range(10):
        step()
    step_s = medians({"step": lambda: seconds(step)}, args.repeats)["step"]
    cars_record = cars.read(sim.data)
    speed, yaw_rate = np.asarray(cars_record.body_vel[..., 0]), np.asarray(cars_record.yaw_rate)
    if not (speed.min() > 0.5 and speed.max() < 3.0 and np.abs(yaw_rate).min() > 0.2):
        raise SystemExit(f"{case}: expected cars on circles, got speeds from {speed.min()} to {speed.max()} m/s")
    report(
        args.device,
        benchmark="vehicles",
        case=case,
        alone=case != "beside_drone",
        engine=engine_name(sim),
        n_worlds=n_worlds,
        n_cars=args.cars,
        n_steps=args.steps,
        compile_s=round(compile_s, 2),
        steps_per_s=round_digits(n_worlds * args.cars * args.steps / step_s),
    )


def measure_errors(controller: PathController, device: str) -> None:
    errors = {
        vehicle: [round(largest_error(controller, vehicle, speed, device), 4) for speed in SPEEDS]
        for vehicle in ("f1tenth_ros", "aiml_head")
    }
    report(device, benchmark="path_errors", controller=type(controller).__name__, speeds=SPEEDS, errors=errors)


def largest_error(controller: PathController, vehicle: str, speed: float, device: str) -> float:
    """Return the largest distance of a car from the figure eight in one round, m."""
    path = figure_eight(WIDTH, DEPTH, speed=speed, height=0.0)
    sim = Sim(control="rotor_vel", device=device)
    cars = sim.add(Cars(path=path, vehicle=vehicle, controller=controller, in_scene=False))
    car = cars.read(sim.data)
    moving_car = car.replace(
        body_vel=car.body_vel.at[..., 0].set(speed)
    )  # the path starts in its middle, the fastest point
    sim.data = sim.data.replace(plugins=sim.data.plugins | {cars.name: moving_car})
    phase = np.linspace(0.0, 2 * np.pi, 20001)
    points = np.stack([WIDTH / 2 * np.sin(phase), DEPTH / 2 * np.sin(2 * phase)], axis=-1)
    distances = []
    for _ in range(round(path.duration * sim.freq / 10)):
        sim.step(10)
        pos = np.asarray(cars.read(sim.data).pos)[0, 0, :2]
        distances.append(np.linalg.norm(points - pos, axis=-1).min())
    return float(max(distances))


if __name__ == "__main__":
    main()
