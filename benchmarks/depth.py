"""Rays per second of depth images, and the time to the first image; images in colour; or a step with a range finder.

One JSON line for each number of poles, fixed and movable, with rates by wall time (median) and by processor time
(least). To compare with another version, run this file alternately with and without the folder of that version in
PYTHONPATH.

With ``--range-finder``, drones at random positions measure six distances up to 4 m in each step.
``fraction_that_meets`` is the fraction of the four horizontal rays that meet something.

With ``--colors``, images of a ``Camera`` per second: depth, and colours with and without shadows.

    python benchmarks/depth.py [--device gpu] [--worlds 64] [--size 64 64] [--poles 0 30 1000] [--range-finder]
                               [--colors]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import Array
from measure import engine_name, medians, report, round_digits, seconds

from crazysim import Camera, RangeFinder, Sim, __version__

HALF_WIDTH = 10.0
"""Half the side of the square in which the poles stand, m."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--size", type=int, nargs=2, default=(64, 64), help="width and height, pixels")
    parser.add_argument("--poles", type=int, nargs="+", default=(0, 30, 1000))
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--range-finder", action="store_true", help="time a step with a range finder, not images")
    parser.add_argument("--colors", action="store_true", help="compare images in colour with depth images")
    args = parser.parse_args()
    for n_poles, movable in [(n, movable) for n in args.poles for movable in ((False, True) if n else (False,))]:
        sim = make_scene(args.worlds, n_poles, movable, args.device)
        if args.range_finder or args.colors:
            (report_range_finder if args.range_finder else report_colors)(sim, n_poles, movable, args)
            continue
        render = partial(sim.depth, "fpv_cam", args.size[0], args.size[1])
        start_time = time.perf_counter()
        jax.block_until_ready(render())
        first_s = time.perf_counter() - start_time
        render_s = medians({"depth": partial(seconds, render)}, args.repeats)["depth"]
        processor_s = min(processor_seconds(render) for _ in range(args.repeats))
        n_rays = args.worlds * args.size[0] * args.size[1]
        report(
            args.device, benchmark="depth", n_poles=n_poles, movable=movable, n_worlds=args.worlds, width=args.size[0],
            height=args.size[1], first_s=round_digits(first_s), rays_per_s=round_digits(n_rays / render_s),
            rays_per_processor_s=round_digits(n_rays / processor_s), crazysim=__version__,
        )  # fmt: skip


def report_colors(sim: Any, n_poles: int, movable: bool, args: argparse.Namespace) -> None:
    cameras = {
        "depth": Camera(*args.size),
        "colours without shadows": Camera(*args.size, outputs=("rgb",), shadows=False),
        "colours": Camera(*args.size, outputs=("rgb",)),
    }
    calls = {name: partial(jax.jit(camera.image_fn(sim)), sim.data) for name, camera in cameras.items()}
    jax.block_until_ready([call() for call in calls.values()])
    rates = medians({name: partial(seconds, call) for name, call in calls.items()}, args.repeats)
    for name, call in calls.items():
        rate = {"images_per_s": round_digits(args.worlds / rates[name])}
        if args.device == "cpu":
            busy_s = min(processor_seconds(call) for _ in range(args.repeats))
            rate["images_per_processor_s"] = round_digits(args.worlds / busy_s)
        report(
            args.device, benchmark="colors", images=name, n_poles=n_poles, movable=movable, n_worlds=args.worlds,
            width=args.size[0], height=args.size[1], **rate, crazysim=__version__,
        )  # fmt: skip


def report_range_finder(sim: Sim, n_poles: int, movable: bool, args: argparse.Namespace) -> None:
    n, n_steps = sim.n_worlds, 20
    pos = (
        np.random.default_rng(1)
        .uniform([-HALF_WIDTH, -HALF_WIDTH, 1], [HALF_WIDTH, HALF_WIDTH, 1], (n, 1, 3))
        .astype(np.float32)
    )
    sim.add(RangeFinder())

    def steps() -> Array:
        sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
        sim.step(n_steps)
        return sim.data.states.pos

    start_time = time.perf_counter()
    jax.block_until_ready(steps())
    first_s = time.perf_counter() - start_time
    step_s = medians({"step": partial(seconds, steps)}, args.repeats)["step"] / n_steps
    processor_s = min(processor_seconds(steps) for _ in range(args.repeats)) / n_steps
    fraction_near = float(np.mean(np.asarray(sim.data.plugins["range_finder"].distance)[..., :4] < 4))
    report(
        args.device, benchmark="range_finder", n_poles=n_poles, movable=movable, n_worlds=n,
        first_s=round_digits(first_s), step_us=round_digits(1e6 * step_s),
        processor_ns_per_drone=round_digits(1e9 * processor_s / n),
        fraction_that_meets=round_digits(fraction_near), engine=engine_name(sim), crazysim=__version__,
    )  # fmt: skip


def processor_seconds(fn: Callable[[], Array]) -> float:
    """Return the processor time of a call over all threads, s. Other work on the machine hardly affects it."""
    start_time = time.process_time()
    jax.block_until_ready(fn())
    return time.process_time() - start_time


def make_scene(n_worlds: int, n_poles: int, movable: bool, device: str) -> Sim:
    """Return a simulation with one drone per world, at a height of 1 m amid poles."""
    sim = Sim(n_worlds, control="attitude", device=device)
    if n_poles:
        pos = np.zeros((n_poles, 3))
        pos[:, :2] = np.random.default_rng(0).uniform(-HALF_WIDTH, HALF_WIDTH, (n_poles, 2))
        sim.scene.add("pole", count=n_poles, pos=pos, mocap=movable)
    pos = np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), sim.data.states.pos.shape)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    return sim


if __name__ == "__main__":
    main()
