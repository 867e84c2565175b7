"""Kernels for GPUs, as far as they can be tested without a GPU: architectures, and the choice between several."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from cases import shared_sim

from crazysim import ConfigError, Downwash, Sim
from crazysim.engine import Step
from crazysim.engine.backends import cuda, kernel, native
from crazysim.engine.errors import KernelError, UnsupportedError
from crazysim.engine.ir.blocks import Builder
from crazysim.engine.ir.program import Leaf, Program, Segment


@dataclasses.dataclass(frozen=True)
class Gpu:
    compute_capability: str
    local_hardware_id: int = 0
    platform: str = "gpu"


OLD, NEW = Gpu("8.6", 0), Gpu("9.0", 1)


@pytest.fixture(scope="module")
def source():
    sim = shared_sim(n_worlds=2, n_drones=1, control="rotor_vel")
    return kernel.write_kernel(Step(sim.step_pipeline, "lanes").plan(sim.data).program, "cuda")


def test_kernels_for_several_gpus_run_on_the_oldest():
    """Code for an architecture runs on all later ones, and 10.0 is later than 9.0."""
    assert cuda.weakest_device([NEW, OLD]) is OLD
    assert cuda.weakest_device([NEW]) is NEW
    assert cuda.weakest_device([Gpu("10.0"), NEW]) is NEW
    assert cuda.weakest_device([]) is None
    assert cuda.weakest_device([Gpu("0", platform="cpu")]) is None


def test_each_architecture_has_its_own_code(source):
    texts = [
        cuda.ptx(source, cuda.architecture(cuda.weakest_device(gpus))) for gpus in ([NEW], [OLD], [NEW, OLD], [NEW])
    ]
    targets = [re.search(r"^\.target (\w+)", text, re.MULTILINE)[1] for text in texts]
    assert targets == ["sm_90", "sm_86", "sm_86", "sm_90"]


def test_a_source_that_nvrtc_refuses_is_unsupported(source):
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here")
    with pytest.raises(KernelError, match="NVRTC refused the kernel"):
        cuda.compile_source("not CUDA", cuda.DEFAULT_ARCHITECTURE, "PTX")


@pytest.mark.parametrize(("n_drones", "threads", "lanes"), [(3, 64, 60), (32, 64, 64), (33, 256, 231)])
def test_worlds_whose_drones_act_on_each_other_fill_warps_or_blocks(n_drones, threads, lanes):
    sim = Sim(n_worlds=2, n_drones=n_drones, control="attitude", engine="lanes")
    sim.add(Downwash())
    gpu_kernel = kernel.write_kernel(sim.build_step_fn().plan(sim.data).program, "cuda")
    assert (gpu_kernel.threads, gpu_kernel.lanes) == (threads, lanes)
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here; CI has it")
    code = cuda.ptx(gpu_kernel, cuda.DEFAULT_ARCHITECTURE)
    in_block = n_drones > 32
    assert ("ld.shared.v4.f32" in code, "shfl.sync" in code) == (in_block, not in_block)
    assert code.count("bar.sync") == (2 if in_block else 0)


def test_a_world_that_does_not_fit_into_a_block_runs_on_lanes():
    sim = Sim(n_worlds=1, n_drones=1025, control="rotor_vel", engine="lanes")
    sim.add(Downwash())
    program = sim.build_step_fn().plan(sim.data).program
    with pytest.raises(
        UnsupportedError, match="the 1025 drones of a world read each other's numbers; on a GPU at most 1024 can"
    ):
        kernel.write_kernel(program, "cuda")


def lowered_text(sim, planned_for, platform):
    step = Step(sim.step_pipeline, "fused", planned_for)
    return jax.jit(lambda data: step(data, 3)).trace(sim.data).lower(lowering_platforms=(platform,)).as_text()


@pytest.mark.parametrize(("name", "remains"), [("add", "rem.s32"), ("sub", "setp.lt.s32"), ("mul", "rem.s32")])
def test_integers_wrap(name, remains):
    """Signed overflow is undefined in CUDA, where (a + a) % a would be 0, a - 1 < a true and (a * 3) % a 0."""
    builder = Builder(stage="one")
    a = builder.input(np.int32)
    b = {"add": a, "sub": np.int32(1), "mul": np.int32(3)}[name]
    result = builder.add(name, (a, b), np.int32)
    test = builder.add("lt", (result, a), bool) if name == "sub" else builder.add("rem", (result, a), np.int32)
    leaves = (Leaf("a", "drone", (2, 1), np.dtype(np.int32)), Leaf("b", "drone", (2, 1), test.dtype))
    segment = Segment("drone", ("one",), "each", builder.finish([test]), ((0, 0),), ((1, 0),))
    gpu_kernel = kernel.write_kernel(Program(leaves, 1, (segment,)), "cuda")
    assert f"{name}_(" in gpu_kernel.text.split("n_steps;")[-1]
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here; CI has it")
    assert remains in cuda.ptx(gpu_kernel, cuda.DEFAULT_ARCHITECTURE)


def test_a_step_has_a_kernel_on_platforms_that_it_was_not_planned_for():
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here; CI has it")
    sim = shared_sim(n_worlds=2, n_drones=1, control="rotor_vel")
    for planned_for in ("cpu", "gpu"):
        for platform, target in (("cpu", "crazysim_advance"), ("cuda", cuda.PTX_TARGET)):
            text = lowered_text(sim, planned_for, platform)
            assert [text.count(name) for name in ("crazysim_advance", cuda.PTX_TARGET)] == [
                int(name == target) for name in ("crazysim_advance", cuda.PTX_TARGET)
            ]


def test_compiling_for_one_platform_needs_no_compiler_of_another(monkeypatch):
    sim = shared_sim(n_worlds=2, n_drones=1, control="rotor_vel")
    with monkeypatch.context() as patch:
        patch.setattr(cuda, "nvrtc", lambda: None)
        assert "crazysim_advance" in lowered_text(sim, "cpu", "cpu")
    if cuda.nvrtc() is None:
        pytest.skip("no NVRTC here; CI has it")
    monkeypatch.setattr(native, "compiler", lambda: None)
    assert cuda.PTX_TARGET in lowered_text(sim, "gpu", "cuda")


def test_a_step_without_a_kernel_where_jax_compiles_it_is_an_error():
    sim = Sim(n_worlds=1, n_drones=1025, control="rotor_vel")
    sim.add(Downwash())
    with pytest.raises(ConfigError, match=r"expected a kernel for the GPU, .*at most 1024 .*\. Use engine='lanes'"):
        lowered_text(sim, "cpu", "cuda")
