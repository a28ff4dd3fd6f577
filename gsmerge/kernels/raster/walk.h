// Shared by the blending kernels: evaluate a Gaussian of a batch over the rows of a tile, eight pixels at a time.
//
// The state of a tile consists of planes of 16 x 16 floats. The weights are gsplat's: alpha is clamped at 0.99 and cut
// below 1/255, and a pixel stops before the Gaussian that would lower its transmittance to 1e-4 or below. Plane 0 of
// the state is the transmittance; its sign bit marks pixels that have stopped.
#pragma once
#include "native.h"

enum { TILE = 16, HALF = TILE / 2, PLANE = TILE * TILE, BATCH = 32, CONIC = 8, SPLAT_COLORS = 3, WIDE = -1 };

#define LN_CUT -5.541263545158426f  // ln(1/255)
#define MAX_ALPHA 0.99f
#define MIN_TRANSMITTANCE 1e-4f
#define HIDDEN -1e4f  // an exponent with a weight of zero
#define SPARE 0.02f  // tolerance for rounding, in rows and columns, around a Gaussian

static const v16f COLUMNS = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
static const v16f PAIR_COLUMNS = {0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7};  // of two rows of half a tile
static const v8f EIGHT = {0, 1, 2, 3, 4, 5, 6, 7};

// Gaussians relative to the tile's first pixel centre: ln w = lnop - (rate (x - mx - slope (y - my)))^2 - decay (y - my)^2.
typedef struct {
  float mx[BATCH], my[BATCH], rate[BATCH], slope[BATCH], decay[BATCH], lnop[BATCH], first[BATCH], last[BATCH];
  float red[BATCH], green[BATCH], blue[BATCH];
  int32_t y0[BATCH], y1[BATCH];  // rows of the tile in which each shows
  int32_t x0[BATCH];  // first of the eight columns in which each shows; WIDE if it shows in more columns
} Batch;

// Share of a Gaussian in eight pixels of a row.
typedef struct {
  v8f alpha, weight;  // weight: alpha times the transmittance, 0 if the pixel stops
  v8f left;           // transmittance behind the Gaussian; negative if the pixel has stopped
  v8i unclamped, goes;  // masks: alpha is below 0.99; the pixel does not stop here or before
} Share;

// The tile on which a kernel works.
typedef struct {
  int64_t left, top;
  int32_t num_x, num_y;  // columns and rows inside the image
  int32_t y_low, y_high;  // rows with pixels that have not stopped
} Tile;

// exp(p) = poly(p)^8 on [ln(1/255), 0]: a minimax polynomial with a relative error of 8e-8 for exp(p / 8), whose
// coefficients are scaled by 8^-k.
static inline v8f alphas_at(v8f p) {
  v8f e = 0.99999992f
      + p * (0.12499907f + p * (0.0078106653f + p * (3.2416797e-4f + p * (9.7100983e-6f + p * 1.7842896e-7f))));
  e = e * e;
  e = e * e;
  e = e * e;
  return sel8(p >= LN_CUT, sel8(e < MAX_ALPHA, e, splat8(MAX_ALPHA)), splat8(0.f));
}

static inline Share take_share(v8f t, v8f alpha) {
  Share s = {alpha, alpha * t, t, alpha < MAX_ALPHA, {0}};
  s.left = t - s.weight;
  s.goes = s.left > MIN_TRANSMITTANCE;
  s.weight = sel8(s.goes, s.weight, splat8(0.f));
  s.left = sel8(s.goes, s.left, (v8f)((v8i)t | INT32_MIN));
  return s;
}

// The exponents of Gaussian j of a batch: top - (rate x - base)^2 in each row of the tile, never positive beyond lnop.
typedef struct { float base[TILE], top[TILE], rate; } Curve;

static inline void trace(Curve *c, const Batch *b, int64_t j) {
  v16f dy = COLUMNS - b->my[j];
  store(c->base, b->rate[j] * (b->mx[j] + b->slope[j] * dy));
  store(c->top, b->lnop[j] - b->decay[j] * dy * dy);
  c->rate = b->rate[j];
}

// Alphas of rows y0 to y1 over the eight columns from x on.
static inline void fill_alphas(v8f *alphas, const Curve *c, int32_t x, int32_t y0, int32_t y1) {
  v8f across = c->rate * (EIGHT + (float)x);
  for (int32_t y = y0; y <= y1; y++) {
    v8f d = across - c->base[y];
    alphas[y] = alphas_at(c->top[y] - d * d);
  }
}

static inline float clamp_column(float x) {
  x = x < (float)(TILE - 1) ? x : (float)(TILE - 1);
  return x > 0.f ? x : 0.f;
}

// Narrow the rows of a batch to those where a column of the tile reaches the cut, and find the columns where a row does.
//
// With q the ln opacity above the cut, a Gaussian shows where decay y^2 + rate^2 (x - slope y)^2 <= q. The highest point
// of this ellipse lies at y = sqrt(q / decay); where that is outside the tile, the ellipse is highest at the tile's
// column next to it. It reaches sqrt(q (1 / rate^2 + slope^2 / decay)) to the sides.
static inline void narrow_rows(Batch *b) {
  for (int i = 0; i < BATCH; i++) {
    float mx = b->mx[i], my = b->my[i], slope = b->slope[i], decay = b->decay[i], squared = b->rate[i] * b->rate[i];
    float q = maxf(b->lnop[i] - LN_CUT, 0.f), a = decay + squared * slope * slope, reach = sqrtf4(q / decay);
    float spare = SPARE + 1e-5f * reach;
    float right = clamp_column(mx + slope * reach) - mx, left = clamp_column(mx - slope * reach) - mx;
    float high = 1.00001f * a * q - decay * squared * right * right;
    float low = 1.00001f * a * q - decay * squared * left * left;
    float last = my + (squared * slope * right + sqrtf4(maxf(high, 0.f))) / a + spare;
    float first = my + (squared * slope * left - sqrtf4(maxf(low, 0.f))) / a - spare;
    last = high < 0.f || low < 0.f ? -1.f : floorf4(last);
    first = ceilf4(first);
    first = first > b->first[i] ? first : b->first[i];
    last = last < b->last[i] ? last : b->last[i];
    b->y0[i] = whole(first, 0.f, (float)TILE);
    b->y1[i] = whole(last, -1.f, (float)(TILE - 1));
    float side = 1.00001f * sqrtf4(q / squared + slope * slope * reach * reach) + SPARE;
    float column = maxf(ceilf4(mx - side), 0.f);
    bool narrow = column >= (float)HALF || mx + side < column + (float)HALF;
    b->x0[i] = whole(narrow ? column : (float)WIDE, (float)WIDE, (float)HALF);
  }
}

// Make a batch of Gaussians without effect, since unused lanes are computed, too.
static inline void clear_batch(Batch *b) {
  float *numbers = b->mx;
  for (int i = 0; i < 11 * BATCH; i++) numbers[i] = 1.f;
}

// The lists of all tiles: rows of conics, tile after tile.
typedef struct {
  const float *conics;
  const int32_t *flatten_ids;
  const int64_t *isect_offsets;
  int64_t tile_width, m, n, ends;  // tiles per row; lengths of conics, flatten_ids and isect_offsets
} Lists;

// True if the range of tiles exists and its lists lie within flatten_ids.
static inline bool lists_are_sound(const Lists *l, int64_t first, int64_t last) {
  if (l->tile_width < 1 || first < 0 || last >= l->ends) return false;
  for (int64_t tile = first; tile < last; tile++) {
    int64_t start = l->isect_offsets[tile], end = l->isect_offsets[tile + 1];
    if (start < 0 || start > end || end > l->n) return false;
  }
  return true;
}

// Transpose eight rows.
static inline void transpose8(v8f r[8]) {
  v8f a[8], b[8];
  for (int k = 0; k < 8; k += 2) {
    a[k] = PICK(r[k], r[k + 1], 0, 8, 1, 9, 4, 12, 5, 13);
    a[k + 1] = PICK(r[k], r[k + 1], 2, 10, 3, 11, 6, 14, 7, 15);
  }
  for (int k = 0; k < 8; k += 4)
    for (int q = 0; q < 2; q++) {
      b[k + 2 * q] = PICK(a[k + q], a[k + q + 2], 0, 1, 8, 9, 4, 5, 12, 13);
      b[k + 2 * q + 1] = PICK(a[k + q], a[k + q + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    }
  for (int q = 0; q < 4; q++) {
    r[q] = PICK(b[q], b[q + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    r[q + 4] = PICK(b[q], b[q + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
}

// Copy the conics of the intersections start to stop into the batch, and prefetch those of the next batch. Return false
// for an invalid index.
static inline bool gather(Batch *b, const Tile *tile, const Lists *l, int64_t start, int64_t stop, int64_t end) {
  float left = (float)tile->left + 0.5f, top = (float)tile->top + 0.5f;
  const int32_t *ids = l->flatten_ids;
  bool outside = false;
  for (int64_t i = start; i < stop; i++) outside |= (uint64_t)(int64_t)ids[i] >= (uint64_t)l->m;
  if (outside) return false;
  for (int64_t j = 0; j < stop - start; j += 8) {
    v8f r[8];
    for (int k = 0; k < 8; k++) r[k] = load8(l->conics + CONIC * (int64_t)ids[mini(start + j + k, stop - 1)]);
    transpose8(r);
    store8(b->mx + j, r[0] - left);
    store8(b->my + j, r[1] - top);
    store8(b->rate + j, r[2]);
    store8(b->slope + j, r[3]);
    store8(b->decay + j, r[4]);
    store8(b->lnop + j, r[5]);
    store8(b->first + j, r[6] - (float)tile->top);
    store8(b->last + j, r[7] - (float)tile->top);
  }
  narrow_rows(b);
  for (int64_t i = stop; i < end && i < stop + BATCH; i++) __builtin_prefetch(l->conics + CONIC * (int64_t)ids[i]);
  return true;
}

// Copy the colours of the intersections start to stop into the batch, and prefetch those of the next batch.
static inline void gather_colors(Batch *b, const float *colors, const int32_t *flatten_ids, int64_t start, int64_t stop,
                                 int64_t end) {
  for (int64_t i = start; i < stop; i++) {
    const float *c = colors + SPLAT_COLORS * (int64_t)flatten_ids[i];
    b->red[i - start] = c[0];
    b->green[i - start] = c[1];
    b->blue[i - start] = c[2];
  }
  for (int64_t i = stop; i < end && i < stop + BATCH; i++)
    __builtin_prefetch(colors + SPLAT_COLORS * (int64_t)flatten_ids[i]);
}

// Reset the planes of a tile: the transmittance is 1, other planes are zero, and lanes outside the image have stopped.
static inline Tile open_tile(float *state, int planes, int64_t tile, int64_t tile_width, int64_t h, int64_t w) {
  int64_t left = tile % tile_width * TILE, top = tile / tile_width * TILE;
  int32_t num_x = (int32_t)mini(TILE, w - left), num_y = (int32_t)mini(TILE, h - top);
  for (int i = PLANE; i < planes * PLANE; i++) state[i] = 0.f;
  for (int y = 0; y < TILE; y++)
    for (int x = 0; x < TILE; x++) state[y * TILE + x] = x < num_x && y < num_y ? 1.f : -1.f;
  return (Tile){left, top, num_x, num_y, 0, num_y - 1};
}

static inline bool row_is_live(const float *row) {
  int32_t live = 0;
  for (int x = 0; x < TILE; x++) live |= row[x] > 0.f;
  return live;
}

// Narrow the rows of a tile to those with pixels that have not stopped.
static inline void narrow_tile(Tile *tile, const float *state) {
  while (tile->y_low <= tile->y_high && !row_is_live(state + tile->y_low * TILE)) tile->y_low++;
  while (tile->y_high >= tile->y_low && !row_is_live(state + tile->y_high * TILE)) tile->y_high--;
}

// First and last of the live rows in which Gaussian j of a batch shows.
static inline int32_t first_row(const Tile *tile, const Batch *b, int64_t j) {
  return b->y0[j] > tile->y_low ? b->y0[j] : tile->y_low;
}
static inline int32_t last_row(const Tile *tile, const Batch *b, int64_t j) {
  return b->y1[j] < tile->y_high ? b->y1[j] : tile->y_high;
}

// Blend Gaussian j of a batch over rows y0 to y1; plane 1 receives its weights.
static inline void weigh_rows(float *state, const Batch *b, int64_t j, int32_t y0, int32_t y1) {
  Curve curve;
  v8f alphas[TILE];
  trace(&curve, b, j);
  for (int32_t x = 0; x < TILE; x += HALF) {
    fill_alphas(alphas, &curve, x, y0, y1);
    for (int32_t y = y0; y <= y1; y++) {
      float *row = state + y * TILE + x;
      Share s = take_share(load8(row), alphas[y]);
      store8(row, s.left);
      store8(row + PLANE, s.weight);
    }
  }
}

// First and last column of the tile that Gaussian j of a batch can touch.
static inline void columns_of(const Batch *b, int64_t j, int32_t num_x, int32_t *x0, int32_t *x1) {
  float rate = b->rate[j], slope = b->slope[j];
  float square = 1.f / (rate * rate) + slope * slope / b->decay[j];
  float reach = sqrtf4(maxf(b->lnop[j] - LN_CUT, 0.f) * square) + 0.01f;
  *x0 = whole(b->mx[j] - reach, 0.f, (float)TILE);
  *x1 = whole(b->mx[j] + reach, -1.f, (float)(num_x - 1));
}
