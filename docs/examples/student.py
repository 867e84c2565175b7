"""Teach a policy that measures no velocities to hover, by one that observes everything.

The teacher, trained with analytic gradients, observes the whole state of the drone. The student observes attitude and
way to the goal, and how both have changed since the last step, and learns the teacher's actions (DAgger).
"""

import tempfile

import jax.numpy as jnp
from jax import Array

import crazysim.envs as envs
from crazysim import train

STUDENT_OBSERVATIONS = ("rot", "difference_to_goal")


def add_changes(obs: dict[str, Array], _) -> dict[str, Array]:
    """Return the last observations, and their differences from those before them."""
    pairs = {name: jnp.split(x, 2, axis=-1) for name, x in obs.items()}
    return {name: new for name, (_, new) in pairs.items()} | {
        f"change of {k}": new - old for k, (old, new) in pairs.items()
    }


def student_env(n_worlds: int) -> envs.Env:
    """Return the task with the observations of the student."""
    env = envs.Observe(envs.make("hover", n_worlds), lambda obs, _: {name: obs[name] for name in STUDENT_OBSERVATIONS})
    return envs.Observe(envs.FrameStack(env, 2), add_changes)


def main(iterations: int = 100) -> tuple[float, float]:
    """Train teacher and student, and print and return their success on held-out starts."""
    with tempfile.TemporaryDirectory() as folder:
        config = {"iterations": 100}
        result = train.run("hover", folder, algorithm="apg", config=config, film=False, progress=False)
    student = train.imitate(student_env(256), result.policy, {"iterations": iterations})
    metrics = train.evaluate(student_env(1000), student)
    for name, figures in (("teacher", result.metrics), ("student", metrics)):
        print(f"{name}: success {figures['success']:.1%} of 1,000 starts, mean error {figures['error']:.4f} m")
    return result.metrics["success"], metrics["success"]


if __name__ == "__main__":
    main()
