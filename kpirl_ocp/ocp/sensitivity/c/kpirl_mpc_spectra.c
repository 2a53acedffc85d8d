/* SPDX-License-Identifier: MIT
 *
 * What a linearised KKT system is conditioned by: outer eigenvalues.
 */
#include "kpirl_mpc_system.h"

#include <string.h>

static const real DELTA = (real)1e-8; /* balances the recursion's rounding, epsilon / DELTA, against the refinement's rate */
static const real HELD = (real)1e-16; /* of bounds of decisions: on the diagonal at a pivot, where a large number rounds no other */
static const real DEPENDENCE = (real)1e-11; /* singular values are known to its square root */

/* Where the vectors of an eigenvalue begin: behind the scratch of products. */
static real *vectors_of(const kpirl_mpc_system *s) { return s->scratch + kpirl_mpc_system_inner_scratch(s); }

/* ---- operators ---------------------------------------------------------------------------------------------- */

/* x = Z R^{-1} v, where Z v follows the dynamics; R are the roots of the decisions. */
static void follow_dynamics(const kpirl_mpc_system *s, const real *v, real *x) {
  const int n_s = s->n_states, n_x = n_s + s->n_actions;
  int t, i;
  memset(x, 0, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
  for (i = 0; i < s->n_decisions; ++i) x[s->decisions[i]] = v[i] / s->roots[i];
  for (t = 0; t < s->horizon; ++t)
    kpirl_mpc_times_vector(s->F + (size_t)t * n_s * n_x, n_s, n_x, x + t * n_x, x + (t + 1) * n_x);
}

/* R^{-1} Z' H Z R^{-1} v */
static void reduced_hessian(const void *self, const real *v, real *product) {
  const kpirl_mpc_system *s = (const kpirl_mpc_system *)self;
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  real *x = s->scratch, *y = x + n_w;
  int t, i;
  memset(y, 0, (size_t)n_w * sizeof(real));
  follow_dynamics(s, v, x);
  kpirl_mpc_times_vector(s->H + (size_t)T * n_x * n_x, n_s, n_s, x + T * n_x, y + T * n_x);
  for (t = T - 1; t >= 0; --t) {
    kpirl_mpc_times_vector(s->H + (size_t)t * n_x * n_x, n_x, n_x, x + t * n_x, y + t * n_x);
    kpirl_mpc_transposed_times_vector(s->F + (size_t)t * n_s * n_x, n_s, n_x, y + (t + 1) * n_x, y + t * n_x);
  }
  for (i = 0; i < s->n_decisions; ++i) product[i] = y[s->decisions[i]] / s->roots[i];
}

/* x of the factorised system for (r, 0, 0); r is overwritten. */
static const real *inverse_times(const kpirl_mpc_system *s, real *r, real *x) {
  const int n_w = kpirl_mpc_system_n_point(s);
  real *start = x + n_w;
  int i;
  for (i = 0; i < n_w; ++i) r[i] = -r[i];
  memset(start, 0, (size_t)s->n_states * sizeof(real));
  kpirl_mpc_system_substitute(s, r, NULL, start, x, NULL);
  return x;
}

/* What an operator works in: the system, and memory behind the basis of its eigenvalue. */
typedef struct working {
  const kpirl_mpc_system *system;
  real *work;
} working;

/* R (inverse of the reduced Hessian) R v */
static void reduced_inverse(const void *self, const real *v, real *product) {
  const working *with = (const working *)self;
  const kpirl_mpc_system *s = with->system;
  const int n_w = kpirl_mpc_system_n_point(s);
  real *r = with->work;
  const real *x;
  int i;
  memset(r, 0, (size_t)n_w * sizeof(real));
  for (i = 0; i < s->n_decisions; ++i) r[s->decisions[i]] = s->roots[i] * v[i];
  x = inverse_times(s, r, r + n_w);
  for (i = 0; i < s->n_decisions; ++i) product[i] = s->roots[i] * x[s->decisions[i]];
}

/* (D C Z Z' C' D + delta)^{-1} b, D = active / length, for factors of effort with rows weighted by D^2 / delta: multipliers of
 * the rows D C x = b with delta relaxation. */
static void multipliers(const void *self, const real *b, real *product) {
  const working *with = (const working *)self;
  const kpirl_mpc_system *s = with->system;
  const int n_w = kpirl_mpc_system_n_point(s), m = kpirl_mpc_system_n_rows(s);
  real *r = with->work;
  const real *x;
  int i;
  memset(r, 0, (size_t)n_w * sizeof(real));
  for (i = 0; i < m; ++i) product[i] = b[i] * s->active[i] / s->lengths[i] / DEPENDENCE;
  kpirl_mpc_rows_transposed_times(s, product, r);
  x = inverse_times(s, r, r + n_w);
  kpirl_mpc_rows_times(s, x, product);
  for (i = 0; i < m; ++i) product[i] = (b[i] - product[i] * s->active[i] / s->lengths[i]) / DEPENDENCE;
}

/* ---- what they show ----------------------------------------------------------------------------------------- */

static real stiffness_of(const kpirl_mpc_system *s, int row) {
  const real delta = kpirl_mpc_decision_of(s, row) >= 0 ? HELD : DELTA, length = s->lengths[row];
  return (s->scale > 0 ? s->scale : 1) / (delta * length * length);
}

/* Is there an active or a smoothed one? */
static int has_rows(const kpirl_mpc_system *s) {
  int i;
  for (i = 0; i < kpirl_mpc_system_n_rows(s); ++i)
    if (s->active[i] != 0 || s->sigma[i] != 0) return 1;
  return 0;
}

int kpirl_mpc_system_factor(kpirl_mpc_system *s, const real *start) {
  const int m = kpirl_mpc_system_n_rows(s), n = s->n_decisions;
  real *vector = vectors_of(s), *weights = vector, error;
  const int immovable = kpirl_mpc_find_lengths(s);
  int i;
  memcpy(vector, start, (size_t)n * sizeof(real));
  s->scale = 0;
  if (n > 0 && has_rows(s))
    s->scale = kpirl_mpc_abs(kpirl_mpc_lanczos(reduced_hessian, s, n, 2, KPIRL_MPC_LARGEST, vector, vector + n, &error));
  for (i = 0; i < m; ++i) {
    s->stiffness[i] = s->active[i] != 0 ? stiffness_of(s, i) : 0;
    weights[i] = s->sigma[i] + s->stiffness[i];
  }
  kpirl_mpc_factor_weighted(s, s->H, weights);
  return immovable;
}

real kpirl_mpc_system_lowest_mode(const kpirl_mpc_system *s, int negative, const real *start, real *direction) {
  const int n_w = kpirl_mpc_system_n_point(s), n = s->n_decisions;
  real *vector = vectors_of(s), *basis = vector + n, value, size;
  working with;
  int i;
  with.system = s;
  with.work = basis + (KPIRL_MPC_PRODUCTS + 1) * n;
  memcpy(vector, start, (size_t)n * sizeof(real));
  value = kpirl_mpc_eigenvalue(reduced_inverse, &with, n, negative ? KPIRL_MPC_LOWEST : KPIRL_MPC_HIGHEST, vector, basis);
  follow_dynamics(s, basis + KPIRL_MPC_PRODUCTS * n, direction); /* one product more than the vector has seen */
  size = kpirl_mpc_decision_norm(s, direction);
  for (i = 0; i < n_w; ++i) direction[i] /= size;
  return value;
}

real kpirl_mpc_system_qualification(kpirl_mpc_system *s, const real *start) {
  const int m = kpirl_mpc_system_n_rows(s);
  real *vector = vectors_of(s), *basis = vector + m, value;
  working with;
  int i;
  with.system = s;
  with.work = basis + (KPIRL_MPC_PRODUCTS + 1) * m;
  for (i = 0; i < m; ++i) vector[i] = s->active[i] / (s->lengths[i] * s->lengths[i] * DEPENDENCE);
  kpirl_mpc_factor_weighted(s, NULL, vector);
  for (i = 0; i < m; ++i) vector[i] = s->active[i] * start[i];
  value = 1 / kpirl_mpc_eigenvalue(multipliers, &with, m, KPIRL_MPC_HIGHEST, vector, basis) - DEPENDENCE;
  return value > 0 ? kpirl_mpc_sqrt(value) : value == value ? 0 : value;
}

/* ---- few rows ------------------------------------------------------------------------------------------------- */

/* Where few active rows are no bounds of decisions: in units, of length one, active rows are
 *
 *     (E; V),  V = (V_b, V_o),    where E picks the decisions b that are at a bound, and o are the others,
 *
 * and their products with each other, and delta = DEPENDENCE, a small Schur complement away from the identity:
 *
 *     (I + delta,  V_b';  V_b,  V V' + delta),    S = V_o V_o' + delta / (1 + delta) V_b V_b' + delta. */
enum { FEW = KPIRL_MPC_FEW };

/* V' by columns (n, count); held: 1 for decisions at a bound; S^{-1} = W' W. */
typedef struct few_rows {
  int n, count;
  real *V, *held, *weighted;
  real W[FEW * FEW], pivots[FEW];
} few_rows;

static void factor(few_rows *with) {
  const int n = with->n, count = with->count;
  real S[FEW * FEW];
  int i, j, k;
  for (i = 0; i < count; ++i) {
    const real *row = with->V + (size_t)i * n;
    for (k = 0; k < n; ++k) with->weighted[k] = with->held[k] > 0 ? DEPENDENCE / (1 + DEPENDENCE) * row[k] : row[k];
    for (j = 0; j <= i; ++j)
      S[i + j * count] = kpirl_mpc_dot(with->weighted, with->V + (size_t)j * n, n) + (i == j ? DEPENDENCE : 0);
  }
  kpirl_mpc_inverse_root(S, count, with->W, with->pivots);
}

/* The inverse of the products with delta: of a for decisions at a bound, zero for others, and b for the other rows. */
static void inverse(const void *self, const real *v, real *product) {
  const few_rows *with = (const few_rows *)self;
  const int n = with->n, count = with->count;
  const real *b = v + n;
  real *z = product, *y = product + n, half[FEW] = {0};
  int i, k;
  for (i = 0; i < count; ++i) y[i] = b[i] - kpirl_mpc_dot(with->V + (size_t)i * n, v, n) / (1 + DEPENDENCE);
  kpirl_mpc_times_vector(with->W, count, count, y, half);
  memset(y, 0, (size_t)count * sizeof(real));
  kpirl_mpc_transposed_times_vector(with->W, count, count, half, y);
  memset(z, 0, (size_t)n * sizeof(real));
  kpirl_mpc_times_vector(with->V, n, count, y, z);
  for (k = 0; k < n; ++k) z[k] = with->held[k] * (v[k] - z[k]) / (1 + DEPENDENCE);
}

/* The next row of V. */
static void add_row(const kpirl_mpc_system *s, int row, few_rows *with) {
  const size_t first = (size_t)with->n * with->count++;
  int i;
  for (i = 0; i < with->n; ++i) with->V[first + i] = s->moved[first + i] / s->lengths[row];
}

real kpirl_mpc_system_few_rows(const kpirl_mpc_system *s, const real *start) {
  const int m = kpirl_mpc_system_n_rows(s), n = s->n_decisions;
  real *vector = vectors_of(s), *basis, value;
  few_rows with;
  int i;
  with.n = n;
  with.count = 0;
  with.held = vector + n + FEW;
  with.weighted = with.held + n;
  with.V = with.weighted + n;
  memset(with.held, 0, (size_t)n * sizeof(real));
  memset(vector, 0, (size_t)n * sizeof(real));
  for (i = 0; i < m; ++i) {
    const int decision = kpirl_mpc_decision_of(s, i);
    if (s->active[i] == 0) continue;
    vector[decision < 0 ? n + with.count : decision] = start[i];
    if (decision < 0)
      add_row(s, i, &with);
    else if (with.held[decision]++ > 0)
      return 0; /* the same row twice */
  }
  if (with.count == 0) return 1;
  factor(&with);
  basis = with.V + (size_t)n * with.count;
  value = 1 / kpirl_mpc_eigenvalue(inverse, &with, n + with.count, KPIRL_MPC_HIGHEST, vector, basis) - DEPENDENCE;
  return value > 0 ? kpirl_mpc_sqrt(value) : value == value ? 0 : value;
}
