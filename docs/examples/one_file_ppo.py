"""Train ``hover`` by PPO in one file with JAX and optax, as a start for your own algorithm, and evaluate the policy.

Rollout, advantages and updates of all worlds are one compiled function.
"""

import time
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from crazysim import envs, train

WORLDS, STEPS, MINIBATCHES, EPOCHS = 1024, 32, 16, 4
DISCOUNT, LAMBDA, CLIP = 0.98, 0.95, 0.2


class Agent(NamedTuple):
    """Weights of policy and value function, and the logarithm of the standard deviation of the actions."""

    policy: list[tuple[Array, Array]]
    value: list[tuple[Array, Array]]
    log_std: Array


class Sample(NamedTuple):
    """Transitions of a rollout. (STEPS, WORLDS, ...) each"""

    obs: Array
    action: Array
    log_prob: Array
    value: Array
    reward: Array
    done: Array


def make_layers(key: Array, sizes: tuple[int, ...], scale: float) -> list[tuple[Array, Array]]:
    """Return weights and biases of a network; those of the last layer are multiplied by the scale."""
    keys = jax.random.split(key, len(sizes) - 1)
    make = jax.nn.initializers.orthogonal(2**0.5)
    weights = [make(key, shape) for key, shape in zip(keys, pairwise(sizes), strict=True)]
    return [(w, jnp.zeros(w.shape[1])) for w in (*weights[:-1], scale * weights[-1])]


def forward(layers: list[tuple[Array, Array]], x: Array) -> Array:
    """Return the outputs of a network with tanh between its layers. (..., n)"""
    for weight, bias in layers[:-1]:
        x = jnp.tanh(x @ weight + bias)
    weight, bias = layers[-1]
    return x @ weight + bias


def log_density(agent: Agent, mean: Array, action: Array) -> Array:
    """Return the logarithm of the density of actions, up to a constant. (...)"""
    return -(0.5 * ((action - mean) / jnp.exp(agent.log_std)) ** 2 + agent.log_std).sum(axis=-1)


def policy(agent: Agent, obs: dict[str, Array]) -> Array:
    """Return the mean actions, in [-1, 1]. (n_worlds, n_drones, 4)"""
    return jnp.tanh(forward(agent.policy, envs.flatten(obs)))


def loss(agent: Agent, sample: Sample, advantage: Array, target: Array) -> Array:
    """Return the clipped objective of PPO, with the error of the value function."""
    ratio = jnp.exp(log_density(agent, jnp.tanh(forward(agent.policy, sample.obs)), sample.action) - sample.log_prob)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage).mean()
    return 0.5 * ((forward(agent.value, sample.obs)[..., 0] - target) ** 2).mean() - gain


def build_iteration(env: envs.Env, optimizer: optax.GradientTransformation) -> Any:
    """Return the function that flies a rollout and learns from it."""

    def act(agent: Agent, obs: dict[str, Array], memory: tuple[()], key: Array) -> tuple[Array, tuple[()], Any]:
        x, mean = envs.flatten(obs), policy(agent, obs)
        action = mean + jnp.exp(agent.log_std) * jax.random.normal(key, mean.shape)
        return action, memory, (x, log_density(agent, mean, action), forward(agent.value, x)[..., 0])

    def keep(agent: Agent, step: Any) -> Sample:
        x, log_prob, value = step.extras
        final = forward(agent.value, envs.flatten(step.final_obs))[..., 0]  # where the time limit cuts an episode off
        reward = 0.1 * step.reward + DISCOUNT * jnp.where((step.truncated & ~step.terminated)[:, None], final, 0.0)
        return Sample(x, step.action, log_prob, value, reward, jnp.broadcast_to(step.done[:, None], reward.shape))

    @jax.jit
    def iterate(agent: Agent, moments: Any, state: envs.EnvState, key: Array) -> tuple[Any, ...]:
        k_fly, k_order = jax.random.split(key)
        state, _, sample = envs.rollout(env, state, partial(act, agent), k_fly, STEPS, partial(keep, agent))
        last = forward(agent.value, envs.flatten(state.obs))[..., 0]

        def accumulate(carry: Any, x: tuple[Array, ...]) -> tuple[Any, Array]:
            advantage, next_value = carry
            reward, value, done = x
            advantage = reward + DISCOUNT * ~done * (next_value + LAMBDA * advantage) - value
            return (advantage, value), advantage

        sequence = (sample.reward, sample.value, sample.done)
        _, advantage = jax.lax.scan(accumulate, (jnp.zeros_like(last), last), sequence, reverse=True)
        data = sample, advantage, advantage + sample.value

        def update(carry: Any, worlds: Array) -> tuple[Any, None]:
            agent, moments = carry
            grads = jax.grad(loss)(agent, *jax.tree.map(lambda x: x[:, worlds], data))
            updates, moments = optimizer.update(grads, moments)
            return (optax.apply_updates(agent, updates), moments), None

        orders = jax.vmap(lambda key: jax.random.permutation(key, WORLDS))(jax.random.split(k_order, EPOCHS))
        (agent, moments), _ = jax.lax.scan(update, (agent, moments), orders.reshape(EPOCHS * MINIBATCHES, -1))
        return agent, moments, state, sample.reward.mean()

    return iterate


def main(iterations: int = 100, starts: int = 1000) -> dict[str, float]:
    """Train, evaluate on held-out starts, and return the metrics."""
    env = envs.AutoReset(envs.make("hover", WORLDS))
    k_policy, k_value, k_env, key = jax.random.split(jax.random.key(0), 4)
    state = jax.jit(env.reset)(k_env)
    n_obs = envs.flatten(state.obs).shape[-1]
    layers = make_layers(k_policy, (n_obs, 64, 64, 4), 0.01), make_layers(k_value, (n_obs, 64, 64, 1), 1.0)
    agent = Agent(*layers, jnp.full(4, jnp.log(0.5)))
    schedule = optax.linear_schedule(2e-3, 0.0, iterations * EPOCHS * MINIBATCHES)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(schedule))
    moments, iterate, start = optimizer.init(agent), build_iteration(env, optimizer), time.perf_counter()
    for i in range(iterations):
        key, k = jax.random.split(key)
        agent, moments, state, reward = iterate(agent, moments, state, k)
        if i % 20 == 0:
            print(f"iteration {i}: reward {reward:.3f}, {time.perf_counter() - start:.0f} s")
    metrics = train.evaluate(envs.make("hover", starts), partial(policy, agent))
    print(f"success {metrics['success']:.1%} of {starts} starts, mean error {metrics['error']:.3f} m")
    return metrics


if __name__ == "__main__":
    main()
