/* SPDX-License-Identifier: MIT
 *
 * What a linearised KKT system is conditioned by: lengths of rows, outer eigenvalues.
 */
#include "kpirl_mpc_system.h"

#include <string.h>

static const real DELTA = (real)1e-8; /* balances the recursion's rounding, epsilon / DELTA, against the refinement's rate */
static const real DEPENDENCE = (real)1e-11; /* singular values are known to its square root */

/* Where the vectors of an eigenvalue begin: behind the scratch of products. */
static real *vectors_of(const kpirl_mpc_system *s) { return s->scratch + kpirl_mpc_system_inner_scratch(s); }

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

/* Does a row that counts see more than one action? */
static int only_actions(const kpirl_mpc_system *s) {
  const int n_x = s->n_states + s->n_actions, m = kpirl_mpc_system_n_rows(s);
  int i;
  for (i = 0; i < m; ++i)
    if (s->active[i] != 0 && (i >= s->n_bounds || s->entries[i] % n_x < s->n_states)) return 0;
  return 1;
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

/* Returns whether no decision moves some active row; such a row has length 1. */
static int find_lengths(kpirl_mpc_system *s) {
  const int n_x = s->n_states + s->n_actions, m = kpirl_mpc_system_n_rows(s);
  int i, immovable = 0;
  memset(s->lengths, 0, (size_t)m * sizeof(real));
  if (!only_actions(s))
    row_variances(s, s->lengths);
  else
    for (i = 0; i < s->n_bounds; ++i) {
      const int t = s->entries[i] / n_x, k = s->entries[i] % n_x - s->n_states;
      const real root = k >= 0 ? s->roots[s->n_free + t * s->n_actions + k] : 1;
      s->lengths[i] = k >= 0 ? 1 / (root * root) : 0;
    }
  for (i = 0; i < m; ++i) {
    immovable |= s->active[i] != 0 && s->lengths[i] == 0;
    s->lengths[i] = s->lengths[i] == 0 ? 1 : kpirl_mpc_root(s->lengths[i]);
  }
  return immovable;
}

/* ---- operators ---------------------------------------------------------------------------------------------- */

/* R^{-1} Z' H Z R^{-1} v, where Z v follows the dynamics; R are the roots of the decisions. */
static void reduced_hessian(const void *self, const real *v, real *product) {
  const kpirl_mpc_system *s = (const kpirl_mpc_system *)self;
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  real *x = s->scratch, *y = x + n_w;
  int t, i;
  memset(x, 0, (size_t)(2 * n_w) * sizeof(real));
  for (i = 0; i < s->n_decisions; ++i) x[s->decisions[i]] = v[i] / s->roots[i];
  for (t = 0; t < T; ++t)
    kpirl_mpc_times_vector(s->F + (size_t)t * n_s * n_x, n_s, n_x, x + t * n_x, x + (t + 1) * n_x);
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
  kpirl_mpc_rows_push(s, product, r);
  x = inverse_times(s, r, r + n_w);
  kpirl_mpc_rows_times(s, x, product);
  for (i = 0; i < m; ++i) product[i] = (b[i] - product[i] * s->active[i] / s->lengths[i]) / DEPENDENCE;
}

/* ---- what they show ----------------------------------------------------------------------------------------- */

int kpirl_mpc_system_factor(kpirl_mpc_system *s, const real *start) {
  const int m = kpirl_mpc_system_n_rows(s), n = s->n_decisions;
  real *vector = vectors_of(s), *weights = vector, error;
  const int immovable = find_lengths(s);
  int i;
  memcpy(vector, start, (size_t)n * sizeof(real));
  s->scale = 0;
  if (n > 0)
    s->scale = kpirl_mpc_abs(kpirl_mpc_lanczos(reduced_hessian, s, n, 2, KPIRL_MPC_LARGEST, vector, vector + n, &error));
  for (i = 0; i < m; ++i) {
    s->stiffness[i] = s->active[i] * (s->scale > 0 ? s->scale : 1) / (DELTA * s->lengths[i] * s->lengths[i]);
    weights[i] = s->sigma[i] + s->stiffness[i];
  }
  kpirl_mpc_factor_weighted(s, s->H, weights);
  return immovable;
}

real kpirl_mpc_system_softest(const kpirl_mpc_system *s, int negative, const real *start, real *direction) {
  const int n_w = kpirl_mpc_system_n_point(s), n = s->n_decisions;
  real *vector = vectors_of(s), *basis = vector + n, value, size;
  working with;
  int i;
  with.system = s;
  with.work = basis + (KPIRL_MPC_PRODUCTS + 1) * n;
  memcpy(vector, start, (size_t)n * sizeof(real));
  value = kpirl_mpc_eigenvalue(reduced_inverse, &with, n, negative ? KPIRL_MPC_LOWEST : KPIRL_MPC_HIGHEST, vector, basis);
  memset(with.work, 0, (size_t)n_w * sizeof(real));
  for (i = 0; i < n; ++i) with.work[s->decisions[i]] = s->roots[i] * vector[i];
  memcpy(direction, inverse_times(s, with.work, with.work + n_w), (size_t)n_w * sizeof(real));
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
  return value > 0 ? kpirl_mpc_root(value) : value == value ? 0 : value;
}
