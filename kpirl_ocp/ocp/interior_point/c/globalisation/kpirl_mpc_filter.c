/* SPDX-License-Identifier: MIT
 *
 * A filter: a step must reduce the objective or the violation of the constraints, and never cycle (Waechter and Biegler, On
 * the implementation of an interior-point filter line-search algorithm, 2006, section 2.3).
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real ROUNDING = 10 * KPIRL_MPC_EPSILON;
static const real VIOLATION = (real)1e-5, OBJECTIVE = (real)1e-8, ARMIJO = (real)1e-4; /* sufficient decreases */

/* The violation is in units of where it starts. */
void kpirl_mpc_start_filter(kpirl_mpc_core *core) {
  kpirl_mpc_filter *filter = &core->filter;
  real theta;
  kpirl_mpc_measure(core, core->d.F);
  core->d.violation = theta = kpirl_mpc_violation(core);
  filter->largest = (real)1e2 * kpirl_mpc_max(1, theta);
  filter->small = (real)1e-4 * kpirl_mpc_max(1, theta);
  filter->feasible = kpirl_mpc_violation_rounding(core);
  filter->count = 0;
}

/* The same pairs for another tau. */
void kpirl_mpc_shift_filter(kpirl_mpc_filter *filter, real from, real to) {
  int i;
  for (i = 0; i < filter->count; ++i) filter->pairs[i].phi -= (to - from) * filter->pairs[i].log_sum;
}

/* Without the pairs that the new one covers; a full filter forgets its oldest pair. */
static void add(kpirl_mpc_filter *filter, kpirl_mpc_merit pair) {
  kpirl_mpc_merit *pairs = filter->pairs;
  int i, kept = 0;
  for (i = 0; i < filter->count; ++i)
    if (pairs[i].theta < pair.theta || pairs[i].phi < pair.phi) pairs[kept++] = pairs[i];
  if (kept == KPIRL_MPC_FILTER_SIZE) {
    --kept;
    memmove(pairs, pairs + 1, (size_t)kept * sizeof(*pairs));
  }
  pairs[kept] = pair;
  filter->count = kept + 1;
}

/* Where the violation is rounding, the objective decides, and may rise by what the violation that is gone costs at `price`. */
int kpirl_mpc_filter_accepts(kpirl_mpc_filter *filter, kpirl_mpc_merit before, real slope, real length, real price, kpirl_mpc_merit trial) {
  const real tolerated = ROUNDING * kpirl_mpc_abs(before.phi);
  int i;
  if (!isfinite(trial.theta) || !isfinite(trial.phi) || trial.theta > filter->largest) return 0;
  for (i = 0; i < filter->count; ++i)
    if (trial.theta - filter->feasible >= filter->pairs[i].theta && trial.phi - tolerated > filter->pairs[i].phi) return 0;
  if (before.theta <= filter->feasible)
    return trial.phi <= before.phi + price * kpirl_mpc_max(before.theta - trial.theta, 0) +
                        ARMIJO * length * kpirl_mpc_min(slope, 0) + tolerated;
  if (slope < 0 && before.theta <= filter->small &&
      length * kpirl_mpc_pow(-slope, (real)2.3) > kpirl_mpc_pow(before.theta, (real)1.1))
    return trial.phi <= before.phi + ARMIJO * length * slope + tolerated;
  if (!(trial.theta <= (1 - VIOLATION) * before.theta || trial.phi <= before.phi - OBJECTIVE * before.theta + tolerated))
    return 0;
  before.phi -= OBJECTIVE * before.theta;
  before.theta *= 1 - VIOLATION;
  add(filter, before);
  return 1;
}
