// The operations of a program for single numbers, on the GPU and on the host.
// FN marks a function that both a GPU and a host compiler inline.

typedef float f32;
typedef double f64;
typedef int i32;
typedef unsigned int u32;
typedef bool b1;

FN f32 bits_f32(u32 x) { return BITS_F32(x); }
FN f32 bits_f32(i32 x) { return BITS_F32(u32(x)); }
FN u32 bits_u32(f32 x) { return BITS_U32(x); }
FN i32 bits_i32(f32 x) { return i32(BITS_U32(x)); }
FN u32 bits_u32(i32 x) { return u32(x); }
FN i32 bits_i32(u32 x) { return i32(x); }
FN f32 f32_nan() { return bits_f32(0x7fc00000u); }
FN f32 f32_infinity() { return bits_f32(0x7f800000u); }
FN f64 f64_nan() { return f64(f32_nan()); }
FN f64 f64_infinity() { return f64(f32_infinity()); }

#define UNARY(NAME, F32, F64) FN f32 NAME##_(f32 x) { return F32; } FN f64 NAME##_(f64 x) { return F64; }
UNARY(acos, acosf(x), acos(x)) UNARY(acosh, acoshf(x), acosh(x)) UNARY(asin, asinf(x), asin(x))
UNARY(asinh, asinhf(x), asinh(x)) UNARY(atan, atanf(x), atan(x)) UNARY(atanh, atanhf(x), atanh(x))
UNARY(cbrt, cbrtf(x), cbrt(x)) UNARY(ceil, ceilf(x), ceil(x)) UNARY(cosh, coshf(x), cosh(x)) UNARY(erf, erff(x), erf(x)) UNARY(erfc, erfcf(x), erfc(x))
UNARY(exp, expf(x), exp(x)) UNARY(exp2, exp2f(x), exp2(x)) UNARY(expm1, expm1f(x), expm1(x))
UNARY(floor, floorf(x), floor(x)) UNARY(log, logf(x), log(x)) UNARY(log1p, log1pf(x), log1p(x))
UNARY(sinh, sinhf(x), sinh(x)) UNARY(sqrt, sqrtf(x), sqrt(x))
UNARY(rsqrt, RSQRTF(x), 1.0 / sqrt(x)) UNARY(tan, tanf(x), tan(x)) UNARY(tanh, tanhf(x), tanh(x))
UNARY(logistic, 1.0f / (1.0f + expf(-x)), 1.0 / (1.0 + exp(-x)))
UNARY(round_even, rintf(x), rint(x)) UNARY(round_away, roundf(x), round(x))
UNARY(neg, -x, -x) UNARY(abs, fabsf(x), fabs(x))
UNARY(sign, x > 0 ? 1.0f : x < 0 ? -1.0f : x, x > 0 ? 1.0 : x < 0 ? -1.0 : x)
UNARY(lgamma, lgammaf(x), lgamma(x))
FN i32 neg_(i32 x) { return i32(0u - u32(x)); }
FN u32 neg_(u32 x) { return 0u - x; }
FN i32 abs_(i32 x) { return x < 0 ? neg_(x) : x; }
FN i32 sign_(i32 x) { return (x > 0) - (x < 0); }
FN u32 sign_(u32 x) { return x > 0u; }
FN b1 is_finite_(f32 x) { return fabsf(x) < f32_infinity(); }
FN b1 is_finite_(f64 x) { return fabs(x) < f64_infinity(); }

FN void sin_cos(f64 x, f64& s, f64& c) { s = sin(x); c = cos(x); }

// Reduction by pi/2 in three parts (Cody and Waite), in float64 for angles from 8192 rad on. Then the polynomials of
// S. L. Moshier's Cephes library.
FN void sin_cos(f32 x, f32& s, f32& c) {
  i32 quarter;
  f32 r;
  if (fabsf(x) < 8192.0f) {
    const f32 n = rintf(x * 0.636619772367581343f);
    quarter = i32(n);
    r = fmaf(n, -7.54978995489188216e-8f, fmaf(n, -4.837512969970703125e-4f, fmaf(n, -1.5703125f, x)));
  } else {
#ifndef __CUDACC_RTC__  // the library is exact for any angle; on GPUs its registers would cost every kernel
    s = f32(sin(f64(x)));
    c = f32(cos(f64(x)));
    return;
#endif
    const f64 n = rint(f64(x) * 0.63661977236758134308);
    quarter = i32(n - 4.0 * floor(0.25 * n));
    const f64 far = fma(n, -6.1232339957367658860e-17, fma(n, -1.5707963267948965580, f64(x)));
    r = f32(fmin(fmax(far, -0.79), 0.79)) + (x - x);  // NaN and infinity give NaN
  }
  const f32 z = r * r;
  const f32 a = fmaf(r * z, fmaf(z, fmaf(z, -1.9515295891e-4f, 8.3321608736e-3f), -1.6666654611e-1f), r);
  const f32 p = fmaf(z, fmaf(z, 2.443315711809948e-5f, -1.388731625493765e-3f), 4.166664568298827e-2f);
  const f32 b = fmaf(z * z, p, fmaf(z, -0.5f, 1.0f));
  const f32 sine = quarter & 1 ? b : a, cosine = quarter & 1 ? a : b;
  s = quarter & 2 ? -sine : sine;
  c = (quarter + 1) & 2 ? -cosine : cosine;
}

// M. Giles, Approximating the erfinv function, GPU Computing Gems 2 (2010); followed by Newton steps in float64.
FN f32 erf_inv_(f32 x) {
  f32 w = -log1pf(-x * x), p;
  if (w < 5.0f) {
    w -= 2.5f;
    p = 2.81022636e-08f; p = 3.43273939e-07f + p * w; p = -3.5233877e-06f + p * w; p = -4.39150654e-06f + p * w;
    p = 0.00021858087f + p * w; p = -0.00125372503f + p * w; p = -0.00417768164f + p * w; p = 0.246640727f + p * w;
    p = 1.50140941f + p * w;
  } else {
    w = sqrtf(w) - 3.0f;
    p = -0.000200214257f; p = 0.000100950558f + p * w; p = 0.00134934322f + p * w; p = -0.00367342844f + p * w;
    p = 0.00573950773f + p * w; p = -0.0076224613f + p * w; p = 0.00943887047f + p * w; p = 1.00167406f + p * w;
    p = 2.83297682f + p * w;
  }
  return fabsf(x) == 1.0f ? x * f32_infinity() : p * x;
}
FN f64 erf_inv_(f64 x) {
  const f64 size = fabs(x);
  f64 y = fabs(f64(erf_inv_(f32(x))));
  if (size < 1.0 && !(y < 6.0)) y = 5.0;  // float32 rounds x to one
  for (int k = 0; k < 4 && size < 1.0; ++k) y -= ((1.0 - size) - erfc(y)) * 0.88622692545275801365 * exp(y * y);
  return x < 0 ? -y : x > 0 ? y : x;
}

// NIST Digital Library of Mathematical Functions, https://dlmf.nist.gov/5: reflection (5.5.4), recurrence (5.5.2), and
// from 10 on the asymptotic series 5.11.2, which is exact to float64. Its coefficients are B(2k) / 2k with the Bernoulli
// numbers B; Wikipedia, "Digamma function", lists the first seven.
FN f64 digamma_(f64 x) {
  f64 y = 0.0;
  if (x <= 0.0) {
    if (x == floor(x)) return f64_nan();
    y = -3.14159265358979323846 / tan(3.14159265358979323846 * (x - rint(x)));
    x = 1.0 - x;
  }
  for (; x < 10.0; x += 1.0) y -= 1.0 / x;
  const f64 z = 1.0 / (x * x);
  const f64 series = z * (1.0 / 12 - z * (1.0 / 120 - z * (1.0 / 252 - z * (1.0 / 240 - z * (1.0 / 132 - z * (691.0 / 32760 - z / 12))))));
  return y + log(x) - 0.5 / x - series;
}
FN f32 digamma_(f32 x) { return f32(digamma_(f64(x))); }

#define ARITHMETIC(T, S) /* S is T, or the unsigned type of signed integers, which must not overflow in C */ \
  FN T add_(T a, T b) { return T(S(a) + S(b)); } FN T sub_(T a, T b) { return T(S(a) - S(b)); } \
  FN T mul_(T a, T b) { return T(S(a) * S(b)); }
ARITHMETIC(f32, f32) ARITHMETIC(f64, f64) ARITHMETIC(i32, u32) ARITHMETIC(u32, u32)
#define COMMON(T) \
  FN b1 lt_(T a, T b) { return a < b; } FN b1 le_(T a, T b) { return a <= b; } FN b1 gt_(T a, T b) { return a > b; } \
  FN b1 ge_(T a, T b) { return a >= b; } FN b1 eq_(T a, T b) { return a == b; } FN b1 ne_(T a, T b) { return a != b; } \
  FN T select_n_(b1 which, T no, T yes) { return which ? yes : no; }
#define LIMITS(T) /* NaN is propagated */ \
  FN T at_least(T x, T low) { return x < low ? low : x; } FN T at_most(T x, T high) { return x > high ? high : x; } \
  FN T max_(T a, T b) { return (a > b || a != a) ? a : b; } FN T min_(T a, T b) { return (a < b || a != a) ? a : b; }
#ifdef F32_LIMITS
F32_LIMITS
#else
LIMITS(f32)
#endif
LIMITS(f64) LIMITS(i32) LIMITS(u32)
#define CLAMP(T) FN T clamp_(T low, T x, T high) { return min_(max_(x, low), high); }
CLAMP(f32) CLAMP(f64) CLAMP(i32) CLAMP(u32)
COMMON(f32) COMMON(f64) COMMON(i32) COMMON(u32)
FN b1 select_n_(b1 which, b1 no, b1 yes) { return which ? yes : no; }
FN b1 eq_(b1 a, b1 b) { return a == b; }
FN b1 ne_(b1 a, b1 b) { return a != b; }
FN f32 div_(f32 a, f32 b) { return a / b; }
FN f64 div_(f64 a, f64 b) { return a / b; }
FN i32 div_(i32 a, i32 b) { return b == 0 ? -1 : b == -1 ? neg_(a) : a / b; }
FN u32 div_(u32 a, u32 b) { return b == 0 ? 0xffffffffu : a / b; }
FN f32 rem_(f32 a, f32 b) { return fmodf(a, b); }
FN f64 rem_(f64 a, f64 b) { return fmod(a, b); }
FN i32 rem_(i32 a, i32 b) { return b == 0 ? a : b == -1 ? 0 : a % b; }
FN u32 rem_(u32 a, u32 b) { return b == 0 ? a : a % b; }
FN f32 atan2_(f32 a, f32 b) { return atan2f(a, b); }
FN f64 atan2_(f64 a, f64 b) { return atan2(a, b); }
FN f32 pow_(f32 a, f32 b) { return powf(a, b); }
FN f64 pow_(f64 a, f64 b) { return pow(a, b); }
FN f32 nextafter_(f32 a, f32 b) { return nextafterf(a, b); }
FN f64 nextafter_(f64 a, f64 b) { return nextafter(a, b); }
template <class T> FN T integer_pow_positive(T x, int y) { T p = 1; for (; y; y >>= 1, x = x * x) if (y & 1) p = p * x; return p; }
FN f32 integer_pow(f32 x, int y) { return y < 0 ? 1.0f / integer_pow_positive(x, -y) : integer_pow_positive(x, y); }
FN i32 integer_pow(i32 x, int y) { return i32(integer_pow_positive(u32(x), y)); }
FN u32 integer_pow(u32 x, int y) { return integer_pow_positive(x, y); }
FN f64 integer_pow(f64 x, int y) { return y < 0 ? 1.0 / integer_pow_positive(x, -y) : integer_pow_positive(x, y); }

#define BITS(T) FN T and_(T a, T b) { return a & b; } FN T or_(T a, T b) { return a | b; } FN T xor_(T a, T b) { return a ^ b; }
BITS(i32) BITS(u32)
FN b1 and_(b1 a, b1 b) { return a && b; }
FN b1 or_(b1 a, b1 b) { return a || b; }
FN b1 xor_(b1 a, b1 b) { return a != b; }
FN b1 not_(b1 a) { return !a; }
FN i32 not_(i32 a) { return ~a; }
FN u32 not_(u32 a) { return ~a; }
FN u32 shift_left_(u32 a, u32 b) { return b < 32 ? a << b : 0; }
FN i32 shift_left_(i32 a, i32 b) { return u32(b) < 32 ? i32(u32(a) << b) : 0; }
FN u32 shift_right_logical_(u32 a, u32 b) { return b < 32 ? a >> b : 0; }
FN i32 shift_right_logical_(i32 a, i32 b) { return u32(b) < 32 ? i32(u32(a) >> b) : 0; }
FN i32 shift_right_arithmetic_(i32 a, i32 b) { return a >> (u32(b) < 32 ? b : 31); }
FN u32 shift_right_arithmetic_(u32 a, u32 b) { return u32(shift_right_arithmetic_(i32(a), i32(b))); }

#define CONVERT(T) FN f32 to_f32(T x) { return f32(x); } FN f64 to_f64(T x) { return f64(x); } FN b1 to_b1(T x) { return x != T(0); }
CONVERT(f32) CONVERT(f64) CONVERT(i32) CONVERT(u32) CONVERT(b1)
#define TO_INTEGER(T) FN i32 to_i32(T x) { return i32(x); } FN u32 to_u32(T x) { return u32(x); }
TO_INTEGER(i32) TO_INTEGER(u32) TO_INTEGER(b1)
// As in XLA, floats are rounded towards zero and limited to the range of the type, and NaN becomes zero.
FN i32 to_i32(f64 x) { return x != x ? 0 : x >= 2147483647.0 ? 2147483647 : x <= -2147483648.0 ? -2147483647 - 1 : i32(x); }
FN u32 to_u32(f64 x) { return x != x ? 0u : x >= 4294967295.0 ? 0xffffffffu : x <= 0.0 ? 0u : u32(x); }
FN i32 to_i32(f32 x) { return x != x ? 0 : x >= 2147483648.0f ? 2147483647 : x <= -2147483648.0f ? -2147483647 - 1 : i32(x); }
FN u32 to_u32(f32 x) { return x != x ? 0u : x >= 4294967296.0f ? 0xffffffffu : x <= 0.0f ? 0u : u32(x); }

// J. K. Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011: Threefry of two 32-bit words, 20 rounds.
template <class K, class X> FN void threefry2x32(K k0, K k1, X& x0, X& x1) {
  const int rotations[2][4] = {{13, 15, 26, 6}, {17, 29, 16, 24}};
  const K keys[3] = {k0, k1, k0 ^ k1 ^ 0x1BD11BDAu};
  x0 = x0 + keys[0];
  x1 = x1 + keys[1];
#ifdef __CUDACC_RTC__
#pragma unroll
#endif
  for (int round = 0; round < 5; ++round) {
    for (int k = 0; k < 4; ++k) {
      const int r = rotations[round & 1][k];
      x0 = x0 + x1;
      x1 = (x1 << r) | (x1 >> (32 - r));
      x1 = x1 ^ x0;
    }
    x0 = x0 + keys[(round + 1) % 3];
    x1 = x1 + keys[(round + 2) % 3] + u32(round + 1);
  }
}
