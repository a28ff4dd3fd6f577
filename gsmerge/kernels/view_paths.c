// The cheapest path through the views of rows that go pixel by pixel.
#include "native.h"

enum { MOST = 128 };  // views, as many as the places of int8
static const float BACK = 200;  // cost of a step that goes back, and
static const float FAR = 50;  // of any longer step forward, as in view_paths.py

// Cost of going from one (pixel, view) to others: pixels forward, little within a pixel, much for
// going back. Costs are whole numbers, of which float32 holds all.
static inline v16f step_costs(int32_t before, int32_t view_before, v16i after, v16i view) {
  v16i forward = after - before;
  v16i goes_back = (after < 0) | (forward < 0) | ((forward == 0) & (view <= view_before));
  v16f cost = __builtin_convertvector(forward, v16f);
  cost = sel(cost < FAR, cost, splat(FAR));
  return before < 0 ? splat(BACK) : sel(goes_back, splat(BACK), cost);
}

static inline float step_cost(int32_t before, int64_t view_before, int32_t after, int64_t view) {
  return step_costs(before, (int32_t)view_before, (v16i){0} + after, (v16i){0} + (int32_t)view)[0];
}

// Viterbi's step: the cheapest way to sixteen views of a row from all views of the row before.
static inline v16f reach(const int32_t *before, const float *cost, int64_t v, v16i after, v16i view,
                         v16i *which) {
  v16f best = splat(__builtin_inff());
  *which = (v16i){0};
  for (int32_t u = 0; u < v; u++) {
    v16f sum = cost[u] + step_costs(before[u], u, after, view);
    v16i better = sum < best;
    best = sel(better, sum, best);
    *which = (better & u) | (~better & *which);
  }
  return best;
}

API int32_t find_path(const int32_t *restrict pixels, int8_t *restrict came_from,
                      int64_t *restrict views, int64_t *restrict back, int64_t n, int64_t v) {
  const v16i lanes = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  float cost[MOST], fresh[MOST];
  if (v < 1 || v >= MOST) return OUTSIDE;
  for (int64_t u = 0; u < v && n > 0; u++) cost[u] = pixels[u] >= 0 ? 0.f : BACK;
  for (int64_t i = 1; i < n; i++) {
    float low = __builtin_inff();
    for (int64_t start = 0; start < v; start += LANES) {
      int64_t some = mini(LANES, v - start);
      v16i after = {0}, which;
      for (int64_t j = 0; j < some; j++) after[j] = pixels[v * i + start + j];
      v16f best = reach(pixels + v * (i - 1), cost, v, after, lanes + (int32_t)start, &which);
      for (int64_t j = 0; j < some; j++) {
        fresh[start + j] = best[j];
        low = minf(best[j], low);
        came_from[v * i + start + j] = (int8_t)which[j];
      }
    }
    for (int64_t u = 0; u < v; u++) cost[u] = fresh[u] - low;
  }
  *back = 0;
  if (n == 0) return 0;
  int64_t last = 0;
  for (int64_t u = 1; u < v; u++) last = cost[u] < cost[last] ? u : last;
  views[n - 1] = last;
  for (int64_t i = n - 1; i > 0; i--) {
    int64_t to = views[i], from = came_from[v * i + to];
    views[i - 1] = from;
    *back += step_cost(pixels[v * (i - 1) + from], from, pixels[v * i + to], to) >= BACK;
  }
  return 0;
}
