// Project points into views, to measure how far they are from their pixels, or to find which views see them.
#include "native.h"

// A row of a matrix times a vector, in the order of multiply_matrices.
static inline double row_times(const double *row, const double *v) {
  double sum = 0.0;
  for (int t = 0; t < 3; t++) sum += v[t] * row[t];
  return sum;
}

API int32_t pixel_errors(const double *points, const int64_t *views, const double *viewmats, const double *Ks,
                         const double *pixels, double *errors, int64_t n, int64_t v) {
  for (int64_t i = 0; i < n; i++) {
    if ((uint64_t)views[i] >= (uint64_t)v) return OUTSIDE;
    const double *viewmat = viewmats + 16 * views[i], *K = Ks + 9 * views[i];
    double camera[3], image[3];
    for (int c = 0; c < 3; c++) camera[c] = row_times(viewmat + 4 * c, points + 3 * i) + viewmat[4 * c + 3];
    for (int c = 0; c < 3; c++) image[c] = row_times(K + 3 * c, camera);
    double x = image[0] / image[2] - pixels[2 * i], y = image[1] / image[2] - pixels[2 * i + 1];
    // products in statements of their own are not fused with the sum
    double xx = x * x, yy = y * y, error = sqrtf8(xx + yy);
    errors[i] = camera[2] > 0.0 && error < __builtin_inf() ? error : __builtin_inf();
  }
  return 0;
}

// Project a point into a camera, and write its pixel and its depth. Return 1 if it is inside the image, otherwise 0.
static inline int show(const double point[3], const double *viewmat, const double *K, int64_t width, int64_t height,
                       double place[3]) {
  double camera[3], image[3];
  for (int c = 0; c < 3; c++) camera[c] = row_times(viewmat + 4 * c, point) + viewmat[4 * c + 3];
  if (!(camera[2] > 0.0)) return 0;
  for (int c = 0; c < 3; c++) image[c] = row_times(K + 3 * c, camera);
  double x = image[0] / image[2], y = image[1] / image[2];
  if (!(x >= 0.0 && x < (double)width && y >= 0.0 && y < (double)height)) return 0;
  place[0] = x, place[1] = y, place[2] = camera[2];
  return 1;
}

enum { BLOCK = 64 };  // number of points that are projected together, in loops that vectorise

API void mark_pixels(const double *points, const double *viewmat, const double *K, double near, uint8_t *hit, int64_t n,
                     int64_t height, int64_t width) {
  double x[BLOCK], y[BLOCK], z[BLOCK];
  for (int64_t start = 0; start < n; start += BLOCK) {
    const double *block = points + 3 * start;
    int64_t count = mini(BLOCK, n - start);
    for (int64_t i = 0; i < count; i++) {
      double camera[3];
      for (int c = 0; c < 3; c++) camera[c] = row_times(viewmat + 4 * c, block + 3 * i) + viewmat[4 * c + 3];
      z[i] = row_times(K + 6, camera);
      x[i] = row_times(K, camera) / z[i];
      y[i] = row_times(K + 3, camera) / z[i];
    }
    for (int64_t i = 0; i < count; i++)
      if (z[i] > near && x[i] >= 0.0 && x[i] < (double)width && y[i] >= 0.0 && y[i] < (double)height)
        hit[(int64_t)y[i] * width + (int64_t)x[i]] = 1;
  }
}

// For each of v cameras, mark which of n points are inside its picture, farther than `near`, and which of these are
// seen: at most `behind` times as far as the depth of their cell in a grid of lines and columns over the picture.
API void see_points(const double *points, const double *viewmats, const double *Ks, const double *depths, double width,
                    double height, double near, double behind, uint8_t *inside, uint8_t *seen, int64_t n, int64_t v,
                    int64_t lines, int64_t columns) {
  double across = (double)columns / width, down = (double)lines / height;
  for (int64_t view = 0; view < v; view++) {
    const double *viewmat = viewmats + 16 * view, *K = Ks + 9 * view, *grid = depths + view * lines * columns;
    for (int64_t i = 0; i < n; i++) {
      double camera[3], image[3];
      for (int c = 0; c < 3; c++) camera[c] = row_times(viewmat + 4 * c, points + 3 * i) + viewmat[4 * c + 3];
      for (int c = 0; c < 3; c++) image[c] = row_times(K + 3 * c, camera);
      double x = image[0] / image[2], y = image[1] / image[2];
      bool is_inside = camera[2] > near && x > 0.0 && x < width && y > 0.0 && y < height;
      inside[view * n + i] = is_inside;
      seen[view * n + i] = 0;
      if (!is_inside) continue;
      int64_t line = mini((int64_t)(y * down), lines - 1), column = mini((int64_t)(x * across), columns - 1);
      seen[view * n + i] = camera[2] <= behind * grid[line * columns + column];
    }
  }
}

// Find the first of the ascending `tails [length]` that is not less than a key. The search starts at `hint` and doubles
// its steps, because the next point of a view usually belongs beside the last one.
static inline int64_t find_tail(const int64_t *tails, int64_t length, int64_t key, int64_t hint) {
  int64_t low = 0, high = length, step = 1;
  if (hint < length && tails[hint] < key) {
    for (low = hint + 1; low + step <= length && tails[low + step - 1] < key; step *= 2) low += step;
    high = mini(length, low + step - 1);
  } else {
    for (high = mini(hint, length); high >= step && tails[high - step] >= key; step *= 2) high -= step;
    low = maxi(0, high - step + 1);
  }
  while (low < high) {
    int64_t middle = (low + high) / 2;
    if (tails[middle] < key) low = middle + 1; else high = middle;
  }
  return low;
}

// Find the longest ascending series of keys with at most one key of each point (Schensted 1961). tails [length] is the
// smallest last key of all series of that length, ends its number i * v + view, and before the number that precedes
// each key in its series.
API int64_t follow_pixels(const float *points, const double *viewmats, const double *Ks, int64_t *ids, int64_t *tails,
                          int32_t *ends, int32_t *before, int64_t *keys, int32_t *views, int64_t *hints,
                          int64_t width, int64_t height, int32_t mixed, int64_t n, int64_t v, int64_t m) {
  int64_t length = 0, area = width * height;
  if (m != n * v) return -1;
  for (int64_t view = 0; view < v; view++) hints[view] = 0;
  double place[3];
  for (int64_t i = 0; i < n; i++) {
    double point[3] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    int64_t count = 0;
    ids[i] = -1;
    for (int64_t view = 0; view < v; view++) {
      if (!show(point, viewmats + 16 * view, Ks + 9 * view, width, height, place)) continue;
      int64_t pixel = (int64_t)place[1] * width + (int64_t)place[0], at = count++;
      int64_t key = mixed ? pixel * v + view : view * area + pixel;
      for (; at > 0 && keys[at - 1] < key; at--) keys[at] = keys[at - 1], views[at] = views[at - 1];
      keys[at] = key, views[at] = (int32_t)view;
    }
    // the largest key comes first, so that no key follows another key of the same point
    for (int64_t k = 0; k < count; k++) {
      int64_t low = find_tail(tails, length, keys[k], hints[views[k]]), number = i * v + views[k];
      hints[views[k]] = low;
      before[number] = low ? ends[low - 1] : -1;
      tails[low] = keys[k], ends[low] = (int32_t)number;
      if (low == length) length++;
    }
  }
  for (int64_t number = length ? ends[length - 1] : -1; number >= 0; number = before[number]) {
    int64_t i = number / v, view = number % v;
    double point[3] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    show(point, viewmats + 16 * view, Ks + 9 * view, width, height, place);
    ids[i] = (view * height + (int64_t)place[1]) * width + (int64_t)place[0];
  }
  return length;
}

// Products are separate statements, so that each is rounded by itself.
static inline double minus(double a, double b, double c, double d) {
  double left = a * b, right = c * d;
  return left - right;
}

API int32_t linearise(const double *points, const double *pixels, const double *K, const double *pose,
                      double *jacobian, double *residuals, int64_t n, int64_t rows, int64_t size) {
  int64_t free = size - 6;
  if (rows != 2 * n || free < 0 || free > 4) return OUTSIDE;
  double fx = K[0], fy = K[4], cx = K[2], cy = K[5];
  for (int64_t i = 0; i < n; i++) {
    double camera[3];
    for (int c = 0; c < 3; c++) camera[c] = row_times(pose + 4 * c, points + 3 * i) + pose[4 * c + 3];
    double inverse = 1.0 / camera[2], u = fx * (camera[0] / camera[2]), v = fy * (camera[1] / camera[2]);
    double ways[2][3] = {{fx * inverse, 0.0, -u * inverse}, {0.0, fy * inverse, -v * inverse}}, value[2] = {u, v};
    double offset[2] = {u + cx, v + cy};
    for (int axis = 0; axis < 2; axis++) {
      double *row = jacobian + (i + axis * n) * size, *way = ways[axis];
      for (int c = 0; c < 3; c++) {
        int after = (c + 1) % 3, last = (c + 2) % 3;
        row[c] = minus(camera[after], way[last], camera[last], way[after]);
        row[3 + c] = way[c];
      }
      for (int64_t k = 6; k < size; k++) row[k] = 0.0;
      if (free) row[free == 1 ? 6 : 6 + axis] = value[axis];
      if (free == 4) row[8 + axis] = 1.0;
      residuals[i + axis * n] = offset[axis] - pixels[2 * i + axis];
    }
  }
  return 0;
}
