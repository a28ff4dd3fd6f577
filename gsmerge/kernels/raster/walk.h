// A Gaussian of a batch over the rows of a tile, sixteen pixels at a time: what the blending kernels share.
//
// A tile's state lives in planes of 16 x 16 floats. The weights are gsplat's: alpha clamped at 0.99, cut below 1/255,
// and a pixel stops before the Gaussian that would take its transmittance to 1e-4 or below. Plane 0 of the state is the
// transmittance; its sign bit marks pixels that stopped.
#pragma once
#include "native.h"

enum { TILE = 16, HALF = TILE / 2, PLANE = TILE * TILE, BATCH = 32, CONIC = 8, SPLAT_COLORS = 3, WIDE = -1 };

#define LN_CUT -5.541263545158426f  // ln(1/255)
#define MAX_ALPHA 0.99f
#define MIN_TRANSMITTANCE 1e-4f
#define HIDDEN -1e4f  // an exponent that shows nothing
#define SPARE 0.02f  // rows and columns beside those in which a Gaussian shows, for rounding

static const v16f COLUMNS = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
static const v16f PAIR_COLUMNS = {0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7};  // of two rows of half a tile

// Gaussians relative to the tile's first pixel centre: ln w = lnop - (rate (x - mx - slope (y - my)))^2 - decay (y - my)^2.
typedef struct {
  float mx[BATCH], my[BATCH], rate[BATCH], slope[BATCH], decay[BATCH], lnop[BATCH], first[BATCH], last[BATCH];
  float red[BATCH], green[BATCH], blue[BATCH];
  int32_t y0[BATCH], y1[BATCH];  // rows of the tile in which each shows
  int32_t x0[BATCH];  // first of the eight columns in which each shows; WIDE where these are more
} Batch;

// Part of the light of sixteen pixels that a Gaussian takes.
typedef struct {
  v16f alpha, weight;  // alpha times the transmittance; 0 where the pixel stops
  v16f left;           // transmittance behind it; negative where the pixel stopped
  v16i unclamped, goes;  // alpha is below 0.99; the pixel does not stop here or before
} Share;

// The tile on which a kernel works.
typedef struct {
  int64_t left, top;
  int32_t num_x, num_y;  // columns and rows inside the image
  int32_t y_low, y_high;  // rows in which a pixel still goes on
} Tile;

// exp(p) = poly(p)^8 on [ln(1/255), 0]: minimax of relative error 8e-8 for exp(p / 8), coefficients scaled by 8^-k.
static inline Share take_share(v16f t, v16f p) {
  v16f e = 0.99999992f
      + p * (0.12499907f + p * (0.0078106653f + p * (3.2416797e-4f + p * (9.7100983e-6f + p * 1.7842896e-7f))));
  e = e * e;
  e = e * e;
  e = e * e;
  Share s;
  s.unclamped = e < MAX_ALPHA;
  s.alpha = sel(p >= LN_CUT, sel(s.unclamped, e, splat(MAX_ALPHA)), splat(0.f));
  s.weight = s.alpha * t;
  s.left = t - s.weight;
  s.goes = s.left > MIN_TRANSMITTANCE;
  s.weight = sel(s.goes, s.weight, splat(0.f));
  s.left = sel(s.goes, s.left, (v16f)((v16i)t | INT32_MIN));
  return s;
}

// What the rows of Gaussian j need: p of row y in two steps.
typedef struct { v16f across; float mx, my, rate, slope, decay, lnop; } Curve;

static inline Curve curve_of(const Batch *b, int j) {
  float rate = b->rate[j];
  return (Curve){rate * COLUMNS, b->mx[j], b->my[j], rate, b->slope[j], b->decay[j], b->lnop[j]};
}

// Exponents of the sixteen pixels of the row dy below the mean; never positive beyond lnop.
static inline v16f exponents(const Curve *c, float dy) {
  v16f d = c->across - c->rate * (c->mx + c->slope * dy);
  return (c->lnop - c->decay * dy * dy) - d * d;
}

// Eight pixels of a row, and those below them.
static inline v16f load_pair(const float *p) {
  v8f upper = *(const v8f *)p, lower = *(const v8f *)(p + TILE);
  return PICK(upper, lower, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
static inline void store_pair(float *p, v16f v) {
  *(v8f *)p = PICK(v, v, 0, 1, 2, 3, 4, 5, 6, 7);
  *(v8f *)(p + TILE) = PICK(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
}
static inline v16f splat_pair(float upper, float lower) {
  v16f a = splat(upper), b = splat(lower);
  return PICK(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
}

// The curve over eight columns from x0 on, twice.
static inline Curve pair_curve_of(const Batch *b, int j) {
  Curve curve = curve_of(b, j);
  curve.across = curve.rate * (PAIR_COLUMNS + (float)b->x0[j]);
  return curve;
}

// First row of the pairs that cover y0 to y1 and, where their number is odd, a row of the tile beside them.
static inline int32_t first_pair(int32_t y0, int32_t y1) { return y0 > 0 && (y1 - y0) % 2 == 0 ? y0 - 1 : y0; }

// Exponents of rows y and y + 1 by the same arithmetic as exponents(); far below the cut outside of y0 to y1.
static inline v16f pair_exponents(const Curve *c, int32_t y, int32_t y0, int32_t y1) {
  float dy = (float)y - c->my, below = (float)(y + 1) - c->my;
  float upper = c->lnop - c->decay * dy * dy, lower = c->lnop - c->decay * below * below;
  v16f d = c->across - splat_pair(c->rate * (c->mx + c->slope * dy), c->rate * (c->mx + c->slope * below));
  return splat_pair(y < y0 ? HIDDEN : upper, y < y1 ? lower : HIDDEN) - d * d;
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

// A batch of Gaussians without effect: lanes that are not filled are calculated with, too.
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

// Whether there is such a range of tiles, and their lists lie within flatten_ids.
static inline bool lists_are_sound(const Lists *l, int64_t first, int64_t last) {
  if (l->tile_width < 1 || first < 0 || last >= l->ends) return false;
  for (int64_t tile = first; tile < last; tile++) {
    int64_t start = l->isect_offsets[tile], end = l->isect_offsets[tile + 1];
    if (start < 0 || start > end || end > l->n) return false;
  }
  return true;
}

// Copy the conics of the intersections start to stop into the batch, and call for those of the next batch -> whether
// there are such conics.
static inline bool gather(Batch *b, const Tile *tile, const Lists *l, int64_t start, int64_t stop, int64_t end) {
  float left = (float)tile->left + 0.5f, top = (float)tile->top + 0.5f;
  const float *conics = l->conics;
  const int32_t *flatten_ids = l->flatten_ids;
  for (int64_t i = start; i < stop; i++) {
    if ((uint64_t)(int64_t)flatten_ids[i] >= (uint64_t)l->m) return false;
    const float *f = conics + CONIC * (int64_t)flatten_ids[i];
    int64_t j = i - start;
    b->mx[j] = f[0] - left;
    b->my[j] = f[1] - top;
    b->rate[j] = f[2];
    b->slope[j] = f[3];
    b->decay[j] = f[4];
    b->lnop[j] = f[5];
    b->first[j] = f[6] - (float)tile->top;
    b->last[j] = f[7] - (float)tile->top;
  }
  narrow_rows(b);
  for (int64_t i = stop; i < end && i < stop + BATCH; i++)
    __builtin_prefetch(conics + CONIC * (int64_t)flatten_ids[i]);
  return true;
}

// Copy the colours of the intersections start to stop into the batch, and call for those of the next batch.
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

// Reset the planes of a tile: all light passes, the others are zero; lanes outside the image have stopped.
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

// Narrow the rows of a tile to those where a pixel still goes on.
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
  Curve curve = curve_of(b, (int)j);
  for (int32_t y = y0; y <= y1; y++) {
    Share s = take_share(load(state + y * TILE), exponents(&curve, (float)y - curve.my));
    store(state + y * TILE, s.left);
    store(state + PLANE + y * TILE, s.weight);
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
