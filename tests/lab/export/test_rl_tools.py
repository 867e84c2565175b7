"""Checkpoints of rl-tools: their bytes, what rl-tools' own reader makes of them, and the same policy in C."""

import ctypes
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.__main__ import main
from crazysim.lab.export.rl_tools import SHAPES, evaluate, read_rl_tools, to_rl_tools, weights_to_c

READER = """
#include <cstdio>
#include <vector>
#include <rl_tools/operations/cpu.h>
#include <rl_tools/nn/layers/dense/operations_generic.h>
#include <rl_tools/nn/layers/gru/operations_generic.h>
#include <rl_tools/nn_models/sequential/operations_generic.h>
#include <rl_tools/persist/backends/tar/operations_cpu.h>
#include <rl_tools/persist/backends/tar/operations_generic.h>
#include <rl_tools/nn/optimizers/adam/instance/persist.h>
#include <rl_tools/nn/layers/dense/persist.h>
#include <rl_tools/nn/layers/gru/persist.h>
#include <rl_tools/nn_models/sequential/persist.h>

namespace rlt = rl_tools;
namespace tar = rlt::persist::backends::tar;
namespace sequential = rlt::nn_models::sequential;
using Device = rlt::devices::DefaultCPU;
using Index = Device::index_t;
using Types = rlt::numeric_types::Policy<float>;
using Activation = rlt::nn::activation_functions::ActivationFunction;
template <int N, Activation F>
using Dense = rlt::nn::layers::dense::BindConfiguration<rlt::nn::layers::dense::Configuration<Types, Index, N, F>>;
using Gru = rlt::nn::layers::gru::BindConfiguration<rlt::nn::layers::gru::Configuration<Types, Index, 16>>;
using Last = sequential::Module<Dense<4, Activation::IDENTITY>>;
using Chain = sequential::Module<Dense<16, Activation::RELU>, sequential::Module<Gru, Last>>;
using Inputs = rlt::tensor::Shape<Index, 500, 2, 22>;
using Policy = sequential::Build<rlt::nn::capability::Forward<true>, Chain, Inputs>;
template <typename Shape> using Tensor = rlt::Tensor<rlt::tensor::Specification<float, Index, Shape>>;

int main(int, char **arguments)
{
    Device device;
    Device::SPEC::RANDOM::ENGINE<> rng;
    Policy policy;
    Policy::Buffer<true> buffer;
    Tensor<Policy::INPUT_SHAPE> input;
    Tensor<Policy::OUTPUT_SHAPE> output, stored;
    rlt::malloc(device, policy);
    rlt::malloc(device, buffer);
    rlt::malloc(device, input);
    rlt::malloc(device, output);
    rlt::malloc(device, stored);
    std::vector<char> bytes(1 << 20);
    tar::ReaderGroup<tar::ReaderGroupSpecification<Index>> file;
    FILE *stream = fopen(arguments[1], "rb");
    file.size = fread(bytes.data(), 1, bytes.size(), stream);
    file.data = bytes.data();
    auto actor = rlt::get_group(device, file, "actor"), example = rlt::get_group(device, file, "example");
    rlt::load(device, policy, actor);
    rlt::load(device, input, example, "input");
    rlt::load(device, stored, example, "output");
    rlt::evaluate(device, policy, input, output, buffer, rng);
    fwrite(rlt::data(input), 4, 500 * 2 * 22, stdout);
    fwrite(rlt::data(stored), 4, 500 * 2 * 4, stdout);
    fwrite(rlt::data(output), 4, 500 * 2 * 4, stdout);
}
"""


@pytest.fixture(scope="module")
def weights():
    rng = np.random.default_rng(0)
    return {name: rng.normal(scale=0.4, size=shape).astype(np.float32) for name, shape in SHAPES.items()}


@pytest.fixture(scope="module")
def checkpoint(weights, tmp_path_factory):
    return to_rl_tools(weights, tmp_path_factory.mktemp("checkpoint") / "policy.tar", "random weights")


def entries_of(content):
    """Return the entries of a tar archive by name, as rl-tools seeks them: header, content, padding to 512 bytes."""
    entries, start = {}, 0
    while content[start]:
        header = content[start : start + 512]
        assert header[257:262] == b"ustar"
        size, start = int(header[124:136].rstrip(b"\0 "), 8), start + 512
        entries[header[:100].rstrip(b"\0").decode()] = content[start : start + size]
        start += -(-size // 512) * 512
    return entries


def test_a_checkpoint_has_the_entries_that_mc_raptor_seeks(weights, checkpoint):
    entries = entries_of(checkpoint.read_bytes())
    assert sum(x.size for x in weights.values()) == 2084
    assert entries["actor/meta"] == b"checkpoint_name: random weights\ntype: sequential\n"
    assert entries["actor/layers/0/meta"] == b"activation_function: RELU\ntype: dense\n"
    parameters = "actor/layers/1/weights_hidden/parameters"
    assert entries[f"{parameters}/meta"] == b"type: tensor\ndtype: float32\nnum_dims: 2\ndim_0: 48\ndim_1: 16\n"
    assert entries[f"{parameters}/data"] == weights["1/weights_hidden"].astype("<f4").tobytes()
    # mc_raptor seeks only the data of the example: 5 steps of 2 episodes, with the strides of its own.
    inputs = np.frombuffer(entries["example/input/data"], "<f4").reshape(500, 2, 22)
    outputs = np.frombuffer(entries["example/output/data"], "<f4").reshape(500, 2, 4)
    np.testing.assert_allclose(evaluate(weights, inputs[:5]), outputs[:5], atol=1e-6)
    # Its buffers: 256 bytes for the attributes of the policy, 100 for those of a tensor.
    assert all(len(x) < (256 if name == "actor/meta" else 100) for name, x in entries.items() if name.endswith("meta"))


def test_a_checkpoint_is_read_back(weights, checkpoint):
    read = read_rl_tools(checkpoint)
    assert read.keys() == weights.keys()
    assert all(np.array_equal(read[name], x) for name, x in weights.items())


def test_rl_tools_reads_the_checkpoint_and_computes_the_same(tmp_path, weights, checkpoint):
    if find_spec("rltools") is None or shutil.which("g++") is None:
        pytest.skip("needs rltools, whose package contains the C++ headers, and g++")
    include = Path(find_spec("rltools").submodule_search_locations[0]) / "external" / "rl_tools" / "include"
    source, program = tmp_path / "reader.cpp", tmp_path / "reader"
    source.write_text(READER)
    subprocess.run(["g++", "-std=c++17", "-O1", "-w", f"-I{include}", source, "-o", program], check=True)
    printed = subprocess.run([program, checkpoint], check=True, capture_output=True).stdout
    inputs, stored, outputs = np.split(np.frombuffer(printed, np.float32), [22_000, 26_000])
    expected = evaluate(weights, inputs.reshape(500, 2, 22))
    assert np.abs(expected).mean() > 0.3
    np.testing.assert_allclose(outputs.reshape(500, 2, 4), expected, atol=1e-5)
    np.testing.assert_allclose(outputs, stored, atol=1e-5)


def test_c_computes_the_same_limited_to_one(tmp_path, weights):
    source, library = tmp_path / "use.c", tmp_path / "use.so"
    source.write_text(
        f'#include "{weights_to_c(weights, tmp_path / "policy.h")}"\n'
        "void fly(int n, const float *observation, float *action);\n"
        "void fly(int n, const float *observation, float *action)\n{\n    policy_state state;\n"
        "    policy_reset(&state);\n"
        "    for (int i = 0; i < n; ++i) policy(&state, observation + 22 * i, action + 4 * i);\n}\n"
    )
    cc = shutil.which("cc") or shutil.which("gcc") or "cc"
    flags = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-shared", "-fPIC")
    subprocess.run([cc, *flags, source, "-o", library, "-lm"], check=True)
    observations = np.random.default_rng(1).normal(size=(200, 22)).astype(np.float32)
    actions = np.empty((200, 4), np.float32)
    pointers = (x.ctypes.data_as(ctypes.POINTER(ctypes.c_float)) for x in (observations, actions))
    ctypes.CDLL(str(library)).fly(len(observations), *pointers)
    expected = evaluate(weights, observations[:, None])[:, 0]
    assert 0.1 < np.mean(np.abs(expected) > 1) < 0.9
    np.testing.assert_allclose(actions, expected.clip(-1, 1), atol=1e-5)


def test_wrong_weights_names_and_files_are_refused(tmp_path, weights, checkpoint):
    path = tmp_path / "policy.tar"
    for wrong in (
        weights | {"0/weights": np.zeros((16, 21))},
        {name: x for name, x in weights.items() if name != "2/biases"},
        weights | {"2/biases": np.full(4, np.nan)},
    ):
        with pytest.raises(ConfigError, match=r"expected .*weights"):
            to_rl_tools(wrong, path)
    for name in ("", "a\nb", "a" * 100):
        with pytest.raises(ConfigError, match="name of at most 99"):
            to_rl_tools(weights, path, name)
    swapped = checkpoint.read_bytes().replace(b"dim_0: 16\ndim_1: 22", b"dim_0: 22\ndim_1: 16")
    path.write_bytes(swapped)
    with pytest.raises(ConfigError, match="Use a policy of this shape"):
        read_rl_tools(path)
    for content in (b"", b"not an archive", swapped.replace(b"dim_0", b"dim_9")):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match="expected a checkpoint of rl-tools"):
            read_rl_tools(path)


def test_the_command_writes_a_checkpoint_for_every_flight_controller(tmp_path, capsys, weights):
    policy = to_rl_tools(weights, tmp_path / "mine.tar", "mine")
    files = ["--rl-tools", f"{tmp_path}/policy.tar", "--c", f"{tmp_path}/mine.h"]
    assert main(["export", str(policy), *files, "--betaflight", str(tmp_path), "--out-of-tree", str(tmp_path)]) == 0
    assert (tmp_path / "policy.tar").read_bytes() == policy.read_bytes()
    assert "for bumblebee" not in (tmp_path / "controller.c").read_text()
    *written, cost = capsys.readouterr().out.splitlines()
    names = ["policy.tar", "mine.h", "policy.h", "controller.c", "policy.h", "betaflight.h"]
    assert written == [f"wrote {tmp_path / name}" for name in names]
    assert cost.startswith("1,952 multiply-adds, 32 sigmoids and 16 tanh: at most 164 us on a Cortex-M4")
    assert main(["export", str(policy), "--out-of-tree", str(tmp_path), "--drone", "bumblebee"]) == 0
    assert "for bumblebee" in (tmp_path / "controller.c").read_text()
    assert main(["export", str(policy), "--onnx", "x.onnx"]) == 2
    assert "got --onnx" in capsys.readouterr().err
