/* SPDX-License-Identifier: MIT
 *
 * How much weight on the identity makes the reduced Hessian positive (inertia correction; Waechter and Biegler, 2006, section
 * 3.1): a tenth of the last one, or as much more as it takes, but not much more than the pivot that is not positive lacks.
 */
#include "kpirl_mpc_method.h"

static const real FIRST = (real)1e-4, SMALLEST = (real)1e-12; /* weights, in units of the Hessian where it is small */
static const real STRONGEST = (real)1e10; /* weight, relative to the scale of the problem, that leads nowhere */
static const real STRONGEST_OFF = 1; /* the same off the dynamics: gaps closed at any cost make costates as large as the weight, and
                                      * these a Hessian that needs a larger one */
static const real FIRST_FACTOR = 100, FACTOR = 8, FALL = 10; /* by which it grows, before one is known and then; and falls */
static const real LEAST_FACTOR = 2, MARGIN = 4; /* by which it grows at least; times what a pivot lacks, at most */

/* The largest entry of the Hessian, if that is less than 1: in other units of the cost the weights are others. */
real kpirl_mpc_unit_weight(const kpirl_mpc_core *core) {
  const real largest = kpirl_mpc_largest_curvature(core);
  return largest > 0 ? kpirl_mpc_min(1, largest) : 1;
}

/* The least weight to try where one is needed. */
static real first_weight(const kpirl_mpc_core *core) {
  const real last = core->regularisation, unit = kpirl_mpc_unit_weight(core);
  return last > 0 ? kpirl_mpc_max(last / FALL, SMALLEST * unit) : FIRST * unit;
}

/* A weight for steps that are too long with the last one. */
real kpirl_mpc_stronger(const kpirl_mpc_core *core) {
  return core->step.regularisation > 0 ? FIRST_FACTOR * core->step.regularisation : first_weight(core);
}

/* What the pivot lacks that is not positive. A weight on the identity adds at least itself to every pivot. Those of free entries of
 * s_0 are known where all others are positive. */
static real lacking(const kpirl_mpc_core *core) {
  const int n_pivots = DIM(core, horizon) * DIM(core, n_actions);
  real least = (real)INFINITY;
  int i;
  for (i = 0; i < n_pivots; ++i) least = kpirl_mpc_min(core->factors.pivots[i], least);
  for (i = 0; least > 0 && i < core->bounds.n_free; ++i) least = kpirl_mpc_min(core->factors.free_pivots[i], least);
  return -least;
}

/* The weight after one that was not enough: much larger weights make short steps. */
static real larger(const kpirl_mpc_core *core, real rho) {
  const real grown = rho * (core->regularisation > 0 ? FACTOR : FIRST_FACTOR), lacks = lacking(core);
  if (!(lacks > 0)) return grown;
  return kpirl_mpc_min(grown, kpirl_mpc_max(LEAST_FACTOR * rho, rho + MARGIN * lacks));
}

/* The Newton step with this regularisation, or, where the Hessian is known to be `indefinite` with it or turns out to be, with as
 * much more as it needs; 0 if none is enough. */
int kpirl_mpc_find_positive_step(kpirl_mpc_core *core, real regularisation, int indefinite) {
  const real strongest = (kpirl_mpc_off_dynamics(core) ? STRONGEST_OFF : STRONGEST) * core->d.scale;
  real rho = regularisation;
  if (!indefinite) kpirl_mpc_newton_step(core, rho);
  while (indefinite || !core->step.positive) {
    rho = rho > 0 ? larger(core, rho) : first_weight(core);
    if (!(rho < strongest)) return 0;
    kpirl_mpc_newton_step(core, rho);
    indefinite = 0;
  }
  if (rho > regularisation) core->indefinite = 1;
  if (rho > 0) core->regularisation = rho;
  return 1;
}
