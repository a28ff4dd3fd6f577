// Apply elementary functions to every number of an array.
#include "exp_log.h"
#include "trig.h"

API void exp_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = exp8(values[i]);
}

API void exp_floats(const float *restrict values, float *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = exp4(values[i]);
}

API void log_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = log8(values[i]);
}

API void log_floats(const float *restrict values, float *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = log4(values[i]);
}

API void log10_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) {
    double x = log8(values[i]);
    out[i] = x * 4.34294481903251816668e-01 + x * 1.09831965021676508e-17;  // 1 / ln 10 in two parts
  }
}

API void log1p_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = log1p8(values[i]);
}

// e^x - 1 = 2^k (e^r - 1) + (2^k - 1) with x = k ln 2 + r. Taylor's series gives e^r - 1, so no digits cancel.
static inline double expm18(double x) {
  double n = x * 1.4426950408889634;
  n = n < -60.0 ? -60.0 : n;
  n = n > 1023.0 ? 1023.0 : n;
  const double magic = 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to whole numbers
  bits8 shifted = {.f = n + magic};
  n = shifted.f - magic;
  double high = x - n * 6.93147180369123816490e-01, r = high - n * 1.90821492927058770002e-10;
  double p = exp_series(r) * (r * r) + r;
  bits8 power = {.u = (shifted.u - 0x4338000000000000u + 1023u) << 52};
  double result = p * power.f + (power.f - 1.0);
  result = x < -40.0 ? -1.0 : result;
  result = x > 709.0 ? exp8(x) : result;  // there 2^k - 1 rounds to 2^k
  return x == 0.0 ? x : result;
}

API void expm1_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = expm18(values[i]);
}

API void sin_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = sin8(values[i]);
}

API void cos_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = cos8(values[i]);
}

API void arccos_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = acos8(values[i]);
}

API void arctan2_each(const double *restrict y, const double *restrict x, double *restrict out,
                      int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = atan28(y[i], x[i]);
}

// Raise bases of at least 0 to powers. x^0 is 1 for all x, and x^1 is x without rounding.
API void power_each(const double *restrict bases, const double *restrict exponents,
                    double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) {
    double e = exponents[i], power = exp8(e * log8(bases[i]));
    power = e == 1.0 && bases[i] > 0.0 ? bases[i] : power;
    out[i] = e == 0.0 ? 1.0 : power;
  }
}
