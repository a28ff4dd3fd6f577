// Merge the regions of a view, one pair after another, cheapest first.
#include "labels.h"

// Columns of the row of a region after its mean, which has three colours, y and x. The nine columns from PLANE on are
// sums over the pixels of z², z²x, z²y, z²xx, z²xy, z²yy, z, zx and zy. The box is the largest -y, y, -x and x in whole
// pixels.
enum { NUM_PIXELS = 5, PLANE, PLANE_ERROR = 15, BOX };
static const int64_t ROW = 20;
// Ridge of the fit of planes, in square pixels. It determines the slopes if there are fewer than three points
static const double SLOPE_RIDGE = 1e-3;
static const int32_t NEVER = -1000000000;  // box of a region without pixels
static const double OVERSIZE = 1e9;        // added to the cost of a merge that makes too large a region

typedef double v4d __attribute__((vector_size(32), aligned(8)));
typedef struct {
  double error, place;
} Growth;

// The edges, which are pairs of neighbouring regions: a heap of them by cost, and a list of half-edges for each region.
// Edge e has the half-edges 2e and 2e + 1.
typedef struct {
  double *costs;
  int32_t *heap;    // edges, the cheapest first
  int32_t *places;  // place of each edge in the heap, or -1 once it was removed
  int32_t *heads;   // first half-edge of each region
  int32_t *nexts;   // next half-edge in the list of each half-edge
  int32_t *ends;    // region to which each half-edge leads
  int64_t size;
} Edges;

typedef struct {
  double *rows;
  double depth_weight, compactness, max_extent;
} Regions;

// The minimum over a, b, c of the sum of (1 - z (a x + b y + c))² over n pixels, with a ridge on the slopes a and b.
static inline double plane_error(double n, const double *s) {
  double w = s[0], z = s[6];
  if (w <= 0) return 0;
  double x = s[1] / w, y = s[2] / w, ridge = SLOPE_RIDGE * w;
  double sxx = s[3] - s[1] * x + ridge, sxy = s[4] - s[1] * y, syy = s[5] - s[2] * y + ridge;
  double bx = s[7] - x * z, by = s[8] - y * z;
  double explained = (syy * bx * bx - 2 * sxy * bx * by + sxx * by * by) / (sxx * syy - sxy * sxy);
  return maxd(n - z * z / w - explained, 0);
}

// Add a pixel with its colour, place and depth to a region's row of sums, and its squared colour to
// the column of the error. It adds four numbers at a time, because unaligned vectors of eight take longer.
static inline void add_pixel(double *row, const float *pixel, double y, double x, double z) {
  v4d *sums = (v4d *)row;
  double r = pixel[0], g = pixel[1], b = pixel[2], zz = z * z;
  sums[0] += (v4d){r, g, b, y};
  sums[1] += (v4d){x, 1, zz, zz * x};
  sums[2] += (v4d){zz * y, zz * x * x, zz * x * y, zz * y * y};
  sums[3] += (v4d){z, z * x, z * y, r * r + g * g + b * b};
}

API int32_t region_sums(const int32_t *labels, const float *pixels, const float *depths,
                        double *rows, int32_t *boxes, double *squares, int64_t padded_height,
                        int64_t padded_width, int64_t height, int64_t width, int64_t capacity,
                        int64_t count) {
  if (count > capacity || !labels_fit(labels, padded_height, padded_width, height, width, count))
    return OUTSIDE;
  double sum = 0;
  for (int64_t i = 0; i < count; i++) {
    for (int j = 0; j < ROW; j++) rows[ROW * i + j] = 0;
    for (int j = 0; j < 4; j++) boxes[4 * i + j] = NEVER;
  }
  for (int64_t v = 0; v < height; v++)
    for (int64_t u = 0; u < width; u++) {
      int64_t at = v * width + u;
      if (depths[at] <= 0) continue;
      double y = (double)v + 0.5 - 0.5 * (double)height, x = (double)u + 0.5 - 0.5 * (double)width;
      int64_t label = labels[(v + 1) * padded_width + u + 1];
      double *row = rows + ROW * label;
      int32_t *box = boxes + 4 * label;
      const int32_t place[4] = {(int32_t)-v, (int32_t)v, (int32_t)-u, (int32_t)u};
      add_pixel(row, pixels + 3 * at, y, x, depths[at]);
      for (int i = 0; i < 4; i++) box[i] = place[i] > box[i] ? place[i] : box[i];
    }
  for (int64_t i = 0; i < count; i++) {
    double *row = rows + ROW * i, n = row[NUM_PIXELS];
    for (int j = 0; j < 5 && n > 0; j++) row[j] /= n;
    sum += row[PLANE_ERROR] - n * (row[0] * row[0] + row[1] * row[1] + row[2] * row[2]);
    row[PLANE_ERROR] = plane_error(n, row + PLANE);
    for (int j = 0; j < 4; j++) row[BOX + j] = boxes[4 * i + j];
  }
  squares[0] = maxd(sum, 0);
  return 0;
}

// By how much the error grows if two regions merge: that of colour and depth, and that of position times compactness.
static inline Growth growth_of(const double *a, const double *b, double depth_weight,
                               double compactness) {
  double n_a = a[NUM_PIXELS], n_b = b[NUM_PIXELS], sums[9];
  if (n_a == 0 || n_b == 0) return (Growth){0, 0};
  for (int i = 0; i < 9; i++) sums[i] = a[PLANE + i] + b[PLANE + i];
  double d0 = a[0] - b[0], d1 = a[1] - b[1], d2 = a[2] - b[2], d3 = a[3] - b[3], d4 = a[4] - b[4];
  double ward = n_a * n_b / (n_a + n_b);
  double bend = maxd(plane_error(n_a + n_b, sums) - a[PLANE_ERROR] - b[PLANE_ERROR], 0);
  return (Growth){ward * (d0 * d0 + d1 * d1 + d2 * d2) + depth_weight * bend,
                  ward * compactness * (d3 * d3 + d4 * d4)};
}

API void merge_growth(const double *rows, int64_t u, int64_t v, double depth_weight,
                      double compactness, double *growth, int64_t capacity) {
  (void)capacity;
  Growth found = growth_of(rows + ROW * u, rows + ROW * v, depth_weight, compactness);
  growth[0] = found.error;
  growth[1] = found.place;
}

static inline double cost_of(const Regions *regions, int64_t u, int64_t v) {
  const double *a = regions->rows + ROW * u, *b = regions->rows + ROW * v;
  Growth growth = growth_of(a, b, regions->depth_weight, regions->compactness);
  double high = maxd(a[BOX], b[BOX]) + maxd(a[BOX + 1], b[BOX + 1]);
  double wide = maxd(a[BOX + 2], b[BOX + 2]) + maxd(a[BOX + 3], b[BOX + 3]);
  return growth.error + growth.place + (maxd(high, wide) >= regions->max_extent ? OVERSIZE : 0);
}

// The row of the union of two regions.
static void join(double *rows, int64_t u, int64_t v, int64_t node) {
  const double *a = rows + ROW * u, *b = rows + ROW * v;
  double *row = rows + ROW * node, sum = a[NUM_PIXELS] + b[NUM_PIXELS];
  double share = sum > 0 ? a[NUM_PIXELS] / sum : 0.5;
  for (int i = 0; i < NUM_PIXELS; i++) row[i] = b[i] + share * (a[i] - b[i]);
  for (int i = NUM_PIXELS; i < PLANE_ERROR; i++) row[i] = a[i] + b[i];
  row[PLANE_ERROR] = plane_error(sum, row + PLANE);
  for (int i = BOX; i < ROW; i++) row[i] = maxd(a[i], b[i]);
}

// Make the lists of half-edges, with every pair once; return the number of edges.
static int64_t link(const int32_t *pairs, int64_t num_pairs, Edges *edges) {
  int64_t num_edges = 0;
  for (int64_t i = 0; i < num_pairs; i++) {
    int32_t u = pairs[2 * i], v = pairs[2 * i + 1], half = edges->heads[u];
    while (half >= 0 && edges->ends[half] != v) half = edges->nexts[half];
    if (half >= 0) continue;
    for (int side = 0; side < 2; side++) {
      int32_t owner = side ? v : u;
      half = (int32_t)(2 * num_edges + side);
      edges->ends[half] = side ? u : v;
      edges->nexts[half] = edges->heads[owner];
      edges->heads[owner] = half;
    }
    num_edges++;
  }
  return num_edges;
}

static inline bool is_before(const double *costs, int32_t d, int32_t e) {
  return costs[d] < costs[e] || (costs[d] == costs[e] && d < e);
}

static inline void put(Edges *edges, int64_t at, int32_t edge) {
  edges->heap[at] = edge;
  edges->places[edge] = (int32_t)at;
}

// Move an edge up or down in the heap to the place for its cost.
static void settle(Edges *edges, int32_t edge) {
  const int32_t *heap = edges->heap;
  const double *costs = edges->costs;
  int64_t at = edges->places[edge], below;
  for (; at > 0 && is_before(costs, edge, heap[(at - 1) / 2]); at = (at - 1) / 2)
    put(edges, at, heap[(at - 1) / 2]);
  for (; (below = 2 * at + 1) < edges->size; at = below) {
    if (below + 1 < edges->size && is_before(costs, heap[below + 1], heap[below])) below++;
    if (!is_before(costs, heap[below], edge)) break;
    put(edges, at, heap[below]);
  }
  put(edges, at, edge);
}

// Remove an edge from the heap.
static void take(Edges *edges, int32_t edge) {
  int32_t at = edges->places[edge], last = edges->heap[--edges->size];
  edges->places[edge] = -1;
  if (last == edge) return;
  put(edges, at, last);
  settle(edges, last);
}

// Move the edges of a child of a new node to the node; edges of both children to the same neighbour
// become one edge.
static void move_edges(Edges *edges, const Regions *regions, int32_t *marks, int32_t child,
                       int32_t node) {
  for (int32_t half = edges->heads[child], following; half >= 0; half = following) {
    int32_t other = edges->ends[half], edge = half / 2;
    following = edges->nexts[half];
    if (edges->places[edge] < 0) continue;
    if (marks[other] == node) {
      take(edges, edge);
      continue;
    }
    marks[other] = node;
    edges->ends[half ^ 1] = node;
    edges->nexts[half] = edges->heads[node];
    edges->heads[node] = half;
    edges->costs[edge] = cost_of(regions, node, other);
    settle(edges, edge);
  }
}

API int32_t merge_order(int64_t num_leaves, const int32_t *pairs, double *rows, double depth_weight,
                        double compactness, double max_extent, int32_t *parents, double *heights,
                        double *growths, int32_t *heads, int32_t *marks, int32_t *nexts,
                        int32_t *ends, int32_t *heap, int32_t *places, double *costs,
                        int64_t num_pairs, int64_t num_nodes, int64_t num_halves) {
  if (num_leaves > num_nodes / 2 || num_halves != 2 * num_pairs || num_halves > INT32_MAX)
    return OUTSIDE;
  for (int64_t i = 0; i < num_pairs; i++)
    if (pairs[2 * i] == pairs[2 * i + 1]) return OUTSIDE;
  for (int64_t i = 0; i < num_nodes; i++) {
    parents[i] = heads[i] = marks[i] = -1;
    heights[i] = growths[i] = 0;
  }
  Regions regions = {rows, depth_weight, compactness, max_extent};
  Edges edges = {costs, heap, places, heads, nexts, ends, 0};
  int64_t num_edges = link(pairs, num_pairs, &edges);
  for (int32_t e = 0; e < num_edges; e++) {
    costs[e] = cost_of(&regions, ends[2 * e], ends[2 * e + 1]);
    put(&edges, edges.size++, e);
    settle(&edges, e);
  }
  for (int32_t node = (int32_t)num_leaves; edges.size > 0; node++) {
    int32_t edge = heap[0], children[2] = {ends[2 * edge], ends[2 * edge + 1]};
    const double *a = rows + ROW * children[0], *b = rows + ROW * children[1];
    heights[node] = costs[edge];
    take(&edges, edge);
    growths[node] = growth_of(a, b, depth_weight, compactness).error;
    join(rows, children[0], children[1], node);
    for (int i = 0; i < 2; i++) {
      parents[children[i]] = node;
      heights[node] = maxd(heights[node], heights[children[i]]);
      move_edges(&edges, &regions, marks, children[i], node);
    }
  }
  return 0;
}

API int32_t cut_labels(const int32_t *parents, const uint8_t *keep, int32_t *tops, int32_t *names,
                       int32_t *labels, int64_t num_nodes, int64_t num_merges, int64_t num_leaves) {
  if (num_leaves + num_merges < num_nodes || num_leaves > num_nodes) return OUTSIDE;
  int32_t count = 0;
  for (int64_t node = num_nodes - 1; node >= 0; node--) {
    int64_t parent = parents[node];
    if (parent >= 0 && (parent <= node || parent < num_leaves || parent >= num_nodes))
      return OUTSIDE;
    tops[node] = parent >= 0 && keep[parent - num_leaves] ? tops[parent] : (int32_t)node;
    names[node] = -1;
  }
  for (int64_t leaf = 0; leaf < num_leaves; leaf++) {
    int32_t *name = names + tops[leaf];
    if (*name < 0) *name = count++;
    labels[leaf] = *name;
  }
  return 0;
}
