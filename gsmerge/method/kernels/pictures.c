// Filter and sample float32 pictures [height,width,channels].
#include "bilinear.h"

// The pixel at index i of a row of n pixels, which is mirrored at both ends without repeating the last pixel.
static inline int64_t mirrored(int64_t i, int64_t n) {
  while (i < 0 || i >= n) {
    i = i < 0 ? -i : 2 * (n - 1) - i;
    if (n == 1) return 0;
  }
  return i;
}

// Write to[i] = sum of taps[t] from[i + t stride], thirty-two values at a time, so that sums stay in registers.
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

// Convolve a picture with a filter along its rows and another along its columns, both of odd lengths. `padded` is room
// for a row with mirrored ends, and `rows` for the result of the first filter, with mirrored rows above and below.
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

// Interpolate a picture bilinearly at (x, y) in pixels; the centres of pixels are at whole numbers.
API int32_t sample_picture(const float *restrict picture, const float *restrict x,
                           const float *restrict y, float *restrict out, int64_t height,
                           int64_t width, int64_t channels, int64_t n) {
  if (height == 0 || width == 0) return n == 0 ? 0 : OUTSIDE;
  for (int64_t i = 0; i < n; i++)
    sample_at(picture, x[i], y[i], height, width, channels, out + i * channels);
  return 0;
}

enum { PLANES = 4 };  // means over a window: of x, y, x x + y y and x y

// Write the numbers of a row of both pictures whose means over windows are needed. Products are separate statements, so
// that each is rounded by itself.
static void multiply_row(const float *restrict x, const float *restrict y, float *restrict squares,
                         float *restrict products, int64_t n) {
  for (int64_t i = 0; i < n; i++) {
    float xx = x[i] * x[i], yy = y[i] * y[i], xy = x[i] * y[i];
    squares[i] = xx + yy;
    products[i] = xy;
  }
}

// Write the similarities of the windows of a row, from their means.
static void compare_row(const float *restrict means, float c1, float c2, float *restrict out, int64_t n) {
  for (int64_t i = 0; i < n; i++) {
    float ux = means[i], uy = means[n + i], uxx = ux * ux, uyy = uy * uy, uxy = ux * uy;
    float variances = means[2 * n + i] - uxx, covariance = means[3 * n + i] - uxy;
    variances = variances - uyy;
    ux = ux + 0.5f, uy = uy + 0.5f;  // because the pictures are centred at 0
    float twice = 2.f * ux, mean = twice * uy, related = 2.f * covariance;
    float over = mean + c1, by = related + c2, above = over * by;
    float xx = ux * ux, yy = uy * uy, lengths = xx + yy;
    lengths = lengths + c1;
    float spread = variances + c2, below = lengths * spread;
    out[i] = above / below;
  }
}

API int32_t compare_windows(const float *restrict x, const float *restrict y, const float *restrict taps, float c1,
                            float c2, float *restrict row, float *restrict across, float *restrict means,
                            float *restrict out, int64_t height, int64_t width, int64_t channels, int64_t size,
                            int64_t room, int64_t rows, int64_t inner_width, int64_t inner_height) {
  int64_t whole = width * channels, n = inner_width * channels;
  if (inner_height != height - size + 1 || inner_width != width - size + 1 || size < 1 || inner_height < 1
      || inner_width < 1 || room != 2 * whole || rows != PLANES)
    return OUTSIDE;
  for (int64_t line = 0; line < height; line++) {
    const float *from[PLANES] = {x + line * whole, y + line * whole, row, row + whole};
    multiply_row(from[0], from[1], row, row + whole, whole);
    for (int p = 0; p < PLANES; p++) weigh(from[p], taps, size, channels, across + (p * height + line) * n, n);
  }
  for (int64_t line = 0; line < inner_height; line++) {
    for (int p = 0; p < PLANES; p++) weigh(across + (p * height + line) * n, taps, size, n, means + p * n, n);
    compare_row(means, c1, c2, out + line * n, n);
  }
  return 0;
}
