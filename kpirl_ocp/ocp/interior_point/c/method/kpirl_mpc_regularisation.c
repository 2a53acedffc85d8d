/* SPDX-License-Identifier: MIT
 *
 * How much weight on the identity makes the reduced Hessian positive (inertia correction; Waechter and Biegler, 2006, section
 * 3.1). The least weight is found to within a factor, at the price of a few factorisations: more of it only shortens
 * steps, and just enough of it would make them arbitrarily long.
 */
#include "kpirl_mpc_core.h"

static const real FIRST = (real)1e-4, SMALLEST = (real)1e-12; /* weights */
static const real STRONGEST = (real)1e10; /* weight, relative to the scale of the problem, that leads nowhere */
static const real FIRST_FACTOR = 100, FACTOR = 8; /* between the weights that are tried: before one is known, and then */
static const real CLOSE = (real)1.5; /* factor within which the least weight is found */
static const real MARGIN = 2;        /* what is taken of it */

/* A weight above `low`, which does not suffice, that suffices and is at most CLOSE times the least one; infinity if none does. */
static real least_regularisation(kpirl_mpc_core *core, real low) {
  const int known = core->regularisation > 0;
  real high = kpirl_mpc_larger(known ? core->regularisation : FIRST, FACTOR * low);
  if (kpirl_mpc_factorise(core, high)) {
    while (high > SMALLEST && high / FACTOR > low && kpirl_mpc_factorise(core, high / FACTOR)) high /= FACTOR;
    low = kpirl_mpc_larger(low, high / FACTOR);
  } else {
    do {
      low = high;
      high *= known ? FACTOR : FIRST_FACTOR;
      if (!(high < STRONGEST * core->d.scale)) return (real)INFINITY;
    } while (!kpirl_mpc_factorise(core, high));
  }
  while (high > CLOSE * low) {
    const real middle = kpirl_mpc_root(low * high);
    if (kpirl_mpc_factorise(core, middle))
      high = middle;
    else
      low = middle;
  }
  return high;
}

/* The Newton step with this regularisation, or with as much more as it needs; 0 if none is enough. */
int kpirl_mpc_find_positive_step(kpirl_mpc_core *core, real regularisation) {
  real rho = regularisation;
  kpirl_mpc_newton_step(core, rho);
  if (!core->step.positive) {
    rho = MARGIN * least_regularisation(core, rho);
    if (isinf(rho)) return 0;
    kpirl_mpc_newton_step(core, rho);
  }
  if (core->step.positive && rho > 0) core->regularisation = rho;
  return core->step.positive;
}
