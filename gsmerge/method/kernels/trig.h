// Compute sines, cosines and their inverses in float64, exact up to two units of the last place. They use plain
// arithmetic, so loops over them vectorise and give the same bits on every processor.
#pragma once
#include "native.h"

// The sine of x plus `quarters` right angles, for |x| up to about 1e5. With x = n pi / 2 + r, it is a polynomial of
// fdlibm in r.
static inline double sin_shifted(double x, int64_t quarters) {
  const double magic = 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to whole numbers
  bits8 shifted = {.f = x * 0.63661977236758134308 + magic};
  double n = shifted.f - magic;
  double r = x - n * 1.57079632673412561417e+00;  // pi / 2 in three parts of 33 bits
  r = r - n * 6.07710050630396597660e-11;
  r = r - n * 2.02226624871116645580e-21;
  double z = r * r;
  double s = 1.58969099521155010221e-10 * z - 2.50507602534068634195e-08;
  s = s * z + 2.75573137070700676789e-06;
  s = s * z - 1.98412698298579493134e-04;
  s = s * z + 8.33333333332248946124e-03;
  s = s * z - 1.66666666666666324348e-01;
  s = s * (z * r) + r;
  double c = -1.13596475577881948265e-11 * z + 2.08757232129817482790e-09;
  c = c * z - 2.75573143513906633035e-07;
  c = c * z + 2.48015872894767294178e-05;
  c = c * z - 1.38888888888741095749e-03;
  c = c * z + 4.16666666666666019037e-02;
  double half = 0.5 * z, rest = 1.0 - half;
  c = rest + (((1.0 - rest) - half) + c * (z * z));
  uint64_t quarter = shifted.u + (uint64_t)quarters;
  double result = quarter & 1 ? c : s;
  return quarter & 2 ? -result : result;
}

static inline double sin8(double x) { return sin_shifted(x, 0); }
static inline double cos8(double x) { return sin_shifted(x, 1); }

// The arc cosine from -1 to 1, and NaN outside. As in fdlibm, it is a rational function of x^2, or of (1 - |x|) / 2 if
// |x| > 1/2.
static inline double acos8(double x) {
  double size = absf8(x);
  bool small = size < 0.5;
  double z = small ? x * x : 0.5 * (1.0 - size);
  double p = 3.47933107596021167570e-05 * z + 7.91534994289814532176e-04;
  p = p * z - 4.00555345006794114027e-02;
  p = p * z + 2.01212532134862925881e-01;
  p = p * z - 3.25565818622400915405e-01;
  p = p * z + 1.66666666666666657415e-01;
  double q = 7.70381505559019352791e-02 * z - 6.88283971605453293030e-01;
  q = q * z + 2.02094576023350569471e+00;
  q = q * z - 2.40339491173441421878e+00;
  q = q * z + 1.0;
  double s = small ? x : sqrtf8(z);
  double arc = s + s * (z * p / q);
  double inner = 1.57079632679489655800e+00 - (arc - 6.12323399573676603587e-17);
  double outer = x < 0.0 ? 3.14159265358979311600e+00 - (2.0 * arc - 1.22464679914735317723e-16)
                         : 2.0 * arc;
  return small ? inner : outer;
}

// The angle of the point (x, y), from -pi to pi, computed as in Cephes; 0 for the origin, NaN for NaN.
static inline double atan28(double y, double x) {
  double a = absf8(x), b = absf8(y);
  bool steep = b > a;
  double low = steep ? a : b, high = steep ? b : a;
  double t = high > 0.0 ? low / high : low + high;
  t = low == high && high > 0.0 ? 1.0 : t;  // also for inf
  bool far = t > 0.66;
  double u = far ? (t - 1.0) / (t + 1.0) : t, z = u * u;
  double p = -8.750608600031904122785e-01 * z - 1.615753718733365076637e+01;
  p = p * z - 7.500855792314704667340e+01;
  p = p * z - 1.228866684490136173410e+02;
  p = p * z - 6.485021904942025371773e+01;
  double q = z + 2.485846490142306297962e+01;
  q = q * z + 1.650270098316988542046e+02;
  q = q * z + 4.328810604912902668951e+02;
  q = q * z + 4.853903996359136964868e+02;
  q = q * z + 1.945506571482613964425e+02;
  double arc = u + u * (z * p / q);
  arc = far ? 7.85398163397448309616e-01 + (arc + 3.06161699786838301793e-17) : arc;
  arc = steep ? 1.57079632679489661923e+00 - (arc - 6.12323399573676603587e-17) : arc;
  arc = x < 0.0 ? 3.14159265358979311600e+00 - (arc - 1.22464679914735317723e-16) : arc;
  return y < 0.0 ? -arc : arc;
}
