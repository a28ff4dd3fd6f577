// Cut pictures by Bayesian adaptive superpixels: fit the parameters of regions, and change labels of pixels.
#include "exp_log.h"
#include "labels.h"

// Columns of the row of a region after its mean, which has three colours, x and y.
enum { XX = 5, XY, YY, LOG_DET };
static const int64_t ROW = 9;

typedef double v4d __attribute__((vector_size(32), aligned(8)));

// Pseudo-observations of the shape prior per pixel of a superpixel's expected area, and the weight of
// the Potts term.
static const double PRIOR_WEIGHT = 50;
static const float POTTS = 0.5f;

API int32_t fit_regions(const int32_t *labels, const float *colours, const double *areas,
                        double *sums, float *rows, int64_t padded_height, int64_t padded_width,
                        int64_t height, int64_t width, int64_t count) {
  if (!labels_fit(labels, padded_height, padded_width, height, width, count)) return OUTSIDE;
  for (int64_t y = 0; y < height; y++)
    for (int64_t x = 0; x < width; x++) {
      const float *colour = colours + 3 * (y * width + x);
      double *sum = sums + ROW * labels[(y + 1) * padded_width + x + 1];
      double across = (double)x, down = (double)y;
      // Four numbers at a time, because unaligned vectors of eight take longer
      *(v4d *)sum += (v4d){colour[0], colour[1], colour[2], across};
      *(v4d *)(sum + 4) += (v4d){down, across * across, across * down, down * down};
      sum[8] += 1;
    }
  for (int64_t label = 0; label < count; label++) {
    const double *sum = sums + ROW * label;
    float *row = rows + ROW * label;
    double n = sum[8], area = areas[label], mean_x = sum[3] / n, mean_y = sum[4] / n;
    for (int i = 0; i < 5; i++) row[i] = (float)(sum[i] / n);
    double weight = 1 / maxd(n + PRIOR_WEIGHT * area - 3, 1);
    double xx = (area * area + sum[XX] - n * mean_x * mean_x) * weight;
    double xy = (sum[XY] - n * mean_x * mean_y) * weight;
    double yy = (area * area + sum[YY] - n * mean_y * mean_y) * weight;
    double det = xx * yy - xy * xy;
    row[XX] = (float)(yy / det);
    row[XY] = (float)(-2 * xy / det);
    row[YY] = (float)(xx / det);
    row[LOG_DET] = (float)log8(det);
  }
  return 0;
}

// Twice the logarithm of the posterior of a label for a pixel, up to a constant. A pixel has three colours, x and y.
static inline float log_posterior(const float *row, const float *pixel, float num_foreign,
                                  float precision) {
  float d0 = pixel[0] - row[0], d1 = pixel[1] - row[1], d2 = pixel[2] - row[2];
  float dx = pixel[3] - row[3], dy = pixel[4] - row[4];
  float shape = (row[XX] * dx + row[XY] * dy) * dx + (row[YY] * dy) * dy;
  float colour = (d0 * d0 + d1 * d1 + d2 * d2) * precision,
        rest = row[LOG_DET] + POTTS * num_foreign;
  return -((colour + shape) + rest);
}

// The label with the highest posterior among those around a pixel; its own label if the pixel may not change.
static inline int32_t best_label(const int32_t *place, int64_t columns, const float *rows,
                                 const float *pixel, const uint8_t *table, const float *foreign,
                                 float precision) {
  const int32_t own = place[0], around[4] = {place[-columns], place[1], place[columns], place[-1]};
  int32_t label = own;
  uint32_t mask = ring_of(place, columns, own);
  if (!table[mask]) return own;
  float best = log_posterior(rows + ROW * own, pixel, foreign[mask], precision);
  for (int i = 0; i < 4; i++) {
    int32_t other = around[i];
    if (other < 0 || other == own || other == label) continue;
    mask = ring_of(place, columns, other);
    if (!table[mask]) return own;
    float score = log_posterior(rows + ROW * other, pixel, foreign[mask], precision);
    if (score > best) {
      best = score;
      label = other;
    }
  }
  return label;
}

API int64_t label_pass(int32_t *labels, const float *colours, const float *rows,
                       const uint8_t *table, const float *foreign, float precision,
                       int64_t padded_height, int64_t padded_width, int64_t height, int64_t width,
                       int64_t count) {
  if (!labels_fit(labels, padded_height, padded_width, height, width, count)) return -OUTSIDE;
  int64_t num_changed = 0;
  for (int grid = 0; grid < 4; grid++)
    for (int64_t y = grid / 2; y < height; y += 2)
      for (int64_t x = grid % 2; x < width; x += 2) {
        int32_t *place = labels + (y + 1) * padded_width + x + 1;
        if (is_inside(place, padded_width)) continue;
        const float *colour = colours + 3 * (y * width + x);
        const float pixel[5] = {colour[0], colour[1], colour[2], (float)x, (float)y};
        int32_t label = best_label(place, padded_width, rows, pixel, table, foreign, precision);
        if (label == *place) continue;
        *place = label;
        num_changed++;
      }
  return num_changed;
}
