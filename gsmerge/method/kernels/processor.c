// Tell of which sources the library was made, and what level the processor has.
#include "native.h"

// Hash of the sources that the library was made of.
API const char *const sources_hash = SOURCES_HASH;

#ifdef __x86_64__
static inline void ask(uint32_t leaf, uint32_t *a, uint32_t *b, uint32_t *c, uint32_t *d) {
  __asm__ volatile("cpuid" : "=a"(*a), "=b"(*b), "=c"(*c), "=d"(*d) : "a"(leaf), "c"(0));
}

// The level of the processor in x86-64: 4 (AVX-512), 3 (AVX2 and FMA), or 0 for less. This function uses only
// instructions that all processors have.
__attribute__((target("arch=x86-64"))) API int32_t processor_level(void) {
  const uint32_t fma = 1u << 12, movbe = 1u << 22, osxsave = 1u << 27, avx = 1u << 28, f16c = 1u << 29;
  const uint32_t bmi1 = 1u << 3, avx2 = 1u << 5, bmi2 = 1u << 8;
  const uint32_t f = 1u << 16, dq = 1u << 17, cd = 1u << 28, bw = 1u << 30, vl = 1u << 31;
  const uint32_t lzcnt = 1u << 5, first = fma | movbe | osxsave | avx | f16c, second = bmi1 | avx2 | bmi2;
  uint32_t a, b, c, d, highest, low, high;
  ask(0, &highest, &b, &c, &d);
  if (highest < 7) return 0;
  ask(1, &a, &b, &c, &d);
  if ((c & first) != first) return 0;
  // registers that the system saves: bits 1 and 2 for AVX, 5 to 7 for AVX-512
  __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  if ((low & 0x6) != 0x6) return 0;
  ask(0x80000001u, &a, &b, &c, &d);
  if (!(c & lzcnt)) return 0;
  ask(7, &a, &b, &c, &d);
  if ((b & second) != second) return 0;
  const uint32_t wide = f | dq | cd | bw | vl;
  return (b & wide) == wide && (low & 0xe6) == 0xe6 ? 4 : 3;
}
#endif

#ifdef _WIN32
int _fltused = 0;
int DllMainCRTStartup(void *instance, uint32_t reason, void *reserved) {
  (void)instance, (void)reason, (void)reserved;
  return 1;
}
#endif
