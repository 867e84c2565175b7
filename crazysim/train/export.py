"""Export of policies: an ONNX file, and a C header that includes only ``math.h``.

Both take the observations of one drone, concatenated in the order of their names, and return its action in [-1, 1].
Both contain a description of their inputs and outputs.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import crazysim
from crazysim.control import Control
from crazysim.envs.env import Env
from crazysim.envs.statistics import CLIP, EPSILON
from crazysim.errors import ConfigError, not_installed
from crazysim.storage import write_file
from crazysim.train.networks import Policy

OBSERVATIONS = {
    "pos": "position, world frame, m",
    "rot": "attitude, body to world, as a rotation matrix, row by row",
    "vel": "velocity, world frame, m/s",
    "ang_vel": "angular velocity, body frame, rad/s",
    "difference_to_goal": "goal minus position, world frame, m",
    "difference_to_target_vel": "target velocity minus velocity, world frame, m/s",
}
"""Descriptions of the common observations, with frame and unit."""
COMMANDS: dict[Control, Sequence[str]] = {
    Control.state: ("x, m", "y, m", "z, m"),
    Control.attitude: ("roll, rad", "pitch, rad", "yaw, rad", "collective thrust, N"),
    Control.body_rate: ("rate about x, rad/s", "rate about y, rad/s", "rate about z, rad/s", "collective thrust, N"),
    Control.force_torque: ("collective thrust, N", "torque about x, N m", "about y, N m", "about z, N m"),
}
"""Components of a command with their units; a rotor command is one speed per rotor, rpm."""
HostLayers = list[tuple[np.ndarray, np.ndarray]]
"""Weights and biases of a network."""
OPSET, IR_VERSION = 17, 8
"""Versions of ONNX operators and of the file format, of 2022, so that older runtimes can read the files."""


def describe(env: Env) -> dict[str, Any]:
    """Return the description of a policy's inputs and outputs that ``to_onnx`` and ``to_c`` require."""
    shapes = jax.eval_shape(env.reset, jax.random.key(0)).obs
    if env.actions.centre.ndim > 1:
        raise ConfigError(
            "expected an environment whose drones have the same actions, got drones of several airframes. Describe "
            "one with a single airframe for each of them."
        )
    return {
        "crazysim": crazysim.__version__,
        "observations": {name: shapes[name].shape[-1] for name in sorted(shapes)},
        "actions": {
            "level": env.actions.control.value,
            "centre": env.actions.centre.tolist(),
            "scale": env.actions.scale.tolist(),
        },
    }


def to_onnx(policy: Policy, path: str | Path, meta: Mapping[str, Any]) -> Path:
    """Write a policy as ONNX: input ``observation`` (batch, n_obs), output ``action`` (batch, n_actions), float32.

    The description of inputs and outputs is stored in the model's ``metadata_props`` as JSON: ``observations`` (names
    and sizes, in order), and ``level``, ``centre``, ``scale`` and ``units`` of the actions.

    Args:
        policy: The policy.
        path: File to write.
        meta: Description of its inputs and outputs, from ``describe(env)`` or from ``load_policy``.

    Returns:
        The path.

    Raises:
        ImportError: If onnx is not installed.
    """
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise ImportError(not_installed("ONNX files need", "onnx", "onnx")) from error
    mean, std, layers = _numbers(policy, meta)
    constants = {"mean": mean, "std": std, "low": np.float32(-CLIP), "high": np.float32(CLIP)}
    nodes = [
        helper.make_node("Sub", ["observation", "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "std"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "low", "high"], ["x0"]),
    ]
    for i, (weight, bias) in enumerate(layers):
        constants |= {f"weight{i}": weight, f"bias{i}": bias}
        out = "action" if i == len(layers) - 1 else f"x{i + 1}"
        nodes.append(helper.make_node("Gemm", [f"x{i}", f"weight{i}", f"bias{i}"], [f"sum{i}"]))
        nodes.append(helper.make_node("Tanh", [f"sum{i}"], [out]))
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", len(mean)])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["batch", len(layers[-1][1])])],
        [numpy_helper.from_array(np.asarray(x), name) for name, x in constants.items()],
        doc_string="\n".join(_description(meta)),
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="crazysim",
        producer_version=str(meta.get("crazysim", crazysim.__version__)),
    )
    actions = meta["actions"]
    properties = {"observations": meta["observations"], "units": _units(actions)} | actions
    properties |= {name: meta[name] for name in ("settings",) if name in meta}
    helper.set_model_props(model, {k: v if isinstance(v, str) else json.dumps(v) for k, v in properties.items()})
    onnx.checker.check_model(model)
    path = Path(path)
    write_file(path, model.SerializeToString())
    return path


def to_c(policy: Policy, path: str | Path, meta: Mapping[str, Any], name: str = "policy") -> Path:
    """Write a policy as a C99 header that defines ``void policy(const float observation[n], float action[k])``.

    The weights are constants, so that they stay in flash memory. The function allocates nothing and calls only
    ``tanhf``.

    Args:
        policy: The policy.
        path: File to write.
        meta: Description of its inputs and outputs, from ``describe(env)`` or from ``load_policy``.
        name: Name of the function, and prefix of the names of the constants.

    Returns:
        The path.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ConfigError(f"expected the name of a C function, got {name!r}; use letters, digits and underscores")
    mean, std, layers = _numbers(policy, meta)
    guard = f"CRAZYSIM_{name.upper()}_H"
    lines = [
        f"/* Policy generated by crazysim {meta.get('crazysim', crazysim.__version__)}; do not edit.",
        " *",
        *(f" * {line}".rstrip() for line in _description(meta)),
        " */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "#include <math.h>",
        "",
        f"static const float {name}_mean[{len(mean)}] = {_array(mean)};",
        f"static const float {name}_std[{len(std)}] = {_array(std)};",
    ]
    for i, (weight, bias) in enumerate(layers):
        lines.append(f"static const float {name}_weight{i}[{weight.shape[0]}][{weight.shape[1]}] = {_array(weight)};")
        lines.append(f"static const float {name}_bias{i}[{len(bias)}] = {_array(bias)};")
    lines += [
        "",
        f"static inline void {name}(const float observation[{len(mean)}], float action[{len(layers[-1][1])}])",
    ]
    lines += ["{", *(f"    {line}" for line in _body(name, layers)), "}", "", f"#endif /* {guard} */", ""]
    path = Path(path)
    write_file(path, "\n".join(lines))
    return path


def _numbers(policy: Policy, meta: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, HostLayers]:
    """Return mean and standard deviation of the inputs, and the layers, as float32."""
    layers = [(np.asarray(weight, np.float32), np.asarray(bias, np.float32)) for weight, bias in policy.layers]
    mean, var = np.asarray(policy.stats.mean, np.float32), np.asarray(policy.stats.var, np.float32)
    n_obs, n_actions = sum(meta["observations"].values()), len(meta["actions"]["centre"])
    if (len(mean), len(layers[-1][1])) != (n_obs, n_actions):
        raise ConfigError(
            f"expected a policy from {n_obs} observations "
            f"({', '.join(f'{k} {n}' for k, n in meta['observations'].items())}) to {n_actions} actions, got one from "
            f"{len(mean)} to {len(layers[-1][1])}; describe the environment that it was trained in"
        )
    if not all(np.isfinite(x).all() for x in (mean, var, *(x for layer in layers for x in layer))):
        raise ConfigError("expected finite weights, got NaN or infinity; the training diverged, so train again")
    return mean, np.sqrt(var + np.float32(EPSILON)), layers


def _units(actions: Mapping[str, Any]) -> list[str]:
    n = len(actions["centre"])
    known = COMMANDS.get(Control(actions["level"]), [f"speed of rotor {i}, rpm" for i in range(n)])
    return [known[i] if i < len(known) else "?" for i in range(n)]


def _description(meta: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines that describe inputs and outputs."""
    yield "Observation, concatenated:"
    begin = 0
    for name, size in meta["observations"].items():
        description = f": {OBSERVATIONS[name]}" if name in OBSERVATIONS else ""
        yield f"  [{begin}..{begin + size - 1}] {name}{description}"
        begin += size
    actions = meta["actions"]
    yield f"Action, between -1 and 1, for commands of level {actions['level']}:"
    for i, (unit, centre, scale) in enumerate(zip(_units(actions), actions["centre"], actions["scale"], strict=True)):
        yield f"  [{i}] {unit} = {centre:.9g} + {scale:.9g} * action[{i}]"


def _body(name: str, layers: HostLayers) -> Iterator[str]:
    """Yield the lines of the function's body."""
    n_obs = layers[0][0].shape[0]
    limit = _number(CLIP)
    yield f"float x0[{n_obs}];"
    yield f"for (int i = 0; i < {n_obs}; ++i) {{"
    yield f"    const float x = (observation[i] - {name}_mean[i]) / {name}_std[i];"
    yield f"    x0[i] = x < -{limit} ? -{limit} : (x > {limit} ? {limit} : x);"
    yield "}"
    for k, (weight, _) in enumerate(layers):
        n_in, n_out = weight.shape
        out = "action" if k == len(layers) - 1 else f"x{k + 1}"
        if out != "action":
            yield f"float {out}[{n_out}];"
        yield f"for (int j = 0; j < {n_out}; ++j) {{"
        yield f"    float sum = {name}_bias{k}[j];"
        yield f"    for (int i = 0; i < {n_in}; ++i) sum += x{k}[i] * {name}_weight{k}[i][j];"
        yield f"    {out}[j] = tanhf(sum);"
        yield "}"


def _number(x: float) -> str:
    """Return a number as a C literal that is read back bit for bit: nine digits identify any float32."""
    text = f"{float(x):.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def _array(x: np.ndarray) -> str:
    if x.ndim > 1:
        return "{\n" + ",\n".join(f"    {_array(row)}" for row in x) + "\n}"
    return "{" + ", ".join(map(_number, x)) + "}"
