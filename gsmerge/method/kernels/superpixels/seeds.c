// Measure how much like a corner each pixel of a picture is, choose seeds for superpixels, and grow regions of them.
#include "native.h"

// The line or column at index i of a picture with n lines or columns, which is mirrored about the first and the last
// one.
static inline int64_t mirror(int64_t i, int64_t n) {
  i = i < 0 ? -i : i;
  i = i < n ? i : 2 * (n - 1) - i;
  return i < 0 ? 0 : i;  // a single line is its own neighbour
}

// Fill the two columns beside a line of w values.
static inline void mirror_ends(float *line, int64_t width) {
  line[0] = line[1 + mirror(-1, width)];
  line[width + 1] = line[1 + mirror(width, width)];
}

// Write the products of Sobel's derivatives of a line, across and down.
static void multiply_slopes(const float *above, const float *here, const float *below, float *xx,
                            float *xy, float *yy, int64_t width) {
  for (int64_t x = 1; x <= width; x++) {
    float right = above[x + 1] + 2 * here[x + 1] + below[x + 1],
          left = above[x - 1] + 2 * here[x - 1] + below[x - 1];
    float down = below[x - 1] + 2 * below[x] + below[x + 1],
          up = above[x - 1] + 2 * above[x] + above[x + 1];
    float dx = (right - left) * (1 / 12.f), dy = (down - up) * (1 / 12.f);
    xx[x] = dx * dx;
    xy[x] = dx * dy;
    yy[x] = dy * dy;
  }
  mirror_ends(xx, width);
  mirror_ends(xy, width);
  mirror_ends(yy, width);
}

static inline float sum_around(const float *above, const float *here, const float *below,
                               int64_t x) {
  return (above[x - 1] + above[x] + above[x + 1]) + (here[x - 1] + here[x] + here[x + 1])
      + (below[x - 1] + below[x] + below[x + 1]);
}

API int32_t corner_response(const float *pixels, float *planes, float *response, int64_t height,
                            int64_t width, int64_t stride) {
  if (stride != width + 2) return OUTSIDE;
  int64_t plane = height * stride;
  float *grey = planes, *xx = grey + plane, *xy = xx + plane, *yy = xy + plane;
  if (width == 0) return 0;
  for (int64_t y = 0; y < height; y++) {
    const float *line = pixels + 3 * y * width;
    for (int64_t x = 0; x < width; x++)
      grey[y * stride + x + 1] =
          0.299f * line[3 * x] + 0.587f * line[3 * x + 1] + 0.114f * line[3 * x + 2];
    mirror_ends(grey + y * stride, width);
  }
  for (int64_t y = 0; y < height; y++) {
    int64_t above = mirror(y - 1, height) * stride, here = y * stride,
            below = mirror(y + 1, height) * stride;
    multiply_slopes(grey + above, grey + here, grey + below, xx + here, xy + here, yy + here,
                    width);
  }
  for (int64_t y = 0; y < height; y++) {
    int64_t above = mirror(y - 1, height) * stride, here = y * stride,
            below = mirror(y + 1, height) * stride;
    for (int64_t x = 1; x <= width; x++) {
      float a = 0.5f * sum_around(xx + above, xx + here, xx + below, x);
      float b = sum_around(xy + above, xy + here, xy + below, x);
      float c = 0.5f * sum_around(yy + above, yy + here, yy + below, x);
      response[y * width + x - 1] = maxf(a + c - sqrtf4((a - c) * (a - c) + b * b), 0);
    }
  }
  return 0;
}

// Shares of the error are separate products and sums, since fusing them would treat the two sides
// differently.
API int32_t dither(const double *density, double jitter, double *errors, uint8_t *seeds,
                   int64_t height, int64_t width, int64_t columns) {
  if (columns != width + 2) return OUTSIDE;
  uint32_t noise = 1;
  for (int64_t y = 0; y < height; y++) {
    double *here = errors + y % 2 * (width + 2), *below = errors + (y + 1) % 2 * (width + 2);
    int64_t ahead = y % 2 ? -1 : 1, x = y % 2 ? width - 1 : 0;
    for (int64_t i = 0; i < width + 2; i++) below[i] = 0;
    for (int64_t step = 0; step < width; step++, x += ahead) {
      noise = noise * 1664525u + 1013904223u;
      double share = density[y * width + x] + here[x + 1];
      double wave = jitter * ((double)(noise >> 8) / 16777216.0 - 0.5);
      bool seed = share > 0.5 + wave;
      double error = share - (seed ? 1.0 : 0.0);
      double parts[4] = {error * 0.4375, error * 0.1875, error * 0.3125, error * 0.0625};
      seeds[y * width + x] = seed;
      here[x + 1 + ahead] += parts[0];
      below[x + 1 - ahead] += parts[1];
      below[x + 1] += parts[2];
      below[x + 1 + ahead] += parts[3];
    }
  }
  return 0;
}

API int32_t voronoi(const int64_t *seeds, int32_t *queue, int32_t *labels, int64_t count,
                    int64_t places, int64_t height, int64_t width) {
  static const int32_t steps[4][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}};
  if (places < height * width + count) return OUTSIDE;
  int64_t tail = count;
  for (int64_t i = 0; i < height * width; i++) labels[i] = -1;
  for (int64_t label = 0; label < count; label++) {
    int64_t y = seeds[2 * label], x = seeds[2 * label + 1];
    if (y < 0 || x < 0 || y >= height || x >= width) return OUTSIDE;
    labels[y * width + x] = (int32_t)label;
    queue[2 * label] = (int32_t)y;
    queue[2 * label + 1] = (int32_t)x;
  }
  for (int64_t head = 0; head < tail; head++) {
    int64_t y = queue[2 * head], x = queue[2 * head + 1];
    for (int i = 0; i < 4; i++) {
      int64_t next_y = y + steps[i][0], next_x = x + steps[i][1];
      if (next_y < 0 || next_y >= height || next_x < 0 || next_x >= width) continue;
      int32_t *label = labels + next_y * width + next_x;
      if (*label >= 0) continue;
      *label = labels[y * width + x];
      queue[2 * tail] = (int32_t)next_y;
      queue[2 * tail + 1] = (int32_t)next_x;
      tail++;
    }
  }
  return 0;
}
