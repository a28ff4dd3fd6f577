// Compute the gradient of the fit's image loss: the L1 error, structural similarity by sums over windows, and the L1
// error of differences between neighbouring pixels.
//
// Rows are processed in groups of four, which begin at multiples of four, wherever a range begins.
// Sums over seven rows share their common terms and are always added up in the same order. A group is
// summed down its columns, then along its rows, a chunk at a time, so that the sums stay in the first
// cache.
#include "native.h"

enum { RADIUS = 3, PAD = 3 * RADIUS, GROUP = 4, TALL = GROUP + 2 * RADIUS };  // PAD is three pixels of three channels
enum {
  CHUNK = 96,
  LINE = CHUNK + 2 * PAD
};  // lengths of a chunk, which is of whole pixels and of whole vectors, and of a chunk with padding
// MEANS are the sums of x, y, x^2 + y^2 and xy. TERMS are the derivatives by the means of x, x^2 and xy.
enum { MEANS = 4, TERMS = 3 };
static const float C1 = 1e-4f, C2 = 9e-4f;  // constants of SSIM for values from 0 to 1
static const float SHARE = 1.f / 49.f;

// The numbers that all loops over groups use.
typedef struct {
  const float *image, *photo, *weight;
  int64_t height, width;  // width counts values, three for each pixel
  float plain, similar;
} Loss;

// From the values of ten rows, compute the sums over the seven rows around each of four rows. a3 to a6 are in all sums.
static inline void sum_seven(const float a[TALL], float sums[GROUP]) {
  float middle = (a[3] + a[4]) + (a[5] + a[6]), above = a[1] + a[2], below = a[7] + a[8];
  sums[0] = middle + (above + a[0]);
  sums[1] = middle + (above + a[7]);
  sums[2] = middle + (below + a[2]);
  sums[3] = middle + (below + a[9]);
}

// The sum of seven values of one channel along a row.
static inline float sum_along(const float *p) {
  return ((p[0] + p[3]) + (p[6] + p[9])) + ((p[12] + p[15]) + p[18]);
}

// Copy columns of the ten rows around a group; values outside the image are zero.
static inline void copy_rows(Loss l, const float *image, int64_t row, int64_t column, int64_t count,
                             float rows[TALL][CHUNK]) {
  for (int k = 0; k < TALL; k++) {
    int64_t y = row - RADIUS + k;
    int64_t left = y < 0 || y >= l.height ? 0 : mini(maxi(l.width - column, 0), count);
    for (int64_t i = 0; i < left; i++) rows[k][i] = image[y * l.width + column + i];
    for (int64_t i = left; i < count; i++) rows[k][i] = 0.f;
  }
}

// Append to the lines the sums down columns whose means are needed, from ten rows of image and photo.
static inline void sum_means(const float *restrict x, const float *restrict y, int64_t stride,
                             float (*restrict sums)[MEANS][LINE], int64_t count) {
  for (int64_t i = 0; i < count; i++) {
    float a[TALL], b[TALL], squares[TALL], products[TALL], s[MEANS][GROUP];
    for (int k = 0; k < TALL; k++) {
      a[k] = x[k * stride + i];
      b[k] = y[k * stride + i];
      squares[k] = a[k] * a[k] + b[k] * b[k];
      products[k] = a[k] * b[k];
    }
    sum_seven(a, s[0]);
    sum_seven(b, s[1]);
    sum_seven(squares, s[2]);
    sum_seven(products, s[3]);
    for (int row = 0; row < GROUP; row++)
      for (int q = 0; q < MEANS; q++) sums[row][q][LINE - count + i] = s[q][row];
  }
}

static inline void append_means(Loss l, int64_t row, int64_t column, float (*sums)[MEANS][LINE],
                                int64_t count) {
  bool inside = row >= RADIUS && row + GROUP + RADIUS <= l.height && column + CHUNK <= l.width;
  if (inside && count == CHUNK) {
    int64_t at = (row - RADIUS) * l.width + column;
    sum_means(l.image + at, l.photo + at, l.width, sums, CHUNK);
  } else {
    float x[TALL][CHUNK], y[TALL][CHUNK];
    copy_rows(l, l.image, row, column, count, x);
    copy_rows(l, l.photo, row, column, count, y);
    sum_means(x[0], y[0], CHUNK, sums, count);
  }
}

// Move the last columns of a chunk to the front of the lines, where the next chunk needs them.
static inline void slide(float *lines, int count) {
  for (int line = 0; line < count; line++)
    for (int i = 0; i < 2 * PAD; i++) lines[line * LINE + i] = lines[line * LINE + CHUNK + i];
}

// Write the weights of the pixels of a row from a column on, once for each channel; zero past the end. `count` is a
// number of values of whole pixels.
static inline void repeat_weights(Loss l, int64_t row, int64_t column, float *wide, int64_t count) {
  const float *weight = l.weight + row * (l.width / 3) + column / 3;
  int64_t left = mini(count, l.width - column) / 3;
  for (int64_t i = 0; i < count / 3; i++) {
    float w = i < left ? weight[i] : 0.f;
    for (int c = 0; c < 3; c++) wide[3 * i + c] = w;
  }
}

// Write the derivatives of the SSIM of a chunk of windows by the means of x, x^2 and xy, times the weights.
static inline void write_terms(const float (*restrict sums)[LINE], const float *restrict wide,
                               float *restrict terms, int64_t stride) {
  for (int i = 0; i < CHUNK; i++) {
    float a = SHARE * sum_along(sums[0] + i), b = SHARE * sum_along(sums[1] + i);
    float squares = SHARE * sum_along(sums[2] + i), products = SHARE * sum_along(sums[3] + i);
    float ab = a * b, both = a * a + b * b;
    float n1 = 2.f * ab + C1, n2 = 2.f * (products - ab) + C2;
    float d1 = both + C1, d2 = squares - both + C2;
    float q = 1.f / (d1 * d2), ssim = n1 * n2 * q, w = SHARE * wide[i];
    float square = -ssim * d1 * q, cross = 2.f * n1 * q;
    terms[i] = w * (2.f * (b * n2 - a * ssim * d2) * q - 2.f * a * square - b * cross);
    terms[stride + i] = w * square;
    terms[2 * stride + i] = w * cross;
  }
}

// Write the terms of a group of rows, [GROUP,TERMS,room], which are zero outside the image.
static void fill_terms(Loss l, int64_t row, float *terms, int64_t room) {
  float sums[GROUP][MEANS][LINE] = {{{0}}}, wide[CHUNK];
  if (row + GROUP <= 0 || row >= l.height) {
    for (int64_t i = 0; i < GROUP * TERMS * room; i++) terms[i] = 0.f;
    return;
  }
  // the first columns count as the end of a chunk before the image
  append_means(l, row, 0, sums, PAD);
  for (int64_t column = 0; column < l.width; column += CHUNK) {
    slide(sums[0][0], GROUP * MEANS);
    append_means(l, row, column + PAD, sums, CHUNK);
    for (int k = 0; k < GROUP; k++) {
      float *to = terms + k * TERMS * room + column;
      if (row + k < 0 || row + k >= l.height) continue;
      repeat_weights(l, row + k, column, wide, CHUNK);
      write_terms(sums[k], wide, to, room);
    }
  }
  for (int k = 0; k < GROUP; k++)
    for (int q = 0; q < TERMS; q++) {
      bool inside = row + k >= 0 && row + k < l.height;
      float *line = terms + (k * TERMS + q) * room;
      for (int64_t i = inside ? l.width : 0; i < room; i++) line[i] = 0.f;
    }
}

// Append the sums down columns of a chunk of terms, from three groups of rows.
static inline void append_terms(const float *restrict before, const float *restrict group,
                                const float *restrict after, int64_t room,
                                float (*restrict sums)[TERMS][LINE], int64_t count) {
  int64_t row = TERMS * room;
  for (int q = 0; q < TERMS; q++)
    for (int64_t i = 0; i < count; i++) {
      const float *b = before + q * room + i, *g = group + q * room + i, *f = after + q * room + i;
      float s[GROUP], a[TALL] = {b[row],     b[2 * row], b[3 * row], g[0],   g[row],
                                 g[2 * row], g[3 * row], f[0],       f[row], f[2 * row]};
      sum_seven(a, s);
      for (int k = 0; k < GROUP; k++) sums[k][q][LINE - count + i] = s[k];
    }
}

// Write the gradient of a chunk of a row, and add its weighted squared errors lane by lane.
static inline void write_gradient(Loss l, const float (*restrict sums)[LINE],
                                  const float *restrict x, const float *restrict y,
                                  const float *restrict wide, float *restrict gradient,
                                  v16f *errors) {
  float squares[CHUNK];
  for (int i = 0; i < CHUNK; i++) {
    float difference = x[i] - y[i];
    float sign = difference > 0.f ? 1.f : difference < 0.f ? -1.f : 0.f;
    float by_mean = sum_along(sums[0] + i), by_square = sum_along(sums[1] + i);
    float by_product = sum_along(sums[2] + i);
    float slope = by_mean + 2.f * by_square * x[i] + by_product * y[i];
    gradient[i] = l.plain * wide[i] * sign - l.similar * slope;
    squares[i] = wide[i] * difference * difference;
  }
  for (int i = 0; i < CHUNK; i += LANES) *errors += load(squares + i);
}

// Write the gradient of the rows from first to last of a group, from its terms and those of the groups beside it.
static void fill_gradient(Loss l, int64_t row, int64_t first, int64_t last,
                          const float *const terms[3], int64_t room, float *gradient,
                          float *errors) {
  float sums[GROUP][TERMS][LINE] = {{{0}}}, wide[CHUNK];
  v16f squares[GROUP] = {{0}};
  append_terms(terms[0], terms[1], terms[2], room, sums, PAD);
  for (int64_t column = 0; column < l.width; column += CHUNK) {
    int64_t left = mini(CHUNK, l.width - column), ahead = column + PAD;
    slide(sums[0][0], GROUP * TERMS);
    append_terms(terms[0] + ahead, terms[1] + ahead, terms[2] + ahead, room, sums, CHUNK);
    for (int64_t y = maxi(first, row); y < mini(last, row + GROUP); y++) {
      int64_t at = y * l.width + column, k = y - row;
      repeat_weights(l, y, column, wide, CHUNK);
      if (left == CHUNK) {
        write_gradient(l, sums[k], l.image + at, l.photo + at, wide, gradient + at, squares + k);
        continue;
      }
      float image[CHUNK] = {0}, photo[CHUNK] = {0}, part[CHUNK];
      for (int64_t i = 0; i < left; i++) {
        image[i] = l.image[at + i];
        photo[i] = l.photo[at + i];
      }
      write_gradient(l, sums[k], image, photo, wide, part, squares + k);
      for (int64_t i = 0; i < left; i++) gradient[at + i] = part[i];
    }
  }
  for (int64_t y = maxi(first, row); y < mini(last, row + GROUP); y++)
    errors[y] = total(squares[y - row]);
}

// Write the differences of a row of the image from the photo, and the weights of its values, both followed by a pixel
// of weight zero. Rows outside the image also have weight zero.
static void fill_row(Loss l, int64_t row, float *restrict off, float *restrict wide) {
  if (row < 0 || row >= l.height) {
    for (int64_t j = 0; j < l.width + 3; j++) off[j] = wide[j] = 0.f;
    return;
  }
  const float *x = l.image + row * l.width, *y = l.photo + row * l.width;
  for (int64_t j = 0; j < l.width; j++) off[j] = x[j] - y[j];
  for (int c = 0; c < 3; c++) off[l.width + c] = 0.f;
  repeat_weights(l, row, 0, wide, l.width + 3);
}

// Write the gradients of pairs of values, which are the sign of the difference times the smaller weight. They are added
// to the first value of a pair and subtracted from the second.
static inline void pull(const float *off, const float *wide, const float *off2, const float *wide2,
                        float *restrict to, int64_t count) {
  for (int64_t i = 0; i < count; i++) {
    float least = minf(wide[i], wide2[i]), further = off[i] - off2[i];
    to[i] = further > 0.f ? least : further < 0.f ? -least : 0.f;
  }
}

// What the next row needs of the last row: differences, weights, and gradients of vertical pairs.
typedef struct {
  float *here, *below, *along, *before, *after;  // rows of length `room`; `here` and `below` are two rows each
  int64_t room;
  float each;
} Edges;

static Edges start_edges(Loss l, float each, int64_t first, float *rows, int64_t room) {
  Edges e = {rows, rows + 2 * room, rows + 4 * room, rows + 5 * room, rows + 6 * room, room, each};
  fill_row(l, first - 1, e.below, e.below + room);
  fill_row(l, first, e.here, e.here + room);
  pull(e.below, e.below + room, e.here, e.here + room, e.before, l.width);
  for (int c = 0; c < 3; c++) e.along[c] = 0.f;
  return e;
}

// Add the gradient of the L1 error of differences to a row, and go on to the next row.
static void add_edges(Loss l, Edges *e, int64_t row, float *restrict gradient) {
  float *here = e->here, *below = e->below, *restrict along = e->along;
  float *restrict before = e->before, *restrict after = e->after, *restrict to = gradient + row * l.width;
  fill_row(l, row + 1, below, below + e->room);
  pull(here, here + e->room, below, below + e->room, after, l.width);
  pull(here, here + e->room, here + 3, here + e->room + 3, along + 3, l.width);
  for (int64_t i = 0; i < l.width; i++)
    to[i] += e->each * ((along[i + 3] - along[i]) + (after[i] - before[i]));
  e->here = below;
  e->below = here;
  e->before = after;
  e->after = before;
}

// The first row of the group to which a row belongs. The row may lie above the image.
static inline int64_t group_of(int64_t row) { return (row + GROUP) / GROUP * GROUP - GROUP; }

API int32_t loss_gradient(const float *restrict image, const float *restrict photo,
                          const float *restrict weight, float ssim_lambda, float edge_weight,
                          int64_t first, int64_t last, float *restrict gradient,
                          float *restrict errors, float *restrict terms, float *restrict rows,
                          int64_t height, int64_t width, int64_t pixels, int64_t room) {
  if (width != 3 * pixels || room < (width + CHUNK - 1) / CHUNK * CHUNK + PAD) return OUTSIDE;
  float count = (float)(height * pixels);
  Loss l = {image, photo, weight, height, width, (1.f - ssim_lambda) / count, ssim_lambda / count};
  float *ring[3];
  for (int k = 0; k < 3; k++) ring[k] = terms + k * GROUP * TERMS * room;
  if (first == last) return 0;
  Edges edges = start_edges(l, edge_weight / count, first, rows, room);
  for (int64_t row = group_of(first - RADIUS); row <= group_of(last - 1) + GROUP; row += GROUP) {
    float *oldest = ring[0];
    ring[0] = ring[1];
    ring[1] = ring[2];
    ring[2] = oldest;
    fill_terms(l, row, ring[2], room);
    fill_gradient(l, row - GROUP, first, last, (const float *const *)ring, room, gradient, errors);
    if (edge_weight > 0.f)
      for (int64_t y = maxi(first, row - GROUP); y < mini(last, row); y++)
        add_edges(l, &edges, y, gradient);
  }
  return 0;
}
