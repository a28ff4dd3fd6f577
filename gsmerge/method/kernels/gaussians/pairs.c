// Merge Gaussians in pairs: in a cell of neighbours the cheapest pair becomes one Gaussian, again and again.
#include "exp_log.h"

enum { CELL = 64, COLUMNS = 15 };  // most Gaussians of a cell; how many numbers of each are in the work space
enum { X, Y, Z, COV, MASS = COV + 6, WEIGHT, LOGDET, COLOR };  // the columns, of CELL numbers each
static const float LEAST = 1e-30f;  // least determinant and mass

typedef struct {
  float (*columns)[CELL], *costs, *best_costs;
  int32_t *rows, *best, *stale;
  int32_t n;
  float color_weight;
} cell;

static inline float find_det(const float *a) {
  return a[0] * (a[3] * a[5] - a[4] * a[4]) - a[1] * (a[1] * a[5] - a[4] * a[2])
      + a[2] * (a[1] * a[4] - a[3] * a[2]);
}

static void measure(cell *s, int i) {
  float a[6];
  for (int k = 0; k < 6; k++) a[k] = s->columns[COV + k][i];
  s->columns[LOGDET][i] = log4(maxf(find_det(a), LEAST));
}

// Compute the costs of merging Gaussian i with each of the others: Runnalls' bound for the pair, per mass, plus the
// squared difference of colours, times the sum of both weights.
static void find_costs(cell *s, int i) {
  float own[COLUMNS], *costs = s->costs;
  for (int k = 0; k < COLUMNS; k++) own[k] = s->columns[k][i];
  const float(*c)[CELL] = (const float(*)[CELL])s->columns;
  for (int j = 0; j < CELL; j++) {
    float mass = own[MASS] + c[MASS][j], p = own[MASS] / mass, q = 1.f - p, pq = p * q;
    float x = c[X][j] - own[X], y = c[Y][j] - own[Y], z = c[Z][j] - own[Z];
    const float both[6] = {
      p * own[COV] + q * c[COV][j] + pq * (x * x), p * own[COV + 1] + q * c[COV + 1][j] + pq * (x * y),
      p * own[COV + 2] + q * c[COV + 2][j] + pq * (x * z), p * own[COV + 3] + q * c[COV + 3][j] + pq * (y * y),
      p * own[COV + 4] + q * c[COV + 4][j] + pq * (y * z), p * own[COV + 5] + q * c[COV + 5][j] + pq * (z * z),
    };
    float r = c[COLOR][j] - own[COLOR], g = c[COLOR + 1][j] - own[COLOR + 1], b = c[COLOR + 2][j] - own[COLOR + 2];
    float lost = log4(maxf(find_det(both), LEAST)) - p * own[LOGDET] - q * c[LOGDET][j];
    float apart = r * r + g * g + b * b;
    costs[j] = (0.5f * lost + s->color_weight * apart) * (own[WEIGHT] + c[WEIGHT][j]);
  }
  costs[i] = __builtin_inff();
}

// Index of the smallest of the first n costs; -1 if none is finite.
static int find_least(const float *costs, int n) {
  float least = __builtin_inff();
  int best = -1;
  for (int j = 0; j < n; j++) {
    best = costs[j] < least ? j : best;
    least = costs[j] < least ? costs[j] : least;
  }
  return best;
}

static void find_best(cell *s, int i) {
  find_costs(s, i);
  s->best[i] = find_least(s->costs, s->n);
  s->best_costs[i] = s->best[i] < 0 ? __builtin_inff() : s->costs[s->best[i]];
}

// Merge j into i, and move the last Gaussian to the place of j.
static void join(cell *s, int i, int j) {
  float(*c)[CELL] = s->columns, mass = c[MASS][i] + c[MASS][j], q = c[MASS][j] / mass, pq = (1.f - q) * q;
  float x = c[X][j] - c[X][i], y = c[Y][j] - c[Y][i], z = c[Z][j] - c[Z][i];
  const float apart[6] = {x * x, x * y, x * z, y * y, y * z, z * z};
  for (int k = 0; k < 6; k++) {
    c[COV + k][i] += q * (c[COV + k][j] - c[COV + k][i]);
    c[COV + k][i] += pq * apart[k];
  }
  for (int k = 0; k < 3; k++) {
    c[X + k][i] += q * (c[X + k][j] - c[X + k][i]);
    c[COLOR + k][i] += q * (c[COLOR + k][j] - c[COLOR + k][i]);
  }
  c[MASS][i] = mass;
  c[WEIGHT][i] += c[WEIGHT][j];
  measure(s, i);
  int last = --s->n;
  for (int k = 0; k < COLUMNS; k++) c[k][j] = c[k][last];
  s->rows[j] = s->rows[last];
  s->best[j] = s->best[last];
  s->best_costs[j] = s->best_costs[last];
}

// Update the best partner of each Gaussian after join(s, i, j).
static void update_best(cell *s, int i, int j) {
  int count = 0;
  for (int k = 0; k < s->n; k++) {
    if (k != i && (s->best[k] == i || s->best[k] == j)) s->stale[count++] = k;
    if (s->best[k] == s->n) s->best[k] = j;  // the last Gaussian has moved to j
  }
  find_best(s, i);
  for (int k = 0; k < s->n; k++)
    if (k != i && s->costs[k] < s->best_costs[k]) {
      s->best_costs[k] = s->costs[k];
      s->best[k] = i;
    }
  for (int e = 0; e < count; e++) find_best(s, s->stale[e]);
}

// Load the Gaussians of a cell, with lengths in units of their root mean square extent.
static void load_cell(cell *s, const double *means, const float *covars, const float *masses,
                      const float *weights, const float *colors, const int64_t *order, int n) {
  float(*c)[CELL] = s->columns, size = 0.f;
  for (int i = 0; i < n; i++)
    for (int k = 0; k < 6; k += k == 0 ? 3 : 2) size += covars[6 * order[i] + k];
  size = maxf(size / (float)n, LEAST);
  float unit = 1.f / sqrtf4(size);
  s->n = n;
  for (int i = 0; i < CELL; i++) {
    int64_t row = order[i < n ? i : 0];
    s->rows[i] = (int32_t)row;
    for (int k = 0; k < 3; k++) {
      c[X + k][i] = (float)(means[3 * row + k] - means[3 * order[0] + k]) * unit;
      c[COLOR + k][i] = colors[3 * row + k];
    }
    for (int k = 0; k < 6; k++) c[COV + k][i] = covars[6 * row + k] / size;
    c[MASS][i] = maxf(masses[row], LEAST);
    c[WEIGHT][i] = weights[row];
    measure(s, i);
  }
  for (int i = 0; i < n; i++) find_best(s, i);
}

API int32_t agglomerate(const double *restrict means, const float *restrict covars,
                        const float *restrict masses, const float *restrict weights, const float *restrict colors,
                        const int64_t *restrict order, const int64_t *restrict starts,
                        double color_weight, double least_share, int64_t first,
                        int64_t last, float *restrict work, int32_t *restrict spare,
                        int32_t *restrict pairs, float *restrict costs, int64_t n, int64_t ends) {
  cell s = {(float(*)[CELL])work, work + COLUMNS * CELL, work + (COLUMNS + 1) * CELL, spare,
            spare + CELL, spare + 2 * CELL, 0, (float)color_weight};
  if (first < 0 || first > last || last >= ends || starts[last] > n) return OUTSIDE;
  for (int64_t number = first; number < last; number++) {
    int64_t low = starts[number], count = starts[number + 1] - low, at = low;
    if (count > CELL) return OUTSIDE;
    if (count < 2) continue;
    load_cell(&s, means, covars, masses, weights, colors, order + low, (int)count);
    double left = least_share * (double)count;
    int least = left > 1.0 ? (int)mind(left, CELL) : 1;
    for (float most = 0.f; s.n > least; at++) {
      int i = find_least(s.best_costs, s.n);
      if (i < 0) break;
      int j = s.best[i], low_place = i < j ? i : j, high_place = i < j ? j : i;
      most = maxf(most, s.best_costs[i]);
      pairs[2 * at] = s.rows[low_place];
      pairs[2 * at + 1] = s.rows[high_place];
      costs[at] = most;
      join(&s, low_place, high_place);
      update_best(&s, low_place, high_place);
    }
  }
  return 0;
}

API int32_t merge_pairs(const int32_t *restrict pairs, double *restrict means,
                        float *restrict covars, float *restrict masses, float *restrict weights, float *restrict sh,
                        int32_t *restrict sizes, int64_t m, int64_t n, int64_t columns) {
  if (any_outside(pairs, 2 * m, n)) return OUTSIDE;
  for (int64_t e = 0; e < m; e++) {
    int64_t i = pairs[2 * e], j = pairs[2 * e + 1];
    float mass = masses[i] + masses[j], q = masses[j] / mass, pq = (1.f - q) * q, apart[3];
    for (int k = 0; k < 3; k++) {
      double away = means[3 * j + k] - means[3 * i + k];
      apart[k] = (float)away;
      means[3 * i + k] += (double)q * away;
    }
    for (int a = 0, k = 0; a < 3; a++)
      for (int b = a; b < 3; b++, k++) {
        float own = covars[6 * i + k], added = q * (covars[6 * j + k] - own) + pq * (apart[a] * apart[b]);
        covars[6 * i + k] = own + added;
      }
    for (int64_t k = 0; k < columns; k++) sh[columns * i + k] += q * (sh[columns * j + k] - sh[columns * i + k]);
    masses[i] = mass;
    weights[i] += weights[j];
    sizes[i] += sizes[j];
  }
  return 0;
}

// Write covariances and masses, see pairs.py.
API void gaussian_moments(const float *restrict quats, const float *restrict scales,
                          const float *restrict opacities, double flatness, float *restrict covars,
                          float *restrict masses, int64_t n) {
  for (int64_t i = 0; i < n; i++) {
    double w = quats[4 * i], x = quats[4 * i + 1], y = quats[4 * i + 2], z = quats[4 * i + 3];
    double f = 2.0 / maxd(w * w + x * x + y * y + z * z, 1e-300);
    const double r[3][3] = {
      {1.0 - f * (y * y + z * z), f * (x * y - w * z), f * (x * z + w * y)},
      {f * (x * y + w * z), 1.0 - f * (x * x + z * z), f * (y * z - w * x)},
      {f * (x * z - w * y), f * (y * z + w * x), 1.0 - f * (x * x + y * y)},
    };
    double s[3] = {scales[3 * i], scales[3 * i + 1], scales[3 * i + 2]};
    double least = maxd(flatness * maxd(maxd(s[0], s[1]), s[2]), 1e-12);
    for (int k = 0; k < 3; k++) s[k] = maxd(s[k], least) * maxd(s[k], least);
    masses[i] = (float)(opacities[i] * sqrtf8(s[0] * s[1] + s[1] * s[2] + s[2] * s[0]));
    for (int a = 0, k = 0; a < 3; a++)
      for (int b = a; b < 3; b++, k++)
        covars[6 * i + k] = (float)(r[a][0] * r[b][0] * s[0] + r[a][1] * r[b][1] * s[1] + r[a][2] * r[b][2] * s[2]);
  }
}
