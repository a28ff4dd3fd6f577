// Find the value at a position of an order without sorting it all (quickselect), for medians and k-d trees.
#pragma once
#include "native.h"

// after as many steps as this many passes over a run, it is sorted, so that no order takes quadratic time
enum { TRIES = 32 };

// Move the value at a place of a heap down, below larger values.
static inline void sink(const double *values, int64_t stride, int64_t *heap, int64_t place,
                        int64_t count) {
  int64_t moved = heap[place];
  double value = values[stride * moved];
  for (int64_t child; (child = 2 * place + 1) < count; place = child) {
    if (child + 1 < count && values[stride * heap[child]] < values[stride * heap[child + 1]])
      child++;
    if (!(value < values[stride * heap[child]])) break;
    heap[place] = heap[child];
  }
  heap[place] = moved;
}

static inline void sort_heap(const double *values, int64_t stride, int64_t *heap, int64_t count) {
  for (int64_t i = count / 2; i-- > 0;) sink(values, stride, heap, i, count);
  while (--count > 0) {
    int64_t largest = heap[0];
    heap[0] = heap[count];
    heap[count] = largest;
    sink(values, stride, heap, 0, count);
  }
}

// Reorder order[low] to order[high - 1] so that values[stride * order[place]] is the value that sorting would put
// there. No value before it is larger, and no value after it is smaller. NaN may end up anywhere.
static inline void partition_run(const double *values, int64_t stride, int64_t *order, int64_t low,
                                 int64_t high, int64_t place) {
  int64_t last = high - 1, most = TRIES * (high - low);
  while (low < last) {
    if ((most -= last - low) < 0) {
      sort_heap(values, stride, order + low, last - low + 1);
      return;
    }
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
