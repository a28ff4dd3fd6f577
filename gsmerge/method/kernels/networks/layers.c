// Compute the layers of the networks on tables of tokens. Every row is computed by itself, so the rest of the table
// does not matter.
#include "exp_log.h"

// this many rows use each weight that is loaded; their sums and the weight fit into sixteen AVX2 registers
enum { ROWS = 6 };
enum { GELU = 1, TANH = 2 };  // activations
enum { MOST_COLUMNS = 1 << 20 };

static inline v16f load_some(const float *p, int64_t count) {
  if (count >= LANES) return load(p);
  v16f v = {0};
  for (int64_t l = 0; l < count; l++) v[l] = p[l];
  return v;
}

static inline void store_some(float *p, v16f v, int64_t count) {
  if (count >= LANES) {
    store(p, v);
    return;
  }
  for (int64_t l = 0; l < count; l++) p[l] = v[l];
}

// x times the distribution function of the normal distribution (Hendrycks and Gimpel 2016).
static inline float gelu(float x) { return 0.5f * x * (1.f + erf4(0.70710678f * x)); }

// Compute up to ROWS rows from `first` on, for sixteen outputs from column j on.
static inline void dense_block(const float *restrict x, const float *restrict weight, const float *restrict residual,
                               v16f bias, float *restrict out, int64_t first, int64_t j, int64_t rows, int64_t inputs,
                               int64_t outputs) {
  const float *from[ROWS];
  v16f sum[ROWS];
  for (int r = 0; r < ROWS; r++) {
    from[r] = x + mini(first + r, rows - 1) * inputs;
    sum[r] = bias;
  }
  for (int64_t k = 0; k < inputs; k++) {
    v16f w = load(weight + k * LANES);
    for (int r = 0; r < ROWS; r++) sum[r] = sum[r] + splat(from[r][k]) * w;
  }
  for (int r = 0; r < mini(ROWS, rows - first); r++) {
    int64_t at = (first + r) * outputs + j;
    if (residual) sum[r] = sum[r] + load_some(residual + at, outputs - j);
    store_some(out + at, sum[r], outputs - j);
  }
}

// Write activation(x W + b + residual). The weights are in blocks of sixteen outputs, the last one padded with zeros.
API int32_t dense(const float *restrict x, const float *restrict weight, const float *restrict bias,
                  const float *restrict residual, int64_t activation, float *restrict out, int64_t rows, int64_t inputs,
                  int64_t blocks, int64_t outputs) {
  if (blocks != (outputs + LANES - 1) / LANES) return OUTSIDE;
  for (int64_t first = 0; first < rows; first += ROWS) {
    for (int64_t b = 0; b < blocks; b++)
      dense_block(x, weight + b * inputs * LANES, residual, load(bias + b * LANES), out, first, b * LANES, rows, inputs,
                  outputs);
    float *values = out + first * outputs;
    int64_t count = mini(ROWS, rows - first) * outputs;
    if (activation == GELU)
      for (int64_t i = 0; i < count; i++) values[i] = gelu(values[i]);
    if (activation == TANH)
      for (int64_t i = 0; i < count; i++) values[i] = values[i] == values[i] ? tanh4(values[i]) : 0.f;
  }
  return 0;
}

// Normalise rows to mean 0 and variance 1, and write them times gains plus shifts (Ba et al. 2016).
API void normalise(const float *restrict x, const float *restrict gains, const float *restrict shifts,
                   float *restrict out, int64_t rows, int64_t width) {
  for (int64_t i = 0; i < rows; i++) {
    const float *row = x + i * width;
    v16f sum = {0}, squares = {0};
    for (int64_t j = 0; j < width; j += LANES) sum += load_some(row + j, width - j);
    float mean = total(sum) / (float)width;
    for (int64_t j = 0; j < width; j += LANES) {
      v16f delta = load_some(row + j, width - j) - splat(mean);
      for (int64_t l = width - j; l < LANES; l++) delta[l] = 0.f;
      squares = squares + delta * delta;
    }
    v16f scale = splat(1.f / sqrtf4(total(squares) / (float)width + 1e-5f));
    for (int64_t j = 0; j < width; j += LANES) {
      v16f unit = (load_some(row + j, width - j) - splat(mean)) * scale;
      v16f result = unit * load_some(gains + j, width - j) + load_some(shifts + j, width - j);
      store_some(out + i * width + j, result, width - j);
    }
  }
}

typedef struct {
  int64_t heads, size, padded;  // number of heads, width of a head, and the same padded to whole vectors
  int64_t width, columns;  // width of the keys of all heads, and of keys and values
  int64_t tokens, room;  // number of tokens of a set, and the same padded to whole vectors
} Shape;

static inline float largest(v16f v) {
  float s[LANES];
  store(s, v);
  for (int half = LANES / 2; half; half >>= 1)
    for (int i = 0; i < half; i++) s[i] = maxf(s[i], s[i + half]);
  return s[0];
}

// Write the shares of all keys for a query in one head, by softmax before the division, and return their sum.
static inline float attention_shares(const float *restrict query, const float *restrict keys,
                                     const float *restrict hidden, float *restrict shares, const Shape *s) {
  v16f top = splat(-__builtin_inff()), sum = {0};
  float scale = 1.f / sqrtf4((float)s->size);
  for (int64_t n = 0; n < s->room; n += LANES) {
    v16f score = {0};
    for (int64_t d = 0; d < s->size; d++) score = score + splat(query[d]) * load(keys + d * s->room + n);
    score = score * splat(scale) + load(hidden + n);
    top = sel(score > top, score, top);
    store(shares + n, score);
  }
  float highest = largest(top);
  for (int64_t n = 0; n < s->room; n += LANES) {
    for (int l = 0; l < LANES; l++) shares[n + l] = exp4(shares[n + l] - highest);
    sum += load(shares + n);
  }
  return total(sum);
}

// Attend to one set. Its keys are transposed, so that sixteen of them are compared with a query at once.
static inline void attend_set(const float *restrict query, const float *restrict pairs, const uint8_t *restrict mask,
                              float *restrict scratch, float *restrict out, int64_t queries, const Shape *s) {
  float *keys = scratch, *hidden = keys + s->width * s->room, *shares = hidden + s->room;
  for (int64_t n = 0; n < s->room; n++) {
    bool there = n < s->tokens;
    hidden[n] = there && mask[n] ? 0.f : -__builtin_inff();
    for (int64_t c = 0; c < s->width; c++) keys[c * s->room + n] = there ? pairs[n * s->columns + c] : 0.f;
  }
  for (int64_t q = 0; q < queries; q++)
    for (int64_t h = 0; h < s->heads; h++) {
      const float *values = pairs + s->width + h * s->padded;
      const float *own = query + q * s->width + h * s->size;
      v16f share = splat(1.f / attention_shares(own, keys + h * s->size * s->room, hidden, shares, s));
      for (int64_t j = 0; j < s->padded; j += LANES) {
        v16f mixed = {0};
        for (int64_t n = 0; n < s->tokens; n++) mixed = mixed + splat(shares[n]) * load(values + n * s->columns + j);
        store(out + (q * s->heads + h) * s->padded + j, mixed * share);
      }
    }
}

// Scaled dot-product attention of several heads (Vaswani et al. 2017, eq. 1).
API int32_t attend(const float *restrict query, const float *restrict pairs, const uint8_t *restrict mask,
                   int64_t heads, float *restrict scratch, float *restrict out, int64_t sets, int64_t queries,
                   int64_t width, int64_t tokens, int64_t columns, int64_t space, int64_t mixed) {
  if (width % heads || width > MOST_COLUMNS || tokens > MOST_COLUMNS) return OUTSIDE;
  Shape s = {.heads = heads, .size = width / heads, .width = width, .columns = columns, .tokens = tokens};
  s.padded = (s.size + LANES - 1) / LANES * LANES;
  s.room = (tokens + LANES - 1) / LANES * LANES;
  if (columns != width + heads * s.padded || mixed != heads * s.padded || space < (width + 2) * s.room) return OUTSIDE;
  for (int64_t i = 0; i < sets; i++)
    attend_set(query + i * queries * width, pairs + i * tokens * columns, mask + i * tokens, scratch,
               out + i * queries * mixed, queries, &s);
  return 0;
}
