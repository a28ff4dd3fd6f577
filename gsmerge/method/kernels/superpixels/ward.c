// Merge neighbouring regions by Ward's method. An edge is a pair of neighbouring regions.
#include "labels.h"

enum { NUM_PIXELS = 5, INVERSE, HEIGHT };  // columns of the row of a region after its mean
static const int64_t ROW = 8;

static const float LEAST_CEILING = 1e-7f;
static const float CEILING_GROWTH = 1.5f;
static const float RETURN_MARGIN = 1.5f;  // parked edges return if they cost less than this many times the ceiling

// A list of edges: the active ones, which cost at most the ceiling, or the parked ones.
typedef struct {
  int32_t *pairs;
  float *costs;
  int64_t count;
} Edges;

typedef struct {
  float *rows;
  int32_t *parents;
  float *best_costs;  // least cost of the active edges of each region; inf between the rounds
  int64_t num_nodes;
} Tree;

API int64_t adjacent_pairs(const int32_t *labels, int32_t *pairs, int64_t rows, int64_t columns,
                           int64_t capacity) {
  int64_t count = 0;
  if (rows < 2 || columns < 2 || capacity < 2 * (rows - 2) * (columns - 2) + 1) return -OUTSIDE;
  for (int64_t y = 1; y < rows - 1; y++) {
    const int32_t *line = labels + y * columns, *above = line - columns, *below = line + columns;
    for (int64_t x = 1; x < columns - 1; x++) {
      int32_t u = line[x], east = line[x + 1], south = below[x];
      // The pair is always written, and the count decides if it stays. A branch here would be mispredicted half of the
      // time
      pairs[2 * count] = u;
      pairs[2 * count + 1] = east;
      count += (east != u) & (east >= 0) & ((above[x] != u) | (above[x + 1] != east));
      pairs[2 * count] = u;
      pairs[2 * count + 1] = south;
      count += (south != u) & (south >= 0) & ((line[x - 1] != u) | (below[x - 1] != south));
    }
  }
  return count;
}

// By how much the squared error grows if two regions merge.
static inline float merge_cost(const float *u, const float *v) {
  float d0 = u[0] - v[0], d1 = u[1] - v[1], d2 = u[2] - v[2], d3 = u[3] - v[3], d4 = u[4] - v[4];
  return (d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4) / (u[INVERSE] + v[INVERSE]);
}

API void merge_costs(const float *rows, const int32_t *pairs, float *costs, int64_t capacity,
                     int64_t count) {
  (void)capacity;
  for (int64_t e = 0; e < count; e++)
    costs[e] = merge_cost(rows + ROW * pairs[2 * e], rows + ROW * pairs[2 * e + 1]);
}

static inline void set_edge(Edges *edges, int64_t e, int32_t u, int32_t v, float cost) {
  edges->pairs[2 * e] = u;
  edges->pairs[2 * e + 1] = v;
  edges->costs[e] = cost;
}

// Compute the cost of every edge and the least cost of each region; drop inner edges and park
// expensive ones. Edges are written to both lists, and the counts decide if they stay. Branches here
// would be mispredicted half of the time.
static void weigh(Edges *edges, Edges *parked, const Tree *tree, float ceiling) {
  const int32_t *parents = tree->parents;
  float *best = tree->best_costs;
  int64_t kept = 0, num_parked = parked->count;
  for (int64_t e = 0; e < edges->count; e++) {
    int32_t u = edges->pairs[2 * e], v = edges->pairs[2 * e + 1];
    u = parents[u] >= 0 ? parents[u] : u;
    v = parents[v] >= 0 ? parents[v] : v;
    float cost = merge_cost(tree->rows + ROW * u, tree->rows + ROW * v) + pair_tie(u, v);
    bool outer = u != v, cheap = cost <= ceiling;
    set_edge(parked, num_parked, u, v, cost);
    num_parked += outer & !cheap;
    set_edge(edges, kept, u, v, cost);
    kept += outer & cheap;
    bits4 bid = {.f = cost};
    // Sets the bits of inf or NaN, which are not less than any cost. A choice between floats would be a branch
    bid.u |= (outer & cheap) ? 0 : 0x7f800000;
    best[u] = minf(bid.f, best[u]);
    best[v] = minf(bid.f, best[v]);
  }
  edges->count = kept;
  parked->count = num_parked;
}

// Make a new node the parent of two regions.
static void join(Tree *tree, int32_t u, int32_t v, float height) {
  const float *a = tree->rows + ROW * u, *b = tree->rows + ROW * v;
  float *row = tree->rows + ROW * tree->num_nodes;
  float sum = a[NUM_PIXELS] + b[NUM_PIXELS], share = a[NUM_PIXELS] / sum;
  for (int i = 0; i < 5; i++) row[i] = b[i] + share * (a[i] - b[i]);
  row[NUM_PIXELS] = sum;
  row[INVERSE] = 1 / sum;
  row[HEIGHT] = maxf(height, maxf(a[HEIGHT], b[HEIGHT]));
  tree->parents[u] = tree->parents[v] = (int32_t)tree->num_nodes++;
}

// Merge the two regions of every edge that is the cheapest of both.
static void join_mutual(const Edges *edges, Tree *tree) {
  for (int64_t e = 0; e < edges->count; e++) {
    int32_t u = edges->pairs[2 * e], v = edges->pairs[2 * e + 1];
    float cost = edges->costs[e];
    if ((cost == tree->best_costs[u]) & (cost == tree->best_costs[v]) && tree->parents[u] < 0
        && tree->parents[v] < 0)
      join(tree, u, v, cost);
  }
  for (int64_t i = 0; i < 2 * edges->count; i++)
    tree->best_costs[edges->pairs[i]] = __builtin_inff();
}

// Return parked edges to the active ones if their cost may be below the new ceiling.
static void unpark(Edges *edges, Edges *parked, const int32_t *parents, float ceiling) {
  int64_t left = 0;
  for (int64_t e = 0; e < parked->count; e++) {
    int32_t u = parked->pairs[2 * e], v = parked->pairs[2 * e + 1];
    float cost = parked->costs[e];
    while (parents[u] >= 0) u = parents[u];
    while (parents[v] >= 0) v = parents[v];
    if (u == v) continue;
    if (cost <= ceiling * RETURN_MARGIN)
      set_edge(edges, edges->count++, u, v, cost);
    else
      set_edge(parked, left++, u, v, cost);
  }
  parked->count = left;
}

API int64_t merge_tree(int64_t num_leaves, int64_t num_merges, float ceiling, int32_t *pairs,
                       float *costs, int32_t *parked_pairs, float *parked_costs, float *rows,
                       int32_t *parents, float *best_costs, int64_t num_pairs, int64_t capacity,
                       int64_t num_nodes) {
  if (capacity <= num_pairs || num_leaves > num_nodes / 2) return -OUTSIDE;
  Edges edges = {pairs, costs, num_pairs}, parked = {parked_pairs, parked_costs, 0};
  Tree tree = {rows, parents, best_costs, num_leaves};
  for (int64_t i = 0; i < num_nodes; i++) {
    parents[i] = -1;
    best_costs[i] = __builtin_inff();
  }
  ceiling = maxf(ceiling, LEAST_CEILING);
  for (;;) {
    int64_t before = tree.num_nodes;
    weigh(&edges, &parked, &tree, ceiling);
    join_mutual(&edges, &tree);
    if (tree.num_nodes > before) continue;
    bool rises = ceiling < __builtin_inff();  // edges that remain above an infinite ceiling have a cost of NaN
    if (tree.num_nodes - num_leaves >= num_merges || parked.count == 0 || !rises)
      return tree.num_nodes;
    ceiling *= CEILING_GROWTH;
    unpark(&edges, &parked, parents, ceiling);
  }
}

API int32_t label_leaves(const int32_t *parents, const uint8_t *keep, int32_t *names,
                         int64_t num_leaves, int64_t num_nodes) {
  int32_t count = 0;
  for (int64_t node = num_nodes - 1; node >= 0; node--) {
    int64_t parent = parents[node];
    if (parent >= 0 && parent <= node) return OUTSIDE;
    if (parent >= 0 && keep[parent])
      names[node] = names[parent];
    else if (keep[node] || node < num_leaves)
      names[node] = count++;
  }
  return 0;
}
