// Evaluate the colours of Gaussians as seen from a point, and their gradients, by real spherical harmonics of degrees 0
// to 4.
//
// A Gaussian's coefficients are stored as red, green and blue of the first harmonic, then of the
// second, and so on. Fifteen coefficients at a time belong to five harmonics, whose values are
// repeated for the three colours.
#include "native.h"

enum { BLOCK = 32, BASES = 24, FIVE = 5, WIDE = 15, ROW = 40 };
static const float CONSTANT = 0.28209479177387814f;  // the harmonic of degree 0
static const float LINEAR = 0.4886025119029199f;  // the harmonics of degree 1 are this times a coordinate
static const v16i LANE = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

// A block of Gaussians as seen from the eye. A row has all harmonics of one Gaussian, and a plane has one harmonic of
// all Gaussians. The constant harmonic is in neither.
typedef struct {
  float x[BLOCK], y[BLOCK], z[BLOCK], inverse[BLOCK];  // direction, 1 / distance
  float planes[BASES][BLOCK], rows[BLOCK][ROW];
} Block;

// The degree that has this number of harmonics.
static inline int degree_of(int64_t num) {
  int degree = 0;
  while ((degree + 1) * (degree + 1) < num + 1) degree++;
  return degree;
}

// Compute the directions of listed Gaussians. Lanes past the size of the block repeat the last Gaussian.
static inline void look(Block *b, const float *means, const int32_t *ids, int64_t size,
                        const float *eye) {
  for (int j = 0; j < BLOCK; j++) {
    const float *mean = means + 3 * (int64_t)ids[mini(j, size - 1)];
    b->x[j] = mean[0] - eye[0];
    b->y[j] = mean[1] - eye[1];
    b->z[j] = mean[2] - eye[2];
  }
  for (int j = 0; j < BLOCK; j++) {
    float length = sqrtf4(b->x[j] * b->x[j] + b->y[j] * b->y[j] + b->z[j] * b->z[j]);
    float inverse = length > 0.f ? 1.f / length : 0.f;
    b->x[j] *= inverse;
    b->y[j] *= inverse;
    b->z[j] *= inverse;
    b->inverse[j] = inverse;
  }
}

// Compute the harmonics of a unit direction (Sloan 2013), with the signs and the order of the 3DGS layout.
static inline void basis_to_2(Block *b, int j, int degree) {
  float x = b->x[j], y = b->y[j], z = b->z[j], xx = x * x, yy = y * y, zz = z * z;
  b->planes[0][j] = -LINEAR * y;
  b->planes[1][j] = LINEAR * z;
  b->planes[2][j] = -LINEAR * x;
  if (degree < 2) return;
  b->planes[3][j] = 1.0925484305920792f * x * y;
  b->planes[4][j] = -1.0925484305920792f * y * z;
  b->planes[5][j] = 0.31539156525252005f * (2.f * zz - xx - yy);
  b->planes[6][j] = -1.0925484305920792f * x * z;
  b->planes[7][j] = 0.5462742152960396f * (xx - yy);
}

static inline void basis_3(Block *b, int j) {
  float x = b->x[j], y = b->y[j], z = b->z[j], xx = x * x, yy = y * y, zz = z * z;
  b->planes[8][j] = -0.5900435899266435f * y * (3.f * xx - yy);
  b->planes[9][j] = 2.890611442640554f * x * y * z;
  b->planes[10][j] = -0.4570457994644658f * y * (4.f * zz - xx - yy);
  b->planes[11][j] = 0.3731763325901154f * z * (2.f * zz - 3.f * xx - 3.f * yy);
  b->planes[12][j] = -0.4570457994644658f * x * (4.f * zz - xx - yy);
  b->planes[13][j] = 1.445305721320277f * z * (xx - yy);
  b->planes[14][j] = -0.5900435899266435f * x * (xx - 3.f * yy);
}

static inline void basis_4(Block *b, int j) {
  float x = b->x[j], y = b->y[j], z = b->z[j], xx = x * x, yy = y * y, zz = z * z;
  b->planes[15][j] = 2.5033429417967046f * x * y * (xx - yy);
  b->planes[16][j] = -1.7701307697799304f * y * z * (3.f * xx - yy);
  b->planes[17][j] = 0.9461746957575601f * x * y * (7.f * zz - 1.f);
  b->planes[18][j] = -0.6690465435572892f * y * z * (7.f * zz - 3.f);
  b->planes[19][j] = 0.10578554691520431f * (zz * (35.f * zz - 30.f) + 3.f);
  b->planes[20][j] = -0.6690465435572892f * x * z * (7.f * zz - 3.f);
  b->planes[21][j] = 0.47308734787878004f * (xx - yy) * (7.f * zz - 1.f);
  b->planes[22][j] = -1.7701307697799304f * x * z * (xx - 3.f * yy);
  b->planes[23][j] = 0.6258357354491761f * (xx * (xx - 3.f * yy) - yy * (3.f * xx - yy));
}

// Fill the rows of the first `count` harmonics of a block from its planes. `count` is a constant, so that loops unroll.
static inline __attribute__((always_inline)) void turn(Block *b, int count) {
  for (int j = 0; j < BLOCK; j++)
    for (int k = 0; k < count; k++) b->rows[j][k] = b->planes[k][j];
}

static inline void fill_rows(Block *b, int degree) {
  for (int j = 0; j < BLOCK; j++) basis_to_2(b, j, 1);
  if (degree < 2) return turn(b, 3);
  for (int j = 0; j < BLOCK; j++) basis_to_2(b, j, 2);
  if (degree < 3) return turn(b, 8);
  for (int j = 0; j < BLOCK; j++) basis_3(b, j);
  if (degree < 4) return turn(b, 15);
  for (int j = 0; j < BLOCK; j++) basis_4(b, j);
  turn(b, BASES);
}

// Values of five harmonics from a place in a row on, each repeated three times.
static inline v16f repeat(const float *row) {
  v16f v = load(row);
  return PICK(v, v, 0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 4);
}

// Load a vector, but with zeros from lane `left` on, because these belong to other rows or lie outside the array.
static inline v16f load_part(const float *p, const float *end, int64_t left) {
  if (end - p >= LANES) return sel(LANE < (int32_t)left, load(p), splat(0.f));
  v16f v = splat(0.f);
  for (int64_t q = 0; q < left && q < LANES; q++) v[q] = p[q];
  return v;
}

// Sums of the lanes of each colour, in the first three.
static inline v16f sum_colors(v16f v) {
  v16f two = v + PICK(v, v, 3, 4, 5, 3, 4, 5, 9, 10, 11, 9, 10, 11, 12, 13, 14, 15);
  v16f four = two + PICK(two, two, 6, 7, 8, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  return four + PICK(v, v, 12, 13, 14, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}

// Compute colours with at most three harmonics, which are too few for blocks.
static inline __attribute__((always_inline)) void
few_colors(const float *restrict means, const float *restrict sh0, const float *restrict shN,
           const int32_t *restrict ids, const float *restrict eye, int64_t first, int64_t last,
           int num, float *restrict colors) {
  for (int64_t i = first; i < last; i++) {
    int64_t g = ids[i];
    const float *mean = means + 3 * g, *base = sh0 + 3 * g, *rest = shN + 3 * num * g;
    float x = mean[0] - eye[0], y = mean[1] - eye[1], z = mean[2] - eye[2];
    float length = sqrtf4(x * x + y * y + z * z), scale = length > 0.f ? LINEAR / length : 0.f;
    float basis[3] = {-scale * y, scale * z, -scale * x};
    for (int c = 0; c < 3; c++) {
      float color = CONSTANT * base[c] + 0.5f;
      for (int k = 0; k < num; k++) color += basis[k] * rest[3 * k + c];
      colors[3 * i + c] = maxf(color, 0.f);
    }
  }
}

API int32_t view_colors(const float *restrict means, const float *restrict sh0,
                        const float *restrict shN, const int32_t *restrict ids,
                        const float *restrict eye, int64_t first, int64_t last,
                        float *restrict colors, int64_t n, int64_t num, int64_t m) {
  if (any_outside(ids + first, last - first, n) || num > BASES) return OUTSIDE;
  (void)m;
  int degree = degree_of(num);
  Block b = {0};
  const float *end = shN + 3 * num * n;
  switch (num) {
  case 0: few_colors(means, sh0, shN, ids, eye, first, last, 0, colors); return 0;
  case 1: few_colors(means, sh0, shN, ids, eye, first, last, 1, colors); return 0;
  case 2: few_colors(means, sh0, shN, ids, eye, first, last, 2, colors); return 0;
  case 3: few_colors(means, sh0, shN, ids, eye, first, last, 3, colors); return 0;
  }
  for (int64_t start = first; start < last; start += BLOCK) {
    int64_t size = mini(BLOCK, last - start);
    look(&b, means, ids + start, size, eye);
    fill_rows(&b, degree);
    for (int64_t j = 0; j < size; j++) {
      int64_t g = ids[start + j];
      v16f sum = splat(0.f);
      for (int64_t k = 0; k < num; k += FIVE)
        sum += load_part(shN + 3 * (num * g + k), end, 3 * (num - k)) * repeat(b.rows[j] + k);
      sum = sum_colors(sum);
      v4f color = {sh0[3 * g], sh0[3 * g + 1], sh0[3 * g + 2], 0.f};
      color = CONSTANT * color + PICK(sum, sum, 0, 1, 2, 3) + 0.5f;
      for (int c = 0; c < 3; c++) colors[3 * (start + j) + c] = maxf(color[c], 0.f);
    }
  }
  return 0;
}

typedef struct {
  float x, y, z;
} Slope;

// The gradient of a weighted sum of harmonics by the unit direction.
static inline Slope slope_to_2(const Block *b, int j, int degree) {
  const float a = 1.0925484305920792f;
  float x = b->x[j], y = b->y[j], z = b->z[j];
  Slope g = {-LINEAR * b->planes[2][j], -LINEAR * b->planes[0][j], LINEAR * b->planes[1][j]};
  if (degree < 2) return g;
  float w4 = b->planes[3][j], w5 = b->planes[4][j], w7 = b->planes[6][j];
  float w6 = 0.31539156525252005f * b->planes[5][j], w8 = 0.5462742152960396f * b->planes[7][j];
  g.x += a * (y * w4 - z * w7) + 2.f * x * (w8 - w6);
  g.y += a * (x * w4 - z * w5) - 2.f * y * (w8 + w6);
  g.z += 4.f * z * w6 - a * (y * w5 + x * w7);
  return g;
}

static inline Slope slope_3(const Block *b, int j) {
  float x = b->x[j], y = b->y[j], z = b->z[j];
  float xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z, flat = xx - yy;
  float w9 = 0.5900435899266435f * b->planes[8][j], w10 = 2.890611442640554f * b->planes[9][j];
  float w11 = 0.4570457994644658f * b->planes[10][j], w12 = 0.3731763325901154f * b->planes[11][j];
  float w13 = 0.4570457994644658f * b->planes[12][j], w14 = 1.445305721320277f * b->planes[13][j];
  float w15 = 0.5900435899266435f * b->planes[14][j];
  Slope g;
  g.x = yz * w10 + 2.f * xy * (w11 - 3.f * w9) - 6.f * xz * w12 + 2.f * xz * w14;
  g.x -= (4.f * zz - 3.f * xx - yy) * w13 + 3.f * flat * w15;
  g.y = xz * w10 + 2.f * xy * (w13 + 3.f * w15) - 6.f * yz * w12 - 2.f * yz * w14;
  g.y -= (4.f * zz - xx - 3.f * yy) * w11 + 3.f * flat * w9;
  g.z = xy * w10 - 8.f * (yz * w11 + xz * w13) + 3.f * (2.f * zz - xx - yy) * w12 + flat * w14;
  return g;
}

static inline Slope slope_4(const Block *b, int j) {
  float x = b->x[j], y = b->y[j], z = b->z[j], xx = x * x, yy = y * y, zz = z * z, xy = x * y;
  float w16 = 2.5033429417967046f * b->planes[15][j], w17 = 1.7701307697799304f * b->planes[16][j];
  float w18 = 0.9461746957575601f * b->planes[17][j], w19 = 0.6690465435572892f * b->planes[18][j];
  float w20 = 0.10578554691520431f * b->planes[19][j], w21 = 0.6690465435572892f * b->planes[20][j];
  float w22 = 0.47308734787878004f * b->planes[21][j], w23 = 1.7701307697799304f * b->planes[22][j];
  float w24 = 2.5033429417967046f * b->planes[23][j];
  float wide = 3.f * xx - yy, tall = xx - 3.f * yy, flat = xx - yy;
  float one = 7.f * zz - 1.f, three = 7.f * zz - 3.f;
  Slope g;
  g.x = y * wide * w16 - 6.f * xy * z * w17 + one * (y * w18 + 2.f * x * w22);
  g.x += x * tall * w24 - z * three * w21 - 3.f * z * flat * w23;
  g.y = x * tall * w16 + 6.f * xy * z * w23 + one * (x * w18 - 2.f * y * w22);
  g.y -= z * three * w19 + 3.f * z * flat * w17 + y * wide * w24;
  g.z = 14.f * z * (xy * w18 + flat * w22) - y * wide * w17 - x * tall * w23;
  g.z += 20.f * z * three * w20 - 3.f * one * (y * w19 + x * w21);
  return g;
}

// Write to x, y, z the gradients of the means, from the weights of the harmonics in the planes.
static inline void means_backward(Block *b, int j, int degree) {
  Slope g = slope_to_2(b, j, degree);
  if (degree > 2) {
    Slope more = slope_3(b, j);
    g = (Slope){g.x + more.x, g.y + more.y, g.z + more.z};
  }
  if (degree > 3) {
    Slope more = slope_4(b, j);
    g = (Slope){g.x + more.x, g.y + more.y, g.z + more.z};
  }
  // only the part perpendicular to the direction counts, divided by the distance
  float x = b->x[j], y = b->y[j], z = b->z[j], along = x * g.x + y * g.y + z * g.z;
  b->x[j] = (g.x - along * x) * b->inverse[j];
  b->y[j] = (g.y - along * y) * b->inverse[j];
  b->z[j] = (g.z - along * z) * b->inverse[j];
}

// Write the gradients of a Gaussian's coefficients. Replace its row by the weights of the harmonics, which are the
// coefficients times the gradient of the colour.
static inline void coefficients_backward(float *row, const float *shN, const float *end, v16f color,
                                         float *grad, const float *grad_end, int64_t num) {
  for (int64_t k = 0; k < num; k += FIVE) {
    int64_t left = 3 * (num - k);
    v16f slope = repeat(row + k) * color;
    if (grad_end - (grad + 3 * k) >= LANES)  // the lanes that follow are overwritten later
      store(grad + 3 * k, slope);
    else
      for (int64_t q = 0; q < left && q < WIDE; q++) grad[3 * k + q] = slope[q];
    v16f each = load_part(shN + 3 * k, end, left) * color;
    each += PICK(each, each, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 15) +
            PICK(each, each, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 15, 15);
    v16f sums = PICK(each, each, 0, 3, 6, 9, 12, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0);
    for (int q = 0; q < FIVE; q++) row[k + q] = sums[q];
  }
}

// A colour in all lanes of its channel.
static inline v16f repeat_color(const float *c) {
  return (v16f){c[0], c[1], c[2], c[0], c[1], c[2], c[0], c[1],
                c[2], c[0], c[1], c[2], c[0], c[1], c[2], 0.f};
}

API int32_t view_colors_backward(const float *restrict means, const float *restrict shN,
                                 const int32_t *restrict ids, const float *restrict eye,
                                 int64_t first, int64_t last, const float *restrict colors,
                                 const float *restrict grad_colors, float *restrict grad_sh0,
                                 float *restrict grad_shN, float *restrict grad_means, int64_t n,
                                 int64_t num, int64_t m) {
  if (any_outside(ids + first, last - first, n) || num > BASES) return OUTSIDE;
  (void)m;
  int degree = degree_of(num), all = (degree + 1) * (degree + 1) - 1;
  Block b = {0};
  for (int64_t q = 3 * first; q < 3 * last; q++) {
    grad_sh0[q] = CONSTANT * (colors[q] > 0.f ? grad_colors[q] : 0.f);
    grad_means[q] = 0.f;
  }
  for (int64_t start = first; num > 0 && start < last; start += BLOCK) {
    int64_t size = mini(BLOCK, last - start);
    look(&b, means, ids + start, size, eye);
    fill_rows(&b, degree);
    for (int64_t j = 0; j < size; j++) {
      int64_t i = start + j;
      const float *seen = colors + 3 * i;
      float color[3];
      for (int c = 0; c < 3; c++) color[c] = seen[c] > 0.f ? grad_colors[3 * i + c] : 0.f;
      coefficients_backward(b.rows[j], shN + 3 * num * ids[i], shN + 3 * num * n,
                            repeat_color(color), grad_shN + 3 * num * i, grad_shN + 3 * num * last,
                            num);
    }
    for (int j = 0; j < BLOCK; j++)
      for (int k = 0; k < all; k++) b.planes[k][j] = k < num ? b.rows[j][k] : 0.f;
    for (int j = 0; j < BLOCK; j++) means_backward(&b, j, degree);
    for (int64_t j = 0; j < size; j++) {
      grad_means[3 * (start + j)] = b.x[j];
      grad_means[3 * (start + j) + 1] = b.y[j];
      grad_means[3 * (start + j) + 2] = b.z[j];
    }
  }
  return 0;
}
