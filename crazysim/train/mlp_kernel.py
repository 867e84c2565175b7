"""CUDA kernels for outputs and gradients of tanh networks, for PPO on NVIDIA GPUs of the Hopper architecture.

XLA writes the activations of every layer to memory and reads them again, which takes most of the time of an update.
Here a warp computes all layers of 16 samples in its registers. The kernel of gradients computes the activations again.
Each block adds up the gradients of the weights over its samples, and XLA adds the sums of the blocks.

Tensor cores compute the products, with operands of 16 bits and sums of 32 bits. The operands have 11 bits of
precision, as in TF32, which XLA uses on the same GPUs, but a smaller range. Weights, normalised observations
and activations are within this range; gradients of the outputs are scaled such that the largest is between 1 and 2.

Lanes of a warp hold operands as in the PTX manual, "Matrix Fragments for mma.m16n8k16": of a product of 16 x 8
numbers, lane 4 g + t has columns 2 t and 2 t + 1 of rows g and g + 8. Two such products, rounded to 16 bits, form a
left operand of the next product.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from crazysim.engine import jaxcompat
from crazysim.engine.backends import cuda
from crazysim.engine.sharding import WORLD_AXIS
from crazysim.train.networks import MEMORYLESS_NETWORK, ApplyLayers, Layers, Network, mlp
from crazysim.train.seeds import are_seeds_divided

MAX_WIDTH, MAX_UNITS, MAX_LAYERS = 128, 64, 4
"""Largest number of inputs or outputs, largest size of a hidden layer, and largest number of layers."""
WARPS_AND_BLOCKS = {(False, False): (4, 4), (False, True): (4, 3), (True, False): (4, 2), (True, True): (8, 1)}
"""Warps per block and blocks per multiprocessor, by whether there are more than 64 inputs and whether the kernel
computes gradients. They were about the fastest of three to six pairs on an H100, with 21 inputs for the first two."""
KERNEL_NAMES = ("mlp_outputs", "mlp_gradients")
"""Names of the kernel of outputs and the kernel of gradients."""
CAPABILITY, MAX_SHARED_BYTES, MULTIPROCESSORS = 90, 227 * 2**10, 132
"""Compute capability of the GPUs that use the kernels (Hopper architecture), times ten; the largest shared
memory of a block there (CUDA C++ Programming Guide), bytes; and the number of multiprocessors of an H100 SXM."""

INTRINSICS = r"""
typedef unsigned u32; typedef unsigned short u16;
#define METHOD __device__ __forceinline__
#define DEVICE static METHOD

DEVICE u32 pack(float low, float high) {
  u32 pair;
  asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(pair) : "f"(high), "f"(low));
  return pair;
}
DEVICE float2 unpack(u32 pair) {
  float2 x;
  asm("{.reg .f16 a, b; mov.b32 {a, b}, %2; cvt.f32.f16 %0, a; cvt.f32.f16 %1, b;}"
      : "=f"(x.x), "=f"(x.y) : "r"(pair));
  return x;
}
// c += a b: 16 x 8, 16 x 16 and 16 x 8
DEVICE void multiply_add(float (&c)[4], const u32 (&a)[4], u32 b0, u32 b1) {
  asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3]) : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}
// Four matrices of 8 x 8; lanes 8 i to 8 i + 7 pass the addresses of the rows of matrix i.
DEVICE void load_matrices(u32 (&x)[4], const u16* row) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
      : "=r"(x[0]), "=r"(x[1]), "=r"(x[2]), "=r"(x[3]) : "r"((u32)__cvta_generic_to_shared(row)) : "memory");
}
DEVICE void load_transposed(u32 (&x)[4], const u16* row) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
      : "=r"(x[0]), "=r"(x[1]), "=r"(x[2]), "=r"(x[3]) : "r"((u32)__cvta_generic_to_shared(row)) : "memory");
}
DEVICE float sum_of_four_lanes(float x) {
  x += __shfl_xor_sync(~0u, x, 1);
  return x + __shfl_xor_sync(~0u, x, 2);
}
DEVICE float hyperbolic_tangent(float x) {
  float y;  // of 11 bits
  asm("tanh.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
"""
"""Instructions of the GPU that CUDA C++ has no operators for."""

FUNCTIONS = r"""
#define LANE ((int)threadIdx.x & 31)
#define WARP ((int)threadIdx.x >> 5)
#define THREADS (32 * WARPS)
#define STRIDE(width) (width + 8)  // of rows in shared memory, such that ldmatrix has no bank conflicts

// Weights and biases of a layer, padded with zeros, in shared memory.
template <int K, int N> DEVICE void load_layer(u16* w, float* b, const float* weight, const float* bias, int k, int n) {
  for (int i = threadIdx.x; i < K * N / 2; i += THREADS) {
    int row = 2 * i / N, column = 2 * i % N;
    float low = row < k && column < n ? weight[row * n + column] : 0.0f;
    float high = row < k && column + 1 < n ? weight[row * n + column + 1] : 0.0f;
    *(u32*)(w + row * STRIDE(N) + column) = pack(low, high);
  }
  for (int i = threadIdx.x; i < N; i += THREADS) b[i] = i < n ? bias[i] : 0.0f;
}

// Left operand from 16 rows of an array (n, width), padded with zeros.
template <int K> DEVICE void load_rows(u32 (&a)[K / 16][4], const float* x, int row, int n, int width, float scale) {
  for (int k = 0; k < K / 16; k++)
    for (int i = 0; i < 4; i++) {
      int r = row + LANE / 4 + 8 * (i & 1), column = 16 * k + 2 * (LANE % 4) + 8 * (i >> 1);
      const float* p = x + (size_t)r * width + column;
      float low = r < n && column < width ? p[0] * scale : 0.0f;
      float high = r < n && column + 1 < width ? p[1] * scale : 0.0f;
      a[k][i] = pack(low, high);
    }
}

// a W + b
template <int K, int N>
DEVICE void apply_layer(float (&c)[N / 8][4], const u32 (&a)[K / 16][4], const u16* w, const float* b) {
  w += (LANE & 15) * STRIDE(N) + 8 * (LANE >> 4);
  for (int j = 0; j < N / 8; j++) {
    float2 pair = *(const float2*)(b + 8 * j + 2 * (LANE % 4));
    c[j][0] = c[j][2] = pair.x;
    c[j][1] = c[j][3] = pair.y;
  }
  for (int k = 0; k < K / 16; k++)
    for (int j = 0; j < N / 8; j += 2) {
      u32 m[4];
      load_transposed(m, w + 16 * k * STRIDE(N) + 8 * j);
      multiply_add(c[j], a[k], m[0], m[1]);
      multiply_add(c[j + 1], a[k], m[2], m[3]);
    }
}

// tanh(a W + b), as a left operand
template <int K, int N>
DEVICE void apply_hidden(u32 (&h)[N / 16][4], const u32 (&a)[K / 16][4], const u16* w, const float* b) {
  float c[N / 8][4];
  apply_layer<K, N>(c, a, w, b);
  for (int j = 0; j < N / 8; j++)
    for (int i = 0; i < 2; i++)
      h[j / 2][2 * (j & 1) + i] = pack(hyperbolic_tangent(c[j][2 * i]), hyperbolic_tangent(c[j][2 * i + 1]));
}

// Gradient of the layer below: (d W^T) (1 - h^2)
template <int K, int N>
DEVICE void reverse_layer(u32 (&below)[K / 16][4], const u32 (&d)[N / 16][4], const u32 (&h)[K / 16][4], const u16* w) {
  w += ((LANE & 7) + 8 * (LANE >> 4)) * STRIDE(N) + 8 * (LANE >> 3 & 1);
  float c[K / 8][4] = {};
  for (int n = 0; n < N / 16; n++)
    for (int j = 0; j < K / 8; j += 2) {
      u32 m[4];
      load_matrices(m, w + 8 * j * STRIDE(N) + 16 * n);
      multiply_add(c[j], d[n], m[0], m[1]);
      multiply_add(c[j + 1], d[n], m[2], m[3]);
    }
  for (int j = 0; j < K / 8; j++)
    for (int i = 0; i < 2; i++) {
      float2 y = unpack(h[j / 2][2 * (j & 1) + i]);
      below[j / 2][2 * (j & 1) + i] = pack(c[j][2 * i] * (1 - y.x * y.x), c[j][2 * i + 1] * (1 - y.y * y.y));
    }
}

// Left operand to the rows of this warp in shared memory.
template <int K> DEVICE void store_rows(u16* s, const u32 (&a)[K / 16][4]) {
  s += (16 * WARP + LANE / 4) * STRIDE(K) + 2 * (LANE % 4);
  for (int k = 0; k < K / 16; k++)
    for (int i = 0; i < 4; i++) *(u32*)(s + 8 * (i & 1) * STRIDE(K) + 16 * k + 8 * (i >> 1)) = a[k][i];
}

// Rows of an array (n, width).
template <int N> DEVICE void write_rows(float* out, const float (&c)[N / 8][4], int row, int n, int width) {
  for (int j = 0; j < N / 8; j++)
    for (int i = 0; i < 4; i++) {
      int r = row + LANE / 4 + 8 * (i >> 1), column = 8 * j + 2 * (LANE % 4) + (i & 1);
      if (r < n && column < width) out[(size_t)r * width + column] = c[j][i];
    }
}

constexpr int common_divisor(int a, int b) { return b ? common_divisor(b, a % b) : a; }
// Sums of a warp for the gradients of a layer: some tiles of 16 rows and 16 columns.
template <int K, int N> struct Sums {
  static constexpr int across = common_divisor(WARPS, N / 16), down = WARPS / across;
  static constexpr int columns = N / 16 / across, rows = (K / 16 + down - 1) / down;
  float weight[columns][rows][2][4], bias[columns][2];

  // Add a^T d and the sum of d over the samples of the block.
  METHOD void add(const u16* a, const u16* d) {
    a += ((LANE & 7) + 8 * (LANE >> 4)) * STRIDE(K) + 8 * (LANE >> 3 & 1) + 16 * rows * (WARP / across);
    d += (LANE & 15) * STRIDE(N) + 8 * (LANE >> 4) + 16 * columns * (WARP % across);
    for (int s = 0; s < WARPS; s++) {
      u32 left[rows][4], right[4];
      for (int k = 0; k < rows; k++)
        if (rows * (WARP / across) + k < K / 16) load_transposed(left[k], a + 16 * s * STRIDE(K) + 16 * k);
      for (int p = 0; p < columns; p++) {
        load_transposed(right, d + 16 * s * STRIDE(N) + 16 * p);
        for (int i = 0; i < 4; i++) {
          float2 pair = unpack(right[i]);
          bias[p][i / 2] += pair.x + pair.y;
        }
        for (int k = 0; k < rows; k++)
          if (rows * (WARP / across) + k < K / 16) {
            multiply_add(weight[p][k][0], left[k], right[0], right[1]);
            multiply_add(weight[p][k][1], left[k], right[2], right[3]);
          }
      }
    }
  }

  // Write the gradients of weights (k, n) and biases (n).
  METHOD void write(float* out, int k_real, int n_real) {
    for (int p = 0; p < columns; p++)
      for (int e = 0; e < 2; e++) {
        int first = 16 * (columns * (WARP % across) + p) + 8 * e;
        for (int k = 0; k < rows; k++)
          for (int i = 0; i < 4; i++) {
            int row = 16 * (rows * (WARP / across) + k) + LANE / 4 + 8 * (i >> 1);
            int column = first + 2 * (LANE % 4) + (i & 1);
            if (row < k_real && column < n_real) out[row * n_real + column] = weight[p][k][e][i];
          }
        float sum = sum_of_four_lanes(bias[p][e]);
        int column = first + LANE / 4;
        if (WARP < across && LANE % 4 == 0 && column < n_real) out[k_real * n_real + column] = sum;
      }
  }
};
"""
"""Functions of the kernels. K and N are numbers of inputs and outputs of a layer, rounded up to multiples of 16; every
warp of a block has 16 samples."""


def cuda_source(sizes: tuple[int, ...], is_gradient: bool) -> tuple[str, int]:
    """Return the CUDA source of a kernel without ``INTRINSICS``, and the shared memory of a block, bytes.

    Args:
        sizes: Number of inputs, sizes of the hidden layers, number of outputs.
        is_gradient: Whether the kernel computes gradients; else it computes outputs.
    """
    n_warps, n_blocks = WARPS_AND_BLOCKS[sizes[0] > 64, is_gradient]
    padded_sizes, layers = [-(-size // 16) * 16 for size in sizes], range(len(sizes) - 1)
    # Declarations of the arrays in shared memory, and their sizes, bytes.
    memory = [(f"u16* w{i}", 2 * padded_sizes[i] * (padded_sizes[i + 1] + 8)) for i in layers]
    memory += [(f"float* b{i}", 4 * padded_sizes[i + 1]) for i in layers]
    if is_gradient:
        memory += [(f"u16* rows{i}", 2 * 16 * n_warps * (padded_sizes[i] + 8)) for i in layers]
        memory += [(f"u16* below{i}", 2 * 16 * n_warps * (padded_sizes[i + 1] + 8)) for i in layers]
    offsets = list(itertools.accumulate((size for _, size in memory), initial=0))
    # Each block of threads loads the weights once.
    setup = ["int n = *count;", f"x += (size_t)blockIdx.y * n * {sizes[0]};"]
    setup += [
        f"{name} = ({name.split()[0]})(memory + {offset});" for (name, _), offset in zip(memory, offsets, strict=False)
    ]
    # Outputs of the hidden layers.
    body = [f"u32 a0[{padded_sizes[0] // 16}][4]; load_rows<{padded_sizes[0]}>(a0, x, row, n, {sizes[0]}, 1.0f);"]
    for i in layers:
        shape, k, n = f"{padded_sizes[i]}, {padded_sizes[i + 1]}", sizes[i], sizes[i + 1]
        setup += [f"weight{i} += (size_t)blockIdx.y * {k * n}; bias{i} += (size_t)blockIdx.y * {n};"]
        setup += [f"load_layer<{shape}>(w{i}, b{i}, weight{i}, bias{i}, {k}, {n});"]
        if i < layers[-1]:
            body += [
                f"u32 a{i + 1}[{padded_sizes[i + 1] // 16}][4]; apply_hidden<{shape}>(a{i + 1}, a{i}, w{i}, b{i});"
            ]
    # Gradient: back through the layers, and sums over the rows.
    epilogue, (inner, outer), width, last = [], padded_sizes[-2:], sizes[-1], layers[-1]
    if is_gradient:
        n_weights = sum((k + 1) * n for k, n in itertools.pairwise(sizes))
        setup += [f"cotangent += (size_t)blockIdx.y * n * {width};"]
        body += [f"u32 d{last}[{outer // 16}][4];"]
        body += [f"load_rows<{outer}>(d{last}, cotangent, row, n, {width}, scale[blockIdx.y]);"]
        epilogue = [f"out += ((size_t)blockIdx.y * gridDim.x + blockIdx.x) * {n_weights};"]
        for i in layers:
            setup += [f"Sums<{padded_sizes[i]}, {padded_sizes[i + 1]}> sums{i} = {{}};"]
            epilogue += [f"sums{i}.write(out, {sizes[i]}, {sizes[i + 1]}); out += {(sizes[i] + 1) * sizes[i + 1]};"]
        for i in reversed(layers):
            k, n = padded_sizes[i], padded_sizes[i + 1]
            body += [f"store_rows<{k}>(rows{i}, a{i}); store_rows<{n}>(below{i}, d{i});"]
            body += [f"u32 d{i - 1}[{k // 16}][4]; reverse_layer<{k}, {n}>(d{i - 1}, d{i}, a{i}, w{i});"] if i else []
        body += ["__syncthreads();", *(f"sums{i}.add(rows{i}, below{i});" for i in layers), "__syncthreads();"]
    else:
        setup += [f"out += (size_t)blockIdx.y * n * {width};"]
        body += [f"float c[{outer // 8}][4]; apply_layer<{inner}, {outer}>(c, a{last}, w{last}, b{last});"]
        body += [f"write_rows<{outer}>(out, c, row, n, {width});"]
    # The kernel around these lines.
    names = ["const int* count", "const float* x"]
    names += ["const float* scale", "const float* cotangent"] if is_gradient else []
    names += [f"const float* {name}{i}" for i in layers for name in ("weight", "bias")] + ["float* out"]
    text = [
        f"#define WARPS {n_warps}", FUNCTIONS, f'extern "C" __global__ void __launch_bounds__(THREADS, {n_blocks})',
        f"{KERNEL_NAMES[is_gradient]}({', '.join(names)}) {{",
        "extern __shared__ __align__(16) unsigned char memory[];", *setup, "__syncthreads();",
        "for (int first = blockIdx.x * 16 * WARPS; first < n; first += gridDim.x * 16 * WARPS) {",
        "int row = first + 16 * WARP;", *body, "}", *epilogue, "}",
    ]  # fmt: skip
    return "\n".join(text), offsets[-1]


def choose_mlp(network: Network, device: jax.Device, mesh: Mesh | None = None, n_seeds: int = 1) -> ApplyLayers:
    """Return a function that runs the kernels, on each device for its own samples, or ``mlp`` if they cannot be used.

    Args:
        network: Network before the layers. It must have no weights, since the kernels compute no gradients with respect
            to features.
        device: Device of the training.
        mesh: Devices of the training; None for one device.
        n_seeds: Number of seeds. If several cannot be divided among the devices, XLA computes the networks.
    """
    is_usable = network is MEMORYLESS_NETWORK and not jaxcompat.FALLBACKS and device.platform == "gpu"
    is_usable = is_usable and jaxcompat.compute_capability(device) == CAPABILITY and cuda.nvrtc() is not None
    if mesh is None or are_seeds_divided(n_seeds, mesh):
        return apply_mlp if is_usable else mlp
    return DistributedMlp(mesh) if is_usable and n_seeds == 1 else mlp


class DistributedMlp(NamedTuple):
    """``apply_mlp`` on the devices of a mesh, each for the samples of its own worlds."""

    mesh: Mesh
    """The devices."""

    def __call__(self, layers: Layers, x: Array) -> Array:
        # A minibatch of PPO has the five axes, with k worlds of each group. The groups of a minibatch, or the worlds of
        # other inputs, are distributed; if the devices do not divide them, XLA computes the outputs.
        axis = 1 if x.ndim == 5 else 0
        if x.shape[axis] % self.mesh.size:
            return mlp(layers, x)
        over_worlds = PartitionSpec(*[None] * axis, WORLD_AXIS)
        specs = (PartitionSpec(), over_worlds)
        apply = jax.shard_map(apply_mlp, mesh=self.mesh, in_specs=specs, out_specs=over_worlds, check_vma=False)
        return apply(layers, x)


def apply_mlp(layers: Layers, x: Array) -> Array:
    """Return ``mlp(layers, x)`` to about 11 bits, within the range of float16, with gradients for the layers only.

    Networks that are larger than the kernels allow, or of another dtype, are computed by ``mlp``.

    Args:
        x: Inputs. (..., n_in)

    Returns:
        Outputs. (..., n_out)
    """
    x, sizes = jax.lax.stop_gradient(x), _layer_sizes(layers)
    dtypes = {array.dtype for array in jax.tree.leaves((layers, x))}
    fits_kernel = max(sizes) <= MAX_WIDTH and max(sizes[1:-1], default=0) <= MAX_UNITS and len(layers) <= MAX_LAYERS
    if dtypes != {np.dtype(np.float32)} or not fits_kernel or cuda_source(sizes, True)[1] > MAX_SHARED_BYTES:
        return mlp(layers, x)
    return _apply(layers, x.reshape(-1, sizes[0])).reshape(*x.shape[:-1], sizes[-1])


def _make_launcher(is_gradient: bool) -> Callable[..., Array]:
    @jaxcompat.custom_vmap
    def run(*args: Any) -> Array:
        return _launch(is_gradient, *_add_seed_axis(1, None, *args))[0]

    @run.def_vmap
    def _run_seeds(n_seeds: int, batched: Any, *args: Any) -> tuple[Array, bool]:
        return _launch(is_gradient, *_add_seed_axis(n_seeds, batched, *args)), True

    return run


_compute_outputs, _compute_gradients = _make_launcher(False), _make_launcher(True)


@jax.custom_vjp
def _apply(layers: Layers, x: Array) -> Array:
    return _compute_outputs(layers, x)


def _forward(layers: Layers, x: Array) -> tuple[Array, Any]:
    return _compute_outputs(layers, x), (layers, x)


def _backward(residuals: Any, cotangent: Array) -> Any:
    layers, x = residuals
    max_cotangent = jnp.max(jnp.abs(cotangent))
    exponent = jnp.where((max_cotangent > 0) & jnp.isfinite(max_cotangent), -jnp.floor(jnp.log2(max_cotangent)), 0.0)
    scale = jnp.exp2(jnp.clip(exponent, -100, 100))  # an infinite scale would turn zeros into NaN
    sums = _compute_gradients(layers, x, scale, cotangent).sum(axis=0) / scale
    ends = np.cumsum([array.size for layer in layers for array in layer])
    arrays = iter(jnp.split(sums, ends[:-1]))
    return [tuple(next(arrays).reshape(array.shape) for array in layer) for layer in layers], jnp.zeros_like(x)


_apply.defvjp(_forward, _backward)


def _add_seed_axis(n_seeds: int, batched: Any, *args: Any) -> Any:
    def stack(x: Array, is_stacked: bool = False) -> Array:
        return x if is_stacked else jnp.broadcast_to(x, (n_seeds, *x.shape))

    return jax.tree.map(stack, args) if batched is None else jax.tree.map(stack, args, tuple(batched))


def _launch(is_gradient: bool, layers: Layers, x: Array, *cotangent: Array) -> Array:
    (n_seeds, n, _), sizes = x.shape, _layer_sizes(layers)
    source, shared_bytes = cuda_source(sizes, is_gradient)
    n_warps, blocks_per_multiprocessor = WARPS_AND_BLOCKS[sizes[0] > 64, is_gradient]
    n_blocks = min(-(-blocks_per_multiprocessor * MULTIPROCESSORS // n_seeds), -(-n // (16 * n_warps)))
    shape = (n_blocks, sum(x.size for x in jax.tree.leaves(layers)) // n_seeds) if is_gradient else (n, sizes[-1])
    result = jax.ShapeDtypeStruct((n_seeds, *shape), np.float32)
    arrays = [np.asarray([n], np.int32), x, *cotangent, *jax.tree.leaves(layers)]
    grid = (n_blocks, n_seeds, 32 * n_warps, shared_bytes)
    return _run_kernel(source, KERNEL_NAMES[is_gradient], grid, arrays, result)


def _run_kernel(source: str, name: str, grid: tuple[int, ...], arrays: list[Any], result: Any) -> Array:
    names = ("grid_x", "grid_y", "block_x", "shared_mem_bytes", "grid_z", "block_y", "block_z")
    integers: dict[str, Any] = {name: np.int32(x) for name, x in zip(names, (*grid, 1, 1, 1), strict=True)}
    code = cuda.compile_source(INTRINSICS + source, f"compute_{CAPABILITY}", "PTX").decode()
    run = jax.ffi.ffi_call(cuda.PTX_TARGET, result)
    return run(*arrays, name=name, kernel_type="ptx", kernel_data=code, **integers)


def _layer_sizes(layers: Layers) -> tuple[int, ...]:
    return layers[0][0].shape[-2], *(weight.shape[-1] for weight, _ in layers)
