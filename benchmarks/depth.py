"""Rays per second of depth images, and the time to the first image; images in colour; or a step with a range finder.

One JSON line for each number of poles, fixed and movable, with rates by wall time (median) and by processor time
(least). To compare with another version, run this file alternately with and without the folder of that version in
PYTHONPATH.

With ``--range-finder``, drones at random positions measure six distances up to 4 m in each step.
``fraction_that_meets`` is the fraction of the four horizontal rays that meet something.

With ``--colors``, images of a ``Camera`` per second: depth, and colours with and without shadows; and gradients of
depths and colours by the positions of the cameras.

With ``--maps``, depth images, and contact reports of rooms, among rooms of 16 to 64 boxes: of one room for all worlds,
the mean of eight rooms, and of numbers of rooms from which each world has drawn one.

    python benchmarks/depth.py [--device gpu] [--worlds 64] [--size 64 64] [--poles 0 30 1000] [--range-finder]
                               [--colors] [--maps 200]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import mujoco
import numpy as np
from jax import Array
from measure import engine_name, medians, report, round_digits, seconds

from crazysim import Camera, Maps, RangeFinder, Sim, __version__
from crazysim.scene.first_hit import Targets

HALF_WIDTH = 10.0
"""Half the side of the square in which the poles stand, m."""
ROOM_WIDTH = 8.0
"""Length of the walls of a room, m."""
N_SINGLE_ROOMS = 8
"""Number of rooms that are measured one by one."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--size", type=int, nargs=2, default=(64, 64), help="width and height, pixels")
    parser.add_argument("--poles", type=int, nargs="+", default=(0, 30, 1000))
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--range-finder", action="store_true", help="time a step with a range finder, not images")
    parser.add_argument("--colors", action="store_true", help="compare images in colour with depth images")
    parser.add_argument("--maps", type=int, nargs="+", help="numbers of rooms; compare them with one room")
    args = parser.parse_args()
    if args.maps:
        report_maps(args)
        return
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
    differentiable = {"depth": cameras["depth"], "colours": Camera(*args.size, outputs=("rgb",), color_gradients=True)}

    def mean_square(pos: Array, take: Callable[[Any], dict[str, Array]]) -> Any:
        images = take(sim.data.replace(states=sim.data.states.replace(pos=pos)))
        return sum((x * x).mean() for x in images.values())

    calls = {name: partial(jax.jit(camera.image_fn(sim)), sim.data) for name, camera in cameras.items()}
    for name, camera in differentiable.items():
        gradient = jax.jit(jax.grad(partial(mean_square, take=camera.image_fn(sim))))
        calls[f"gradient of {name}"] = partial(gradient, sim.data.states.pos)
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


def report_maps(args: argparse.Namespace) -> None:
    rng, n, size = np.random.default_rng(0), args.worlds, tuple(args.size)
    rooms = [random_room(rng) for _ in range(max(N_SINGLE_ROOMS, *args.maps))]
    pos, yaw = rng.uniform([-3, -3, 0.3], [3, 3, 2], (n, 1, 3)), rng.uniform(-np.pi, np.pi, (n, 1))
    quat = np.stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)], axis=-1)
    poses = {"pos": pos.astype(np.float32), "quat": quat.astype(np.float32)}
    for n_maps in (1, *args.maps):
        cases = [[room] for room in rooms[:N_SINGLE_ROOMS]] if n_maps == 1 else [rooms[:n_maps]]
        numbers = [measure_rooms(case, poses, size, args) for case in cases]
        means = {name: round_digits(float(np.mean([x[name] for x in numbers]))) for name in numbers[0]}
        report(
            args.device, benchmark="maps", n_maps=n_maps, n_worlds=n, width=size[0], height=size[1], **means,
            crazysim=__version__,
        )  # fmt: skip


def measure_rooms(
    rooms: list[mujoco.MjSpec], poses: dict[str, np.ndarray], size: tuple[int, int], args: argparse.Namespace
) -> dict[str, float]:
    """Return rates of depth images and contact reports, the time of their first calls, and the bytes of the tables."""
    sim = Sim(args.worlds, control="attitude", device=args.device)
    if len(rooms) == 1:
        sim.scene.add(rooms[0], "room", mocap=False)
    else:
        sim.add(Maps(rooms))
        sim.reset()
    sim.data = sim.data.replace(states=sim.data.states.replace(**poses))
    calls = {
        "images": partial(sim.depth, "fpv_cam", *size, drones=False),
        "contacts": partial(sim.contact_report, floor=False, drones=False),
    }
    start_time = time.perf_counter()
    jax.block_until_ready([call() for call in calls.values()])
    result = {"first_s": time.perf_counter() - start_time}
    times = medians({name: partial(seconds, call) for name, call in calls.items()}, args.repeats)
    for name, call in calls.items():
        result[f"{name}_per_s"] = args.worlds / times[name]
        if args.device == "cpu":
            result[f"{name}_per_processor_s"] = args.worlds / min(processor_seconds(call) for _ in range(args.repeats))
    tables = Targets(sim.scene.visual_model, 1, drones=False).build_fixed_hierarchy(np.float32)
    return result | {"table_bytes": sum(x.nbytes for x in tables)}


def random_room(rng: np.random.Generator) -> mujoco.MjSpec:
    """Return a room of 8 x 8 m with 4 walls, and boxes on its floor, 16 to 64 together."""
    room, half = mujoco.MjSpec(), ROOM_WIDTH / 2
    for k in range(4):
        side, angle = 1 - 2 * (k % 2), np.pi / 2 * (k // 2)
        wall = [side * half * np.cos(angle), side * half * np.sin(angle), 1.25]
        room.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=wall, size=[0.05, half, 1.25], euler=[0, 0, np.degrees(angle)]
        )
    for _ in range(rng.integers(12, 61)):
        half_sizes = rng.uniform(0.1, 0.4, 3) * [1, 1, 2]
        pos = [*rng.uniform(-half, half, 2), half_sizes[2]]
        room.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=pos, size=half_sizes, euler=[0, 0, rng.uniform(0, 360)]
        )
    return room


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
