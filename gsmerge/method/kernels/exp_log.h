// Compute exp, log and similar functions, exact up to two units of the last place. They use plain arithmetic, so loops
// over them vectorise and give the same bits on every processor.
#pragma once
#include "native.h"

// e^x in float32; 0 below -104, inf above 89. With x = n ln 2 + r, the polynomial of Cephes' expf gives e^r.
static inline float exp4(float x) {
  const float magic = 12582912.f;  // 1.5 * 2^23: adding it rounds to whole numbers
  x = x < -104.f ? -104.f : x;
  x = x > 89.f ? 89.f : x;
  bits4 shifted = {.f = x * 1.44269504f + magic};
  float n = shifted.f - magic;
  float r = x - n * 0.693359375f;
  r = r + n * 2.12194440e-4f;
  float p = 1.9875691500e-4f * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = p * (r * r) + r + 1.f;
  int32_t power = (int32_t)(shifted.u - 0x4b400000u), half = power >> 1;  // for NaN this may be any number
  bits4 low = {.u = (uint32_t)(half + 127) << 23}, high = {.u = (uint32_t)(power - half + 127) << 23};
  return p * low.f * high.f;
}

// Natural logarithm in float32; -inf at 0, NaN below. Polynomial of Cephes' logf.
static inline float log4(float x) {
  bool tiny = x < 1.17549435e-38f;
  bits4 whole = {.f = tiny ? x * 8388608.f : x};
  int32_t shifted = (int32_t)(whole.u - 0x3f3504f3u);  // so that the mantissa lies between sqrt(1/2) and sqrt(2)
  float n = (float)((shifted >> 23) - (tiny ? 23 : 0));
  bits4 mantissa = {.i = (shifted & 0x7fffff) + 0x3f3504f3};
  float r = mantissa.f - 1.f, z = r * r;
  float p = 7.0376836292e-2f * r - 1.1514610310e-1f;
  p = p * r + 1.1676998740e-1f;
  p = p * r - 1.2420140846e-1f;
  p = p * r + 1.4249322787e-1f;
  p = p * r - 1.6668057665e-1f;
  p = p * r + 2.0000714765e-1f;
  p = p * r - 2.4999993993e-1f;
  p = p * r + 3.3333331174e-1f;
  p = p * r * z - 2.12194440e-4f * n - 0.5f * z;
  float result = r + p + 0.693359375f * n;
  result = x > 3.4028234e38f ? x : result;
  result = x == 0.f ? -__builtin_inff() : result;
  return x >= 0.f ? result : __builtin_nanf("");
}

// (e^r - 1 - r) / r^2 by Taylor's series up to the term r^13 / 13!, for |r| of at most ln(2) / 2.
static inline double exp_series(double r) {
  double p = 1.0 / 6227020800.0;
  p = p * r + 1.0 / 479001600.0;
  p = p * r + 1.0 / 39916800.0;
  p = p * r + 1.0 / 3628800.0;
  p = p * r + 1.0 / 362880.0;
  p = p * r + 1.0 / 40320.0;
  p = p * r + 1.0 / 5040.0;
  p = p * r + 1.0 / 720.0;
  p = p * r + 1.0 / 120.0;
  p = p * r + 1.0 / 24.0;
  p = p * r + 1.0 / 6.0;
  return p * r + 0.5;
}

// e^x in float64; 0 below -746, inf above 710.
static inline double exp8(double x) {
  const double magic = 6755399441055744.0;  // 1.5 * 2^52
  x = x < -746.0 ? -746.0 : x;
  x = x > 710.0 ? 710.0 : x;
  bits8 shifted = {.f = x * 1.4426950408889634 + magic};
  double n = shifted.f - magic;
  double r = x - n * 6.93147180369123816490e-01;
  r = r - n * 1.90821492927058770002e-10;
  double p = exp_series(r) * (r * r) + r + 1.0;
  int64_t power = (int64_t)(shifted.u - 0x4338000000000000u), half = power >> 1;
  bits8 low = {.u = (uint64_t)(half + 1023) << 52}, high = {.u = (uint64_t)(power - half + 1023) << 52};
  return p * low.f * high.f;
}

// Natural logarithm in float64; -inf at 0, NaN below. The series in s = f / (2 + f) of fdlibm.
static inline double log8(double x) {
  bool tiny = x < 2.2250738585072014e-308;
  bits8 whole = {.f = tiny ? x * 18014398509481984.0 : x};
  int64_t shifted = (int64_t)(whole.u - 0x3fe6a09e667f3bcdu);
  double n = (double)((shifted >> 52) - (tiny ? 54 : 0));
  bits8 mantissa = {.i = (shifted & 0xfffffffffffff) + 0x3fe6a09e667f3bcd};
  double f = mantissa.f - 1.0, s = f / (2.0 + f), z = s * s, w = z * z;
  double odd = w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01));
  double even = z * (6.666666666666735130e-01 + w * (2.857142874366239149e-01
      + w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01)));
  double square = 0.5 * f * f;
  double low = n * 1.90821492927058770002e-10 + s * (square + (odd + even));
  double result = n * 6.93147180369123816490e-01 - ((square - low) - f);
  result = x > 1.7976931348623157e308 ? x : result;
  result = x == 0.0 ? -__builtin_inf() : result;
  return x >= 0.0 ? result : __builtin_nan("");
}

// log(1 + x) = log(u) + (x - (u - 1)) / u with the rounded u = 1 + x: the second term corrects the rounding.
static inline double log1p8(double x) {
  double u = 1.0 + x, lost = (x - (u - 1.0)) / u;
  bool plain = u > 0.0 && u <= 1.7976931348623157e308;
  double result = log8(u) + (plain ? lost : 0.0);
  return x == 0.0 ? x : result;
}

// log Γ(x) in float64 for x of at least 0, exact up to 1e-14 near its zeros at 1 and 2. From 12 on it is Stirling's
// series. Below, Γ(x) = Γ(x + 1) / x is used.
static inline double lgamma8(double x) {
  if (!(x >= 0.0)) return __builtin_nan("");
  if (x > 1e305) return __builtin_inf();
  double product = 1.0;
  for (; x < 12.0; x += 1.0) product *= x;
  double s = 1.0 / (x * x);
  double p = 691.0 / 360360.0 - s * (1.0 / 156.0);
  p = 1.0 / 1188.0 - s * p;
  p = 1.0 / 1680.0 - s * p;
  p = 1.0 / 1260.0 - s * p;
  p = 1.0 / 360.0 - s * p;
  p = 1.0 / 12.0 - s * p;
  double stirling = (x - 0.5) * log8(x) - x + 0.91893853320467274178 + p / x;
  return product == 1.0 ? stirling : stirling - log8(product);
}

// The error function in float32: an odd polynomial below .95, above it 1 - exp(-p(|x|)); both are minimax fits.
static inline float erf4(float x) {
  float t = absf4(x), z = t * t;
  float p = -5.8621011e-4f * z + 4.9675116e-3f;
  p = p * z - 2.6748870e-2f;
  p = p * z + 1.1281321e-1f;
  p = p * z - 3.7612447e-1f;
  p = p * z + 1.2837914e-1f;
  p = p * t + t;
  float u = t < 4.f ? t : 4.f;  // from 4 on the function is 1 in float32
  float q = -1.9242520e-4f * u + 3.0085293e-3f;
  q = q * u - 2.2087612e-2f;
  q = q * u + 1.0364027e-1f;
  q = q * u + 6.3751709e-1f;
  q = q * u + 1.1274749f;
  q = q * u + 2.4472171e-4f;
  float size = t < 0.95f ? p : 1.f - exp4(-q);
  size = x == x ? size : x;
  return x < 0.f ? -size : size;
}

// The hyperbolic tangent in float32: an odd minimax polynomial below .625, above it 1 - 2 / (e^(2 |x|) + 1).
static inline float tanh4(float x) {
  float t = absf4(x), z = t * t;
  float p = -5.7049850e-3f * z + 2.0639086e-2f;
  p = p * z - 5.3739715e-2f;
  p = p * z + 1.3331442e-1f;
  p = p * z - 3.3333281e-1f;
  p = p * (z * t) + t;
  float size = t < 0.625f ? p : 1.f - 2.f / (exp4(2.f * t) + 1.f);
  size = x == x ? size : x;
  return x < 0.f ? -size : size;
}
