// Evaluate a Gaussian of a batch over the rows of a tile, sixteen pixels at a time, for all blending kernels.
//
// The state of a tile consists of planes of 16 x 16 floats. The weights are gsplat's: alpha is clamped at 0.99 and cut
// below 1/255, and a pixel stops before the Gaussian that would lower its transmittance to 1e-4 or below. Plane 0 of
// the state is the transmittance; its sign bit marks pixels that have stopped.
#pragma once
#include "pixels.h"

enum { BATCH = 32, CONIC = 8, SPLAT_COLORS = 3, WIDE = -1 };

#define SPARE 0.02f  // rows and columns by which a Gaussian is enlarged, against rounding

// Gaussians relative to the tile's first pixel centre: ln w = lnop - (rate (x - mx - slope (y - my)))^2 - decay (y -
// my)^2.
typedef struct {
  float mx[BATCH], my[BATCH], rate[BATCH], slope[BATCH], decay[BATCH], lnop[BATCH], first[BATCH], last[BATCH];
  float red[BATCH], green[BATCH], blue[BATCH];
  int32_t y0[BATCH], y1[BATCH];  // first and last row of the tile in which each Gaussian shows
  int32_t x0[BATCH];  // first of the eight columns in which each Gaussian shows; WIDE if it shows in more
} Batch;

// What a Gaussian contributes to some pixels.
typedef struct {
  pixels alpha, weight;  // weight is alpha times the transmittance, or 0 if the pixel stops
  pixels left;           // transmittance behind the Gaussian; negative if the pixel has stopped
  masks unclamped, goes;  // set if alpha is below 0.99; set if the pixel does not stop here or before
} Share;

// The tile on which a kernel works.
typedef struct {
  int64_t left, top;
  int32_t num_x, num_y;  // columns and rows inside the image
  int32_t y_low, y_high;  // rows with pixels that have not stopped
} Tile;

INLINE Share take_share(pixels t, pixels alpha) {
  Share s = {alpha, alpha * t, t, alpha < MAX_ALPHA, {0}};
  s.left = t - s.weight;
  s.goes = s.left > MIN_TRANSMITTANCE;
  s.weight = pick(s.goes, s.weight, all(0.f));
  s.left = pick(s.goes, s.left, (pixels)((masks)t | INT32_MIN));
  return s;
}

// The part of a tile in which a Gaussian is computed, sixteen pixels at a time: whole rows, or pairs of rows of eight
// columns.
typedef struct {
  bool wide;
  int32_t x, y0, y1;  // first column, 0 for whole rows; first and last row
} Rows;

// First and last row, or first and last pair of rows, which has a row of the part. The last pair ends at the last row,
// unless the only pair begins at row 0.
INLINE int32_t first_of(Rows r, int part) {
  bool odd = !r.wide && r.y0 > 0 && (r.y1 - r.y0) % 2 == 0;
  return r.y0 - odd + 2 * (PARTS == 2 && odd && part == 0);
}
INLINE int32_t last_of(Rows r, int part) { return r.wide || PARTS == 1 ? r.y1 : r.y1 - part; }
INLINE int32_t step_of(Rows r) { return r.wide ? 1 : 2; }
INLINE int64_t gap_of(Rows r) { return r.wide ? HALF : TILE; }
INLINE v16f columns_in(Rows r) { return r.wide ? load(ROW_X) : load(PAIR_X) + (float)r.x; }

// Spread the number of row y, or those of the pair of rows from y on, over all their pixels.
INLINE pixels spread_rows(const v16f *numbers, int32_t y, bool wide, int part) {
#if PARTS == 1
  (void)part;
  v16i rows = (wide ? (v16i){0} : (v16i){0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1}) + y;
  return (pixels)_mm512_permutexvar_ps((__m512i)rows, (__m512)*numbers);
#else
  return all(((const float *)numbers)[wide ? y : y + part]);
#endif
}

// A Gaussian of a batch in the rows of a tile: the distances dy of the rows from the mean, and its alphas. These are
// computed before they are used, so that those of the next row do not wait for a pixel's transmittance.
typedef struct {
  v16f dy;
  float alphas[TILE][TILE] __attribute__((aligned(64)));  // by row; PARTS == 1: of the pair of rows from it on
} Curve;

// Exponents in row y are top - (rate x - base)^2, never positive beyond lnop.
INLINE void trace(Curve *c, const Batch *b, int64_t j, Rows r) {
  v16f y = load(ROW_X), dy = y - b->my[j];
  v16f base = b->rate[j] * (b->mx[j] + b->slope[j] * dy), top = b->lnop[j] - b->decay[j] * dy * dy;
  c->dy = dy;
#if PARTS == 1
  v16f across = b->rate[j] * columns_in(r);
  if (!r.wide)  // one row of a pair may be outside the rows of the Gaussian
    top = sel((y >= (float)r.y0) & (y <= (float)r.y1), top, splat(HIDDEN));
  for (int32_t row = first_of(r, 0); row <= r.y1; row += step_of(r)) {
    pixels side = across - spread_rows(&base, row, r.wide, 0);
    store(c->alphas[row], alphas_at(spread_rows(&top, row, r.wide, 0) - side * side));
  }
#else
  pixels left = b->rate[j] * (part_of(ROW_X, 0) + (float)r.x), right = b->rate[j] * part_of(ROW_X, 1);
  for (int32_t row = r.y0; row <= r.y1; row++) {
    pixels middle = spread_rows(&base, row, true, 0), highest = spread_rows(&top, row, true, 0);
    store8(c->alphas[row], alphas_at(highest - (left - middle) * (left - middle)));
    if (r.wide) store8(c->alphas[row] + HALF, alphas_at(highest - (right - middle) * (right - middle)));
  }
#endif
}

// The alphas of row y, or of the pair of rows from y on.
INLINE pixels alphas_of(const Curve *c, int32_t y, bool wide, int part) {
#if PARTS == 1
  (void)wide, (void)part;
  return load(c->alphas[y]);
#else
  return load8(wide ? c->alphas[y] + HALF * part : c->alphas[y + part]);
#endif
}

static inline float clamp_column(float x) {
  x = x < (float)(TILE - 1) ? x : (float)(TILE - 1);
  return x > 0.f ? x : 0.f;
}

// Narrow the rows of a batch to those where a column of the tile reaches the cut, and find the columns where a row
// does.
//
// With q the ln opacity above the cut, a Gaussian shows where decay y^2 + rate^2 (x - slope y)^2 <= q. The highest
// point of this ellipse lies at y = sqrt(q / decay); where that is outside the tile, the ellipse is highest at the
// tile's column next to it. It reaches sqrt(q (1 / rate^2 + slope^2 / decay)) to the sides.
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

// Fill a batch with Gaussians without effect, because unused lanes are computed as well.
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

// Transpose eight rows of eight numbers.
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

// Reset the planes of a tile. The transmittance is 1, other planes are zero, and pixels outside the image have stopped.
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

// The first and the last row in which Gaussian j of a batch shows, among those with pixels that have not stopped.
static inline int32_t first_row(const Tile *tile, const Batch *b, int64_t j) {
  return b->y0[j] > tile->y_low ? b->y0[j] : tile->y_low;
}
static inline int32_t last_row(const Tile *tile, const Batch *b, int64_t j) {
  return b->y1[j] < tile->y_high ? b->y1[j] : tile->y_high;
}

// Blend Gaussian j of a batch over rows y0 to y1; plane 1 receives its weights.
static inline void weigh_rows(float *state, const Batch *b, int64_t j, int32_t y0, int32_t y1) {
  Curve curve;
  trace(&curve, b, j, (Rows){true, 0, y0, y1});
  for (int part = 0; part < PARTS; part++)
    for (int32_t y = y0; y <= y1; y++) {
      float *row = state + y * TILE;
      Share s = take_share(load_part(row, HALF, part), alphas_of(&curve, y, true, part));
      store_part(row, HALF, part, s.left);
      store_part(row + PLANE, HALF, part, s.weight);
    }
}

// Write the first and the last column of the tile that Gaussian j of a batch can touch.
static inline void columns_of(const Batch *b, int64_t j, int32_t num_x, int32_t *x0, int32_t *x1) {
  float rate = b->rate[j], slope = b->slope[j];
  float square = 1.f / (rate * rate) + slope * slope / b->decay[j];
  float reach = sqrtf4(maxf(b->lnop[j] - LN_CUT, 0.f) * square) + 0.01f;
  *x0 = whole(b->mx[j] - reach, 0.f, (float)TILE);
  *x1 = whole(b->mx[j] + reach, -1.f, (float)(num_x - 1));
}
