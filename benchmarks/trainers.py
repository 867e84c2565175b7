"""PPO of crazysim, of Brax and of RSL-RL on the same environment.

    python benchmarks/trainers.py --device gpu --worlds 1024 65536 --seeds 3
    python benchmarks/trainers.py --worlds 64 --iterations 8 --trainers crazysim brax

All three libraries train the task with the hyperparameters of its recipe: the same worlds, steps, epochs, minibatches,
networks with tanh, initial learning rate, discount, ``gae_lambda``, weight of the entropy, largest norm of the gradient
and clipping. RSL-RL also uses the weight of the value loss and the initial standard deviation of the recipe. Other
settings are the defaults of each library. The learning rate decreases linearly to zero in crazysim, and is constant in
Brax and RSL-RL. Brax steps the environment by ``BraxEnv``, within its compiled program. RSL-RL steps it by
``RslRlEnv``, with one compiled call a step, and shares arrays with Torch.

There is a JSON line for each trainer and number of worlds. It has the environment steps per second, the median over the
seeds, and the success of each seed on 1,000 held-out starts after the same number of steps. The rate is measured over
the last three quarters of a training, because the first quarter includes the compilation. No quarter includes
evaluations. ``benchmarks/figures.py --write --only trainers`` puts the table into docs/results.md.

``pip install brax==0.14.2`` installs Brax, and ``pip install rsl-rl-lib==5.5.1`` installs RSL-RL with PyTorch. A
trainer that is not installed is left out, and a printed line says so.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import importlib.metadata
import importlib.util
import io
import json
import os
import statistics
import sys
import time
from contextlib import redirect_stdout
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from measure import describe_machine, round_digits, run_in_process

import crazysim
from crazysim.engine.pytree import PyTree, static
from crazysim.envs import AutoReset, BraxEnv, make
from crazysim.envs.env import Env
from crazysim.envs.state import Obs, flatten
from crazysim.train import evaluate, ppo
from crazysim.train.config import find_recipe
from crazysim.train.networks import Layers, mlp

QUARTERS = 4
"""Number of equal parts of a training; the first part is not timed."""
PACKAGES = {"crazysim": "crazysim", "brax": "brax", "rsl_rl": "rsl-rl-lib"}
"""Package on PyPI of each trainer, by the name of its module."""

TrainingResult = tuple[float, Any]
"""Duration of the last three quarters of a training, s, and its policy."""


class PeerPolicy(PyTree):
    """Deterministic policy with the weights and statistics of another library."""

    mean: Array
    """Mean of the observations. (n_obs,)"""
    std: Array
    """Divisor of the observations. (n_obs,)"""
    layers: Layers
    """Weights and biases."""
    has_tanh: bool = static()
    """True if a tanh follows the layers."""

    def __call__(self, obs: Obs) -> Array:
        out = mlp(self.layers, (flatten(obs) - self.mean) / self.std)
        return jnp.tanh(out) if self.has_tanh else out


def train_crazysim(env: Env, config: ppo.Config, seed: int) -> TrainingResult:
    """Train by ``crazysim.train.ppo``."""
    auto_reset_env = _auto_reset(env)
    key = jnp.stack([jax.random.fold_in(jax.random.key(seed), 1)])
    learner, configs, start_time = ppo.init(auto_reset_env, (config,), key), (config,), 0.0
    for i in range(config.iterations):
        if i == config.iterations // QUARTERS:
            jax.block_until_ready(learner)
            start_time = time.perf_counter()
        learner, _ = ppo.iterate(learner, auto_reset_env, configs)
    jax.block_until_ready(learner)
    seconds = time.perf_counter() - start_time
    return seconds, jax.tree.map(lambda x: x[0], learner.as_policy())


@functools.cache
def _auto_reset(env: Env) -> AutoReset:
    return AutoReset(env)


def train_brax(env: Env, config: ppo.Config, seed: int) -> TrainingResult:
    """Train by the PPO of Brax."""
    from brax.training.agents.ppo import networks, train
    from flax import linen

    if not hasattr(jax, "device_put_replicated"):  # Brax 0.14.2 calls this function, which jax 0.10 removed
        jax.device_put_replicated = _device_put_replicated  # type: ignore[attr-defined]
    quarter_times: list[float] = []  # s, before the training and after each quarter of it
    n_worlds = env.sim.n_worlds
    _, (normalizer, policy, _), _ = train.train(
        BraxEnv(env),  # type: ignore[arg-type]
        num_timesteps=config.iterations * config.n_steps * n_worlds,
        wrap_env=False,
        num_envs=n_worlds,
        episode_length=env.max_steps,
        learning_rate=config.learning_rate,
        entropy_cost=config.entropy,
        discounting=config.discount,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clip,
        max_grad_norm=config.max_grad_norm,
        unroll_length=config.n_steps,
        batch_size=n_worlds // config.minibatches,
        num_minibatches=config.minibatches,
        num_updates_per_batch=config.epochs,
        normalize_observations=True,
        network_factory=functools.partial(
            networks.make_ppo_networks,
            policy_hidden_layer_sizes=config.hidden,
            value_hidden_layer_sizes=config.hidden,
            activation=linen.tanh,
        ),
        seed=seed,
        num_evals=QUARTERS + 1,
        num_eval_envs=n_worlds,
        run_evals=False,
        policy_params_fn=lambda *_: quarter_times.append(time.perf_counter()),
    )
    weights = policy["params"]
    *hidden, (weight, bias) = ((weights[name]["kernel"], weights[name]["bias"]) for name in sorted(weights))
    n_actions = env.actions.size  # the first outputs are means, the others standard deviations
    layers = [*hidden, (weight[:, :n_actions], bias[:n_actions])]
    return quarter_times[-1] - quarter_times[1], PeerPolicy(normalizer.mean, normalizer.std, layers, True)


def _device_put_replicated(tree: Any, devices: Any) -> Any:
    sharding = jax.sharding.NamedSharding(jax.sharding.Mesh(devices, ("i",)), jax.sharding.PartitionSpec("i"))
    return jax.tree.map(lambda x: jax.device_put(jnp.stack([x] * len(devices)), sharding), tree)


def train_rsl_rl(env: Env, config: ppo.Config, seed: int) -> TrainingResult:
    """Train by RSL-RL, whose networks run in Torch."""
    import torch
    from rsl_rl.runners import OnPolicyRunner

    from crazysim.envs.rsl_rl import RslRlEnv

    torch.set_num_threads(1)  # small networks: more threads only wait for each other
    torch.manual_seed(seed)
    network = {"class_name": "MLPModel", "hidden_dims": config.hidden, "activation": "tanh", "obs_normalization": True}
    settings = {
        "num_steps_per_env": config.n_steps,
        "save_interval": config.iterations,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": network | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": config.init_std}},
        "critic": network,
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": config.epochs,
            "num_mini_batches": config.minibatches,
            "clip_param": config.clip,
            "gamma": config.discount,
            "lam": config.gae_lambda,
            "value_loss_coef": config.value_weight,
            "entropy_coef": config.entropy,
            "learning_rate": config.learning_rate,
            "schedule": "fixed",
            "max_grad_norm": config.max_grad_norm,
        },
    }
    torch_env = RslRlEnv(env, seed)

    def synchronise() -> float:
        if torch_env.device != "cpu":
            torch.cuda.synchronize()
        jax.block_until_ready(torch_env.state)
        return time.perf_counter()

    quarter = config.iterations // QUARTERS
    with redirect_stdout(io.StringIO()):
        runner = OnPolicyRunner(torch_env, settings, device=torch_env.device)
        runner.learn(quarter)
        start_time = synchronise()
        runner.learn(config.iterations - quarter)
        seconds = synchronise() - start_time
    actor: Any = runner.get_inference_policy()
    arrays = {name: jnp.asarray(x.detach().cpu().numpy()) for name, x in actor.state_dict().items()}
    names = sorted(name.removesuffix(".weight") for name in arrays if name.endswith(".weight"))
    layers = [(arrays[f"{name}.weight"].T, arrays[f"{name}.bias"]) for name in names]
    normalizer = actor.obs_normalizer
    mean, std = arrays["obs_normalizer._mean"][0], arrays["obs_normalizer._std"][0] + normalizer.eps
    return seconds, PeerPolicy(mean, std, layers, False)


TRAINERS = {"crazysim": train_crazysim, "brax": train_brax, "rsl_rl": train_rsl_rl}
"""Functions that train a policy, by the name of the trainer's module."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--task", default="hover", help="task of one drone; by default %(default)s")
    parser.add_argument("--trainers", nargs="+", choices=TRAINERS, default=list(TRAINERS))
    parser.add_argument("--worlds", nargs="+", type=int, default=[1024], help="numbers of worlds")
    parser.add_argument("--iterations", type=int, help="iterations of a training; by default the recipe's")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds")
    parser.add_argument("--starts", type=int, default=1000, help="held-out starts")
    args = parser.parse_args()
    recipe = find_recipe(args.task, "ppo")
    config = ppo.Config(**recipe.config)
    if args.iterations is not None:
        config = dataclasses.replace(config, iterations=args.iterations)
    if config.iterations % QUARTERS:
        parser.error(f"expected iterations that {QUARTERS} divides, got {config.iterations}")
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # Torch takes memory of the same GPU
    for n_worlds in args.worlds:
        for name in args.trainers:
            if importlib.util.find_spec(name) is None:
                print(f"left out {name}: pip install {PACKAGES[name]}", flush=True)
                continue
            line = run_in_process(
                measure_trainer, name, args.task, args.device, n_worlds, config, args.seeds, args.starts
            )
            print(json.dumps(line), flush=True)


def measure_trainer(
    name: str, task: str, device: str, n_worlds: int, config: ppo.Config, n_seeds: int, n_starts: int
) -> dict[str, Any]:
    env, eval_env = (make(task, n, device=device) for n in (n_worlds, n_starts))
    env_steps = config.iterations * config.n_steps * n_worlds
    rates, success = [], []
    for seed in range(n_seeds):
        start_time = time.perf_counter()
        seconds, policy = TRAINERS[name](env, config, seed)
        rates.append(env_steps * (1 - (config.iterations // QUARTERS) / config.iterations) / seconds)
        total_s = time.perf_counter() - start_time
        success.append(round(evaluate(eval_env, policy)["success"], 4))
        print(f"{name}, seed {seed}: {total_s:.1f} s, success {success[-1]:.1%}", file=sys.stderr, flush=True)
    rate = statistics.median(rates)
    line: dict[str, Any] = {
        "benchmark": "trainers",
        "trainer": name,
        "version": _version(name),
    }
    if name == "rsl_rl":
        line["torch"] = importlib.metadata.version("torch")
    line |= {"task": task, "n_worlds": n_worlds, "iterations": config.iterations, "env_steps": env_steps}
    line |= {"env_steps_per_s": round_digits(rate), "seconds": round_digits(env_steps / rate), "success": success}
    return line | describe_machine(device)


def _version(name: str) -> str:
    return crazysim.__version__ if name == "crazysim" else importlib.metadata.version(PACKAGES[name])


if __name__ == "__main__":
    main()
