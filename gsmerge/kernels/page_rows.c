// Gaussians as the whole numbers of a page, each less that of the row before; see page_rows.py.
#include "exp_log.h"

enum { LOOKS = 10, MOST_COLUMNS = 64 };  // columns before the harmonics, and of all

// Rounds halves to even numbers.
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

// Writes the differences of a row from the one before, their signs as lowest bits.
static inline void put(const int32_t *row, int32_t *before, uint32_t *out, int64_t i, int64_t m, int64_t columns) {
  for (int64_t c = 0; c < columns; c++) {
    uint32_t by = (uint32_t)row[c] - (uint32_t)before[c];
    out[c * m + i] = (by << 1) ^ (by >> 31 ? UINT32_MAX : 0);
    before[c] = row[c];
  }
}

static inline double dot3(const double *a, double x, double y, double z) { return (a[0] * x + a[1] * y) + a[2] * z; }

// Products and sums are statements of their own, so that they are rounded as NumPy rounds them.
API int32_t pack_looks(const int64_t *rows, const float *opacities, const float *sh0, const float *scales,
                       const float *quats, const float *shN, double sh_scale, double color_scale, const int32_t *steps,
                       double levels, uint32_t *out, int64_t m, int64_t n, int64_t stored, int64_t columns) {
  int32_t row[MOST_COLUMNS] = {0}, before[MOST_COLUMNS] = {0};
  if (columns > MOST_COLUMNS || columns > LOOKS + stored) return OUTSIDE;
  (void)n;
  for (int64_t i = 0; i < m; i++) {
    int64_t g = rows[i];
    double opacity = 255.0 * opacities[g];
    row[0] = (int32_t)nearest((double)to_byte(opacity) / steps[0]);
    for (int c = 0; c < 3; c++) {
      double harmonic = sh_scale * sh0[3 * g + c], color = 0.5 + harmonic;
      double share = color_scale * (color - 0.5) / sh_scale, level = 255.0 * (share + 0.5);
      row[1 + c] = (int32_t)nearest((double)to_byte(level) / steps[1]);
      double size = log8(scales[3 * g + c]);
      size = size > -30.0 ? size : -30.0;
      size = 16.0 * ((size < 30.0 ? size : 30.0) + 10.0);
      row[4 + c] = (int32_t)nearest((double)to_byte(size) / steps[2]);
    }
    row[1] -= row[2];  // from green, which says most of the others
    row[3] -= row[2];
    const float *quat = quats + 4 * g;
    float squares[4];
    for (int c = 0; c < 4; c++) squares[c] = quat[c] * quat[c];
    double length = sqrtf4(((squares[0] + squares[1]) + squares[2]) + squares[3]), sign = quat[0] < 0.f ? -1.0 : 1.0;
    length = sign * (length > 1e-12 ? length : 1e-12);
    double w = quat[0] / length;
    for (int c = 0; c < 3; c++) row[7 + c] = (int32_t)nearest(levels * (quat[1 + c] / length / (1.0 + w)));
    for (int64_t k = 0; k < columns - LOOKS; k++) {
      double harmonic = shN[stored * g + k];
      harmonic = harmonic > -2.0 ? harmonic : -2.0;
      int32_t step = k < 9 ? 8 : 16, value = (int32_t)nearest(128.0 * (harmonic < 2.0 ? harmonic : 2.0)) + 128 + step / 2;
      value = (value - (value & (step - 1)));
      value = value > 0 ? value : 0;
      row[LOOKS + k] = value < 255 ? value : 255;
    }
    put(row, before, out, i, m, columns);
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
