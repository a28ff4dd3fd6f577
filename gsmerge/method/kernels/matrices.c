// Multiply float64 matrices, solve linear equations, and find symmetric eigenvalues, in a fixed order of operations.
//
// Each element of a product is the fused sum of its terms in their order. Loops run over the columns of a row, so they
// vectorise without changing a bit.
#include "native.h"

enum { PANEL = 16 };   // columns that are eliminated together, so that large matrices stay in the caches
enum { ROWS = 4, COLUMNS = 8 };  // size of a block of a product whose sums stay in registers
enum { TERMS = 256 };            // terms that are added at a time, so that their part of b stays in the first cache
enum { SWEEPS = 50 };  // most sweeps of Jacobi's method, which needs about six
static const double TINY = 1e-300;

// out[i,k] += a[i,j] b[j,k] over the terms from..to, for a block of rows and columns whose sums stay in registers.
static inline void add_terms(const double *restrict a, const double *restrict b, double *restrict out,
                             int64_t from, int64_t to, int64_t j, int64_t k, int64_t rows,
                             int64_t columns) {
  double sums[ROWS][COLUMNS];
  for (int64_t r = 0; r < rows; r++)
    for (int64_t c = 0; c < columns; c++) sums[r][c] = out[r * k + c];
  for (int64_t t = from; t < to; t++)
    for (int64_t r = 0; r < rows; r++)
      for (int64_t c = 0; c < columns; c++) sums[r][c] += a[r * j + t] * b[t * k + c];
  for (int64_t r = 0; r < rows; r++)
    for (int64_t c = 0; c < columns; c++) out[r * k + c] = sums[r][c];
}

// out[i,k] = a[i,j] b[j,k]
static inline void multiply_rows(const double *restrict a, const double *restrict b, double *restrict out, int64_t i,
                                 int64_t j, int64_t k) {
  for (int64_t at = 0; at < i * k; at++) out[at] = 0.0;
  for (int64_t from = 0; from < j; from += TERMS) {
    int64_t to = mini(from + TERMS, j);
    for (int64_t row = 0; row < i; row += ROWS)
      for (int64_t column = 0; column < k; column += COLUMNS) {
        const double *left = a + row * j, *right = b + column;
        double *sums = out + row * k + column;
        if (row + ROWS <= i && column + COLUMNS <= k)
          add_terms(left, right, sums, from, to, j, k, ROWS, COLUMNS);
        else
          add_terms(left, right, sums, from, to, j, k, mini(ROWS, i - row), mini(COLUMNS, k - column));
      }
  }
}

// The same product for points, which have three columns whose sums stay in registers.
static inline void turn_points(const double *restrict a, const double *restrict b, double *restrict out, int64_t i) {
  for (int64_t row = 0; row < i; row++) {
    double sums[3] = {0.0};
    for (int t = 0; t < 3; t++)
      for (int c = 0; c < 3; c++) sums[c] += a[row * 3 + t] * b[t * 3 + c];
    for (int c = 0; c < 3; c++) out[row * 3 + c] = sums[c];
  }
}

// out[n,i,k] = a[n,i,j] b[m,j,k] with m = n, or one matrix for all.
API int32_t multiply_matrices(const double *restrict a, const double *restrict b,
                              double *restrict out, int64_t n, int64_t i, int64_t j, int64_t m,
                              int64_t k) {
  if (m != n && m != 1) return OUTSIDE;
  for (int64_t each = 0; each < n; each++) {
    const double *left = a + each * i * j, *right = m == 1 ? b : b + each * j * k;
    if (j == 3 && k == 3)
      turn_points(left, right, out + each * i * k, i);
    else
      multiply_rows(left, right, out + each * i * k, i, j, k);
  }
  return 0;
}

static void swap_rows(double *restrict a, double *restrict b, int64_t n) {
  for (int64_t c = 0; c < n; c++) {
    double kept = a[c];
    a[c] = b[c];
    b[c] = kept;
  }
}

// a -= factor b
static inline void take_off(double *restrict a, const double *restrict b, double factor, int64_t n) {
  if (factor == 0.0) return;  // many factors are zero in sparse matrices
  for (int64_t c = 0; c < n; c++) a[c] -= factor * b[c];
}

// Replace the columns first..last of a by those of L and U, and bring the rows below, and those of b, into the order of
// the pivots; return false if a pivot is zero.
static bool factor_panel(double *a, double *b, int64_t d, int64_t k, int64_t first, int64_t last) {
  for (int64_t c = first; c < last; c++) {
    int64_t best = c;
    for (int64_t r = c + 1; r < d; r++) {
      double size = absf8(a[r * d + c]);
      best = size > absf8(a[best * d + c]) || size != size ? r : best;
    }
    if (best != c) {
      swap_rows(a + c * d, a + best * d, d);
      swap_rows(b + c * k, b + best * k, k);
    }
    double pivot = a[c * d + c];
    if (pivot == 0.0) return false;
    for (int64_t r = c + 1; r < d; r++) {
      double *row = a + r * d;
      row[c] /= pivot;
      take_off(row + c + 1, a + c * d + c + 1, row[c], last - c - 1);
    }
  }
  return true;
}

// Solve a x = b for n matrices of d rows, by elimination with pivots chosen by columns. Overwrite a, and replace b by
// x. Return 1 if some matrix is singular, otherwise 0.
API int32_t solve_equations(double *a, double *b, int64_t n, int64_t d, int64_t k) {
  for (int64_t i = 0; i < n; i++, a += d * d, b += d * k) {
    for (int64_t first = 0; first < d; first += PANEL) {
      int64_t last = mini(first + PANEL, d);
      if (!factor_panel(a, b, d, k, first, last)) return 1;
      for (int64_t r = first + 1; r < d; r++)
        for (int64_t c = first; c < mini(r, last); c++)
          take_off(a + r * d + last, a + c * d + last, a[r * d + c], d - last);
    }
    for (int64_t r = 0; r < d; r++)
      for (int64_t c = 0; c < r; c++) take_off(b + r * k, b + c * k, a[r * d + c], k);
    for (int64_t r = d - 1; r >= 0; r--) {
      for (int64_t c = r + 1; c < d; c++) take_off(b + r * k, b + c * k, a[r * d + c], k);
      for (int64_t c = 0; c < k; c++) b[r * k + c] /= a[r * d + r];
    }
  }
  return 0;
}

// Rotate the symmetric a so that a[p][q] becomes zero, and rotate the columns of v alike.
static void rotate_pair(double *a, double *v, int64_t d, int64_t p, int64_t q) {
  double off = a[p * d + q];
  if (!(absf8(off) > TINY)) return;
  double theta = (a[q * d + q] - a[p * d + p]) / (2.0 * off);
  double t = 1.0 / (absf8(theta) + sqrtf8(theta * theta + 1.0));
  t = theta < 0.0 ? -t : t;
  double c = 1.0 / sqrtf8(t * t + 1.0), s = t * c;
  for (int64_t k = 0; k < d; k++) {
    double x = a[k * d + p], y = a[k * d + q];
    a[k * d + p] = c * x - s * y;
    a[k * d + q] = s * x + c * y;
  }
  for (int64_t k = 0; k < d; k++) {
    double x = a[p * d + k], y = a[q * d + k];
    a[p * d + k] = c * x - s * y;
    a[q * d + k] = s * x + c * y;
    x = v[k * d + p], y = v[k * d + q];
    v[k * d + p] = c * x - s * y;
    v[k * d + q] = s * x + c * y;
  }
}

// Make n symmetric matrices a diagonal by Jacobi's method, and write their eigenvectors to the columns of v.
API void diagonalise(double *restrict a, double *restrict v, int64_t n, int64_t d) {
  for (int64_t i = 0; i < n; i++, a += d * d, v += d * d) {
    for (int64_t k = 0; k < d * d; k++) v[k] = k % (d + 1) == 0 ? 1.0 : 0.0;
    for (int64_t sweep = 0; sweep < SWEEPS; sweep++) {
      double off = 0.0, on = 0.0;
      for (int64_t p = 0; p < d; p++) {
        on += a[p * d + p] * a[p * d + p];
        for (int64_t q = p + 1; q < d; q++) off += a[p * d + q] * a[p * d + q];
      }
      if (!(off > 1e-31 * on)) break;
      for (int64_t p = 0; p < d; p++)
        for (int64_t q = p + 1; q < d; q++) rotate_pair(a, v, d, p, q);
    }
  }
}
