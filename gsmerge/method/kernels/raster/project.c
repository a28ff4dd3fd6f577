// Project Gaussians into a view: find those that it may show, their conics, and their boxes of tiles.
#include "exp_log.h"
#include "projection.h"

enum { MOST_TILES = 1 << 15 };  // most corners of tiles in a row or a column, because their numbers have 16 bits
// number of Gaussians that are gathered into planes; number that are gathered at once if they follow each other
enum { BLOCK = 64, ROW = 16 };

static inline int32_t tile(float pixel) {
  return whole(pixel, 0.f, (MOST_TILES - 1) * (float)TILE) / TILE;
}

// Planes of a block: the pixels in which a sphere may be seen, and a flag for one that may be seen at all.
enum { X0, X1, Y0, Y1, SIDES };
typedef struct {
  float side[SIDES][BLOCK];
  int32_t seen[BLOCK];
} Bounds;

static inline void bound(Bounds *b, int64_t j, Camera c, vec3 p, vec3 scale, float opacity) {
  const float reach = -2.f * LN_CUT;
  float s = maxf(maxf(scale.x, scale.y), scale.z);
  float z = dot(c.r2, p) + c.t.z, iz = 1.f / z;
  float ux = (dot(c.r0, p) + c.t.x) * iz, uy = (dot(c.r1, p) + c.t.y) * iz;
  float tx = between(ux, c.left, c.right), ty = between(uy, c.above, c.below);
  float sx = s * c.fx * iz, sy = s * c.fy * iz;
  float rx = sqrtf4(reach * (sx * sx * (1.f + tx * tx) + c.eps2d));
  float ry = sqrtf4(reach * (sy * sy * (1.f + ty * ty) + c.eps2d));
  float mx = c.fx * ux + c.cx, my = c.fy * uy + c.cy;
  b->side[X0][j] = mx - rx;
  b->side[X1][j] = mx + rx;
  b->side[Y0][j] = my - ry;
  b->side[Y1][j] = my + ry;
  bool seen = (z > c.near) & (z < c.far) & (opacity >= MIN_OPACITY) & (mx + rx > 0.f) &
              (mx - rx < c.width) & (my + ry > 0.f) & (my - ry < c.height);
  b->seen[j] = seen;
}

// Clear `seen` unless the tiles of the bounds contain a wanted tile; `wanted` counts the wanted tiles
// above and to the left of each corner.
static inline void look_up(Bounds *b, const int32_t *wanted, int32_t lines, int32_t columns) {
  int32_t corners[SIDES][BLOCK];
  for (int j = 0; j < BLOCK; j++) {
    int32_t x0 = tile(b->side[X0][j]), x1 = tile(b->side[X1][j]) + 1;
    int32_t y0 = tile(b->side[Y0][j]), y1 = tile(b->side[Y1][j]) + 1;
    corners[X0][j] = x0 < columns ? x0 : columns - 1;
    corners[X1][j] = x1 < columns ? x1 : columns - 1;
    corners[Y0][j] = y0 < lines ? y0 : lines - 1;
    corners[Y1][j] = y1 < lines ? y1 : lines - 1;
  }
  for (int j = 0; j < BLOCK; j++) {
    const int32_t *top = wanted + (int64_t)columns * corners[Y0][j];
    const int32_t *bottom = wanted + (int64_t)columns * corners[Y1][j];
    int64_t left = corners[X0][j], right = corners[X1][j];
    int64_t inside = (int64_t)bottom[right] - top[right] - bottom[left] + top[left];
    b->seen[j] &= inside > 0;
  }
}

API int64_t cull(const float *restrict means, const float *restrict scales,
                 const float *restrict opacities, const uint8_t *restrict keep,
                 const int32_t *restrict wanted, const float *restrict camera, int32_t start,
                 int32_t *restrict ids, int64_t n, int64_t lines, int64_t columns) {
  Camera c = *(const Camera *)camera;
  Bounds b = {0};
  int64_t count = 0;
  if (wanted && (lines < 1 || lines > MOST_TILES || columns < 1 || columns > MOST_TILES)) return 0;
  for (int64_t from = 0; from < n; from += BLOCK) {
    int64_t size = mini(BLOCK, n - from);
    for (int64_t j = 0; j < size; j++) {
      const float *mean = means + 3 * (from + j), *scale = scales + 3 * (from + j);
      bound(&b, j, c, (vec3){mean[0], mean[1], mean[2]}, (vec3){scale[0], scale[1], scale[2]},
            opacities[from + j]);
    }
    if (wanted) look_up(&b, wanted, (int32_t)lines, (int32_t)columns);
    for (int64_t j = 0; keep && j < size; j++) b.seen[j] &= keep[from + j] != 0;
    for (int64_t j = 0; j < size; j++) {
      ids[count] = (int32_t)((uint32_t)start + (uint32_t)(from + j));
      count += b.seen[j];
    }
  }
  return count;
}

// Planes of a block: conics, and the first and the (exclusive) last column and row of tiles.
typedef struct {
  float mean[3][BLOCK], quat[4][BLOCK], scale[3][BLOCK], opacity[BLOCK];
  float conic[CONIC][BLOCK], depth[BLOCK];
  int32_t box[4][BLOCK];
} Block;

// A conic means ln w(x, y) = lnop - (rate_x (x - mean_x - slope (y - mean_y)))^2
// - rate_y (y - mean_y)^2, which is never above 0, however thin the Gaussian.
static inline void project_one(Block *b, int64_t j, Camera c) {
  Ray ray = see(c, (vec3){b->mean[0][j], b->mean[1][j], b->mean[2][j]});
  float w = b->quat[0][j], x = b->quat[1][j], y = b->quat[2][j], z = b->quat[3][j];
  float qq = w * w + x * x + y * y + z * z;
  Rows m = rotation(w, x, y, z, qq > 1e-30f ? 2.f / qq : 0.f);
  vec3 s = cut_scales((vec3){b->scale[0][j], b->scale[1][j], b->scale[2][j]}, widest(c) * ray.at.z);
  // u and v, the rows of J W R S, are half axes
  vec3 u = product(transposed(m.m0, m.m1, m.m2, ray.a), s);
  vec3 v = product(transposed(m.m0, m.m1, m.m2, ray.b), s);
  float uu = dot(u, u), vv = dot(v, v), uv = dot(u, v);
  // |u x v|^2 = |u|^2 |v|^2 - (u.v)^2, but without cancellation, so it is positive for thin Gaussians, too
  vec3 normal = cross(u, v);
  float det0 = dot(normal, normal);
  float det = maxf(det0 + c.eps2d * (uu + vv + c.eps2d), 1e-20f);
  float cxx = uu + c.eps2d, cyy = maxf(vv + c.eps2d, 1e-10f), iy = 1.f / cyy;
  float opacity = minf(1.f, b->opacity[j]);
  float share = c.antialiased > 0.f ? sqrtf4(maxf(det0 / det, LEAST_SHARE)) : 1.f;
  float lnop = log4(opacity * share);
  float mx = c.fx * ray.ux + c.cx, my = c.fy * ray.uy + c.cy;
  // in these pixels a weight may reach 1/255
  float reach = maxf(2.f * (lnop - LN_CUT), 0.f);
  float rx = sqrtf4(reach * cxx), ry = sqrtf4(reach * cyy);
  float x0 = maxf(ceilf4(mx - rx - 0.5f), 0.f), x1 = minf(floorf4(mx + rx - 0.5f), c.width - 1.f);
  float y0 = maxf(ceilf4(my - ry - 0.5f), 0.f), y1 = minf(floorf4(my + ry - 0.5f), c.height - 1.f);
  b->conic[0][j] = mx;
  b->conic[1][j] = my;
  b->conic[2][j] = sqrtf4(0.5f * cyy / det);
  b->conic[3][j] = uv * iy;
  b->conic[4][j] = 0.5f * iy;
  b->conic[5][j] = lnop;
  b->conic[6][j] = y0;
  b->conic[7][j] = y1;
  b->depth[j] = ray.at.z;
  int32_t drawn = -((x1 >= x0) & (y1 >= y0) & (lnop >= LN_CUT));  // all bits or none
  b->box[0][j] = drawn & tile(x0);
  b->box[1][j] = drawn & (tile(x1) + 1);
  b->box[2][j] = drawn & tile(y0);
  b->box[3][j] = drawn & (tile(y1) + 1);
}

// Gather Gaussians that follow each other into the lanes from j on, in loops that vectorise.
static inline void gather_row(Block *restrict b, int64_t j, const float *restrict means, const float *restrict quats,
                              const float *restrict scales, const float *restrict opacities) {
  for (int k = 0; k < 3; k++)
    for (int i = 0; i < ROW; i++) b->mean[k][j + i] = means[3 * i + k];
  for (int k = 0; k < 4; k++)
    for (int i = 0; i < ROW; i++) b->quat[k][j + i] = quats[4 * i + k];
  for (int k = 0; k < 3; k++)
    for (int i = 0; i < ROW; i++) b->scale[k][j + i] = scales[3 * i + k];
  for (int i = 0; i < ROW; i++) b->opacity[j + i] = opacities[i];
}

API int32_t project(const float *restrict means, const float *restrict quats,
                    const float *restrict scales, const float *restrict opacities,
                    const int32_t *restrict ids, const float *restrict camera,
                    float *restrict conics, float *restrict depths, int16_t *restrict boxes,
                    int64_t n, int64_t m) {
  if (any_outside(ids, m, n)) return OUTSIDE;
  Camera c = *(const Camera *)camera;
  Block b;
  for (int64_t start = 0; start < m; start += BLOCK) {
    int64_t size = mini(BLOCK, m - start);
    for (int64_t from = 0; from < BLOCK; from += ROW) {
      int64_t first = ids[start + mini(from, size - 1)];
      bool in_row = from + ROW <= size;  // usually true, because most Gaussians of a scene are seen
      for (int64_t j = 0; in_row && j < ROW; j++) in_row = ids[start + from + j] == first + j;
      if (in_row) {
        gather_row(&b, from, means + 3 * first, quats + 4 * first, scales + 3 * first, opacities + first);
        continue;
      }
      for (int64_t j = from; j < from + ROW; j++) {
        int64_t i = ids[start + mini(j, size - 1)];
        for (int k = 0; k < 3; k++) b.mean[k][j] = means[3 * i + k];
        for (int k = 0; k < 4; k++) b.quat[k][j] = quats[4 * i + k];
        for (int k = 0; k < 3; k++) b.scale[k][j] = scales[3 * i + k];
        b.opacity[j] = opacities[i];
      }
    }
    for (int64_t j = 0; j < BLOCK; j++) project_one(&b, j, c);
    for (int64_t j = 0; j < size; j++)
      for (int k = 0; k < CONIC; k++)
        conics[CONIC * (start + j) + k] = b.conic[k][j];
    for (int64_t j = 0; j < size; j++) depths[start + j] = b.depth[j];
    for (int64_t j = 0; j < size; j++)
      for (int k = 0; k < 4; k++) boxes[4 * (start + j) + k] = (int16_t)b.box[k][j];
  }
  return 0;
}

API void shift_means(const float *restrict means, const double *restrict origin, float *restrict out, int64_t n) {
  double shift[3 * ROW];
  for (int i = 0; i < 3 * ROW; i++) shift[i] = origin[i % 3];
  int64_t i = 0;
  for (; i + 3 * ROW <= 3 * n; i += 3 * ROW)
    for (int j = 0; j < 3 * ROW; j++) out[i + j] = (float)((double)means[i + j] - shift[j]);
  for (int j = 0; i < 3 * n; i++, j++) out[i] = (float)((double)means[i] - shift[j]);
}
