// Draw simple shapes by casting the rays of a pinhole camera, and light them with shadow maps; see cast.py.
#include "trig.h"

enum { QUAD, BOX, ELLIPSOID, CONE, LEAF, BLOB };
enum { WAVES = 4, MARCH = 24, HALVINGS = 10 };  // waves of a blob; most steps along a ray; bisections of the last step
static const double NEAR = 1e-4;  // depth below which hits do not count
static const double MISS = 1e30;

typedef struct {
  double o[3], d[3];  // origin and direction
} ray;

// One shape, with the values that all rays share.
typedef struct {
  int32_t kind;
  const double *rotation, *size, *waves;
  // origin of all rays in the shape's frame, and their directions by pixel coordinates
  double origin[3], columns[3][3];
  double reach, slope;  // upper bounds of the sum of the waves and of its slope
} shape;

typedef struct {
  double entry, exit;
} span;

static inline double power2(double x) { return x * x; }

static inline double dot3(const double *a, const double *b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Write the sine of each wave at a point times its amplitude, or its cosine if it is shifted by one quarter period.
static inline void swing(const double *waves, double x, double y, double z, int64_t quarters,
                         double *out) {
  for (int k = 0; k < WAVES; k++) {
    const double *w = waves + 5 * k;
    out[k] = w[4] * sin_shifted(w[0] * x + w[1] * y + w[2] * z + w[3], quarters);
  }
}

// Approximate distance from a blob in its own frame; 0 on its surface.
static inline double find_level(const double *waves, const ray *r, double t) {
  double x = r->o[0] + t * r->d[0], y = r->o[1] + t * r->d[1], z = r->o[2] + t * r->d[2], w[WAVES];
  swing(waves, x, y, z, 0, w);
  return sqrtf8(x * x + y * y + z * z) - 1.0 - ((w[0] + w[1]) + (w[2] + w[3]));
}

// Depths at which a ray enters and leaves the range from -h to h of one axis.
static inline span cut_slab(double o, double d, double h) {
  if (d == 0.0) return absf8(o) <= h ? (span){-MISS, MISS} : (span){MISS, -MISS};
  double a = (-h - o) / d, b = (h - o) / d;
  return a > b ? (span){b, a} : (span){a, b};
}

static inline double hit_flat(bool leaf, const double *s, const ray *r) {
  if (r->d[2] == 0.0) return MISS;
  double t = -r->o[2] / r->d[2], x = r->o[0] + t * r->d[0], y = r->o[1] + t * r->d[1];
  if (absf8(y) > s[1] || t < NEAR) return MISS;
  double width = leaf ? s[0] * (1.0 - power2(y / s[1])) : s[0];
  return absf8(x) > width ? MISS : t;
}

static inline double hit_box(const double *s, const ray *r) {
  span x = cut_slab(r->o[0], r->d[0], s[0]), y = cut_slab(r->o[1], r->d[1], s[1]);
  span z = cut_slab(r->o[2], r->d[2], s[2]);
  double near = maxd(maxd(x.entry, y.entry), z.entry), far = mind(mind(x.exit, y.exit), z.exit);
  if (near > far || far < NEAR) return MISS;
  return near >= NEAR ? near : far;
}

// Depths at which a ray enters and leaves a sphere about the origin.
static inline span cut_sphere(double radius, const ray *r) {
  double a = dot3(r->d, r->d), b = dot3(r->o, r->d), c = dot3(r->o, r->o) - radius * radius;
  double square = b * b - a * c;
  if (square <= 0.0) return (span){MISS, -MISS};
  double root = sqrtf8(square);
  return (span){(-b - root) / a, (-b + root) / a};
}

// Depth of the first hit of a tapered cylinder. x and z are in units of the radius at -y, and y in half heights.
static inline double hit_cone(const double *s, const ray *r) {
  double best = MISS, mean = 0.5 * (1.0 + s[3]), slope = 0.5 * (s[3] - 1.0);
  double ox = r->o[0], oy = r->o[1], oz = r->o[2], dx = r->d[0], dy = r->d[1], dz = r->d[2];
  double at = mean + slope * oy, rise = slope * dy, a = dx * dx + dz * dz - rise * rise;
  double b = ox * dx + oz * dz - at * rise, c = ox * ox + oz * oz - at * at, square = b * b - a * c;
  for (int sign = -1; sign <= 1 && square > 0.0 && a != 0.0; sign += 2) {
    double t = (-b + sign * sqrtf8(square)) / a, y = oy + t * dy;
    if (t >= NEAR && t < best && absf8(y) <= 1.0 && mean + slope * y >= 0.0) best = t;
  }
  for (int end = -1; end <= 1 && dy != 0.0; end += 2) {
    double t = (end - oy) / dy, x = ox + t * dx, z = oz + t * dz, radius = mean + slope * end;
    if (t >= NEAR && t < best && x * x + z * z <= radius * radius) best = t;
  }
  return best;
}

// Depth between two depths at which the level of a blob first changes its sign. Steps are so short that they hardly
// cross the surface. The level changes by at most `pace` per unit of depth.
static double march(const double *waves, double pace, double first, double last, const ray *r) {
  first = maxd(first, NEAR);
  if (!(last > first)) return MISS;
  double least = (last - first) / MARCH, t = first, level = find_level(waves, r, t);
  bool outside = level > 0.0;
  // the number of steps is bounded, because a step may round to zero
  for (int step = 0; t < last && step < 2 * MARCH; step++) {
    double before = t;
    t = mind(t + maxd(absf8(level) / pace, least), last);
    level = find_level(waves, r, t);
    if ((level > 0.0) == outside) continue;
    double low = before, high = t;
    for (int k = 0; k < HALVINGS; k++) {
      double middle = 0.5 * (low + high);
      bool same = (find_level(waves, r, middle) > 0.0) == outside;
      low = same ? middle : low;
      high = same ? high : middle;
    }
    return 0.5 * (low + high);
  }
  return MISS;
}

// Depth of the nearest hit of a ray in the shape's own frame, if it is nearer than a limit.
static inline double find_hit(const shape *s, double limit, const ray *given) {
  if (s->kind == QUAD || s->kind == LEAF) return hit_flat(s->kind == LEAF, s->size, given);
  if (s->kind == BOX) return hit_box(s->size, given);
  ray r;
  for (int k = 0; k < 3; k++) {
    r.o[k] = given->o[k] / s->size[k];
    r.d[k] = given->d[k] / s->size[k];
  }
  if (s->kind == CONE) return hit_cone(s->size, &r);
  if (s->kind == BLOB) {
    span sphere = cut_sphere(1.0 + s->reach, &r);
    double pace = (1.0 + s->slope) * sqrtf8(dot3(r.d, r.d));
    return march(s->waves, pace, sphere.entry, mind(sphere.exit, limit), &r);
  }
  span sphere = cut_sphere(1.0, &r);
  return sphere.entry >= NEAR ? sphere.entry : sphere.exit >= NEAR ? sphere.exit : MISS;
}

// Outward normal at a point in the shape's own frame, of any length.
static inline void find_normal(const shape *s, const double *p, double *n) {
  const double *h = s->size;
  double a = p[0] / h[0], b = p[1] / h[1], c = p[2] / maxd(h[2], 1e-12);
  n[0] = n[1] = n[2] = 0.0;
  if (s->kind == QUAD || s->kind == LEAF) {
    n[2] = 1.0;
  } else if (s->kind == BOX) {
    double x = absf8(a), y = absf8(b), z = absf8(c);
    if (x >= y && x >= z)
      n[0] = a;
    else if (y >= z)
      n[1] = b;
    else
      n[2] = c;
  } else if (s->kind == CONE) {
    double slope = 0.5 * (h[3] - 1.0), radius = 0.5 * (1.0 + h[3]) + slope * b;
    bool side = absf8(b) <= 1.0 - 1e-6;
    n[0] = side ? a / h[0] : 0.0;
    n[1] = side ? -radius * slope / h[1] : b;
    n[2] = side ? c / h[2] : 0.0;
  } else {
    double length = sqrtf8(a * a + b * b + c * c), w[WAVES];
    n[0] = a / length, n[1] = b / length, n[2] = c / length;
    if (s->kind == BLOB) {
      swing(s->waves, a, b, c, 1, w);
      for (int k = 0; k < WAVES; k++)
        for (int i = 0; i < 3; i++) n[i] -= w[k] * s->waves[5 * k + i];
    }
    for (int i = 0; i < 3; i++) n[i] /= h[i];
  }
}

static shape open_shape(int32_t kind, const double *rotation, const double *centre,
                        const double *size, const double *waves, const double *eye,
                        const double *axes) {
  shape s = {.kind = kind, .rotation = rotation, .size = size, .waves = waves};
  for (int i = 0; i < 3; i++) {
    s.origin[i] = 0.0;
    for (int k = 0; k < 3; k++) s.origin[i] += rotation[3 * k + i] * (eye[k] - centre[k]);
    for (int j = 0; j < 3; j++) {
      s.columns[j][i] = 0.0;
      for (int k = 0; k < 3; k++) s.columns[j][i] += rotation[3 * k + i] * axes[3 * k + j];
    }
  }
  for (int k = 0; k < WAVES; k++) {
    s.reach += absf8(waves[5 * k + 4]);
    s.slope += absf8(waves[5 * k + 4]) * sqrtf8(dot3(waves + 5 * k, waves + 5 * k));
  }
  return s;
}

// The ray of pixel row i and column j in a shape's frame, of length 1 along the camera's z.
static inline ray make_ray(const shape *s, const double *lens, double step, int64_t i, int64_t j) {
  double u = (((double)j + 0.5) * step - lens[2]) / lens[0],
         v = (((double)i + 0.5) * step - lens[3]) / lens[1];
  ray r;
  for (int k = 0; k < 3; k++) {
    r.o[k] = s->origin[k];
    r.d[k] = s->columns[0][k] * u + s->columns[1][k] * v + s->columns[2][k];
  }
  return r;
}

// Point of a hit in the shape's frame, and unit normal in the world, towards the camera.
static inline void describe_hit(const shape *s, const ray *r, double t, float *point,
                                float *normal) {
  double p[3], n[3];
  for (int k = 0; k < 3; k++) p[k] = r->o[k] + t * r->d[k];
  find_normal(s, p, n);
  double length = sqrtf8(dot3(n, n));
  length = dot3(n, r->d) > 0.0 ? -length : length;  // seen from inside or behind
  for (int k = 0; k < 3; k++) {
    point[k] = (float)p[k];
    normal[k] = (float)(dot3(s->rotation + 3 * k, n) / length);
  }
}

API int32_t cast(const double *restrict eye, const double *restrict axes,
                 const double *restrict lens, double step, const int32_t *restrict kinds,
                 const double *restrict rotations, const double *restrict centres,
                 const double *restrict sizes, const double *restrict waves,
                 const int32_t *restrict rects, double *restrict depth, int32_t *restrict ids,
                 float *restrict points, float *restrict normals, int64_t m, int64_t h, int64_t w) {
  for (int64_t pass = 0; pass < 2; pass++)  // first the depths of all shapes, then points and normals
    for (int64_t n = 0; n < m; n++) {
      const int32_t *rect = rects + 4 * n;
      if (rect[0] < 0 || rect[1] < 0 || rect[2] > w || rect[3] > h) return OUTSIDE;
      shape s = open_shape(kinds[n], rotations + 9 * n, centres + 3 * n, sizes + 4 * n,
                           waves + 5 * WAVES * n, eye, axes);
      for (int64_t i = rect[1]; i < rect[3]; i++)
        for (int64_t j = rect[0]; j < rect[2]; j++) {
          int64_t at = w * i + j;
          if (pass == 1 && ids[at] != n) continue;
          ray r = make_ray(&s, lens, step, i, j);
          if (pass == 1) {
            describe_hit(&s, &r, depth[at], points + 3 * at, normals + 3 * at);
            continue;
          }
          double t = find_hit(&s, depth[at], &r);
          ids[at] = t < depth[at] ? (int32_t)n : ids[at];
          depth[at] = t < depth[at] ? t : depth[at];
        }
    }
  return 0;
}

API void add_light(const float *restrict points, const float *restrict normals,
                   const double *restrict axes, const double *restrict centre, double radius,
                   const float *restrict maps, double bias, const double *restrict weights,
                   float *restrict out, int64_t n, int64_t k, int64_t s) {
  double half = 0.5 * (double)s, scale = half / radius;
  for (int64_t l = 0; l < k; l++) {
    const double *right = axes + 9 * l, *down = right + 3, *forward = right + 6;
    for (int64_t i = 0; i < n; i++) {
      double p[3], normal[3];
      for (int c = 0; c < 3; c++) {
        p[c] = points[3 * i + c] - centre[c];
        normal[c] = normals[3 * i + c];
      }
      double cosine = -dot3(normal, forward);
      if (cosine <= 0.0) continue;
      double u = dot3(right, p) * scale + half, v = dot3(down, p) * scale + half;
      bool inside = u >= 0.0 && u < (double)s && v >= 0.0 && v < (double)s;
      if (inside && maps[s * s * l + s * (int64_t)v + (int64_t)u] < dot3(forward, p) - bias)
        continue;
      out[i] += (float)(weights[l] * cosine);
    }
  }
}
