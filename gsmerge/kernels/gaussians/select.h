// Quickselect of an order, for medians and k-d trees.
#pragma once
#include "native.h"

// Reorders order[low] to order[high - 1] so that values[stride * order[place]] is the one that
// sorting would put there: none before it is above it, none after it below. NaN compares to nothing
// and may end up anywhere.
static inline void partition_run(const double *values, int64_t stride, int64_t *order, int64_t low,
                                 int64_t high, int64_t place) {
  int64_t last = high - 1;
  while (low < last) {
    double pivot = values[stride * order[(low + last) / 2]];
    int64_t i = low, j = last;
    while (i <= j) {
      while (values[stride * order[i]] < pivot) i++;
      while (values[stride * order[j]] > pivot) j--;
      if (i > j) break;
      int64_t other = order[i];
      order[i++] = order[j];
      order[j--] = other;
    }
    if (place <= j)
      last = j;
    else if (place >= i)
      low = i;
    else
      return;
  }
}
