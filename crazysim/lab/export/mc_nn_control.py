"""Policies for PX4's ``mc_nn_control``, a network without memory that is compiled into the firmware.

Inputs of the module: goal minus position, m; the first two rows of the rotation matrix from body to world; velocity,
m/s; angular velocity, rad/s; 15 numbers. The axes of the world are x east, y north, z up, those of the body x forward,
y left, z up. Outputs: ``thrust - 1`` of motors 1 to 4 of PX4's quadrotor x (front right, back left, front left, back
right), limited to [-1, 1]; the unit follows from the parameter ``MC_NN_THRST_COEF``. Its interpreter knows dense layers
and ReLU (PX4-Autopilot, ``src/modules/mc_nn_control`` at commit 01486656).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import Control
from crazysim.core.airframes import as_airframes
from crazysim.core.data import SimData
from crazysim.envs.env import Env
from crazysim.envs.state import Obs
from crazysim.envs.statistics import EPSILON
from crazysim.envs.wrappers import Observe
from crazysim.errors import require
from crazysim.lab.export.rl_tools import rotor_order
from crazysim.lab.export.tflite import to_tflite
from crazysim.train.networks import Network, Policy, init_mlp

OBSERVATIONS = ("difference_to_goal", "rot", "vel", "ang_vel")
"""Observations of the teacher that contain the inputs, in their order."""
MOTORS = ((1, -1), (-1, 1), (1, 1), (-1, -1))
"""Signs of x (forward) and y (left) of PX4's motors 1 to 4."""
MAX_THRUST_COEFFICIENT = 5.0
"""Largest value of ``MC_NN_THRST_COEF``."""
KNOTS = np.linspace(-3.0, 3.0, 16)
"""Points between which the curve from the student's output to the motor's thrust is straight."""


def to_mc_nn_control(
    teacher: Policy | Callable[[Obs], Array],
    env: Env,
    path: str | Path,
    iterations: int = 300,
    hidden: Sequence[int] = (64, 64),
    seed: int = 0,
) -> tuple[Policy, dict[str, float]]:
    """Distil a policy for PX4's ``mc_nn_control``, and write it as a TensorFlow Lite file.

    The student observes the 15 inputs of the module, and learns the teacher's speeds of the rotors by DAgger in the
    environment, with its airframe, sensors and effects.

    Args:
        teacher: Trained policy without memory, or any function from observations to actions.
        env: Environment of the teacher, of many worlds, whose observations include ``OBSERVATIONS``.
        iterations: Iterations of DAgger.
        hidden: Sizes of the hidden layers.

    Returns:
        The student, which flies in ``observe_inputs(env)``, and the parameters of PX4 that belong to the file, by name.
    """
    from crazysim.train.dagger import imitate

    airframe = as_airframes(env.sim.airframes, env.sim.n_drones)[0]
    require(
        env.sim.control == Control.rotor_vel,
        f"expected a policy that commands rotor speeds, got one of level {env.sim.control.value}. Train with "
        f"--set control=rotor_vel.",
    )
    order, max_speed = rotor_order(airframe, MOTORS), float(np.max(airframe.rotor_vel_limits[1]))

    def init(key: Array, n_obs: int) -> list[tuple[Array, Array]]:
        return init_mlp(key, (n_obs, *hidden), np.sqrt(2.0))

    def apply(layers: list[tuple[Array, Array]], x: Array, memory: tuple[()]) -> tuple[Array, tuple[()]]:
        for weight, bias in layers:
            x = jax.nn.relu(x @ weight + bias)
        return x, memory

    student = imitate(observe_inputs(env), teacher, {"iterations": iterations}, seed, network=Network(init, apply))
    layers = [(np.asarray(w, float), np.asarray(b, float)) for w, b in [*student.body, *student.layers]]
    # Normalisation, in the first layer.
    std = np.sqrt(np.asarray(student.stats.var, float) + EPSILON)
    weight, bias = layers[0]
    layers[0] = weight / std[:, None], bias - np.asarray(student.stats.mean, float) / std @ weight
    # Curve of each motor from the student's output, before tanh, to thrust minus 1.
    coefficient = min(MAX_THRUST_COEFFICIENT, 2e5 * (60.0 / max_speed) ** 2)
    weight, bias = (x[..., order] for x in layers.pop())
    command = env.actions.centre[order] + env.actions.scale[order] * np.tanh(KNOTS[:, None])
    thrust = coefficient / 1e5 * (np.clip(command, 0.0, max_speed) / 60.0) ** 2 - 1.0
    slopes = np.diff(thrust, axis=0, prepend=thrust[:1], append=thrust[-1:]) / (KNOTS[1] - KNOTS[0])
    changes = np.diff(slopes, axis=0).T[:, :, None] * np.eye(len(order))[:, None]
    layers += [
        (np.repeat(weight, len(KNOTS), axis=1), np.repeat(bias, len(KNOTS)) - np.tile(KNOTS, len(order))),
        (changes.reshape(-1, len(order)), thrust[0]),
    ]
    to_tflite(layers, path)
    return student, {
        "MC_NN_THRST_COEF": round(coefficient, 4),
        "MC_NN_MAX_RPM": round(max_speed),
        "MC_NN_MIN_RPM": 0,
        "THR_MDL_FAC": 0.8,
    }


def observe_inputs(env: Env) -> Env:
    """Return the environment with the inputs of ``mc_nn_control`` as its observation, ``inputs``."""

    def inputs(obs: Obs, _: SimData) -> Obs:
        missing = ", ".join(name for name in OBSERVATIONS if name not in obs)
        require(not missing, f"expected the observations {', '.join(OBSERVATIONS)}, got no {missing}. Train hover.")
        difference, rot, vel, ang_vel = (obs[name] for name in OBSERVATIONS)
        return {"inputs": jnp.concatenate([difference, rot[..., :6], vel, ang_vel], axis=-1)}

    return Observe(env, inputs)
