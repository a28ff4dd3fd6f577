// Sort members into groups, compute the moments of each group, and turn covariances into principal axes.
#include "exp_log.h"
#include "select.h"

// Up to FEW members a median is found by counting. SWEEPS is the largest number of Jacobi sweeps. The moments of LINE
// members are computed together, and AHEAD members are loaded ahead.
enum { FEW = 64, SWEEPS = 8, LINE = 32, AHEAD = 32 };
static const double MAX_OPACITY = 0.995;  // the optical depth -ln(1 - opacity) of an opacity of 1 would be infinite
static const double CAP = 3.0;  // members are shrunk to at most this many times the median extent of their group
static const double FLOOR = 0.1;  // smallest standard deviation of a group, in pixel footprints
static const double VOLUME = 15.749609945722419;  // (2 pi)^(3/2)

typedef struct {
  const float *means, *quats, *scales, *opacities, *sh0, *shN, *footprints;
  int64_t rest;  // number of coefficients of shN
} members;

// Sort the ids of members by label, and write where the members of each label start. Labels below 0 are left out.
API int32_t sort_labels(const int32_t *restrict labels, int64_t *restrict starts,
                        int32_t *restrict ids, int64_t n, int64_t ends) {
  if (n > INT32_MAX || ends < 1) return OUTSIDE;
  for (int64_t g = 0; g < ends; g++) starts[g] = 0;
  for (int64_t i = 0; i < n; i++) {
    int64_t g = labels[i];
    if (g < 0) continue;
    if (g + 1 >= ends) return OUTSIDE;
    starts[g + 1]++;
  }
  for (int64_t g = 1; g < ends; g++) starts[g] += starts[g - 1];
  for (int64_t i = 0; i < n; i++)
    if (labels[i] >= 0) ids[starts[labels[i]]++] = (int32_t)i;
  // each start has moved to the end of its list
  for (int64_t g = ends - 1; g > 0; g--) starts[g] = starts[g - 1];
  starts[0] = 0;
  return 0;
}

static inline double largest(const float *s) { return maxf(maxf(s[0], s[1]), s[2]); }

// The median; for an even number the smaller of the two in the middle. For few members counting is faster than
// quickselect, whose branches are mispredicted.
static double find_median(const double *values, int64_t *order, int64_t n) {
  int64_t middle = (n - 1) / 2;
  for (int64_t j = 0; j < n && n <= FEW; j++) {
    int64_t below = 0, upto = 0;
    for (int64_t i = 0; i < n; i++) {
      below += values[i] < values[j];
      upto += values[i] <= values[j];
    }
    if (below <= middle && middle < upto) return values[j];
  }
  for (int64_t j = 0; j < n; j++) order[j] = j;
  partition_run(values, 1, order, 0, n, middle);
  return values[order[middle]];
}

// Write the factor by which each member is shrunk, so that its extent is at most CAP times the median extent of its
// group. Extents are in footprints.
static void cap_members(const members *m, const int32_t *ids, int64_t n, double *caps,
                        int64_t *order) {
  for (int64_t j = 0; j < n; j++)
    caps[j] = largest(m->scales + 3 * (int64_t)ids[j]) / m->footprints[ids[j]];
  double limit = CAP * find_median(caps, order, n);
  for (int64_t j = 0; j < n; j++) caps[j] = caps[j] > limit ? limit / caps[j] : 1.0;
}

// Numbers of up to LINE members, a lane for each, so that loops over them vectorise.
typedef struct {
  double weights[LINE], opacities[LINE], scales[3][LINE], offsets[3][LINE];  // offsets are from the group's mean
  double covars[6][LINE], logs[LINE], areas[LINE];  // covars are the members' own, times their weights
  float quats[4][LINE];
} lanes;

// Compute the covariances w R diag(s)^2 R^T as xx xy xz yy yz zz. R is the rotation of a quaternion wxyz of any length;
// the zero quaternion stands for no rotation.
static inline void add_covariances(lanes *l, int64_t n) {
  for (int64_t j = 0; j < n; j++) {
    double w = l->quats[0][j], x = l->quats[1][j], y = l->quats[2][j], z = l->quats[3][j];
    double norm = w * w + x * x + y * y + z * z, f = norm > 0.0 ? 2.0 / norm : 0.0;
    double xx = f * x * x, xy = f * x * y, xz = f * x * z;
    double yy = f * y * y, yz = f * y * z, zz = f * z * z;
    double wx = f * w * x, wy = f * w * y, wz = f * w * z;
    double r[3][3] = {{1.0 - yy - zz, xy - wz, xz + wy},
                      {xy + wz, 1.0 - xx - zz, yz - wx},
                      {xz - wy, yz + wx, 1.0 - xx - yy}};
    double v[3], weight = l->weights[j];
    for (int k = 0; k < 3; k++) v[k] = weight * l->scales[k][j] * l->scales[k][j];
    for (int p = 0, k = 0; p < 3; p++)
      for (int q = p; q < 3; q++, k++)
        l->covars[k][j] = v[0] * r[p][0] * r[q][0] + v[1] * r[p][1] * r[q][1] + v[2] * r[p][2] * r[q][2];
  }
}

// Compute the sums over a group of the weights, the weighted means and the weighted footprints.
static inline void sum_means(const members *m, const int32_t *ids, int64_t n, bool uniform,
                             double *sums) {
  for (int k = 0; k < 5; k++) sums[k] = 0.0;
  for (int64_t j = 0; j < n; j++) {
    int64_t i = ids[j];
    double w = uniform ? 1.0 : mind(m->opacities[i], MAX_OPACITY);
    sums[0] += w;
    for (int k = 0; k < 3; k++) sums[1 + k] += w * m->means[3 * i + k];
    sums[4] += w * m->footprints[i];
  }
}

// Fill the lanes of n members of a group; a weight is an opacity times `norm`, or `norm` alone if `uniform`.
static inline void fill_lanes(const members *m, const int32_t *ids, int64_t n, const double *caps, const double *mean,
                              double norm, bool uniform, lanes *l) {
  for (int64_t j = 0; j < n; j++) {
    int64_t i = ids[j];
    l->opacities[j] = mind(m->opacities[i], MAX_OPACITY);
    for (int k = 0; k < 3; k++) {
      l->offsets[k][j] = m->means[3 * i + k] - mean[k];
      l->scales[k][j] = m->scales[3 * i + k];
    }
    for (int k = 0; k < 4 && caps; k++) l->quats[k][j] = m->quats[4 * i + k];
  }
  for (int64_t j = 0; j < n; j++) {
    l->weights[j] = uniform ? norm : l->opacities[j] * norm;
    for (int k = 0; k < 3 && caps; k++) l->scales[k][j] *= caps[j];
  }
  for (int64_t j = 0; j < n; j++) {
    double x = l->scales[0][j], y = l->scales[1][j], z = l->scales[2][j];
    l->logs[j] = log8(1.0 - l->opacities[j]);
    l->areas[j] = maxd(maxd(x * y, x * z), y * z);
  }
  if (caps) add_covariances(l, n);
}

// Compute the moments of one group, see pool.py. A fully transparent group gets equal weights, so that it has a mean.
// Without caps, the covariances of the members do not count.
static void pool_group(const members *m, const int32_t *ids, int64_t n, const double *caps, double *out,
                       float *out_sh) {
  lanes l;
  double sums[5], mean[3], c[6] = {0}, mass = 0.0, extinction = 0.0;
  sum_means(m, ids, n, false, sums);
  double total = sums[0];
  bool uniform = total <= 0.0;
  if (uniform) sum_means(m, ids, n, true, sums);
  double norm = 1.0 / sums[0], footprint = sums[4] * norm;
  for (int k = 0; k < 3; k++) mean[k] = sums[1 + k] * norm;
  for (int64_t first = 0; first < n; first += LINE) {
    int64_t size = mini(LINE, n - first);
    fill_lanes(m, ids + first, size, caps ? caps + first : caps, mean, norm, uniform, &l);
    for (int64_t j = 0; j < size; j++) {
      for (int p = 0, k = 0; p < 3; p++)
        for (int q = p; q < 3; q++, k++) c[k] += l.weights[j] * l.offsets[p][j] * l.offsets[q][j];
      for (int k = 0; k < 6 && caps; k++) c[k] += l.covars[k][j];
      mass += l.opacities[j] * l.scales[0][j] * l.scales[1][j] * l.scales[2][j];
      extinction -= l.logs[j] * l.areas[j];
    }
    for (int64_t j = 0; j < size; j++) {
      int64_t i = ids[first + j];
      float share = (float)l.weights[j];
      for (int k = 0; k < 3; k++) out_sh[k] += share * m->sh0[3 * i + k];
      const float *rest = m->shN + 3 * m->rest * i;
      for (int64_t k = 0; k < 3 * m->rest; k++) out_sh[3 + k] += share * rest[k];
    }
  }
  double floor = FLOOR * footprint * (FLOOR * footprint);
  for (int k = 0; k < 3; k++) out[k] = mean[k];
  for (int k = 0; k < 6; k++) out[3 + k] = k == 0 || k == 3 || k == 5 ? c[k] + floor : c[k];
  out[9] = total, out[10] = mass * VOLUME, out[11] = extinction, out[12] = footprint;
}

// Begin to load the members of the next group, which are the next to come from memory.
static inline void prefetch_members(const members *m, const int32_t *ids, int64_t n) {
  for (int64_t j = 0; j < n; j++) {
    int64_t i = ids[j];
    __builtin_prefetch(m->means + 3 * i);
    __builtin_prefetch(m->quats + 4 * i);
    __builtin_prefetch(m->scales + 3 * i);
    __builtin_prefetch(m->sh0 + 3 * i);
    __builtin_prefetch(m->opacities + i);
    __builtin_prefetch(m->footprints + i);
  }
}

API int32_t pool_groups(const int64_t *restrict starts, const int32_t *restrict ids,
                        const float *restrict means, const float *restrict quats,
                        const float *restrict scales, const float *restrict opacities,
                        const float *restrict sh0, const float *restrict shN,
                        const float *restrict footprints, int32_t own_covariance,
                        double *restrict caps, int64_t *restrict order,
                        double *restrict out_geometry, float *restrict out_sh, int64_t ends,
                        int64_t m, int64_t n, int64_t rest, int64_t longest, int64_t groups,
                        int64_t bases) {
  if (ends != groups + 1 || bases != rest + 1) return OUTSIDE;
  members all = {means, quats, scales, opacities, sh0, shN, footprints, rest};
  for (int64_t g = 0; g < groups; g++) {
    const int32_t *own = ids + starts[g];
    int64_t count = starts[g + 1] - starts[g];
    if (count > longest || starts[g + 1] > m) return OUTSIDE;
    if (count == 0) continue;
    for (int64_t j = 0; j < count; j++)
      if (own[j] < 0 || own[j] >= n) return OUTSIDE;
    prefetch_members(&all, own + count, mini(AHEAD, m - starts[g + 1]));
    if (own_covariance) cap_members(&all, own, count, caps, order);
    pool_group(&all, own, count, own_covariance ? caps : 0, out_geometry + 13 * g, out_sh + 3 * bases * g);
  }
  return 0;
}

// Rotate the symmetric a so that a[p][q] becomes zero (Jacobi), and the columns of u, which become the eigenvectors.
static inline void rotate_pair(double a[3][3], double u[3][3], int p, int q) {
  if (!(absf8(a[p][q]) > 1e-300)) return;
  double theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
  double t = 1.0 / (absf8(theta) + sqrtf8(theta * theta + 1.0));
  t = theta < 0.0 ? -t : t;
  double c = 1.0 / sqrtf8(t * t + 1.0), s = t * c;
  for (int k = 0; k < 3; k++) {
    double x = a[k][p], y = a[k][q];
    a[k][p] = c * x - s * y;
    a[k][q] = s * x + c * y;
  }
  for (int k = 0; k < 3; k++) {
    double x = a[p][k], y = a[q][k];
    a[p][k] = c * x - s * y;
    a[q][k] = s * x + c * y;
    x = u[k][p], y = u[k][q];
    u[k][p] = c * x - s * y;
    u[k][q] = s * x + c * y;
  }
}

// Write the unit quaternion wxyz, w >= 0, of orthonormal axes. If they are left-handed, the first one is reversed.
static inline void right_handed_quat(double r[3][3], double *out) {
  double det = r[0][0] * (r[1][1] * r[2][2] - r[1][2] * r[2][1])
      - r[0][1] * (r[1][0] * r[2][2] - r[1][2] * r[2][0])
      + r[0][2] * (r[1][0] * r[2][1] - r[1][1] * r[2][0]);
  if (det < 0.0)
    for (int i = 0; i < 3; i++) r[i][0] = -r[i][0];
  // 4 q q^T has these four diagonals; dividing by the largest one is safe
  double q[4] = {1 + r[0][0] + r[1][1] + r[2][2], 1 + r[0][0] - r[1][1] - r[2][2],
                 1 - r[0][0] + r[1][1] - r[2][2], 1 - r[0][0] - r[1][1] + r[2][2]};
  int best = 0;
  for (int i = 1; i < 4; i++) best = q[i] > q[best] ? i : best;
  double root = sqrtf8(q[best]), f = 0.5 / root;
  double a = r[2][1] - r[1][2], b = r[0][2] - r[2][0], c = r[1][0] - r[0][1];
  double d = r[1][0] + r[0][1], e = r[0][2] + r[2][0], h = r[2][1] + r[1][2];
  const double rows[4][4] = {{0, a, b, c}, {a, 0, d, e}, {b, d, 0, h}, {c, e, h, 0}};
  for (int i = 0; i < 4; i++) q[i] = i == best ? 0.5 * root : rows[best][i] * f;
  double norm = (q[0] < 0.0 ? -1.0 : 1.0)
      / sqrtf8(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int i = 0; i < 4; i++) out[i] = q[i] * norm;
}

API void decompose(const double *restrict covars, double *restrict out_scales,
                   double *restrict out_quats, int64_t g) {
  for (int64_t n = 0; n < g; n++) {
    double a[3][3], u[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, r[3][3];
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++) a[i][j] = covars[9 * n + 3 * i + j];
    for (int sweep = 0; sweep < SWEEPS; sweep++) {
      double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
      if (off <= 1e-28 * (a[0][0] * a[0][0] + a[1][1] * a[1][1] + a[2][2] * a[2][2])) break;
      rotate_pair(a, u, 0, 1);
      rotate_pair(a, u, 0, 2);
      rotate_pair(a, u, 1, 2);
    }
    // find the smallest and the largest number on the diagonal; the third one is in the middle
    int low = 0, high = 0;
    for (int k = 1; k < 3; k++) {
      low = a[k][k] < a[low][low] ? k : low;
      high = a[k][k] >= a[high][high] ? k : high;
    }
    int order[3] = {low, 3 - low - high < 2 ? 3 - low - high : 2, high};  // the limit is for NaN
    for (int k = 0; k < 3; k++) {
      out_scales[3 * n + k] = sqrtf8(maxd(a[order[k]][order[k]], 0.0));
      for (int i = 0; i < 3; i++) r[i][k] = u[i][order[k]];
    }
    right_handed_quat(r, out_quats + 4 * n);
  }
}
