"""The C of dense products, z = start + x y: tiles in registers, of the heights that the shapes of a file need.

A tile of z, some vectors of rows times up to five columns, stays in registers while it walks along the columns of x.
Every shape that occurs has a function of its own, in which the compiler knows all sizes. An entry of z sums its
products in the order of CasADi's virtual machine, except where several partial sums hide the latency of low tiles.
"""

from __future__ import annotations

from collections.abc import Iterator

_TILES = r"""/* rows first .. end of `columns` columns, as vectors of which the last overlaps its neighbour if need be;
   `chains` partial sums hide the latency of a tile that is low */
static INLINE void kernel_@kind@(const int vectors, const int columns, const int chains, const casadi_real* x,
    casadi_int nrow_x, casadi_int ncol_x, const casadi_real* y, const casadi_real* start, casadi_real* z,
    casadi_int first, casadi_int end) {
  @kind@_vector sum[5][MOST_VECTORS];
  casadi_int row[MOST_VECTORS], k = 0;
  int v, c, p;
  UNROLL for (v = 0; v < vectors; ++v) row[v] = v < vectors - 1 ? first + v * @lanes@ : end - @lanes@;
  UNROLL for (c = 0; c < columns * chains; ++c)
    UNROLL for (v = 0; v < vectors; ++v)
      sum[c][v] = start && c < columns ? *(const @kind@_vector*) (start + c * nrow_x + row[v]) : (@kind@_vector) {0};
  for (; k + chains <= ncol_x; k += chains)
    UNROLL for (p = 0; p < chains; ++p)
      UNROLL for (v = 0; v < vectors; ++v) {
        const @kind@_vector a = *(const @kind@_vector*) (x + (k + p) * nrow_x + row[v]);
        UNROLL for (c = 0; c < columns; ++c) sum[p * columns + c][v] += a * y[k + p + c * ncol_x];
      }
  for (; k < ncol_x; ++k)
    UNROLL for (v = 0; v < vectors; ++v) {
      const @kind@_vector a = *(const @kind@_vector*) (x + k * nrow_x + row[v]);
      UNROLL for (c = 0; c < columns; ++c) sum[c][v] += a * y[k + c * ncol_x];
    }
  UNROLL for (c = columns; c < columns * chains; ++c)
    UNROLL for (v = 0; v < vectors; ++v) sum[c % columns][v] += sum[c][v];
  UNROLL for (c = 0; c < columns; ++c)
    UNROLL for (v = 0; v < vectors; ++v) *(@kind@_vector*) (z + c * nrow_x + row[v]) = sum[c][v];
}

/* all rows of `columns` columns, in tiles of nearly equal height */
static INLINE void kernel_@kind@_panel(const int columns, const int most, const casadi_real* x, casadi_int nrow_x,
    casadi_int ncol_x, const casadi_real* y, const casadi_real* start, casadi_real* z) {
  const casadi_int vectors = (nrow_x + @lanes@ - 1) / @lanes@, tiles = (vectors + most - 1) / most;
  casadi_int first = 0, t;
  for (t = 0; t < tiles; ++t) {
    casadi_int height = vectors * (t + 1) / tiles - vectors * t / tiles, known = 0;
    casadi_int end = t < tiles - 1 ? first + height * @lanes@ : nrow_x;
#ifdef KERNEL_IN_ORDER
#define CHAINS(h) 1
#else
#define CHAINS(h) (columns > 1 ? 1 : h > 4 ? 1 : h > 2 ? 2 : 4)
#endif
#define TILE(h) if (h <= most && h >= vectors / tiles && h <= vectors / tiles + 1 && h == height) { \
      kernel_@kind@(h, columns, CHAINS(h), x, nrow_x, ncol_x, y, start, z, first, end); \
      known = 1; \
    }
    @heights of @kind@s@
    if (!known) __builtin_trap(); /* a height that `tiles` did not foresee */
#undef TILE
#undef CHAINS
    first = end;
  }
}

"""

_KERNEL = r"""
#if defined(__AVX512F__)
@wide@
#else
@narrow@
#endif
#define HALF_LANES 4
#define MOST_VECTORS 25
#define UNROLL _Pragma("GCC unroll 32")
#define INLINE inline __attribute__((always_inline))
/* Unaligned vectors of doubles; a compiler without that width splits them. */
typedef casadi_real tile_vector __attribute__((vector_size(TILE_LANES * sizeof(casadi_real)), aligned(8), may_alias));
typedef casadi_real half_vector __attribute__((vector_size(HALF_LANES * sizeof(casadi_real)), aligned(8), may_alias));

@tiles@/* 4 .. 8 rows as two vectors of four that overlap, with two partial sums each */
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

/* z = start + x y, where no start stands for zeros. One column in columns of x that are no whole vectors is found by
   vectors of four, which cross fewer cache lines. */
static INLINE void kernel_mtimes_from(const casadi_real* x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* y, casadi_int ncol_y, const casadi_real* start, casadi_real* z) {
  casadi_int i = 0, j, k;
  if (nrow_x >= TILE_LANES) {
#define PANEL(kind, n, most) kernel_##kind##_panel(n, most, x, nrow_x, ncol_x, y + i * ncol_x, \
      start ? start + i * nrow_x : 0, z + i * nrow_x)
    for (; i + 5 <= ncol_y; i += 5) PANEL(tile, 5, TILE_VECTORS);
    i = ncol_y / 5 * 5;
    if (ncol_y % 5 == 4) PANEL(tile, 4, TILE_VECTORS);
    if (ncol_y % 5 == 3) PANEL(tile, 3, TILE_VECTORS);
    if (ncol_y % 5 == 2) PANEL(tile, 2, TILE_VECTORS * 2);
    if (ncol_y % 5 == 1 && nrow_x % TILE_LANES == 0) PANEL(tile, 1, TILE_VECTORS * 2);
    if (ncol_y % 5 == 1 && nrow_x % TILE_LANES != 0) PANEL(half, 1, HALF_VECTORS);
#undef PANEL
    return;
  }
  for (j = 0; j < nrow_x * ncol_y; ++j) z[j] = start ? start[j] : 0;
#ifndef KERNEL_IN_ORDER
  if (nrow_x == 1) {
    kernel_row(x, ncol_x, y, ncol_y, z);
    return;
  }
  if (nrow_x >= HALF_LANES) {
    kernel_low(x, nrow_x, ncol_x, y, ncol_y, z);
    return;
  }
#endif
  for (; i < ncol_y; ++i)
    for (k = 0; k < ncol_x; ++k)
      for (j = 0; j < nrow_x; ++j) z[j + i * nrow_x] += x[j + k * nrow_x] * y[k + i * ncol_x];
}

static void casadi_mtimes_dense(const casadi_real* x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* y, casadi_int ncol_y, casadi_real* z, casadi_int tr) {
  casadi_int i, j, k;
  if (!tr) {
    for (i = 0; i < ncol_y; ++i)
      for (k = 0; k < ncol_x; ++k)
        for (j = 0; j < nrow_x; ++j) z[j + i * nrow_x] += x[j + k * nrow_x] * y[k + i * ncol_x];
    return;
  }
  for (i = 0; i < ncol_y; ++i)
    for (j = 0; j < ncol_x; ++j)
      for (k = 0; k < nrow_x; ++k) z[j + i * ncol_x] += x[k + j * nrow_x] * y[k + i * nrow_x];
}
"""

KINDS = (("tile", "TILE_LANES"), ("half", "HALF_LANES"))
_HALF = 4  # HALF_LANES
_WIDTHS = {"@wide@": (8, 4, 25), "@narrow@": (4, 2, 4)}  # TILE_LANES, and the most TILE_VECTORS and HALF_VECTORS
PRODUCTS = _KERNEL.lstrip().replace(
    "@tiles@", "".join(_TILES.replace("@kind@", kind).replace("@lanes@", lanes) for kind, lanes in KINDS)
)
for _name, _width in _WIDTHS.items():
    PRODUCTS = PRODUCTS.replace(
        _name, "#define TILE_LANES {}\n#define TILE_VECTORS {}\n#define HALF_VECTORS {}".format(*_width)
    )


def tiles(rows: int, columns: int) -> Iterator[tuple[str, int]]:
    """Kinds and heights [vectors] of the tiles of a product in `kernel_mtimes_from`, with vectors of either width."""
    rest = columns % 5
    for lanes, tall, half in _WIDTHS.values():
        if rows < lanes:
            continue
        panels = [("tile", lanes, tall)] * (columns >= 5 or rest in (3, 4))
        if rest == 2 or (rest == 1 and rows % lanes == 0):
            panels.append(("tile", lanes, 2 * tall))
        elif rest == 1:
            panels.append(("half", _HALF, half))
        for kind, length, most in panels:
            vectors = -(-rows // length)
            count = -(-vectors // most)
            yield from ((kind, vectors * (t + 1) // count - vectors * t // count) for t in range(count))
