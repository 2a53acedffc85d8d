/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_filter.h"

#include <float.h>
#include <tgmath.h>

typedef kpirl_mpc_real real;

#ifdef KPIRL_MPC_FLOAT
static const real ROUNDING = 10 * FLT_EPSILON;
#else
static const real ROUNDING = 10 * DBL_EPSILON;
#endif

static real larger(real a, real b) { return a > b ? a : b; }

void kpirl_mpc_start_filter(kpirl_mpc_filter *filter, real theta) {
  filter->largest = (real)1e4 * larger(1, theta);
  filter->small = (real)1e-4 * larger(1, theta);
  filter->count = 0;
}

int kpirl_mpc_accepts(kpirl_mpc_filter *filter, kpirl_mpc_merit before, real slope, real length, kpirl_mpc_merit trial) {
  const real violation = (real)1e-5, objective = (real)1e-8, armijo = (real)1e-4; /* sufficient decreases */
  const real tolerated = ROUNDING * fabs(before.phi);
  int i;
  if (!isfinite(trial.theta) || !isfinite(trial.phi) || trial.theta > filter->largest) return 0;
  for (i = 0; i < filter->count; ++i)
    if (trial.theta >= filter->theta[i] && trial.phi - tolerated > filter->phi[i]) return 0;
  if (slope < 0 && length * pow(-slope, (real)2.3) > pow(before.theta, (real)1.1) && before.theta <= filter->small)
    return trial.phi <= before.phi + armijo * length * slope + tolerated;
  if (!(trial.theta <= (1 - violation) * before.theta || trial.phi <= before.phi - objective * before.theta + tolerated))
    return 0;
  filter->theta[filter->count] = (1 - violation) * before.theta;
  filter->phi[filter->count++] = before.phi - objective * before.theta;
  return 1;
}
