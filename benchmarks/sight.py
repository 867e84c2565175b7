"""Rates of flying by sight: the task ``forest`` with its convolution, its gradient, and lidars among trees.

    python benchmarks/sight.py [--device gpu] [--worlds 4096] [--repeats 7] [--cases policy gradient lidar] [--small]

``policy``: rollouts of ``forest`` with automatic resets, in a corridor that is long enough for 200 trees, which every
world draws anew in every episode. The policy has the convolution and the layers of the recipe, and receives a depth
image of 16 x 12 pixels in every step.
``gradient``: the gradient of the mean reward of 150 steps of ``forest`` with respect to the weights of this policy,
through every image. ``forward_passes`` is its time over the time of the mean reward alone.
``lidar``: steps of hovering drones among 200 trees, whose lidars take 16 x 360 rays at 10 Hz. ``realtime`` is the
simulated time of one world divided by the real time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from measure import engine_name, medians, report, round_digits, start_hovering

import crazysim.envs as envs
from crazysim import Forest, Lidar, Sim, __version__
from crazysim.envs.state import flatten
from crazysim.envs.statistics import RunningStats
from crazysim.train.config import TrainConfig
from crazysim.train.convolution import find_images
from crazysim.train.networks import Policy, choose_network, init_weights

N_TREES, AREA_OF_TREE = 200, 16.0
"""Number of trees in a world, and the area of ground for each tree, m^2."""
CORRIDOR = 16.0
"""Width of the corridor of ``forest``, m."""
LIDAR_FREQ = 10
"""Rate of the lidars, Hz."""
N_CALLS = 5
"""Number of calls that are timed together."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--cases", nargs="+", choices=("policy", "gradient", "lidar"), default=["policy", "lidar"])
    parser.add_argument("--small", action="store_true", help="few steps, to try the script")
    args = parser.parse_args()
    if "policy" in args.cases:
        measure_rollouts(args, 4 if args.small else 50)
    if "gradient" in args.cases:
        measure_gradients(args, 4 if args.small else 150)
    if "lidar" in args.cases:
        measure_lidars(args, 2 if args.small else 10)


def measure_rollouts(args: argparse.Namespace, n_steps: int) -> None:
    """Time rollouts of ``forest`` with its recipe's network."""
    length = N_TREES * AREA_OF_TREE / CORRIDOR
    env = envs.AutoReset(envs.make("forest", args.worlds, length=length, device=args.device))
    state = jax.jit(env.reset)(jax.device_put(jax.random.key(0), env.sim.device))
    policy, shape = make_policy(env, state), state.action.shape

    def act(obs: Any, memory: Any, key: Any) -> Any:
        return policy(obs) + 0.1 * jax.random.normal(key, shape), memory, ()

    @jax.jit
    def run(carry: Any) -> Any:
        state, key = carry
        key, rollout_key = jax.random.split(key)
        state, _, done = envs.rollout(env, state, act, rollout_key, n_steps, lambda x: x.done.mean())
        return (state, key), done

    call_s, first_s, done = time_calls(run, (state, jax.device_put(jax.random.key(2), env.sim.device)), args.repeats)
    report(
        args.device, benchmark="sight", case="policy", engine=engine_name(env.sim), n_worlds=args.worlds,
        n_trees=N_TREES, image=[16, 12], env_steps_per_s=round_digits(args.worlds * n_steps / call_s),
        rays_per_s=round_digits(args.worlds * n_steps * 16 * 12 / call_s), done=round_digits(float(np.mean(done))),
        first_s=round(first_s, 1), crazysim=__version__,
    )  # fmt: skip


def make_policy(env: envs.Env, state: Any) -> Policy:
    """Make an untrained policy of ``forest`` with the network of its recipe."""
    recipe: Any = TrainConfig.create("forest", "ppo").algorithm_config()
    images = find_images({name: x.shape[-1] for name, x in state.obs.items()}, env.image_formats())
    network, n_obs = choose_network(0, None, recipe.convolution, images), flatten(state.obs).shape[-1]
    weights = init_weights(network, jax.random.key(1), n_obs, (*recipe.hidden, env.actions.size), 0.01)
    policy = Policy(RunningStats.create(n_obs, network.pixels), weights.layers, weights.body, network)
    return jax.device_put(policy, env.sim.device)


def measure_gradients(args: argparse.Namespace, n_steps: int) -> None:
    """Time the mean reward of steps of ``forest``, and its gradient by the weights of the policy."""
    env = envs.make("forest", args.worlds, device=args.device)
    key = jax.device_put(jax.random.key(0), env.sim.device)
    state = jax.jit(env.reset)(key)
    policy = make_policy(env, state)

    def mean_reward(weights: Any) -> Any:
        own_policy = policy.replace(layers=weights[0], body=weights[1])
        act = lambda obs, memory, key: (own_policy(obs), memory, ())  # noqa: E731
        return envs.rollout(env, state, act, key, n_steps, lambda x: x.reward.mean())[2].mean()

    weights = policy.layers, policy.body
    functions = {"forward": jax.jit(mean_reward), "gradient": jax.jit(jax.grad(mean_reward))}

    def seconds(fn: Any) -> float:
        start_time = time.perf_counter()
        jax.block_until_ready(fn(weights))
        return time.perf_counter() - start_time

    first_s = {name: seconds(fn) for name, fn in functions.items()}
    call_s = medians({name: partial(seconds, fn) for name, fn in functions.items()}, args.repeats)
    slopes = [np.asarray(x) for x in jax.tree.leaves(functions["gradient"](weights))]
    if not (all(np.isfinite(x).all() for x in slopes) and any(np.any(x) for x in slopes)):
        raise SystemExit("the gradient is zero or not finite; no figure")
    stats = getattr(env.sim.device, "memory_stats", lambda: None)() or {}
    report(
        args.device, benchmark="sight", case="gradient", engine=engine_name(env.sim), n_worlds=args.worlds,
        n_steps=n_steps, image=[16, 12], forward_s=round_digits(call_s["forward"]),
        gradient_s=round_digits(call_s["gradient"]),
        steps_per_s=round_digits(args.worlds * n_steps / call_s["gradient"]),
        forward_passes=round_digits(call_s["gradient"] / call_s["forward"]),
        memory_gb=round(stats.get("peak_bytes_in_use", 0) / 1e9, 1), first_s=round(first_s["gradient"], 1),
        crazysim=__version__,
    )  # fmt: skip


def measure_lidars(args: argparse.Namespace, n_images: int) -> None:
    """Time steps of drones with lidars among trees."""
    side = (N_TREES * AREA_OF_TREE) ** 0.5
    trees = Forest(density=1 / AREA_OF_TREE, radii=(0.1, 0.3), size=(side, side))
    lidar = Lidar.vlp16(360, freq=LIDAR_FREQ)
    sim = Sim(args.worlds, control="attitude", device=args.device, plugins=[trees, lidar])
    start_hovering(sim, "attitude")
    step, n_steps = sim.build_step_fn(), n_images * sim.freq // LIDAR_FREQ
    run = jax.jit(lambda data: (step(data, n_steps), ()))
    call_s, first_s, _ = time_calls(run, sim.data, args.repeats)
    n_rays = lidar.image_size[0] * lidar.image_size[1]
    report(
        args.device, benchmark="sight", case="lidar", engine=engine_name(sim), n_worlds=args.worlds, n_trees=N_TREES,
        image=[*lidar.image_size[::-1]], realtime=round_digits(n_steps / sim.freq / call_s),
        rays_per_s=round_digits(args.worlds * n_images * n_rays / call_s), first_s=round(first_s, 1),
        crazysim=__version__,
    )  # fmt: skip


def time_calls(run: Callable[[Any], Any], carry: Any, repeats: int) -> tuple[float, float, Any]:
    """Return the median time of a call, s, the time of the first call, s, and the second result of the last call."""
    results = [carry, None]

    def call(n_calls: int) -> float:
        start_time = time.perf_counter()
        for _ in range(n_calls):
            results[:] = run(results[0])
        jax.block_until_ready(results)
        return (time.perf_counter() - start_time) / n_calls

    first_s = call(1)
    call(1)
    return medians({"": partial(call, N_CALLS)}, repeats)[""], first_s, results[1]


if __name__ == "__main__":
    main()
