// Cut Gaussians at the edges of photos, by computing the moments of their parts inside.
//
// The edges of a photo are the four planes through the camera and the borders of the picture, which bound the field of
// view. How deep a Gaussian lies in a photo is its least distance from these planes, in standard deviations of the
// Gaussian across each plane. It is cut in the photo in which it lies deepest. If it reaches past the nearest plane of
// this photo, the part beyond is left out (moments of a truncated normal distribution).
#include "native.h"

enum { NUM_EDGES = 4, CUTS = 2 };  // edges of a photo; most cuts of a Gaussian, because a corner has two edges
// a Gaussian ends at this many standard deviations; farther from an edge it is not cut
static const double REACH = 2.0;

typedef struct {
  double room, sigma;    // distance of the mean inside the plane, and standard deviation across the plane
  const double *normal;  // outward, of unit length
} Plane;

static inline double dot3(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Covariance R diag(s^2) R' of a Gaussian, row by row.
static inline void covariance(double *c, const float *q, const float *s) {
  double w = q[0], x = q[1], y = q[2], z = q[3], unit = 2.0 / maxd(w * w + x * x + y * y + z * z, 1e-30);
  double r[9] = {1.0 - unit * (y * y + z * z), unit * (x * y - w * z), unit * (x * z + w * y),
                 unit * (x * y + w * z), 1.0 - unit * (x * x + z * z), unit * (y * z - w * x),
                 unit * (x * z - w * y), unit * (y * z + w * x), 1.0 - unit * (x * x + y * y)};
  double v[3] = {(double)s[0] * s[0], (double)s[1] * s[1], (double)s[2] * s[2]};
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++)
      c[3 * i + j] = r[3 * i] * v[0] * r[3 * j] + r[3 * i + 1] * v[1] * r[3 * j + 1] + r[3 * i + 2] * v[2] * r[3 * j + 2];
}

// True if a ball lies wholly inside the field of view of some photo.
static inline bool is_held(const double *mean, double radius, const double *normals, const double *offsets, int64_t v) {
  for (int64_t view = 0; view < v; view++) {
    int inside = 0;
    for (int64_t p = NUM_EDGES * view; p < NUM_EDGES * (view + 1); p++)
      inside += offsets[p] - dot3(normals + 3 * p, mean) >= radius;
    if (inside == NUM_EDGES) return true;
  }
  return false;
}

// The edge nearest to a Gaussian, of the photo in which it lies deepest; of equal ones the first. _find_nearest_edges
// of gsmerge/method/fit/edges.py finds it by the same rule, for Gaussians that are split and not cut.
static inline Plane nearest_plane(const double *mean, const double *c, const double *normals, const double *offsets,
                                  int64_t v) {
  Plane deepest = {-1e300, 1.0, normals};
  for (int64_t view = 0; view < v; view++) {
    Plane nearest = {1e300, 1.0, normals};
    for (int64_t p = NUM_EDGES * view; p < NUM_EDGES * (view + 1); p++) {
      const double *n = normals + 3 * p;
      double across[3] = {dot3(c, n), dot3(c + 3, n), dot3(c + 6, n)};
      double sigma = sqrtf8(maxd(dot3(n, across), 1e-30)), room = (offsets[p] - dot3(n, mean)) / sigma;
      if (room < nearest.room) nearest = (Plane){room, sigma, n};
    }
    if (nearest.room > deepest.room) deepest = nearest;
  }
  return deepest;
}

// Density of the normal distribution divided by its distribution function, at x in [-2, 2]. Chebyshev interpolation is
// exact up to 1e-6.
static inline double hazard(double x) {
  static const double terms[] = {0.7978845608028657, -0.6366256964745176, 0.10900567804265883, 0.019158206345196927,
                                 -0.00017911589947197377, -0.0013142822301547019, -0.0003737371729142186,
                                 1.1555382477821418e-05, 3.117940604174681e-05, 3.0874227004719494e-06,
                                 -8.518021703957102e-07};
  double sum = terms[10];
  for (int i = 9; i >= 0; i--) sum = sum * x + terms[i];
  return sum;
}

// Replace mean and covariance by those of the part of the Gaussian inside a plane.
static inline void cut(double *mean, double *c, Plane plane) {
  const double *n = plane.normal;
  double across[3] = {dot3(c, n), dot3(c + 3, n), dot3(c + 6, n)}, h = hazard(plane.room);
  double loss = h * (h + plane.room) / (plane.sigma * plane.sigma);
  for (int i = 0; i < 3; i++) mean[i] -= across[i] / plane.sigma * h;
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) c[3 * i + j] -= across[i] * across[j] * loss;
}

API int32_t cut_at_edges(const float *restrict quats, const float *restrict scales, const double *restrict normals,
                         const double *restrict offsets, int64_t first, int64_t last, float *restrict means,
                         double *restrict covars, uint8_t *restrict is_cut, int64_t n, int64_t v) {
  (void)n;
  for (int64_t i = first; i < last; i++) {
    const float *s = scales + 3 * i;
    float *m = means + 3 * i;
    double mean[3] = {m[0], m[1], m[2]}, *c = covars + 9 * i;
    is_cut[i] = 0;
    if (v == 0 || is_held(mean, REACH * maxf(s[0], maxf(s[1], s[2])), normals, offsets, v)) continue;
    covariance(c, quats + 4 * i, s);
    for (int k = 0; k < CUTS; k++) {
      Plane plane = nearest_plane(mean, c, normals, offsets, v);
      if (!(plane.room < REACH && plane.room > -REACH)) break;
      cut(mean, c, plane);
      is_cut[i] = 1;
    }
    for (int k = 0; k < 3 && is_cut[i]; k++) m[k] = (float)mean[k];
  }
  return 0;
}
