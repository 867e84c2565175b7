"""Environment steps per second, with random actions and with a policy, in one compiled rollout with automatic resets.

    python benchmarks/envs.py [--device gpu] [--tasks hover race] [--worlds 4096 1048576] [--randomize] [--depth 16 12]
                              [--actions random policy bfloat16 training]

An environment step at 50 Hz is ten physics steps at 500 Hz. Worlds that crash are reset, as in training. With several
drones in a world, the steps of each drone count. ``ended`` is the fraction of worlds whose episode ends per step; lines
of ``training`` lack it. With ``--randomize`` the same rollouts with ``Randomize.crazyflie()`` are timed alternately.
``drones`` is ``as the airframe`` or ``randomized``, which describes their parameters. With ``--depth`` the policies
also receive a depth image of each drone's camera at every environment step. ``training`` times the iterations of
``crazysim train`` by PPO. This includes rollout and updates, but no compilation or evaluation. Batches of training grow
with the number of worlds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from measure import engine_name, medians, report, round_digits

import crazysim.envs as envs
from crazysim import Randomize
from crazysim.envs.state import flatten
from crazysim.envs.statistics import RunningStats
from crazysim.train import ppo
from crazysim.train.config import TrainConfig
from crazysim.train.networks import Policy, init_mlp

MAX_DEPTH = 5.0
"""Largest distance that a policy receives, m."""
DEFAULT_ACTIONS = ("random", "policy", "bfloat16")
DEFAULT_WORLDS = {"cpu": (1024, 16384), "gpu": (4096, 65536, 1048576)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--tasks", nargs="+", default=["hover"], help="names in crazysim.envs.TASKS")
    parser.add_argument("--worlds", type=int, nargs="+", help="numbers of worlds")
    parser.add_argument("--steps", type=int, default=50, help="environment steps per call")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument(
        "--randomize", action="store_true", help="also time the same with Randomize.crazyflie(), alternately"
    )
    parser.add_argument("--depth", type=int, nargs=2, help="width and height of images that the policies receive")
    parser.add_argument(
        "--actions", nargs="+", default=DEFAULT_ACTIONS, choices=(*DEFAULT_ACTIONS, "training"), help="what is timed"
    )
    args = parser.parse_args()
    for task in args.tasks:
        for n_worlds in args.worlds or DEFAULT_WORLDS["cpu" if args.device == "cpu" else "gpu"]:
            settings = task, n_worlds, args.steps, args.device, args.repeats
            report_rates(*settings, args.randomize, args.depth, args.actions)


def report_rates(
    task: str,
    n_worlds: int,
    n_steps: int,
    device: str,
    repeats: int,
    randomize: bool,
    image_size: Sequence[int] | None,
    actions: Sequence[str],
) -> None:
    base_env = envs.make(task, n_worlds, device=device)
    env_by_drones = {"as the airframe": envs.AutoReset(base_env)}
    if randomize:
        randomized_env = envs.make(task, n_worlds, device=device, effects=[Randomize.crazyflie()])
        env_by_drones["randomized"] = envs.AutoReset(randomized_env)
    env_device = base_env.sim.device
    key = jax.device_put(jax.random.key(0), env_device)
    start_states = {drones: jax.jit(env.reset)(key) for drones, env in env_by_drones.items()}
    n_obs = flatten(start_states["as the airframe"].obs).shape[-1] + (
        image_size[0] * image_size[1] if image_size else 0
    )
    policy = Policy(
        RunningStats.create(n_obs), init_mlp(jax.random.key(1), (n_obs, 64, 64, base_env.actions.size), 0.01)
    )
    policy = jax.device_put(policy, env_device)

    shape = start_states["as the airframe"].action.shape

    def act_with_noise(policy: Policy) -> Any:
        return lambda obs, memory, key: (policy(obs) + 0.1 * jax.random.normal(key, shape), memory, ())

    def summarize_transition(step: Any) -> Any:
        return step.reward.mean(), step.done.mean()

    def rollout_with_images(env: Any, state: Any, act: Any, key: Any) -> Any:
        render = base_env.sim.scene.depth_fn("fpv_cam", *image_size)  # type: ignore[misc]

        def step(state: Any, key: Any) -> Any:
            depth = jnp.minimum(render(state.data).distance, MAX_DEPTH)
            action, _, _ = act({**state.obs, "depth": depth.reshape(*depth.shape[:2], -1)}, (), key)
            state = env.step(state, action)
            return state, summarize_transition(state)

        return jax.lax.scan(step, state, jax.random.split(key, n_steps))

    def jit_rollout(env: Any, act: Any) -> Any:
        def run(carry: Any) -> Any:
            state, key = carry
            key, step_key = jax.random.split(key)
            if image_size:
                state, outputs = rollout_with_images(env, state, act, step_key)
            else:
                state, _, outputs = envs.rollout(env, state, act, step_key, n_steps, summarize_transition)
            return (state, key), outputs

        return jax.jit(run)

    act_functions = {
        "random": lambda obs, memory, key: (jax.random.uniform(key, shape, minval=-0.3, maxval=0.3), memory, ()),
        "policy": act_with_noise(policy),
        "bfloat16": act_with_noise(policy.replace(layers=jax.tree.map(lambda x: x.astype("bfloat16"), policy.layers))),
    }
    config = TrainConfig.create(task, "ppo", n_worlds=n_worlds).algorithm_config()
    for name in actions:
        measures: dict[str, Any] = {}
        compile_s, last_results = {}, {}
        for drones, env in env_by_drones.items():
            if name == "training":
                carry = ppo.init(env, (config,), key[None])
                lowered = ppo.iterate.lower(carry, env, (config,))
            else:
                carry = (start_states[drones], jax.device_put(jax.random.key(2), env_device))
                lowered = jit_rollout(env, act_functions[name]).lower(carry)
            start_time = time.perf_counter()
            run = lowered.compile()
            compile_s[drones] = time.perf_counter() - start_time
            carry, _ = run(carry)
            results: list[Any] = [carry]

            def measure(run: Any = run, results: list[Any] = results) -> float:
                jax.block_until_ready(results[0])
                start_time = time.perf_counter()
                results[0], results[1:] = (out := run(results[0]))[0], [out[1]]
                jax.block_until_ready(results)
                return time.perf_counter() - start_time

            measures[drones], last_results[drones] = measure, results
        steps = config.n_steps if name == "training" else n_steps
        for drones, seconds in medians(measures, repeats).items():
            ended_entry = (
                {} if name == "training" else {"ended": round_digits(float(jnp.mean(last_results[drones][1][1])))}
            )
            report(
                device,
                benchmark="envs",
                task=task,
                actions=name,
                drones=drones,
                n_worlds=n_worlds,
                n_steps=steps,
                depth=image_size,
                engine=engine_name(base_env.sim),
                compile_s=round(compile_s[drones], 2),
                env_steps_per_s=round_digits(n_worlds * base_env.sim.n_drones * steps / seconds),
                **ended_entry,
            )


if __name__ == "__main__":
    main()
