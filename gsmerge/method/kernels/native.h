// Definitions that all files share: vectors of sixteen floats, sums over their lanes, and clamping.
//
// Sums over lanes have a fixed order. Functions of the C library are not used, because their last bits differ.
#pragma once
#include <stdbool.h>
#include <stdint.h>

#ifdef _WIN32
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif

#define INLINE static inline __attribute__((always_inline))

enum { LANES = 16 };
enum { OUTSIDE = 1 };  // what a function returns that met an index outside its array; otherwise it returns 0
typedef float v16f __attribute__((vector_size(64), aligned(4)));
typedef float v8f __attribute__((vector_size(32), aligned(4)));
typedef float v4f __attribute__((vector_size(16), aligned(4)));
typedef float v2f __attribute__((vector_size(8), aligned(4)));
typedef int32_t v4i __attribute__((vector_size(16), aligned(4)));
typedef int32_t v8i __attribute__((vector_size(32), aligned(4)));
typedef int32_t v16i __attribute__((vector_size(64), aligned(4)));

static inline v16f splat(float x) { return x - (v16f){0}; }
static inline v8f splat8(float x) { return x - (v8f){0}; }

// a where the mask is set, b elsewhere. Masks are results of comparisons, with all bits set or none.
static inline v16f sel(v16i mask, v16f a, v16f b) {
  return (v16f)((mask & (v16i)a) | (~mask & (v16i)b));
}

static inline v8f sel8(v8i mask, v8f a, v8f b) { return (v8f)((mask & (v8i)a) | (~mask & (v8i)b)); }

static inline v16f load(const float *p) { return *(const v16f *)p; }
static inline void store(float *p, v16f v) { *(v16f *)p = v; }
static inline v8f load8(const float *p) { return *(const v8f *)p; }
static inline void store8(float *p, v8f v) { *(v8f *)p = v; }

#define PICK __builtin_shufflevector

static inline v16f join8(v8f a, v8f b) { return PICK(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15); }

// The sum of sixteen lanes: first the two halves are added, then the halves of the result, and so on.
static inline float total(v16f v) {
  v8f a = PICK(v, v, 0, 1, 2, 3, 4, 5, 6, 7) + PICK(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
  v4f b = PICK(a, a, 0, 1, 2, 3) + PICK(a, a, 4, 5, 6, 7);
  v2f c = PICK(b, b, 0, 1) + PICK(b, b, 2, 3);
  return c[0] + c[1];
}

// Add the two halves of each block of sixteen, eight or four lanes. In each block of the result, the sums of the first
// vector come before those of the second.
static inline v16f add_halves8(v16f a, v16f b) {
  return PICK(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
      + PICK(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
}
static inline v16f add_halves4(v16f a, v16f b) {
  return PICK(a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27)
      + PICK(a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
}
static inline v16f add_halves2(v16f a, v16f b) {
  return PICK(a, b, 0, 1, 4, 5, 8, 9, 12, 13, 16, 17, 20, 21, 24, 25, 28, 29)
      + PICK(a, b, 2, 3, 6, 7, 10, 11, 14, 15, 18, 19, 22, 23, 26, 27, 30, 31);
}

// The sums of the lanes of eight vectors, each in the order of total(). All vectors are halved at once.
static inline v8f totals(const v16f v[8]) {
  v16f a = add_halves4(add_halves8(v[0], v[1]), add_halves8(v[2], v[3]));
  v16f b = add_halves4(add_halves8(v[4], v[5]), add_halves8(v[6], v[7])), c = add_halves2(a, b);
  return PICK(c, c, 0, 2, 4, 6, 8, 10, 12, 14) + PICK(c, c, 1, 3, 5, 7, 9, 11, 13, 15);
}

static inline float minf(float a, float b) { return a < b ? a : b; }
static inline float maxf(float a, float b) { return a > b ? a : b; }
static inline double mind(double a, double b) { return a < b ? a : b; }
static inline double maxd(double a, double b) { return a > b ? a : b; }
static inline int64_t mini(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int64_t maxi(int64_t a, int64_t b) { return a > b ? a : b; }

// Clamp a float between two whole numbers, and return it as an integer; NaN gives the lower number.
static inline int32_t whole(float x, float low, float high) {
  x = x > low ? x : low;
  return (int32_t)(x < high ? x : high);
}

// True if one of m indices is outside an array of n.
static inline bool any_outside(const int32_t *ids, int64_t m, int64_t n) {
  uint32_t most = 0;  // as unsigned numbers negative indices are above all others
  for (int64_t i = 0; i < m; i++) most = (uint32_t)ids[i] > most ? (uint32_t)ids[i] : most;
  return m > 0 && most >= mini(n, INT64_C(1) << 31);
}

#define sqrtf4 __builtin_sqrtf
#define sqrtf8 __builtin_sqrt
#define floorf4 __builtin_floorf
#define ceilf4 __builtin_ceilf
#define absf4 __builtin_fabsf
#define absf8 __builtin_fabs

typedef union { float f; int32_t i; uint32_t u; } bits4;
typedef union { double f; int64_t i; uint64_t u; } bits8;
