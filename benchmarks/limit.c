/* Counts the pairs of a pixel and a Gaussian in tile lists, and measures the highest rates of a processor.

limit.py compiles this file for the target of the kernels, with the walk.h of the checkout that is measured. Needed
pairs do not depend on the kernels. Visited pairs do, so `visit` has to change with the kernels. */
#include <math.h>
#include "walk.h"
#ifndef PARTS  // older checkouts walk eight pixels at a time on all processors
#define PARTS 2
#endif

// Counts over a list of tiles, in the order of COUNTS in limit.py: pixels, entries of tile lists, entries that were
// read before all pixels of the tile were opaque, entries that reach the tile, visited and needed pairs, and vectors of
// eight pixels, all and those with a needed pair.
typedef struct {
  int64_t pixels, listed, walked, shown, visited, needed, vectors, useful;
} Counts;

// Return how many pixels of a row blend.c and blend_backward.c work on for Gaussian j of a batch; x0 is the first one.
static int32_t lanes_of(const Batch *b, int64_t j, int32_t *x0) {
  *x0 = b->x0[j] == WIDE ? 0 : b->x0[j];
  return b->x0[j] == WIDE ? TILE : HALF;
}

// Return the number of pairs of Gaussian j of a batch that change the picture, and draw it into `light`. `bits` has a
// row of the tile in each number, with a bit for each pixel that it changes.
static int64_t need(float *light, const Batch *b, int64_t j, int32_t bits[TILE]) {
  int64_t count = 0;
  for (int32_t y = 0; y < TILE; y++) {
    float dy = (float)y - b->my[j], base = b->mx[j] + b->slope[j] * dy, top = b->lnop[j] - b->decay[j] * dy * dy;
    bits[y] = 0;
    for (int32_t x = 0; x < TILE; x++) {
      float *t = light + y * TILE + x, d = b->rate[j] * ((float)x - base), p = top - d * d;
      if (p < LN_CUT || *t <= 0.f) continue;
      float left = *t * (1.f - minf(expf(p), MAX_ALPHA));
      bool goes = left > MIN_TRANSMITTANCE;
      *t = goes ? left : -*t;
      count += goes;
      bits[y] |= goes << x;
    }
  }
  return count;
}

// Count the pairs of Gaussian j of a batch that the kernels work on, and their vectors of eight pixels.
static void visit(Counts *c, const Tile *t, const Batch *b, int64_t j, const int32_t bits[TILE]) {
  int32_t x0, lanes = lanes_of(b, j, &x0), y0 = first_row(t, b, j), y1 = last_row(t, b, j);
  int32_t extra = PARTS == 1 && y0 <= y1 && lanes == HALF && (y1 - y0) % 2 == 0;  // rows of eight come in pairs
  c->shown += y0 <= y1;
  c->visited += HALF * extra;
  c->vectors += extra;
  for (int32_t y = y0; y <= y1; y++)
    for (int32_t x = x0; x < x0 + lanes; x += HALF) {
      c->visited += HALF;
      c->vectors++;
      c->useful += (bits[y] >> x & 0xff) != 0;
    }
}

// Add the counts of tiles `first` to `last` to c; return 0, or OUTSIDE if an index is outside its array.
API int32_t count_pairs(const float *conics, const int32_t *flatten_ids, const int64_t *offsets, int64_t tile_width,
                        int64_t first, int64_t last, int64_t h, int64_t w, int64_t m, int64_t n, int64_t ends,
                        Counts *c) {
  Lists lists = {conics, flatten_ids, offsets, tile_width, m, n, ends};
  if (!lists_are_sound(&lists, first, last)) return OUTSIDE;
  float light[PLANE] __attribute__((aligned(64)));
  Batch batch;
  clear_batch(&batch);
  for (int64_t tile = first; tile < last; tile++) {
    Tile t = open_tile(light, 1, tile, tile_width, h, w);
    int64_t start = offsets[tile], end = offsets[tile + 1];
    c->pixels += t.num_x * t.num_y;
    c->listed += end - start;
    for (; start < end && t.y_low <= t.y_high; start += BATCH) {
      int64_t stop = mini(end, start + BATCH);
      if (!gather(&batch, &t, &lists, start, stop, end)) return OUTSIDE;
      c->walked += stop - start;
      for (int64_t j = 0; j < stop - start; j++) {
        int32_t bits[TILE];
        c->needed += need(light, &batch, j, bits);
        visit(c, &t, &batch, j, bits);
      }
      narrow_tile(&t, light);
    }
  }
  return 0;
}

#ifdef __AVX512F__
typedef v16f wide;
#else
typedef v8f wide;
#endif
enum { CHAINS = 12, WIDTH = sizeof(wide) / sizeof(float) };

// Compute independent chains of multiply-adds in registers of the target; return their number, one for each lane.
API int64_t add_products(int64_t rounds, float *out) {
  wide x[CHAINS], a, b;
  for (int i = 0; i < WIDTH; i++) a[i] = 0.999f + 1e-5f * out[i], b[i] = 1e-3f * out[i];
  for (int k = 0; k < CHAINS; k++) x[k] = a + (float)k;
  for (int64_t i = 0; i < rounds; i++)
    for (int k = 0; k < CHAINS; k++) x[k] = x[k] * a + b;
  for (int k = 1; k < CHAINS; k++) x[0] += x[k];
  for (int i = 0; i < WIDTH; i++) out[i] = x[0][i];
  return rounds * CHAINS * WIDTH;
}

// Compute independent chains of divisions; return their number, one for each lane.
API int64_t divide(int64_t rounds, float *out) {
  wide x[CHAINS], a;
  for (int i = 0; i < WIDTH; i++) a[i] = 1.5f + 1e-5f * out[i];
  for (int k = 0; k < CHAINS; k++) x[k] = a + (float)k;
  for (int64_t i = 0; i < rounds; i++)
    for (int k = 0; k < CHAINS; k++) x[k] = a / x[k];
  for (int k = 1; k < CHAINS; k++) x[0] += x[k];
  for (int i = 0; i < WIDTH; i++) out[i] = x[0][i];
  return rounds * CHAINS * WIDTH;
}

// Read one array and write another `rounds` times; return the bytes read and written.
API int64_t stream(const float *from, float *to, int64_t count, int64_t rounds) {
  for (int64_t i = 0; i < rounds; i++) {
    float add = (float)i;
    for (int64_t j = 0; j < count; j += LANES) store(to + j, load(from + j) + add);
  }
  return 8 * count * rounds;
}
