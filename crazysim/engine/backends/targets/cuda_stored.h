// Numbers that the backward pass stores of each step of an interval. Numbers of neighbouring threads are neighbours.
#if MAX_NUMBER_BYTES == 8
typedef unsigned long long StoredNumber;
FN StoredNumber to_stored_number(f64 x) { return __double_as_longlong(x); }
FN f64 from_stored_number(StoredNumber x, f64) { return __longlong_as_double(x); }
#else
typedef unsigned int StoredNumber;
#endif
FN StoredNumber to_stored_number(f32 x) { return BITS_U32(x); }
FN StoredNumber to_stored_number(i32 x) { return u32(x); }
FN StoredNumber to_stored_number(u32 x) { return x; }
FN StoredNumber to_stored_number(b1 x) { return x; }
FN f32 from_stored_number(StoredNumber x, f32) { return BITS_F32(u32(x)); }
FN i32 from_stored_number(StoredNumber x, i32) { return i32(u32(x)); }
FN u32 from_stored_number(StoredNumber x, u32) { return u32(x); }
FN b1 from_stored_number(StoredNumber x, b1) { return x != 0; }
#define STATE_NUMBER(state, k) stored[(size_t(state) * N_STORED + k) * (gridDim.x * blockDim.x) + blockIdx.x * blockDim.x + threadIdx.x]
#define STORE_STATE(T, state, k, x) STATE_NUMBER(state, k) = to_stored_number(x);
#define LOAD_STATE(T, state, k) from_stored_number(STATE_NUMBER(state, k), T())
