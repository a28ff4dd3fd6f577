// Run the backward pass of projection: compute gradients of means, rotations, scales and opacities from sums over an
// image.
#include "projection.h"

enum { BLOCK = 128, POSE = 12, SUMS = 9 };

// Planes of a block. The inputs are mean, quaternion, scales, opacity, and six of the sums over the image (1, x, y, xx,
// xy, yy). The outputs are gradients of these parameters and of the pose of the camera.
typedef struct {
  float mean[3][BLOCK], quat[4][BLOCK], scale[3][BLOCK], sum[6][BLOCK], opacity[BLOCK];
  float grad_mean[3][BLOCK], grad_quat[4][BLOCK], grad_scale[3][BLOCK], grad_opacity[BLOCK];
  float pose[POSE][BLOCK];
} Block;

static inline void put(float (*planes)[BLOCK], int64_t j, vec3 v) {
  planes[0][j] = v.x;
  planes[1][j] = v.y;
  planes[2][j] = v.z;
}

static inline vec3 get(float (*planes)[BLOCK], int64_t j) {
  return (vec3){planes[0][j], planes[1][j], planes[2][j]};
}

typedef struct {
  float a, b, c, gxx, gxy, gyy;
} Conic;

// Compute the conic A, B, C, of the exponent -1/2 (A xx + 2 B xy + C yy), and the gradient of the covariance.
// With the conic Q and half the second moments M, the gradient is Q M Q. In antialiased mode the
// dilation lowers the opacity, which adds s (inv(S) - Q), with s = thinning and the covariance S
// before the dilation.
static inline Conic conic_backward(vec3 u, vec3 v, float eps2d, float sxx, float sxy, float syy,
                                   float thinning) {
  float uu = dot(u, u), vv = dot(v, v), uv = dot(u, v);
  vec3 normal = cross(u, v);
  float det0 = dot(normal, normal);  // as in the forward pass
  float det = maxf(det0 + eps2d * (uu + vv + eps2d), 1e-20f);
  float scale = 1.f / det, scale0 = 1.f / (det0 > 1e-30f ? det0 : 1.f);
  float a = (vv + eps2d) * scale, b = -uv * scale, c = (uu + eps2d) * scale;
  float s = det0 > LEAST_SHARE * det ? thinning : 0.f;
  float e00 = a * sxx + b * sxy, e01 = a * sxy + b * syy;
  float e10 = b * sxx + c * sxy, e11 = b * sxy + c * syy;
  return (Conic){a,
                 b,
                 c,
                 e00 * a + e01 * b + s * (vv * scale0 - a),
                 e00 * b + e01 * c - s * (uv * scale0 + b),
                 e10 * b + e11 * c + s * (uu * scale0 - c)};
}

// Write the gradient of a quaternion q, divided by h, from the gradients gc of a M and gd of b M. M is the matrix of q.
// Only the part perpendicular to q counts.
static inline void rotation_backward(Block *block, int64_t j, float w, float x, float y, float z,
                                     float h, Ray ray, vec3 gc, vec3 gd) {
  vec3 g0 = mix(ray.a.x, gc, ray.b.x, gd);
  vec3 g1 = mix(ray.a.y, gc, ray.b.y, gd);
  vec3 g2 = mix(ray.a.z, gc, ray.b.z, gd);
  float yz = g2.y - g1.z, xz = g0.z - g2.x, xy = g1.x - g0.y;
  float sum_xy = g0.y + g1.x, sum_xz = g0.z + g2.x, sum_yz = g1.z + g2.y;
  float gw = x * yz + y * xz + z * xy;
  float gx = w * yz + y * sum_xy + z * sum_xz - 2.f * x * (g1.y + g2.z);
  float gy = w * xz + x * sum_xy + z * sum_yz - 2.f * y * (g0.x + g2.z);
  float gz = w * xy + x * sum_xz + y * sum_yz - 2.f * z * (g0.x + g1.y);
  float along = gw * w + gx * x + gy * y + gz * z;
  block->grad_quat[0][j] = h * (gw - along * w);
  block->grad_quat[1][j] = h * (gx - along * x);
  block->grad_quat[2][j] = h * (gy - along * y);
  block->grad_quat[3][j] = h * (gz - along * z);
}

// Write the gradient of the mean that comes through its image position, and through J W from the gradients ga, gb of
// its rows.
static inline void position_backward(Block *block, int64_t j, Camera c, Ray ray, vec3 p, vec3 ga,
                                     vec3 gb, Conic conic) {
  float sx = block->sum[1][j], sy = block->sum[2][j];
  float kxz = dot(ga, c.r2), kyz = dot(gb, c.r2);
  float gux = c.fx * (conic.a * sx + conic.b * sy) - (ray.ux == ray.tx ? ray.jx * kxz : 0.f);
  float guy = c.fy * (conic.b * sx + conic.c * sy) - (ray.uy == ray.ty ? ray.jy * kyz : 0.f);
  float giz = c.fx * (dot(ga, c.r0) - ray.tx * kxz) + c.fy * (dot(gb, c.r1) - ray.ty * kyz) +
              gux * ray.at.x + guy * ray.at.y;
  vec3 g = {gux * ray.iz, guy * ray.iz, -ray.iz * ray.iz * giz};
  put(block->grad_mean, j, transposed(c.r0, c.r1, c.r2, g));
  put(block->pose, j, mix(g.x, p, ray.jx, ga));
  put(block->pose + 3, j, mix(g.y, p, ray.jy, gb));
  put(block->pose + 6, j, mix(g.z, p, 1.f, mix(ray.jxz, ga, ray.jyz, gb)));
  put(block->pose + 9, j, g);
}

static inline void backward_one(Block *block, int64_t j, Camera c) {
  vec3 p = get(block->mean, j), scale = get(block->scale, j);
  Ray ray = see(c, p);
  float w = block->quat[0][j], x = block->quat[1][j], y = block->quat[2][j], z = block->quat[3][j];
  float qq = w * w + x * x + y * y + z * z;
  bool turned = qq > 1e-30f;
  float h = turned ? 2.f : 0.f, qn = 1.f / sqrtf4(turned ? qq : 1.f);
  w *= qn, x *= qn, y *= qn, z *= qn;
  Rows m = rotation(w, x, y, z, h);
  float wide = widest(c) * ray.at.z;
  vec3 s = cut_scales(scale, wide);
  // u and v are half axes, and c and d the same without scales
  vec3 across = transposed(m.m0, m.m1, m.m2, ray.a), down = transposed(m.m0, m.m1, m.m2, ray.b);
  vec3 u = product(across, s), v = product(down, s);
  float weight = block->sum[0][j], thinning = 0.5f * c.antialiased * weight;
  Conic conic = conic_backward(u, v, c.eps2d, 0.5f * block->sum[3][j], 0.5f * block->sum[4][j],
                               0.5f * block->sum[5][j], thinning);
  vec3 gu = mix(2.f * conic.gxx, u, 2.f * conic.gxy, v);
  vec3 gv = mix(2.f * conic.gxy, u, 2.f * conic.gyy, v);
  block->grad_scale[0][j] = scale.x < wide ? gu.x * across.x + gv.x * down.x : 0.f;
  block->grad_scale[1][j] = scale.y < wide ? gu.y * across.y + gv.y * down.y : 0.f;
  block->grad_scale[2][j] = scale.z < wide ? gu.z * across.z + gv.z * down.z : 0.f;
  vec3 gc = product(gu, s), gd = product(gv, s);
  rotation_backward(block, j, w, x, y, z, h * qn, ray, gc, gd);
  vec3 ga = {dot(m.m0, gc), dot(m.m1, gc), dot(m.m2, gc)};
  vec3 gb = {dot(m.m0, gd), dot(m.m1, gd), dot(m.m2, gd)};
  position_backward(block, j, c, ray, p, ga, gb, conic);
  float opacity = block->opacity[j];
  block->grad_opacity[j] = opacity <= 1.f ? weight / opacity : 0.f;
}

// Gather the inputs of a block. Lanes past its size repeat the last Gaussian.
static inline void gather(Block *b, const float *means, const float *quats, const float *scales,
                          const float *opacities, const int32_t *ids, const float *sums,
                          int64_t size) {
  for (int64_t j = 0; j < BLOCK; j++) {
    int64_t k = mini(j, size - 1), i = ids[k];
    for (int q = 0; q < 3; q++) b->mean[q][j] = means[3 * i + q];
    for (int q = 0; q < 4; q++) b->quat[q][j] = quats[4 * i + q];
    for (int q = 0; q < 3; q++) b->scale[q][j] = scales[3 * i + q];
    for (int q = 0; q < 6; q++) b->sum[q][j] = sums[SUMS * k + 3 + q];
    b->opacity[j] = opacities[i];
  }
}

// Write the sum of the gradients of the pose over a block, lane by lane.
static inline void sum_pose(Block *b, int64_t size, float *pose) {
  for (int q = 0; q < POSE; q++) {
    for (int64_t j = size; j < BLOCK; j++) b->pose[q][j] = 0.f;
    v16f sum = load(b->pose[q]);
    for (int64_t j = LANES; j < BLOCK; j += LANES) sum += load(b->pose[q] + j);
    pose[q] = total(sum);
  }
}

API int32_t project_backward(const float *restrict means, const float *restrict quats,
                             const float *restrict scales, const float *restrict opacities,
                             const int32_t *restrict ids, const float *restrict sums,
                             const float *restrict camera, int64_t first, int64_t last,
                             float *restrict grad_means, float *restrict grad_quats,
                             float *restrict grad_scales, float *restrict grad_opacities,
                             float *restrict grad_poses, int64_t n, int64_t m, int64_t blocks) {
  if (any_outside(ids + first, last - first, n) || first % BLOCK) return OUTSIDE;
  if (grad_poses && blocks * BLOCK < last) return OUTSIDE;
  (void)m;
  Camera c = *(const Camera *)camera;
  Block b;
  for (int64_t start = first; start < last; start += BLOCK) {
    int64_t size = mini(BLOCK, last - start);
    gather(&b, means, quats, scales, opacities, ids + start, sums + SUMS * start, size);
    for (int64_t j = 0; j < BLOCK; j++) backward_one(&b, j, c);
    for (int64_t j = 0; j < size; j++) {
      int64_t k = start + j;
      for (int q = 0; q < 3; q++) grad_means[3 * k + q] = b.grad_mean[q][j];
      for (int q = 0; q < 4; q++) grad_quats[4 * k + q] = b.grad_quat[q][j];
      for (int q = 0; q < 3; q++) grad_scales[3 * k + q] = b.grad_scale[q][j];
      grad_opacities[k] = b.grad_opacity[j];
    }
    if (grad_poses) sum_pose(&b, size, grad_poses + POSE * (start / BLOCK));
  }
  return 0;
}

API int32_t add_rows(const int32_t *restrict ids, const float *restrict rows,
                     float *restrict totals, int64_t m, int64_t c, int64_t n) {
  for (int64_t i = 0; i < m; i++) {
    if ((uint64_t)ids[i] >= (uint64_t)n) return OUTSIDE;
    const float *row = rows + c * i;
    float *sums = totals + c * ids[i];
    for (int64_t k = 0; k < c; k++) sums[k] += row[k];
  }
  return 0;
}
