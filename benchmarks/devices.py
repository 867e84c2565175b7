"""Rates on several devices compared with one device: physics, environments, training, gradients and depth images.

    python benchmarks/devices.py [--device gpu] [--devices 1 2] [--hosts 2] [--cases physics PPO] [--processes 12]

The worlds of each device are the same for any number of devices (weak scaling), except for ``seeds``: sixteen seeds are
divided among the devices. There is a JSON line for each case and number of devices. It has the rate, the ratio of the
rate to the rate on the first number of devices, and the compile time. It also has the bytes that the devices exchange
in a call and the memory of the program on a device, both read from the compiled program.

With ``--processes`` several cases are compiled at the same time, in separate processes, and then timed one after
another. With ``--hosts`` the largest number of devices is measured again, divided among processes that
``jax.distributed`` connects. The line ``weights`` compares the weights of PPO after three iterations. ``--small`` is
for a trial run on CPUs, with ``XLA_FLAGS=--xla_force_host_platform_device_count=4``.
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import multiprocessing.connection
import os
import socket
import time
from collections.abc import Callable
from contextlib import nullcontext, redirect_stdout
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from measure import medians, report, round_digits, start_hovering

import crazysim.envs as envs
from crazysim import Sim, __version__
from crazysim.core import functional, world_mesh
from crazysim.engine.sharding import distribute
from crazysim.envs.state import flatten
from crazysim.envs.statistics import RunningStats
from crazysim.train import apg, ppo
from crazysim.train.config import TrainConfig
from crazysim.train.devices import exchanged_bytes, learner_shardings, replicated_sharding
from crazysim.train.networks import Policy, init_mlp

WEIGHTS = "weights"
"""Name of the case that compares weights."""
N_SEEDS = 16
"""Seeds of the case that divides them among the devices."""
N_CALLS = 5
"""Calls that are timed together."""
IMAGE = (64, 64)
"""Width and height of a depth image, pixels."""


class Case(NamedTuple):
    """A compiled program with its first arguments."""

    call: Any
    """Compiled program."""
    arguments: tuple[Any, ...]
    """Its arguments."""
    is_carried: bool
    """True if the first result is the argument of the next call."""
    n_units: int
    """Number of units, such as steps, that one call computes."""
    compile_s: float
    """Compile time, s."""


class Size(NamedTuple):
    """Size of a case."""

    n_worlds: int
    """Worlds of each device, or of each seed in the cases of seeds."""
    n_small_worlds: int
    """The same number with ``--small``."""
    unit: str
    """Unit of the rate."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="platform of the devices")
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2], help="numbers of devices")
    parser.add_argument("--cases", nargs="+", default=[*CASES, WEIGHTS], choices=[*CASES, WEIGHTS])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--small", action="store_true", help="few worlds and steps, for a trial run")
    parser.add_argument("--processes", type=int, default=1, help="cases that are compiled at the same time")
    parser.add_argument(
        "--hosts", type=int, default=1, help="processes among which the devices are divided in the last measurement"
    )
    args = parser.parse_args()
    n_hosts, args.hosts = args.hosts, 1
    if args.processes > 1:
        run_in_processes(args)
    else:
        for name in args.cases:
            run(name, args)
    if n_hosts > 1:
        args.hosts, args.devices = n_hosts, [max(args.devices)]
        args.cases = [name for name in args.cases if name != WEIGHTS]
        with socket.socket() as free_socket:
            free_socket.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{free_socket.getsockname()[1]}"
        context = multiprocessing.get_context("spawn")
        hosts = [context.Process(target=run_on_host, args=(i, address, args)) for i in range(n_hosts)]
        for process in hosts:
            process.start()
        multiprocessing.connection.wait([process.sentinel for process in hosts])
        for process in hosts:
            process.join(60)
            process.kill()  # a process may wait for another process that failed
        if any(process.exitcode for process in hosts):
            raise SystemExit("a host failed; the errors are above")


def run_on_host(i: int, address: str, args: argparse.Namespace) -> None:
    """Run all cases as one of the processes that share the devices; only the first process prints lines."""
    n_devices = args.devices[0] // args.hosts
    if args.device == "cpu":
        os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={n_devices}"
    jax.distributed.initialize(address, args.hosts, i, list(range(i * n_devices, (i + 1) * n_devices)))
    with open(os.devnull, "w") as devnull, redirect_stdout(devnull) if i else nullcontext():
        for name in args.cases:
            run(name, args)


def run_in_processes(args: argparse.Namespace) -> None:
    """Run each case in a separate process. Up to ``args.processes`` of them compile at the same time."""
    context = multiprocessing.get_context("spawn")
    failed = []
    for k in range(0, len(args.cases), args.processes):
        names = args.cases[k : k + args.processes]
        barrier_and_lock = context.Barrier(len(names)), context.Lock()
        processes = {name: context.Process(target=run, args=(name, args, *barrier_and_lock)) for name in names}
        for process in processes.values():
            process.start()
        for name, process in processes.items():
            process.join()
            failed += [name] if process.exitcode else []
    if failed:
        raise SystemExit(f"{', '.join(failed)} failed; the errors are above")


def run(name: str, args: argparse.Namespace, barrier: Any = None, lock: Any = None) -> None:
    """Compile a case for each number of devices, time it, and print its lines.

    Args:
        name: Name of the case.
        args: Options of the command.
        barrier: Barrier at which processes wait until all of them have compiled their case; None for one process.
        lock: Lock of the process that measures; None for one process.
    """
    devices = jax.devices(args.device)
    if len(devices) < max(args.devices):
        raise SystemExit(f"expected {max(args.devices)} devices, got {len(devices)}. See --help for CPUs.")
    if name == WEIGHTS:
        make_result, print_result = trained_weights, compare_weights
    else:
        make_result, print_result = partial(build_case, name), partial(time_and_report, name)
    try:
        results: dict[int, Any] = {n: make_result(devices[:n], args.small) for n in args.devices}
    finally:
        if barrier is not None:
            barrier.wait()
    with nullcontext() if lock is None else lock:
        print_result(results, args)


def compare_weights(weights: dict[int, tuple[np.ndarray, np.ndarray]], args: argparse.Namespace) -> None:
    """Print the lines that compare weights before and after a training."""
    first_start, first_end = weights[args.devices[0]]
    for n in args.devices[1:]:
        start, end = weights[n]
        report(
            args.device, benchmark="devices", case=WEIGHTS, n_devices=n, compared_with=args.devices[0],
            same_start=bool(np.array_equal(start, first_start)),
            difference=round_digits(float(np.linalg.norm(end - first_end))),
            moved=round_digits(float(np.linalg.norm(first_end - first_start))), crazysim=__version__,
        )  # fmt: skip


def build_case(name: str, devices: list[jax.Device], is_small: bool) -> Case:
    """Return a case on some devices; if ``is_small``, with few worlds, and with 4 steps or 4 x 4 pixels."""
    (make_case, size), n = CASES[name], len(devices)
    n_worlds = size.n_small_worlds if is_small else size.n_worlds
    first_device = next(device for device in devices if device.process_index == jax.process_index())
    device_options = {"device": first_device, "mesh": world_mesh(devices) if n > 1 else None}
    return make_case(n_worlds if name.startswith("seeds") else n * n_worlds, device_options, 4 if is_small else None)


def time_and_report(name: str, cases: dict[int, Case], args: argparse.Namespace) -> None:
    size = CASES[name][1]
    states: dict[int, list[Any]] = {n: list(case.arguments) for n, case in cases.items()}

    def seconds(n: int) -> float:
        case, state = cases[n], states[n]
        jax.block_until_ready(state)
        start_time = time.perf_counter()
        for _ in range(N_CALLS):  # queued, as in a training
            results = case.call(*state)
            if case.is_carried:
                state[0] = results[0]
        jax.block_until_ready((state, results))
        return (time.perf_counter() - start_time) / N_CALLS

    for n in cases:
        seconds(n)
        seconds(n)
    call_times = medians({n: partial(seconds, n) for n in cases}, args.repeats)
    rates = {n: cases[n].n_units / call_times[n] for n in cases}
    for n, case in cases.items():
        text, memory = case.call.as_text(), case.call.memory_analysis()
        n_bytes = memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
        report(
            args.device, benchmark="devices", case=name, n_devices=n, n_hosts=args.hosts, unit=size.unit,
            n_worlds=size.n_small_worlds if args.small else size.n_worlds, call_s=round_digits(call_times[n]),
            rate=round_digits(rates[n]), ratio=round_digits(rates[n] / rates[args.devices[0]]),
            exchanged=exchanged_bytes(text), memory_bytes=n_bytes - memory.alias_size_in_bytes,
            compile_s=round(case.compile_s, 1), crazysim=__version__,
        )  # fmt: skip


def compile_case(
    fn: Any, *arguments: Any, n_units: int, is_carried: bool = False, static: tuple[Any, ...] = ()
) -> Case:
    lowered = fn.lower(*arguments, *static)
    start_time = time.perf_counter()
    call = lowered.compile()
    return Case(call, arguments, is_carried, n_units, time.perf_counter() - start_time)


def physics_case(n_worlds: int, device_options: dict[str, Any], small_size: int | None) -> Case:
    """Return the case of steps with attitude commands."""
    n_steps = small_size or 100
    sim = Sim(n_worlds, control="attitude", **device_options)
    start_hovering(sim, "attitude")
    step = sim.build_step_fn()
    return compile_case(
        jax.jit(lambda data: (step(data, n_steps), ())), sim.data, n_units=n_worlds * n_steps, is_carried=True
    )


def rollout_case(
    task: str, with_policy: bool, n_worlds: int, device_options: dict[str, Any], small_size: int | None
) -> Case:
    """Return the case of rollouts with automatic resets, with random actions or a policy of two layers of 64 units."""
    n_steps = small_size or 50
    env = envs.AutoReset(envs.make(task, n_worlds, **device_options))
    replicated = replicated_sharding(env.sim)
    state = jax.jit(env.reset)(distribute(jax.random.key(0), replicated))
    shape, n_obs = state.action.shape, flatten(state.obs).shape[-1]
    policy = Policy(RunningStats.create(n_obs), init_mlp(jax.random.key(1), (n_obs, 64, 64, env.actions.size), 0.01))
    policy = distribute(policy, replicated)

    def run(carry: Any, policy: Any) -> Any:
        def act(obs: Any, memory: Any, key: Any) -> Any:
            if with_policy:
                return policy(obs) + 0.1 * jax.random.normal(key, shape), memory, ()
            return jax.random.uniform(key, shape, minval=-0.3, maxval=0.3), memory, ()

        state, key = carry
        key, rollout_key = jax.random.split(key)
        state, _, transitions = envs.rollout(env, state, act, rollout_key, n_steps)
        return (state, key), transitions

    carry = state, distribute(jax.random.key(2), replicated)
    return compile_case(jax.jit(run), carry, policy, n_units=n_worlds * n_steps, is_carried=True)


def training_case(
    algorithm: Any, n_seeds: int, n_worlds: int, device_options: dict[str, Any], small_size: int | None
) -> Case:
    """Return the case of iterations of a training of ``hover`` with all its seeds."""
    recipe = TrainConfig.create("hover", "ppo" if algorithm is ppo else "apg", n_worlds=n_worlds).algorithm_config()
    recipe = recipe if small_size is None else dataclasses.replace(recipe, n_steps=small_size)
    base_env = envs.make("hover", n_seeds * n_worlds, **device_options)
    env, recipes = envs.AutoReset(base_env) if algorithm is ppo else base_env, (recipe,) * n_seeds
    replicated = replicated_sharding(base_env.sim)
    keys = distribute(jax.random.split(jax.random.key(0), n_seeds), replicated)
    shapes = jax.eval_shape(partial(algorithm.init, env, recipes), keys)
    shardings = learner_shardings(shapes, base_env.sim, n_seeds)
    learner = jax.jit(algorithm.init, static_argnums=(0, 1), out_shardings=shardings)(env, recipes, keys)
    iterate = jax.jit(algorithm.iterate, static_argnums=(1, 2), out_shardings=(shardings, replicated))
    n_units = n_seeds * n_worlds * recipe.n_steps
    return compile_case(iterate, learner, n_units=n_units, is_carried=True, static=(env, recipes))


def gradient_case(n_worlds: int, device_options: dict[str, Any], small_size: int | None) -> Case:
    """Return the case of gradients of squared distances after some steps with respect to attitude commands."""
    n_steps = small_size or 100
    sim = Sim(n_worlds, control="attitude", **device_options)
    start_hovering(sim, "attitude")
    step = sim.build_step_fn().with_zeros_of(sim.data)

    def squared_distance(cmd: Any, start: Any) -> Any:
        end = step(functional.attitude_control(start, cmd), n_steps)
        return jnp.sum((end.states.pos - start.states.pos) ** 2)

    cmd = 1.01 * sim.data.controls.attitude.staged_cmd
    return compile_case(jax.jit(jax.grad(squared_distance)), cmd, sim.data, n_units=n_worlds * n_steps)


def depth_case(n_worlds: int, device_options: dict[str, Any], small_size: int | None) -> Case:
    """Return the case of depth images of a drone amid 30 movable poles; its units are rays."""
    size = (small_size, small_size) if small_size else IMAGE
    sim = Sim(n_worlds, control="attitude", **device_options)
    pos = np.zeros((30, 3))
    pos[:, :2] = np.random.default_rng(0).uniform(-10, 10, (30, 2))
    sim.scene.add("pole", count=30, pos=pos, mocap=True)
    start_hovering(sim, "attitude")
    take_image = sim.scene.depth_fn("fpv_cam", *size)
    return compile_case(jax.jit(lambda data: take_image(data).distance), sim.data, n_units=n_worlds * size[0] * size[1])


def trained_weights(devices: list[jax.Device], is_small: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of a policy before and after three iterations of PPO."""
    device_options = {"device": devices[0], "mesh": world_mesh(devices) if len(devices) > 1 else None}
    with jax.default_matmul_precision("highest"):  # by default a GPU rounds the operands to 10 bits
        case = training_case(ppo, 1, 256 if is_small else 16384, device_options, 4 if is_small else None)
    learner = case.arguments[0]
    weights = [learner.agents.policy]
    for _ in range(3):
        learner, _ = case.call(learner)
    weights.append(learner.agents.policy)
    first, last = (np.concatenate([np.ravel(x) for x in jax.tree.leaves(jax.device_get(x))]) for x in weights)
    return first, last


CASES: dict[str, tuple[Callable[..., Case], Size]] = {
    "physics": (physics_case, Size(4194304, 64, "steps")),
    "hover, random actions": (partial(rollout_case, "hover", False), Size(1048576, 64, "environment steps")),
    "hover, policy": (partial(rollout_case, "hover", True), Size(1048576, 64, "environment steps")),
    "race, random actions": (partial(rollout_case, "race", False), Size(1048576, 64, "environment steps")),
    "race, policy": (partial(rollout_case, "race", True), Size(1048576, 64, "environment steps")),
    "PPO": (partial(training_case, ppo, 1), Size(262144, 64, "environment steps")),
    "analytic policy gradients": (partial(training_case, apg, 1), Size(16384, 64, "environment steps")),
    "gradient": (gradient_case, Size(131072, 64, "steps")),
    "depth": (depth_case, Size(16384, 8, "rays")),
    "seeds": (partial(training_case, ppo, N_SEEDS), Size(16384, 16, "environment steps")),
    "seeds, recipe": (partial(training_case, ppo, N_SEEDS), Size(1024, 16, "environment steps")),
}
"""Function that builds each case, and the size of the case, by name."""


if __name__ == "__main__":
    main()
