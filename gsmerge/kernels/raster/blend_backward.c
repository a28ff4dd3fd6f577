// The backward pass of blending: gradients with respect to every Gaussian's conic and colour.
//
// Tiles are processed front to back again, with the weights of blend.c. Let g be the gradient of a pixel's colour C,
// and h that of its final transmittance T. A pixel starts with rest = g.C + h T. Every Gaussian subtracts its w (g.c),
// so that the rest is the part behind it. Then
//
//     d loss / d ln alpha = w (g.c) - alpha / (1 - alpha) rest
//
// needs no list of the blended Gaussians and no division of transmittances.
#include "walk.h"

enum { SUMS = 9 };

// Sums over rows, by column, of the gradients of one Gaussian; v are the gradients of ln alpha.
typedef struct {
  v8f red, green, blue, v, vy, vyy;
} Wants;

// Remove Gaussian j of a batch from the pixels of rows y0 to y1, or of every second row, of eight columns; return the
// gradients.
static inline Wants walk_rows(float *columns, const v8f *alphas, const Batch *b, int64_t j, int32_t y0, int32_t y1,
                              int32_t step) {
  float my = b->my[j], red = b->red[j], green = b->green[j], blue = b->blue[j];
  Wants w = {{0}, {0}, {0}, {0}, {0}, {0}};
  for (int32_t y = y0; y <= y1; y += step) {
    float *row = columns + y * TILE, dy = (float)y - my;
    Share s = take_share(load8(row), alphas[y]);
    v8f g0 = load8(row + 2 * PLANE), g1 = load8(row + 3 * PLANE), g2 = load8(row + 4 * PLANE);
    v8f own = s.weight * (red * g0 + green * g1 + blue * g2), rest = load8(row + PLANE) - own;
    v8f v = sel8(s.goes & s.unclamped, own - s.alpha * rest / (1.f - s.alpha), splat8(0.f)), vy = v * dy;
    store8(row, s.left);
    store8(row + PLANE, rest);
    w.red += s.weight * g0;
    w.green += s.weight * g1;
    w.blue += s.weight * g2;
    w.v += v;
    w.vy += vy;
    w.vyy += vy * dy;
  }
  return w;
}

// Sum over all columns; x is the same in all rows of a lane, so moments with x are computed here.
static inline void add_columns(Wants a, Wants b, v16f dx, float *slot) {
  v16f v = join8(a.v, b.v), vy = join8(a.vy, b.vy), vx = v * dx;
  v16f sums[8] = {join8(a.red, b.red), join8(a.green, b.green), join8(a.blue, b.blue), v, vx, vy, vx * dx, vy * dx};
  store8(slot, totals(sums));
  slot[8] = total(join8(a.vyy, b.vyy));
}

// Remove Gaussian j of a batch from the pixels of rows y0 to y1 and write its gradients. There are sixteen sums by
// column: of both halves of the tile, or of the even and the odd rows of the eight columns in which it shows.
static inline void walk_one(float *state, const Batch *b, int64_t j, int32_t y0, int32_t y1, float *slot) {
  Curve curve;
  v8f alphas[TILE];
  trace(&curve, b, j);
  if (b->x0[j] == WIDE) {
    fill_alphas(alphas, &curve, 0, y0, y1);
    Wants left = walk_rows(state, alphas, b, j, y0, y1, 1);
    fill_alphas(alphas, &curve, HALF, y0, y1);
    add_columns(left, walk_rows(state + HALF, alphas, b, j, y0, y1, 1), COLUMNS - b->mx[j], slot);
  } else {
    int32_t odd = y0 > 0 && (y1 - y0) % 2 == 0, x = b->x0[j];  // odd: the rows begin with the second one of a pair
    fill_alphas(alphas, &curve, x, y0, y1);
    Wants first = walk_rows(state + x, alphas, b, j, y0 + odd, y1, 2);
    Wants second = walk_rows(state + x, alphas, b, j, y0 + 1 - odd, y1, 2);
    add_columns(first, second, PAIR_COLUMNS + (float)x - b->mx[j], slot);
  }
}

API int32_t blend_backward(const float *restrict conics, const int32_t *restrict flatten_ids,
                           const int64_t *restrict isect_offsets, int64_t tile_width, const float *restrict colors,
                           int64_t first, int64_t last, const float *restrict image,
                           const float *restrict transmittance, const float *restrict grad_image,
                           const float *restrict grad_left, float *restrict slots, int64_t m, int64_t n, int64_t ends,
                           int64_t h, int64_t w) {
  Lists lists = {conics, flatten_ids, isect_offsets, tile_width, m, n, ends};
  if (!lists_are_sound(&lists, first, last)) return OUTSIDE;
  float state[5 * PLANE] __attribute__((aligned(64)));
  Batch batch;
  clear_batch(&batch);
  for (int64_t tile = first; tile < last; tile++) {
    Tile t = open_tile(state, 5, tile, tile_width, h, w);
    for (int y = 0; y < t.num_y; y++)
      for (int x = 0; x < t.num_x; x++) {
        int64_t pixel = (t.top + y) * w + t.left + x;
        float *lane = state + y * TILE + x, rest = grad_left ? grad_left[pixel] * transmittance[pixel] : 0.f;
        for (int c = 0; c < 3; c++) {
          float g = grad_image[3 * pixel + c];
          lane[(2 + c) * PLANE] = g;
          rest += g * image[3 * pixel + c];
        }
        lane[PLANE] = rest;
      }
    int64_t start = isect_offsets[tile], end = isect_offsets[tile + 1];
    for (; start < end && t.y_low <= t.y_high; start += BATCH) {
      int64_t stop = mini(end, start + BATCH);
      if (!gather(&batch, &t, &lists, start, stop, end)) return OUTSIDE;
      gather_colors(&batch, colors, flatten_ids, start, stop, end);
      for (int64_t j = 0; j < stop - start; j++) {
        int32_t y0 = first_row(&t, &batch, j), y1 = last_row(&t, &batch, j);
        float *slot = slots + SUMS * (start + j);
        if (y0 > y1)
          for (int c = 0; c < SUMS; c++) slot[c] = 0.f;
        else
          walk_one(state, &batch, j, y0, y1, slot);
      }
      narrow_tile(&t, state);
    }
    for (int64_t i = SUMS * start; i < SUMS * end; i++) slots[i] = 0.f;
  }
  return 0;
}

// Intersections of Gaussians in other ranges are left out without a branch, which would be mispredicted.
API int32_t gather_slots(const int32_t *restrict flatten_ids, const float *restrict slots, int64_t first, int64_t last,
                         float *restrict sums, int64_t n, int64_t m) {
  if (first < 0 || last > m) return OUTSIDE;
  for (int64_t start = 0; start < n; start += PLANE) {
    int64_t stop = mini(n, start + PLANE), inside[PLANE], count = 0;
    for (int64_t i = start; i < stop; i++) {
      inside[count] = i;
      count += (flatten_ids[i] >= first) & (flatten_ids[i] < last);
    }
    for (int64_t j = 0; j < count; j++) {
      const float *slot = slots + SUMS * inside[j];
      float *sum = sums + SUMS * (int64_t)flatten_ids[inside[j]];
      for (int c = 0; c < SUMS; c++) sum[c] += slot[c];
    }
  }
  return 0;
}
