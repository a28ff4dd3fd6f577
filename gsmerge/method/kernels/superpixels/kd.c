// Cut a picture into rectangles, from which merging starts.
#include "native.h"

// Cuts are queued in buckets by the exponent and three mantissa bits of their gain, so a nearly best
// one is found in O(1).
enum { NUM_BUCKETS = 2048, BUCKET_SHIFT = 20 };
enum {
  CUT = 4,
  NEXT,
  NODE = 8
};  // columns of the row of a rectangle after y0, x0, y1, x1; and length of the row

typedef struct {
  const double *integral;
  int64_t stride;  // number of entries of a line of the integral image
  double compactness;
  int32_t *nodes;
  int64_t *heads;
} Queue;
typedef struct {
  double gain;
  int64_t cut;
} Cut;

API int32_t integral_image(const float *pixels, double *integral, int64_t height, int64_t width,
                           int64_t places) {
  int64_t stride = 3 * (width + 1);
  if (places != (height + 1) * (width + 1)) return OUTSIDE;
  for (int64_t i = 0; i < stride; i++) integral[i] = 0;
  for (int64_t y = 0; y < height; y++) {
    double red = 0, green = 0, blue = 0, *row = integral + (y + 1) * stride;
    row[0] = row[1] = row[2] = 0;
    for (int64_t x = 0; x < width; x++) {
      const float *pixel = pixels + 3 * (y * width + x);
      double *at = row + 3 * (x + 1);
      red += pixel[0];
      green += pixel[1];
      blue += pixel[2];
      at[0] = at[0 - stride] + red;
      at[1] = at[1 - stride] + green;
      at[2] = at[2 - stride] + blue;
    }
  }
  return 0;
}

// The best cut of a rectangle across one of its sides. `near` and `far` are the corners at both ends of the side that
// is not cut, and `step` is the distance of neighbours along the side that is cut.
static inline Cut best_cut(const double *near, const double *far, int64_t step, int64_t side,
                           double num_pixels, double compactness) {
  double length = (double)side, spatial = 0.25 * compactness * num_pixels * num_pixels, total[3],
         base[3];
  for (int i = 0; i < 3; i++) {
    double first = far[i] - near[i];
    total[i] = far[3 * step * side + i] - near[3 * step * side + i] - first;
    base[i] = length * first;
  }
  double best = -1;
  int64_t best_at = 0;
  for (int64_t cut = 1; cut < side; cut++) {
    const double *n = near + 3 * step * cut, *f = far + 3 * step * cut;
    double before = (double)cut, balance = before * (length - before);
    double d0 = length * (f[0] - n[0]) - (before * total[0] + base[0]);
    double d1 = length * (f[1] - n[1]) - (before * total[1] + base[1]);
    double d2 = length * (f[2] - n[2]) - (before * total[2] + base[2]);
    double gain = (d0 * d0 + d1 * d1 + d2 * d2) / balance + spatial * balance;
    best_at = gain > best ? cut : best_at;
    best = gain > best ? gain : best;
  }
  return (Cut){.gain = best / num_pixels, .cut = best_at};
}

API int32_t cut_gain(const double *integral, int64_t near, int64_t far, int64_t step, int64_t side,
                     double num_pixels, double compactness, double *found, int64_t places) {
  if (maxi(near, far) >= places || side > (places - 1 - maxi(near, far)) / step) return OUTSIDE;
  Cut best = best_cut(integral + 3 * near, integral + 3 * far, step, side, num_pixels, compactness);
  found[0] = best.gain;
  found[1] = (double)best.cut;
  return 0;
}

// Store a rectangle with its best cut, in the bucket of its gain, but not above the bucket `limit`. Single pixels are
// not stored. A cut of a part comes after the cut that made the part, so its bucket need not be above the one that is
// emptied.
static void enqueue(const Queue *queue, int64_t node, int64_t limit, int64_t y0, int64_t x0,
                    int64_t y1, int64_t x1) {
  int64_t height = y1 - y0, width = x1 - x0, stride = queue->stride;
  double num_pixels = (double)height * (double)width;
  const double *near = queue->integral + 3 * (y0 * stride + x0);
  Cut down = best_cut(near, near + 3 * width, stride, height, num_pixels, queue->compactness);
  Cut across = best_cut(near, near + 3 * height * stride, 1, width, num_pixels, queue->compactness);
  int32_t *row = queue->nodes + NODE * node;
  row[0] = (int32_t)y0;
  row[1] = (int32_t)x0;
  row[2] = (int32_t)y1;
  row[3] = (int32_t)x1;
  row[CUT] = (int32_t)(down.gain >= across.gain ? y0 + down.cut : -(x0 + across.cut));
  bits4 gain = {.f = (float)maxd(down.gain, across.gain)};
  if (!(gain.f >= 0)) return;
  int64_t bucket = mini(limit, gain.u >> BUCKET_SHIFT);
  row[NEXT] = (int32_t)queue->heads[bucket];
  queue->heads[bucket] = (int32_t)node;
}

static void paint(const int32_t *nodes, int64_t count, int32_t *labels, int64_t height,
                  int64_t width) {
  for (int64_t i = 0; i < (height + 2) * (width + 2); i++) labels[i] = -1;
  for (int64_t node = 0; node < count; node++) {
    const int32_t *row = nodes + NODE * node;
    for (int64_t y = row[0]; y < row[2]; y++) {
      int32_t *line = labels + (y + 1) * (width + 2) + 1;
      for (int64_t x = row[1]; x < row[3]; x++) line[x] = (int32_t)node;
    }
  }
}

API int64_t split_rectangles(const double *integral, int64_t count, int64_t block,
                             double compactness, int32_t *nodes, int64_t *heads, int32_t *labels,
                             int64_t places, int64_t capacity, int64_t padded_height,
                             int64_t padded_width) {
  int64_t height = padded_height - 2, width = padded_width - 2, stride = width + 1;
  if (height < 0 || width < 0 || places != (height + 1) * stride) return -OUTSIDE;
  int64_t num_rows = maxi(1, height / block), num_columns = maxi(1, width / block), num_leaves = 0;
  if (capacity < maxi(count, num_rows * num_columns)) return -OUTSIDE;
  Queue queue = {integral, stride, compactness, nodes, heads};
  for (int i = 0; i < NUM_BUCKETS; i++) heads[i] = -1;
  for (int64_t i = 0; i < num_rows; i++)
    for (int64_t j = 0; j < num_columns; j++)
      enqueue(&queue, num_leaves++, NUM_BUCKETS - 1, i * height / num_rows, j * width / num_columns,
              (i + 1) * height / num_rows, (j + 1) * width / num_columns);
  for (int64_t bucket = NUM_BUCKETS - 1; num_leaves < count && bucket >= 0;) {
    int64_t node = heads[bucket];
    if (node < 0) {
      bucket--;
      continue;
    }
    const int32_t *row = nodes + NODE * node;
    heads[bucket] = row[NEXT];
    int64_t y0 = row[0], x0 = row[1], y1 = row[2], x1 = row[3], cut = row[CUT];
    bool down = cut > y0;
    enqueue(&queue, node, bucket, y0, x0, down ? cut : y1, down ? x1 : -cut);
    enqueue(&queue, num_leaves++, bucket, down ? cut : y0, down ? x0 : -cut, y1, x1);
  }
  paint(nodes, num_leaves, labels, height, width);
  return num_leaves;
}
