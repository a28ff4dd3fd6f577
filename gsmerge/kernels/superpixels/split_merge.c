// Split and merge moves of superpixels.
#include "exp_log.h"
#include "labels.h"

enum { SUMS = 7 };  // columns of a region's sums: pixels, colours (3), squared colours (3)
enum { LOG_ALPHA, SHAPE, SCALE, SPREAD };  // numbers of a prior: log α, a and b of the inverse gamma, v

API int32_t sum_regions(const int32_t *labels, const float *colours, const uint8_t *marks,
                        double *sums, int64_t padded_height, int64_t padded_width, int64_t height,
                        int64_t width, int64_t count) {
  if (!labels_fit(labels, padded_height, padded_width, height, width, count)) return OUTSIDE;
  for (int64_t y = 0; y < height; y++)
    for (int64_t x = 0; x < width; x++) {
      if (!marks[y * width + x]) continue;
      double *sum = sums + (int64_t)SUMS * labels[(y + 1) * padded_width + x + 1];
      sum[0] += 1;
      for (int i = 0; i < 3; i++) {
        double colour = colours[3 * (y * width + x) + i];
        sum[1 + i] += colour;
        sum[4 + i] += colour * colour;
      }
    }
  return 0;
}

// The part of the evidence that all regions share.
typedef struct {
  double gamma, scale;  // log Γ(a) and log(2 π b)
} Constants;

static inline Constants constants_of(const double *prior) {
  return (Constants){lgamma8(prior[SHAPE]), log8(6.283185307179586 * prior[SCALE])};
}

static double evidence(const double *sums, const double *prior, Constants constants) {
  double n = sums[0], b = prior[SCALE], v = prior[SPREAD], shape = prior[SHAPE] + 0.5 * n;
  double value = lgamma8(n) - n * log8(n);
  value +=
      3 * (lgamma8(shape) - constants.gamma - 0.5 * log8(1 + n * v) - 0.5 * n * constants.scale);
  double share = v / (1 + n * v), half = 0.5 / b,
         growth = 1;  // product of b_n / b over three channels
  for (int i = 0; i < 3; i++)
    growth *= 1 + half * maxd(sums[4 + i] - sums[1 + i] * sums[1 + i] * share, 0);
  return value - shape * log8(growth);
}

API double log_evidence(const double *sums, const double *prior) {
  return evidence(sums, prior, constants_of(prior));
}

API void weigh_splits(const double *whole, const double *second, const double *prior,
                      double *ratios, int64_t count) {
  Constants constants = constants_of(prior);
  for (int64_t label = 0; label < count; label++) {
    const double *all = whole + SUMS * label, *half = second + SUMS * label;
    double rest[SUMS];
    if (!(half[0] > 0)) continue;
    for (int i = 0; i < SUMS; i++) rest[i] = all[i] - half[i];
    double parts = evidence(rest, prior, constants) + evidence(half, prior, constants);
    ratios[label] = prior[LOG_ALPHA] + parts - evidence(all, prior, constants);
  }
}

API void choose_merges(const double *sums, const int32_t *pairs, const double *prior, double *own,
                       int32_t *partners, double *ratios, int64_t count, int64_t num_pairs) {
  Constants constants = constants_of(prior);
  for (int64_t label = 0; label < count; label++)
    own[label] = evidence(sums + SUMS * label, prior, constants);
  for (int64_t e = 0; e < num_pairs; e++) {
    int64_t u = mini(pairs[2 * e], pairs[2 * e + 1]), v = maxi(pairs[2 * e], pairs[2 * e + 1]);
    double both[SUMS];
    for (int i = 0; i < SUMS; i++) both[i] = sums[SUMS * u + i] + sums[SUMS * v + i];
    double ratio = evidence(both, prior, constants) - own[u] - own[v] - prior[LOG_ALPHA]
        + pair_tie((int32_t)u, (int32_t)v);
    for (int side = 0; side < 2; side++) {
      int64_t label = side ? v : u, other = side ? u : v;
      if (ratio > ratios[label] || (ratio == ratios[label] && other < partners[label])) {
        ratios[label] = ratio;
        partners[label] = (int32_t)other;
      }
    }
  }
}

// Box (first and last row, first and last column) and sums (of y, of x, pixels) of every region.
static void measure_boxes(const int32_t *labels, int64_t *boxes, double *sums, int64_t height,
                          int64_t width, int64_t count) {
  for (int64_t label = 0; label < count; label++) {
    int64_t *box = boxes + 4 * label;
    box[0] = box[2] = height + width;
    box[1] = box[3] = -1;
  }
  for (int64_t y = 0; y < height; y++)
    for (int64_t x = 0; x < width; x++) {
      int64_t label = labels[(y + 1) * (width + 2) + x + 1], *box = boxes + 4 * label;
      box[0] = mini(box[0], y);
      box[1] = maxi(box[1], y);
      box[2] = mini(box[2], x);
      box[3] = maxi(box[3], x);
      sums[3 * label] += (double)y;
      sums[3 * label + 1] += (double)x;
      sums[3 * label + 2] += 1;
    }
}

// The first and the last pixel of every region, which differ if it has two pixels. They lie in its
// first and last row, or with `across` in its first and last column, nearest to the middle of its
// pixels. A region of one row or column is split along it.
static void find_ends(const int32_t *labels, bool across, const int64_t *boxes, const double *sums,
                      double *offsets, int64_t *ends, int64_t height, int64_t width,
                      int64_t count) {
  for (int64_t i = 0; i < 2 * count; i++) {
    offsets[i] = __builtin_inf();
    ends[i] = -1;
  }
  for (int64_t y = 0; y < height; y++)
    for (int64_t x = 0; x < width; x++) {
      int64_t label = labels[(y + 1) * (width + 2) + x + 1];
      const int64_t *box = boxes + 4 * label;
      bool sideways = box[2] < box[3] && (across || box[0] == box[1]);
      int64_t place = sideways ? x : y, other = sideways ? y : x;
      double offset =
          absf8((double)other - sums[3 * label + (sideways ? 0 : 1)] / sums[3 * label + 2]);
      for (int end = 0; end < 2; end++)
        if (place == box[2 * sideways + end] && offset < offsets[2 * label + end]) {
          offsets[2 * label + end] = offset;
          ends[2 * label + end] = y * width + x;
        }
    }
}

// Spread the marks of the queued places over their regions, one step at a time.
static void spread_halves(const int32_t *labels, uint8_t *halves, int32_t *queue, int64_t tail,
                          int64_t width) {
  static const int32_t steps[4][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}};
  for (int64_t head = 0; head < tail; head++) {
    int64_t y = queue[2 * head], x = queue[2 * head + 1];
    for (int i = 0; i < 4; i++) {
      int64_t next_y = y + steps[i][0], next_x = x + steps[i][1];
      if (labels[(next_y + 1) * (width + 2) + next_x + 1] != labels[(y + 1) * (width + 2) + x + 1])
        continue;
      if (halves[next_y * width + next_x] != 2) continue;
      halves[next_y * width + next_x] = halves[y * width + x];
      queue[2 * tail] = (int32_t)next_y;
      queue[2 * tail + 1] = (int32_t)next_x;
      tail++;
    }
  }
}

API int32_t mark_halves(const int32_t *labels, int32_t across, int64_t *boxes, double *sums,
                        double *offsets, int64_t *ends, int32_t *queue, uint8_t *halves,
                        int64_t padded_height, int64_t padded_width, int64_t count, int64_t places,
                        int64_t height, int64_t width) {
  if (places < height * width
      || !labels_fit(labels, padded_height, padded_width, height, width, count))
    return OUTSIDE;
  measure_boxes(labels, boxes, sums, height, width, count);
  find_ends(labels, across, boxes, sums, offsets, ends, height, width, count);
  int64_t tail = 0;
  for (int64_t i = 0; i < height * width; i++) halves[i] = 2;
  for (int64_t i = 0; i < 2 * count; i++) {
    int64_t place = ends[i];
    if (place < 0 || halves[place] != 2) continue;
    halves[place] = i % 2;
    queue[2 * tail] = (int32_t)(place / width);
    queue[2 * tail + 1] = (int32_t)(place % width);
    tail++;
  }
  spread_halves(labels, halves, queue, tail, width);
  return 0;
}
