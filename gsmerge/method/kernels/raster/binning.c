// Sort Gaussians by depth, and append them to the lists of the tiles.
#include "exp_log.h"
#include "walk.h"

// with an upper bound of the transmittance below this, every pixel of a tile is opaque despite rounding
static const float CLOSED = 5e-5f;
static const float ROUNDING = 0.01f;  // tolerance for rounding errors of exponents

// most bits of a pass; most passes. 2048 counters and their streams fit the first caches
enum { DIGIT = 11, PASSES = 3 };

// Sort by radix, the least significant digit first. Only bits in which values differ are sorted, in as few passes as
// possible with about equal numbers of bits.
API void sort_bits(const uint32_t *bits, int32_t *order, uint64_t *keys, uint64_t *spare, int64_t m) {
  int64_t counts[PASSES][1 << DIGIT];
  if (m == 0) return;
  uint32_t low = bits[0], high = bits[0];
  for (int64_t i = 0; i < m; i++) {
    low = bits[i] < low ? bits[i] : low;
    high = bits[i] > high ? bits[i] : high;
  }
  int width = 1;
  while ((uint64_t)(high - low) >> width) width++;
  int passes = (width + DIGIT - 1) / DIGIT, digit = (width + passes - 1) / passes;
  uint32_t mask = (1u << digit) - 1;
  for (int p = 0; p < passes; p++)
    for (uint32_t j = 0; j <= mask; j++) counts[p][j] = 0;
  for (int64_t i = 0; i < m; i++) {
    uint32_t key = bits[i] - low;
    keys[i] = (uint64_t)key << 32 | (uint64_t)i;
    for (int p = 0; p < passes; p++) counts[p][(key >> (p * digit)) & mask]++;
  }
  for (int p = 0; p < passes; p++) {
    int64_t sum = 0;
    for (uint32_t j = 0; j <= mask; j++) {
      int64_t count = counts[p][j];
      counts[p][j] = sum;
      sum += count;
    }
    for (int64_t i = 0; i < m; i++) spare[counts[p][(keys[i] >> (32 + p * digit)) & mask]++] = keys[i];
    uint64_t *done = spare;
    spare = keys;
    keys = done;
  }
  for (int64_t i = 0; i < m; i++) order[i] = (int32_t)keys[i];
}

// Count the boxes over each tile, by marking the corners of boxes and taking running sums. Without a loop over the
// tiles of each box, no branch is mispredicted.
API int32_t count_boxes(const int16_t *boxes, int64_t tile_height, int64_t tile_width, int64_t *corners,
                        int64_t *counts, int64_t m, int64_t num_corners, int64_t tiles) {
  int64_t stride = tile_width + 1;
  uint64_t *marks = (uint64_t *)corners;  // unsigned, so that overflow is defined
  if (num_corners != (tile_height + 1) * stride || tiles != tile_height * tile_width) return OUTSIDE;
  for (int64_t i = 0; i < m; i++) {
    int64_t x0 = boxes[4 * i], x1 = boxes[4 * i + 1], y0 = boxes[4 * i + 2], y1 = boxes[4 * i + 3];
    if (x0 < 0 || y0 < 0 || x0 > x1 || y0 > y1 || x1 > tile_width || y1 > tile_height) return OUTSIDE;
    marks[y0 * stride + x0]++;
    marks[y0 * stride + x1]--;
    marks[y1 * stride + x0]--;
    marks[y1 * stride + x1]++;
  }
  for (int64_t line = 0; line < tile_height; line++) {
    uint64_t run = 0;
    for (int64_t column = 0; column < tile_width; column++) {
      int64_t tile = line * tile_width + column;
      run += marks[line * stride + column];
      counts[tile] = (int64_t)(run + (line > 0 ? (uint64_t)counts[tile - tile_width] : 0));
    }
  }
  return 0;
}

API int32_t deal_tiles(const int32_t *order, const int16_t *boxes, int64_t tile_width, int64_t *cursors,
                       int32_t *flatten_ids, int64_t m, int64_t tiles, int64_t intersections) {
  for (int64_t i = 0; i < m; i++) {
    int64_t x0 = boxes[4 * i], y0 = boxes[4 * i + 2], width = boxes[4 * i + 1] - x0, height = boxes[4 * i + 3] - y0;
    if (x0 < 0 || y0 < 0 || width <= 0 || height <= 0) continue;
    if (x0 + width > tile_width || (y0 + height) * tile_width > tiles) return OUTSIDE;
    int64_t tile = y0 * tile_width + x0, column = 0;
    // One loop for both axes, because most boxes have one or two tiles, and the end of each loop is mispredicted
    for (int64_t n = width * height; n > 0; n--) {
      uint64_t slot = (uint64_t)cursors[tile];
      if (slot >= (uint64_t)intersections) return OUTSIDE;
      flatten_ids[slot] = order[i];
      cursors[tile]++;
      column++;
      bool wrap = column == width;
      tile += wrap ? tile_width - width + 1 : 1;
      column = wrap ? 0 : column;
    }
  }
  return 0;
}

// A lower bound of a Gaussian's alpha in the pixels of the tile at (left, top). The exponent is concave, so it is least
// in a corner.
static inline float least_share(const float *conic, float left, float top) {
  float least = 0.f;
  for (int corner = 0; corner < 4; corner++) {
    float x = left + 0.5f + (corner & 1 ? TILE - 1 : 0) - conic[0], y = top + 0.5f + (corner & 2 ? TILE - 1 : 0) - conic[1];
    float across = conic[2] * (x - conic[3] * y), p = conic[5] - conic[4] * y * y - across * across - ROUNDING;
    if (!(p >= LN_CUT)) return 0.f;
    least = minf(least, p);
  }
  return minf(exp4(least), MAX_ALPHA);
}

API int32_t deal_open_tiles(const int32_t *order, const int16_t *boxes, const float *conics, int64_t tile_width,
                            int64_t first, int64_t last, float *left, int64_t *cursors, int32_t *flatten_ids, int64_t m,
                            int64_t tiles, int64_t intersections) {
  if (first < 0 || first > last || tile_width < 1 || last > tiles / tile_width) return OUTSIDE;
  int64_t open = (last - first) * tile_width;
  for (int64_t i = 0; i < m && open > 0; i++) {
    int64_t x0 = boxes[4 * i], x1 = boxes[4 * i + 1], y0 = maxi(first, boxes[4 * i + 2]), y1 = mini(last, boxes[4 * i + 3]);
    if (x0 < 0 || x1 > tile_width || (uint64_t)(int64_t)order[i] >= (uint64_t)m) return OUTSIDE;
    for (int64_t y = y0; y < y1; y++)
      for (int64_t x = x0; x < x1; x++) {
        int64_t tile = y * tile_width + x;
        if (left[tile] < CLOSED) continue;
        uint64_t slot = (uint64_t)cursors[tile];
        cursors[tile] = (int64_t)(slot + 1);
        if (intersections > 0 && slot >= (uint64_t)intersections) return OUTSIDE;
        if (intersections > 0) flatten_ids[slot] = order[i];
        left[tile] *= 1.f - least_share(conics + CONIC * (int64_t)order[i], (float)(x * TILE), (float)(y * TILE));
        open -= left[tile] < CLOSED;
      }
  }
  return 0;
}
