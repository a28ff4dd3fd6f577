// Blend a view front to back, tile by tile, and sum over its blending weights.
//
// All kernels use the same lists with the same weights. Gaussians are gathered 32 at a time into a small local batch,
// with the rows of the tile in which they show.
#include "walk.h"

enum { CHANNELS = 4 };  // number of channels that weighted_sums adds up at a time

// The sum and the maximum of the weights of a Gaussian in each column.
typedef struct { pixels sum, peak; } Weights;

static inline v4f max4(v4f a, v4f b) { return (v4f)(((a > b) & (v4i)a) | (~(a > b) & (v4i)b)); }

static inline float maximum(v16f v) {
  v4f a = max4(PICK(v, v, 0, 1, 2, 3), PICK(v, v, 4, 5, 6, 7));
  v4f b = max4(PICK(v, v, 8, 9, 10, 11), PICK(v, v, 12, 13, 14, 15)), peak = max4(a, b);
  return maxf(maxf(peak[0], peak[1]), maxf(peak[2], peak[3]));
}

// Blend Gaussian j of a batch in a part of its rows, and return its weights. If `colored`, planes 1 to 3 collect the
// colour.
INLINE Weights blend_part(float *state, const Curve *curve, Rows r, const Batch *b, int64_t j, bool colored, int part) {
  float red = b->red[j], green = b->green[j], blue = b->blue[j];
  int32_t last = last_of(r, part);
  int64_t gap = gap_of(r);
  Weights w = {{0}, {0}};
  for (int32_t y = first_of(r, part); y <= last; y += step_of(r)) {
    float *row = state + y * TILE + r.x;
    Share s = take_share(load_part(row, gap, part), alphas_of(curve, y, r.wide, part));
    store_part(row, gap, part, s.left);
    if (colored) {
      store_part(row + PLANE, gap, part, load_part(row + PLANE, gap, part) + s.weight * red);
      store_part(row + 2 * PLANE, gap, part, load_part(row + 2 * PLANE, gap, part) + s.weight * green);
      store_part(row + 3 * PLANE, gap, part, load_part(row + 3 * PLANE, gap, part) + s.weight * blue);
    }
    w.sum += s.weight;
    w.peak = pick(s.weight > w.peak, s.weight, w.peak);
  }
  return w;
}

INLINE void blend_rows(float *state, Rows r, const Batch *b, int64_t j, bool colored, Weights w[PARTS]) {
  Curve curve;
  trace(&curve, b, j, r);
  for (int part = 0; part < PARTS; part++) w[part] = blend_part(state, &curve, r, b, j, colored, part);
}

// Blend Gaussian j of a batch over rows y0 to y1.
INLINE void blend_one(float *state, const Batch *b, int64_t j, int32_t y0, int32_t y1, bool colored, Weights w[PARTS]) {
  if (b->x0[j] == WIDE) blend_rows(state, (Rows){true, 0, y0, y1}, b, j, colored, w);
  else blend_rows(state, (Rows){false, b->x0[j], y0, y1}, b, j, colored, w);
}

// Blend Gaussian j of a batch over the whole tile, and add its weights to a row of totals: their sum, and their
// maximum.
INLINE void survey_one(float *state, const Batch *b, int64_t j, int32_t y0, int32_t y1, bool colored, float *own) {
  Weights w[PARTS];
  blend_rows(state, (Rows){true, 0, y0, y1}, b, j, colored, w);
  own[0] += total(JOIN(w, sum));
  own[1] = maxf(own[1], maximum(JOIN(w, peak)));
}

API int32_t blend(const float *restrict conics, const int32_t *restrict flatten_ids,
                  const int64_t *restrict isect_offsets, int64_t tile_width, const float *restrict colors,
                  int64_t first, int64_t last, int64_t top, const float *restrict background, float *restrict image,
                  float *restrict transmittance, int64_t m, int64_t n, int64_t ends, int64_t h, int64_t w) {
  Lists lists = {conics, flatten_ids, isect_offsets, tile_width, m, n, ends};
  if (!lists_are_sound(&lists, first, last)) return OUTSIDE;
  float state[4 * PLANE] __attribute__((aligned(64)));
  Batch batch;
  Weights weights[PARTS];
  clear_batch(&batch);
  for (int64_t tile = first; tile < last; tile++) {
    Tile t = open_tile(state, 4, tile, tile_width, top + h, w);
    if (t.top < top) continue;
    int64_t end = isect_offsets[tile + 1];
    for (int64_t start = isect_offsets[tile]; start < end && t.y_low <= t.y_high; start += BATCH) {
      int64_t stop = mini(end, start + BATCH);
      if (!gather(&batch, &t, &lists, start, stop, end)) return OUTSIDE;
      gather_colors(&batch, colors, flatten_ids, start, stop, end);
      for (int64_t j = 0; j < stop - start; j++) {
        int32_t y0 = first_row(&t, &batch, j), y1 = last_row(&t, &batch, j);
        if (y0 <= y1) blend_one(state, &batch, j, y0, y1, true, weights);
      }
      narrow_tile(&t, state);
    }
    for (int y = 0; y < t.num_y; y++)
      for (int x = 0; x < t.num_x; x++) {
        int64_t pixel = (t.top - top + y) * w + t.left + x;
        const float *lane = state + y * TILE + x;
        float rest = absf4(lane[0]);
        for (int c = 0; c < 3; c++) image[3 * pixel + c] = lane[(c + 1) * PLANE] + rest * background[c];
        transmittance[pixel] = rest;
      }
  }
  return 0;
}

// Mark the pixels of a range of tiles whose transmittance falls to `limit`. A tile ends where all of its pixels have.
API int32_t cover(const float *restrict conics, const int32_t *restrict flatten_ids,
                  const int64_t *restrict isect_offsets, int64_t tile_width, int64_t first, int64_t last, float limit,
                  uint8_t *restrict covered, int64_t m, int64_t n, int64_t ends, int64_t h, int64_t w) {
  Lists lists = {conics, flatten_ids, isect_offsets, tile_width, m, n, ends};
  if (!lists_are_sound(&lists, first, last)) return OUTSIDE;
  float state[PLANE] __attribute__((aligned(64)));
  Batch batch;
  Weights weights[PARTS];
  clear_batch(&batch);
  for (int64_t tile = first; tile < last; tile++) {
    Tile t = open_tile(state, 1, tile, tile_width, h, w);
    int64_t end = isect_offsets[tile + 1];
    for (int64_t start = isect_offsets[tile]; start < end && t.y_low <= t.y_high; start += BATCH) {
      int64_t stop = mini(end, start + BATCH);
      if (!gather(&batch, &t, &lists, start, stop, end)) return OUTSIDE;
      for (int64_t j = 0; j < stop - start; j++) {
        int32_t y0 = first_row(&t, &batch, j), y1 = last_row(&t, &batch, j);
        if (y0 <= y1) blend_one(state, &batch, j, y0, y1, false, weights);
      }
      for (int i = 0; i < PLANE; i++) state[i] = state[i] > limit ? state[i] : -absf4(state[i]);
      narrow_tile(&t, state);
    }
    for (int y = 0; y < t.num_y; y++)
      for (int x = 0; x < t.num_x; x++)
        covered[(t.top + y) * w + t.left + x] = absf4(state[y * TILE + x]) <= limit;
  }
  return 0;
}

// The sum of weights times one channel in each column.
typedef struct { pixels sum; } Channel;

// Sum the weights of Gaussian j times the planes of some channels over the tile.
INLINE void sum_weights(float *state, const Batch *b, int64_t j, int32_t y0, int32_t y1, int channels, float *slot) {
  Channel sums[CHANNELS][PARTS] = {{{{0}}}};
  Curve curve;
  trace(&curve, b, j, (Rows){true, 0, y0, y1});
  for (int part = 0; part < PARTS; part++)
    for (int32_t y = y0; y <= y1; y++) {
      float *row = state + y * TILE;
      Share s = take_share(load_part(row, HALF, part), alphas_of(&curve, y, true, part));
      store_part(row, HALF, part, s.left);
      for (int c = 0; c < channels; c++) sums[c][part].sum += s.weight * load_part(row + (c + 1) * PLANE, HALF, part);
    }
  for (int c = 0; c < CHANNELS; c++) slot[c] = c < channels ? total(JOIN(sums[c], sum)) : 0.f;
}

API int32_t weighted_sums(const float *restrict conics, const int32_t *restrict flatten_ids,
                          const int64_t *restrict isect_offsets, int64_t tile_width, int64_t first, int64_t last,
                          const float *restrict image, float *restrict slots, int64_t m, int64_t n, int64_t ends,
                          int64_t h, int64_t w, int64_t channels) {
  Lists lists = {conics, flatten_ids, isect_offsets, tile_width, m, n, ends};
  if (!lists_are_sound(&lists, first, last)) return OUTSIDE;
  float state[(CHANNELS + 1) * PLANE] __attribute__((aligned(64)));
  Batch batch;
  clear_batch(&batch);
  for (int64_t tile = first; tile < last; tile++) {
    Tile t = open_tile(state, CHANNELS + 1, tile, tile_width, h, w);
    for (int y = 0; y < t.num_y; y++)
      for (int x = 0; x < t.num_x; x++)
        for (int64_t c = 0; c < channels && c < CHANNELS; c++)
          state[(c + 1) * PLANE + y * TILE + x] = image[((t.top + y) * w + t.left + x) * channels + c];
    int64_t start = isect_offsets[tile], end = isect_offsets[tile + 1];
    for (; start < end && t.y_low <= t.y_high; start += BATCH) {
      int64_t stop = mini(end, start + BATCH);
      if (!gather(&batch, &t, &lists, start, stop, end)) return OUTSIDE;
      for (int64_t j = 0; j < stop - start; j++) {
        int32_t y0 = first_row(&t, &batch, j), y1 = last_row(&t, &batch, j);
        float *slot = slots + CHANNELS * (start + j);
        if (channels == 1)  // the number of channels is a constant in each call, so that loops unroll
          sum_weights(state, &batch, j, y0, y1, 1, slot);
        else
          sum_weights(state, &batch, j, y0, y1, CHANNELS, slot);
      }
      narrow_tile(&t, state);
    }
    for (int64_t i = CHANNELS * start; i < CHANNELS * end; i++) slots[i] = 0.f;
  }
  return 0;
}

API int32_t add_slots(const int32_t *restrict flatten_ids, const float *restrict slots, const int32_t *restrict ids,
                      int64_t first, float *restrict sums, int64_t n, int64_t m, int64_t gaussians, int64_t channels) {
  int64_t count = mini(CHANNELS, channels - first);
  for (int64_t i = 0; i < n; i++) {
    int64_t row = flatten_ids[i];
    if ((uint64_t)row >= (uint64_t)m || (uint64_t)(int64_t)ids[row] >= (uint64_t)gaussians) return OUTSIDE;
  }
  for (int64_t i = 0; i < n; i++) {
    __builtin_prefetch(sums + channels * ids[flatten_ids[mini(i + BATCH, n - 1)]]);
    float *sum = sums + channels * ids[flatten_ids[i]] + first;
    for (int64_t c = 0; c < count; c++) sum[c] += slots[CHANNELS * i + c];
  }
  return 0;
}

// Blend the whole image over black, and in the same pass find the sum and the maximum of every Gaussian's weights.
API int32_t survey(const float *restrict conics, const int32_t *restrict flatten_ids,
                   const int64_t *restrict isect_offsets, int64_t tile_width, const float *restrict colors,
                   float *restrict image, float *restrict totals, int64_t m, int64_t n, int64_t ends, int64_t h,
                   int64_t w) {
  Lists lists = {conics, flatten_ids, isect_offsets, tile_width, m, n, ends};
  if (!lists_are_sound(&lists, 0, ends - 1)) return OUTSIDE;
  float state[4 * PLANE] __attribute__((aligned(64)));
  Batch batch;
  clear_batch(&batch);
  for (int64_t tile = 0; tile < ends - 1; tile++) {
    Tile t = open_tile(state, 4, tile, tile_width, h, w);
    int64_t end = isect_offsets[tile + 1];
    for (int64_t start = isect_offsets[tile]; start < end && t.y_low <= t.y_high; start += BATCH) {
      int64_t stop = mini(end, start + BATCH);
      if (!gather(&batch, &t, &lists, start, stop, end)) return OUTSIDE;
      gather_colors(&batch, colors, flatten_ids, start, stop, end);
      for (int64_t j = 0; j < stop - start; j++)
        survey_one(state, &batch, j, first_row(&t, &batch, j), last_row(&t, &batch, j), true,
                   totals + 2 * (int64_t)flatten_ids[start + j]);
      narrow_tile(&t, state);
    }
    for (int y = 0; y < t.num_y; y++)
      for (int x = 0; x < t.num_x; x++)
        for (int c = 0; c < 3; c++)
          image[3 * ((t.top + y) * w + t.left + x) + c] = state[(c + 1) * PLANE + y * TILE + x];
  }
  return 0;
}

API int32_t contributions(const float *restrict conics, const int32_t *restrict flatten_ids,
                          const int64_t *restrict isect_offsets, int64_t tile_width, int64_t height, int64_t width,
                          float *restrict totals, int64_t m, int64_t n, int64_t ends) {
  Lists lists = {conics, flatten_ids, isect_offsets, tile_width, m, n, ends};
  if (!lists_are_sound(&lists, 0, ends - 1)) return OUTSIDE;
  float state[PLANE] __attribute__((aligned(64)));
  Batch batch;
  clear_batch(&batch);
  for (int64_t tile = 0; tile < ends - 1; tile++) {
    Tile t = open_tile(state, 1, tile, tile_width, height, width);
    int64_t end = isect_offsets[tile + 1];
    for (int64_t start = isect_offsets[tile]; start < end && t.y_low <= t.y_high; start += BATCH) {
      int64_t stop = mini(end, start + BATCH);
      if (!gather(&batch, &t, &lists, start, stop, end)) return OUTSIDE;
      for (int64_t i = start; i < stop; i++) __builtin_prefetch(totals + 2 * (int64_t)flatten_ids[i]);
      for (int64_t j = 0; j < stop - start; j++)
        survey_one(state, &batch, j, first_row(&t, &batch, j), last_row(&t, &batch, j), false,
                   totals + 2 * (int64_t)flatten_ids[start + j]);
      narrow_tile(&t, state);
    }
  }
  return 0;
}

// The part of one tile in which each Gaussian of a list shows, as all kernels use it: first and last row, first column.
API int32_t parts_of_tile(const float *conics, const int32_t *flatten_ids, int64_t left, int64_t top, int32_t *parts,
                          int64_t m, int64_t n) {
  Lists lists = {conics, flatten_ids, 0, 1, m, n, 0};
  Batch batch;
  clear_batch(&batch);
  Tile t = {left, top, TILE, TILE, 0, TILE - 1};
  for (int64_t start = 0; start < n; start += BATCH) {
    int64_t stop = mini(n, start + BATCH);
    if (!gather(&batch, &t, &lists, start, stop, n)) return OUTSIDE;
    for (int64_t j = 0; j < stop - start; j++) {
      parts[3 * (start + j)] = batch.y0[j];
      parts[3 * (start + j) + 1] = batch.y1[j];
      parts[3 * (start + j) + 2] = batch.x0[j];
    }
  }
  return 0;
}
