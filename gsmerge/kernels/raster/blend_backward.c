// The backward pass of blending: what a loss wants of every Gaussian's conic and colour.
//
// The tiles are walked front to back again, with the weights of blend.c. With g the gradient of a pixel's colour and h
// that of its transmittance, a pixel starts with the whole rest = g.C + h T (C its final colour, T its final
// transmittance); every Gaussian takes its w (g.c) away, so what is left is what lies behind it, and
//
//     d loss / d ln alpha = w (g.c) - alpha / (1 - alpha) rest
//
// needs no list of what was blended and no division of transmittances.
#include "walk.h"

enum { SUMS = 9 };

// Sums over rows, by column, of what pixels want of one Gaussian: v are the gradients of ln alpha.
typedef struct {
  v16f red, green, blue, v, vy, vyy;
} Wants;

// Take the share of a Gaussian off sixteen pixels, with gradients of their colours, and add what they want of it.
static inline v16f take_back(Wants *w, Share s, v16f rest, const v16f g[3], const float color[3], v16f dy) {
  v16f own = s.weight * (color[0] * g[0] + color[1] * g[1] + color[2] * g[2]);
  rest = rest - own;
  v16f v = own - s.alpha * rest / (1.f - s.alpha);
  v = sel(s.goes & s.unclamped, v, splat(0.f));
  v16f vy = v * dy;
  w->red += s.weight * g[0];
  w->green += s.weight * g[1];
  w->blue += s.weight * g[2];
  w->v += v;
  w->vy += vy;
  w->vyy += vy * dy;
  return rest;
}

// Add all columns; x is the same in all rows of a lane, so its moments wait until here.
static inline void add_columns(const Wants *w, v16f dx, float *slot) {
  v16f vx = w->v * dx;
  store8(slot, totals((v16f[8]){w->red, w->green, w->blue, w->v, vx, w->vy, vx * dx, w->vy * dx}));
  slot[8] = total(w->vyy);
}

// Take Gaussian j of a batch off the pixels of rows y0 to y1 and write what they want of it.
static inline void walk_rows(float *state, const Batch *b, int64_t j, int32_t y0, int32_t y1, float *slot) {
  Curve curve = curve_of(b, (int)j);
  float color[3] = {b->red[j], b->green[j], b->blue[j]};
  Wants wants = {{0}, {0}, {0}, {0}, {0}, {0}};
  for (int32_t y = y0; y <= y1; y++) {
    float *row = state + y * TILE, dy = (float)y - curve.my;
    Share s = take_share(load(row), exponents(&curve, dy));
    v16f g[3] = {load(row + 2 * PLANE), load(row + 3 * PLANE), load(row + 4 * PLANE)};
    store(row, s.left);
    store(row + PLANE, take_back(&wants, s, load(row + PLANE), g, color, splat(dy)));
  }
  add_columns(&wants, COLUMNS - curve.mx, slot);
}

// The same over half a tile's columns, two rows at a time.
static inline void walk_pairs(float *state, const Batch *b, int64_t j, int32_t y0, int32_t y1, float *slot) {
  Curve curve = pair_curve_of(b, (int)j);
  float color[3] = {b->red[j], b->green[j], b->blue[j]};
  Wants wants = {{0}, {0}, {0}, {0}, {0}, {0}};
  for (int32_t y = first_pair(y0, y1); y <= y1; y += 2) {
    float *row = state + y * TILE + b->x0[j];
    Share s = take_share(load_pair(row), pair_exponents(&curve, y, y0, y1));
    v16f g[3] = {load_pair(row + 2 * PLANE), load_pair(row + 3 * PLANE), load_pair(row + 4 * PLANE)};
    v16f dy = splat_pair((float)y - curve.my, (float)(y + 1) - curve.my);
    store_pair(row, s.left);
    store_pair(row + PLANE, take_back(&wants, s, load_pair(row + PLANE), g, color, dy));
  }
  add_columns(&wants, PAIR_COLUMNS + (float)b->x0[j] - curve.mx, slot);
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
        else if (batch.x0[j] == WIDE)
          walk_rows(state, &batch, j, y0, y1, slot);
        else
          walk_pairs(state, &batch, j, y0, y1, slot);
      }
      narrow_tile(&t, state);
    }
    for (int64_t i = SUMS * start; i < SUMS * end; i++) slots[i] = 0.f;
  }
  return 0;
}

// Intersections of other ranges' Gaussians are left out without a branch, which would be mispredicted.
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
