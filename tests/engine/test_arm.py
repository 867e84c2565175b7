"""Host kernels for ARM: compiled by a cross compiler, run by an emulator, compared with the kernels of this machine."""

import shutil
import subprocess

import jax
import numpy as np
import pytest
from cases import needs_compiler

from crazysim import Sim
from crazysim.engine import Step, jaxcompat
from crazysim.engine.backends import kernel, native

COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"
PROGRAM_PATHS = {program: shutil.which(program) for program in (COMPILER, EMULATOR)}

# Reads the numbers of lanes, steps, inputs and outputs, the size of each array in bytes, and the inputs. Calls the
# kernel, and writes the outputs.
DRIVER = """
#include <stdio.h>
#include <stdlib.h>
extern "C" int crazysim_call(int n_lanes, int n_steps, void** in, int n_in);
int main() {
  int head[4];
  if (fread(head, sizeof head, 1, stdin) != 1) return 2;
  const int n = head[2] + head[3];
  int* bytes = (int*)malloc(n * sizeof(int));
  void** arrays = (void**)malloc(n * sizeof(void*));
  if (fread(bytes, sizeof(int), n, stdin) != size_t(n)) return 3;
  for (int i = 0; i < n; ++i) arrays[i] = aligned_alloc(64, (bytes[i] + 63) / 64 * 64 + 64);
  for (int i = 0; i < head[2]; ++i)
    if (bytes[i] && fread(arrays[i], bytes[i], 1, stdin) != 1) return 4;
  if (!crazysim_call(head[0], head[1], arrays, head[2])) return 5;
  for (int i = head[2]; i < n; ++i) fwrite(arrays[i], bytes[i], 1, stdout);
}
"""


def run_on_arm(folder, source, n_lanes, n_steps, inputs, outputs):
    (folder / "kernel.cpp").write_text(source)
    (folder / "driver.cpp").write_text(DRIVER)
    flags = [flag for flag in native.COMPILER_FLAGS if flag not in ("-march=native", "-shared")]
    subprocess.run(
        [COMPILER, *flags, "-I", jaxcompat.ffi_include_folder(), "kernel.cpp", "driver.cpp", "-static", "-o", "run"],
        cwd=folder, check=True,
    )  # fmt: skip
    head = np.array([n_lanes, n_steps, len(inputs), len(outputs), *[x.nbytes for x in (*inputs, *outputs)]], np.int32)
    request = head.tobytes() + b"".join(x.tobytes() for x in inputs)
    received = subprocess.run([EMULATOR, "run"], cwd=folder, input=request, capture_output=True, check=True).stdout
    ends = np.cumsum([x.nbytes for x in outputs])
    assert len(received) == ends[-1]
    parts = np.split(np.frombuffer(received, np.uint8), ends[:-1])
    return [part.view(x.dtype).reshape(x.shape) for part, x in zip(parts, outputs, strict=True)]


@needs_compiler
@pytest.mark.skipif(None in PROGRAM_PATHS.values(), reason=f"needs {' and '.join(PROGRAM_PATHS)}")
def test_a_kernel_for_arm_computes_the_numbers_of_this_machine(tmp_path):
    """Compilers contract products and sums differently, so numbers differ by rounding; 37 lanes fill no vector."""
    sim, scales = Sim(n_worlds=37), np.linspace(0.5, 1, 37, dtype=np.float32)
    sim.attitude_control(scales[:, None, None] * np.tile(np.float32([0.05, -0.1, 0.2, 0.4]), (37, 1, 1)))
    flat = Step(sim.step_pipeline, "lanes").flatten(sim.data)
    source = kernel.write_kernel(flat.plan.program, "host")
    inputs = [np.asarray(flat.leaves[i]) for i in source.inputs]
    outputs = [np.empty(flat.leaves[i].shape, flat.leaves[i].dtype) for i in source.outputs] + [np.empty((37, 1), bool)]
    *after, flags = run_on_arm(tmp_path, source.text, 37, 20, inputs, outputs)
    sim.step(20)
    expected = jax.tree.leaves(sim.data)
    assert not flags.any()
    for i, x in zip(source.outputs, after, strict=True):
        np.testing.assert_allclose(x, expected[i], rtol=1e-5, atol=1e-5)
