// Process sixteen pixels of a tile at a time, for the blending kernels: a row, or eight columns of a pair of rows.
//
// Processors with sixteen lanes process them in one part, others in two: the left half or the first row, and then the
// right half or the second row. Every pixel has the same bits in both cases, and so have all sums.
#pragma once
#include "native.h"

enum { TILE = 16, HALF = TILE / 2, PLANE = TILE * TILE };

#define LN_CUT -5.541263545158426f  // ln(1/255)
#define MAX_ALPHA 0.99f
#define MIN_TRANSMITTANCE 1e-4f
#define HIDDEN -1e4f  // an exponent that gives a weight of zero

#ifdef __AVX512F__
#include <immintrin.h>
#define PARTS 1
typedef v16f pixels;
typedef v16i masks;
#define JOIN(parts, name) ((parts)[0].name)
#else
#define PARTS 2
typedef v8f pixels;
typedef v8i masks;
#define JOIN(parts, name) join8((parts)[0].name, (parts)[1].name)
#endif

// The columns of the sixteen pixels of a row, and those of a pair of rows.
static const float ROW_X[TILE] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
static const float PAIR_X[TILE] = {0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7};

INLINE pixels all(float x) { return x - (pixels){0}; }
INLINE pixels pick(masks mask, pixels a, pixels b) { return (pixels)((mask & (masks)a) | (~mask & (masks)b)); }
INLINE pixels part_of(const float *sixteen, int part) { return *(const pixels *)(sixteen + HALF * part); }

// Load a part of sixteen pixels of a plane, which are eight from p on and eight from `gap` numbers later.
INLINE pixels load_part(const float *p, int64_t gap, int part) {
#if PARTS == 1
  (void)part;
  return join8(load8(p), load8(p + gap));
#else
  return load8(p + part * gap);
#endif
}

INLINE void store_part(float *p, int64_t gap, int part, pixels v) {
#if PARTS == 1
  (void)part;
  store8(p, PICK(v, v, 0, 1, 2, 3, 4, 5, 6, 7));
  store8(p + gap, PICK(v, v, 8, 9, 10, 11, 12, 13, 14, 15));
#else
  store8(p + part * gap, v);
#endif
}

// exp(p), but at most MAX_ALPHA, and 0 below LN_CUT. It is computed as poly(p)^8. The polynomial is a minimax fit of
// exp(p / 8) on [LN_CUT, 0] with a relative error of 8e-8, whose coefficients are scaled by 8^-k.
INLINE pixels alphas_at(pixels p) {
  pixels e = 0.99999992f
      + p * (0.12499907f + p * (0.0078106653f + p * (3.2416797e-4f + p * (9.7100983e-6f + p * 1.7842896e-7f))));
  e = e * e;
  e = e * e;
  e = e * e;
  return pick(p >= LN_CUT, pick(e < MAX_ALPHA, e, all(MAX_ALPHA)), all(0.f));
}
