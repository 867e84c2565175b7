// A lane is a thread. Drones of a world that read each other's numbers form a group. A group of up to 32 drones is in
// one warp, a larger group in one block. The lanes of a warp or block are whole groups; the remaining threads are idle.
#if GROUP <= 32
#define THREADS 32
#define LANES (32 / GROUP * GROUP)
#else
#define THREADS BLOCK_THREADS
#define LANES (THREADS / GROUP * GROUP)
#endif
#define BLOCK_LANES (BLOCK_THREADS / THREADS * LANES)
#define UNROLL _Pragma("unroll 4")
#define FN static __device__ __forceinline__
#define RSQRTF(x) rsqrtf(x)
#define BITS_F32(x) __uint_as_float(x)
#define BITS_U32(x) __float_as_uint(x)
#if __CUDA_ARCH__ >= 800
// One instruction each.
#define F32_LIMITS \
  FN f32 max_(f32 a, f32 b) { f32 r; asm("max.NaN.f32 %0, %1, %2;" : "=f"(r) : "f"(a), "f"(b)); return r; } \
  FN f32 min_(f32 a, f32 b) { f32 r; asm("min.NaN.f32 %0, %1, %2;" : "=f"(r) : "f"(a), "f"(b)); return r; } \
  FN f32 at_least(f32 x, f32 low) { return max_(x, low); } FN f32 at_most(f32 x, f32 high) { return min_(x, high); }
#endif
#include "scalar.h"

// A copy that the compiler takes for a different number, so that it repeats computations instead of keeping results.
#define OPAQUE_COPY(x) opaque_copy_(x, opaque_zero)
FN f32 opaque_copy_(f32 x, int opaque_zero) { return bits_f32(bits_u32(x) | u32(opaque_zero)); }
FN f64 opaque_copy_(f64 x, int opaque_zero) { return __longlong_as_double(__double_as_longlong(x) | (long long)opaque_zero); }

FN b1 any(b1 x) { return x; }
FN b1 any_lane(b1 x) { return x; }  // threads may take different branches
FN f32 f32_lanes(f32 x) { return x; }
FN f64 f64_lanes(f64 x) { return x; }
FN i32 i32_lanes(i32 x) { return x; }
FN u32 u32_lanes(u32 x) { return x; }
FN b1 b1_lanes(b1 x) { return x; }

// A number of drone d of the same world.
template <class T> FN T read_drone(T x, int d) { return GROUP == 1 ? x : __shfl_sync(0xffffffffu, x, threadIdx.x % 32 / GROUP * GROUP + d); }
FN b1 read_drone(b1 x, int d) { return read_drone(i32(x), d) != 0; }

// Read a number that all lanes share, where it is used. The compiler moves this assembly out of the loop over steps, but
// not out of branches. It would move an ordinary load out of both, and keep the number in a register.
#define SHARED(p, k) read(p + k)
#define READ(T, type, to) FN T read(const T* p) { T x; asm("ld.global.nc." type " %0, [%1];" : to(x) : "l"(p)); return x; }
READ(f32, "f32", "=f") READ(f64, "f64", "=d") READ(i32, "s32", "=r") READ(u32, "u32", "=r")
FN b1 read(const b1* p) { return *p; }

#define ROWS(T, SIZE, DRONES, p)
#define DECLARE_RESULT(T, SIZE, p)
#define STORE_RESULT(SIZE, DRONES, p)
#define LOAD(SIZE, DRONES, p, k) p[lane / DRONES * SIZE + k]
#define STORE(SIZE, DRONES, p, k, value) if (is_active && lane % DRONES == 0) p[lane / DRONES * SIZE + k] = value;
#define LANE lane
// A row of numbers, one for each lane.
#define LOAD_ROW(p, k) p[size_t(k) * n_lanes + lane]
#define STORE_ROW(p, k, value) if (is_active) p[size_t(k) * n_lanes + lane] = value;
// Tables of constants. lookup returns the entry at index + k; lookup_four returns that entry and the next three, and
// index + k must be a multiple of four.
#define TABLE static __device__ const __align__(16)
struct four { f32 x[4]; };
template <class T> FN T lookup(const T* p, i32 index, i32 k) { return (p + index)[k]; }
FN four lookup_four(const f32* p, i32 index, i32 k) {
  const float4 v = __ldg((const float4*)(p + index + k));
  return {{v.x, v.y, v.z, v.w}};
}
