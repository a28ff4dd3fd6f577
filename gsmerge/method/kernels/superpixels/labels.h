// Definitions that the kernels of superpixels share. Label pictures are padded: [h+2,w+2] with a frame of -1, so that
// no loop has to check for the border.
#pragma once
#include "native.h"

// True if labels [rows,columns] are valid for a picture of this size: -1 on the frame, and below count
// inside.
static inline bool labels_fit(const int32_t *labels, int64_t rows, int64_t columns, int64_t height,
                              int64_t width, int64_t count) {
  if (rows != height + 2 || columns != width + 2 || count < 0) return false;
  const uint32_t end = (uint32_t)mini(count, INT32_MAX);
  int32_t frame = -1;
  for (int64_t x = 0; x < columns; x++) frame &= labels[x] & labels[(rows - 1) * columns + x];
  bool good = frame == -1;
  for (int64_t y = 1; y <= height; y++) {
    const int32_t *line = labels + y * columns;
    good &= line[0] == -1 && line[width + 1] == -1;
    for (int64_t x = 1; x <= width; x++) good &= (uint32_t)line[x] < end;
  }
  return good;
}

// A number whose bit i is set if neighbour i (N, NE, E, SE, S, SW, W, NW) of a place has the label.
static inline uint32_t ring_of(const int32_t *place, int64_t columns, int32_t label) {
  const int32_t *above = place - columns, *below = place + columns;
  return (uint32_t)((above[0] == label) | (above[1] == label) << 1 | (place[1] == label) << 2
                    | (below[1] == label) << 3 | (below[0] == label) << 4
                    | (below[-1] == label) << 5 | (place[-1] == label) << 6
                    | (above[-1] == label) << 7);
}

// True if the four neighbours of a place have the same label as the place.
static inline bool is_inside(const int32_t *place, int64_t columns) {
  int32_t own = place[0];
  return (place[-columns] == own) & (place[1] == own) & (place[columns] == own)
      & (place[-1] == own);
}

// A small number in (0, 1e-7] that depends only on the pair. It makes equal costs differ, so that flat
// pictures do not merge only one pair per round.
static inline float pair_tie(int32_t u, int32_t v) {
  uint32_t mixed = (uint32_t)u * 2654435761u ^ (uint32_t)v * 40503u;
  mixed ^= mixed >> 15;
  return (float)(1e-7 / 1024) * (float)((mixed & 1023) + 1);
}
