// W lanes are a vector, one of the vector types of GCC and Clang. Numbers that all lanes share are scalars.
// Only C headers are included (-nostdinc++): parsing C++ headers would take longer than parsing everything else.
#include <math.h>
#include <pthread.h>
#include <sched.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "xla/ffi/api/c_api.h"

#define FN static inline __attribute__((always_inline))
#define RSQRTF(x) (1.0f / sqrtf(x))
static inline float bits_to_float(unsigned x) { float y; memcpy(&y, &x, 4); return y; }
static inline unsigned bits_of_float(float x) { unsigned y; memcpy(&y, &x, 4); return y; }
#define BITS_F32(x) bits_to_float(x)
#define BITS_U32(x) bits_of_float(x)
#include "scalar.h"

#if defined(__AVX512F__)
#define REGISTER_BYTES 64
#elif defined(__AVX__)
#define REGISTER_BYTES 32
#else
#define REGISTER_BYTES 16
#endif
// Drones of a world that read each other's numbers form a group. A vector has W lanes: as many numbers of the widest
// type as fit into a register, but at least one group. LANES of them are used, which are whole groups. A group of more
// than 8 drones has several vectors. A block is one vector, or all vectors of one such group.
#if GROUP <= 8
#define W (REGISTER_BYTES / MAX_NUMBER_BYTES > GROUP ? REGISTER_BYTES / MAX_NUMBER_BYTES : GROUP <= 2 ? 2 : GROUP <= 4 ? 4 : 8)
#define LANES (W / GROUP * GROUP)
#define VECTORS 1
#else
#define W (REGISTER_BYTES / MAX_NUMBER_BYTES)
#define LANES W
#define VECTORS ((GROUP + W - 1) / W)
#endif
#define LANES_OF_BLOCK (VECTORS == 1 && GROUP <= 8 ? LANES : GROUP)
#define UNROLL _Pragma("GCC unroll 8")
// Loops over vectors (EACH_SINGLE_VECTOR); for groups of several vectors, loops over worlds (EACH_WORLD) and over the
// vectors of a world (EACH_VECTOR).
#define EACH_SINGLE_VECTOR \
  for (int64_t first = from; first < to; first += LANES) \
    if (const int n_active = n_lanes - first < LANES ? int(n_lanes - first) : LANES; true) \
      if (const i32v own_drone = lane_indices() % GROUP; true)
#define EACH_WORLD for (int64_t world_start = from; world_start < to; world_start += GROUP)
#define EACH_VECTOR \
  for (int v = 0; v < VECTORS; ++v) \
    if (const int64_t first = world_start + v * W; true) \
      if (const int n_active = GROUP - v * W < W ? GROUP - v * W : W; true) \
        if (const i32v own_drone = lane_indices() + v * W; true)

template <class T> struct vec { typedef T type __attribute__((vector_size(sizeof(T) * W))); };
typedef vec<f32>::type f32v;
typedef vec<f64>::type f64v;
typedef vec<i32>::type i32v;
typedef vec<u32>::type u32v;
typedef vec<int64_t>::type i64v;
typedef vec<int8_t>::type i8v;
struct b1v { i32v m; };  // all bits set where true
template <> struct vec<b1> { typedef b1v type; };

// std::enable_if_t, which C headers do not define.
template <bool> struct enable_if {};
template <> struct enable_if<true> { typedef void type; };
template <bool condition> using enable_if_t = typename enable_if<condition>::type;

// Conversion of a scalar to a vector (lift), and the type of one lane of a vector (one).
template <class T> struct is_lanes { static const bool value = false; };
template <> struct is_lanes<f32v> { static const bool value = true; typedef f32 one; };
template <> struct is_lanes<f64v> { static const bool value = true; typedef f64 one; };
template <> struct is_lanes<i32v> { static const bool value = true; typedef i32 one; };
template <> struct is_lanes<u32v> { static const bool value = true; typedef u32 one; };
template <> struct is_lanes<b1v> { static const bool value = true; typedef b1 one; };
template <class... T> struct any_lanes { static const bool value = (is_lanes<T>::value || ...); };
FN f32v lift(f32 x) { return x - f32v{}; }  // a sum would lose the sign of -0.0
FN f64v lift(f64 x) { return x - f64v{}; }
FN i32v lift(i32 x) { return i32v{} + x; }
FN u32v lift(u32 x) { return u32v{} + x; }
FN b1v lift(b1 x) { return {i32v{} - i32(x)}; }
template <class V, class = enable_if_t<is_lanes<V>::value>> FN V lift(V x) { return x; }
template <class T> FN f32v f32_lanes(T x) { return lift(x); }
template <class T> FN f64v f64_lanes(T x) { return lift(x); }
template <class T> FN i32v i32_lanes(T x) { return lift(x); }
template <class T> FN u32v u32_lanes(T x) { return lift(x); }
template <class T> FN b1v b1_lanes(T x) { return lift(x); }

#define OPAQUE_COPY(x) (x)  // the compiler decides whether to repeat computations or to keep their results
FN i32v lane_indices() { i32v x; for (int i = 0; i < W; ++i) x[i] = i; return x; }
// A number of drone d of the same world.
template <class V> FN V read_drone(V x, int d) {
  if (GROUP == 1) return x;
  decltype(x == x) from;
  for (int i = 0; i < W; ++i) { const int j = i / GROUP * GROUP + d; from[i] = j < W ? j : W - 1; }
#if defined(__clang__)
  V y;
  for (int i = 0; i < W; ++i) y[i] = x[from[i]];
  return y;
#else
  return __builtin_shuffle(x, from);
#endif
}
FN b1v read_drone(b1v x, int d) { return {read_drone(x.m, d)}; }

// A number of drone d of a world of several vectors.
template <class V> FN auto read_place(const V* x, int d) { return x[d / W][d % W]; }
FN b1 read_place(const b1v* x, int d) { return x[d / W].m[d % W] != 0; }

FN b1v mask(i32v m) { return {m}; }
FN b1v mask(i64v m) { return {__builtin_convertvector(m, i32v)}; }
FN b1 any(b1 x) { return x; }
FN b1 any_lane(b1 x) { return x; }
FN b1 any(b1v x) {
  const auto bytes = __builtin_convertvector(x.m, i8v);
  uint64_t parts[(W + 7) / 8] = {};
  memcpy(parts, &bytes, sizeof(bytes));
  return W > 8 ? (parts[0] | parts[(W + 7) / 8 - 1]) != 0 : parts[0] != 0;
}
FN b1 any_lane(b1v x) { return any(x); }

#define LANES1(A) template <class A, class = enable_if_t<is_lanes<A>::value>> FN
#define LANES2(A, B) template <class A, class B, class = enable_if_t<any_lanes<A, B>::value>> FN
#define OPERATOR(NAME, OP) LANES2(A, B) auto NAME##_(A a, B b) { return lift(a) OP lift(b); }
OPERATOR(add, +) OPERATOR(sub, -) OPERATOR(mul, *)
#define COMPARE(NAME, OP) LANES2(A, B) b1v NAME##_(A a, B b) { return mask(lift(a) OP lift(b)); }
COMPARE(lt, <) COMPARE(le, <=) COMPARE(gt, >) COMPARE(ge, >=)
FN b1v are_equal(b1v a, b1v b) { return {a.m == b.m}; }
template <class V> FN b1v are_equal(V a, V b) { return mask(a == b); }
FN b1v not_(b1v a) { return {~a.m}; }
FN i32v not_(i32v a) { return ~a; }
FN u32v not_(u32v a) { return ~a; }
LANES2(A, B) b1v eq_(A a, B b) { return are_equal(lift(a), lift(b)); }
LANES2(A, B) b1v ne_(A a, B b) { return not_(are_equal(lift(a), lift(b))); }
#define BITWISE(NAME, OP) \
  FN b1v NAME##_lanes(b1v a, b1v b) { return {a.m OP b.m}; } template <class V> FN V NAME##_lanes(V a, V b) { return a OP b; } \
  LANES2(A, B) auto NAME##_(A a, B b) { return NAME##_lanes(lift(a), lift(b)); }
BITWISE(and, &) BITWISE(or, |) BITWISE(xor, ^)

FN f32v select_lanes(b1v w, f32v no, f32v yes) { return w.m ? yes : no; }
FN i32v select_lanes(b1v w, i32v no, i32v yes) { return w.m ? yes : no; }
FN u32v select_lanes(b1v w, u32v no, u32v yes) { return w.m ? yes : no; }
FN f64v select_lanes(b1v w, f64v no, f64v yes) { return __builtin_convertvector(w.m, i64v) ? yes : no; }
FN b1v select_lanes(b1v w, b1v no, b1v yes) { return {(w.m & yes.m) | (~w.m & no.m)}; }
template <class C, class A, class B, class = enable_if_t<any_lanes<C, A, B>::value>>
FN auto select_n_(C which, A no, B yes) { return select_lanes(lift(which), lift(no), lift(yes)); }
LANES2(A, B) auto max_(A a, B b) { return select_n_(or_(gt_(a, b), ne_(a, a)), b, a); }
LANES2(A, B) auto min_(A a, B b) { return select_n_(or_(lt_(a, b), ne_(a, a)), b, a); }
LANES2(A, B) auto at_least(A x, B low) { return select_n_(lt_(x, low), x, low); }
LANES2(A, B) auto at_most(A x, B high) { return select_n_(gt_(x, high), x, high); }
template <class A, class B, class C, class = enable_if_t<any_lanes<A, B, C>::value>>
FN auto clamp_(A low, B x, C high) { return min_(max_(x, low), high); }

// Apply a function to each lane, in a form that compilers can turn into vector instructions.
template <class R, class F, class V> FN R map_lanes(F f, V x) {
  typename is_lanes<V>::one a[W];
  typename is_lanes<R>::one r[W];
  memcpy(a, &x, sizeof(x));
  for (int i = 0; i < W; ++i) r[i] = f(a[i]);
  R out;
  memcpy(&out, r, sizeof(out));
  return out;
}
template <class F, class V> FN V map_lanes2(F f, V x, V y) {
  typename is_lanes<V>::one a[W], b[W];
  memcpy(a, &x, sizeof(x));
  memcpy(b, &y, sizeof(y));
  for (int i = 0; i < W; ++i) a[i] = f(a[i], b[i]);
  memcpy(&x, a, sizeof(x));
  return x;
}
#define EACH(NAME) LANES1(V) V NAME##_(V x) { typedef typename is_lanes<V>::one T; return map_lanes<V>([](T t) { return NAME##_(t); }, x); }
EACH(acos) EACH(acosh) EACH(asin) EACH(asinh) EACH(atan) EACH(atanh) EACH(cbrt) EACH(ceil) EACH(cosh) EACH(digamma) EACH(erf) EACH(erfc)
EACH(erf_inv) EACH(exp2) EACH(expm1) EACH(floor) EACH(log) EACH(lgamma) EACH(log1p) EACH(logistic) EACH(round_even)
EACH(round_away) EACH(sign) EACH(sinh) EACH(sqrt) EACH(tan) EACH(tanh)
#define EACH2(NAME) LANES2(A, B) auto NAME##_(A x, B y) { \
  typedef typename is_lanes<decltype(lift(x))>::one T; return map_lanes2([](T s, T t) { return NAME##_(s, t); }, lift(x), lift(y)); }
EACH2(nextafter) EACH2(pow) EACH2(rem) EACH2(shift_right_arithmetic) EACH2(shift_left) EACH2(shift_right_logical)
LANES1(V) V neg_(V x) { return -x; }
LANES1(V) V abs_(V x) { return select_n_(lt_(x, V{}), select_n_(eq_(x, V{}), x, V{}), -x); }
LANES1(V) V rsqrt_(V x) { return lift(typename is_lanes<V>::one(1)) / sqrt_(x); }
FN f32v quotient(f32v a, f32v b) { return a / b; }
FN f64v quotient(f64v a, f64v b) { return a / b; }
FN i32v quotient(i32v a, i32v b) { return map_lanes2([](i32 s, i32 t) { return div_(s, t); }, a, b); }
FN u32v quotient(u32v a, u32v b) { return map_lanes2([](u32 s, u32 t) { return div_(s, t); }, a, b); }
LANES2(A, B) auto div_(A a, B b) { return quotient(lift(a), lift(b)); }
// A division by a constant compiles to multiplications.
FN i32v div_(i32v a, i32 b) { return __builtin_constant_p(b) && b > 0 ? a / b : quotient(a, lift(b)); }
LANES1(V) b1v is_finite_(V x) { return eq_(x - x, V{}); }
LANES1(V) V integer_pow(V x, int y) {
  V p = lift(typename is_lanes<V>::one(1)), one = p;
  for (int n = y < 0 ? -y : y; n; n >>= 1, x = x * x) if (n & 1) p = p * x;
  return y < 0 ? one / p : p;
}

// As for single numbers (scalar.h). From 8192 rad on, the scalar function is called for each lane.
FN void sin_cos(f32v x, f32v& s, f32v& c) {
  if (any(not_(lt_(abs_(x), 8192.0f)))) {
    for (int i = 0; i < W; ++i) { f32 a, b; sin_cos(f32(x[i]), a, b); s[i] = a; c[i] = b; }
    return;
  }
  const f32v n = round_even_(x * 0.636619772367581343f);
  const f32v r = ((x - n * 1.5703125f) - n * 4.837512969970703125e-4f) - n * 7.54978995489188216e-8f;
  const i32v quarter = __builtin_convertvector(n, i32v);
  const f32v z = r * r;
  const f32v a = r + r * z * (-1.6666654611e-1f + z * (8.3321608736e-3f + z * -1.9515295891e-4f));
  const f32v b = 1.0f - 0.5f * z + z * z * (4.166664568298827e-2f + z * (-1.388731625493765e-3f + z * 2.443315711809948e-5f));
  const i32v odd = (quarter & 1) != 0;
  const f32v sine = odd ? b : a, cosine = odd ? a : b;
  s = (quarter & 2) != 0 ? -sine : sine;
  c = ((quarter + 1) & 2) != 0 ? -cosine : cosine;
}
FN void sin_cos(f64v x, f64v& s, f64v& c) { for (int i = 0; i < W; ++i) { s[i] = sin(x[i]); c[i] = cos(x[i]); } }

// Accurate to 1.5 units in the last place. The polynomial was fitted for the least relative error.
FN f32v exp_(f32v x) {
  const f32v in = at_most(at_least(x, -104.0f), 89.0f);  // the results are zero below and infinity above
  const f32v n = round_even_(in * 1.44269504088896341f);
  const f32v r = (in - n * 0.693359375f) - n * -2.12194440e-4f;
  const f32v p = 0.4999999403953552f + r * (0.1666652113199234f + r * (0.04166838899254799f +
      r * (0.008368715643882751f + r * 0.0013814602280035615f)));
  const i32v whole = __builtin_convertvector(select_n_(eq_(n, n), f32v{}, n), i32v), half = whole >> 1;
  // The power of two is split into two factors, which are normal numbers even if their product is not.
  return (1.0f + (r + r * r * p)) * (f32v)((half + 127) << 23) * (f32v)((whole - half + 127) << 23);
}
FN f64v exp_(f64v x) { return map_lanes<f64v>([](f64 t) { return exp_(t); }, x); }
// S. L. Moshier's logf of the Cephes library at 1 + x, for x from -1 to 0, corrected for the rounding of 1 + x.
FN f32v log1p_below(f32v x) {
  const f32v u = 1.0f + x, rest = (x - (u - 1.0f)) / u;
  const i32v bits = (i32v)u, scaled = bits - 0x3f3504f3;  // the mantissa from sqrt(1/2) to sqrt(2)
  const i32v e = scaled >> 23;
  const f32v n = __builtin_convertvector(e, f32v), m = (f32v)(bits - (e << 23)) - 1.0f, z = m * m;
  const f32v p = 3.3333331174e-1f + m * (-2.4999993993e-1f + m * (2.0000714765e-1f + m * (-1.6668057665e-1f +
      m * (1.4249322787e-1f + m * (-1.2420140846e-1f + m * (1.1676998740e-1f + m * (-1.1514610310e-1f +
      m * 7.0376836292e-2f)))))));
  return n * 0.693359375f + (m + (m * z * p + n * -2.12194440e-4f - 0.5f * z + rest));
}
// As for single numbers (scalar.h), with both branches computed.
FN f32v erf_inv_(f32v x) {
  const f32v w = -log1p_below(-x * x), near = w - 2.5f, far = sqrt_(w) - 3.0f;
  f32v p = 3.43273939e-07f + 2.81022636e-08f * near, q = 0.000100950558f + -0.000200214257f * far;
  p = -3.5233877e-06f + p * near; p = -4.39150654e-06f + p * near; p = 0.00021858087f + p * near;
  p = -0.00125372503f + p * near; p = -0.00417768164f + p * near; p = 0.246640727f + p * near; p = 1.50140941f + p * near;
  q = 0.00134934322f + q * far; q = -0.00367342844f + q * far; q = 0.00573950773f + q * far; q = -0.0076224613f + q * far;
  q = 0.00943887047f + q * far; q = 1.00167406f + q * far; q = 2.83297682f + q * far;
  const f32v size = abs_(x), infinite = lift(f32_infinity());
  return size == 1.0f ? x * infinite : size > 1.0f ? infinite - infinite : (w < 5.0f ? p : q) * x;
}
FN f32v atan2_(f32v y, f32v x) {
  const i32v sign = (i32v)y & i32v(lift(i32(-2147483647 - 1)));
  const f32v a = (f32v)((i32v)x & 0x7fffffff), b = (f32v)((i32v)y & 0x7fffffff);
  const f32v low = a < b ? a : b, high = a < b ? b : a;
  const f32v one = lift(f32(1));
  const f32v z = low == high ? (low == 0.0f ? low : one) : low / high;  // both may be zero, or infinite
  const f32v u = z * z;
  const f32v q = -0.33333152532577515f + u * (0.19993773102760315f + u * (-0.14211055636405945f + u * (0.10666004568338394f +
      u * (-0.07552213966846466f + u * (0.04321185126900673f + u * (-0.016367923468351364f + u * 0.0029206909239292145f))))));
  f32v r = z + z * u * q;
  r = a < b ? (1.57079637050628662f - r) - 4.37113883e-8f : r;
  r = (i32v)x < 0 ? (3.14159274101257324f - r) - 8.74227766e-8f : r;
  return (f32v)((i32v)r | sign);
}
FN f64v atan2_(f64v y, f64v x) { return map_lanes2([](f64 s, f64 t) { return atan2_(s, t); }, y, x); }
LANES2(A, B) auto atan2_(A y, B x) { return atan2_(lift(y), lift(x)); }

FN f32v to_f32(f32v x) { return x; }
FN f32v to_f32(f64v x) { return __builtin_convertvector(x, f32v); }
FN f32v to_f32(i32v x) { return __builtin_convertvector(x, f32v); }
FN f32v to_f32(u32v x) { return __builtin_convertvector(x, f32v); }
FN f32v to_f32(b1v x) { return __builtin_convertvector(-x.m, f32v); }
FN f64v to_f64(f64v x) { return x; }
FN f64v to_f64(b1v x) { return __builtin_convertvector(-x.m, f64v); }
LANES1(V) f64v to_f64(V x) { return __builtin_convertvector(x, f64v); }
LANES1(V) i32v to_i32(V x) { return map_lanes<i32v>([](typename is_lanes<V>::one t) { return to_i32(t); }, x); }
LANES1(V) u32v to_u32(V x) { return map_lanes<u32v>([](typename is_lanes<V>::one t) { return to_u32(t); }, x); }
FN i32v to_i32(b1v x) { return -x.m; }
FN u32v to_u32(b1v x) { return (u32v)(-x.m); }
FN b1v to_b1(b1v x) { return x; }
LANES1(V) b1v to_b1(V x) { return ne_(x, V{}); }
template <class V> FN u32v bits_u32(V x) { return (u32v)x; }
template <class V> FN i32v bits_i32(V x) { return (i32v)x; }
template <class V> FN f32v bits_f32(V x) { return (f32v)x; }

// Each lane has a row of SIZE numbers. Rows are loaded and stored four numbers at a time, and transposed in registers.
#if W % 4 == 0 && defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define TRANSPOSES
#endif
#endif
#ifdef TRANSPOSES
template <class T> struct quad { typedef T type __attribute__((vector_size(4 * sizeof(T)))); };
template <class T> FN typename quad<T>::type load_quad(const T* p) { typename quad<T>::type x; memcpy(&x, p, sizeof(x)); return x; }
// A quad is four neighbouring lanes of a vector. SHUFFLE_QUADS selects four numbers from each pair of quads of two
// vectors: 0 to 3 are of the first vector, 4 to 7 of the second. JOIN_ROWS is the vector of the rows i, i + 4, ...,
// four numbers of each. EACH_QUAD applies a macro to the index of each quad.
#define LANE_OF_QUAD(i, quad) ((i) / 4 * W + (i) % 4 + 4 * (quad))
#define LANES_OF_QUAD(quad, i, j, k, l) LANE_OF_QUAD(i, quad), LANE_OF_QUAD(j, quad), LANE_OF_QUAD(k, quad), LANE_OF_QUAD(l, quad)
#if W == 4
#define LANES_OF_QUADS(i, j, k, l) i, j, k, l
#define JOIN_ROWS(row, i) row(i)
#define EACH_QUAD(F) F(0)
#elif W == 8
#define LANES_OF_QUADS(i, j, k, l) LANES_OF_QUAD(0, i, j, k, l), LANES_OF_QUAD(1, i, j, k, l)
#define JOIN_ROWS(row, i) __builtin_shufflevector(row(i), row(i + 4), 0, 1, 2, 3, 4, 5, 6, 7)
#define EACH_QUAD(F) F(0) F(1)
#else
#define LANES_OF_QUADS(i, j, k, l) LANES_OF_QUAD(0, i, j, k, l), LANES_OF_QUAD(1, i, j, k, l), LANES_OF_QUAD(2, i, j, k, l), LANES_OF_QUAD(3, i, j, k, l)
#define JOIN_TWO_ROWS(row, i) __builtin_shufflevector(row(i), row(i + 4), 0, 1, 2, 3, 4, 5, 6, 7)
#define JOIN_ROWS(row, i) __builtin_shufflevector(JOIN_TWO_ROWS(row, i), JOIN_TWO_ROWS(row, i + 8), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#define EACH_QUAD(F) F(0) F(1) F(2) F(3)
#endif
#define SHUFFLE_QUADS(a, b, i, j, k, l) __builtin_shufflevector(a, b, LANES_OF_QUADS(i, j, k, l))
template <class V> FN void transpose(V* r) {
  const V a = SHUFFLE_QUADS(r[0], r[1], 0, 4, 1, 5), b = SHUFFLE_QUADS(r[2], r[3], 0, 4, 1, 5);
  const V c = SHUFFLE_QUADS(r[0], r[1], 2, 6, 3, 7), d = SHUFFLE_QUADS(r[2], r[3], 2, 6, 3, 7);
  r[0] = SHUFFLE_QUADS(a, b, 0, 1, 4, 5); r[1] = SHUFFLE_QUADS(a, b, 2, 3, 6, 7);
  r[2] = SHUFFLE_QUADS(c, d, 0, 1, 4, 5); r[3] = SHUFFLE_QUADS(c, d, 2, 3, 6, 7);
}
#endif
#define NOINLINE static __attribute__((noinline))
// The rows of the lanes of a vector. Lanes beyond the last lane repeat its row. If DRONES lanes share a row, which is a
// row of their world, lane i has row i / DRONES.
template <int SIZE, int DRONES, class T> NOINLINE const T* copy_rows(T* to, const T* p, int64_t first, int n) {
  for (int i = 0; i < W; ++i) memcpy(to + i * SIZE, p + (first + (i < n ? i : n - 1)) / DRONES * SIZE, SIZE * sizeof(T));
  return to;
}
template <int SIZE, int DRONES, class T> FN const T* find_rows(T* buffer, const T* p, int64_t first, int n) {
  return DRONES > 1 || n < LANES ? copy_rows<SIZE, DRONES>(buffer, p, first, n) : p + first * SIZE;
}
template <int SIZE, int DRONES, class T> NOINLINE void copy_back(const T* from, T* p, int64_t first, int n) {
  for (int i = 0; i < n; ++i) memcpy(p + (first + i) / DRONES * SIZE, from + i * SIZE, SIZE * sizeof(T));
}
template <class V> FN V from_memory(V x) { return x; }
typedef uint8_t u8v __attribute__((vector_size(W)));
FN b1v from_memory(u8v x) { return {-__builtin_convertvector(x, i32v)}; }
template <class V> FN V to_memory(V x) { return x; }
FN u8v to_memory(b1v x) { return __builtin_convertvector(-x.m, u8v); }
// Number k of each row of a vector.
template <int SIZE, class T> FN typename vec<T>::type load_number(const T* p, int k) {
  decltype(to_memory(typename vec<T>::type())) x;
  if (SIZE == 1 && LANES == W) {
    memcpy(&x, p, sizeof(x));
    return from_memory(x);
  }
#ifdef TRANSPOSES
  if constexpr (SIZE >= 3 && sizeof(T) >= 4) {
    const int from = SIZE <= 4 ? 0 : k / 4 * 4 + 4 <= SIZE ? k / 4 * 4 : SIZE - 4;
    const auto row = [=](int i) __attribute__((always_inline)) -> typename quad<T>::type {
      const T* const at = p + (i < LANES ? i : LANES - 1) * SIZE + from;
      if (SIZE > 3 || i < LANES - 1) return load_quad(at);
      const auto x = load_quad(at - 1);  // a read beyond the last row may be out of bounds
      return __builtin_shufflevector(x, x, 1, 2, 3, 3);
    };
    typename vec<T>::type r[4] = {JOIN_ROWS(row, 0), JOIN_ROWS(row, 1), JOIN_ROWS(row, 2), JOIN_ROWS(row, 3)};
    transpose(r);
    return r[k - from];
  }
#endif
  for (int i = 0; i < W; ++i) x[i] = p[(i < LANES ? i : LANES - 1) * SIZE + k];
  return from_memory(x);
}
// Rows of three numbers are written as four; the next row overwrites the fourth number.
#define STORE_QUAD(quad) UNROLL for (int j = 0; j < 4 && 4 * quad + j < LANES; ++j) { \
  const auto y = __builtin_shufflevector(r[j], r[j], 4 * quad, 4 * quad + 1, 4 * quad + 2, 4 * quad + 3); \
  memcpy(p + (4 * quad + j) * SIZE + from, &y, (SIZE == 3 && 4 * quad + j == LANES - 1 ? 3 : 4) * sizeof(T)); \
}
template <int SIZE, class T, class V> FN void store_rows(T* p, const V* x) {
  if (SIZE == 1) {
    const auto y = to_memory(x[0]);
    memcpy(p, &y, LANES * sizeof(T));
    return;
  }
#ifdef TRANSPOSES
  if constexpr (SIZE >= 3 && sizeof(T) >= 4) {
    UNROLL for (int k = 0; k < SIZE; k += 4) {
      const int from = SIZE <= 4 ? 0 : k + 4 <= SIZE ? k : SIZE - 4;
      V r[4] = {x[from], x[from + 1], x[from + 2], x[from + (SIZE > 3 ? 3 : 2)]};
      transpose(r);
      EACH_QUAD(STORE_QUAD)
    }
    return;
  }
#endif
  for (int k = 0; k < SIZE; ++k) {
    const auto y = to_memory(x[k]);
    for (int i = 0; i < LANES; ++i) p[i * SIZE + k] = y[i];
  }
}
template <int SIZE, int DRONES, class T, class V> FN void store_result(T* p, int64_t first, int n, const V* x) {
  T buffer[SIZE * W];
  const bool is_direct = DRONES == 1 && n == LANES;
  store_rows<SIZE>(is_direct ? p + first * SIZE : buffer, x);
  if (!is_direct) copy_back<SIZE, DRONES>(buffer, p, first, n);
}
#define ROWS(T, SIZE, DRONES, p) T buffer_##p[SIZE * W]; const T* const rows_##p = find_rows<SIZE, DRONES>(buffer_##p, p, first, n_active);
#define LOAD(SIZE, DRONES, p, k) load_number<SIZE>(rows_##p, k)
#define DECLARE_RESULT(T, SIZE, p) vec<T>::type result_##p[SIZE];
#define STORE(SIZE, DRONES, p, k, value) result_##p[k] = value;
#define STORE_RESULT(SIZE, DRONES, p) store_result<SIZE, DRONES>(p, first, n_active, result_##p);
// The index of each lane. Lanes beyond the last lane have its index.
FN i32v lane_numbers(int64_t first, int n) { const i32v i = lane_indices(); return i32(first) + (i < n ? i : lift(n - 1)); }
#define LANE lane_numbers(first, n_active)
// A row of numbers, one for each lane.
template <class T> FN typename vec<T>::type load_row(const T* p, int n) {
  T buffer[W];
  return load_number<1>(find_rows<1, 1>(buffer, p, 0, n), 0);
}
#define LOAD_ROW(p, k) load_row(p + (k) * n_lanes + first, n_active)
#define STORE_ROW(p, k, value) { const auto x = value; store_result<1, 1>(p + (k) * n_lanes, first, n_active, &x); }

// Tables of constants. lookup returns the entry at index + k; lookup_four returns that entry and the next three.
#define TABLE static const
template <class V> struct four { V x[4]; };
template <class T> FN T lookup(const T* p, i32 index, i32 k) { return (p + index)[k]; }
template <class T> FN typename vec<T>::type lookup(const T* p, i32v index, i32 k) {
  if (!any(ne_(index, index[0]))) return lift(p[index[0] + k]);  // all lanes read the same entry
  typename vec<T>::type x;
  for (int i = 0; i < W; ++i) x[i] = p[index[i] + k];
  return x;
}
FN b1v lookup(const b1* p, i32v index, i32 k) {
  i32v x;
  for (int i = 0; i < W; ++i) x[i] = p[index[i] + k];
  return {-x};
}
FN four<f32> lookup_four(const f32* p, i32 index, i32 k) {
  four<f32> r;
  memcpy(&r, p + index + k, sizeof(r));
  return r;
}
FN four<f32v> lookup_four(const f32* p, i32v index, i32 k) {
  if (!any(ne_(index, index[0]))) {
    const four<f32> r = lookup_four(p, index[0], k);
    return {{lift(r.x[0]), lift(r.x[1]), lift(r.x[2]), lift(r.x[3])}};
  }
#ifdef TRANSPOSES
  const auto row = [=](int i) __attribute__((always_inline)) { return load_quad(p + index[i] + k); };
  four<f32v> r = {{JOIN_ROWS(row, 0), JOIN_ROWS(row, 1), JOIN_ROWS(row, 2), JOIN_ROWS(row, 3)}};
  transpose(r.x);
#else
  four<f32v> r;
  for (int i = 0; i < W; ++i) for (int j = 0; j < 4; ++j) r.x[j][i] = p[index[i] + k + j];
#endif
  return r;
}

// Allocation of memory aligned to cache lines.
#ifndef ALLOCATE
#define ALLOCATE(size) aligned_alloc(64, ((size) + 63) / 64 * 64)
#endif

