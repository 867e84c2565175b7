"""The CUDA kernels of PPO's networks, run on the host, and where they are used."""

import ctypes
import re
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim.engine.backends import cuda
from crazysim.engine.sharding import world_mesh
from crazysim.train import mlp_kernel
from crazysim.train.mlp_kernel import CAPABILITY, INTRINSICS, DistributedMlp, apply_mlp, choose_mlp, cuda_source
from crazysim.train.networks import MEMORYLESS_NETWORK, gru_network, init_mlp, mlp

HOST_HEADER = Path(__file__).with_name("gpu_on_host.h")
H100 = SimpleNamespace(platform="gpu", compute_capability=f"{CAPABILITY / 10}")


@pytest.fixture(scope="module")
def compile_for_host(tmp_path_factory):
    """Return the function of a library that runs a kernel with blocks of CUDA threads on the host."""
    if sys.platform != "linux":
        pytest.skip("the threads on the host need Linux")
    folder, functions = tmp_path_factory.mktemp("kernels"), {}

    def compiled(source, name, n_threads):
        if source not in functions:
            source_path, path = folder / f"{len(functions)}.cpp", folder / f"{len(functions)}.so"
            (parameters,) = re.findall(rf"^{name}\((.*)\) ", source, re.MULTILINE)
            arguments = ", ".join(f"({x.rpartition(' ')[0]})p[{i}]" for i, x in enumerate(parameters.split(", ")))
            body = re.sub(r"extern __shared__.*;", "", source)
            call = f"run([](void** p) {{ {name}({arguments}); }}, p, x, y, {n_threads});"
            text = f'#include "{HOST_HEADER}"\n{body}\nextern "C" void call(void** p, int x, int y) {{ {call} }}\n'
            source_path.write_text(text)
            words = ["g++", "-std=c++17", "-O1", "-w", "-shared", "-fPIC", "-Wl,-Bsymbolic"]
            subprocess.run([*words, source_path, "-o", path], check=True)
            functions[source] = ctypes.CDLL(str(path)).call
        return functions[source]

    return compiled


@pytest.fixture
def on_host(monkeypatch, compile_for_host):
    lock = threading.Lock()

    def run_kernel(source, name, grid, arrays, result):
        def run(*arrays):
            arrays = [np.ascontiguousarray(x) for x in arrays] + [np.full(result.shape, np.nan, result.dtype)]
            pointers = (ctypes.c_void_p * len(arrays))(*(x.ctypes.data for x in arrays))
            with lock:  # the threads on the host are static variables
                compile_for_host(source, name, grid[2])(pointers, grid[0], grid[1])
            return arrays[-1]

        return jax.pure_callback(run, result, *arrays)

    monkeypatch.setattr(mlp_kernel, "_run_kernel", run_kernel)


def networks(sizes, n_seeds):
    """Return the layers of a network for each seed, with biases that are not zero."""
    keys = jax.random.split(jax.random.key(0), n_seeds)
    return jax.vmap(lambda key: [(weight, weight[0] + 0.2) for weight, _ in init_mlp(key, sizes, 1.0)])(keys)


@pytest.mark.parametrize("sizes", [(13, 48, 32, 3), (80, 16, 1)])
def test_outputs_and_gradients_of_the_kernels_are_those_of_jax(on_host, sizes):
    n_seeds, n = 2, 70 if sizes[0] <= 64 else 30
    layers = networks(sizes, n_seeds)
    x = 2.0 * jax.random.normal(jax.random.key(1), (n_seeds, 2, n // 2, sizes[0]))
    cotangent = jax.random.normal(jax.random.key(2), (*x.shape[:-1], sizes[-1]))
    cotangent *= jnp.array([1e-9, 1e4])[:, None, None, None]  # far beyond the range of 16 bits

    def outputs_and_gradients(apply):
        def compute_for_seed(layers, x, cotangent):
            out, backward = jax.vjp(lambda layers: apply(layers, x), layers)
            return out, backward(cotangent)[0]

        return jax.jit(jax.vmap(compute_for_seed))(layers, x, cotangent)

    result, expected = (jax.tree.leaves(outputs_and_gradients(apply)) for apply in (apply_mlp, mlp))
    assert len(result) == 2 * len(sizes) - 1
    for a, b in zip(result, expected, strict=True):
        assert a.shape == b.shape
        for seed_a, seed_b in zip(a, b, strict=True):  # of each seed
            assert np.linalg.norm(seed_a - seed_b) < 3e-3 * np.linalg.norm(seed_b)  # 11 bits


@pytest.mark.parametrize("shape", [(8, 5, 13), (3, 4, 2, 5, 13), (6, 5, 13)])
def test_each_device_runs_the_kernels_for_its_own_worlds(on_host, shape):
    """Inputs of worlds, and of a minibatch with groups of worlds; six worlds cannot be divided among four devices."""
    apply_distributed = DistributedMlp(world_mesh(jax.devices()[:4]))
    layers = jax.tree.map(lambda x: x[0], networks((13, 16, 3), 1))
    x = jax.random.normal(jax.random.key(1), shape)
    cotangent = jax.random.normal(jax.random.key(2), (*shape[:-1], 3))

    @partial(jax.jit, static_argnums=0)
    def compute_outputs_and_gradients(apply):
        out, backward = jax.vjp(lambda layers: apply(layers, x), layers)
        return out, backward(cotangent)[0]

    result, expected = (jax.tree.leaves(compute_outputs_and_gradients(apply)) for apply in (apply_distributed, mlp))
    for a, b in zip(result, expected, strict=True):
        assert np.linalg.norm(a - b) < 3e-3 * np.linalg.norm(b)  # 11 bits


def test_gradients_of_zeros_are_zero_and_inputs_get_none(on_host):
    layers = jax.tree.map(lambda x: x[0], networks((13, 48, 32, 3), 1))
    x = jnp.ones((5, 13))
    out, backward = jax.vjp(apply_mlp, layers, x)
    layer_gradients, input_gradient = backward(jnp.zeros_like(out))
    assert all((gradient == 0).all() for gradient in jax.tree.leaves((layer_gradients, input_gradient)))
    _, input_gradient = backward(jnp.ones_like(out))
    assert (input_gradient == 0).all()


def test_gradients_that_grow_through_large_weights_are_finite(on_host):
    """The gradient is multiplied by 12 up to the 32 units, by 1,536 up to the 48: a tenth of the range of 16 bits."""
    layers = [(jnp.full(w.shape[1:], 4.0), jnp.zeros(b.shape[1:])) for w, b in networks((13, 48, 32, 3), 1)]
    x = jnp.zeros((5, 13))
    result, expected = (
        jax.vjp(lambda layers, f=f: f(layers, x), layers)[1](jnp.ones((5, 3)))[0] for f in (apply_mlp, mlp)
    )
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=3e-3)


@pytest.mark.parametrize("sizes", [(129, 16, 1), (4, 65, 1), (4, 16, 16, 16, 16, 1)])
def test_larger_networks_are_computed_by_xla(sizes):
    layers = jax.tree.map(lambda x: x[0], networks(sizes, 1))
    x = jax.random.normal(jax.random.key(1), (3, sizes[0]))
    np.testing.assert_array_equal(apply_mlp(layers, x), mlp(layers, x))


def test_other_dtypes_are_computed_by_xla():
    layers = jax.tree.map(lambda x: x[0].astype(jnp.bfloat16), networks((4, 16, 1), 1))
    x = jnp.ones((3, 4))
    np.testing.assert_array_equal(apply_mlp(layers, x), mlp(layers, x))


def test_kernels_are_used_on_h100s_without_a_network_before_the_layers(monkeypatch):
    monkeypatch.setattr(cuda, "nvrtc", lambda: "found")
    assert choose_mlp(MEMORYLESS_NETWORK, H100) is apply_mlp
    assert choose_mlp(MEMORYLESS_NETWORK, jax.devices("cpu")[0]) is mlp
    assert choose_mlp(MEMORYLESS_NETWORK, SimpleNamespace(platform="gpu", compute_capability="8.9")) is mlp
    mesh = world_mesh(jax.devices()[:2])
    assert choose_mlp(MEMORYLESS_NETWORK, H100, mesh) == DistributedMlp(mesh)
    assert choose_mlp(MEMORYLESS_NETWORK, H100, mesh, 4) is apply_mlp
    assert choose_mlp(MEMORYLESS_NETWORK, H100, mesh, 3) is mlp
    assert choose_mlp(gru_network(8), H100) is mlp
    monkeypatch.setattr(cuda, "nvrtc", lambda: None)
    assert choose_mlp(MEMORYLESS_NETWORK, H100) is mlp


def test_seeds_are_one_launch_of_each_kernel(monkeypatch):
    monkeypatch.setattr(cuda, "compile_source", lambda source, arch, kind: b"code")
    layers, x = networks((13, 64, 64, 4), 3), jnp.ones((3, 1000, 13))
    gradient = jax.vmap(jax.grad(lambda layers, x: jnp.square(apply_mlp(layers, x)).mean()))
    text = jax.jit(gradient).trace(layers, x).lower(lowering_platforms=("cuda",)).as_text()
    calls = re.findall(rf'@"?{re.escape(cuda.PTX_TARGET)}.*', text)
    assert [name for call in calls for name in re.findall(r"mlp_\w+", call)] == ["mlp_outputs", "mlp_gradients"]
    assert all("grid_y = 3 : i32" in call for call in calls)


@pytest.mark.parametrize("gradient", [False, True])
def test_nvrtc_compiles_the_kernels(gradient):
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here")
    for sizes in ((21, 64, 64, 4), (128, 64, 64, 1)):
        assert cuda.compile_source(INTRINSICS + cuda_source(sizes, gradient)[0], f"compute_{CAPABILITY}", "PTX")
