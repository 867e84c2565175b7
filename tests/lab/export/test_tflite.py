"""TensorFlow Lite files, read by the interpreter of microcontrollers, which PX4's mc_nn_control runs."""

import itertools

import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.lab.export.tflite import to_tflite


@pytest.fixture(scope="module")
def layers():
    rng = np.random.default_rng(0)
    pairs = itertools.pairwise((15, 64, 32, 4))
    return [(rng.normal(size=(n, m)) / np.sqrt(n), rng.normal(size=m)) for n, m in pairs]


def test_the_interpreter_computes_the_network_in_the_memory_of_mc_nn_control(tmp_path, layers):
    runtime = pytest.importorskip("tflite_micro.python.tflite_micro.runtime")
    path = to_tflite(layers, tmp_path / "control_net.tflite")
    interpreter = runtime.Interpreter.from_file(str(path), arena_size=10 * 1024)
    x = np.random.default_rng(1).normal(size=(50, 15)).astype(np.float32)
    outputs = []
    for row in x:
        interpreter.set_input(row[None], 0)
        interpreter.invoke()
        outputs.append(interpreter.get_output(0)[0])
    for weight, bias in layers[:-1]:
        x = np.maximum(x @ weight + bias, 0)
    np.testing.assert_allclose(outputs, x @ layers[-1][0] + layers[-1][1], atol=1e-5)


def test_a_file_has_dense_layers_only_and_aligned_weights(tmp_path, layers):
    schema = pytest.importorskip("tflite_micro.tensorflow.lite.micro.python.schema_py_generated")
    content = to_tflite(layers, tmp_path / "control_net.tflite").read_bytes()
    assert content[4:8] == b"TFL3"
    model = schema.Model.GetRootAsModel(content, 0)
    graph = model.Subgraphs(0)
    assert (model.Version(), model.SubgraphsLength(), model.OperatorCodesLength()) == (3, 1, 1)
    assert model.OperatorCodes(0).BuiltinCode() == schema.BuiltinOperator.FULLY_CONNECTED
    assert (graph.Inputs(0), graph.Outputs(0)) == (0, graph.TensorsLength() - 1)
    assert [graph.Tensors(i).ShapeAsNumpy().tolist() for i in (0, graph.TensorsLength() - 1)] == [[1, 15], [1, 4]]
    for weight, bias in layers:
        for x in (weight.T, bias):
            assert content.index(x.astype("<f4").tobytes()) % 16 == 0


def test_layers_that_do_not_fit_and_nan_are_refused(tmp_path, layers):
    with pytest.raises(ConfigError, match="that fit one another"):
        to_tflite([layers[0], layers[2]], tmp_path / "net.tflite")
    with pytest.raises(ConfigError, match="train again"):
        to_tflite([(np.full((15, 4), np.nan), np.zeros(4))], tmp_path / "net.tflite")
