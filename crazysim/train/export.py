"""Export of policies: an ONNX file, and a C header that includes only ``math.h``.

Both take the observations of one drone, concatenated in the order of their names, and return its action in [-1, 1].
Both contain a description of their inputs and outputs. A policy with memory also takes and returns its memory, which is
zero at the start of an episode.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import crazysim
from crazysim.control import Control
from crazysim.envs.env import Env
from crazysim.envs.statistics import CLIP, EPSILON
from crazysim.errors import ConfigError, not_installed
from crazysim.storage import write_file
from crazysim.train.networks import Gru, Policy

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
GATES = ("reset", "update", "candidate")
"""Gates of a gated recurrent unit, in the order of its weights."""
OPSET, IR_VERSION = 17, 8
"""Versions of ONNX operators and of the file format, of 2022, so that older runtimes can read the files."""


class PolicyNumbers(NamedTuple):
    """Numbers of a policy, float32."""

    mean: np.ndarray
    """Mean of the observations. (n_obs,)"""
    std: np.ndarray
    """Standard deviation of the observations. (n_obs,)"""
    gru: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    """Weights of the observations, (n_obs, n_memory), and of the memory, (n_memory, n_memory), and bias of each gate;
    empty without memory."""
    layers: list[tuple[np.ndarray, np.ndarray]]
    """Weights and biases of the layers."""

    @property
    def n_memory(self) -> int:
        """Size of the memory; 0 for none."""
        return len(self.gru[0][2]) if self.gru else 0


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

    A policy with memory also has the input ``memory`` (batch, n_memory), zero at the start of an episode, and the
    output ``next_memory``, which is the input of the next step. The description of inputs and outputs is stored in the
    model's ``metadata_props`` as JSON: ``observations`` (names and sizes, in order), and ``level``, ``centre``,
    ``scale`` and ``units`` of the actions.

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
    numbers = _check_numbers(policy, meta)
    constants = {"mean": numbers.mean, "std": numbers.std, "low": np.float32(-CLIP), "high": np.float32(CLIP)}
    nodes = []

    def add_node(operator: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output

    x = add_node(
        "Clip",
        [add_node("Div", [add_node("Sub", ["observation", "mean"], "centred"), "std"], "scaled"), "low", "high"],
        "x",
    )
    if numbers.n_memory:
        constants["one"] = np.float32(1.0)
        for gate, (inputs, recurrent, bias) in zip(GATES, numbers.gru, strict=True):
            constants |= {f"{gate}_inputs": inputs, f"{gate}_recurrent": recurrent, f"{gate}_bias": bias}
            add_node("Gemm", [x, f"{gate}_inputs", f"{gate}_bias"], f"{gate}_x")
            add_node("MatMul", ["memory", f"{gate}_recurrent"], f"{gate}_h")
        for gate in ("reset", "update"):
            add_node("Sigmoid", [add_node("Add", [f"{gate}_x", f"{gate}_h"], f"{gate}_sum")], gate)
        add_node(
            "Tanh",
            [add_node("Add", ["candidate_x", add_node("Mul", ["reset", "candidate_h"], "recalled")], "c_sum")],
            "candidate",
        )
        add_node("Mul", ["update", "memory"], "kept")
        add_node("Mul", [add_node("Sub", ["one", "update"], "share"), "candidate"], "written")
        add_node("Add", ["kept", "written"], "next_memory")
        x = add_node("Concat", [x, "next_memory"], "features", axis=1)
    for i, (weight, bias) in enumerate(numbers.layers):
        constants |= {f"weight{i}": weight, f"bias{i}": bias}
        is_last = i == len(numbers.layers) - 1
        x = add_node(
            "Tanh", [add_node("Gemm", [x, f"weight{i}", f"bias{i}"], f"sum{i}")], "action" if is_last else f"x{i + 1}"
        )
    n_memory = numbers.n_memory

    def value_infos(sizes: Mapping[str, int]) -> list[Any]:
        return [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", n]) for name, n in sizes.items() if n]

    graph = helper.make_graph(
        nodes,
        "policy",
        value_infos({"observation": len(numbers.mean), "memory": n_memory}),
        value_infos({"action": len(numbers.layers[-1][1]), "next_memory": n_memory}),
        [numpy_helper.from_array(np.asarray(x), name) for name, x in constants.items()],
        doc_string="\n".join(_description_lines(meta)),
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="crazysim",
        producer_version=str(meta.get("crazysim", crazysim.__version__)),
    )
    actions = meta["actions"]
    properties = {"observations": meta["observations"], "units": _action_units(actions)} | actions
    properties |= {name: meta[name] for name in ("settings",) if name in meta}
    helper.set_model_props(model, {k: v if isinstance(v, str) else json.dumps(v) for k, v in properties.items()})
    onnx.checker.check_model(model)
    path = Path(path)
    write_file(path, model.SerializeToString())
    return path


def to_c(policy: Policy, path: str | Path, meta: Mapping[str, Any], name: str = "policy") -> Path:
    """Write a policy as a C99 header that defines ``void policy(const float observation[n], float action[k])``.

    A policy with memory has the state of a drone as its first argument: ``policy_state state; policy_reset(&state);``
    at the start of an episode, and ``policy(&state, observation, action)`` in each step. The weights are constants, so
    that they stay in flash memory. The functions allocate nothing and call only ``tanhf``, and ``expf`` with memory.

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
    numbers = _check_numbers(policy, meta)
    n_obs, n_memory, n_actions = len(numbers.mean), numbers.n_memory, len(numbers.layers[-1][1])
    guard = f"CRAZYSIM_{name.upper()}_H"
    lines = [
        f"/* Policy generated by crazysim {meta.get('crazysim', crazysim.__version__)}; do not edit.",
        " *",
        *(f" * {line}".rstrip() for line in _description_lines(meta)),
        " */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "#include <math.h>",
        "",
    ]
    constants = {"mean": numbers.mean, "std": numbers.std}
    for gate, arrays in zip(GATES, numbers.gru, strict=False):
        constants |= {f"{gate}_{kind}": x for kind, x in zip(("inputs", "recurrent", "bias"), arrays, strict=True)}
    for i, (weight, bias) in enumerate(numbers.layers):
        constants |= {f"weight{i}": weight, f"bias{i}": bias}
    for constant, x in constants.items():
        lines.append(f"static const float {name}_{constant}{''.join(f'[{n}]' for n in x.shape)} = {_array_literal(x)};")
    lines.append("")
    if n_memory:
        lines += [
            "/* Memory of one drone between steps. */",
            f"typedef struct {{ float memory[{n_memory}]; }} {name}_state;",
            "",
            "/* Call it at the start of an episode. */",
            f"static inline void {name}_reset({name}_state *state)",
            f"{{ for (int i = 0; i < {n_memory}; ++i) state->memory[i] = 0.0f; }}",
            "",
        ]
    state = f"{name}_state *state, " if n_memory else ""
    lines.append(f"static inline void {name}({state}const float observation[{n_obs}], float action[{n_actions}])")
    lines += ["{", *(f"    {line}" for line in _body_lines(name, numbers)), "}", "", f"#endif /* {guard} */", ""]
    path = Path(path)
    write_file(path, "\n".join(lines))
    return path


def _check_numbers(policy: Policy, meta: Mapping[str, Any]) -> PolicyNumbers:
    """Return the numbers of a policy, after checking them."""
    if not policy.network.is_built_in:
        raise ConfigError(
            "expected a policy with the built-in network, got one with a network of your own. Export it with its "
            "library, or with jax.export."
        )
    host_policy = jax.tree.map(lambda x: np.asarray(x, np.float32), policy)
    mean, var, layers = host_policy.stats.mean, host_policy.stats.var, host_policy.layers
    n_obs, n_actions = sum(meta["observations"].values()), len(meta["actions"]["centre"])
    if (len(mean), len(layers[-1][1])) != (n_obs, n_actions):
        raise ConfigError(
            f"expected a policy from {n_obs} observations "
            f"({', '.join(f'{k} {n}' for k, n in meta['observations'].items())}) to {n_actions} actions, got one from "
            f"{len(mean)} to {len(layers[-1][1])}; describe the environment that it was trained in"
        )
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(host_policy)):
        raise ConfigError("expected finite weights, got NaN or infinity; the training diverged, so train again")
    gru = []
    if isinstance(host_policy.body, Gru):
        arrays = (host_policy.body.inputs, host_policy.body.recurrent, host_policy.body.bias)
        gru = list(zip(*(np.split(x, len(GATES), axis=-1) for x in arrays), strict=True))
    return PolicyNumbers(mean, np.sqrt(var + np.float32(EPSILON)), gru, layers)


def _action_units(actions: Mapping[str, Any]) -> list[str]:
    n = len(actions["centre"])
    units = COMMANDS.get(Control(actions["level"]), [f"speed of rotor {i}, rpm" for i in range(n)])
    return [units[i] if i < len(units) else "?" for i in range(n)]


def _description_lines(meta: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines that describe inputs and outputs."""
    yield "Observation, concatenated:"
    offset = 0
    for name, size in meta["observations"].items():
        description = f": {OBSERVATIONS[name]}" if name in OBSERVATIONS else ""
        yield f"  [{offset}..{offset + size - 1}] {name}{description}"
        offset += size
    actions = meta["actions"]
    yield f"Action, between -1 and 1, for commands of level {actions['level']}:"
    for i, (unit, centre, scale) in enumerate(
        zip(_action_units(actions), actions["centre"], actions["scale"], strict=True)
    ):
        yield f"  [{i}] {unit} = {centre:.9g} + {scale:.9g} * action[{i}]"


def _body_lines(name: str, numbers: PolicyNumbers) -> Iterator[str]:
    """Yield the lines of the function's body."""
    n_obs, n_memory, limit = len(numbers.mean), numbers.n_memory, float_literal(CLIP)
    yield f"float x0[{n_obs + n_memory}];"
    yield f"for (int i = 0; i < {n_obs}; ++i) {{"
    yield f"    const float x = (observation[i] - {name}_mean[i]) / {name}_std[i];"
    yield f"    x0[i] = x < -{limit} ? -{limit} : (x > {limit} ? {limit} : x);"
    yield "}"
    if n_memory:
        yield f"for (int j = 0; j < {n_memory}; ++j) {{"
        for gate in GATES:
            yield f"    float {gate} = {name}_{gate}_bias[j], {gate}_memory = 0.0f;"
            yield f"    for (int i = 0; i < {n_obs}; ++i) {gate} += x0[i] * {name}_{gate}_inputs[i][j];"
            yield f"    for (int i = 0; i < {n_memory}; ++i)"
            yield f"        {gate}_memory += state->memory[i] * {name}_{gate}_recurrent[i][j];"
        yield "    reset = 1.0f / (1.0f + expf(-(reset + reset_memory)));"
        yield "    update = 1.0f / (1.0f + expf(-(update + update_memory)));"
        yield "    candidate = tanhf(candidate + reset * candidate_memory);"
        yield f"    x0[{n_obs} + j] = update * state->memory[j] + (1.0f - update) * candidate;"
        yield "}"
        yield f"for (int j = 0; j < {n_memory}; ++j) state->memory[j] = x0[{n_obs} + j];"
    for k, (weight, _) in enumerate(numbers.layers):
        n_in, n_out = weight.shape
        output = "action" if k == len(numbers.layers) - 1 else f"x{k + 1}"
        if output != "action":
            yield f"float {output}[{n_out}];"
        yield f"for (int j = 0; j < {n_out}; ++j) {{"
        yield f"    float sum = {name}_bias{k}[j];"
        yield f"    for (int i = 0; i < {n_in}; ++i) sum += x{k}[i] * {name}_weight{k}[i][j];"
        yield f"    {output}[j] = tanhf(sum);"
        yield "}"


def float_literal(x: float) -> str:
    """Return a number as a C literal that is read back bit for bit: nine digits identify any float32."""
    text = f"{float(x):.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def _array_literal(x: np.ndarray) -> str:
    if x.ndim > 1:
        return "{\n" + ",\n".join(f"    {_array_literal(row)}" for row in x) + "\n}"
    return "{" + ", ".join(map(float_literal, x)) + "}"
