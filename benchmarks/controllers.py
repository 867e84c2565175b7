"""Controllers compared on the same flights: tracking, disturbance and cost, one line each.

    python benchmarks/controllers.py [--device gpu] [--drone cf21B_500] [--controllers geometric indi ...] [--speed 2]

- tracking_rms: figure eight of 2 m, 2 m/s in its middle, from a matching start, RMS distance over 9 s, m
- from_rest_rms: the same from hover at its middle, over the last 6 of 9 s, m
- pushed: hover under a sideways force of a tenth of the weight from 2 s on, distance at its largest and after 8 s, m
- steps_per_s: physics steps of many worlds that hover, in calls of 100 steps; without, with --worlds 0

load_lqr carries 0.2 kg on a rod of 0.4 m; its distances are those of the load. It needs a drone that lifts that, such
as bumblebee.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import digits, engine_of, medians, report, seconds

from crazysim import Sim, SlungLoad
from crazysim.control import LoadLQR, TrackingLQR
from crazysim.dynamics import first_principles
from crazysim.trajectories import Follow, figure_eight, hover

CONTROLLERS = ("crazyflow", "mellinger", "pid", "geometric", "lqr", "tracking_lqr", "indi")
LOAD_MASS, LENGTH = 0.2, 0.4
"""Mass of the load of load_lqr, kg, and length of its rod, m."""
KNOTS = 0.15
"""Time between gains of tracking_lqr, s; 60 of them last 9 s."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--drone", default="cf21B_500")
    parser.add_argument("--controllers", nargs="+", default=CONTROLLERS)
    parser.add_argument("--speed", type=float, default=2.0, help="largest speed along the figure eight, m/s")
    parser.add_argument("--worlds", type=int, default=16384, help="worlds of the measurement of cost; 0 for none")
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    for name in args.controllers:
        compare(name, args)


def compare(name: str, args: argparse.Namespace) -> None:
    """Print the line of one controller."""
    eight = figure_eight(2.0, 1.0, speed=args.speed, height=1.0)
    flown = distances(flight(name, args, eight, moving=True), 9.0)
    settled = distances(flight(name, args, eight, moving=False), 9.0)[1500:]
    pushed = distances(flight(name, args, hover([0, 0, 1.0]), moving=False), 10.0, 0.1)
    report(
        args.device,
        benchmark="controllers",
        controller=name,
        drone=args.drone,
        speed=args.speed,
        tracking_rms=digits(rms(flown)),
        from_rest_rms=digits(rms(settled)),
        pushed_largest=digits(float(pushed[1000:].max())),
        pushed_after=digits(float(pushed[-1])),
        **(cost(name, args) if args.worlds else {}),
    )


def cost(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """Return the rate of steps of many worlds that hover, and the engine."""
    sim = flight(name, args, hover([0, 0, 1.0]), moving=False, n_worlds=args.worlds)

    def steps() -> Any:
        sim.step(100)
        return sim.data.states.pos

    seconds(steps)
    duration = medians({"steps": lambda: seconds(steps)}, args.repeats)["steps"]
    return {"n_worlds": args.worlds, "engine": engine_of(sim), "steps_per_s": digits(args.worlds * 100 / duration)}


def controller_of(name: str, trajectory: Any) -> Any:
    """Return the argument ``controller`` of a simulation that follows a trajectory."""
    if name == "load_lqr":
        return LoadLQR(load_mass=LOAD_MASS, length=LENGTH)
    if name == "tracking_lqr":
        return TrackingLQR(jax.vmap(trajectory.evaluate)(KNOTS * np.arange(60, dtype=np.float32)), dt=KNOTS)
    return name


def flight(name: str, args: argparse.Namespace, trajectory: Any, moving: bool, n_worlds: int = 1) -> Sim:
    """Return a simulation that follows a trajectory, from its first point, with its velocity or at rest."""
    controller = controller_of(name, trajectory)
    sim = Sim(n_worlds, drone=args.drone, control="state", controller=controller, device=args.device)
    sim.add(Follow(trajectory, visible=False))
    start, s = trajectory.evaluate(jnp.float32(0)), sim.data.states
    rotors = first_principles.hover_rotor_vel(sim.data.params)
    above = jnp.array([0, 0, LENGTH if name == "load_lqr" else 0.0])
    new = {"pos": start.pos + above, "rotor_vel": rotors} | ({"vel": start.vel} if moving else {})
    placed = {key: jnp.broadcast_to(jnp.asarray(x), getattr(s, key).shape) for key, x in new.items()}
    sim.data = sim.data.replace(states=s.replace(**placed))
    if name == "load_lqr":
        sim.add(SlungLoad(mass=LOAD_MASS, length=LENGTH))
    return sim


def distances(sim: Sim, duration: float, push: float = 0.0) -> np.ndarray:
    """Return the distance from the setpoint after every step, m; under a force of ``push`` weights from 2 s on."""
    step, follow = sim.build_step_fn(), sim.plugins["follow"]
    weight = float(sim.airframe.value("rigid_body.mass", ())) * 9.81
    data, zeros = sim.data, step.zeros(sim.data)

    def fly(data: Any, force: jax.Array, n: int) -> Any:
        s = data.states
        data = data.replace(states=s.replace(force=jnp.broadcast_to(force, s.force.shape)))

        def one(data: Any, _: Any) -> Any:
            data = step(data, 1, zeros)
            t = data.core.steps[0, 0] / data.core.freq
            target = follow.read(data).trajectories.evaluate_one(0, t).pos
            carried = data.plugins.get("load", data.states)
            return data, jnp.linalg.norm(carried.pos[0, 0] - target)

        return jax.lax.scan(one, data, length=n)

    fly = jax.jit(fly, static_argnums=2)
    n_free = round(2.0 * sim.freq)
    data, first = fly(data, jnp.zeros(3), n_free)
    _, second = fly(data, jnp.array([push * weight, 0.0, 0.0]), round(duration * sim.freq) - n_free)
    return np.concatenate([first, second])


def rms(x: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


if __name__ == "__main__":
    main()
