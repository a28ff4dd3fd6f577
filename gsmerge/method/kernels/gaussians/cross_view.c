// Measure how points agree with the Gaussians of other views, in each view at the one pixel to which a point projects.
#include "exp_log.h"

enum { COLUMNS = 6 };

// What points are compared with: Gaussians, the front Gaussian of each pixel, and the limits of agreement.
typedef struct {
  const int32_t *fronts;  // row of the front Gaussian of each pixel, below 0 if there is none
  const float *means, *opacities, *sh0;
  double color_scale, near, far, min_opacity;
  int64_t width, height, count;
} surface;

static inline double along(const double *row, double x, double y, double z) {
  return row[0] * x + row[1] * y + row[2] * z + row[3];
}

// Compare a point with one view at the pixel to which it projects, and add the result; false for an invalid row.
static inline bool add_view(const surface *s, const double *m, const double *K, int64_t first,
                            const double *point, const float *color, double *out) {
  double x = point[0], y = point[1], z = point[2], depth = along(m + 8, x, y, z);
  if (!(depth > 1e-9)) return true;
  double right = along(m, x, y, z), down = along(m + 4, x, y, z);
  double column = (K[0] * right + K[1] * down + K[2] * depth) / depth;
  double row = (K[4] * down + K[5] * depth) / depth;
  if (!(column >= 0.0 && column < (double)s->width && row >= 0.0 && row < (double)s->height))
    return true;
  int64_t j = s->fronts[first + (int64_t)row * s->width + (int64_t)column];
  if (j < 0) return true;
  if (j >= s->count) return false;
  double there = along(m + 8, s->means[3 * j], s->means[3 * j + 1], s->means[3 * j + 2]);
  if (!(there > 0.0 && s->opacities[j] > s->min_opacity)) return true;
  double ratio = log8(depth / there);
  out[0] += 1.0;
  if (absf8(ratio) < s->near) {
    out[1] += 1.0;
    for (int c = 0; c < 3; c++)
      out[4] += absf8(color[c] - s->color_scale * s->sh0[3 * j + c]) / 3.0;
  } else {
    out[ratio < 0.0 ? 2 : 3] += 1.0;
  }
  out[5] += mind(maxd(ratio, -s->far), s->far);
  return true;
}

API int32_t sum_cross_view(const double *restrict points, const float *restrict colors,
                           const int64_t *restrict own, const int32_t *restrict asked,
                           const double *restrict viewmats, const double *restrict Ks, int64_t width,
                           int64_t height, const int32_t *restrict fronts,
                           const float *restrict means, const float *restrict opacities,
                           const float *restrict sh0, double color_scale, double near, double far,
                           double min_opacity, int64_t first, int64_t last, double *restrict out,
                           int64_t g, int64_t views, int64_t most, int64_t n) {
  if (last > g) return OUTSIDE;
  surface s = {fronts, means, opacities, sh0, color_scale, near,
               far, min_opacity, width, height, n};
  for (int64_t start = first, stop; start < last; start = stop) {
    int64_t view = own[start], count = view < 0 ? views : most;
    for (stop = start + 1; stop < last && own[stop] == view; stop++);
    if (view >= views) return OUTSIDE;
    // views are the outer loop, because neighbouring points read neighbouring pixels
    for (int64_t q = 0; q < count; q++) {
      int64_t v = view < 0 ? q : asked[most * view + q];
      for (int64_t i = start; i < stop && v != view; i++)
        if (!add_view(&s, viewmats + 16 * v, Ks + 9 * v, v * width * height, points + 3 * i,
                      colors + 3 * i, out + COLUMNS * i))
          return OUTSIDE;
    }
  }
  return 0;
}
