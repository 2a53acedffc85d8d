"""Dense products and tanh in generated C, written so that a compiler turns them into vector instructions.

CasADi's own `casadi_mtimes_dense`, z += x y, runs along rows and cannot be vectorised. This one keeps a tile of z, some
vectors of rows times up to five columns, in registers while it walks along the columns of x. Results differ by
rounding alone; NaN and infinity go through as in any sum. So they do in tanh, which is right to two units in the last
place.
"""

from __future__ import annotations

import inspect
import re

import kpirl_ocp.ocp.codegen.copy_elision as copy_elision

_KERNEL = r"""
#if defined(__AVX512F__)
#define TILE_LANES 8
#define TILE_VECTORS 4
#else
#define TILE_LANES 4
#define TILE_VECTORS 2
#endif
#define HALF_LANES 4
#define UNROLL _Pragma("GCC unroll 8")
/* Unaligned vectors of doubles; a compiler without that width splits them. */
typedef casadi_real tile_vector __attribute__((vector_size(TILE_LANES * sizeof(casadi_real)), aligned(8), may_alias));
typedef casadi_real half_vector __attribute__((vector_size(HALF_LANES * sizeof(casadi_real)), aligned(8), may_alias));

/* rows first .. end of `columns` columns, as vectors of which the last overlaps its neighbour if it has to;
   `chains` partial sums hide the latency of a tile that is low */
static inline __attribute__((always_inline)) void kernel_tile(const int vectors, const int columns, const int chains,
    const casadi_real* x, casadi_int nrow_x, casadi_int ncol_x, const casadi_real* y, const casadi_real* start,
    casadi_real* z, casadi_int first, casadi_int end) {
  tile_vector sum[5][8];
  casadi_int row[8], k = 0;
  int v, c, p;
  UNROLL for (v = 0; v < vectors; ++v) row[v] = v < vectors - 1 ? first + v * TILE_LANES : end - TILE_LANES;
  UNROLL for (c = 0; c < columns * chains; ++c)
    UNROLL for (v = 0; v < vectors; ++v)
      sum[c][v] = start && c < columns ? *(const tile_vector*) (start + c * nrow_x + row[v]) : (tile_vector) {0};
  for (; k + chains <= ncol_x; k += chains)
    UNROLL for (p = 0; p < chains; ++p)
      UNROLL for (v = 0; v < vectors; ++v) {
        const tile_vector a = *(const tile_vector*) (x + (k + p) * nrow_x + row[v]);
        UNROLL for (c = 0; c < columns; ++c) sum[p * columns + c][v] += a * y[k + p + c * ncol_x];
      }
  for (; k < ncol_x; ++k)
    UNROLL for (v = 0; v < vectors; ++v) {
      const tile_vector a = *(const tile_vector*) (x + k * nrow_x + row[v]);
      UNROLL for (c = 0; c < columns; ++c) sum[c][v] += a * y[k + c * ncol_x];
    }
  UNROLL for (c = columns; c < columns * chains; ++c)
    UNROLL for (v = 0; v < vectors; ++v) sum[c % columns][v] += sum[c][v];
  UNROLL for (c = 0; c < columns; ++c)
    UNROLL for (v = 0; v < vectors; ++v) *(tile_vector*) (z + c * nrow_x + row[v]) = sum[c][v];
}

/* all rows of `columns` columns, in tiles of nearly equal height */
static inline __attribute__((always_inline)) void kernel_panel(const int columns, const int most,
    const casadi_real* x, casadi_int nrow_x, casadi_int ncol_x, const casadi_real* y, const casadi_real* start,
    casadi_real* z) {
  const casadi_int vectors = (nrow_x + TILE_LANES - 1) / TILE_LANES, tiles = (vectors + most - 1) / most;
  casadi_int first = 0, t;
  for (t = 0; t < tiles; ++t) {
    casadi_int height = vectors * (t + 1) / tiles - vectors * t / tiles;
    casadi_int end = t < tiles - 1 ? first + height * TILE_LANES : nrow_x;
#define TILE(h) if (h <= most && height == h) \
      kernel_tile(h, columns, columns > 1 ? 1 : h > 4 ? 1 : h > 2 ? 2 : 4, x, nrow_x, ncol_x, y, start, z, first, end);
    TILE(1) TILE(2) TILE(3) TILE(4) TILE(5) TILE(6) TILE(7) TILE(8)
#undef TILE
    first = end;
  }
}

/* 4 .. 8 rows as two vectors of four that overlap, with two partial sums each */
static inline void kernel_low(const casadi_real* x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* y, casadi_int ncol_y, casadi_real* z) {
  const casadi_int below = nrow_x - HALF_LANES;
  casadi_int i, k;
  for (i = 0; i < ncol_y; ++i, y += ncol_x, z += nrow_x) {
    const casadi_real* column = x;
    half_vector top[2] = {*(const half_vector*) z, {0}}, bottom[2] = {*(const half_vector*) (z + below), {0}};
    for (k = 0; k + 2 <= ncol_x; k += 2, column += 2 * nrow_x) {
      top[0] += *(const half_vector*) column * y[k];
      bottom[0] += *(const half_vector*) (column + below) * y[k];
      top[1] += *(const half_vector*) (column + nrow_x) * y[k + 1];
      bottom[1] += *(const half_vector*) (column + nrow_x + below) * y[k + 1];
    }
    if (k < ncol_x) {
      top[0] += *(const half_vector*) column * y[k];
      bottom[0] += *(const half_vector*) (column + below) * y[k];
    }
    top[0] += top[1];
    bottom[0] += bottom[1];
    *(half_vector*) z = top[0];
    *(half_vector*) (z + below) = bottom[0];
  }
}

/* z += y' x: sums along the columns of y, four of them side by side */
static inline void kernel_row(const casadi_real* x, casadi_int count, const casadi_real* y, casadi_int ncol_y,
    casadi_real* z) {
  casadi_int i, k;
  int c, lane;
  for (i = 0; i < ncol_y; i += 4, y += 4 * count, z += 4) {
    const int columns = ncol_y - i < 4 ? (int) (ncol_y - i) : 4;
    tile_vector sum[4] = {{0}};
    half_vector half[4] = {{0}};
    casadi_real rest[4] = {0};
    if (columns == 4) {
      for (k = 0; k + TILE_LANES <= count; k += TILE_LANES)
        UNROLL for (c = 0; c < 4; ++c)
          sum[c] += *(const tile_vector*) (x + k) * *(const tile_vector*) (y + k + c * count);
      if (k + HALF_LANES <= count) {
        UNROLL for (c = 0; c < 4; ++c)
          half[c] = *(const half_vector*) (x + k) * *(const half_vector*) (y + k + c * count);
        k += HALF_LANES;
      }
      for (; k < count; ++k)
        UNROLL for (c = 0; c < 4; ++c) rest[c] += x[k] * y[k + c * count];
    } else {
      for (c = 0; c < columns; ++c) {
        for (k = 0; k + TILE_LANES <= count; k += TILE_LANES)
          sum[c] += *(const tile_vector*) (x + k) * *(const tile_vector*) (y + k + c * count);
        if (k + HALF_LANES <= count) {
          half[c] = *(const half_vector*) (x + k) * *(const half_vector*) (y + k + c * count);
          k += HALF_LANES;
        }
        for (; k < count; ++k) rest[c] += x[k] * y[k + c * count];
      }
    }
    for (c = 0; c < columns; ++c) {
      UNROLL for (lane = 0; lane < TILE_LANES; lane += HALF_LANES)
        half[c] += *(const half_vector*) ((const casadi_real*) &sum[c] + lane);
      z[c] += rest[c] + ((half[c][0] + half[c][2]) + (half[c][1] + half[c][3]));
    }
  }
}

/* z = start + x y, where no start stands for zeros */
static void kernel_mtimes_from(const casadi_real* x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* y, casadi_int ncol_y, const casadi_real* start, casadi_real* z) {
  casadi_int i = 0, j, k;
  if (nrow_x >= TILE_LANES) {
#define PANELS(n, most) for (; i + n <= ncol_y; i += n) \
      kernel_panel(n, most, x, nrow_x, ncol_x, y + i * ncol_x, start ? start + i * nrow_x : 0, z + i * nrow_x);
    PANELS(5, TILE_VECTORS)
    PANELS(4, TILE_VECTORS)
    PANELS(3, TILE_VECTORS)
    PANELS(2, TILE_VECTORS * 2)
    PANELS(1, TILE_VECTORS * 2)
#undef PANELS
    return;
  }
  for (j = 0; j < nrow_x * ncol_y; ++j) z[j] = start ? start[j] : 0;
  if (nrow_x == 1) {
    kernel_row(x, ncol_x, y, ncol_y, z);
  } else if (nrow_x >= HALF_LANES) {
    kernel_low(x, nrow_x, ncol_x, y, ncol_y, z);
  } else {
    for (; i < ncol_y; ++i)
      for (k = 0; k < ncol_x; ++k)
        for (j = 0; j < nrow_x; ++j) z[j + i * nrow_x] += x[j + k * nrow_x] * y[k + i * ncol_x];
  }
}

static void casadi_mtimes_dense(const casadi_real* x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* y, casadi_int ncol_y, casadi_real* z, casadi_int tr) {
  casadi_int i, j, k;
  if (!tr) {
    kernel_mtimes_from(x, nrow_x, ncol_x, y, ncol_y, z, z);
    return;
  }
  for (i = 0; i < ncol_y; ++i)
    for (j = 0; j < ncol_x; ++j)
      for (k = 0; k < nrow_x; ++k) z[j + i * ncol_x] += x[k + j * nrow_x] * y[k + i * nrow_x];
}
"""

_COPY = r"""#include <string.h>
static inline void casadi_copy(const casadi_real* x, casadi_int n, casadi_real* y) {
  if (!y) return;
  if (x) memmove(y, x, n * sizeof(casadi_real)); else memset(y, 0, n * sizeof(casadi_real));
}
"""

_TANH = r"""#include <math.h>
#include <string.h>
typedef double wide __attribute__((vector_size(32)));
typedef long long wide_bits __attribute__((vector_size(32)));

/* tanh x = e / (e + 2) with e = exp(2 |x|) - 1 = 2^n (exp(r) - 1) + (2^n - 1), |r| <= log(2) / 2, by Taylor's series;
   beyond 22 it is 1 to the last place. Comparisons with NaN are false, so that NaN stays. */
static inline wide kernel_tanh4(wide x) {
  const wide zero = {0}, round = zero + 0x1.8p52;
  const wide_bits sign = (wide_bits) x & ((wide_bits) {0} + (-0x7fffffffffffffffLL - 1));
  wide a = (wide) ((wide_bits) x ^ sign), n, r, p, power, e;
  const wide_bits far = a > 22.0;
  a = 2 * (wide) ((far & (wide_bits) (zero + 22.0)) | (~far & (wide_bits) a));
  n = a * 0x1.71547652b82fep+0 + round;
  power = (wide) (((wide_bits) n + 1023) << 52);
  n -= round;
  r = a - n * 6.93147180369123816490e-01 - n * 1.90821492927058770002e-10; /* the first product is exact */
  p = r * (1 / 6227020800.0) + 1 / 479001600.0;
  p = p * r + 1 / 39916800.0;
  p = p * r + 1 / 3628800.0;
  p = p * r + 1 / 362880.0;
  p = p * r + 1 / 40320.0;
  p = p * r + 1 / 5040.0;
  p = p * r + 1 / 720.0;
  p = p * r + 1 / 120.0;
  p = p * r + 1 / 24.0;
  p = p * r + 1 / 6.0;
  p = p * r + 0.5;
  p = p * r * r + r;
  e = power * p + (power - 1);
  return (wide) ((wide_bits) (e / (e + 2)) | sign);
}

static void kernel_tanh(const casadi_real* x, casadi_int n, casadi_real* y) {
  wide some;
  for (; n >= 4; n -= 4, x += 4, y += 4) {
    memcpy(&some, x, 32);
    some = kernel_tanh4(some);
    memcpy(y, &some, 32);
  }
  if (n > 0) {
    some = (wide) {0};
    memcpy(&some, x, n * sizeof(casadi_real));
    some = kernel_tanh4(some);
    memcpy(y, &some, n * sizeof(casadi_real));
  }
}

"""

# The least and the largest of an array; as with fmin and fmax, NaN does not count.
_EXTREME = r"""static casadi_real casadi_vf@name@(const casadi_real* x, casadi_int n, casadi_real r) {
  casadi_real some[32];
  casadi_int i = 0;
  int j, half;
  for (j = 0; j < 32; ++j) some[j] = r;
  for (; i + 32 <= n; i += 32)
    for (j = 0; j < 32; ++j) some[j] = x[i + j] @than@ some[j] ? x[i + j] : some[j];
  for (half = 16; half > 0; half /= 2)
    for (j = 0; j < half; ++j) some[j] = some[j + half] @than@ some[j] ? some[j + half] : some[j];
  for (r = some[0]; i < n; ++i) r = x[i] @than@ r ? x[i] : r;
  return r;
}
"""
_LEAST, _LARGEST = (
    _EXTREME.replace("@name@", name).replace("@than@", than) for name, than in (("min", "<"), ("max", ">"))
)

SOURCES = _KERNEL + _COPY + _LEAST + _LARGEST + _TANH + inspect.getsource(copy_elision)
"""All text on which the result of `with_fast_kernels` depends; for the key of a cache."""
_BODIES = {
    "void casadi_mtimes_dense": _KERNEL.lstrip(),
    "void casadi_copy": _COPY,
    "casadi_real casadi_vfmin": _LEAST,
    "casadi_real casadi_vfmax": _LARGEST,
}
_TANH_LOOP = re.compile(r"for \(i=0, rr=([^,]+), cs=([^;]+); i<(\d+); \+\+i\) \*rr\+\+ = tanh\( ?\*cs\+\+ ?\);")


def with_fast_kernels(source: str) -> str:
    """Generated C with its dense products, copies, extremes and tanh of arrays replaced, and with fewer copies.

    Nothing is added for functions that it does not contain.
    """
    for name, body in _BODIES.items():
        start = source.find(f"{name}(")
        if start >= 0:
            end = source.index("\n}\n", start) + len("\n}\n")
            source = source[:start] + body + source[end:]
    source = copy_elision.with_fewer_copies(source)
    source, found = _TANH_LOOP.subn(r"kernel_tanh(\2, \3, \1);", source)
    if found:
        at = re.search(r"#define casadi_int .*\n(#endif\n)?", source)
        assert at, "generated C defines casadi_int"
        source = source[: at.end()] + _TANH + source[at.end() :]
    return source
