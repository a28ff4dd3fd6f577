// Pack Gaussians as the whole numbers of a page, each minus that of the row before; see page_rows.py.
#include "exp_log.h"

enum { LOOKS = 10, MOST_COLUMNS = 64 };  // columns before the harmonics, and most columns
enum { BLOCK = 256 };                    // number of rows that are packed column by column, in loops that vectorise

typedef int32_t column[BLOCK + 1];  // a number of the row before a block, then the numbers of its rows

// The nearest whole number; halves are rounded to even numbers.
static inline double nearest(double x) {
  const double magic = 6755399441055744.0;  // 1.5 * 2^52
  return (x + magic) - magic;
}

// The nearest whole number from 0 to 255; halves are rounded up, NaN gives 0.
static inline int32_t to_byte(double x) {
  x += 0.5;
  x = x > 0.0 ? x : 0.0;
  return (int32_t)(x < 255.0 ? x : 255.0);
}

// The difference of a number from the number before, with the sign in the lowest bit.
static inline uint32_t step_from(int32_t before, int32_t now) {
  uint32_t by = (uint32_t)now - (uint32_t)before;
  return (by << 1) ^ (by >> 31 ? UINT32_MAX : 0);
}

// Write the differences of a row from the row before, which it replaces.
static inline void put(const int32_t *row, int32_t *before, uint32_t *out, int64_t i, int64_t m, int64_t columns) {
  for (int64_t c = 0; c < columns; c++) {
    out[c * m + i] = step_from(before[c], row[c]);
    before[c] = row[c];
  }
}

static inline double dot3(const double *a, double x, double y, double z) { return (a[0] * x + a[1] * y) + a[2] * z; }

static inline void gather(const int64_t *restrict rows, const float *restrict values, int64_t width, int64_t count,
                          double *restrict out) {
  for (int64_t i = 0; i < count; i++) out[i] = values[width * rows[i]];
}

// Pack opacities. Products and sums are separate statements, so that they are rounded as in NumPy.
static void pack_opacities(const double *restrict opacities, int32_t step, int64_t count, int32_t *restrict out) {
  for (int64_t i = 0; i < count; i++) {
    double opacity = 255.0 * opacities[i];
    out[i] = (int32_t)nearest((double)to_byte(opacity) / step);
  }
}

static void pack_colors(const double *restrict harmonics, double sh_scale, double color_scale, int32_t step,
                        int64_t count, int32_t *restrict out) {
  for (int64_t i = 0; i < count; i++) {
    double harmonic = sh_scale * harmonics[i], color = 0.5 + harmonic;
    double share = color_scale * (color - 0.5) / sh_scale, level = 255.0 * (share + 0.5);
    out[i] = (int32_t)nearest((double)to_byte(level) / step);
  }
}

static void pack_scales(const double *restrict scales, int32_t step, int64_t count, int32_t *restrict out) {
  for (int64_t i = 0; i < count; i++) {
    double size = log8(scales[i]);
    size = size > -30.0 ? size : -30.0;
    size = 16.0 * ((size < 30.0 ? size : 30.0) + 10.0);
    out[i] = (int32_t)nearest((double)to_byte(size) / step);
  }
}

static void pack_turns(const int64_t *restrict rows, const float *restrict quats, double levels, int64_t count,
                       column *restrict out) {
  double parts[4][BLOCK], lengths[BLOCK];
  for (int64_t i = 0; i < count; i++) {
    const float *quat = quats + 4 * rows[i];
    float squares[4];
    for (int c = 0; c < 4; c++) squares[c] = quat[c] * quat[c];
    lengths[i] = sqrtf4(((squares[0] + squares[1]) + squares[2]) + squares[3]);
    for (int c = 0; c < 4; c++) parts[c][i] = quat[c];
  }
  for (int64_t i = 0; i < count; i++) {
    double sign = parts[0][i] < 0.0 ? -1.0 : 1.0, length = sign * (lengths[i] > 1e-12 ? lengths[i] : 1e-12);
    double w = parts[0][i] / length;
    for (int c = 0; c < 3; c++) out[c][1 + i] = (int32_t)nearest(levels * (parts[1 + c][i] / length / (1.0 + w)));
  }
}

static void pack_harmonics(const double *restrict values, int32_t step, int64_t count, int32_t *restrict out) {
  for (int64_t i = 0; i < count; i++) {
    double harmonic = values[i] > -2.0 ? values[i] : -2.0;
    int32_t value = (int32_t)nearest(128.0 * (harmonic < 2.0 ? harmonic : 2.0)) + 128 + step / 2;
    value = (value - (value & (step - 1)));
    value = value > 0 ? value : 0;
    out[i] = value < 255 ? value : 255;
  }
}

// Write the differences of a column from row to row, and keep its last number for the next block.
static void put_column(int32_t *restrict numbers, int64_t count, uint32_t *restrict out) {
  for (int64_t i = 0; i < count; i++) out[i] = step_from(numbers[i], numbers[1 + i]);
  numbers[0] = numbers[count];
}

API int32_t pack_looks(const int64_t *rows, const float *opacities, const float *sh0, const float *scales,
                       const float *quats, const float *shN, double sh_scale, double color_scale, const int32_t *steps,
                       double levels, uint32_t *out, int64_t m, int64_t n, int64_t stored, int64_t columns) {
  column looks[MOST_COLUMNS];
  double values[BLOCK];
  if (columns > MOST_COLUMNS || columns > LOOKS + stored) return OUTSIDE;
  (void)n;
  for (int64_t c = 0; c < columns; c++) looks[c][0] = 0;
  for (int64_t first = 0; first < m; first += BLOCK) {
    const int64_t *block = rows + first, count = m - first < BLOCK ? m - first : BLOCK;
    gather(block, opacities, 1, count, values);
    pack_opacities(values, steps[0], count, looks[0] + 1);
    for (int c = 0; c < 3; c++) {
      gather(block, sh0 + c, 3, count, values);
      pack_colors(values, sh_scale, color_scale, steps[1], count, looks[1 + c] + 1);
      gather(block, scales + c, 3, count, values);
      pack_scales(values, steps[2], count, looks[4 + c] + 1);
    }
    for (int64_t i = 1; i <= count; i++) {  // red and blue are stored as differences from green, which are small
      looks[1][i] -= looks[2][i];
      looks[3][i] -= looks[2][i];
    }
    pack_turns(block, quats, levels, count, looks + 7);
    for (int64_t k = 0; k < columns - LOOKS; k++) {
      gather(block, shN + k, stored, count, values);
      pack_harmonics(values, k < 9 ? 8 : 16, count, looks[LOOKS + k] + 1);
    }
    for (int64_t c = 0; c < columns; c++) put_column(looks[c], count, out + c * m + first);
  }
  return 0;
}

API int64_t pack_pixels(const int64_t *rows, const int64_t *ids, const float *means, const double *viewmats,
                        const double *Ks, int64_t width, int64_t height, double pixel_parts, double depth_parts,
                        uint32_t *out, int64_t m, int64_t n, int64_t views) {
  int32_t row[4], before[4] = {0};
  (void)n;
  for (int64_t i = 0; i < m; i++) {
    int64_t id = ids[rows[i]], view = id / (width * height), pixel = id % (width * height);
    if (id < 0 || view >= views) return i;
    const double *pose = viewmats + 16 * view, *K = Ks + 9 * view;
    const float *mean = means + 3 * rows[i];
    double seen[3], image[3];
    for (int c = 0; c < 3; c++) seen[c] = dot3(pose + 4 * c, mean[0], mean[1], mean[2]) + pose[4 * c + 3];
    for (int c = 0; c < 3; c++) image[c] = dot3(K + 3 * c, seen[0], seen[1], seen[2]);
    if (!(image[2] > 0.0)) return i;
    double right = image[0] / image[2] - ((double)(pixel % width) + 0.5);
    double down = image[1] / image[2] - ((double)(pixel / width) + 0.5);
    row[0] = (int32_t)id;
    row[1] = (int32_t)nearest(pixel_parts * right);
    row[2] = (int32_t)nearest(pixel_parts * down);
    row[3] = (int32_t)nearest(depth_parts * log8(image[2]));
    put(row, before, out, i, m, 4);
  }
  return m;
}
