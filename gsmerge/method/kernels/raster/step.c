// Take a step of a fit in phases. In each phase every thread makes one call, and takes pieces of work from a counter
// until none are left. The last thread to finish does what a single thread has to do. The phases call the kernels of
// the other files, so their bits are those of single calls.
#include "native.h"
#include "projection.h"

API int64_t cull(const float *, const float *, const float *, const uint8_t *, const int32_t *, const float *,
                    int32_t, int32_t *, int64_t, int64_t, int64_t);
API int32_t view_colors(const float *, const float *, const float *, const int32_t *, const float *, int64_t, int64_t,
                        float *, int64_t, int64_t, int64_t);
API int32_t project(const float *, const float *, const float *, const float *, const int32_t *, const float *,
                       float *, float *, int16_t *, int64_t, int64_t);
API void sort_bits(const uint32_t *, int32_t *, uint64_t *, uint64_t *, int64_t);
API int32_t count_boxes(const int16_t *, int64_t, int64_t, int64_t *, int64_t *, int64_t, int64_t, int64_t);
API int32_t deal_tiles(const int32_t *, const int16_t *, int64_t, int64_t *, int32_t *, int64_t, int64_t, int64_t);
API int32_t deal_open_tiles(const int32_t *, const int16_t *, const float *, int64_t, int64_t, int64_t, float *,
                            int64_t *, int32_t *, int64_t, int64_t, int64_t);
API int32_t blend(const float *, const int32_t *, const int64_t *, int64_t, const float *, int64_t, int64_t, int64_t,
                     const float *, float *, float *, int64_t, int64_t, int64_t, int64_t, int64_t);
API int32_t loss_gradient(const float *, const float *, const float *, float, float, int64_t, int64_t, float *,
                             float *, float *, float *, int64_t, int64_t, int64_t, int64_t);
API int32_t blend_backward(const float *, const int32_t *, const int64_t *, int64_t, const float *, int64_t, int64_t,
                              const float *, const float *, const float *, const float *, float *, int64_t, int64_t,
                              int64_t, int64_t, int64_t);
API int32_t gather_slots(const int32_t *, const float *, int64_t, int64_t, float *, int64_t, int64_t);
API int32_t project_backward(const float *, const float *, const float *, const float *, const int32_t *,
                                const float *, const float *, int64_t, int64_t, float *, float *, float *, float *,
                                float *, int64_t, int64_t, int64_t);
API int32_t adam(float *, const float *, float *, float *, const float *, const float *, const float *,
                    const uint8_t *, const int32_t *, const float *, const float *, const float *, const float *,
                    const float *, const float *, const float *, const float *, const float *, int64_t, int64_t,
                    int64_t, float *, float *, float *, float *, float *, int64_t, int64_t);

// PIECE is the number of Gaussians of a piece, and RANGES the number of ranges of tiles for each thread
enum { SUMS = 9, BLOCK = 128, PIECE = 1 << 13, RANGES = 8 };

// The table of kernels/raster/step.py: addresses, then sizes, then numbers.
typedef struct {
  float *means, *quats, *scales, *opacities, *colors, *x, *x0, *m, *v, *units, *box_shares, *min_sizes;
  uint8_t *fixed;
  float *sh0, *shN, *drawn;
  int32_t *ids;
  int64_t *num_kept;
  float *conics, *depths, *tints;
  int16_t *boxes;
  int32_t *order;
  uint64_t *keys, *spare;
  int16_t *ordered_boxes;
  float *sums, *g_means, *g_quats, *g_scales, *g_opacities, *g_colors, *g_poses;
  int64_t *corners, *counts, *offsets;
  float *light;
  int32_t *flatten_ids;
  float *slots, *image, *transmittance, *gradient, *errors, *terms, *rows, *photo, *weight, *camera, *eye, *background;
  float *loss_weights, *rates, *limits, *betas, *regs;
  int64_t n, num, pieces, blocks, spans, num_corners, tiles, ends, room, height, width, threads, line;
  int64_t step, num_visible, num_intersections, next, arrived, failed;
} Step;

enum { CULL, PROJECT, COUNT, COUNT_OPEN, DEAL, DEAL_OPEN, BLEND, LOSS, BACKWARD, UPDATE };

typedef struct {
  int64_t first, last;
} Span;

static inline Span share(int64_t count, int64_t i, int64_t num) {
  return (Span){count * i / num, count * (i + 1) / num};
}

// The first tile whose list begins at the share i / num of all intersections, or behind it.
static inline int64_t cut(const Step *s, int64_t i, int64_t num) {
  if (i <= 0) return 0;
  if (i >= num) return s->tiles;
  int64_t low = 0, high = s->tiles, at = s->num_intersections * i / num;
  while (low < high) {
    int64_t middle = (low + high) / 2;
    if (s->offsets[middle] < at) low = middle + 1;
    else high = middle;
  }
  return low;
}

static inline int64_t columns_of(const Step *s) { return (s->width + TILE - 1) / TILE; }

static int64_t num_pieces(const Step *s, int64_t phase) {
  if (phase == CULL) return s->pieces;
  if (phase == PROJECT) return (s->num_visible + PIECE - 1) / PIECE;
  if (phase == COUNT || phase == DEAL) return s->spans;
  return phase == LOSS || phase == UPDATE ? s->threads : RANGES * s->threads;
}

static int32_t cull_piece(Step *s, int64_t i) {
  int64_t start = i * PIECE, size = mini(PIECE, s->n - start);
  s->num_kept[i] = cull(s->means + 3 * start, s->scales + 3 * start, s->drawn + start, 0, 0, s->camera, (int32_t)start,
                        s->ids + start, size, 0, 0);
  return 0;
}

// Compute the colours that the camera sees. Without harmonics they are those of the state, which may be negative.
static int32_t color_rows(Step *s, int64_t first, int64_t last) {
  if (s->num > 0)
    return view_colors(s->means, s->sh0, s->shN, s->ids, s->eye, first, last, s->tints, s->n, s->num, s->num_visible);
  for (int64_t row = first; row < last; row++)
    for (int c = 0; c < 3; c++) s->tints[3 * row + c] = s->colors[3 * (int64_t)s->ids[row] + c];
  return 0;
}

static int32_t project_piece(Step *s, int64_t i) {
  int64_t first = i * PIECE, last = mini(s->num_visible, first + PIECE);
  if (color_rows(s, first, last)) return OUTSIDE;
  return project(s->means, s->quats, s->scales, s->drawn, s->ids + first, s->camera, s->conics + CONIC * first,
                 s->depths + first, s->boxes + 4 * first, s->n, last - first);
}

static int32_t count_span(Step *s, int64_t i) {
  Span rows = share(s->num_visible, i, s->spans);
  int64_t columns = columns_of(s), *corners = s->corners + i * s->num_corners;
  for (int64_t k = 0; k < s->num_corners; k++) corners[k] = 0;
  const uint64_t *boxes = (const uint64_t *)s->boxes;
  uint64_t *ordered = (uint64_t *)s->ordered_boxes;
  for (int64_t k = rows.first; k < rows.last; k++) ordered[k] = boxes[s->order[k]];
  return count_boxes(s->ordered_boxes + 4 * rows.first, s->tiles / columns, columns, corners, s->counts + i * s->tiles,
                     rows.last - rows.first, s->num_corners, s->tiles);
}

// Deal Gaussians to a range of rows of tiles, to each tile until no light passes it. Without intersections only count.
static int32_t deal_open_lines(Step *s, int64_t i, int64_t intersections) {
  int64_t columns = columns_of(s);
  Span lines = share(s->tiles / columns, i, RANGES * s->threads);
  for (int64_t tile = lines.first * columns; tile < lines.last * columns; tile++) s->light[tile] = 1.f;
  return deal_open_tiles(s->order, s->ordered_boxes, s->conics, columns, lines.first, lines.last, s->light, s->counts,
                         s->flatten_ids, s->num_visible, s->tiles, intersections);
}

static int32_t count_open_lines(Step *s, int64_t i) {
  int64_t columns = columns_of(s);
  Span lines = share(s->tiles / columns, i, RANGES * s->threads);
  for (int64_t tile = lines.first * columns; tile < lines.last * columns; tile++) s->counts[tile] = 0;
  return deal_open_lines(s, i, 0);
}

static int32_t list_open_lines(Step *s, int64_t i) { return deal_open_lines(s, i, s->num_intersections); }

static int32_t deal_span(Step *s, int64_t i) {
  Span rows = share(s->num_visible, i, s->spans);
  return deal_tiles(s->order + rows.first, s->ordered_boxes + 4 * rows.first, columns_of(s), s->counts + i * s->tiles,
                    s->flatten_ids, rows.last - rows.first, s->tiles, s->num_intersections);
}

static int32_t blend_range(Step *s, int64_t i) {
  int64_t num = RANGES * s->threads;
  return blend(s->conics, s->flatten_ids, s->offsets, columns_of(s), s->tints, cut(s, i, num), cut(s, i + 1, num), 0,
               s->background, s->image, s->transmittance, s->num_visible, s->num_intersections, s->ends, s->height,
               s->width);
}

static int32_t loss_rows(Step *s, int64_t i) {
  Span rows = share(s->height, i, s->threads);
  return loss_gradient(s->image, s->photo, s->weight, s->loss_weights[0], s->loss_weights[1], rows.first, rows.last,
                       s->gradient, s->errors, s->terms + 36 * i * s->line, s->rows + 7 * i * s->line, s->height,
                       3 * s->width, s->width, s->line);
}

static int32_t backward_range(Step *s, int64_t i) {
  int64_t num = RANGES * s->threads;
  return blend_backward(s->conics, s->flatten_ids, s->offsets, columns_of(s), s->tints, cut(s, i, num),
                        cut(s, i + 1, num), s->image, s->transmittance, s->gradient, 0, s->slots, s->num_visible,
                        s->num_intersections, s->ends, s->height, s->width);
}

static int32_t update_rows(Step *s, int64_t i) {
  Span blocks = share((s->num_visible + BLOCK - 1) / BLOCK, i, s->threads);
  int64_t first = BLOCK * blocks.first, last = mini(BLOCK * blocks.last, s->num_visible);
  float *poses = s->blocks ? s->g_poses : 0;  // there are no blocks if the camera does not move
  for (int64_t k = SUMS * first; k < SUMS * last; k++) s->sums[k] = 0.f;
  if (gather_slots(s->flatten_ids, s->slots, first, last, s->sums, s->num_intersections, s->num_visible))
    return OUTSIDE;
  if (project_backward(s->means, s->quats, s->scales, s->drawn, s->ids, s->sums, s->camera, first, last, s->g_means,
                       s->g_quats, s->g_scales, s->g_opacities, poses, s->n, s->num_visible, s->blocks))
    return OUTSIDE;
  for (int64_t k = first; k < last; k++)
    for (int c = 0; c < 3; c++) s->g_colors[3 * k + c] = s->sums[SUMS * k + c];
  return adam(s->x, s->x0, s->m, s->v, s->units, s->box_shares, s->min_sizes, s->fixed, s->ids, s->g_means,
              s->g_quats, s->g_scales, s->g_opacities, s->g_colors, s->rates, s->limits, s->betas, s->regs, s->step,
              first, last, s->means, s->quats, s->scales, s->opacities, s->colors, s->n, s->num_visible);
}

static int32_t (*const WORK[])(Step *, int64_t) = {
    cull_piece,      project_piece, count_span, count_open_lines, deal_span,
    list_open_lines, blend_range,   loss_rows,  backward_range,   update_rows,
};

// Find where the list of each tile begins, and within it the part of each span.
static void place_lists(Step *s, int64_t spans) {
  int64_t sum = 0;
  for (int64_t tile = 0; tile < s->tiles; tile++) {
    s->offsets[tile] = sum;
    for (int64_t i = 0; i < spans; i++) {
      int64_t *at = s->counts + i * s->tiles + tile, count = *at;
      *at = sum;  // where the span's part of the list begins
      sum += count;
    }
  }
  s->offsets[s->tiles] = s->num_intersections = sum;
}

// Do what a single thread does between two phases: close the gaps between pieces, sort by depth, place the lists of
// tiles.
static void finish(Step *s, int64_t phase) {
  if (phase == CULL) {
    int64_t count = 0;
    for (int64_t i = 0; i < s->pieces; i++)
      for (int64_t k = 0; k < s->num_kept[i]; k++) s->ids[count++] = s->ids[i * PIECE + k];
    s->num_visible = count;
  }
  if (phase == PROJECT) sort_bits((const uint32_t *)s->depths, s->order, s->keys, s->spare, s->num_visible);
  if (phase == COUNT) place_lists(s, s->spans);
  if (phase == COUNT_OPEN) place_lists(s, 1);
}

// True if the buffers have the right sizes for the picture and the Gaussians.
static inline bool fits(const Step *s) {
  int64_t columns = columns_of(s), lines = (s->height + TILE - 1) / TILE;
  return s->width > 0 && s->height > 0 && s->threads > 0 && s->spans > 0 && s->n >= 0 && s->n < INT64_C(1) << 31 &&
         s->tiles == columns * lines && s->ends == s->tiles + 1 &&
         s->num_corners == (columns + 1) * (lines + 1) && s->pieces == (s->n + PIECE - 1) / PIECE &&
         (s->blocks == 0 || s->blocks == (s->n + BLOCK - 1) / BLOCK);
}

API int32_t fit_phase(int64_t *table, int64_t phase, int64_t fields) {
  Step *s = (Step *)table;
  if (fields * (int64_t)sizeof(int64_t) != sizeof(Step)) return OUTSIDE;
  if (!fits(s) || (phase > COUNT_OPEN && s->num_intersections > s->room)) return OUTSIDE;
  int64_t num = num_pieces(s, phase), piece;
  while ((piece = __atomic_fetch_add(&s->next, 1, __ATOMIC_RELAXED)) < num)
    if (WORK[phase](s, piece)) __atomic_store_n(&s->failed, 1, __ATOMIC_RELAXED);
  if (__atomic_add_fetch(&s->arrived, 1, __ATOMIC_ACQ_REL) < s->threads) return 0;
  finish(s, phase);
  s->next = s->arrived = 0;
  return s->failed ? OUTSIDE : 0;
}
