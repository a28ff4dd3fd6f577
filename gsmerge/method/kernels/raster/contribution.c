// Find the superpixel of one view to which each Gaussian contributes most (paper, supplement on non-pixel-aligned
// backbones).
//
// A pair is a Gaussian and a superpixel that it touches, with the sum of its blending weights there. Pairs are summed
// one row of tiles after another, and linked in a chain for each Gaussian. At the end of a row, Gaussians that do not
// reach into the next row are finished, and the pairs of the others are carried over. So memory grows with the width of
// the view, not with its height.
#include "walk.h"

enum { LABEL, SUM, NEXT, PAIR };  // columns of a pair; NEXT is the next pair of the same Gaussian, -1 for none
enum { LAST_ROW = 7 };            // column of a conic
// number of pairs, number of Gaussians with pairs, and the next tile
enum { NUM_PAIRS, NUM_ACTIVE, NEXT_TILE, COUNTS };

// Write a pair and insert it at the front of its Gaussian's chain.
static inline void chain(double *pairs, int64_t at, int32_t *heads, int64_t k, int64_t label, double value) {
  double *pair = pairs + PAIR * at;
  pair[LABEL] = (double)label;
  pair[SUM] = value;
  pair[NEXT] = heads[k];
  heads[k] = (int32_t)at;
}

// A number of a pair as an index below n; -1 for an invalid index.
static inline int64_t index_of(double value, int64_t n) { return value >= 0.0 && value < (double)n ? (int64_t)value : -1; }

// Number the superpixels of a tile from 0, and return how many there are. `lanes` gets the number of each pixel's
// superpixel, and `names` the label of each number.
static int32_t number_labels(const int32_t *labels, const Tile *t, int64_t w, int32_t *stamps, int32_t *lanes,
                          int32_t *names) {
  int32_t count = 0;
  for (int y = 0; y < t->num_y; y++)
    for (int x = 0; x < t->num_x; x++) {
      int32_t label = labels[(t->top + y) * w + t->left + x];
      if (stamps[label] < 0) {
        stamps[label] = count;
        names[count++] = label;
      }
      lanes[y * TILE + x] = stamps[label];
    }
  for (int32_t i = 0; i < count; i++) stamps[names[i]] = -1;
  return count;
}

// Sum one Gaussian's weights in each superpixel of the tile; return the number of superpixels it touches.
static inline int32_t sum_tile(const float *weights, const Batch *b, int64_t j, int32_t y0, int32_t y1, int32_t num_x,
                               const int32_t *lanes, float *sums, int32_t *touched) {
  int32_t x0, x1, count = 0;
  columns_of(b, j, num_x, &x0, &x1);
  for (int32_t y = y0; y <= y1; y++)
    for (int32_t x = x0; x <= x1; x++) {
      float w = weights[y * TILE + x];
      int32_t label = lanes[y * TILE + x];
      touched[count] = label;
      count += w > 0.f && sums[label] == 0.f;
      sums[label] += w;
    }
  return count;
}

// Append the pairs of a row of tiles from counts[NEXT_TILE] on. Stop at a tile whose pairs may not fit; the caller
// continues with more room.
API int32_t add_row(const float *restrict conics, const int32_t *restrict flatten_ids,
                    const int64_t *restrict isect_offsets, int64_t tile_width, int64_t line,
                    const int32_t *restrict labels, int32_t *restrict heads, double *restrict pairs,
                    int32_t *restrict active, int32_t *restrict stamps, int64_t *restrict counts, int64_t m, int64_t n,
                    int64_t ends, int64_t h, int64_t w, int64_t room, int64_t slots, int64_t num_labels) {
  (void)num_labels;
  if (line < 0 || (line + 1) * tile_width >= ends || slots <= m || counts[NUM_ACTIVE] < 0 || counts[NUM_ACTIVE] > m ||
      counts[NUM_PAIRS] < 0 || counts[NUM_PAIRS] > room)
    return OUTSIDE;
  Lists lists = {conics, flatten_ids, isect_offsets, tile_width, m, n, ends};
  if (!lists_are_sound(&lists, line * tile_width, (line + 1) * tile_width)) return OUTSIDE;
  float state[2 * PLANE] __attribute__((aligned(64))), sums[PLANE] = {0};
  int32_t lanes[PLANE] = {0}, names[PLANE], touched[PLANE + 1];
  Batch batch;
  clear_batch(&batch);
  int64_t num_pairs = counts[NUM_PAIRS], num_active = counts[NUM_ACTIVE];
  for (int64_t tile = maxi(line * tile_width, counts[NEXT_TILE]); tile < (line + 1) * tile_width; tile++) {
    int64_t start = isect_offsets[tile], end = isect_offsets[tile + 1];
    Tile t = open_tile(state, 2, tile, tile_width, h, w);
    counts[NEXT_TILE] = tile;
    if (num_pairs + (end - start) * number_labels(labels, &t, w, stamps, lanes, names) > room) return 0;
    for (; start < end && t.y_low <= t.y_high; start += BATCH) {
      int64_t stop = mini(end, start + BATCH);
      if (!gather(&batch, &t, &lists, start, stop, end)) return OUTSIDE;
      for (int64_t j = 0; j < stop - start; j++) {
        int32_t y0 = first_row(&t, &batch, j), y1 = last_row(&t, &batch, j), k = flatten_ids[start + j];
        weigh_rows(state, &batch, j, y0, y1);
        int32_t count = sum_tile(state + PLANE, &batch, j, y0, y1, t.num_x, lanes, sums, touched);
        active[num_active] = k;
        num_active += count > 0 && heads[k] < 0 && num_active < m;
        for (int32_t i = 0; i < count; i++) {
          chain(pairs, num_pairs++, heads, k, names[touched[i]], sums[touched[i]]);
          sums[touched[i]] = 0.f;
        }
      }
      narrow_tile(&t, state);
    }
    counts[NUM_PAIRS] = num_pairs;
    counts[NUM_ACTIVE] = num_active;
    counts[NEXT_TILE] = tile + 1;
  }
  return 0;
}

// Add up the pairs of every Gaussian; finish Gaussians that end above bottom, and carry over the sums of the others.
API int32_t settle_row(int64_t bottom, const float *restrict conics, int32_t *restrict heads,
                       const double *restrict pairs, double *restrict carried, int32_t *restrict active,
                       double *restrict totals, int32_t *restrict seen, float *restrict out_values,
                       int32_t *restrict out_labels, int64_t *restrict counts, int64_t m, int64_t room, int64_t slots,
                       int64_t num_labels) {
  int64_t num_carried = 0, num_staying = 0, num_pairs = counts[NUM_PAIRS], unread = num_pairs;
  if (counts[NUM_ACTIVE] > slots || num_pairs > room) return OUTSIDE;
  for (int64_t a = 0; a < counts[NUM_ACTIVE]; a++) {
    int64_t k = active[a], count = 0;
    if (k < 0 || k >= m) return OUTSIDE;
    for (int64_t pair = heads[k]; pair >= 0; pair = index_of(pairs[PAIR * pair + NEXT], num_pairs)) {
      int64_t label = pair < num_pairs ? index_of(pairs[PAIR * pair + LABEL], num_labels) : -1;
      if (label < 0 || unread-- <= 0) return OUTSIDE;  // if a chain has more links than there are pairs, it is a ring
      if (totals[label] == 0.0) {
        if (count == num_labels) return OUTSIDE;  // this happens only if sums are 0 or less
        seen[count++] = (int32_t)label;
      }
      totals[label] += pairs[PAIR * pair + SUM];
    }
    if (count == 0) return OUTSIDE;
    heads[k] = -1;
    bool final = conics[CONIC * k + LAST_ROW] < (float)bottom;
    int32_t best = seen[0];
    for (int64_t i = 0; i < count; i++) {
      int32_t label = seen[i];
      double sum = totals[label];
      best = sum > totals[best] || (sum == totals[best] && label < best) ? label : best;
      if (!final) chain(carried, num_carried++, heads, k, label, sum);
    }
    if (final) {
      out_values[k] = (float)totals[best];
      out_labels[k] = best;
    }
    for (int64_t i = 0; i < count; i++) totals[seen[i]] = 0.0;
    active[num_staying] = (int32_t)k;
    num_staying += !final;
  }
  counts[NUM_PAIRS] = num_carried;
  counts[NUM_ACTIVE] = num_staying;
  return 0;
}
