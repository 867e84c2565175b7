"""Export of policies: an ONNX file, and a C header that includes only ``math.h``.

The exported functions take the observations of one drone, concatenated in the order of their names, and return its
action in [-1, 1]. Both files describe these inputs and outputs, with the camera of each image. A policy with memory
also takes and returns its memory, which is zero at the start of an episode.

Actions and memory are finite whatever is observed: an observation that is NaN counts as its mean in training, an
infinite one as the largest normalised value, and a pixel that is neither counts as 0. A controller that should stop
without a valid state has to check the state itself, as the out of tree controller does.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import crazysim
from crazysim.control import Control
from crazysim.envs.statistics import CLIP, EPSILON
from crazysim.errors import optional_import, require, require_type
from crazysim.storage import as_path, write_file
from crazysim.train.convolution import KERNEL_SIZE, STRIDE, Image
from crazysim.train.interface import Interface, sizes_text
from crazysim.train.networks import Encoder, Gru, Policy

OBSERVATION_DESCRIPTIONS = {
    "pos": "position, world frame, m",
    "rot": "attitude, body to world, as a rotation matrix, row by row",
    "vel": "velocity, world frame, m/s",
    "ang_vel": "angular velocity, body frame, rad/s",
    "difference_to_goal": "goal minus position (of the load in transport and deliver), world frame, m",
    "heading": "horizontal unit vector along the yaw, world frame, x and y",
    "heading_vel": "velocity along the heading: ahead, left, up, m/s",
    "goal_direction": "unit vector to the goal along the heading: ahead, left, up",
    "goal_distance": "distance from the goal, m",
    "height": "height above the ground, m",
    "offset": "position to the left of the middle of the corridor, m",
    "up": "upward unit vector, body frame",
    "difference_to_target_vel": "target velocity minus velocity, world frame, m/s",
}
"""Descriptions of the common observations, with frame and unit."""
COMMAND_COMPONENTS: dict[Control, Sequence[str]] = {
    Control.state: ("x, m", "y, m", "z, m"),
    Control.attitude: ("roll, rad", "pitch, rad", "yaw, rad", "collective thrust, N"),
    Control.body_rate: ("rate about x, rad/s", "rate about y, rad/s", "rate about z, rad/s", "collective thrust, N"),
    Control.force_torque: ("collective thrust, N", "torque about x, N m", "about y, N m", "about z, N m"),
}
"""Components of a command with their units. Commands of rotor speeds are left out: they have one speed per rotor,
rpm."""
GRU_GATES = ("reset", "update", "candidate")
"""Gates of a gated recurrent unit, in the order of its weights."""
POLICY_REMEDY = "Use the first result of load_policy."
OPSET, IR_VERSION = 17, 8
"""Versions of ONNX operators and of the file format, of 2022, so that older runtimes can read the files."""


class PolicyNumbers(NamedTuple):
    """Numbers of a policy, float32."""

    mean: np.ndarray
    """Mean of the observations. (n_obs,)"""
    std: np.ndarray
    """Standard deviation of the observations. (n_obs,)"""
    images: tuple[Image, ...]
    """Images that convolutions replace by features."""
    convolutions: Sequence[Sequence[tuple[Any, Any]]]
    """Weights (9 n_in, n_out) and biases (n_out,) of the layers of each image."""
    gru: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    """Weights of the inputs (n_inputs, n_memory), weights of the memory (n_memory, n_memory) and biases (n_memory,) of
    each gate; empty without memory."""
    layers: list[tuple[np.ndarray, np.ndarray]]
    """Weights and biases of the layers after convolutions and memory."""

    @property
    def n_memory(self) -> int:
        """Size of the memory; 0 for none."""
        return len(self.gru[0][2]) if self.gru else 0

    @property
    def vector_ranges(self) -> list[range]:
        """Indices of the observations that are not pixels: before, between and after the images."""
        starts, ends = [0, *(x.pixels.stop for x in self.images)], [x.start for x in self.images] + [len(self.mean)]
        return [range(start, end) for start, end in zip(starts, ends, strict=True) if start < end]

    @property
    def n_inputs(self) -> int:
        """Number of inputs of memory and layers: observations that are not pixels, and features of images."""
        return len(self.layers[0][0]) - self.n_memory


def to_onnx(policy: Policy, path: str | Path, meta: Mapping[str, Any]) -> Path:
    """Write a policy as ONNX: input ``observation`` (batch, n_obs), output ``action`` (batch, n_actions), float32.

    A policy with memory also has the input ``memory`` (batch, n_memory), zero at the start of an episode, and the
    output ``next_memory``, which is the input of the next step. The description of inputs and outputs is stored in the
    model's ``metadata_props`` as JSON: ``observations`` (names and sizes, in order), ``images`` (size and camera of
    each image; pixels are row by row), and ``level``, ``centre``, ``scale`` and ``units`` of the actions.

    Args:
        meta: Description of the policy's inputs and outputs, from ``describe(env)`` or from ``load_policy``.

    Raises:
        ImportError: If onnx is not installed.
    """
    with optional_import("ONNX files need", "onnx", "onnx"):
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    numbers = policy_numbers(policy, meta)
    constants = {"mean": numbers.mean, "std": numbers.std, "low": np.float32(-CLIP), "high": np.float32(CLIP)}
    constants["zero"] = np.float32(0.0)
    nodes = []

    def add_node(operator: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output

    # Normalised observations, clipped, with zeros for NaN.
    add_node("Div", [add_node("Sub", ["observation", "mean"], "centred"), "std"], "scaled")
    add_node("Clip", ["scaled", "low", "high"], "clipped")
    x = add_node("Where", [add_node("IsNaN", ["scaled"], "is_nan"), "zero", "clipped"], "x")
    if numbers.images:
        x = _add_convolutions(add_node, constants, numbers, x)
    if numbers.n_memory:
        # Gated recurrent unit.
        constants["one"] = np.float32(1.0)
        for gate, (inputs, recurrent, bias) in zip(GRU_GATES, numbers.gru, strict=True):
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
    # Perceptron, with tanh after each layer.
    for i, (weight, bias) in enumerate(numbers.layers):
        constants |= {f"weight{i}": weight, f"bias{i}": bias}
        is_last = i == len(numbers.layers) - 1
        x = add_node(
            "Tanh", [add_node("Gemm", [x, f"weight{i}", f"bias{i}"], f"sum{i}")], "action" if is_last else f"x{i + 1}"
        )
    n_memory = numbers.n_memory

    def value_infos(sizes: Mapping[str, int]) -> list[Any]:
        return [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", n]) for name, n in sizes.items() if n]

    # File with metadata for programs that load it.
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
    stored = ("settings", "images", "task", "freq", "task_code")
    properties |= {name: meta[name] for name in stored if meta.get(name) is not None}
    helper.set_model_props(model, {k: v if isinstance(v, str) else json.dumps(v) for k, v in properties.items()})
    onnx.checker.check_model(model)
    path = as_path(path)
    write_file(path, model.SerializeToString())
    return path


def _add_convolutions(
    add_node: Callable[..., str], constants: dict[str, Any], numbers: PolicyNumbers, normalized: str
) -> str:
    constants |= {"axis": np.array([1]), "one_metre": np.float32(1.0), "flat": np.array([0, -1])}

    def add_slice(source: str, indices: range) -> str:
        name = f"observation{indices.start}"
        constants.update({f"{name}_start": np.array([indices.start]), f"{name}_end": np.array([indices.stop])})
        return add_node("Slice", [source, f"{name}_start", f"{name}_end", "axis"], name)

    parts = [add_slice(normalized, indices) for indices in numbers.vector_ranges]
    for i, (image, layers) in enumerate(zip(numbers.images, numbers.convolutions, strict=True)):
        constants[f"shape{i}"] = np.array([0, *image.shape])
        x = add_slice("observation", image.pixels)
        if image.is_depth:
            x = add_node("Reciprocal", [add_node("Add", [x, "one_metre"], f"distance{i}")], f"nearness{i}")
        is_invalid = add_node("IsNaN", [add_node("Mul", [x, "zero"], f"nought{i}")], f"is_invalid{i}")  # inf * 0 is NaN
        x = add_node("Where", [is_invalid, "zero", x], f"valid{i}")
        x = add_node("Reshape", [x, f"shape{i}"], f"pixels{i}")
        x = add_node("Transpose", [x], f"image{i}", perm=[0, 3, 1, 2])
        for k, (weight, bias) in enumerate(layers):
            kernel = weight.reshape(KERNEL_SIZE, KERNEL_SIZE, -1, len(bias)).transpose(3, 2, 0, 1)
            constants |= {f"kernel{i}_{k}": np.ascontiguousarray(kernel), f"kernel_bias{i}_{k}": bias}
            inputs = [x, f"kernel{i}_{k}", f"kernel_bias{i}_{k}"]
            x = add_node("Conv", inputs, f"sum{i}_{k}", pads=[1] * 4, strides=[STRIDE] * 2)
            x = add_node("Relu", [x], f"layer{i}_{k}")
        x = add_node("Transpose", [x], f"channels{i}", perm=[0, 2, 3, 1])
        parts.append(add_node("Reshape", [x, "flat"], f"features{i}"))
    return add_node("Concat", parts, "inputs", axis=1)


def to_c(policy: Policy, path: str | Path, meta: Mapping[str, Any], name: str = "policy") -> Path:
    """Write a policy as a C99 header that defines ``void policy(const float observation[n], float action[k])``.

    A policy with memory has the state of a drone as its first argument: ``policy_state state; policy_reset(&state);``
    at the start of an episode, and ``policy(&state, observation, action)`` in each step. The weights are constants, so
    that they stay in flash memory. The functions allocate nothing and call only ``tanhf``, and ``expf`` with memory.

    Args:
        meta: Description of the policy's inputs and outputs, from ``describe(env)`` or from ``load_policy``.
        name: Name of the function, and prefix of the names of the constants.
    """
    require(
        isinstance(name, str) and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name),
        f"expected the name of a C function, got {name!r}; use letters, digits and underscores",
    )
    numbers = policy_numbers(policy, meta)
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
    # Weights.
    constants = {"mean": numbers.mean, "std": numbers.std}
    for i, layers in enumerate(numbers.convolutions):
        for k, (weight, bias) in enumerate(layers):
            constants |= {f"kernel{i}_{k}": weight, f"kernel_bias{i}_{k}": bias}
    for gate, arrays in zip(GRU_GATES, numbers.gru, strict=False):
        constants |= {f"{gate}_{kind}": x for kind, x in zip(("inputs", "recurrent", "bias"), arrays, strict=True)}
    for i, (weight, bias) in enumerate(numbers.layers):
        constants |= {f"weight{i}": weight, f"bias{i}": bias}
    for constant, x in constants.items():
        lines.append(constant_line(f"{name}_{constant}", x))
    lines.append("")
    # Memory, and the function that resets it.
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
    # The policy.
    state = f"{name}_state *state, " if n_memory else ""
    lines.append(f"static inline void {name}({state}const float observation[{n_obs}], float action[{n_actions}])")
    lines += ["{", *(f"    {line}" for line in _body_lines(name, numbers)), "}", "", f"#endif /* {guard} */", ""]
    path = as_path(path)
    write_file(path, "\n".join(lines))
    return path


def policy_numbers(policy: Policy, meta: Mapping[str, Any]) -> PolicyNumbers:
    """Return the numbers of a policy with the built-in network, after checking that they fit a description."""
    require_type(policy, Policy, POLICY_REMEDY)
    described = Interface.read(meta)
    if policy.interface is not None:
        policy.interface.require(described, "a description")
    require(
        policy.network.is_built_in,
        "expected a policy with the built-in network, got one with another network. Export it with raptor_weights if "
        "it is of RAPTOR's shape, with its library, or with jax.export.",
    )
    host_policy = jax.tree.map(lambda x: np.asarray(x, np.float32), policy)
    mean, var, layers = host_policy.stats.mean, host_policy.stats.var, host_policy.layers
    body, convolutions = host_policy.body, ()
    if isinstance(body, Encoder):
        body, convolutions = body.memory, body.convolutions
    n_obs, n_actions = sum(described.sizes.values()), len(described.ranges)
    require(
        (len(mean), len(layers[-1][1])) == (n_obs, n_actions),
        f"expected a policy from {sizes_text(described.sizes)} to {n_actions} actions, got one from {len(mean)} to "
        f"{len(layers[-1][1])}. Describe the environment that it was trained in.",
    )
    require(
        all(np.isfinite(x).all() for x in jax.tree.leaves(host_policy)),
        "expected finite weights, got NaN or infinity; the training diverged, so train again",
    )
    gru = []
    if isinstance(body, Gru):
        arrays = (body.inputs, body.recurrent, body.bias)
        gru = list(zip(*(np.split(x, len(GRU_GATES), axis=-1) for x in arrays), strict=True))
    return PolicyNumbers(mean, np.sqrt(var + np.float32(EPSILON)), policy.network.images, convolutions, gru, layers)


def _action_units(actions: Mapping[str, Any]) -> list[str]:
    n = len(actions["centre"])
    units = COMMAND_COMPONENTS.get(Control(actions["level"]), [f"speed of rotor {i}, rpm" for i in range(n)])
    return [units[i] if i < len(units) else "?" for i in range(n)]


def _description_lines(meta: Mapping[str, Any]) -> Iterator[str]:
    if meta.get("freq") is not None:
        yield f"Policy of the task {meta['task']}, {meta['freq']} actions per second."
    yield "Observation, concatenated:"
    offset = 0
    for name, size in Interface.read(meta).observations:
        description = f": {OBSERVATION_DESCRIPTIONS[name]}" if name in OBSERVATION_DESCRIPTIONS else ""
        if name in meta.get("images", {}):
            description = ": image, row by row: " + json.dumps(meta["images"][name])
        yield f"  [{offset}..{offset + size - 1}] {name}{description}"
        offset += size
    actions = meta["actions"]
    yield f"Action, between -1 and 1, for commands of level {actions['level']}:"
    for i, (unit, centre, scale) in enumerate(
        zip(_action_units(actions), actions["centre"], actions["scale"], strict=True)
    ):
        yield f"  [{i}] {unit} = {centre:.9g} + {scale:.9g} * action[{i}]"


def _body_lines(name: str, numbers: PolicyNumbers) -> Iterator[str]:
    n_inputs, n_memory, limit = numbers.n_inputs, numbers.n_memory, float_literal(CLIP)
    yield f"float x0[{n_inputs + n_memory}];"
    offset = 0
    # Normalised observations, then features of images.
    for indices in numbers.vector_ranges:
        yield f"for (int i = {indices.start}; i < {indices.stop}; ++i) {{"
        yield f"    const float x = (observation[i] - {name}_mean[i]) / {name}_std[i];"
        target = "i" if indices.start == offset else f"i - {indices.start - offset}"
        yield f"    x0[{target}] = isnan(x) ? 0.0f : (x < -{limit} ? -{limit} : (x > {limit} ? {limit} : x));"
        yield "}"
        offset += len(indices)
    for i, (image, layers) in enumerate(zip(numbers.images, numbers.convolutions, strict=True)):
        yield from _convolution_lines(name, i, image, layers, offset)
        offset += math.prod(list(image.shapes([len(bias) for _, bias in layers]))[-1])
    if n_memory:
        # Gated recurrent unit.
        yield f"for (int j = 0; j < {n_memory}; ++j) {{"
        for gate in GRU_GATES:
            yield f"    float {gate} = {name}_{gate}_bias[j], {gate}_memory = 0.0f;"
            yield f"    for (int i = 0; i < {n_inputs}; ++i) {gate} += x0[i] * {name}_{gate}_inputs[i][j];"
            yield f"    for (int i = 0; i < {n_memory}; ++i)"
            yield f"        {gate}_memory += state->memory[i] * {name}_{gate}_recurrent[i][j];"
        yield "    reset = 1.0f / (1.0f + expf(-(reset + reset_memory)));"
        yield "    update = 1.0f / (1.0f + expf(-(update + update_memory)));"
        yield "    candidate = tanhf(candidate + reset * candidate_memory);"
        yield f"    x0[{n_inputs} + j] = update * state->memory[j] + (1.0f - update) * candidate;"
        yield "}"
        yield f"for (int j = 0; j < {n_memory}; ++j) state->memory[j] = x0[{n_inputs} + j];"
    # Perceptron.
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


def _convolution_lines(name: str, i: int, image: Image, layers: Sequence[Any], offset: int) -> Iterator[str]:
    shapes = list(image.shapes([len(bias) for _, bias in layers]))
    yield f"float image{i}_0[{len(image.pixels)}];"
    yield f"for (int p = 0; p < {len(image.pixels)}; ++p) {{"
    pixel = f"observation[{image.start} + p]"
    yield f"    const float x = {f'1.0f / (1.0f + {pixel})' if image.is_depth else pixel};"
    yield f"    image{i}_0[p] = isfinite(x) ? x : 0.0f;"
    yield "}"
    for k, ((height, width, n_in), (rows, columns, n_out)) in enumerate(itertools.pairwise(shapes)):
        target, start = f"image{i}_{k + 1}", 0
        if k == len(layers) - 1:
            target, start = "x0", offset
        else:
            yield f"float {target}[{rows * columns * n_out}];"
        yield f"for (int r = 0; r < {rows}; ++r) for (int c = 0; c < {columns}; ++c)"
        yield f"for (int j = 0; j < {n_out}; ++j) {{"
        yield f"    float sum = {name}_kernel_bias{i}_{k}[j];"
        yield f"    for (int a = 0; a < {KERNEL_SIZE}; ++a) for (int b = 0; b < {KERNEL_SIZE}; ++b) {{"
        yield f"        const int y = {STRIDE} * r + a - 1, x = {STRIDE} * c + b - 1;"
        yield f"        if (y < 0 || y >= {height} || x < 0 || x >= {width}) continue;"
        yield f"        for (int m = 0; m < {n_in}; ++m)"
        yield f"            sum += image{i}_{k}[(y * {width} + x) * {n_in} + m]"
        yield f"                * {name}_kernel{i}_{k}[(a * {KERNEL_SIZE} + b) * {n_in} + m][j];"
        yield "    }"
        yield f"    {target}[{start} + (r * {columns} + c) * {n_out} + j] = sum > 0.0f ? sum : 0.0f;"
        yield "}"


def float_literal(x: float) -> str:
    """Return a number as a C literal that is read back bit for bit: nine digits identify any float32."""
    text = f"{float(x):.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def constant_line(name: str, x: np.ndarray) -> str:
    """Return the definition of an array as a C constant."""
    return f"static const float {name}{''.join(f'[{n}]' for n in x.shape)} = {_array_literal(x)};"


def _array_literal(x: np.ndarray) -> str:
    if x.ndim > 1:
        return "{\n" + ",\n".join(f"    {_array_literal(row)}" for row in x) + "\n}"
    return "{" + ", ".join(map(float_literal, x)) + "}"
