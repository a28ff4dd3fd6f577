// Compress bytes to a deflate stream (RFC 1951) of literals and of runs of one byte, with a Huffman code for each block.
#include "native.h"

enum { BLOCK = 1 << 16, SYMBOLS = 286, END = 256, LONGEST = 15, LEAST_RUN = 3, MOST_RUN = 258, HEAD = 256 };

enum { TOKENS = END + MOST_RUN + 1 };  // literals, and END plus the length of a run

typedef struct {
  uint8_t *out;
  int64_t at;
  uint64_t bits;  // not written yet, from the lowest bit on
  int32_t count;  // number of these bits, at most 7 after flush
} Writer;

// Bits of a token in a block.
typedef struct { uint32_t bits, count; } Word;

static inline void put(Writer *w, uint64_t bits, int32_t count) {
  w->bits |= bits << w->count;
  w->count += count;
}

// Write whole bytes; there is always room for eight more.
static inline void flush(Writer *w) {
  __builtin_memcpy(w->out + w->at, &w->bits, 8);
  w->at += w->count >> 3;
  w->bits >>= w->count & ~7;
  w->count &= 7;
}

// The symbol of a run, with its extra bits.
typedef struct { int32_t symbol, extra, value; } Run;

static inline Run run_of(int32_t length) {
  int32_t more = length - LEAST_RUN, log = 0;
  if (length == MOST_RUN) return (Run){SYMBOLS - 1, 0, 0};
  if (more < 8) return (Run){END + 1 + more, 0, 0};
  while (more >> (log + 1)) log++;
  return (Run){END + 1 + 4 * (log - 1) + ((more >> (log - 2)) & 3), log - 2, more & ((1 << (log - 2)) - 1)};
}

// True if three bytes repeat the one before them; compared at once, since single comparisons are mispredicted.
static inline bool starts_run(const uint8_t *before) {
  uint32_t bytes;
  __builtin_memcpy(&bytes, before, 4);
  return bytes == (bytes >> 8 | bytes << 24);
}

// Split a block into tokens: literals, and END plus the length of runs of the byte before. Count how often each occurs.
static int64_t split(const uint8_t *data, int64_t first, int64_t last, uint16_t *tokens, int32_t uses[2][TOKENS]) {
  int64_t count = 0, i = first;
  while (i < last) {
    int32_t token = data[i++];
    if (i > 1 && i + LEAST_RUN - 1 <= last && starts_run(data + i - 2)) {
      int64_t most = mini(last, i - 1 + MOST_RUN), start = i - 1;
      for (i += LEAST_RUN - 1; i < most && data[i] == data[start]; i++) {}
      token = END + (int32_t)(i - start);
    }
    uses[count & 1][token]++;
    tokens[count++] = (uint16_t)token;
  }
  return count;
}

// Lengths of a Huffman code for the symbols that occur; return the longest one.
static int32_t measure_code(const int64_t *uses, uint8_t *lengths) {
  int64_t sums[2 * SYMBOLS];  // of leaves in ascending order, then of inner nodes
  int32_t symbols[SYMBOLS], above[2 * SYMBOLS], depths[2 * SYMBOLS], leaves = 0, longest = 0;
  for (int32_t s = 0; s < SYMBOLS; s++) {
    lengths[s] = 0;
    if (!uses[s]) continue;
    int32_t at = leaves++;
    for (; at > 0 && uses[symbols[at - 1]] > uses[s]; at--) symbols[at] = symbols[at - 1];
    symbols[at] = s;
  }
  for (int32_t i = 0; i < leaves; i++) sums[i] = uses[symbols[i]];
  int32_t leaf = 0, inner = leaves, nodes = leaves;
  for (; nodes < 2 * leaves - 1; nodes++) {
    sums[nodes] = 0;
    for (int side = 0; side < 2; side++) {
      int32_t least = leaf < leaves && (inner >= nodes || sums[leaf] <= sums[inner]) ? leaf++ : inner++;
      sums[nodes] += sums[least];
      above[least] = nodes;
    }
  }
  depths[nodes - 1] = 0;
  for (int32_t i = nodes - 2; i >= 0; i--) {
    depths[i] = depths[above[i]] + 1;
    if (i >= leaves) continue;
    lengths[symbols[i]] = (uint8_t)depths[i];
    longest = depths[i] > longest ? depths[i] : longest;
  }
  return longest;
}

// Codes of the lengths in the order of the symbols, from their highest bit on.
static void make_code(const uint8_t *lengths, uint16_t *codes) {
  int32_t next[LONGEST + 2] = {0}, counts[LONGEST + 1] = {0};
  for (int32_t s = 0; s < SYMBOLS; s++) counts[lengths[s]]++;
  counts[0] = 0;
  for (int32_t length = 1; length <= LONGEST; length++) next[length + 1] = (next[length] + counts[length]) << 1;
  for (int32_t s = 0; s < SYMBOLS; s++) {
    int32_t code = lengths[s] ? next[lengths[s]]++ : 0, turned = 0;
    for (int32_t bit = 0; bit < lengths[s]; bit++) turned |= ((code >> bit) & 1) << (lengths[s] - 1 - bit);
    codes[s] = (uint16_t)turned;
  }
}

// Write the head of a block: the lengths of its code, each in four bits, and two distances of one bit.
static void put_head(Writer *w, const uint8_t *lengths, bool is_last) {
  put(w, is_last, 1);
  put(w, 2, 2);
  put(w, SYMBOLS - 257, 5);
  put(w, 1, 5);
  put(w, 15, 4);
  for (int i = 0; i < 19; i++) {
    put(w, i < 3 ? 0 : 4, 3);  // no code for repeated lengths, which come first
    flush(w);
  }
  for (int32_t s = 0; s < SYMBOLS + 2; s++) {
    int32_t length = s < SYMBOLS ? lengths[s] : 1;
    put(w, (uint64_t)((length & 1) << 3 | (length & 2) << 1 | (length & 4) >> 1 | (length & 8) >> 3), 4);
    flush(w);
  }
}

// Bits of every token: a run's are those of its symbol, its extra bits, and one bit 0 for the distance 1.
static void make_words(const uint8_t *lengths, Word *words) {
  uint16_t codes[SYMBOLS];
  make_code(lengths, codes);
  for (int32_t token = 0; token <= END; token++) words[token] = (Word){codes[token], lengths[token]};
  for (int32_t length = LEAST_RUN; length <= MOST_RUN; length++) {
    Run run = run_of(length);
    uint32_t count = lengths[run.symbol];
    words[END + length] = (Word){codes[run.symbol] | (uint32_t)run.value << count, count + (uint32_t)run.extra + 1};
  }
}

API int64_t deflate_runs(const uint8_t *data, uint8_t *out, int64_t n, int64_t room) {
  Writer w = {out, 0, 0, 0};
  uint16_t tokens[BLOCK];
  uint8_t lengths[SYMBOLS];
  Word words[TOKENS] = {{0}};
  if (n < 1 || room < 2 * n + HEAD * (n / BLOCK + 1)) return -1;  // each byte takes 15 bits at most
  for (int64_t first = 0; first < n; first += BLOCK) {
    int32_t token_uses[2][TOKENS] = {{0}};
    int64_t last = mini(n, first + BLOCK), count = split(data, first, last, tokens, token_uses), uses[SYMBOLS] = {0};
    for (int32_t token = 0; token < TOKENS; token++) {
      int64_t symbol = token < END + LEAST_RUN ? token : run_of(token - END).symbol;
      uses[symbol] += token_uses[0][token] + token_uses[1][token];
    }
    uses[END] = 1;
    while (measure_code(uses, lengths) > LONGEST)
      for (int32_t s = 0; s < SYMBOLS; s++) uses[s] = (uses[s] + 1) / 2;  // flatter, until the code is short enough
    make_words(lengths, words);
    put_head(&w, lengths, last == n);
    int64_t i = 0;
    for (; i + 2 <= count; i += 2) {
      put(&w, words[tokens[i]].bits, (int32_t)words[tokens[i]].count);
      put(&w, words[tokens[i + 1]].bits, (int32_t)words[tokens[i + 1]].count);
      flush(&w);
    }
    if (i < count) put(&w, words[tokens[i]].bits, (int32_t)words[tokens[i]].count);
    put(&w, words[END].bits, (int32_t)words[END].count);
    flush(&w);
  }
  put(&w, 0, 7);  // so that all bits of the stream are written
  flush(&w);
  return w.at;
}
