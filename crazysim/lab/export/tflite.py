"""Dense networks as TensorFlow Lite files, which the interpreter of microcontrollers reads (``tflite-micro``)."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazysim.errors import optional_import, require
from crazysim.storage import as_path, write_file

SCHEMA_VERSION, FILE_IDENTIFIER, ALIGNMENT = 3, b"TFL3", 16
"""Version of the schema of TensorFlow Lite, the file's identifier, and the alignment of weights, bytes."""
FULLY_CONNECTED, FULLY_CONNECTED_OPTIONS = 9, 8
"""``BuiltinOperator`` and ``BuiltinOptions`` of a dense layer."""
NO_ACTIVATION, RELU = 0, 1
"""``ActivationFunctionType``."""


def to_tflite(layers: Sequence[tuple[np.ndarray, np.ndarray]], path: str | Path) -> Path:
    """Write a dense network as a TensorFlow Lite file, with ReLU after each layer but the last.

    Args:
        layers: Weights (n_in, n_out) and biases (n_out,), first layer first.

    Raises:
        ImportError: If flatbuffers is not installed.
    """
    with optional_import("TensorFlow Lite files need", "flatbuffers", "tflite"):
        import flatbuffers
    arrays = [(np.asarray(weight, "<f4").T, np.asarray(bias, "<f4")) for weight, bias in layers]
    sizes = [arrays[0][0].shape[-1], *(len(bias) for _, bias in arrays)]
    require(
        [weight.shape for weight, _ in arrays] == [(n_out, n_in) for n_in, n_out in itertools.pairwise(sizes)],
        f"expected weights (n_in, n_out) that fit one another, got {[np.shape(weight) for weight, _ in layers]}",
    )
    require(
        all(np.isfinite(x).all() for pair in arrays for x in pair),
        "expected finite weights, got NaN or infinity; the training diverged, so train again",
    )
    builder = flatbuffers.Builder()

    # Tables, whose fields are numbered as in schema.fbs; None leaves a field out.
    def table(*fields: tuple[str, Any] | None) -> int:
        builder.StartObject(len(fields))
        for slot, field in enumerate(fields):
            if field is not None:
                getattr(builder, f"Prepend{field[0]}Slot")(slot, field[1], None)
        return builder.EndObject()

    def offsets(items: Iterable[int]) -> tuple[str, int]:
        items = list(items)
        builder.StartVector(4, len(items), 4)
        for item in reversed(items):
            builder.PrependUOffsetTRelative(item)
        return "UOffsetTRelative", builder.EndVector()

    def array(x: np.ndarray, alignment: int = 4) -> tuple[str, int]:
        builder.StartVector(x.itemsize, x.size, alignment)
        builder.head = builder.Head() - x.nbytes
        builder.Bytes[builder.Head() : builder.Head() + x.nbytes] = x.tobytes()
        return "UOffsetTRelative", builder.EndVector()

    def integers(*x: int) -> tuple[str, int]:
        return array(np.array(x, "<i4"))

    def tensor(name: str, shape: Sequence[int], buffer: int = 0) -> int:
        text = "UOffsetTRelative", builder.CreateString(name)
        return table(integers(*shape), ("Int8", 0), ("Uint32", buffer), text)

    # A tensor for the input, and three for each layer. The first buffer is empty, for tensors without weights.
    buffers, tensors, operators = [table()], [tensor("input", (1, sizes[0]))], []
    for i, (weight, bias) in enumerate(arrays):
        is_last = i == len(arrays) - 1
        for name, x in (("weights", weight), ("biases", bias)):
            buffers.append(table(array(np.frombuffer(x.tobytes(), np.uint8), ALIGNMENT)))
            tensors.append(tensor(f"{name}{i}", x.shape, len(buffers) - 1))
        tensors.append(tensor("output" if is_last else f"layer{i}", (1, sizes[i + 1])))
        options = "UOffsetTRelative", table(("Int8", NO_ACTIVATION if is_last else RELU))
        inputs, outputs = integers(3 * i, 3 * i + 1, 3 * i + 2), integers(3 * i + 3)
        operators.append(table(("Uint32", 0), inputs, outputs, ("Uint8", FULLY_CONNECTED_OPTIONS), options))
    code = table(("Int8", FULLY_CONNECTED), None, ("Int32", 1), ("Int32", FULLY_CONNECTED))
    graph = table(offsets(tensors), integers(0), integers(len(tensors) - 1), offsets(operators))
    model = table(("Uint32", SCHEMA_VERSION), offsets([code]), offsets([graph]), None, offsets(buffers))
    builder.Finish(model, FILE_IDENTIFIER)
    path = as_path(path)
    write_file(path, bytes(builder.Output()))
    return path
