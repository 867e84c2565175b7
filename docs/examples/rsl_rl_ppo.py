"""Train ``hover`` with the PPO of RSL-RL, and evaluate its actor on held-out starts.

It requires ``pip install rsl-rl-lib``. The actor becomes a JAX function, which ``crazysim.train`` evaluates and films
like its own policies.
"""

import sys
import time

import jax
import jax.numpy as jnp
import torch
from jax import Array
from rsl_rl.runners import OnPolicyRunner

import crazysim.envs as envs
from crazysim import train

WORLDS = 1024
NETWORK = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "elu", "obs_normalization": True}
SETTINGS = {
    "num_steps_per_env": 24,
    "save_interval": 100,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": NETWORK | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.5}},
    "critic": NETWORK,
    "algorithm": {
        "class_name": "PPO",
        "learning_rate": 1e-3,
        "schedule": "adaptive",
        "desired_kl": 0.01,
        "gamma": 0.98,
        "lam": 0.95,
        "entropy_coef": 0.0,
        "num_learning_epochs": 5,
        "num_mini_batches": 4,
    },
}


def make_actor(runner: OnPolicyRunner):
    """Return the deterministic actor as a function from named observations to actions."""
    actor = runner.get_inference_policy()
    modules = [x for x in actor.mlp if isinstance(x, torch.nn.Linear)]
    weights = [tuple(jnp.asarray(x.detach().cpu().numpy()) for x in (layer.weight.T, layer.bias)) for layer in modules]
    mean, std = (jnp.asarray(x.cpu().numpy()) for x in (actor.obs_normalizer.mean, actor.obs_normalizer.std))
    eps = actor.obs_normalizer.eps

    def act(obs: dict[str, Array]) -> Array:
        x = (envs.flatten(obs) - mean) / (std + eps)
        for weight, bias in weights[:-1]:
            x = jax.nn.elu(x @ weight + bias)
        weight, bias = weights[-1]
        return x @ weight + bias

    return act


def main(iterations: int = 120, starts: int = 1000, seed: int = 0) -> tuple[OnPolicyRunner, dict[str, float]]:
    """Train for some iterations, evaluate, and return the runner and the metrics."""
    torch.set_num_threads(1)  # small networks: more threads only wait for each other
    torch.manual_seed(seed)
    env = envs.RslRlEnv(envs.make("hover", WORLDS), seed)
    runner, start_time = OnPolicyRunner(env, SETTINGS, device=env.device), time.perf_counter()
    runner.learn(iterations)
    seconds = time.perf_counter() - start_time
    metrics = train.evaluate(envs.make("hover", starts), make_actor(runner))
    n_steps = iterations * SETTINGS["num_steps_per_env"] * WORLDS
    print(
        f"PPO of RSL-RL, hover: {n_steps:,} environment steps in {seconds:.0f} s; success {metrics['success']:.1%} of "
        f"{starts:,} held-out starts, mean error {metrics['error']:.3f} m"
    )
    return runner, metrics


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
