// Convert Gaussians, as files store them row by row, to arrays in the convention of the package.
#include "exp_log.h"

enum { LINE = 64 };  // number of rows whose scales are computed together

// Write a quaternion with length one; return false if this is impossible. Products are separate statements, so that
// they are rounded as in NumPy.
static inline bool unit_quat(const float *q, float *out) {
  float w = q[0] * q[0], x = q[1] * q[1], y = q[2] * q[2], z = q[3] * q[3];
  float squared = ((w + x) + y) + z, inverse = 1.f / sqrtf4(squared);
  for (int c = 0; c < 4; c++) out[c] = q[c] * inverse;
  return squared > 1e-30f && squared < 1e30f;
}

API int64_t convert_rows(const float *rows, const int32_t *places, float most_position, float most_harmonic,
                         float most_log_scale, float *means, float *quats, float *scales, float *opacities, float *sh0,
                         float *shN, int64_t n, int64_t columns, int64_t used, int64_t rest) {
  if (used != 14 + rest) return 0;
  const int32_t *of_sh0 = places + 3, *of_rest = places + 6, *of_scales = of_rest + rest, *of_quats = of_scales + 3;
  for (int64_t first = 0; first < n; first += LINE) {
    int64_t size = mini(LINE, n - first);
    float logs[3 * LINE] = {0}, quat[4];
    bool plain = true;
    for (int64_t i = 0; i < size; i++) {
      const float *row = rows + (first + i) * columns;
      float *mean = means + 3 * (first + i), *color = sh0 + 3 * (first + i), *harmonics = shN + rest * (first + i);
      for (int c = 0; c < 3; c++) {
        mean[c] = row[places[c]];
        color[c] = row[of_sh0[c]];
        logs[3 * i + c] = row[of_scales[c]];
        plain &= absf4(mean[c]) <= most_position && absf4(color[c]) <= most_harmonic;
        plain &= absf4(logs[3 * i + c]) <= most_log_scale;
      }
      for (int64_t k = 0; k < rest; k++) {
        harmonics[k] = row[of_rest[k]];
        plain &= absf4(harmonics[k]) <= most_harmonic;
      }
      for (int c = 0; c < 4; c++) quat[c] = row[of_quats[c]];
      plain &= unit_quat(quat, quats + 4 * (first + i));
      opacities[first + i] = row[of_quats[4]];
      plain &= absf4(opacities[first + i]) <= 3.4028234e38f;
    }
    if (!plain) return first;
    for (int k = 0; k < 3 * LINE; k++) logs[k] = exp4(logs[k]);
    for (int64_t k = 0; k < 3 * size; k++) scales[3 * first + k] = logs[k];
  }
  return n;
}
