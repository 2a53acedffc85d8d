/* SPDX-License-Identifier: MIT
 *
 * What slacks, forces and steps of a linearised KKT system are compared with, so that no unit counts.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

static const real LEAST_FORCE = (real)1e-3; /* share of the largest one, in units of the cost, that every force is compared with */
static const real NOTHING = (real)1e-9;     /* an entry of x that is smaller everywhere has no size of its own */
static const real LEAST = (real)1e-12;      /* share of the largest curvature, in units of the cost, below which one is none */

real kpirl_mpc_over(real value, real size) { return value / (size > 0 ? size : 1); }

real kpirl_mpc_worse(real a, real b) { return isnan(a) || isnan(b) ? (real)INFINITY : kpirl_mpc_max(a, b); }

/* The absolute values of the first `count` of the `rows` of each column. */
static void absolute_rows(const real *restrict from, int rows, int columns, int count, real *restrict to) {
  int i, j;
  for (j = 0; j < columns; ++j, from += rows, to += count)
    for (i = 0; i < count; ++i) to[i] = kpirl_mpc_abs(from[i]);
}

static int any_nonzero(const real *values, int count) {
  int i, any = 0;
  for (i = 0; i < count; ++i) any |= values[i] != 0;
  return any;
}

/* Where the first n_s rows and columns of H (n, n) have entries off the diagonal: from `first` up to the end that is returned; in
 * many problems few. */
static int coupled(const real *H, int n_s, int n, int *first) {
  int end = n_s;
  for (*first = 0; *first < n_s; ++*first)
    if (any_nonzero(H + *first * (n + 1) + 1, n_s - 1 - *first)) break;
  while (end > *first && !any_nonzero(H + (end - 1) * n, end - 1)) --end;
  return end;
}

/* values (n_x) += the diagonal of |F|' |H| |F| of what H (n, n) holds off its diagonal, of the first n_s rows and columns.
 * work: n_s (n_s + 2 n_x) numbers. */
static void add_coupling(const real *F, int n_s, int n_x, const real *H, int n, real *restrict work, real *restrict values) {
  int i, k, first;
  const int count = coupled(H, n_s, n, &first) - first;
  real *absolute_H = work, *rows = absolute_H + count * count, *product = rows + n_x * count; /* |F|' of these rows */
  if (count <= 0) return;
  absolute_rows(H + first * (n + 1), n, count, count, absolute_H);
  for (i = 0; i < count; ++i) absolute_H[i * (count + 1)] = 0;
  for (k = 0; k < count; ++k)
    for (i = 0; i < n_x; ++i) rows[i + k * n_x] = kpirl_mpc_abs(F[first + k + i * n_s]);
  memset(product, 0, (size_t)(n_x * count) * sizeof(real));
  kpirl_mpc_times(rows, n_x, count, absolute_H, count, product);
  for (k = 0; k < count; ++k)
    for (i = 0; i < n_x; ++i) values[i] += rows[i + k * n_x] * product[i + k * n_x];
}

/* The same of the diagonal of H. work: n_s (n_x + 1) numbers. */
static void add_squares(const real *restrict F, int n_s, int n_x, const real *H, int n, real *restrict work, real *values) {
  real *restrict squares = work + n_s;
  int i;
  for (i = 0; i < n_s; ++i) work[i] = kpirl_mpc_abs(H[i + i * n]);
  for (i = 0; i < n_s * n_x; ++i) squares[i] = F[i] * F[i];
  kpirl_mpc_transposed_times_vector(squares, n_s, n_x, work, values);
}

void kpirl_mpc_system_curvature(const kpirl_mpc_system *s, real *curvature) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions;
  int t, i;
  for (t = 0; t <= T; ++t) {
    const int n = t < T ? n_x : n_s, after = t + 1 < T ? n_x : n_s;
    const real *H = s->H + (size_t)t * n_x * n_x, *next = H + n_x * n_x, *F = s->F + (size_t)t * n_s * n_x;
    for (i = 0; i < n; ++i) curvature[t * n_x + i] = kpirl_mpc_abs(H[i + i * n]);
    if (t == T) break;
    add_squares(F, n_s, n_x, next, after, s->scratch, curvature + t * n_x);
    add_coupling(F, n_s, n_x, next, after, s->scratch, curvature + t * n_x);
  }
}

/* |columns|' values over the stages; or the largest |entry| * value, where `largest`. */
static void measure_rows(const kpirl_mpc_system *s, const real *columns, int rows, int last_rows, const real *values,
                         int largest, real *result) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions;
  int t, r, i;
  for (t = 0; t <= T; ++t) {
    const int n = t < T ? n_x : n_s, count = t < T ? rows : last_rows;
    for (r = 0; r < count; ++r) {
      const real *column = columns + (size_t)t * n_x * rows + r * n;
      real sum = 0;
      for (i = 0; i < n; ++i) {
        const real part = column[i] != 0 ? kpirl_mpc_abs(column[i]) * values[t * n_x + i] : 0;
        sum = !largest ? sum + part : part > sum || isnan(part) ? part : sum;
      }
      result[t * rows + r] = sum;
    }
  }
}

static void measure(const kpirl_mpc_system *s, const real *values, int largest, real *result) {
  const int path = s->n_bounds + s->horizon * s->n_path + s->n_terminal;
  int i;
  for (i = 0; i < s->n_bounds; ++i) result[i] = values[s->entries[i]];
  measure_rows(s, s->G, s->n_path, s->n_terminal, values, largest, result + s->n_bounds);
  measure_rows(s, s->E, s->n_equality, s->n_terminal_equality, values, largest, result + path);
}

void kpirl_mpc_row_sizes(const kpirl_mpc_system *s, real *row_sizes) { measure(s, s->sizes, 0, row_sizes); }

void kpirl_mpc_force_shares(const kpirl_mpc_system *s, const real *costates, const real *curvature, real *shares) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  real *balanced = s->scratch, *pulls = balanced + n_w, *absolute_F = pulls + n_s, most = 0;
  int t, i;
  for (i = 0; i < n_w; ++i) balanced[i] = curvature[i] * s->sizes[i];
  for (t = 0; t < T; ++t) {
    absolute_rows(costates + t * n_s, n_s, 1, n_s, pulls);
    absolute_rows(s->F + (size_t)t * n_s * n_x, n_s * n_x, 1, n_s * n_x, absolute_F);
    kpirl_mpc_transposed_times_vector(absolute_F, n_s, n_x, pulls, balanced + t * n_x);
    kpirl_mpc_axpy(1, pulls, n_s, balanced + (t + 1) * n_x);
  }
  for (i = 0; i < n_w; ++i) most = kpirl_mpc_max(most, balanced[i] * s->sizes[i]);
  for (i = 0; i < n_w; ++i) balanced[i] = 1 / kpirl_mpc_max(balanced[i], LEAST_FORCE * most / s->sizes[i]);
  measure(s, balanced, 1, shares);
}

/* ---- of a point ------------------------------------------------------------------------------------------------ */

/* Every entry of values (n_w), none negative, becomes the largest of its kind over the horizon. */
static void largest_of_kind(int T, int n_s, int n_u, real *values) {
  const int n_x = n_s + n_u;
  int t, i;
  for (t = 1; t <= T; ++t)
    for (i = 0; i < (t < T ? n_x : n_s); ++i) values[i] = kpirl_mpc_max(values[t * n_x + i], values[i]);
  for (t = 1; t <= T; ++t) memcpy(values + t * n_x, values, (size_t)(t < T ? n_x : n_s) * sizeof(real));
}

void kpirl_mpc_point_sizes(const kpirl_mpc_dimensions *of, const kpirl_mpc_rows *rows, const real *x, real *sizes) {
  const int n_w = of->horizon * (of->n_states + of->n_actions) + of->n_states;
  int i;
  for (i = 0; i < n_w; ++i) sizes[i] = kpirl_mpc_max(kpirl_mpc_abs(x[i]), rows->largest_bound[i]);
  largest_of_kind(of->horizon, of->n_states, of->n_actions, sizes);
  for (i = 0; i < n_w; ++i)
    if (!(sizes[i] > NOTHING)) sizes[i] = 1;
}

void kpirl_mpc_find_roots(kpirl_mpc_kkt *k) {
  kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s);
  real *energy = s->scratch, most; /* in the unit of the cost */
  int i;
  for (i = 0; i < n_w; ++i) energy[i] = k->curvature[i] * s->sizes[i] * s->sizes[i];
  most = kpirl_mpc_norm_inf(energy, n_w);
  largest_of_kind(s->horizon, s->n_states, s->n_actions, energy);
  for (i = 0; i < s->n_decisions; ++i) {
    const real own = energy[s->decisions[i]], used = own > LEAST * most ? own : most > 0 ? most : 1;
    s->roots[i] = kpirl_mpc_sqrt(used) / s->sizes[s->decisions[i]];
  }
}

void kpirl_mpc_relative_forces(const kpirl_mpc_kkt *k, const real *forces, real *relative) {
  int i;
  for (i = 0; i < kpirl_mpc_system_n_rows(&k->system); ++i) relative[i] = forces[i] == 0 ? 0 : forces[i] * k->shares[i];
}

/* ---- lengths of rows ---------------------------------------------------------------------------------------- */

/* a' S a for the columns a (n) of `columns`; product: n numbers. */
static void variances(const real *columns, int n, int rows, const real *S, real *product, real *result) {
  int r;
  for (r = 0; r < rows; ++r) {
    memset(product, 0, (size_t)n * sizeof(real));
    kpirl_mpc_times_vector(S, n, n, columns + r * n, product);
    result[r] = kpirl_mpc_dot(columns + r * n, product, n);
  }
}

int kpirl_mpc_decision_of(const kpirl_mpc_system *s, int row) {
  const int n_s = s->n_states, n_x = n_s + s->n_actions;
  int j, entry;
  if (row >= s->n_bounds) return -1;
  entry = s->entries[row];
  for (j = 0; j < s->n_free; ++j)
    if (s->free[j] == entry) return j;
  if (entry >= s->horizon * n_x || entry % n_x < n_s) return -1;
  return s->n_free + entry / n_x * s->n_actions + entry % n_x - n_s;
}

int kpirl_mpc_system_other_rows(const kpirl_mpc_system *s) {
  int i, count = 0;
  for (i = 0; i < kpirl_mpc_system_n_rows(s); ++i) count += s->active[i] != 0 && kpirl_mpc_decision_of(s, i) < 0;
  return count;
}

void kpirl_mpc_moved_by_decisions(const kpirl_mpc_system *s, int row, real *work, real *by) {
  const int n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  real *m = work, *forces = m + n_w;
  int t = s->horizon, i;
  memset(m, 0, (size_t)n_w * sizeof(real));
  if (row < s->n_bounds) {
    t = s->entries[row] / n_x;
    m[s->entries[row]] = s->signs[row];
  } else {
    memset(forces, 0, (size_t)kpirl_mpc_system_n_rows(s) * sizeof(real));
    forces[row] = 1;
    kpirl_mpc_rows_transposed_times(s, forces, m);
  }
  while (t-- > 0)
    kpirl_mpc_transposed_times_vector(s->F + (size_t)t * n_s * n_x, n_s, n_x, m + (t + 1) * n_x, m + t * n_x);
  for (i = 0; i < s->n_decisions; ++i) by[i] = m[s->decisions[i]] / s->roots[i];
}

/* Row . covariance . row, where decisions are white in their units, stage by stage. */
static void row_variances(kpirl_mpc_system *s, real *values) {
  const int T = s->horizon, n_s = s->n_states, n_u = s->n_actions, n_x = n_s + n_u;
  real *S = s->scratch, *SFt = S + n_x * n_x, *Ft = SFt + n_x * n_s, *product = Ft + n_x * n_s, *of_x = product + n_x;
  const int n_h = s->n_path, n_e = s->n_equality;
  real *path = values + s->n_bounds, *equality = path + T * n_h + s->n_terminal;
  int t, i, j;
  memset(S, 0, (size_t)n_x * n_x * sizeof(real));
  for (i = 0; i < s->n_free; ++i) S[s->free[i] * (n_x + 1)] = 1 / (s->roots[i] * s->roots[i]);
  for (t = 0; t < T; ++t) {
    const real *F = s->F + (size_t)t * n_s * n_x;
    for (i = 0; i < n_u; ++i) {
      const real root = s->roots[s->n_free + t * n_u + i];
      S[(n_s + i) * (n_x + 1)] = 1 / (root * root);
    }
    for (i = 0; i < n_x; ++i) of_x[t * n_x + i] = S[i * (n_x + 1)];
    variances(s->G + (size_t)t * n_x * n_h, n_x, n_h, S, product, path + t * n_h);
    variances(s->E + (size_t)t * n_x * n_e, n_x, n_e, S, product, equality + t * n_e);
    kpirl_mpc_transpose(F, n_s, n_x, Ft);
    memset(SFt, 0, (size_t)n_x * n_s * sizeof(real));
    kpirl_mpc_times(S, n_x, n_x, Ft, n_s, SFt);
    memset(Ft, 0, (size_t)n_s * n_s * sizeof(real));
    kpirl_mpc_times(F, n_s, n_x, SFt, n_s, Ft);
    memset(S, 0, (size_t)n_x * n_x * sizeof(real));
    for (j = 0; j < n_s; ++j) memcpy(S + j * n_x, Ft + j * n_s, (size_t)n_s * sizeof(real));
  }
  for (i = 0; i < n_s; ++i) of_x[T * n_x + i] = S[i * (n_x + 1)];
  if (T > 0)
    for (i = 0; i < n_s; ++i) memmove(S + i * n_s, S + i * n_x, (size_t)n_s * sizeof(real));
  variances(s->G + (size_t)T * n_x * n_h, n_s, s->n_terminal, S, product, path + T * n_h);
  variances(s->E + (size_t)T * n_x * n_e, n_s, s->n_terminal_equality, S, product, equality + T * n_e);
  for (i = 0; i < s->n_bounds; ++i) values[i] = of_x[s->entries[i]];
}

/* The length of one row, which is no bound of a decision, and how decisions move it. */
static real length_of(const kpirl_mpc_system *s, int row, real *moved) {
  kpirl_mpc_moved_by_decisions(s, row, s->scratch + kpirl_mpc_system_inner_scratch(s), moved);
  return kpirl_mpc_norm_2(moved, s->n_decisions);
}

/* Row by row, of which those that are no bounds of decisions take n_s n_x products a stage, or by one covariance, which takes
 * n_s n_x (n_s + n_x). */
int kpirl_mpc_find_lengths(kpirl_mpc_system *s) {
  const int m = kpirl_mpc_system_n_rows(s), many = kpirl_mpc_system_other_rows(s) > KPIRL_MPC_FEW;
  real *moved = s->moved;
  int i, immovable = 0;
  if (many) row_variances(s, s->lengths);
  for (i = 0; i < m; ++i) {
    const int decision = s->active[i] != 0 ? kpirl_mpc_decision_of(s, i) : -1;
    real length = 1;
    if (decision >= 0) {
      length = 1 / s->roots[decision];
    } else if (s->active[i] != 0 && many) {
      length = kpirl_mpc_sqrt(s->lengths[i]);
    } else if (s->active[i] != 0) {
      length = length_of(s, i, moved);
      moved += s->n_decisions;
    }
    immovable |= length == 0;
    s->lengths[i] = length == 0 ? 1 : length;
  }
  return immovable;
}
