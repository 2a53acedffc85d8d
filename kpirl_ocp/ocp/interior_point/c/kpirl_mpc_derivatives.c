/* SPDX-License-Identifier: MIT
 *
 * What is known at an iterate: derivatives, constraints, residuals.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real SUBPROBLEM = 10; /* a barrier problem is solved when residuals are below so many tau */

/* The largest of the gradient of the objective, the costates, the multipliers of h and e, and 1. */
static real scale_of(const kpirl_mpc_core *core) {
  const int n_w = kpirl_mpc_n_point(core), n_s = DIM(core, n_states), m = kpirl_mpc_n_inequalities(core);
  real sizes[5];
  sizes[4] = 1;
  sizes[0] = kpirl_mpc_norm_inf(core->d.cost_gradient + n_s, n_w - n_s);
  sizes[1] = kpirl_mpc_norm_inf(core->at.costates, DIM(core, horizon) * n_s);
  sizes[2] = kpirl_mpc_norm_inf(core->at.z + kpirl_mpc_n_bounds(core), m - kpirl_mpc_n_bounds(core));
  sizes[3] = kpirl_mpc_norm_inf(core->at.nu + core->n_fixed, kpirl_mpc_n_equalities(core) - core->n_fixed);
  return kpirl_mpc_norm_inf(sizes, 5);
}

/* The gradient by s_0 is no condition where s_0 is given. */
static void forget_start(kpirl_mpc_core *core) {
  const int n_s = DIM(core, n_states);
  real *gradient = core->d.gradient;
  int i;
  memcpy(core->d.start_gradient, gradient, (size_t)n_s * sizeof(real));
  memset(gradient, 0, (size_t)n_s * sizeof(real));
  for (i = 0; i < core->bounds.n_free; ++i)
    gradient[core->bounds.free_entries[i]] = core->d.start_gradient[core->bounds.free_entries[i]];
}

/* The gradient that functions give, of all but bounds, without the terms of path constraints and equalities. */
static void find_unconstrained_gradient(kpirl_mpc_core *core) {
  kpirl_mpc_derivatives *d = &core->d;
  const int bounds = kpirl_mpc_n_bounds(core), m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  int i;
  memcpy(d->unconstrained_gradient, d->gradient, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  for (i = bounds; i < m; ++i) core->scratch[i - bounds] = -core->at.z[i];
  kpirl_mpc_path_transposed_times(core, core->scratch, d->unconstrained_gradient);
  for (i = core->n_fixed; i < n_c; ++i) core->scratch[i - core->n_fixed] = -core->at.nu[i];
  kpirl_mpc_equality_transposed_times(core, core->scratch, d->unconstrained_gradient);
}

void kpirl_mpc_differentiate(kpirl_mpc_core *core, int level) {
  const kpirl_mpc_iterate *at = &core->at;
  kpirl_mpc_derivatives *d = &core->d;
  core->factored = 0;
  kpirl_mpc_evaluate(core, level);
  d->matrices = level == KPIRL_MPC_SECOND;
  if (d->matrices) find_unconstrained_gradient(core);
  kpirl_mpc_bounds_transposed_times(core, at->z, at->nu, d->gradient);
  forget_start(core);
  kpirl_mpc_gap(core, at->x, d->gap);
  kpirl_mpc_inequalities(core, at->x, d->path, d->g);
  kpirl_mpc_equalities(core, at->x, d->equality, d->c);
  d->scale = scale_of(core);
  d->violation = kpirl_mpc_violation(core);
}

/* The largest violation of a constraint; `elastic`: of one that is elastic, too. NaN where there is one. */
static real largest_violation(const kpirl_mpc_core *core, int elastic) {
  const kpirl_mpc_derivatives *d = &core->d;
  const int n_s = DIM(core, n_states), m = kpirl_mpc_n_inequalities(core);
  real parts[4] = {0, 0, 0, 0};
  int i;
  parts[0] = kpirl_mpc_norm_inf(d->defects, DIM(core, horizon) * n_s);
  parts[1] = kpirl_mpc_norm_inf(d->gap, n_s);
  if (elastic || core->penalty <= 0) parts[2] = kpirl_mpc_norm_inf(d->c, kpirl_mpc_n_equalities(core));
  for (i = 0; i < m; ++i)
    if ((elastic || !kpirl_mpc_is_elastic(core, i)) && !(d->g[i] <= parts[3]) && !isnan(parts[3])) parts[3] = d->g[i];
  return kpirl_mpc_norm_inf(parts, 4);
}

real kpirl_mpc_largest_violation(const kpirl_mpc_core *core) { return largest_violation(core, 1); }

void kpirl_mpc_find_residuals(const kpirl_mpc_core *core, real tau, kpirl_mpc_residuals *residuals) {
  const kpirl_mpc_derivatives *d = &core->d;
  const int m = kpirl_mpc_n_inequalities(core);
  real complementarity = 0;
  int i;
  for (i = 0; i < m; ++i) {
    const real product = kpirl_mpc_abs(-d->g[i] * core->at.z[i] - tau);
    if (!kpirl_mpc_is_elastic(core, i) && !(product <= complementarity) && !isnan(complementarity)) complementarity = product;
  }
  residuals->stationarity = kpirl_mpc_norm_inf(d->gradient, kpirl_mpc_n_point(core));
  residuals->feasibility = largest_violation(core, 0);
  residuals->complementarity = complementarity;
  residuals->scale = d->scale;
}

int kpirl_mpc_subproblem_solved(const kpirl_mpc_core *core) {
  const real small = SUBPROBLEM * core->tau, small_violation = core->penalty > 0 ? small / core->penalty : small;
  kpirl_mpc_residuals residuals;
  kpirl_mpc_find_residuals(core, core->tau, &residuals);
  return residuals.stationarity <= small && residuals.feasibility <= small_violation && residuals.complementarity <= small;
}
