"""The loop of every script: send a command, take a control step of 5 physics steps, read the positions into NumPy.

    python benchmarks/loop.py [--device gpu] [--worlds 1 64 1024 16384] [--controls state attitude]

One JSON line for each command level and number of worlds, with the median and the shortest time of an iteration.
``loop/contacts`` asks for the contacts instead of the positions. The lines ``loop/jax`` show how much of this time JAX
takes: one compiled addition to as many positions, read into NumPy. The last line is the loop of C MuJoCo with one free
box: set its force, take 5 ``mj_step``, read its position.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable

import jax
import mujoco
import numpy as np
from measure import is_flying, report, start_hovering

from crazysim import Sim

N_STEPS = 5
"""Physics steps per command: 100 commands per second at 500 Hz."""
N_ITERATIONS = 50
"""Iterations of a repeat, 0.5 s of flight."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64, 1024, 16384])
    parser.add_argument("--controls", nargs="+", default=["state", "attitude"])
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    for control, n_worlds in itertools.product(args.controls, args.worlds):
        sim = Sim(n_worlds, control=control, device=args.device)
        start_hovering(sim, control)
        initial_data, command = sim.data, np.asarray(getattr(sim.data.controls, control).staged_cmd)
        send_command = getattr(sim, f"{control}_control")

        def reset(sim: Sim = sim, initial_data=initial_data) -> None:
            sim.data = initial_data

        reads = {"loop": lambda sim=sim: sim.data.states.pos, "loop/contacts": lambda sim=sim: sim.contacts()}
        for name, read in reads.items():

            def iterate(sim: Sim = sim, command=command, send_command=send_command, read=read) -> None:
                send_command(command)
                sim.step(N_STEPS)
                np.asarray(read())

            times = measure_times(reset, iterate, args.repeats)
            if not is_flying(sim):
                raise RuntimeError("the drones crashed; a crashed drone costs less to simulate")
            realtime = N_STEPS / sim.freq * n_worlds / times["iteration_s"]
            report(args.device, benchmark=name, control=control, n_worlds=n_worlds, **times, realtime=realtime)
    for n_worlds in args.worlds:
        report(
            args.device,
            benchmark="loop/jax",
            n_worlds=n_worlds,
            **measure_times(*jax_loop(args.device, n_worlds), args.repeats),
        )
    report("cpu", benchmark="loop/mj_step", n_worlds=1, **measure_times(*mujoco_loop(), args.repeats))


def measure_times(reset: Callable[[], None], iterate: Callable[[], None], repeats: int) -> dict[str, float]:
    """Return the median and the shortest time of an iteration, s, over repeats that each begin with a reset."""
    reset()
    iterate()
    times = []
    for _ in range(repeats):
        reset()
        for _ in range(N_ITERATIONS):
            start_time = time.perf_counter()
            iterate()
            times.append(time.perf_counter() - start_time)
    return {"iteration_s": float(np.median(times)), "shortest_s": min(times)}


def jax_loop(device: str, n_worlds: int) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return the reset and the iteration of a loop that adds one to ``n_worlds`` positions and reads them."""
    positions = jax.device_put(np.zeros((n_worlds, 1, 3), np.float32), jax.devices(device)[0])
    plus_one = jax.jit(lambda x: x + 1.0)

    def iterate() -> None:
        np.asarray(plus_one(positions))

    return iterate, iterate


def mujoco_loop() -> tuple[Callable[[], None], Callable[[], None]]:
    """Return the reset and the iteration of a loop of C MuJoCo with one box that a force holds up."""
    xml = '<mujoco><worldbody><body><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    force = np.array([0.0, 0.0, -model.opt.gravity[2] * model.body_mass[1]])

    def iterate() -> None:
        data.xfrc_applied[1, :3] = force
        mujoco.mj_step(model, data, N_STEPS)
        data.qpos[:3].copy()

    return lambda: mujoco.mj_resetData(model, data), iterate


if __name__ == "__main__":
    main()
