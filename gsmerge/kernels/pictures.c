// Filter and sample float32 pictures, channels last.
#include "bilinear.h"

// Place of index i in a row of n that is mirrored at both ends without repeating them.
static inline int64_t mirrored(int64_t i, int64_t n) {
  while (i < 0 || i >= n) {
    i = i < 0 ? -i : 2 * (n - 1) - i;
    if (n == 1) return 0;
  }
  return i;
}

// to[i] = sum of taps[t] from[i + t stride], thirty-two values at a time, so that sums stay in registers.
static void weigh(const float *restrict from, const float *restrict taps, int64_t count,
                  int64_t stride, float *restrict to, int64_t n) {
  int64_t i = 0;
  for (; i + 2 * LANES <= n; i += 2 * LANES) {
    v16f a = taps[0] * load(from + i), b = taps[0] * load(from + i + LANES);
    for (int64_t t = 1; t < count; t++) {
      a += taps[t] * load(from + i + t * stride);
      b += taps[t] * load(from + i + LANES + t * stride);
    }
    store(to + i, a);
    store(to + i + LANES, b);
  }
  for (; i < n; i++) {
    float a = taps[0] * from[i];
    for (int64_t t = 1; t < count; t++) a += taps[t] * from[i + t * stride];
    to[i] = a;
  }
}

// Convolves a picture [height,width,channels] with a filter along its rows and another along its
// columns; both have odd lengths. `padded` holds a row with mirrored ends; `rows` holds the result of
// the first filter, with mirrored rows above and below.
API int32_t filter_picture(const float *restrict picture, const float *restrict across,
                           const float *restrict down, float *restrict padded,
                           float *restrict rows, float *restrict out, int64_t height,
                           int64_t width, int64_t channels, int64_t taps_across, int64_t taps_down,
                           int64_t room, int64_t padded_height) {
  int64_t half = taps_across / 2, row = width * channels, middle = taps_down / 2;
  if (taps_across % 2 == 0 || taps_down % 2 == 0 || room < row + 2 * half * channels
      || padded_height != height + 2 * middle)
    return OUTSIDE;
  if (height == 0 || row == 0) return 0;
  for (int64_t y = -middle; y < height + middle; y++) {
    const float *from = picture + mirrored(y, height) * row;
    for (int64_t x = 0; x < half; x++)
      for (int64_t c = 0; c < channels; c++) {
        padded[x * channels + c] = from[mirrored(x - half, width) * channels + c];
        padded[(half + width + x) * channels + c] = from[mirrored(width + x, width) * channels + c];
      }
    for (int64_t i = 0; i < row; i++) padded[half * channels + i] = from[i];
    weigh(padded, across, taps_across, channels, rows + (y + middle) * row, row);
  }
  for (int64_t y = 0; y < height; y++)
    weigh(rows + y * row, down, taps_down, row, out + y * row, row);
  return 0;
}

// Samples a picture bilinearly at (x, y) in pixels; whole numbers are the centres of pixels.
API int32_t sample_picture(const float *restrict picture, const float *restrict x,
                           const float *restrict y, float *restrict out, int64_t height,
                           int64_t width, int64_t channels, int64_t n) {
  if (height == 0 || width == 0) return n == 0 ? 0 : OUTSIDE;
  for (int64_t i = 0; i < n; i++)
    sample_at(picture, x[i], y[i], height, width, channels, out + i * channels);
  return 0;
}
