// Compute the rows of the regions of a label picture.
#include "labels.h"

// The row of a region has its mean (three colours, y and x times spread), its number of pixels, and two columns for the
// algorithm that uses it
static const int64_t ROW = 8;

API int32_t region_rows(const int32_t *labels, const float *pixels, float spread, double *sums,
                        float *rows, int64_t padded_height, int64_t padded_width, int64_t height,
                        int64_t width, int64_t count, int64_t capacity) {
  if (capacity < count || !labels_fit(labels, padded_height, padded_width, height, width, count))
    return OUTSIDE;
  for (int64_t y = 0; y < height; y++) {
    const int32_t *line = labels + (y + 1) * padded_width + 1;
    for (int64_t x = 0; x < width; x++) {
      const float *pixel = pixels + 3 * (y * width + x);
      double *sum = sums + INT64_C(6) * line[x];
      sum[0] += pixel[0];
      sum[1] += pixel[1];
      sum[2] += pixel[2];
      sum[3] += (double)y;
      sum[4] += (double)x;
      sum[5] += 1;
    }
  }
  for (int64_t label = 0; label < count; label++) {
    const double *sum = sums + 6 * label;
    float *row = rows + ROW * label;
    for (int i = 0; i < 3; i++) row[i] = (float)(sum[i] / sum[5]);
    row[3] = (float)(spread * sum[3] / sum[5]);
    row[4] = (float)(spread * sum[4] / sum[5]);
    row[5] = (float)sum[5];
  }
  return 0;
}
