// Quickselect on its own.
#include "select.h"

API int32_t partition(const double *restrict values, int64_t *restrict order, int64_t low,
                      int64_t high, int64_t place, int64_t n, int64_t m) {
  if (low > place || place >= high || high > m) return OUTSIDE;
  (void)n;
  partition_run(values, 1, order, low, high, place);
  return 0;
}
