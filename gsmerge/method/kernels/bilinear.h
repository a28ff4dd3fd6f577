// Interpolate bilinearly in a float32 picture [height,width,channels].
#pragma once
#include "native.h"

// The two pixels of a row next to a coordinate, and the share of the second one. Outside, the last pixel counts for
// both.
typedef struct {
  int64_t first, second;
  float share;
} between;

static inline between neighbours(float x, int64_t n) {
  float last = (float)(n - 1);
  x = x > 0.f ? x : 0.f;  // NaN also becomes 0
  x = x < last ? x : last;
  int64_t first = mini((int64_t)x, n - 1);
  return (between){first, mini(first + 1, n - 1), x - (float)first};
}

// Write the channels of a picture at (x, y) in pixels; the centres of pixels are at whole numbers.
static inline void sample_at(const float *restrict picture, float x, float y, int64_t height, int64_t width,
                             int64_t channels, float *restrict out) {
  between h = neighbours(x, width), v = neighbours(y, height);
  const float *top = picture + v.first * width * channels, *bottom = picture + v.second * width * channels;
  for (int64_t c = 0; c < channels; c++) {
    float a = top[h.first * channels + c], b = top[h.second * channels + c];
    float d = bottom[h.first * channels + c], e = bottom[h.second * channels + c];
    float above = a + h.share * (b - a), below = d + h.share * (e - d);
    out[c] = above + v.share * (below - above);
  }
}
