/* SPDX-License-Identifier: MIT
 *
 * Newton steps of the primal-dual interior-point method. On the perturbed conditions
 *
 *     grad L = 0,   g + y = 0,   y z = tau,   c = 0,   dynamics,
 *
 * y, z and nu are eliminated, which leaves the linear-quadratic problem of kpirl_mpc_recursion.h with
 *
 *     H + G' (z/y) G + E' E / delta + rho I,    gradient + G' (tau/y + z/y (g + y)) + E' (nu + c / delta).
 *
 * Enough of rho makes the reduced Hessian positive. Equalities are those of the proximal method of multipliers (Rockafellar,
 * 1976): exact where the method converges, and never singular.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real ROUNDING = 1000 * KPIRL_MPC_EPSILON; /* the smallest share of a slack or multiplier that a step leaves */

/* ---- the linear-quadratic problem --------------------------------------------------------------------------- */

/* M: the condensed Hessian of stage t; diagonal: what bounds and regularisation add to all of x. */
static void condense(const kpirl_mpc_core *core, int t, const real *diagonal, real *M) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const int n_h = DIM(core, n_path), n_e = DIM(core, n_equality), last = t == T, n = last ? n_s : n_x;
  const kpirl_mpc_derivatives *d = &core->d;
  int i;
  memcpy(M, d->H + t * n_x * n_x, (size_t)n * n * sizeof(real));
  for (i = 0; i < n; ++i) M[i + i * n] += diagonal[t * n_x + i];
  kpirl_mpc_add_rows(d->G + t * n_x * n_h, n, last ? DIM(core, n_terminal) : n_h, core->weights + kpirl_mpc_n_bounds(core) + t * n_h, M);
  if (n_e + DIM(core, n_terminal_equality) > 0) {
    const int rows = last ? DIM(core, n_terminal_equality) : n_e;
    kpirl_mpc_add_rows(d->E + t * n_x * n_e, n, rows, core->stiffness + core->n_fixed + t * n_e, M);
  }
}

static int all_positive(const real *pivots, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (!(pivots[i] > 0) || !isfinite(pivots[i])) return 0;
  return 1;
}

/* The weights z / y and 1 / delta; and what those of bounds, and the regularisation, add to the diagonal (n_w). */
static void find_weights(kpirl_mpc_core *core, real regularisation, real *diagonal) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core), n_w = kpirl_mpc_n_point(core);
  int i;
  memset(diagonal, 0, (size_t)n_w * sizeof(real));
  for (i = 0; i < m; ++i) core->weights[i] = core->at.z[i] / core->at.y[i];
  for (i = 0; i < core->n_lower; ++i) diagonal[core->lower[i]] += core->weights[i];
  for (i = 0; i < core->n_upper; ++i) diagonal[core->upper[i]] += core->weights[core->n_lower + i];
  for (i = 0; core->penalty <= 0 && i < n_c; ++i) core->stiffness[i] = 1 / KPIRL_MPC_PROXIMAL;
  for (i = 0; i < core->n_fixed; ++i) diagonal[core->fixed[i]] += core->stiffness[i];
  for (i = 0; i < n_w; ++i) diagonal[i] += regularisation;
}

int kpirl_mpc_factorise(kpirl_mpc_core *core, real regularisation) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_u = DIM(core, n_actions), n_x = n_s + n_u;
  const int n_free = core->bounds.n_free;
  kpirl_mpc_factors *factors = &core->factors;
  real *diagonal = core->right;
  int t;
  core->factored = 0;
  find_weights(core, regularisation, diagonal);
  condense(core, T, diagonal, factors->P + T * n_s * n_s);
  kpirl_mpc_mirror(factors->P + T * n_s * n_s, n_s);
  for (t = T - 1; t >= 0; --t) {
    condense(core, t, diagonal, core->M);
    kpirl_mpc_factor_stage(n_s, n_u, factors->P + (t + 1) * n_s * n_s, core->d.F + t * n_s * n_x, core->M, core->scratch,
                           factors->P + t * n_s * n_s, factors->W + t * n_u * n_u, factors->Y + t * n_u * n_s,
                           factors->pivots + t * n_u);
    if (!all_positive(factors->pivots + t * n_u, n_u)) {
      memset(factors->pivots, 0, (size_t)(t * n_u) * sizeof(real)); /* nobody needs the rest */
      return 0;
    }
  }
  if (n_free > 0) kpirl_mpc_factor_start(n_s, n_free, core->bounds.free_entries, factors->P, core->scratch, factors);
  return all_positive(factors->free_pivots, n_free);
}

/* right = the gradient of the Lagrangian with these multipliers of inequalities and of equalities. */
static void set_gradient(kpirl_mpc_core *core, const real *z, const real *nu) {
  memcpy(core->right, core->d.unconstrained_gradient, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  kpirl_mpc_bounds_transposed_times(core, z, nu, core->right);
  kpirl_mpc_path_transposed_times(core, z + kpirl_mpc_n_bounds(core), core->right);
  kpirl_mpc_equality_transposed_times(core, nu + core->n_fixed, core->right);
}

/* The change of x and costates where forces of inequalities are core->force, and those of equalities change->nu. */
static void solve_stages(kpirl_mpc_core *core, kpirl_mpc_iterate *change) {
  const kpirl_mpc_derivatives *d = &core->d;
  set_gradient(core, core->force, change->nu);
  kpirl_mpc_substitute(DIM(core, horizon), DIM(core, n_states), DIM(core, n_actions), core->bounds.n_free,
                       core->bounds.free_entries, d->F, &core->factors, core->right, d->defects, d->gap, core->scratch,
                       change->x, change->costates);
}

/* values (n_c) = (values + E x) / delta */
static void find_equality_multipliers(const kpirl_mpc_core *core, const real *x, real *values) {
  const int n_c = kpirl_mpc_n_equalities(core), n_fixed = core->n_fixed;
  int i;
  for (i = 0; i < n_fixed; ++i) values[i] += x[core->fixed[i]];
  kpirl_mpc_equality_times(core, x, values + n_fixed);
  for (i = 0; i < n_c; ++i) values[i] *= core->stiffness[i];
}

/* The changes of y and z that belong to that of x. */
static void find_inequality_step(const kpirl_mpc_core *core, kpirl_mpc_iterate *change) {
  const int m = kpirl_mpc_n_inequalities(core);
  const kpirl_mpc_iterate *at = &core->at;
  int i;
  kpirl_mpc_inequalities_times(core, change->x, change->z); /* dg, so far */
  for (i = 0; i < m; ++i) {
    const real dg = change->z[i];
    change->y[i] = -kpirl_mpc_slack_residual(core, core->d.g[i], at->y[i]) - dg;
    change->z[i] = core->force[i] + core->weights[i] * dg - at->z[i];
  }
}

/* right += (H + rho) dx + the dynamics' part of the change of costates */
static void add_curvature(kpirl_mpc_core *core, const kpirl_mpc_iterate *change) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const kpirl_mpc_derivatives *d = &core->d;
  real *right = core->right;
  int t;
  kpirl_mpc_axpy(core->step.regularisation, change->x, kpirl_mpc_n_point(core), right);
  for (t = 0; t < T; ++t) {
    const real *costates = change->costates + t * n_s;
    kpirl_mpc_symmetric_times_vector(d->H + t * n_x * n_x, n_x, change->x + t * n_x, right + t * n_x);
    kpirl_mpc_transposed_times_vector(d->F + t * n_s * n_x, n_s, n_x, costates, right + t * n_x);
    kpirl_mpc_axpy(-1, costates, n_s, right + (t + 1) * n_x);
  }
  kpirl_mpc_symmetric_times_vector(d->H + T * n_x * n_x, n_s, change->x + T * n_x, right + T * n_x);
}

/* A change of nu leaves delta times it of equalities, and rounding of 1 / delta in the multipliers. One step of iterative refinement
 * takes both away: what is left of the gradient, and of equalities from the new nu, with the same factors. */
static void refine(kpirl_mpc_core *core, kpirl_mpc_iterate *change) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), m = kpirl_mpc_n_inequalities(core);
  const int n_c = kpirl_mpc_n_equalities(core);
  real *forces = core->trial.z, *fixing = core->trial.nu;
  int i;
  for (i = 0; i < m; ++i) forces[i] = core->at.z[i] + change->z[i];
  for (i = 0; i < n_c; ++i) fixing[i] = core->at.nu[i] + 2 * change->nu[i];
  set_gradient(core, forces, fixing);
  add_curvature(core, change);
  memset(core->start, 0, (size_t)n_s * sizeof(real));
  kpirl_mpc_substitute(T, n_s, DIM(core, n_actions), core->bounds.n_free, core->bounds.free_entries, core->d.F, &core->factors,
                       core->right, NULL, core->start, core->scratch, core->trial.x, core->trial.costates);
  kpirl_mpc_axpy(1, core->trial.x, kpirl_mpc_n_point(core), change->x);
  kpirl_mpc_axpy(1, core->trial.costates, T * n_s, change->costates);
  memset(fixing, 0, (size_t)n_c * sizeof(real));
  find_equality_multipliers(core, core->trial.x, fixing);
  for (i = 0; i < n_c; ++i) change->nu[i] = 2 * change->nu[i] + fixing[i];
}

/* The step for these factors and core->target, what y z is to become. */
void kpirl_mpc_step_to_target(kpirl_mpc_core *core, kpirl_mpc_iterate *change) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  const real enough = (real)core->options.tolerance / 10;
  const kpirl_mpc_iterate *at = &core->at;
  int i;
  for (i = 0; i < m; ++i)
    core->force[i] = core->target[i] / at->y[i] + core->weights[i] * kpirl_mpc_slack_residual(core, core->d.g[i], at->y[i]);
  for (i = 0; i < n_c; ++i) change->nu[i] = at->nu[i] + core->d.c[i] * core->stiffness[i];
  if (core->penalty > 0) kpirl_mpc_penalty_slopes(core, core->force, change->nu);
  solve_stages(core, change);
  memcpy(change->nu, core->d.c, (size_t)n_c * sizeof(real));
  find_equality_multipliers(core, change->x, change->nu);
  find_inequality_step(core, change);
  if (core->penalty > 0 || !(KPIRL_MPC_PROXIMAL * kpirl_mpc_norm_inf(change->nu, n_c) > enough)) return;
  refine(core, change);
  find_inequality_step(core, change);
}

/* The longest step in (0, 1] that keeps value + length * change at least (1 - share) value; value > 0. */
real kpirl_mpc_longest(const real *value, const real *change, int count, real share) {
  return kpirl_mpc_min(1, share / kpirl_mpc_largest_fall(value, change, count, share));
}

/* ---- steps -------------------------------------------------------------------------------------------------- */

/* The fraction to the boundary comes closer to one as tau falls, as far as rounding lets what is left stay positive; where tau
 * is fixed, as in real-time iterations, there is no reason to come close. */
static real fraction_to_boundary(const kpirl_mpc_core *core) {
  const real left = kpirl_mpc_max(core->step.tau / core->d.scale, ROUNDING);
  return core->options.steps > 0 ? KPIRL_MPC_BOUNDARY : kpirl_mpc_max(KPIRL_MPC_BOUNDARY, 1 - left);
}

void kpirl_mpc_limit_lengths(kpirl_mpc_core *core) {
  kpirl_mpc_step *step = &core->step;
  const int m = kpirl_mpc_n_inequalities(core);
  step->share = fraction_to_boundary(core);
  step->primal_length = kpirl_mpc_longest(core->at.y, step->change.y, m, step->share);
  step->dual_length = kpirl_mpc_longest(core->at.z, step->change.z, m, step->share);
  step->positive = step->positive && kpirl_mpc_all_finite(step->change.x, kpirl_mpc_n_point(core));
}

void kpirl_mpc_newton_step(kpirl_mpc_core *core, real regularisation) {
  const int m = kpirl_mpc_n_inequalities(core);
  int i;
  core->step.tau = core->tau;
  core->step.positive = kpirl_mpc_factorise(core, regularisation);
  if (!core->step.positive) return;
  core->step.regularisation = regularisation;
  for (i = 0; i < m; ++i) core->target[i] = core->tau;
  kpirl_mpc_step_to_target(core, &core->step.change);
  if (core->penalty > 0) kpirl_mpc_elastic_step(core);
  kpirl_mpc_limit_lengths(core);
}
