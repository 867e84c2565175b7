// A lane is a thread.
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
// Sine and cosine of one angle share nearly all of their work, which the compiler sees when both are written out:
// reduction by pi/2 in three parts (Cody and Waite), from 8192 rad on in float64, then the polynomials of
// S. L. Moshier's Cephes library. Unlike the CUDA library's they need no memory for far angles.
#define F32_SINE \
  FN f32 reduced(f32 x, i32& quarter) { \
    if (fabsf(x) < 8192.0f) { \
      const f32 n = rintf(x * 0.636619772367581343f); \
      quarter = i32(n); \
      return fmaf(n, -7.54978995489188216e-8f, fmaf(n, -4.837512969970703125e-4f, fmaf(n, -1.5703125f, x))); \
    } \
    const f64 n = rint(f64(x) * 0.63661977236758134308); \
    quarter = i32(n - 4.0 * floor(0.25 * n)); \
    const f64 r = fma(n, -6.1232339957367658860e-17, fma(n, -1.5707963267948965580, f64(x))); \
    return f32(fmin(fmax(r, -0.79), 0.79)) + (x - x); /* NaN and infinity give NaN */ \
  } \
  FN f32 near_sin(f32 r, f32 z) { \
    return fmaf(r * z, fmaf(z, fmaf(z, -1.9515295891e-4f, 8.3321608736e-3f), -1.6666654611e-1f), r); \
  } \
  FN f32 near_cos(f32 z) { \
    const f32 p = fmaf(z, fmaf(z, 2.443315711809948e-5f, -1.388731625493765e-3f), 4.166664568298827e-2f); \
    return fmaf(z * z, p, fmaf(z, -0.5f, 1.0f)); \
  } \
  FN f32 sin_(f32 x) { \
    i32 q; const f32 r = reduced(x, q), z = r * r, y = (q & 1) ? near_cos(z) : near_sin(r, z); \
    return (q & 2) ? -y : y; \
  } \
  FN f32 cos_(f32 x) { \
    i32 q; const f32 r = reduced(x, q), z = r * r, y = (q & 1) ? near_sin(r, z) : near_cos(z); \
    return ((q + 1) & 2) ? -y : y; \
  }
#include "scalar.h"

FN b1 any(b1 x) { return x; }
FN f32 f32_lanes(f32 x) { return x; }
FN f64 f64_lanes(f64 x) { return x; }
FN i32 i32_lanes(i32 x) { return x; }
FN u32 u32_lanes(u32 x) { return x; }
FN b1 b1_lanes(b1 x) { return x; }

#define LOAD(p, index) p[index]
#define STORE(p, index, value) if (active) p[index] = value;
