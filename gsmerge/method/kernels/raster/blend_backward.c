// Run the backward pass of blending: compute the gradients by every Gaussian's conic and colour.
//
// Tiles are processed front to back again, with the weights of blend.c. Let g be the gradient of a pixel's colour C,
// and h that of its final transmittance T. Each pixel starts with rest = g.C + h T. Every Gaussian of weight w and
// colour c subtracts its w (g.c), so that the rest is what lies behind it. Then
//
//
// needs no list of the blended Gaussians and no division of transmittances.
#include "walk.h"

enum { SUMS = 9 };

// The sums of the gradients of a Gaussian in each column; v are the gradients of ln alpha.
typedef struct {
  pixels red, green, blue, v, vy, vyy;
} Wants;

// Subtract Gaussian j of a batch from the rests in a part of its rows; return the gradients.
INLINE Wants walk_part(float *state, const Curve *curve, Rows r, const Batch *b, int64_t j, int part) {
  float red = b->red[j], green = b->green[j], blue = b->blue[j];
  int32_t last = last_of(r, part);
  int64_t gap = gap_of(r);
  Wants w = {{0}, {0}, {0}, {0}, {0}, {0}};
  for (int32_t y = first_of(r, part); y <= last; y += step_of(r)) {
    float *row = state + y * TILE + r.x;
    Share s = take_share(load_part(row, gap, part), alphas_of(curve, y, r.wide, part));
    pixels g0 = load_part(row + 2 * PLANE, gap, part), g1 = load_part(row + 3 * PLANE, gap, part);
    pixels g2 = load_part(row + 4 * PLANE, gap, part), dy = spread_rows(&curve->dy, y, r.wide, part);
    pixels own = s.weight * (red * g0 + green * g1 + blue * g2), rest = load_part(row + PLANE, gap, part) - own;
    pixels v = pick(s.goes & s.unclamped, own - s.alpha * rest / (1.f - s.alpha), all(0.f)), vy = v * dy;
    store_part(row, gap, part, s.left);
    store_part(row + PLANE, gap, part, rest);
    w.red += s.weight * g0;
    w.green += s.weight * g1;
    w.blue += s.weight * g2;
    w.v += v;
    w.vy += vy;
    w.vyy += vy * dy;
  }
  return w;
}

// Sum over all columns. x is the same in all rows of a lane, so moments with x are computed here and not before.
INLINE void add_columns(const Wants w[PARTS], v16f dx, float *slot) {
  v16f v = JOIN(w, v), vy = JOIN(w, vy), vx = v * dx;
  v16f sums[8] = {JOIN(w, red), JOIN(w, green), JOIN(w, blue), v, vx, vy, vx * dx, vy * dx};
  store8(slot, totals(sums));
  slot[8] = total(JOIN(w, vyy));
}

// Subtract Gaussian j of a batch from the rests in its rows, and write its gradients.
INLINE void walk_rows(float *state, Rows r, const Batch *b, int64_t j, float *slot) {
  Curve curve;
  Wants w[PARTS];
  trace(&curve, b, j, r);
  for (int part = 0; part < PARTS; part++) w[part] = walk_part(state, &curve, r, b, j, part);
  add_columns(w, columns_in(r) - b->mx[j], slot);
}

INLINE void walk_one(float *state, const Batch *b, int64_t j, int32_t y0, int32_t y1, float *slot) {
  if (b->x0[j] == WIDE) walk_rows(state, (Rows){true, 0, y0, y1}, b, j, slot);
  else walk_rows(state, (Rows){false, b->x0[j], y0, y1}, b, j, slot);
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

// Add the slots of a range of Gaussians. Those of others are left out without a branch, which would be mispredicted.
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
