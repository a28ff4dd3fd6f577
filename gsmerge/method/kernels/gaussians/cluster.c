// Measure the overlap of neighbouring Gaussians, and cluster those that overlap. A pair of neighbours is an edge of a
// graph of Gaussians.
#include "exp_log.h"

// Determinant of a symmetric 3 x 3 given as xx xy xz yy yz zz.
static inline double find_det(const double *a) {
  return a[0] * (a[3] * a[5] - a[4] * a[4]) - a[1] * (a[1] * a[5] - a[4] * a[2])
      + a[2] * (a[1] * a[4] - a[3] * a[2]);
}

static inline double find_volume(const double *cov) { return sqrtf8(maxd(find_det(cov), 0.0)); }

// Bhattacharyya's coefficient (1943): exp(-d' C^-1 d / 8) (|A| |B|)^(1/4) / |C|^(1/2) with C = (A + B) / 2.
static inline double find_overlap(const double *mean_a, const double *cov_a, double volume_a,
                                  const double *mean_b, const double *cov_b) {
  double half[6];
  for (int k = 0; k < 6; k++) half[k] = 0.5 * (cov_a[k] + cov_b[k]);
  double det = find_det(half);
  if (det <= 0.0) return 0.0;
  double x = mean_b[0] - mean_a[0], y = mean_b[1] - mean_a[1], z = mean_b[2] - mean_a[2];
  // adjugate of the mean covariance
  double xx = half[3] * half[5] - half[4] * half[4], yy = half[0] * half[5] - half[2] * half[2];
  double zz = half[0] * half[3] - half[1] * half[1], xy = half[2] * half[4] - half[1] * half[5];
  double xz = half[1] * half[4] - half[2] * half[3], yz = half[1] * half[2] - half[0] * half[4];
  double cross = xy * x * y + xz * x * z + yz * y * z;
  double distance = xx * x * x + yy * y * y + zz * z * z + 2.0 * cross;
  return exp8(-0.125 * (distance / det)) * sqrtf8(volume_a * find_volume(cov_b) / det);
}

API double bhattacharyya(const double *restrict mean_a, const double *restrict cov_a,
                         const double *restrict mean_b, const double *restrict cov_b) {
  return find_overlap(mean_a, cov_a, find_volume(cov_a), mean_b, cov_b);
}

API double box_overlap(const double *restrict mean_a, const double *restrict cov_a,
                       const double *restrict mean_b, const double *restrict cov_b) {
  const int diagonal[3] = {0, 3, 5};
  double shared = 1.0, volume_a = 1.0, volume_b = 1.0;
  for (int c = 0; c < 3; c++) {
    double a = sqrtf8(cov_a[diagonal[c]]), b = sqrtf8(cov_b[diagonal[c]]);
    double low = maxd(mean_a[c] - a, mean_b[c] - b), high = mind(mean_a[c] + a, mean_b[c] + b);
    shared *= maxd(high - low, 0.0);
    volume_a *= 2.0 * a;
    volume_b *= 2.0 * b;
  }
  double whole = volume_a + volume_b - shared;
  return whole > 0.0 ? shared / whole : 0.0;
}

// Cosine of two vectors of length 1. It uses eight lanes, because rows of sixteen floats would cross cache lines.
static inline double find_cosine(const float *a, const float *b, int64_t d) {
  v8f sum = {0};
  int64_t c = 0;
  for (; c + 8 <= d; c += 8) sum += *(const v8f *)(a + c) * *(const v8f *)(b + c);
  float rest = 0.f;
  for (; c < d; c++) rest += a[c] * b[c];
  v4f half = PICK(sum, sum, 0, 1, 2, 3) + PICK(sum, sum, 4, 5, 6, 7);
  return (half[0] + half[2]) + (half[1] + half[3]) + rest;
}

static inline double find_difference(const double *a, const double *b) {
  double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
  return x * x + y * y + z * z;
}

API int32_t edge_scores(const int64_t *restrict neighbors, const double *restrict means,
                        const double *restrict covars, const double *restrict colors,
                        const float *restrict latents, const int64_t *restrict views,
                        double max_color, double similarity, int32_t boxes, double *restrict out,
                        int64_t g, int64_t k, int64_t d) {
  double most = max_color * max_color;
  for (int64_t i = 0; i < g; i++) {
    const double *mean = means + 3 * i, *cov = covars + 6 * i;
    double volume = find_volume(cov);
    for (int64_t e = k * i; e < k * (i + 1); e++) {
      int64_t j = neighbors[e];
      out[e] = -1.0;
      if (j >= g) return OUTSIDE;
      if (j < 0 || (views[i] >= 0 && views[i] == views[j])) continue;
      if (d > 0 ? find_cosine(latents + d * i, latents + d * j, d) < similarity
                : find_difference(colors + 3 * i, colors + 3 * j) > most)
        continue;
      out[e] = boxes ? box_overlap(mean, cov, means + 3 * j, covars + 6 * j)
                     : find_overlap(mean, cov, volume, means + 3 * j, covars + 6 * j);
    }
  }
  return 0;
}

// Position of the largest score that is left; -1 if there is none.
static inline int64_t find_best(const double *left, int64_t k) {
  double top = -__builtin_inf();
  int64_t best = -1;
  for (int64_t e = 0; e < k; e++) {
    best = left[e] > top ? e : best;
    top = left[e] > top ? left[e] : top;
  }
  return best;
}

// Return true if a cluster already has a member of a view; views below 0 mean no view.
static inline bool has_view(const int64_t *candidates, int64_t k, const int64_t *clusters,
                            int64_t cluster, const int64_t *views, int64_t view) {
  for (int64_t e = 0; e < k && view >= 0; e++) {
    int64_t j = candidates[e];
    if (j >= 0 && clusters[j] == cluster && views[j] == view) return true;
  }
  return false;
}

API int32_t find_stars(const int64_t *restrict neighbors, const double *restrict scores,
                       const int64_t *restrict views, const int64_t *restrict order,
                       double threshold, int64_t max_size, double *restrict left,
                       int64_t *restrict clusters, int64_t *restrict num_clusters, int64_t n,
                       int64_t k, int64_t m) {
  int64_t count = 0;
  for (int64_t i = 0; i < n; i++) clusters[i] = -1;
  for (int64_t o = 0; o < m; o++) {
    int64_t leader = order[o];
    if (clusters[leader] >= 0) continue;
    const int64_t *candidates = neighbors + k * leader;
    const double *overlaps = scores + k * leader;
    clusters[leader] = count;
    for (int64_t e = 0; e < k; e++) {
      if (candidates[e] >= n) return OUTSIDE;
      left[e] = candidates[e] >= 0 && overlaps[e] >= threshold ? overlaps[e] : -__builtin_inf();
    }
    for (int64_t size = 1; size < max_size;) {
      int64_t best = find_best(left, k);
      if (best < 0) break;
      left[best] = -__builtin_inf();
      int64_t j = candidates[best];
      if (clusters[j] >= 0 || has_view(candidates, k, clusters, count, views, views[j])) continue;
      clusters[j] = count;
      size++;
    }
    count++;
  }
  *num_clusters = count;
  return 0;
}

static inline int64_t find_root(int64_t *parents, int64_t i) {
  while (parents[i] != i) {
    parents[i] = parents[parents[i]];
    i = parents[i];
  }
  return i;
}

API int32_t find_components(const int64_t *restrict neighbors, const double *restrict scores,
                            double threshold, int64_t *restrict parents, int64_t *restrict clusters,
                            int64_t *restrict num_clusters, int64_t n, int64_t k) {
  int64_t count = 0;
  for (int64_t i = 0; i < n; i++) parents[i] = i;
  for (int64_t i = 0; i < n; i++)
    for (int64_t e = k * i; e < k * (i + 1); e++) {
      if (!(scores[e] >= threshold) || neighbors[e] < 0) continue;
      if (neighbors[e] >= n) return OUTSIDE;
      int64_t a = find_root(parents, i), b = find_root(parents, neighbors[e]);
      parents[maxi(a, b)] = mini(a, b);
    }
  for (int64_t i = 0; i < n; i++) {  // a root comes before all others of its tree
    int64_t root = find_root(parents, i);
    clusters[i] = root == i ? count++ : clusters[root];
  }
  *num_clusters = count;
  return 0;
}
