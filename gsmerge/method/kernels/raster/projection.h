// Definitions that projection and its backward pass share.
#pragma once
#include "native.h"

enum { CONIC = 8, TILE = 16 };
static const float LN_CUT = -5.541263545158426f;  // ln(1/255): smaller weights are not drawn
static const float MIN_OPACITY = 1.f / 255.f;
static const float MAX_SIGMA = 1e6f;  // in pixels; wider conics look flat, and squares of this number do not overflow
static const float LEAST_SHARE = 0.005f * 0.005f;  // least share of the density that remains after dilation

typedef struct {
  float x, y, z;
} vec3;

// A camera's numbers, in the order of kernels/raster/project.py.
typedef struct {
  vec3 r0, r1, r2, t;  // rows of the rotation from world to camera, shift
  float fx, fy, cx, cy, width, height, near, far, eps2d;
  float right, left, below, above;  // limits of x / z and y / z, beyond which the EWA projection is too inexact
  float antialiased;
} Camera;
_Static_assert(sizeof(Camera) == 26 * sizeof(float), "as many as in project.py");

static inline float dot(vec3 u, vec3 v) { return u.x * v.x + u.y * v.y + u.z * v.z; }

// x u + y v
static inline vec3 mix(float x, vec3 u, float y, vec3 v) {
  return (vec3){x * u.x + y * v.x, x * u.y + y * v.y, x * u.z + y * v.z};
}

static inline vec3 cross(vec3 u, vec3 v) {
  return (vec3){u.y * v.z - u.z * v.y, u.z * v.x - u.x * v.z, u.x * v.y - u.y * v.x};
}

static inline vec3 product(vec3 u, vec3 v) { return (vec3){u.x * v.x, u.y * v.y, u.z * v.z}; }

// The product of the transpose of rows m0, m1, m2 and u.
static inline vec3 transposed(vec3 m0, vec3 m1, vec3 m2, vec3 u) {
  return (vec3){m0.x * u.x + m1.x * u.y + m2.x * u.z, m0.y * u.x + m1.y * u.y + m2.y * u.z,
                m0.z * u.x + m1.z * u.y + m2.z * u.z};
}

static inline float between(float value, float low, float high) {
  value = value < high ? value : high;
  return value > low ? value : low;
}

// The largest scale. At depth 1 it has MAX_SIGMA pixels.
static inline float widest(Camera c) { return MAX_SIGMA / maxf(c.fx, c.fy); }
static inline vec3 cut_scales(vec3 s, float wide) {
  return (vec3){minf(s.x, wide), minf(s.y, wide), minf(s.z, wide)};
}

// A mean in the camera, and the derivative J W of the projection there.
typedef struct {
  vec3 at;  // in the camera's axes
  float iz, ux, uy;  // 1 / z, x / z, y / z
  float tx, ty;  // x / z and y / z, clamped near the image
  float jx, jy, jxz, jyz;
  vec3 a, b;  // rows of J W
} Ray;

static inline Ray see(Camera c, vec3 p) {
  Ray r;
  r.at = (vec3){dot(c.r0, p) + c.t.x, dot(c.r1, p) + c.t.y, dot(c.r2, p) + c.t.z};
  r.iz = 1.f / r.at.z;
  r.ux = r.at.x * r.iz;
  r.uy = r.at.y * r.iz;
  r.tx = between(r.ux, c.left, c.right);
  r.ty = between(r.uy, c.above, c.below);
  r.jx = c.fx * r.iz;
  r.jy = c.fy * r.iz;
  r.jxz = -r.jx * r.tx;
  r.jyz = -r.jy * r.ty;
  r.a = mix(r.jx, c.r0, r.jxz, c.r2);
  r.b = mix(r.jy, c.r1, r.jyz, c.r2);
  return r;
}

typedef struct {
  vec3 m0, m1, m2;
} Rows;

// Rows of the rotation matrix of a quaternion, with h = 2 / |q|^2, or h = 0 for no rotation.
static inline Rows rotation(float w, float x, float y, float z, float h) {
  return (Rows){
      {1.f - h * (y * y + z * z), h * (x * y - w * z), h * (x * z + w * y)},
      {h * (x * y + w * z), 1.f - h * (x * x + z * z), h * (y * z - w * x)},
      {h * (x * z - w * y), h * (y * z + w * x), 1.f - h * (x * x + y * y)},
  };
}
