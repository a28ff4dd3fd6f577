// Take a step of the optimiser on all parameters of Gaussians.
//
// The fourteen parameters of a Gaussian are one vector: mean 3, log scale 3, quaternion 4, opacity logit 1, colour 3,
// and two unused lanes. Roots and exponentials of single numbers of a row are computed for all rows of a block
// together.
#include "exp_log.h"

enum { MEAN = 0, SIZE = 3, QUAT = 6, LOGIT = 10, COLOR = 11, COLUMNS = 14, BLOCK = 16 };
static const float MAX_LOGIT = 6.9f, MIN_LOGIT = -5.5f, MAX_COLOR = 1.05f, MIN_COLOR = -0.05f;
static const v16i OF_MEAN = {-1, -1, -1}, OF_SIZE = {0, 0, 0, -1, -1, -1};
static const v16i OF_QUAT = {0, 0, 0, 0, 0, 0, -1, -1, -1, -1};
static const v16i OF_LOGIT = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, -1};
static const v16i OF_COLOR = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, -1, -1, -1};

// Load a row as two overlapping halves, because the memory beside it belongs to other rows.
static inline v16f load_row(const float *p) {
  v8f low = *(const v8f *)p, high = *(const v8f *)(p + COLUMNS - 8);
  return PICK(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 12, 13, 14, 15, 15, 15);
}

static inline void store_row(float *p, v16f v) {
  *(v8f *)p = PICK(v, v, 0, 1, 2, 3, 4, 5, 6, 7);
  *(v8f *)(p + COLUMNS - 8) = PICK(v, v, 6, 7, 8, 9, 10, 11, 12, 13);
}

static inline v16f min16(v16f a, v16f b) { return sel(a < b, a, b); }
static inline v16f max16(v16f a, v16f b) { return sel(a > b, a, b); }

// The sum over the mean in each lane of the mean, and over the quaternion in each of its lanes; other lanes unchanged.
static inline v16f sum_groups(v16f v) {
  v16f z = {0};
  return (PICK(v, z, 0, 0, 0, 3, 4, 5, 6, 6, 6, 6, 10, 11, 12, 13, 14, 15) +
          PICK(v, z, 1, 1, 1, 16, 16, 16, 7, 7, 7, 7, 16, 16, 16, 16, 16, 16)) +
         (PICK(v, z, 2, 2, 2, 16, 16, 16, 8, 8, 8, 8, 16, 16, 16, 16, 16, 16) +
          PICK(v, z, 16, 16, 16, 16, 16, 16, 9, 9, 9, 9, 16, 16, 16, 16, 16, 16));
}

// The numbers that all rows of a step share.
typedef struct {
  v16f rates;  // learning rates, divided by the bias of first moments
  float beta1, beta2, second;  // decays of both moments, and the bias correction of second moments
  float mean_limit, size_limit, logit_limit, ratio_limit, long_limit;
  float opacity_reg, scale_reg;  // numbers added to the gradients of opacities, and of scales in units of a size
} Step;

static inline double power(double base, int64_t exponent) {
  double result = 1.0;
  for (; exponent > 0; exponent >>= 1, base *= base) result = exponent & 1 ? result * base : result;
  return result;
}

// A block of rows, with numbers that are computed for all of them together.
typedef struct {
  float rows[BLOCK][LANES], distance[BLOCK], length[BLOCK], unit[BLOCK], share[BLOCK];
  float visible[BLOCK * 4];  // scales and opacity
} Block;

// Update the moments and the parameters of a row with its gradient, without limits of the parameters.
static inline void move(Block *b, int64_t j, Step s, const float *x, const float *x0, float *m,
                        float *v) {
  v16f gradient = load(b->rows[j]), energy = gradient * gradient;
  // one second moment for the mean and one for the quaternion, which has three degrees of freedom
  energy = sel(OF_MEAN | OF_QUAT, sum_groups(energy) * (1.f / 3.f), energy);
  v16f first = s.beta1 * load_row(m) + (1.f - s.beta1) * gradient;
  v16f second = s.beta2 * load_row(v) + (1.f - s.beta2) * energy;
  store_row(m, first);
  store_row(v, second);
  v16f root;
  for (int c = 0; c < LANES; c++) root[c] = sqrtf4(second[c] * s.second);
  v16f ahead = s.beta1 * first + (1.f - s.beta1) * gradient;
  v16f step = s.rates * ahead / (root + 1e-15f);
  v16f moved = load_row(x) - sel(OF_MEAN, step * b->unit[j], step);
  v16f away = sel(OF_MEAN, moved - load_row(x0), moved), squares = sum_groups(away * away);
  b->distance[j] = squares[MEAN];
  b->length[j] = squares[QUAT];
  store(b->rows[j], moved);
}

// Compute the factors that bring the means of a block into their box, and the quaternions to length one.
static inline void confine_groups(Block *b, Step s) {
  for (int j = 0; j < BLOCK; j++) {
    float far = sqrtf4(b->distance[j]), reach = b->share[j] * s.mean_limit * b->unit[j];
    b->distance[j] = far > reach ? reach / far : 1.f;
    float square = b->length[j];
    b->length[j] = square > 0.f ? 1.f / sqrtf4(square) : 0.f;
  }
}

// Return a row with all limits: parameters inside the box about the start, scales of at least the least size, colours
// in their range, and a quaternion of length one.
static inline v16f confine(const Block *b, int64_t j, Step s, v16f x0, float least) {
  const float inf = __builtin_inff();
  v16f x = load(b->rows[j]);
  v16f reach = sel(OF_SIZE, splat(b->share[j] * s.size_limit),
                   sel(OF_LOGIT, splat(s.logit_limit), splat(inf)));
  v16f low = sel(OF_COLOR, min16(splat(MIN_COLOR), x0), x0 - reach);
  v16f high = sel(OF_COLOR, max16(splat(MAX_COLOR), x0), x0 + reach);
  v16f floor = sel(OF_SIZE, splat(least), sel(OF_LOGIT, splat(MIN_LOGIT), splat(-inf)));
  v16f ceiling = sel(OF_LOGIT, splat(MAX_LOGIT), splat(inf));
  v16f inside = min16(ceiling, max16(floor, min16(high, max16(low, x))));
  v16f nearer = b->distance[j] < 1.f ? x0 + b->distance[j] * (x - x0) : x;
  return sel(OF_MEAN, nearer, sel(OF_QUAT, x * b->length[j], inside));
}

// Limit the largest scale to a multiple of the second one, or to a multiple of the least size if that is longer.
static inline v16f shorten(v16f x, Step s, float least) {
  float a = x[SIZE], b = x[SIZE + 1], c = x[SIZE + 2];
  float low = a < b ? a : b, high = a < b ? b : a, second = c < low ? low : c < high ? c : high;
  float wide = second + s.ratio_limit, most = least + s.long_limit;
  return sel(OF_SIZE, min16(x, splat(wide > most ? wide : most)), x);
}

// Convert gradients of the rasterizer to those of the optimiser's parameters, which are means in units of the
// Gaussian's size, log scales and logits.
static inline void gather(Block *b, int64_t j, Step s, const float *scale, float opacity,
                          const float *mean, const float *quat, const float *grad_scale,
                          float grad_opacity, const float *color) {
  float scale_reg = s.scale_reg / b->unit[j];
  for (int c = 0; c < 3; c++) b->rows[j][MEAN + c] = mean[c] * b->unit[j];
  for (int c = 0; c < 3; c++) b->rows[j][SIZE + c] = (grad_scale[c] + scale_reg) * scale[c];
  for (int c = 0; c < 4; c++) b->rows[j][QUAT + c] = quat[c];
  b->rows[j][LOGIT] = (grad_opacity + s.opacity_reg) * opacity * (1.f - opacity);
  for (int c = 0; c < 3; c++) b->rows[j][COLOR + c] = color[c];
}

// Begin to load a row, which may lie in two lines of the cache, before it is used.
static inline void fetch(int64_t at, const float *x, const float *x0, const float *m, const float *v) {
  const float *tables[4] = {x, x0, m, v};
  for (int k = 0; k < 4; k++) {
    __builtin_prefetch(tables[k] + at);
    __builtin_prefetch(tables[k] + at + COLUMNS - 1);
  }
}

API int32_t adam(float *restrict x, const float *restrict x0, float *restrict m, float *restrict v,
                 const float *restrict units, const float *restrict box_shares,
                 const float *restrict min_sizes, const uint8_t *restrict fixed,
                 const int32_t *restrict ids,
                 const float *restrict g_means, const float *restrict g_quats,
                 const float *restrict g_scales, const float *restrict g_opacities,
                 const float *restrict g_colors, const float *restrict rates,
                 const float *restrict limits, const float *restrict betas,
                 const float *restrict regs, int64_t step, int64_t first, int64_t last,
                 float *restrict means, float *restrict quats,
                 float *restrict scales, float *restrict opacities, float *restrict colors,
                 int64_t n, int64_t k) {
  if (any_outside(ids + first, last - first, n)) return OUTSIDE;
  (void)k;
  float first_share = (float)(1.0 - power(betas[0], step + 1));
  float second_share = (float)(1.0 - power(betas[1], step));
  Step s = {.rates = load_row(rates) / first_share,
            .beta1 = betas[0],
            .beta2 = betas[1],
            .second = 1.f / second_share,
            .mean_limit = limits[0],
            .size_limit = limits[1],
            .logit_limit = limits[2],
            .ratio_limit = limits[3],
            .long_limit = limits[4],
            .opacity_reg = regs[0],
            .scale_reg = regs[1]};
  Block b = {0};
  for (int64_t next = first; next < last;) {
    int64_t rows[BLOCK], gradients[BLOCK], size = 0;
    for (; next < last && size < BLOCK; next++) {
      rows[size] = ids[next];
      gradients[size] = next;
      size += !fixed[ids[next]];
    }
    for (int64_t k = next; k < mini(next + BLOCK, last); k++) fetch(COLUMNS * (int64_t)ids[k], x, x0, m, v);
    for (int64_t j = 0; j < size; j++) {
      int64_t i = rows[j], g = gradients[j];
      b.unit[j] = units[i];
      b.share[j] = box_shares[i];
      gather(&b, j, s, scales + 3 * i, opacities[i], g_means + 3 * g, g_quats + 4 * g,
             g_scales + 3 * g, g_opacities[g], g_colors + 3 * g);
    }
    for (int64_t j = 0; j < size; j++) {
      int64_t at = COLUMNS * rows[j];
      move(&b, j, s, x + at, x0 + at, m + at, v + at);
    }
    confine_groups(&b, s);
    for (int64_t j = 0; j < size; j++) {
      int64_t i = rows[j];
      v16f row = shorten(confine(&b, j, s, load_row(x0 + COLUMNS * i), min_sizes[i]), s, min_sizes[i]);
      store_row(x + COLUMNS * i, row);
      for (int c = 0; c < 3; c++) means[3 * i + c] = row[MEAN + c];
      for (int c = 0; c < 4; c++) quats[4 * i + c] = row[QUAT + c];
      for (int c = 0; c < 3; c++) colors[3 * i + c] = row[COLOR + c];
      for (int c = 0; c < 3; c++) b.visible[4 * j + c] = row[SIZE + c];
      b.visible[4 * j + 3] = -row[LOGIT];
    }
    for (int q = 0; q < 4 * BLOCK; q++) b.visible[q] = exp4(b.visible[q]);
    for (int64_t j = 0; j < size; j++) {
      for (int c = 0; c < 3; c++) scales[3 * rows[j] + c] = b.visible[4 * j + c];
      opacities[rows[j]] = 1.f / (1.f + b.visible[4 * j + 3]);
    }
  }
  return 0;
}
