/* SPDX-License-Identifier: MIT
 *
 * A tile of z, some vectors of rows times up to five columns, stays in registers while it walks along the columns of x.
 * Rows that are no multiple of a vector are covered by a last vector that overlaps its neighbour in the same tile.
 */
#include "kpirl_mpc_kernels.h"

#if defined(__GNUC__) && defined(__AVX512F__)
#define VECTOR_BYTES (8 * sizeof(real))
#define TILE_VECTORS 4
#elif defined(__GNUC__) && defined(__AVX__)
#define VECTOR_BYTES 32
#define TILE_VECTORS 2
#elif defined(__GNUC__) && (defined(__SSE2__) || defined(__ARM_NEON))
#define VECTOR_BYTES 16 /* wider ones than the processor's are kept in memory by gcc */
#define TILE_VECTORS 2
#endif

#ifdef VECTOR_BYTES
enum { LANES = (int)(VECTOR_BYTES / sizeof(real)) }; /* at most 8: see few_rows */
typedef real vector __attribute__((vector_size(VECTOR_BYTES), aligned(sizeof(real)), may_alias));
typedef real half __attribute__((vector_size(VECTOR_BYTES / 2), aligned(sizeof(real)), may_alias));
#define INLINE static inline __attribute__((always_inline))
#ifdef __clang__
#define UNROLL _Pragma("clang loop unroll(full)")
#else
#define UNROLL _Pragma("GCC unroll 8")
#endif

INLINE void tile(const int vectors, const int columns, const real *x, int rows, int inner, const real *y, real *z, int stride,
                 int first, int end) {
  vector sum[5][8];
  int row[8], v, c, k;
  UNROLL for (v = 0; v < vectors; ++v) row[v] = v < vectors - 1 ? first + v * LANES : end - LANES;
  UNROLL for (c = 0; c < columns; ++c)
    UNROLL for (v = 0; v < vectors; ++v) sum[c][v] = *(const vector *)(z + c * stride + row[v]);
  for (k = 0; k < inner; ++k)
    UNROLL for (v = 0; v < vectors; ++v) {
      const vector a = *(const vector *)(x + k * rows + row[v]);
      UNROLL for (c = 0; c < columns; ++c) sum[c][v] += a * y[k + c * inner];
    }
  UNROLL for (c = 0; c < columns; ++c)
    UNROLL for (v = 0; v < vectors; ++v) *(vector *)(z + c * stride + row[v]) = sum[c][v];
}

/* Rows first .. rows of `columns` columns, in tiles of nearly equal height of which the last is the highest. */
INLINE void panel(const int columns, const int most, const real *x, int rows, int inner, const real *y, real *z, int first) {
  const int vectors = (rows - first + LANES - 1) / LANES, tiles = (vectors + most - 1) / most;
  int t;
  for (t = 0; t < tiles; ++t) {
    const int height = vectors * (t + 1) / tiles - vectors * t / tiles;
    const int end = t < tiles - 1 ? first + height * LANES : rows;
    switch (height) {
      case 1: tile(1, columns, x, rows, inner, y, z, rows, first, end); break;
      case 2: tile(2, columns, x, rows, inner, y, z, rows, first, end); break;
      case 3: if (most > 2) tile(3, columns, x, rows, inner, y, z, rows, first, end); break;
      case 4: if (most > 2) tile(4, columns, x, rows, inner, y, z, rows, first, end); break;
    }
    first = end;
  }
}

/* Fewer rows than a vector has: one column at a time in registers. */
INLINE void low(const int rows, const real *restrict x, int inner, const real *restrict y, int columns, real *restrict z) {
  int i, j, k;
  for (j = 0; j < columns; ++j, y += inner, z += rows) {
    real sum[8];
    UNROLL for (i = 0; i < rows; ++i) sum[i] = z[i];
    for (k = 0; k < inner; ++k) UNROLL for (i = 0; i < rows; ++i) sum[i] += x[k * rows + i] * y[k];
    UNROLL for (i = 0; i < rows; ++i) z[i] = sum[i];
  }
}

static void few_rows(const real *x, int rows, int inner, const real *y, int columns, real *z) {
  switch (rows) {
    case 1: low(1, x, inner, y, columns, z); break;
    case 2: low(2, x, inner, y, columns, z); break;
    case 3: low(3, x, inner, y, columns, z); break;
    case 4: low(4, x, inner, y, columns, z); break;
    case 5: low(5, x, inner, y, columns, z); break;
    case 6: low(6, x, inner, y, columns, z); break;
    case 7: low(7, x, inner, y, columns, z); break;
  }
}

void kpirl_mpc_times(const real *x, int rows, int inner, const real *y, int columns, real *z) {
  int j = 0;
  if (rows < LANES) {
    few_rows(x, rows, inner, y, columns, z);
    return;
  }
#define PANELS(width) for (; j + width <= columns; j += width) panel(width, TILE_VECTORS, x, rows, inner, y + j * inner, z + j * rows, 0);
  PANELS(5)
  PANELS(4)
  PANELS(3)
  PANELS(2)
  PANELS(1)
#undef PANELS
}

void kpirl_mpc_times_lower(const real *x, int rows, int inner, const real *y, real *z) {
  int j = 0;
  if (rows < LANES) {
    few_rows(x, rows, inner, y, rows, z);
    return;
  }
#define PANELS(width) \
  for (; j + width <= rows; j += width) \
    panel(width, TILE_VECTORS, x, rows, inner, y + j * inner, z + j * rows, j < rows - LANES ? j : rows - LANES);
  PANELS(5)
  PANELS(4)
  PANELS(3)
  PANELS(2)
  PANELS(1)
#undef PANELS
}

/* The sum of the entries: halves are added to each other, the first ones in registers. */
INLINE real total(const vector v) {
  real parts[LANES / 2];
  int i, k;
  *(half *)parts = ((const half *)&v)[0] + ((const half *)&v)[1];
  UNROLL for (k = LANES / 4; k > 0; k /= 2) UNROLL for (i = 0; i < k; ++i) parts[i] += parts[i + k];
  return parts[0];
}

/* Some columns times x, of which `last` is the end, with zeros where it overlaps the first `whole` entries. */
INLINE void dots(const int columns, const real *a, int rows, const real *x, const vector last, int whole, real *y) {
  vector sum[4];
  int c, i;
  UNROLL for (c = 0; c < columns; ++c) sum[c] = *(const vector *)(a + (c + 1) * rows - LANES) * last;
  for (i = 0; i < whole; i += LANES) {
    const vector part = *(const vector *)(x + i);
    UNROLL for (c = 0; c < columns; ++c) sum[c] += *(const vector *)(a + c * rows + i) * part;
  }
  UNROLL for (c = 0; c < columns; ++c) y[c] += total(sum[c]);
}

typedef __typeof__((vector){0} == (vector){0}) mask;

/* The last vector of x, with zeros in the place of the first `whole` entries. */
INLINE vector end_of(const real *x, int rows, int whole) {
  mask index;
  int i;
  UNROLL for (i = 0; i < LANES; ++i) index[i] = rows - LANES + i;
  return (vector)((mask)*(const vector *)(x + rows - LANES) & (index >= whole));
}

/* Fewer rows than a vector has. */
static void short_dots(const real *a, int rows, int columns, const real *x, real *y) {
  int i, j;
  for (j = 0; j < columns; ++j) {
    real sum = 0;
    for (i = 0; i < rows; ++i) sum += a[i + j * rows] * x[i];
    y[j] += sum;
  }
}

void kpirl_mpc_transposed_times_vector(const real *a, int rows, int columns, const real *x, real *y) {
  const int whole = rows > 0 ? (rows - 1) / LANES * LANES : 0;
  vector last;
  int j = 0;
  if (rows < LANES) {
    short_dots(a, rows, columns, x, y);
    return;
  }
  last = end_of(x, rows, whole);
  for (; j + 4 <= columns; j += 4) dots(4, a + j * rows, rows, x, last, whole, y + j);
  for (; j < columns; ++j) dots(1, a + j * rows, rows, x, last, whole, y + j);
}

#else /* no vectors */

void kpirl_mpc_transposed_times_vector(const real *restrict a, int rows, int columns, const real *restrict x,
                                       real *restrict y) {
  int j;
  for (j = 0; j < columns; ++j) y[j] += kpirl_mpc_dot(a + j * rows, x, rows);
}

void kpirl_mpc_times(const real *restrict x, int rows, int inner, const real *restrict y, int columns, real *restrict z) {
  int i, j, k;
  for (j = 0; j < columns; ++j)
    for (k = 0; k < inner; ++k)
      for (i = 0; i < rows; ++i) z[i + j * rows] += x[i + k * rows] * y[k + j * inner];
}

void kpirl_mpc_times_lower(const real *restrict x, int rows, int inner, const real *restrict y, real *restrict z) {
  int i, j, k;
  for (j = 0; j < rows; ++j)
    for (k = 0; k < inner; ++k)
      for (i = j; i < rows; ++i) z[i + j * rows] += x[i + k * rows] * y[k + j * inner];
}

#endif

void kpirl_mpc_times_vector(const real *a, int rows, int columns, const real *x, real *y) {
  kpirl_mpc_times(a, rows, columns, x, 1, y);
}

void kpirl_mpc_symmetric_times_vector(const real *restrict a, int n, const real *restrict x, real *restrict y) {
  int i, j;
  for (j = 0; j < n; ++j) {
    real sum = a[j + j * n] * x[j];
    for (i = j + 1; i < n; ++i) {
      y[i] += a[i + j * n] * x[j];
      sum += a[i + j * n] * x[i];
    }
    y[j] += sum;
  }
}

void kpirl_mpc_transpose(const real *restrict a, int rows, int columns, real *restrict transposed) {
  int i, j = 0;
  for (; j + 4 <= columns; j += 4, a += 4 * rows) {
    const real *restrict b = a + rows, *restrict c = b + rows, *restrict d = c + rows;
    real *restrict to = transposed + j;
    for (i = 0; i < rows; ++i, to += columns) {
      to[0] = a[i];
      to[1] = b[i];
      to[2] = c[i];
      to[3] = d[i];
    }
  }
  for (; j < columns; ++j, a += rows) {
    real *restrict to = transposed + j;
    for (i = 0; i < rows; ++i, to += columns) *to = a[i];
  }
}

void kpirl_mpc_mirror(real *a, int n) {
  int i, j = 0, k;
  for (; j + 4 <= n; j += 4) {
    const real *b = a + j * n;
    for (k = 1; k < 4; ++k)
      for (i = 0; i < k; ++i) a[j + i + (j + k) * n] = b[j + k + i * n];
    for (i = j + 4; i < n; ++i) {
      real *to = a + j + i * n;
      to[0] = b[i];
      to[1] = b[i + n];
      to[2] = b[i + 2 * n];
      to[3] = b[i + 3 * n];
    }
  }
  for (i = j + 1; i < n; ++i)
    for (k = j; k < i; ++k) a[k + i * n] = a[i + k * n];
}

void kpirl_mpc_mirror_stages(int T, int n_s, int n_x, real *H) {
  int t;
  for (t = 0; t <= T; ++t) kpirl_mpc_mirror(H + t * n_x * n_x, t < T ? n_x : n_s);
}

void kpirl_mpc_add_rows(const real *columns, int n, int rows, const real *weights, real *M) {
  int i, j, r;
  for (r = 0; r < rows; ++r) {
    const real *restrict a = columns + r * n;
    for (j = 0; j < n; ++j) {
      const real factor = weights[r] * a[j];
      if (factor == 0) continue;
      for (i = j; i < n; ++i) M[i + j * n] += factor * a[i];
    }
  }
}

void kpirl_mpc_stage_rows_times(int T, int n_s, int n_x, const real *gradients, int rows, int last_rows, const real *x,
                                real *values) {
  int t;
  for (t = 0; rows > 0 && t < T; ++t)
    kpirl_mpc_transposed_times_vector(gradients + t * n_x * rows, n_x, rows, x + t * n_x, values + t * rows);
  if (last_rows > 0)
    kpirl_mpc_transposed_times_vector(gradients + T * n_x * rows, n_s, last_rows, x + T * n_x, values + T * rows);
}

void kpirl_mpc_stage_rows_transposed_times(int T, int n_s, int n_x, const real *gradients, int rows, int last_rows,
                                           const real *values, real *product) {
  int t;
  for (t = 0; rows > 0 && t < T; ++t)
    kpirl_mpc_times_vector(gradients + t * n_x * rows, n_x, rows, values + t * rows, product + t * n_x);
  if (last_rows > 0)
    kpirl_mpc_times_vector(gradients + T * n_x * rows, n_s, last_rows, values + T * rows, product + T * n_x);
}
