/* SPDX-License-Identifier: MIT
 *
 * When an iterate is a solution: within the tolerance, or as far as rounding allows.
 */
#include "kpirl_mpc_method.h"

static const real ROUNDING = 500 * KPIRL_MPC_EPSILON; /* of slack * multiplier, relative to `largest_product` */
static const real HEAVIEST = (real)1e4; /* multipliers, relative to the gradient of J, up to which they are the scale of stationarity */
static const int IDLE = 5; /* iterations without a smaller residual after which rounding is the floor */

/* The largest multiplier times what its slack is a difference of: an entry of x and a bound; of h, taken as 1. */
static real largest_product(const kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core), bounds = kpirl_mpc_n_bounds(core);
  real most = kpirl_mpc_norm_inf(core->at.z + bounds, m - bounds);
  int i;
  for (i = 0; i < bounds; ++i) {
    const real x = core->at.x[kpirl_mpc_bounded_entry(core, i)];
    most = kpirl_mpc_max(kpirl_mpc_abs(x) * core->at.z[i], most);
  }
  return most;
}

/* What complementarity may be off: a fifth of the tolerance in units of the cost, unless rounding leaves more. The sum of all
 * y z is the duality gap of a convex problem. */
static real close_enough(const kpirl_mpc_core *core) {
  return kpirl_mpc_max((real)core->options.tolerance / 5, ROUNDING * largest_product(core));
}

/* The tau to stop at. */
real kpirl_mpc_final_tau(const kpirl_mpc_core *core) {
  return core->options.barrier > 0 ? (real)core->options.barrier : close_enough(core) / 2;
}

/* Residuals relative to the scale, those of feasibility as they are. */
static void relative(const kpirl_mpc_residuals *r, real *parts) {
  parts[0] = r->stationarity / r->scale;
  parts[1] = r->complementarity / r->scale;
  parts[2] = r->feasibility;
}

real kpirl_mpc_worst(const kpirl_mpc_residuals *r) {
  real parts[3];
  relative(r, parts);
  return kpirl_mpc_norm_inf(parts, 3);
}

/* The residuals to stop at. Multipliers that grow without bound, where constraints have no interior, are no scale for the gradient. */
static void find_residuals(const kpirl_mpc_core *core, kpirl_mpc_residuals *residuals) {
  const real gradient = kpirl_mpc_norm_inf(core->d.cost_gradient, kpirl_mpc_n_point(core));
  kpirl_mpc_find_residuals(core, (real)core->options.barrier, residuals);
  residuals->scale = kpirl_mpc_min(residuals->scale, kpirl_mpc_max(1, HEAVIEST * gradient));
}

/* Do the conditions hold? Complementarity relative to the scale alone would leave the weakest of the active constraints too far
 * from its bound. */
int kpirl_mpc_solved(const kpirl_mpc_core *core) {
  kpirl_mpc_residuals residuals;
  find_residuals(core, &residuals);
  return kpirl_mpc_worst(&residuals) <= core->tolerance && residuals.complementarity <= close_enough(core);
}

/* Do the conditions hold as far as rounding lets them? Where all of x is small, a violation has to be small beside it, too. */
int kpirl_mpc_acceptable(const kpirl_mpc_core *core) {
  const real enough = kpirl_mpc_sqrt(core->tolerance) / 10, size = kpirl_mpc_norm_inf(core->at.x, kpirl_mpc_n_point(core));
  kpirl_mpc_residuals residuals;
  find_residuals(core, &residuals);
  return kpirl_mpc_worst(&residuals) <= enough && residuals.feasibility <= kpirl_mpc_max(core->tolerance, enough * size);
}

/* Have all residuals stayed as they are for some iterations? A start that follows the dynamics has the best feasibility of all;
 * regularised steps are slow for another reason than rounding. */
int kpirl_mpc_idle(kpirl_mpc_core *core) {
  kpirl_mpc_residuals residuals;
  real parts[3];
  int i;
  kpirl_mpc_find_residuals(core, (real)core->options.barrier, &residuals);
  relative(&residuals, parts);
  core->idle = core->step.regularisation > 0 ? 0 : core->idle + 1;
  for (i = 0; i < 3; ++i)
    if (parts[i] < core->best[i] / 2) {
      core->best[i] = parts[i];
      core->idle = 0;
    }
  return core->idle >= IDLE;
}
