/* SPDX-License-Identifier: MIT
 *
 * Solutions of the linearised KKT conditions by refinement with their factors.
 */
#include "kpirl_mpc_system.h"

#include <string.h>

static const real CLOSE = (real)1e-10;   /* below it, a step that gains less than three digits has met the rounding */
static const real SETTLED = (real)0.1;   /* the last correction is at most this share of the total change ... */
static const real FOLLOWED = (real)1e-6; /* ... or this share of x, and the relative residual is below this */
static const real NOTHING = (real)1e-8;  /* an x this much shorter than a free one is zero up to rounding */
enum { CHANGES = 6 };

void kpirl_mpc_copy_triple(const kpirl_mpc_system *s, const kpirl_mpc_triple *from, kpirl_mpc_triple *to) {
  memcpy(to->x, from->x, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
  memcpy(to->costates, from->costates, (size_t)(s->horizon * s->n_states) * sizeof(real));
  memcpy(to->forces, from->forces, (size_t)kpirl_mpc_system_n_rows(s) * sizeof(real));
}

/* Entries of s_0 that are given have no equation but their value, which is `missing` here; rows that are not active have none. */
static void only_equations(const kpirl_mpc_system *s, const real *missing, const real *x, kpirl_mpc_triple *residual) {
  int i, next = 0;
  for (i = 0; i < kpirl_mpc_system_n_rows(s); ++i)
    if (s->active[i] == 0) residual->forces[i] = 0;
  for (i = 0; i < s->n_states; ++i) {
    const int is_free = next < s->n_free && s->free[next] == i;
    next += is_free;
    residual->start[i] = is_free ? 0 : missing[i] - x[i];
    if (!is_free) residual->x[i] = 0;
  }
}

/* residual = right - system point. */
static void residual_of(const kpirl_mpc_system *s, const kpirl_mpc_triple *right, const kpirl_mpc_triple *point,
                        kpirl_mpc_triple *residual) {
  int i;
  kpirl_mpc_system_balance(s, point, residual->x, residual->forces);
  for (i = 0; i < kpirl_mpc_system_n_point(s); ++i) residual->x[i] = right->x[i] - residual->x[i];
  for (i = 0; i < kpirl_mpc_system_n_rows(s); ++i) residual->forces[i] = right->forces[i] - residual->forces[i];
  kpirl_mpc_defects_times(s, point->x, residual->costates);
  for (i = 0; i < s->horizon * s->n_states; ++i) residual->costates[i] = right->costates[i] - residual->costates[i];
  only_equations(s, right->start, point->x, residual);
}

/* K (dx, dlambda) = (r + C' S c, d) with K the factorised matrix; dcostates NULL: not wanted. work: n_w + m numbers. */
static void substitute(const kpirl_mpc_system *s, const kpirl_mpc_triple *residual, real *dx, real *dcostates, real *work) {
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, m = kpirl_mpc_system_n_rows(s);
  real *q = work, *pushes = q + n_w, *d = residual->costates;
  int i;
  for (i = 0; i < m; ++i) pushes[i] = s->stiffness[i] * residual->forces[i];
  memcpy(q, residual->x, (size_t)n_w * sizeof(real));
  if (kpirl_mpc_norm_inf(pushes, m) != 0) kpirl_mpc_rows_transposed_times(s, pushes, q);
  for (i = 0; i < n_w; ++i) q[i] = -q[i];
  for (i = 0; i < n_c; ++i) d[i] = -d[i];
  kpirl_mpc_system_substitute(s, q, kpirl_mpc_norm_inf(d, n_c) != 0 ? d : NULL, residual->start, dx, dcostates);
}

/* Its solution, and dmu = S (C dx - c): point += step. Returns |dx|. */
static real correct(const kpirl_mpc_system *s, const kpirl_mpc_triple *residual, kpirl_mpc_triple *point, real *work) {
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, m = kpirl_mpc_system_n_rows(s);
  real *dx = work, *dcostates = dx + n_w, *change = dcostates + n_c, *forces = residual->forces, size;
  int i;
  substitute(s, residual, dx, dcostates, change);
  size = kpirl_mpc_decision_norm(s, dx);
  for (i = 0; i < n_w; ++i) point->x[i] += dx[i];
  for (i = 0; i < n_c; ++i) point->costates[i] += dcostates[i];
  if (kpirl_mpc_norm_inf(s->stiffness, m) == 0) return size;
  kpirl_mpc_rows_times(s, dx, change);
  for (i = 0; i < m; ++i) point->forces[i] += s->stiffness[i] * (change[i] - forces[i]);
  return size;
}

/* ---- norms -------------------------------------------------------------------------------------------------- */

/* |values * sizes| over x */
static real gradient_norm(const kpirl_mpc_system *s, const real *values) {
  real *v = s->scratch;
  int i;
  for (i = 0; i < kpirl_mpc_system_n_point(s); ++i) v[i] = values[i] * s->sizes[i];
  return kpirl_mpc_norm_2(v, kpirl_mpc_system_n_point(s));
}

real kpirl_mpc_point_norm(const kpirl_mpc_system *s, const real *x) {
  real *v = s->scratch;
  int i;
  for (i = 0; i < kpirl_mpc_system_n_point(s); ++i) v[i] = x[i] / s->sizes[i];
  return kpirl_mpc_norm_2(v, kpirl_mpc_system_n_point(s));
}

/* |values / sizes|, or |values * sizes|, of numbers that belong to s_1 .. s_T */
static real successor_norm(const kpirl_mpc_system *s, const real *values, int divided) {
  const int n_s = s->n_states, n_x = n_s + s->n_actions;
  real *v = s->scratch;
  int t, i;
  for (t = 0; t < s->horizon; ++t) {
    const real *sizes = s->sizes + (t + 1) * n_x, *own = values + t * n_s;
    for (i = 0; i < n_s; ++i) v[t * n_s + i] = divided ? own[i] / sizes[i] : own[i] * sizes[i];
  }
  return kpirl_mpc_norm_2(v, s->horizon * n_s);
}

static real row_norm(const kpirl_mpc_system *s, const real *values) {
  real *v = s->scratch;
  int i;
  for (i = 0; i < kpirl_mpc_system_n_rows(s); ++i) v[i] = s->active[i] * values[i] / s->lengths[i];
  return kpirl_mpc_norm_2(v, kpirl_mpc_system_n_rows(s));
}

/* The least that an x without rows can be: |reduced r| over the largest |eigenvalue| of the reduced Hessian. Zero where there are
 * no rows, and no x is shorter. */
static real least_norm(const kpirl_mpc_system *s, const real *r) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions;
  real *m = s->scratch, sum = 0;
  int t, i;
  if (!(s->scale > 0)) return 0;
  memcpy(m, r, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
  for (t = T - 1; t >= 0; --t)
    kpirl_mpc_transposed_times_vector(s->F + (size_t)t * n_s * n_x, n_s, n_x, m + (t + 1) * n_x, m + t * n_x);
  for (i = 0; i < s->n_decisions; ++i) {
    const real v = m[s->decisions[i]] / s->roots[i];
    sum += v * v;
  }
  return kpirl_mpc_sqrt(sum) / s->scale;
}

/* The largest of the three residuals, relative; NaN if one is. */
static real error_of(const kpirl_mpc_system *s, const kpirl_mpc_triple *right, const kpirl_mpc_triple *point,
                     const kpirl_mpc_triple *residual, real least) {
  const real gaps = successor_norm(s, right->costates, 1), values = row_norm(s, right->forces);
  real gradient = gradient_norm(s, right->x), decisions = kpirl_mpc_decision_norm(s, point->x), x, parts[3];
  if (gaps > 0 || values > 0) gradient = kpirl_mpc_max(gradient, successor_norm(s, point->costates, 0));
  decisions = kpirl_mpc_max(kpirl_mpc_max(decisions, least), values);
  x = kpirl_mpc_max(kpirl_mpc_max(kpirl_mpc_point_norm(s, point->x), gaps),
                       kpirl_mpc_over(least, kpirl_mpc_decision_norm(s, s->sizes)));
  parts[0] = kpirl_mpc_over(gradient_norm(s, residual->x), gradient);
  parts[1] = kpirl_mpc_over(successor_norm(s, residual->costates, 1), x);
  parts[2] = kpirl_mpc_over(row_norm(s, residual->forces), decisions);
  return kpirl_mpc_norm_inf(parts, 3);
}

/* The point that is zero but for decisions at a bound, whose stiffness times their value would round all other terms; returns whether
 * there is one that is not zero. */
static int stand_at_bounds(const kpirl_mpc_system *s, const kpirl_mpc_triple *right, kpirl_mpc_triple *at) {
  int i, any = 0;
  memset(at->x, 0, (size_t)kpirl_mpc_system_n_triple(s) * sizeof(real));
  for (i = 0; i < s->n_bounds; ++i)
    if (s->active[i] != 0 && right->forces[i] != 0 && kpirl_mpc_decision_of(s, i) >= 0) {
      at->x[s->entries[i]] = s->signs[i] * right->forces[i];
      any = 1;
    }
  return any;
}

/* ---- solutions ---------------------------------------------------------------------------------------------- */

/* The solution by one substitution. residual: a triple. */
static void solve_once(const kpirl_mpc_system *s, const kpirl_mpc_triple *right, kpirl_mpc_triple *at, kpirl_mpc_triple *residual,
                       real *work) {
  if (stand_at_bounds(s, right, at)) {
    residual_of(s, right, at, residual);
  } else {
    kpirl_mpc_copy_triple(s, right, residual); /* of a point that is zero */
    only_equations(s, right->start, at->x, residual);
  }
  correct(s, residual, at, work);
}

void kpirl_mpc_system_solve_once(const kpirl_mpc_system *s, const kpirl_mpc_triple *right, kpirl_mpc_triple *point) {
  kpirl_mpc_triple at, residual;
  real *work = kpirl_mpc_place_triple(s, s->scratch + kpirl_mpc_system_inner_scratch(s), &at);
  work = kpirl_mpc_place_triple(s, work, &residual);
  solve_once(s, right, &at, &residual, work);
  kpirl_mpc_copy_triple(s, &at, point);
}

real kpirl_mpc_system_solve(const kpirl_mpc_system *s, const kpirl_mpc_triple *right, real enough, int most,
                            kpirl_mpc_triple *point) {
  const real least = least_norm(s, right->x);
  kpirl_mpc_triple at, residual;
  real *work = s->scratch + kpirl_mpc_system_inner_scratch(s), best = (real)INFINITY;
  int k;
  work = kpirl_mpc_place_triple(s, work, &at);
  work = kpirl_mpc_place_triple(s, work, &residual);
  solve_once(s, right, &at, &residual, work);
  for (k = 1; k <= most; ++k) {
    real error;
    int stalled;
    residual_of(s, right, &at, &residual);
    error = error_of(s, right, &at, &residual, least);
    stalled = !(error < best / (error > CLOSE ? 10 : 1000));
    if (error < best || k == 1) {
      best = error;
      kpirl_mpc_copy_triple(s, &at, point);
    }
    if (stalled || error <= enough) break;
    if (k < most) correct(s, &residual, &at, work);
  }
  return best;
}

real kpirl_mpc_system_change(const kpirl_mpc_system *s, const kpirl_mpc_system *nearby, const kpirl_mpc_triple *right,
                             kpirl_mpc_triple *point) {
  const int n_w = kpirl_mpc_system_n_point(s);
  const real least = least_norm(s, right->x);
  const real whole = kpirl_mpc_max(kpirl_mpc_decision_norm(s, point->x), NOTHING * least);
  kpirl_mpc_triple residual;
  real *work = s->scratch + kpirl_mpc_system_inner_scratch(s), *before, last = 0, change = 0;
  int i, k;
  before = kpirl_mpc_place_triple(s, work, &residual);
  work = before + n_w;
  memcpy(before, point->x, (size_t)n_w * sizeof(real));
  for (k = 0; k <= CHANGES; ++k) {
    real error;
    residual_of(nearby, right, point, &residual);
    error = error_of(nearby, right, point, &residual, least);
    if (k > 0 && error <= FOLLOWED && last <= kpirl_mpc_max(SETTLED * change, FOLLOWED * whole))
      return change > 0 ? change / whole : 0;
    last = correct(s, &residual, point, work);
    for (i = 0; i < n_w; ++i) residual.x[i] = point->x[i] - before[i];
    change = kpirl_mpc_decision_norm(s, residual.x);
  }
  return (real)INFINITY;
}

/* x (n_w) of the solution for a right-hand side, which is overwritten, by one substitution. */
static const real *decisions_once(const kpirl_mpc_system *s, kpirl_mpc_triple *right) {
  const int n_w = kpirl_mpc_system_n_point(s);
  real *x = s->scratch + kpirl_mpc_system_inner_scratch(s), *zero = x + n_w;
  memset(zero, 0, (size_t)n_w * sizeof(real));
  only_equations(s, zero, zero, right);
  substitute(s, right, x, NULL, zero);
  return x;
}

real kpirl_mpc_system_first_change(const kpirl_mpc_system *s, kpirl_mpc_triple *residual, const kpirl_mpc_triple *point) {
  return kpirl_mpc_decision_norm(s, decisions_once(s, residual)) / kpirl_mpc_decision_norm(s, point->x);
}

real kpirl_mpc_system_follow(const kpirl_mpc_system *s, kpirl_mpc_triple *residual, kpirl_mpc_triple *point) {
  const real whole = kpirl_mpc_decision_norm(s, point->x);
  real *work = s->scratch + kpirl_mpc_system_inner_scratch(s);
  memset(work, 0, (size_t)s->n_states * sizeof(real));
  only_equations(s, work, work, residual);
  return correct(s, residual, point, work) / whole;
}

real kpirl_mpc_system_reach(const kpirl_mpc_system *s, kpirl_mpc_triple *right) {
  return kpirl_mpc_point_norm(s, decisions_once(s, right));
}
