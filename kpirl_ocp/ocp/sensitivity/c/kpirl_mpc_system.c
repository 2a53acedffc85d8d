/* SPDX-License-Identifier: MIT
 *
 * Products with the linearised KKT conditions, and their factors.
 */
#include "kpirl_mpc_system.h"

#include <string.h>

static int n_path(const kpirl_mpc_system *s) { return s->horizon * s->n_path + s->n_terminal; }

static int n_equality(const kpirl_mpc_system *s) { return s->horizon * s->n_equality + s->n_terminal_equality; }

int kpirl_mpc_system_inner_scratch(const kpirl_mpc_system *s) {
  const int n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  const int substitute = kpirl_mpc_substitute_scratch(s->horizon, n_s, s->n_actions);
  const int blocks = n_x * n_x + kpirl_mpc_stage_scratch(n_s, s->n_actions) + s->n_free * s->n_free + 2 * n_s * n_x + n_x;
  return substitute + blocks + 2 * n_w + kpirl_mpc_system_n_rows(s);
}

int kpirl_mpc_system_n_triple(const kpirl_mpc_system *s) {
  return kpirl_mpc_system_n_point(s) + s->horizon * s->n_states + kpirl_mpc_system_n_rows(s) + s->n_states;
}

real *kpirl_mpc_place_triple(const kpirl_mpc_system *s, real *memory, kpirl_mpc_triple *triple) {
  triple->x = memory;
  triple->costates = triple->x + kpirl_mpc_system_n_point(s);
  triple->forces = triple->costates + s->horizon * s->n_states;
  triple->start = triple->forces + kpirl_mpc_system_n_rows(s);
  return triple->start + s->n_states;
}

int kpirl_mpc_system_scratch(const kpirl_mpc_system *s) {
  const int n_w = kpirl_mpc_system_n_point(s), m = kpirl_mpc_system_n_rows(s), widest = n_w > m ? n_w : m;
  return kpirl_mpc_system_inner_scratch(s) + 3 * kpirl_mpc_system_n_triple(s) + (6 + KPIRL_MPC_FEW) * n_w +
         (KPIRL_MPC_PRODUCTS + 2) * widest;
}

/* ---- products ----------------------------------------------------------------------------------------------- */

void kpirl_mpc_rows_times(const kpirl_mpc_system *s, const real *x, real *values) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions;
  real *path = values + s->n_bounds, *equality = path + n_path(s);
  int i;
  for (i = 0; i < s->n_bounds; ++i) values[i] = s->signs[i] * x[s->entries[i]];
  memset(path, 0, (size_t)(n_path(s) + n_equality(s)) * sizeof(real));
  kpirl_mpc_stage_rows_times(T, n_s, n_x, s->G, s->n_path, s->n_terminal, x, path);
  kpirl_mpc_stage_rows_times(T, n_s, n_x, s->E, s->n_equality, s->n_terminal_equality, x, equality);
}

void kpirl_mpc_rows_transposed_times(const kpirl_mpc_system *s, const real *forces, real *product) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions;
  const real *path = forces + s->n_bounds, *equality = path + n_path(s);
  int i;
  for (i = 0; i < s->n_bounds; ++i) product[s->entries[i]] += s->signs[i] * forces[i];
  kpirl_mpc_stage_rows_transposed_times(T, n_s, n_x, s->G, s->n_path, s->n_terminal, path, product);
  kpirl_mpc_stage_rows_transposed_times(T, n_s, n_x, s->E, s->n_equality, s->n_terminal_equality, equality, product);
}

void kpirl_mpc_hessian_times(const kpirl_mpc_system *s, const real *x, real *product) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions;
  int t;
  memset(product, 0, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
  for (t = 0; t <= T; ++t) {
    const int n = t < T ? n_x : n_s;
    kpirl_mpc_times_vector(s->H + (size_t)t * n_x * n_x, n, n, x + t * n_x, product + t * n_x);
  }
}

void kpirl_mpc_defects_transposed_times(const kpirl_mpc_system *s, const real *costates, real *product) {
  const int n_s = s->n_states, n_x = n_s + s->n_actions;
  int t, i;
  for (t = 0; t < s->horizon; ++t) {
    kpirl_mpc_transposed_times_vector(s->F + (size_t)t * n_s * n_x, n_s, n_x, costates + t * n_s, product + t * n_x);
    for (i = 0; i < n_s; ++i) product[(t + 1) * n_x + i] -= costates[t * n_s + i];
  }
}

void kpirl_mpc_defects_times(const kpirl_mpc_system *s, const real *x, real *defects) {
  const int n_s = s->n_states, n_x = n_s + s->n_actions;
  int t, i;
  memset(defects, 0, (size_t)(s->horizon * n_s) * sizeof(real));
  for (t = 0; t < s->horizon; ++t) {
    kpirl_mpc_times_vector(s->F + (size_t)t * n_s * n_x, n_s, n_x, x + t * n_x, defects + t * n_s);
    for (i = 0; i < n_s; ++i) defects[t * n_s + i] -= x[(t + 1) * n_x + i];
  }
}

void kpirl_mpc_system_balance(const kpirl_mpc_system *s, const kpirl_mpc_triple *at, real *balance, real *values) {
  const int m = kpirl_mpc_system_n_rows(s);
  real *forces = s->scratch;
  int i;
  kpirl_mpc_hessian_times(s, at->x, balance);
  kpirl_mpc_defects_transposed_times(s, at->costates, balance);
  kpirl_mpc_rows_times(s, at->x, values);
  for (i = 0; i < m; ++i) forces[i] = at->forces[i] + s->sigma[i] * values[i];
  kpirl_mpc_rows_transposed_times(s, forces, balance);
}

/* ---- factors ------------------------------------------------------------------------------------------------------------ */

void kpirl_mpc_system_substitute(const kpirl_mpc_system *s, const real *q, const real *d, const real *start, real *x,
                                 real *costates) {
  kpirl_mpc_substitute(s->horizon, s->n_states, s->n_actions, s->n_free, s->free, s->F, &s->factors, q, d, start, s->scratch,
                       x, costates);
}

void kpirl_mpc_factor_weighted(kpirl_mpc_system *s, const real *H, const real *weights) {
  const int T = s->horizon, n_s = s->n_states, n_u = s->n_actions, n_x = n_s + n_u;
  kpirl_mpc_factors *factors = &s->factors;
  const real *path = weights + s->n_bounds, *equality = path + n_path(s);
  real *diagonal = s->scratch, *own = diagonal + kpirl_mpc_system_n_point(s), *scratch = own + n_x * n_x;
  int i, t;
  memset(diagonal, 0, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
  for (i = 0; i < s->n_bounds; ++i) diagonal[s->entries[i]] += weights[i];
  for (i = 0; H == NULL && i < s->n_decisions; ++i) diagonal[s->decisions[i]] += s->roots[i] * s->roots[i];
  for (t = T; t >= 0; --t) {
    const int last = t == T, n = last ? n_s : n_x;
    real *M = last ? factors->P + (size_t)T * n_s * n_s : own;
    if (H == NULL)
      memset(M, 0, (size_t)n * n * sizeof(real));
    else
      memcpy(M, H + (size_t)t * n_x * n_x, (size_t)n * n * sizeof(real));
    for (i = 0; i < n; ++i) M[i + i * n] += diagonal[t * n_x + i];
    kpirl_mpc_add_rows(s->G + (size_t)t * n_x * s->n_path, n, last ? s->n_terminal : s->n_path, path + t * s->n_path, M);
    kpirl_mpc_add_rows(s->E + (size_t)t * n_x * s->n_equality, n, last ? s->n_terminal_equality : s->n_equality,
             equality + t * s->n_equality, M);
    if (last)
      kpirl_mpc_mirror(M, n_s);
    else
      kpirl_mpc_factor_stage(n_s, n_u, factors->P + (size_t)(t + 1) * n_s * n_s, s->F + (size_t)t * n_s * n_x, M, scratch,
                             factors->P + (size_t)t * n_s * n_s, factors->W + (size_t)t * n_u * n_u,
                             factors->Y + (size_t)t * n_u * n_s, factors->pivots + t * n_u);
  }
  if (s->n_free > 0) kpirl_mpc_factor_start(n_s, s->n_free, s->free, factors->P, scratch, factors);
}

real kpirl_mpc_decision_norm(const kpirl_mpc_system *s, const real *x) {
  real *v = s->scratch;
  int i;
  for (i = 0; i < s->n_decisions; ++i) v[i] = s->roots[i] * x[s->decisions[i]];
  return kpirl_mpc_norm_2(v, s->n_decisions);
}
