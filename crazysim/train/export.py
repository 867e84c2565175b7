"""Export of policies for flight controllers and other programs, and the description that it needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from crazysim.envs.env import Env
from crazysim.errors import require, require_type
from crazysim.names import lazy_getattr
from crazysim.train.interface import describe_env

if TYPE_CHECKING:
    from crazysim.lab.export.betaflight import to_betaflight
    from crazysim.lab.export.cost import cost_text
    from crazysim.lab.export.mc_nn_control import observe_inputs, to_mc_nn_control
    from crazysim.lab.export.out_of_tree import to_out_of_tree
    from crazysim.lab.export.policies import to_c, to_onnx
    from crazysim.lab.export.rl_tools import (
        find_weights,
        raptor_order,
        raptor_policy,
        raptor_weights,
        read_rl_tools,
        shipped_weights,
        to_rl_tools,
        weights_to_c,
    )
    from crazysim.lab.export.tflite import to_tflite

__all__ = [
    "cost_text", "describe", "find_weights", "observe_inputs", "raptor_order", "raptor_policy",
    "raptor_weights", "read_rl_tools", "shipped_weights", "to_betaflight", "to_c", "to_mc_nn_control",
    "to_onnx", "to_out_of_tree", "to_rl_tools", "to_tflite", "weights_to_c",
]  # fmt: skip

__getattr__ = lazy_getattr(__name__)


def describe(env: Env) -> dict[str, Any]:
    """Describe a policy's inputs and outputs, as ``to_onnx`` and ``to_c`` require."""
    require_type(env, Env, "Use crazysim.envs.make('hover', n_worlds).")
    require(
        env.actions.centre.ndim <= 1,
        "expected an environment whose drones have the same actions, got drones of several airframes. Describe "
        "one with a single airframe for each of them.",
    )
    return describe_env(env)
