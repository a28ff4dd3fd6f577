// How far points are from where cameras saw them.
#include "native.h"

// Rows of a matrix times a vector, in the order of multiply_matrices.
static inline double row_times(const double *row, const double *v) {
  double sum = 0.0;
  for (int t = 0; t < 3; t++) sum += v[t] * row[t];
  return sum;
}

API int32_t pixel_errors(const double *points, const int64_t *views, const double *viewmats, const double *Ks,
                         const double *pixels, double *errors, int64_t n, int64_t v) {
  for (int64_t i = 0; i < n; i++) {
    if ((uint64_t)views[i] >= (uint64_t)v) return OUTSIDE;
    const double *viewmat = viewmats + 16 * views[i], *K = Ks + 9 * views[i];
    double camera[3], image[3];
    for (int c = 0; c < 3; c++) camera[c] = row_times(viewmat + 4 * c, points + 3 * i) + viewmat[4 * c + 3];
    for (int c = 0; c < 3; c++) image[c] = row_times(K + 3 * c, camera);
    double x = image[0] / image[2] - pixels[2 * i], y = image[1] / image[2] - pixels[2 * i + 1];
    double xx = x * x, yy = y * y, error = sqrtf8(xx + yy);  // statements of their own are not contracted
    errors[i] = camera[2] > 0.0 && error < __builtin_inf() ? error : __builtin_inf();
  }
  return 0;
}

// Products are statements of their own, so that they are rounded one by one.
static inline double minus(double a, double b, double c, double d) {
  double left = a * b, right = c * d;
  return left - right;
}

API int32_t linearise(const double *points, const double *pixels, const double *K, const double *pose,
                      double *jacobian, double *residuals, int64_t n, int64_t rows, int64_t size) {
  int64_t free = size - 6;
  if (rows != 2 * n || free < 0 || free > 4) return OUTSIDE;
  double fx = K[0], fy = K[4], cx = K[2], cy = K[5];
  for (int64_t i = 0; i < n; i++) {
    double camera[3];
    for (int c = 0; c < 3; c++) camera[c] = row_times(pose + 4 * c, points + 3 * i) + pose[4 * c + 3];
    double inverse = 1.0 / camera[2], u = fx * (camera[0] / camera[2]), v = fy * (camera[1] / camera[2]);
    double ways[2][3] = {{fx * inverse, 0.0, -u * inverse}, {0.0, fy * inverse, -v * inverse}}, value[2] = {u, v};
    double offset[2] = {u + cx, v + cy};
    for (int axis = 0; axis < 2; axis++) {
      double *row = jacobian + (i + axis * n) * size, *way = ways[axis];
      for (int c = 0; c < 3; c++) {
        int after = (c + 1) % 3, last = (c + 2) % 3;
        row[c] = minus(camera[after], way[last], camera[last], way[after]);
        row[3 + c] = way[c];
      }
      for (int64_t k = 6; k < size; k++) row[k] = 0.0;
      if (free) row[free == 1 ? 6 : 6 + axis] = value[axis];
      if (free == 4) row[8 + axis] = 1.0;
      residuals[i + axis * n] = offset[axis] - pixels[2 * i + axis];
    }
  }
  return 0;
}
