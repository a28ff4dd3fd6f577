// Split groups of members into children, by halving them repeatedly across their widest direction.
#include "trig.h"

// number of features of a member, and length of its row, in which the last two numbers are zero
enum { FEATURES = 6, ROW = 8 };
static const double COLOR = 0.28209479177387814;  // factor from a spherical harmonic of degree 0 to rgb
static const double PIXEL = 0.012;  // difference in colour that counts as much as one pixel
typedef double v8d __attribute__((vector_size(64), aligned(8)));

// The members of one group as features, first colour and then position; `measured` is true if errors are requested.
typedef struct {
  double *features, *weights;
  int64_t *spare;
  double plane_weight;
  bool measured;
} space;

// One child: its start in the order, and the values that a cut across it needs.
typedef struct {
  double spread, error, mean[ROW], axis[ROW];
} run;

static inline v8d row_of(const double *rows, int64_t i) { return *(const v8d *)(rows + ROW * i); }

static inline double dot(v8d a, v8d b) {
  v8d p = a * b;
  return (p[0] + p[4]) + (p[2] + p[6]) + ((p[1] + p[5]) + (p[3] + p[7]));
}

// Write the principal axis of a scatter, by power iteration, and return the scatter along it.
static double find_axis(const v8d *scatter, double *axis) {
  int widest = 0;
  for (int c = 1; c < FEATURES; c++) widest = scatter[c][c] > scatter[widest][widest] ? c : widest;
  v8d direction = scatter[widest];
  for (int step = 0; step < 7; step++) {  // a rough axis is enough to cut across
    double length = sqrtf8(dot(direction, direction));
    if (length <= 1e-30) return 0.0;
    direction /= length;
    v8d product = {0};  // rows in place of columns, because the scatter is symmetric
    for (int c = 0; c < FEATURES; c++) product += scatter[c] * direction[c];
    direction = product;
  }
  *(v8d *)axis = direction;
  return sqrtf8(dot(direction, direction));
}

// Smallest eigenvalue of the scatter of the positions, which is the sum of squared distances from their plane.
static double find_thickness(const v8d *scatter) {
  double a = scatter[3][3], b = scatter[4][4], c = scatter[5][5];
  double d = scatter[4][3], e = scatter[5][3], f = scatter[5][4], middle = (a + b + c) / 3.0;
  a -= middle, b -= middle, c -= middle;
  double p = sqrtf8((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0);
  if (p <= 1e-30) return maxd(middle, 0.0);
  double half = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e))
      / (2.0 * p * p * p);
  double angle = acos8(mind(maxd(half, -1.0), 1.0)) / 3.0;
  return maxd(middle + 2.0 * p * cos8(angle + 2.0943951023931953), 0.0);  // 2 pi / 3
}

// Compute mean, axis and spread of some members, and their squared error. This is the error of the colour plus the
// weighted error of the distance from a plane, scaled as if the mean weight of members were one.
static void measure_run(const space *s, const int64_t *members, int64_t n, run *out) {
  double total = 0.0;
  v8d mean = {0}, scatter[FEATURES] = {{0}};
  for (int64_t j = 0; j < n; j++) {
    int64_t i = members[j];
    total += s->weights[i];
    mean += row_of(s->features, i) * s->weights[i];
  }
  mean /= total;
  for (int64_t j = 0; j < n; j++) {
    int64_t i = members[j];
    v8d delta = row_of(s->features, i) - mean, weighted = delta * s->weights[i];
    for (int c = 0; c < FEATURES; c++) scatter[c] += delta * weighted[c];
  }
  *(v8d *)out->mean = mean;
  out->spread = find_axis(scatter, out->axis);
  if (!s->measured) return;
  double colour = scatter[0][0] + scatter[1][1] + scatter[2][2];
  out->error = (double)n / total * (colour + s->plane_weight * find_thickness(scatter));
}

// Order members by the side of the mean on which they lie; return the number of members on the first side.
static int64_t part_members(const space *s, int64_t *members, int64_t n, const run *across) {
  v8d mean = *(const v8d *)across->mean, axis = *(const v8d *)across->axis;
  int64_t low = 0, high = n;
  for (int64_t j = 0; j < n; j++) s->spare[j] = members[j];
  for (int64_t j = 0; j < n; j++) {
    bool first = dot(row_of(s->features, s->spare[j]) - mean, axis) <= 0.0;
    high -= !first;
    members[first ? low : high] = s->spare[j];
    low += first;
  }
  return low;
}

// Cut an order of n members into at most `count` runs, and return the number of runs. `cuts` gets their bounds, and
// errors[r - 1] the error with r runs.
static int64_t split(const space *s, int64_t *order, int64_t n, int64_t count, run *runs,
                     int64_t *cuts, double *errors) {
  int64_t num = 1;
  cuts[0] = 0, cuts[1] = n;
  measure_run(s, order, n, runs);
  if (s->measured) errors[0] = runs[0].error;
  while (num < count) {
    int64_t widest = 0;
    for (int64_t r = 1; r < num; r++) widest = runs[r].spread > runs[widest].spread ? r : widest;
    if (runs[widest].spread <= 1e-12) break;
    int64_t start = cuts[widest], end = cuts[widest + 1];
    int64_t cut = start + part_members(s, order + start, end - start, runs + widest);
    if (cut == start || cut == end) {
      runs[widest].spread = 0.0;
      continue;
    }
    for (int64_t r = num; r > widest; r--) {
      cuts[r + 1] = cuts[r];
      runs[r] = runs[r - 1];
    }
    cuts[widest + 1] = cut;
    num++;
    measure_run(s, order + start, cut - start, runs + widest);
    measure_run(s, order + cut, end - cut, runs + widest + 1);
    double error = 0.0;
    for (int64_t r = 0; r < num && s->measured; r++) error += runs[r].error;
    if (s->measured) errors[num - 1] = error;
  }
  return num;
}

// Write the features of the members of one group; return false if a row is outside the arrays.
static bool fill_features(const space *s, const int32_t *rows, int64_t size, int64_t n,
                          const float *means, const float *sh0, const float *opacities,
                          const double *centre, double footprint) {
  double scale = PIXEL / footprint;
  for (int64_t j = 0; j < size; j++) {
    int64_t i = rows[j];
    if (i < 0 || i >= n) return false;
    s->weights[j] = maxd(opacities[i], 1e-3);
    v8d row = {0};
    for (int c = 0; c < 3; c++) {
      row[c] = COLOR * sh0[3 * i + c];
      row[3 + c] = scale * (means[3 * i + c] - centre[c]);
    }
    *(v8d *)(s->features + ROW * j) = row;
  }
  return true;
}

API int32_t split_groups(const int64_t *restrict starts, const int32_t *restrict ids,
                         const float *restrict means, const float *restrict sh0,
                         const float *restrict opacities, const double *restrict centres,
                         const double *restrict footprints, const int64_t *restrict counts,
                         double plane_weight, double *restrict features, double *restrict weights,
                         int64_t *restrict order, int64_t *restrict cuts, double *restrict room,
                         int64_t *restrict child_starts, int32_t *restrict child_ids,
                         int64_t *restrict parents, int64_t *restrict num_children,
                         double *restrict errors, int64_t ends, int64_t m, int64_t n,
                         int64_t groups, int64_t longest, int64_t bounds, int64_t most,
                         int64_t slots, int64_t own, int64_t children, int64_t width) {
  if (ends != groups + 1 || bounds != most + 1 || slots != children + 1) return OUTSIDE;
  if (starts[groups] > m || starts[groups] - starts[0] > own) return OUTSIDE;
  space s = {features, weights, order + longest, plane_weight, width > 0};
  int64_t first = starts[0], made = 0;
  for (int64_t g = 0; g < groups; g++) {
    const int32_t *rows = ids + starts[g];
    int64_t size = starts[g + 1] - starts[g], count = counts[g];
    if (size > longest || count > most || count > children - made || (width > 0 && count > width))
      return OUTSIDE;
    if (!fill_features(&s, rows, size, n, means, sh0, opacities, centres + 3 * g, footprints[g]))
      return OUTSIDE;
    for (int64_t j = 0; j < size; j++) order[j] = j;
    int64_t runs = split(&s, order, size, count, (run *)room, cuts, errors + width * g);
    for (int64_t j = 0; j < size; j++) child_ids[starts[g] - first + j] = rows[order[j]];
    for (int64_t r = 0; r < runs; r++, made++) {
      child_starts[made] = starts[g] - first + cuts[r];
      parents[made] = g;
    }
  }
  child_starts[made] = starts[groups] - first;
  *num_children = made;
  return 0;
}
