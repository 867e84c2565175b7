"""Train ``hover`` off-policy, with the SAC of Stable-Baselines3, and evaluate its actor on held-out starts.

It requires ``pip install stable-baselines3``. The actor becomes a JAX function, which ``crazysim.train`` evaluates and
films like its own policies.
"""

import sys
import time

import jax
import jax.numpy as jnp
import torch
from jax import Array
from stable_baselines3 import SAC

import crazysim.envs as envs
from crazysim import train

WORLDS = 64


def make_actor(model: SAC):
    """Return the deterministic actor as a function from named observations to actions."""
    modules = [*model.actor.latent_pi, model.actor.mu]
    layers = [x for x in modules if isinstance(x, torch.nn.Linear)]
    weights = [tuple(jnp.asarray(x.detach().numpy()) for x in (layer.weight.T, layer.bias)) for layer in layers]

    def act(obs: dict[str, Array]) -> Array:
        x = envs.flatten(obs)
        for weight, bias in weights[:-1]:
            x = jax.nn.relu(x @ weight + bias)
        weight, bias = weights[-1]
        return jnp.tanh(x @ weight + bias)

    return act


def make_model(seed: int = 0) -> SAC:
    """Return an untrained model on ``hover``."""
    env = envs.DroneVecEnv(envs.make("hover", WORLDS))
    return SAC(
        "MlpPolicy",
        env,
        learning_rate=lambda remaining: 3e-3 * remaining,  # annealed: precision comes last
        gamma=0.95,
        tau=0.02,
        ent_coef="auto_0.1",
        target_entropy=-8.0,  # less noise than the default, -4
        batch_size=256,
        n_steps=5,  # 0.1 s: one action, 0.02 s, changes the value less than the critics err
        train_freq=1,
        gradient_steps=8,
        learning_starts=20 * WORLDS,
        policy_kwargs={"net_arch": [64, 64], "optimizer_kwargs": {"fused": True}},
        seed=seed,
        device="cpu",
    )


def main(steps: int = 120_000, starts: int = 1000, seed: int = 0) -> tuple[SAC, dict[str, float]]:
    """Train for some environment steps, evaluate, and return the model and its metrics."""
    torch.set_num_threads(1)  # small networks: more threads only wait for each other
    model, start_time = make_model(seed), time.perf_counter()
    model.learn(steps)
    seconds = time.perf_counter() - start_time
    metrics = train.evaluate(envs.make("hover", starts), make_actor(model))
    print(
        f"SAC of Stable-Baselines3, hover: {model.num_timesteps:,} environment steps in {seconds:.0f} s; success "
        f"{metrics['success']:.1%} of {starts:,} held-out starts, mean error {metrics['error']:.3f} m"
    )
    return model, metrics


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
