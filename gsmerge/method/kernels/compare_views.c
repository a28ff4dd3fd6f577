// Compare pixels of two views: measure how well their photos agree, and find pixels that show the same surface.
//
// A product that must not be fused with a sum is a statement of its own.
#include "bilinear.h"
#include "exp_log.h"
#include "gaussians/select.h"

enum { MIN_SEEN = 50 };  // least number of pixels that two views must share
static const double SAME_DEPTH = 0.15;  // largest difference of the logarithms of two depths of one surface
// The scale of the robust weights is DOUBT times the median absolute residual, and at least MIN_DOUBT. Grey levels are
// from 0 to 1.
static const double DOUBT = 1.5, MIN_DOUBT = 0.01;
static const double CLEAR = 0.03;  // a cost grows only logarithmically with residuals above this

// point in the world; its x / z, y / z and z in a camera; its pixel
typedef struct { double world[3], x, y, z, u, v; } Place;

// Numbers of all pixels that two views share, in columns.
typedef struct { double *world[3], *x, *y, *z, *right, *down, *residual, *value; int64_t *order; } Columns;
enum { COLUMNS = 10 };

static inline double times(double a, double b, double c, double d) {
  double left = a * b, right = c * d;
  return left + right;
}

// The sum of three products, in the order of multiply_matrices; `step` is the stride of the second factor.
static inline double dot3(const double *a, const double *b, int step) {
  double sum = 0.0;
  for (int t = 0; t < 3; t++) sum += a[t] * b[t * step];
  return sum;
}

// Where the camera `to` sees a point that is given in the frame of the camera `from`.
static inline Place place_of(const double *point, const double *from, const double *to, const double *K, double near) {
  Place p;
  double away[3], camera[3];
  for (int c = 0; c < 3; c++) away[c] = point[c] - from[4 * c + 3];
  for (int c = 0; c < 3; c++) p.world[c] = dot3(away, from + c, 4);
  for (int c = 0; c < 3; c++) camera[c] = dot3(p.world, to + 4 * c, 1) + to[4 * c + 3];
  p.z = camera[2] > near ? camera[2] : near;
  p.x = camera[0] / p.z, p.y = camera[1] / p.z;
  p.u = K[0] * camera[0] / p.z + K[2], p.v = K[4] * camera[1] / p.z + K[5];
  return p;
}

// The median of n values, n > 0.
static double median_of(const double *values, int64_t *order, int64_t n) {
  for (int64_t i = 0; i < n; i++) order[i] = i;
  partition_run(values, 1, order, 0, n, n / 2);
  double upper = values[order[n / 2]], lower = values[order[0]];
  if (n % 2) return upper;
  for (int64_t i = 1; i < n / 2; i++) lower = maxd(lower, values[order[i]]);
  return (lower + upper) / 2.0;
}

// Write the normal equations for the pose of the second camera; `doubt` is the squared scale of the weights.
static void sum_normal(const Columns *s, const double *viewmat, double doubt, int64_t n, double *restrict curvature,
                       double *restrict slope) {
  for (int k = 0; k < 36; k++) curvature[k] = 0.0;
  for (int k = 0; k < 6; k++) slope[k] = 0.0;
  for (int64_t i = 0; i < n; i++) {
    double world[3] = {s->world[0][i], s->world[1][i], s->world[2][i]}, residual = s->residual[i];
    double way[3] = {s->right[i], s->down[i], -times(s->right[i], s->x[i], s->down[i], s->y[i])}, column[6];
    double square = residual * residual, weight = 1.0 / (doubt + square);
    for (int c = 0; c < 3; c++) column[3 + c] = dot3(way, viewmat + c, 4);
    for (int c = 0; c < 3; c++)
      column[c] = times(world[(c + 1) % 3], column[3 + (c + 2) % 3], -world[(c + 2) % 3], column[3 + (c + 1) % 3]);
    for (int r = 0; r < 6; r++) {
      double weighted = column[r] * weight;
      for (int c = 0; c < 6; c++) curvature[6 * r + c] += weighted * column[c];
      slope[r] += weighted * residual;
    }
  }
}

// For each pair of views from `first` to before `last`, project the pixels of the first view into the photo [h,w,3] of
// the second view, and sample its grey level and gradient there.
API int32_t compare_views(const double *points, const float *greys, const int64_t *starts, const int64_t *pairs,
                          const double *viewmats, const double *given, const double *Ks, const float *pictures,
                          const double *depths, double near, double border, double scale, int64_t first, int64_t last,
                          double *scratch, int64_t *order, double *curvatures, double *slopes, double *costs,
                          double *flows, int64_t n, int64_t p, int64_t room, int64_t ends, int64_t v, int64_t h,
                          int64_t w, int64_t columns) {
  (void)n, (void)p;
  if (ends != v + 1 || columns != COLUMNS) return OUTSIDE;
  Columns s = {.order = order};
  double **column[COLUMNS] = {s.world, s.world + 1, s.world + 2, &s.x, &s.y, &s.z,
                              &s.right, &s.down, &s.residual, &s.value};
  for (int i = 0; i < COLUMNS; i++) *column[i] = scratch + i * room;
  for (int64_t k = first; k < last; k++) {
    int64_t a = pairs[2 * k], b = pairs[2 * k + 1], begin = starts[a], end = starts[a + 1], m = 0;
    if (end - begin > room) return OUTSIDE;
    const double *K = Ks + 9 * b, *here = viewmats + 16 * a, *there = viewmats + 16 * b;
    for (int64_t i = begin; i < end; i++) {
      Place now = place_of(points + 3 * i, here, there, K, near);
      bool inside = now.z > near && now.u > border && now.u < (double)w - border && now.v > border
          && now.v < (double)h - border;
      if (!inside) continue;
      int64_t pixel = (b * h + (int64_t)now.v) * w + (int64_t)now.u;
      if (!(absf8(log8(depths[pixel] / now.z)) < SAME_DEPTH)) continue;  // also true for a depth of NaN
      Place before = place_of(points + 3 * i, given + 16 * a, given + 16 * b, K, near);
      double du = now.u - before.u, dv = now.v - before.v;
      float sample[3];
      sample_at(pictures + b * h * w * 3, (float)(now.u - 0.5), (float)(now.v - 0.5), h, w, 3, sample);
      for (int c = 0; c < 3; c++) s.world[c][m] = now.world[c];
      s.x[m] = now.x, s.y[m] = now.y, s.z[m] = now.z;
      s.right[m] = (double)sample[1] * K[0] / now.z, s.down[m] = (double)sample[2] * K[4] / now.z;
      s.residual[m] = (double)sample[0] - greys[k * room + i - begin];
      s.value[m++] = sqrtf8(times(du, du, dv, dv));
    }
    costs[k] = flows[k] = 0.0;
    if (m < MIN_SEEN) {
      for (int c = 0; c < 36; c++) curvatures[36 * k + c] = 0.0;
      for (int c = 0; c < 6; c++) slopes[6 * k + c] = 0.0;
      continue;
    }
    flows[k] = scale * median_of(s.value, order, m);
    // subtracting the median removes a difference in exposure
    double middle = median_of(s.residual, order, m), doubt, sum = 0.0;
    for (int64_t i = 0; i < m; i++) {
      s.residual[i] -= middle;
      s.value[i] = absf8(s.residual[i]);
    }
    doubt = maxd(MIN_DOUBT, DOUBT * median_of(s.value, order, m));
    sum_normal(&s, there, doubt * doubt, m, curvatures + 36 * k, slopes + 6 * k);
    for (int64_t i = 0; i < m; i++) {
      double share = s.residual[i] / CLEAR;
      s.value[i] = log1p8(share * share);
    }
    for (int64_t i = 0; i < m; i++) sum += s.value[i];
    costs[k] = sum / (double)m;
  }
  return 0;
}

// Find the pixels of a view whose surface another view shows too. Write their positions in `rows`, ascending, and the
// pixels of the other view; return their number.
API int64_t find_surfaces(const float *means, const int64_t *rows, const float *others, const uint8_t *valid,
                          const double *viewmat, const double *K, int64_t width, double near, double same,
                          int64_t *ids, int64_t *places, int64_t pixels, int64_t n, int64_t size) {
  int64_t count = 0, height = width > 0 ? size / width : 0;
  for (int64_t i = 0; i < n; i++) {
    if ((uint64_t)rows[i] >= (uint64_t)pixels) return -1;
    double point[3], camera[3], image[3];
    for (int c = 0; c < 3; c++) point[c] = means[3 * rows[i] + c];
    for (int c = 0; c < 3; c++) camera[c] = dot3(point, viewmat + 4 * c, 1) + viewmat[4 * c + 3];
    for (int c = 0; c < 3; c++) image[c] = dot3(camera, K + 3 * c, 1);
    double u = image[0] / image[2], v = image[1] / image[2];
    if (!(camera[2] > near && u >= 0.0 && u < (double)width && v >= 0.0 && v < (double)height)) continue;
    int64_t place = (int64_t)v * width + (int64_t)u;
    const float *there = others + 3 * place;
    double z = times(there[0], viewmat[8], there[1], viewmat[9]), last = there[2] * viewmat[10];
    z = z + last + viewmat[11];
    if (!valid[place] || !(absf8(log8(camera[2] / maxd(z, near))) < same)) continue;
    ids[count] = i;
    places[count++] = place;
  }
  return count;
}

// Add to `sums`, for pixels that the picture [h,w,3] of a camera shows, the difference of their colour from it, and 1.
// Points are `start` plus `depths` times `along`, whose rows are columns, rows and depths in that camera.
API int32_t add_differences(const float *picture, const double *along, const double *start, const double *depths,
                            const float *colors, const int64_t *pixels, float *sums, int64_t h, int64_t w, int64_t n,
                            int64_t height, int64_t width) {
  for (int64_t i = 0; i < n; i++) {
    if ((uint64_t)pixels[i] >= (uint64_t)(height * width)) return OUTSIDE;
    double place[3];
    for (int c = 0; c < 3; c++) {
      double way = along[c * n + i] * depths[i];
      place[c] = way + start[c];
    }
    double u = place[0] / place[2], v = place[1] / place[2];
    if (!(place[2] > 0.0 && u >= 0.0 && u < (double)w && v >= 0.0 && v < (double)h)) continue;
    const float *there = picture + 3 * ((int64_t)v * w + (int64_t)u), *here = colors + 3 * i;
    float red = absf4(there[0] - here[0]), green = absf4(there[1] - here[1]), blue = absf4(there[2] - here[2]);
    sums[2 * pixels[i]] += (red + green + blue) / 3.0f;
    sums[2 * pixels[i] + 1] += 1.0f;
  }
  return 0;
}
