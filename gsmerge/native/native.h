// What all files share: vectors of sixteen floats, clamping, and exp and log whose bits are the same everywhere.
//
// Sums over lanes have one written order. Functions of the C library are not used: their last bit differs.
#pragma once
#include <stdbool.h>
#include <stdint.h>

#ifdef _WIN32
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif

enum { LANES = 16 };
enum { OUTSIDE = 1 };  // status of a function that met an index outside its array; 0 otherwise
typedef float v16f __attribute__((vector_size(64), aligned(4)));
typedef int32_t v16i __attribute__((vector_size(64), aligned(4)));

static inline v16f splat(float x) { return x - (v16f){0}; }

// a where the mask is set, b elsewhere. Masks are what comparisons give: all bits or none.
static inline v16f sel(v16i mask, v16f a, v16f b) {
  return (v16f)((mask & (v16i)a) | (~mask & (v16i)b));
}

static inline v16f load(const float *p) { return *(const v16f *)p; }
static inline void store(float *p, v16f v) { *(v16f *)p = v; }

// The sum of sixteen lanes, halves first.
static inline float total(v16f v) {
  float s[8];
  for (int i = 0; i < 8; i++) s[i] = v[i] + v[i + 8];
  for (int half = 4; half; half >>= 1)
    for (int i = 0; i < half; i++) s[i] += s[i + half];
  return s[0];
}

static inline float minf(float a, float b) { return a < b ? a : b; }
static inline float maxf(float a, float b) { return a > b ? a : b; }
static inline double mind(double a, double b) { return a < b ? a : b; }
static inline double maxd(double a, double b) { return a > b ? a : b; }
static inline int64_t mini(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int64_t maxi(int64_t a, int64_t b) { return a > b ? a : b; }

// A float between two whole numbers, as an integer; NaN gives the lower one.
static inline int32_t whole(float x, float low, float high) {
  x = x > low ? x : low;
  return (int32_t)(x < high ? x : high);
}

#define sqrtf4 __builtin_sqrtf
#define sqrtf8 __builtin_sqrt
#define floorf4 __builtin_floorf
#define ceilf4 __builtin_ceilf
#define absf4 __builtin_fabsf
#define absf8 __builtin_fabs

typedef union { float f; int32_t i; uint32_t u; } bits4;
typedef union { double f; int64_t i; uint64_t u; } bits8;
