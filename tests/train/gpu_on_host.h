// A block of CUDA threads on the host, each with a stack of its own: instructions of a warp run when all lanes are there.
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <ucontext.h>
#include <vector>

typedef unsigned u32;
typedef unsigned short u16;
#define METHOD inline
#define DEVICE static inline
#define __device__
#define __global__
#define __forceinline__ inline
#define __launch_bounds__(...)
struct float2 { float x, y; };
struct Index { int x, y; };
static Index threadIdx, blockIdx, gridDim;

struct Lane { u32 a[4], b[2]; const u16* row; float x; };
static Lane lanes[1024];
static ucontext_t scheduler, threads[1024];
static bool finished[1024];
static int arrived[33], passed[33], n_threads;  // of each warp, and of the block
alignas(16) static unsigned char memory[1 << 18];

static void wait(int group, int size) {
  int thread = threadIdx.x, turn = passed[group];
  if (++arrived[group] == size) arrived[group] = 0, passed[group]++;
  while (passed[group] == turn) swapcontext(&threads[thread], &scheduler);
  threadIdx.x = thread;
}
#define WAIT_WARP wait(threadIdx.x / 32, 32)
static void __syncthreads() { wait(32, n_threads); }

static u16 to_half(float x) { _Float16 h = (_Float16)x; u16 y; memcpy(&y, &h, 2); return y; }
static float to_float(u16 x) { _Float16 h; memcpy(&h, &x, 2); return (float)h; }
static u32 pack(float low, float high) { return to_half(low) | (u32)to_half(high) << 16; }
static float2 unpack(u32 x) { return {to_float((u16)x), to_float((u16)(x >> 16))}; }
static float hyperbolic_tangent(float x) { return std::tanh(x); }
static float half_of(u32 x, int i) { return to_float((u16)(x >> 16 * i)); }

// PTX manual, "Matrix Fragments for mma.m16n8k16 with floating point type"
static void multiply_add(float (&c)[4], const u32 (&a)[4], u32 b0, u32 b1) {
  int thread = threadIdx.x, warp = thread / 32 * 32;
  memcpy(lanes[thread].a, a, sizeof a);
  lanes[thread].b[0] = b0, lanes[thread].b[1] = b1;
  WAIT_WARP;
  for (int i = 0; i < 4; i++) {
    int row = thread % 32 / 4 + 8 * (i >> 1), column = 2 * (thread % 4) + (i & 1);
    for (int k = 0; k < 16; k++) {
      u32 left = lanes[warp + row % 8 * 4 + k % 8 / 2].a[row / 8 + 2 * (k / 8)];
      u32 right = lanes[warp + column * 4 + k % 8 / 2].b[k / 8];
      c[i] += half_of(left, k % 2) * half_of(right, k % 2);
    }
  }
  WAIT_WARP;
}
static void load(u32 (&x)[4], const u16* row, bool transposed) {
  int thread = threadIdx.x, warp = thread / 32 * 32, g = thread % 32 / 4, t = thread % 4;
  lanes[thread].row = row;
  WAIT_WARP;
  for (int i = 0; i < 4; i++) {
    const Lane* rows = lanes + warp + 8 * i;
    u16 low = transposed ? rows[2 * t].row[g] : rows[g].row[2 * t];
    u16 high = transposed ? rows[2 * t + 1].row[g] : rows[g].row[2 * t + 1];
    x[i] = low | (u32)high << 16;
  }
  WAIT_WARP;
}
static void load_matrices(u32 (&x)[4], const u16* row) { load(x, row, false); }
static void load_transposed(u32 (&x)[4], const u16* row) { load(x, row, true); }
static float sum_of_four_lanes(float x) {
  int thread = threadIdx.x;
  lanes[thread].x = x;
  WAIT_WARP;
  float sum = 0;
  for (int i = 0; i < 4; i++) sum += lanes[thread / 4 * 4 + i].x;
  WAIT_WARP;
  return sum;
}

typedef void (*Arguments)(void**);
static Arguments kernel;
static void** arguments;
static void begin(int thread) {
  threadIdx.x = thread;
  kernel(arguments);
  finished[thread] = true;
}
static void run(Arguments function, void** pointers, int blocks, int stacks, int size) {
  kernel = function, arguments = pointers, n_threads = size, gridDim = {blocks, stacks};
  std::vector<char> memory_of_stacks((size_t)size << 17);
  for (int block = 0; block < blocks * stacks; block++) {
    blockIdx = {block % blocks, block / blocks};
    for (int i = 0; i < size; i++) {
      finished[i] = false;
      getcontext(&threads[i]);
      threads[i].uc_stack = {memory_of_stacks.data() + ((size_t)i << 17), 0, 1 << 17};
      threads[i].uc_link = &scheduler;
      makecontext(&threads[i], (void (*)())begin, 1, i);
    }
    for (int left = size; left;) {
      left = 0;
      for (int i = 0; i < size; i++)
        if (!finished[i]) left++, threadIdx.x = i, swapcontext(&scheduler, &threads[i]);
    }
  }
}
