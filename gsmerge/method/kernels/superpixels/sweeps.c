// Move border pixels between regions, with exact costs.
#include "labels.h"

enum { NUM_PIXELS = 5, LEAVE, JOIN };  // columns of a region's row after its mean
static const int64_t ROW = 8;

API int64_t ring_mask(const int32_t *labels, int64_t y, int64_t x, int32_t label, int64_t rows,
                      int64_t columns) {
  if (y < 1 || x < 1 || y >= rows - 1 || x >= columns - 1) return -OUTSIDE;
  return ring_of(labels + y * columns + x, columns, label);
}

// Squared distance of the feature of a pixel from the mean of a region.
static inline float distance(const float *row, const float *feature) {
  float d0 = feature[0] - row[0], d1 = feature[1] - row[1], d2 = feature[2] - row[2];
  float d3 = feature[3] - row[3], d4 = feature[4] - row[4];
  return d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4;
}

// Add a pixel to a region (sign 1) or remove it (sign -1), and update the mean.
static inline void shift(float *row, float sign, const float *feature) {
  float num_pixels = row[NUM_PIXELS] + sign, step = sign / num_pixels;
  row[NUM_PIXELS] = num_pixels;
  row[LEAVE] = num_pixels / (num_pixels - 1);
  row[JOIN] = num_pixels / (num_pixels + 1);
  for (int i = 0; i < 5; i++) row[i] += step * (feature[i] - row[i]);
}

// The label with the least cost for a pixel, among its own and those of its neighbours.
static inline int32_t best_label(const int32_t *place, int64_t columns, const float *rows,
                                 const float *feature) {
  const int32_t own = place[0], around[4] = {place[-columns], place[1], place[columns], place[-1]};
  int32_t label = own;
  float best = distance(rows + ROW * own, feature) * rows[ROW * own + LEAVE];
  for (int i = 0; i < 4; i++) {
    int32_t other = around[i];
    if (other < 0 || other == own || other == label) continue;
    float cost = distance(rows + ROW * other, feature) * rows[ROW * other + JOIN];
    if (cost < best) {
      best = cost;
      label = other;
    }
  }
  return label;
}

API int64_t sweep(int32_t *labels, const float *pixels, float *rows, const uint8_t *table,
                  float spread, int32_t backward, int64_t padded_height, int64_t padded_width,
                  int64_t height, int64_t width, int64_t count) {
  if (!labels_fit(labels, padded_height, padded_width, height, width, count)) return -OUTSIDE;
  int64_t num_moved = 0, ahead = backward ? -1 : 1;
  for (int64_t step_y = 0; step_y < height; step_y++) {
    int64_t y = backward ? height - 1 - step_y : step_y, x = backward ? width - 1 : 0;
    int32_t *line = labels + (y + 1) * padded_width + 1;
    for (int64_t step_x = 0; step_x < width; step_x++, x += ahead) {
      int32_t *place = line + x, own = *place;
      if (is_inside(place, padded_width) || !table[ring_of(place, padded_width, own)]) continue;
      const float *pixel = pixels + 3 * (y * width + x);
      const float feature[5] = {pixel[0], pixel[1], pixel[2], spread * (float)y, spread * (float)x};
      int32_t label = best_label(place, padded_width, rows, feature);
      if (label == own) continue;
      *place = label;
      shift(rows + ROW * own, -1, feature);
      shift(rows + ROW * label, 1, feature);
      num_moved++;
    }
  }
  return num_moved;
}
