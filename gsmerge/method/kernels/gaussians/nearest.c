// Find the nearest points of other views by a balanced k-d tree, which is kept in arrays and searched without
// recursion.
#include "select.h"

enum { LEAF = 16, DEPTH = 64 };  // most points of a leaf; room on the stack, enough for 2^60 points

typedef struct {
  int64_t node, low, high;  // a node of the tree, and its run of the order
} branch;

// The axis along which the points of a run differ most.
static inline int widest_axis(const double *points, const int64_t *order, int64_t low,
                              int64_t high) {
  double least[3], most[3], widest = -1.0;
  for (int axis = 0; axis < 3; axis++) least[axis] = most[axis] = points[3 * order[low] + axis];
  for (int64_t i = low + 1; i < high; i++)
    for (int axis = 0; axis < 3; axis++) {
      double value = points[3 * order[i] + axis];
      least[axis] = mind(least[axis], value);
      most[axis] = maxd(most[axis], value);
    }
  int best = 0;
  for (int axis = 0; axis < 3; axis++)
    if (most[axis] - least[axis] > widest) {
      best = axis;
      widest = most[axis] - least[axis];
    }
  return best;
}

API int32_t build_tree(const double *restrict points, int64_t *restrict order,
                       int8_t *restrict axes, double *restrict splits, int64_t n, int64_t m,
                       int64_t nodes) {
  branch stack[DEPTH] = {{0, 0, m}};
  (void)n;
  for (int top = 1; top > 0;) {
    branch run = stack[--top];
    if (run.high - run.low <= LEAF) continue;
    if (run.node >= nodes) return OUTSIDE;
    int64_t middle = (run.low + run.high) / 2;
    int axis = widest_axis(points, order, run.low, run.high);
    partition_run(points + axis, 3, order, run.low, run.high, middle);
    axes[run.node] = (int8_t)axis;
    splits[run.node] = points[3 * order[middle] + axis];
    stack[top++] = (branch){2 * run.node + 1, run.low, middle};
    stack[top++] = (branch){2 * run.node + 2, middle, run.high};
  }
  return 0;
}

typedef struct {
  const double *points, *splits;
  const int64_t *views, *order;
  const int8_t *axes;
  int64_t n, m, nodes, count;
} tree;

typedef struct {
  branch run;
  double bound, offsets[3];  // squared distance of the query from the cell of the run, and its parts along the axes
} wait;

// Descend to the leaf on the query's side, and put the other sides on the stack; return false for an invalid tree.
static inline bool descend(const tree *t, const double *query, wait *at, wait *stack, int *top) {
  while (at->run.high - at->run.low > LEAF) {
    int64_t node = at->run.node, middle = (at->run.low + at->run.high) / 2;
    if (node >= t->nodes || t->axes[node] < 0 || t->axes[node] > 2) return false;
    int axis = t->axes[node];
    double away = query[axis] - t->splits[node], near = at->offsets[axis];
    branch left = {2 * node + 1, at->run.low, middle}, right = {2 * node + 2, middle, at->run.high};
    wait *other = stack + (*top)++;
    *other = *at;
    other->run = away > 0.0 ? left : right;
    other->bound = at->bound - near * near + away * away;
    other->offsets[axis] = away;
    at->run = away > 0.0 ? right : left;
  }
  return true;
}

// Insert a point into the sorted list of the nearest points, in place of the last one.
static inline void insert(double *distances, int64_t *ids, int64_t count, double distance,
                          int64_t id) {
  int64_t place = count - 1;
  for (; place > 0 && distances[place - 1] > distance; place--) {
    distances[place] = distances[place - 1];
    ids[place] = ids[place - 1];
  }
  distances[place] = distance;
  ids[place] = id;
}

static bool search(const tree *t, int64_t row, int64_t most, double *distances, int64_t *ids) {
  const double *query = t->points + 3 * row;
  int64_t view = t->views[row], last = t->count - 1, looked = 0;
  wait stack[DEPTH] = {{{0, 0, t->m}, 0.0, {0}}};
  for (int top = 1; top > 0 && looked < most;) {
    wait at = stack[--top];
    if (at.bound >= distances[last]) continue;
    if (!descend(t, query, &at, stack, &top)) return false;
    looked += at.run.high - at.run.low;
    for (int64_t i = at.run.low; i < at.run.high; i++) {
      int64_t k = t->order[i];
      if (k < 0 || k >= t->n) return false;
      if (k == row || (t->views[k] == view && view >= 0)) continue;
      const double *p = t->points + 3 * k;
      double x = p[0] - query[0], y = p[1] - query[1], z = p[2] - query[2];
      double distance = x * x + y * y + z * z;
      if (distance < distances[last]) insert(distances, ids, t->count, distance, k);
    }
  }
  return true;
}

API int32_t search_tree(const double *restrict points, const int64_t *restrict views,
                        const int64_t *restrict order, const int8_t *restrict axes,
                        const double *restrict splits, int64_t first, int64_t last, int64_t most,
                        double *restrict distances, int64_t *restrict out, int64_t n, int64_t m,
                        int64_t nodes, int64_t k) {
  tree t = {points, splits, views, order, axes, n, m, nodes, k};
  if (last > n) return OUTSIDE;
  for (int64_t row = first; row < last && k > 0; row++) {
    for (int64_t i = 0; i < k; i++) {
      distances[i] = __builtin_inf();
      out[k * row + i] = -1;
    }
    if (!search(&t, row, most, distances, out + k * row)) return OUTSIDE;
  }
  return 0;
}

// Run quickselect alone, for tests.
API int32_t partition(const double *restrict values, int64_t *restrict order, int64_t low,
                      int64_t high, int64_t place, int64_t n, int64_t m) {
  if (low > place || place >= high || high > m) return OUTSIDE;
  (void)n;
  partition_run(values, 1, order, low, high, place);
  return 0;
}
