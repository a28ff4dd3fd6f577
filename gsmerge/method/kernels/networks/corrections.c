// Apply corrections to Gaussians and to Feature Gaussians, in float64. A correction of zero changes no bit.
#include "exp_log.h"
#include "trig.h"

#define SH_C0 0.28209479177387814

enum { COLUMNS = 13, MEAN = 0, SIZE = 3, TURN = 6, LOGIT = 9, COLOR = 10 };  // columns of a correction

// Rotate a vector from the frame of a group to the world.
static inline void to_world(const float *frame, const double *v, double *out) {
  for (int i = 0; i < 3; i++) out[i] = frame[3 * i] * v[0] + frame[3 * i + 1] * v[1] + frame[3 * i + 2] * v[2];
}

// The geometric mean of the two largest of three scales.
static inline double size_of(const float *scales) {
  double a = scales[0], b = scales[1], c = scales[2];
  return sqrtf8(maxd(mind(a, b), mind(maxd(a, b), c)) * maxd(a, maxd(b, c)));
}

// Convert three columns of a correction, in units of a Gaussian's size, to a vector in the world.
static inline void shift_of(const float *residual, const float *frame, double size, double *out) {
  double local[3];
  for (int i = 0; i < 3; i++) local[i] = residual[MEAN + i] * size;
  to_world(frame, local, out);
}

static inline double length_of(const double *v) { return maxd(sqrtf8(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), 1e-12); }

static inline void multiply(double a[3][3], double b[3][3], double out[3][3]) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) out[i][j] = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
}

// The rotation matrix of a rotation vector (Rodrigues).
static inline void rotation_of(const double *v, double out[3][3]) {
  double cross[3][3] = {{0, -v[2], v[1]}, {v[2], 0, -v[0]}, {-v[1], v[0], 0}}, square[3][3];
  double angle = length_of(v);
  multiply(cross, cross, square);
  double first = sin8(angle) / angle, second = (1.0 - cos8(angle)) / (angle * angle);
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) out[i][j] = (i == j ? 1.0 : 0.0) + first * cross[i][j] + second * square[i][j];
}

// The matrix that stretches along the axes of a quaternion of any length by factors e^s.
static inline void stretch_of(const float *quat, const float *logs, double out[3][3]) {
  double q[4], norm = 0.0;
  for (int i = 0; i < 4; i++) norm += (double)quat[i] * quat[i];
  norm = maxd(sqrtf8(norm), 1e-12);
  for (int i = 0; i < 4; i++) q[i] = quat[i] / norm;
  double w = q[0], x = q[1], y = q[2], z = q[3];
  const double axes[3][3] = {
      {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)},
      {2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)},
      {2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)},
  };
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      double sum = 0.0;
      for (int k = 0; k < 3; k++) sum += axes[i][k] * (exp8(logs[k]) - 1.0) * axes[j][k];
      out[i][j] = (i == j ? 1.0 : 0.0) + sum;
    }
}

// Transform a covariance by a linear change.
static inline void change_covariance(double change[3][3], float *covar) {
  double before[3][3], half[3][3], after[3][3], turned[3][3];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      before[i][j] = covar[3 * i + j];
      turned[i][j] = change[j][i];
    }
  multiply(change, before, half);
  multiply(half, turned, after);
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) covar[3 * i + j] = (float)((after[i][j] + after[j][i]) / 2.0);
}

API void correct_features(float *restrict means, float *restrict covars, float *restrict masses,
                          float *restrict extinctions, float *restrict sh0, const float *restrict quats,
                          const float *restrict scales, const float *restrict frames, const float *restrict residuals,
                          int64_t g) {
  for (int64_t n = 0; n < g; n++) {
    const float *residual = residuals + COLUMNS * n, *frame = frames + 9 * n;
    double shift[3], local[3], turn[3], rotation[3][3], stretch[3][3], change[3][3];
    shift_of(residual, frame, size_of(scales + 3 * n), shift);
    for (int i = 0; i < 3; i++) local[i] = residual[TURN + i];
    to_world(frame, local, turn);
    rotation_of(turn, rotation);
    stretch_of(quats + 4 * n, residual + SIZE, stretch);
    multiply(rotation, stretch, change);
    change_covariance(change, covars + 9 * n);
    // change of the disc of the two larger axes
    double depth = residual[LOGIT], disc = (double)residual[SIZE + 1] + residual[SIZE + 2];
    masses[n] = (float)(masses[n] * exp8(depth + residual[SIZE] + disc));
    extinctions[n] = (float)(extinctions[n] * exp8(depth + disc));
    for (int i = 0; i < 3; i++) {
      // the shift is not finite for means near the limit of float32
      bool finite = absf8(shift[i]) <= 1.7976931348623157e308;
      means[3 * n + i] = (float)(means[3 * n + i] + (finite ? shift[i] : 0.0));
      sh0[3 * n + i] = (float)(sh0[3 * n + i] + residual[COLOR + i] / SH_C0);
    }
  }
}

API void correct_gaussians(float *restrict means, float *restrict quats, float *restrict scales,
                           float *restrict opacities, float *restrict sh0, const float *restrict residuals,
                           const float *restrict frames, const int64_t *restrict owners, int64_t n, int64_t g) {
  (void)g;
  for (int64_t p = 0; p < n; p++) {
    const float *residual = residuals + COLUMNS * p, *frame = frames + 9 * owners[p];
    double shift[3], local[3], v[3];
    shift_of(residual, frame, size_of(scales + 3 * p), shift);
    for (int i = 0; i < 3; i++) local[i] = residual[TURN + i];
    to_world(frame, local, v);
    double angle = length_of(v), sine = sin8(angle / 2.0) / angle;
    double x = sine * v[0], y = sine * v[1], z = sine * v[2], w = cos8(angle / 2.0);
    double a = quats[4 * p], b = quats[4 * p + 1], c = quats[4 * p + 2], d = quats[4 * p + 3];
    quats[4 * p] = (float)(w * a - x * b - y * c - z * d);
    quats[4 * p + 1] = (float)(w * b + x * a + y * d - z * c);
    quats[4 * p + 2] = (float)(w * c - x * d + y * a + z * b);
    quats[4 * p + 3] = (float)(w * d + x * c - y * b + z * a);
    double odds = opacities[p], factor = exp8(residual[LOGIT]);  // adds the correction to the logit
    opacities[p] = (float)mind(maxd(odds * factor / (1.0 + odds * (factor - 1.0)), 0.0), 1.0);
    for (int i = 0; i < 3; i++) {
      means[3 * p + i] = (float)(means[3 * p + i] + shift[i]);
      scales[3 * p + i] = (float)(scales[3 * p + i] * exp8(residual[SIZE + i]));
      sh0[3 * p + i] = (float)(sh0[3 * p + i] + residual[COLOR + i] / SH_C0);
    }
  }
}
