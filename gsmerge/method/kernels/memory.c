// Define the three functions that a compiler may call in place of a loop or an assignment. No C library is linked.
#include <stddef.h>
#if defined(__clang__)
#define PLAIN __attribute__((no_builtin))
#else
#define PLAIN __attribute__((optimize("no-tree-loop-distribute-patterns")))
#endif

PLAIN void *memset(void *to, int value, size_t count) {
  unsigned char *bytes = to;
  for (size_t i = 0; i < count; i++) bytes[i] = (unsigned char)value;
  return to;
}

PLAIN void *memcpy(void *restrict to, const void *restrict from, size_t count) {
  unsigned char *bytes = to;
  const unsigned char *source = from;
  for (size_t i = 0; i < count; i++) bytes[i] = source[i];
  return to;
}

PLAIN void *memmove(void *to, const void *from, size_t count) {
  unsigned char *bytes = to;
  const unsigned char *source = from;
  if (bytes < source)
    for (size_t i = 0; i < count; i++) bytes[i] = source[i];
  else
    for (size_t i = count; i-- > 0;) bytes[i] = source[i];
  return to;
}
