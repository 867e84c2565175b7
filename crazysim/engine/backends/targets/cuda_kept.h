// Numbers that a gradient keeps of each step of an interval: those of the lanes of neighbouring threads are neighbours.
#if WIDEST == 8
typedef unsigned long long Kept;
FN Kept as_kept(f64 x) { return __double_as_longlong(x); }
FN f64 from_kept(Kept x, f64) { return __longlong_as_double(x); }
#else
typedef unsigned int Kept;
#endif
FN Kept as_kept(f32 x) { return BITS_U32(x); }
FN Kept as_kept(i32 x) { return u32(x); }
FN Kept as_kept(u32 x) { return x; }
FN Kept as_kept(b1 x) { return x; }
FN f32 from_kept(Kept x, f32) { return BITS_F32(u32(x)); }
FN i32 from_kept(Kept x, i32) { return i32(u32(x)); }
FN u32 from_kept(Kept x, u32) { return u32(x); }
FN b1 from_kept(Kept x, b1) { return x != 0; }
#define KEPT_AT(state, k) kept[(size_t(state) * N_KEPT + k) * (gridDim.x * blockDim.x) + blockIdx.x * blockDim.x + threadIdx.x]
#define KEEP(T, state, k, x) KEPT_AT(state, k) = as_kept(x);
#define KEPT(T, state, k) from_kept(KEPT_AT(state, k), T())
