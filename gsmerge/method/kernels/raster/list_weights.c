// List the blending weights of a view as entries of a pixel and a weight.
#include "walk.h"

enum { CHANNELS = 4 };  // number of channels of a pixel

// Append the weights of tiles from progress[0] on, behind the first progress[1] entries, and advance both numbers. Stop
// at a tile whose entries may not fit, so that the caller can continue with more room.
API int32_t list_weights(const float *restrict conics, const int32_t *restrict flatten_ids,
                         const int64_t *restrict isect_offsets, int64_t tile_width, int64_t height, int64_t width,
                         int64_t *restrict starts, uint8_t *restrict lanes, float *restrict weights,
                         int64_t *restrict progress, int64_t m, int64_t n, int64_t ends, int64_t more, int64_t room) {
  if (more != n + 1 || progress[0] < 0 || progress[1] < 0) return OUTSIDE;
  Lists lists = {conics, flatten_ids, isect_offsets, tile_width, m, n, ends};
  if (!lists_are_sound(&lists, progress[0], ends - 1)) return OUTSIDE;
  float state[2 * PLANE] __attribute__((aligned(64)));
  Batch batch;
  clear_batch(&batch);
  for (int64_t tile = progress[0]; tile < ends - 1; tile++) {
    Tile t = open_tile(state, 2, tile, tile_width, height, width);
    int64_t start = isect_offsets[tile], end = isect_offsets[tile + 1], count = progress[1];
    for (; start < end && t.y_low <= t.y_high; start += BATCH) {
      int64_t stop = mini(end, start + BATCH);
      if (count + BATCH * PLANE > room) return 0;
      if (!gather(&batch, &t, &lists, start, stop, end)) return OUTSIDE;
      for (int64_t j = 0; j < stop - start; j++) {
        int32_t y0 = first_row(&t, &batch, j), y1 = last_row(&t, &batch, j), x0, x1;
        weigh_rows(state, &batch, j, y0, y1);
        columns_of(&batch, j, t.num_x, &x0, &x1);
        for (int32_t y = y0; y <= y1; y++)
          for (int32_t x = x0; x <= x1; x++) {
            float w = state[PLANE + y * TILE + x];
            lanes[count] = (uint8_t)(y * TILE + x);
            weights[count] = w;
            count += w > 0.f;  // without a branch, which would be mispredicted half of the time
          }
        starts[start + j + 1] = count;
      }
      narrow_tile(&t, state);
    }
    for (int64_t i = start; i < end; i++) starts[i + 1] = count;
    progress[0] = tile + 1;
    progress[1] = count;
  }
  return 0;
}

API int32_t collect(const int64_t *restrict starts, const uint8_t *restrict lanes, const float *restrict weights,
                 const int32_t *restrict flatten_ids, const int64_t *restrict isect_offsets, int64_t tile_width,
                 const float *restrict image, double *restrict sums, int64_t more, int64_t entries, int64_t n,
                 int64_t ends, int64_t h, int64_t w, int64_t m) {
  (void)entries, (void)m;
  if (more != n + 1) return OUTSIDE;
  float state[PLANE][CHANNELS] __attribute__((aligned(64)));
  for (int i = 0; i < PLANE; i++)
    for (int c = 0; c < CHANNELS; c++) state[i][c] = 0.f;
  for (int64_t tile = 0; tile < ends - 1; tile++) {
    int64_t left = tile % tile_width * TILE, top = tile / tile_width * TILE;
    for (int64_t y = 0; y < mini(TILE, h - top); y++)
      for (int64_t x = 0; x < mini(TILE, w - left); x++)
        for (int c = 0; c < CHANNELS; c++)
          state[y * TILE + x][c] = image[((top + y) * w + left + x) * CHANNELS + c];
    for (int64_t i = isect_offsets[tile]; i < isect_offsets[tile + 1]; i++) {
      float own[CHANNELS] = {0};
      for (int64_t e = starts[i]; e < starts[i + 1]; e++)
        for (int c = 0; c < CHANNELS; c++) own[c] += weights[e] * state[lanes[e]][c];
      for (int c = 0; c < CHANNELS; c++) sums[CHANNELS * (int64_t)flatten_ids[i] + c] += own[c];
    }
  }
  return 0;
}
