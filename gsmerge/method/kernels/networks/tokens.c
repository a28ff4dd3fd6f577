// Compute the inputs of the networks, which are numbers without a unit in the frame of each group. They are computed in
// float64 and written as float32.
#include "exp_log.h"

#define SH_C0 0.28209479177387814
#define TINY 1e-12  // least length before a division or a logarithm, world units

enum { PART = 13, MEMBER = 19, NUMBERS = 19 };  // numbers of columns, see tokens.py

static inline double clampd(double x, double low, double high) { return mind(maxd(x, low), high); }

// Convert to a finite float32: 0 for NaN, the largest number for infinity.
static inline float finite4(double x) {
  const double most = 3.4028234663852886e38;
  return x == x ? (float)clampd(x, -most, most) : 0.f;
}

static inline double dot8(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static inline double asinh8(double x) {
  double t = absf8(x), y = log8(t + sqrtf8(t * t + 1.0));
  return x < 0.0 ? -y : y;
}

static inline double logit8(double p) {
  double inside = clampd(p, 1e-4, 1.0 - 1e-4);
  return log8(inside / (1.0 - inside));
}

static inline void normalise8(double *v) {
  double norm = maxd(sqrtf8(dot8(v, v)), 1e-12);
  for (int i = 0; i < 3; i++) v[i] = v[i] / norm;
}

// Write the frame of each group, whose columns are the picture's right and down and the ray, and the group's size,
// which is the geometric mean of its two largest scales.
API void place_frames(const float *restrict means, const float *restrict scales, const double *restrict viewmats,
                      const int64_t *restrict views, float *restrict frames, float *restrict sizes, int64_t g,
                      int64_t v) {
  (void)v;
  for (int64_t n = 0; n < g; n++) {
    const double *m = viewmats + 16 * views[n];
    double away[3], right[3], ahead[3], down[3], length = 0.0;
    for (int i = 0; i < 3; i++) {
      double centre = -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]);
      away[i] = (double)means[3 * n + i] - centre;
      length += away[i] * away[i];
    }
    bool apart = sqrtf8(length) > TINY;
    for (int i = 0; i < 3; i++) away[i] = apart ? away[i] : m[8 + i];
    normalise8(away);
    double across = dot8(m, away), along = dot8(m + 8, away);
    for (int i = 0; i < 3; i++) {
      right[i] = m[i] - across * away[i];
      ahead[i] = m[8 + i] - along * away[i];
    }
    bool level = sqrtf8(dot8(right, right)) > 1e-3;
    for (int i = 0; i < 3; i++) right[i] = level ? right[i] : ahead[i];
    normalise8(right);
    for (int i = 0; i < 3; i++) {
      int j = (i + 1) % 3, k = (i + 2) % 3;
      down[i] = away[j] * right[k] - away[k] * right[j];
    }
    for (int i = 0; i < 3; i++) {
      frames[9 * n + 3 * i] = (float)right[i];
      frames[9 * n + 3 * i + 1] = (float)down[i];
      frames[9 * n + 3 * i + 2] = (float)away[i];
    }
    double a = scales[3 * n], b = scales[3 * n + 1], c = scales[3 * n + 2];
    double most = maxd(a, maxd(b, c)), middle = maxd(mind(a, b), mind(maxd(a, b), c));
    sizes[n] = (float)maxd(sqrtf8(middle * most), TINY);
  }
}

// Write the six different entries of a covariance in a frame, in units of the group's size.
static inline void describe_covariance(const float *covar, const float *frame, double size, float *out) {
  double turned[3][3];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      turned[i][j] = 0.0;
      for (int k = 0; k < 3; k++) turned[i][j] += (double)frame[3 * k + i] * covar[3 * k + j];
    }
  int column = 0;
  for (int i = 0; i < 3; i++)
    for (int j = i; j < 3; j++) {
      double entry = 0.0;
      for (int k = 0; k < 3; k++) entry += turned[i][k] * frame[3 * k + j];
      out[column++] = finite4(asinh8(entry / (size * size)));
    }
}

API int32_t describe_groups(const float *restrict means, const float *restrict scales, const float *restrict opacities,
                            const float *restrict sh0, const float *restrict covars, const float *restrict masses,
                            const float *restrict extinctions, const float *restrict weights,
                            const int64_t *restrict counts, const float *restrict footprints,
                            const float *restrict frames, const float *restrict sizes,
                            const double *restrict viewmats, const int64_t *restrict views, float *restrict out, int64_t g, int64_t v,
                            int64_t columns) {
  (void)v;
  if (columns < NUMBERS) return OUTSIDE;
  for (int64_t n = 0; n < g; n++) {
    float *row = out + n * columns;
    double pixel = maxd(footprints[n], TINY), count = (double)counts[n];
    for (int i = 0; i < 3; i++)
      row[i] = finite4(clampd(log8(maxd(scales[3 * n + i], TINY) / pixel), -12.0, 12.0) / 4.0);
    row[3] = finite4(logit8(opacities[n]) / 3.0);
    row[4] = finite4(clampd(log8(maxd(masses[n], 1e-30) / (pixel * pixel * pixel)), -30.0, 30.0) / 10.0);
    row[5] = finite4(clampd(log8(maxd(extinctions[n], 1e-30) / (pixel * pixel)), -30.0, 30.0) / 10.0);
    row[6] = finite4(log8(count) / 4.0);
    row[7] = finite4((double)weights[n] / count);
    for (int i = 0; i < 3; i++) row[8 + i] = finite4(SH_C0 * sh0[3 * n + i]);
    describe_covariance(covars + 9 * n, frames + 9 * n, sizes[n], row + 11);
    const double *m = viewmats + 16 * views[n];
    double place[3];
    for (int i = 0; i < 3; i++) {
      double point[3] = {means[3 * n], means[3 * n + 1], means[3 * n + 2]};
      place[i] = dot8(m + 4 * i, point) + m[4 * i + 3];
    }
    for (int i = 0; i < 2; i++) row[17 + i] = finite4(clampd(place[i] / maxd(place[2], 1e-6), -3.0, 3.0));
  }
  return 0;
}

// Write the axis of the smallest scale, in the world. The quaternion may have any length.
static inline void normal_of(const float *quat, const float *scales, double *normal) {
  double q[4], norm = 0.0;
  for (int i = 0; i < 4; i++) norm += (double)quat[i] * quat[i];
  norm = maxd(sqrtf8(norm), 1e-12);
  for (int i = 0; i < 4; i++) q[i] = quat[i] / norm;
  double w = q[0], x = q[1], y = q[2], z = q[3];
  int least = scales[1] < scales[0] ? 1 : 0;
  least = scales[2] < scales[least] ? 2 : least;
  const double axes[3][3] = {
      {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)},
      {2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)},
      {2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)},
  };
  for (int i = 0; i < 3; i++) normal[i] = axes[least][i];
}

API int32_t describe_parts(const float *restrict means, const float *restrict quats, const float *restrict scales,
                           const float *restrict opacities, const float *restrict sh0,
                           const float *restrict group_means, const float *restrict group_sh0,
                           const float *restrict frames, const float *restrict sizes,
                           const float *restrict footprints, const int64_t *restrict ids,
                           const int64_t *restrict owners, int64_t members, float *restrict out, int64_t parts,
                           int64_t g, int64_t n, int64_t columns) {
  (void)parts, (void)g;
  if (columns < (members ? MEMBER : PART)) return OUTSIDE;
  for (int64_t t = 0; t < n; t++) {
    int64_t p = ids[t], o = owners[t];
    const float *frame = frames + 9 * o;
    float *row = out + t * columns;
    double size = sizes[o], pixel = maxd(footprints[o], TINY), offset[3], normal[3], local[3], facing[3];
    for (int i = 0; i < 3; i++) offset[i] = (double)means[3 * p + i] - group_means[3 * o + i];
    normal_of(quats + 4 * p, scales + 3 * p, normal);
    for (int i = 0; i < 3; i++) {
      double axis[3] = {frame[i], frame[3 + i], frame[6 + i]};
      local[i] = dot8(axis, offset);
      facing[i] = dot8(axis, normal);
    }
    double a = scales[3 * p], b = scales[3 * p + 1], c = scales[3 * p + 2];
    double sorted[3] = {mind(a, mind(b, c)), maxd(mind(a, b), mind(maxd(a, b), c)), maxd(a, maxd(b, c))};
    for (int i = 0; i < 3; i++) {
      sorted[i] = maxd(sorted[i], TINY);
      row[i] = finite4(asinh8(local[i] / size));
      row[3 + i] = finite4(clampd(log8(sorted[i] / pixel), -12.0, 12.0) / 4.0);
    }
    row[6] = finite4(logit8(opacities[p]) / 3.0);
    // The normal points towards the camera. A round Gaussian gets none, because rounding would choose it
    double flat = (1.0 - sorted[0] / sorted[1]) * (facing[2] > 0.0 ? -1.0 : facing[2] < 0.0 ? 1.0 : 0.0);
    for (int i = 0; i < 3; i++) {
      row[7 + i] = finite4(SH_C0 * ((double)sh0[3 * p + i] - group_sh0[3 * o + i]));
      row[10 + i] = finite4(flat * facing[i]);
    }
    for (int i = 0; members && i < 3; i++) {
      row[PART + i] = finite4(asinh8(local[i] / pixel));
      row[PART + 3 + i] = finite4(SH_C0 * sh0[3 * p + i]);
    }
  }
  return 0;
}
