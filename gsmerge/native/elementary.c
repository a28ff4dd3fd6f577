// Elementary functions of every number of an array.
#include "exp_log.h"
#include "trig.h"

API void exp_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = exp8(values[i]);
}

API void log_each(const double *restrict values, double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = log8(values[i]);
}

API void arctan2_each(const double *restrict y, const double *restrict x, double *restrict out,
                      int64_t n) {
  for (int64_t i = 0; i < n; i++) out[i] = atan28(y[i], x[i]);
}

// Bases from 0 on; x^0 = 1 for all x.
API void power_each(const double *restrict bases, const double *restrict exponents,
                    double *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) {
    double e = exponents[i], power = exp8(e * log8(bases[i]));
    out[i] = e == 0.0 ? 1.0 : power;
  }
}
