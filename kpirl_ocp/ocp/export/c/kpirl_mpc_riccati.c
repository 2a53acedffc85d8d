/* SPDX-License-Identifier: MIT
 *
 * The interior-point method: predictor-corrector steps (Mehrotra, 1992) until the first-order conditions hold, as long as
 * a filter accepts (Waechter and Biegler, 2006, sections 2.3 and 3.1); or a fixed number of full Newton steps, the
 * real-time iteration (Diehl et al., 2005). Where pivots of the recursion are not positive, weight on the actions is added.
 */
#include "kpirl_mpc_filter.h"
#include "kpirl_mpc_newton.h"
#include "kpirl_mpc_rows.h"
#include "kpirl_mpc_start.h"

#include <string.h>
#include <tgmath.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON, NW = KPIRL_MPC_N_POINT - NS };
enum { ROWS = KPIRL_MPC_N_ROWS, FIXED = KPIRL_MPC_N_FIXED };

typedef kpirl_mpc_real real;

static const real START = (real)0.3;      /* barrier of a cold start, relative to the gradient of the objective there */
static const real WARM = (real)1e-3;      /* largest one of a warm start */
static const real LARGE = (real)100;      /* multipliers above this count as large */
static const real SHORTEST = (real)1e-10; /* step length below which a line search gives up */
static const real TINY = (real)1e-14;     /* relative step below which rounding decides, so that it is taken as it is */
static const real FAR = (real)1e12;       /* |w| beyond which an iterate has diverged */
static const int ATTEMPTS = 6;            /* line searches at one iterate, each with a stronger regularisation */

static real larger(real a, real b) { return a > b ? a : b; }
static real smaller(real a, real b) { return a < b ? a : b; }

kpirl_mpc_status kpirl_mpc_check_settings(const kpirl_mpc_settings *settings) {
  (void)settings;
  return KPIRL_MPC_CONVERGED;
}

/* ---- one solve ---------------------------------------------------------------------------------------------- */

/* What complementarity may be off: a fifth of the tolerance, in units of the multipliers where these are large. */
static real close_enough(const kpirl_mpc *mpc) {
  return mpc->settings.tolerance / 5 * larger(1, mpc->work.at.scale / LARGE);
}

/* The barrier to stop at. */
static real final_tau(const kpirl_mpc *mpc) {
  return mpc->settings.barrier > 0 ? mpc->settings.barrier : close_enough(mpc) / 2;
}

/* Do the conditions hold, and complementarity as if multipliers were at most LARGE? Relative to larger multipliers alone,
 * the weakest of the active constraints would stay too far from its bound. */
static int solved(const kpirl_mpc *mpc, kpirl_mpc_solution *scratch) {
  kpirl_mpc_residuals(mpc, mpc->settings.barrier, scratch);
  return scratch->residual <= mpc->work.tolerance && scratch->complementarity <= close_enough(mpc);
}

/* The Newton step, with as much regularisation as the pivots ask for; 0 if none is enough. */
static int find_positive_step(kpirl_mpc *mpc, real regularisation) {
  kpirl_mpc_workspace *work = &mpc->work;
  real rho = regularisation;
  while (rho < (real)1e20) {
    kpirl_mpc_find_step(mpc, rho);
    if (work->step.positive) {
      if (rho > 0) work->regularisation = rho;
      return 1;
    }
    if (rho > 0)
      rho *= work->regularisation > 0 ? 8 : 100;
    else
      rho = work->regularisation > 0 ? larger(work->regularisation / 3, (real)1e-12) : (real)1e-4;
  }
  return 0;
}

/* Derivative of J - tau sum log y along the step. */
static real slope_of(const kpirl_mpc_workspace *work) {
  const kpirl_mpc_iterate *change = &work->step.change;
  real slope = 0, barrier = 0;
  int i;
  for (i = 0; i < NS + NW; ++i) slope += work->at.cost_gradient[i] * change->point[i];
  for (i = 0; i < ROWS; ++i) barrier += change->y[i] / work->iterate.y[i];
  return slope - work->step.tau * barrier;
}

/* Go to the trial point, or with `last` find out no more about it than its residuals. */
static void arrive(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, int last) {
  kpirl_mpc_workspace *work = &mpc->work;
  int i;
  for (i = 0; i < ROWS; ++i) work->trial.z[i] = work->iterate.z[i] + work->step.dual_length * work->step.change.z[i];
  memcpy(&work->iterate, &work->trial, sizeof work->iterate);
  kpirl_mpc_centre(mpc, numbers);
  kpirl_mpc_differentiate(mpc, numbers, !last);
}

/* Move by the longest length that the filter accepts, if there is one. */
static int move_along(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers) {
  kpirl_mpc_workspace *work = &mpc->work;
  const kpirl_mpc_step *step = &work->step;
  const int tiny = kpirl_mpc_largest(step->change.point + NS, NW) <=
                   TINY * (1 + kpirl_mpc_largest(work->iterate.point + NS, NW));
  const real slope = slope_of(work);
  real length = step->primal_length;
  kpirl_mpc_merit before, trial;
  before.theta = work->at.violation;
  before.phi = work->at.objective - step->tau * kpirl_mpc_log_slacks(work->iterate.y);
  while (length >= SHORTEST) {
    kpirl_mpc_try(mpc, numbers, length, &trial.theta, &trial.phi);
    if ((tiny && isfinite(trial.phi)) || kpirl_mpc_accepts(&work->filter, before, slope, length, trial)) {
      arrive(mpc, numbers, 0);
      return 1;
    }
    length = isinf(trial.phi) ? kpirl_mpc_shortened(work, length) : length / 2;
  }
  return 0;
}

/* Move along the corrected step where it is one to a minimum; else along Newton steps, regularised. */
static int search(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers) {
  kpirl_mpc_workspace *work = &mpc->work;
  const real least = final_tau(mpc);
  real rho = 0;
  int attempt;
  kpirl_mpc_find_corrected_step(mpc, least, larger(work->tau, least));
  if (work->step.positive) {
    if (work->step.tau != work->tau) {
      work->tau = work->step.tau;
      kpirl_mpc_start_filter(&work->filter, work->at.violation);
    }
    if (move_along(mpc, numbers)) return 1;
  }
  for (attempt = 0; attempt < ATTEMPTS; ++attempt) {
    if (!find_positive_step(mpc, rho)) return 0;
    if (move_along(mpc, numbers)) return 1;
    rho = larger(100 * work->step.regularisation, (real)1e-4);
  }
  return 0;
}

static kpirl_mpc_status why_stuck(const kpirl_mpc *mpc, kpirl_mpc_solution *scratch) {
  if (!kpirl_mpc_matrices_finite(mpc)) return KPIRL_MPC_NOT_FINITE;
  /* Without bounds on states every rollout is feasible: then only this iterate is not. */
  kpirl_mpc_residuals(mpc, mpc->settings.barrier, scratch);
  return KPIRL_MPC_STATE_CONSTRAINTS && scratch->feasibility > sqrt(mpc->work.tolerance) ? KPIRL_MPC_INFEASIBLE
                                                                                        : KPIRL_MPC_STALLED;
}

static kpirl_mpc_status converge(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, kpirl_mpc_solution *scratch) {
  kpirl_mpc_workspace *work = &mpc->work;
  for (;; ++work->iterations) {
    if (!kpirl_mpc_finite(mpc)) return KPIRL_MPC_NOT_FINITE;
    if (solved(mpc, scratch)) return KPIRL_MPC_CONVERGED;
    if (work->iterations == mpc->settings.max_iterations) return KPIRL_MPC_ITERATION_LIMIT;
    if (kpirl_mpc_late(mpc)) return KPIRL_MPC_TIME_LIMIT;
    if (kpirl_mpc_largest(work->iterate.point + NS, NW) > FAR) return KPIRL_MPC_DIVERGED;
    if (!search(mpc, numbers)) return why_stuck(mpc, scratch);
  }
}

/* Full Newton steps, cut only where a slack or multiplier would become negative. */
static kpirl_mpc_status advance(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, kpirl_mpc_solution *scratch) {
  kpirl_mpc_workspace *work = &mpc->work;
  int i;
  for (; work->iterations < mpc->settings.steps; ++work->iterations) {
    if (!kpirl_mpc_finite(mpc)) return KPIRL_MPC_NOT_FINITE;
    if (kpirl_mpc_late(mpc)) return KPIRL_MPC_TIME_LIMIT;
    if (!find_positive_step(mpc, 0)) return why_stuck(mpc, scratch);
    for (i = 0; i < NS + NW; ++i)
      work->trial.point[i] = work->iterate.point[i] + work->step.primal_length * work->step.change.point[i];
    for (i = 0; i < T * NS; ++i)
      work->trial.costates[i] = work->iterate.costates[i] + work->step.primal_length * work->step.change.costates[i];
    for (i = 0; i < ROWS; ++i)
      work->trial.y[i] = work->iterate.y[i] + work->step.primal_length * work->step.change.y[i];
    for (i = 0; i < FIXED; ++i)
      work->trial.nu[i] = work->iterate.nu[i] + work->step.primal_length * work->step.change.nu[i];
    arrive(mpc, numbers, work->iterations == mpc->settings.steps - 1);
  }
  if (!kpirl_mpc_finite(mpc)) return KPIRL_MPC_NOT_FINITE;
  return solved(mpc, scratch) ? KPIRL_MPC_CONVERGED : KPIRL_MPC_STEPS_TAKEN;
}

/* As small as the guess is good, so that a solution stays one; at most WARM, so that a guess counts. */
static real warm_barrier(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                         kpirl_mpc_solution *scratch) {
  const real final = mpc->settings.tolerance / 10;
  kpirl_mpc_warm_start(mpc, numbers, guess, final);
  kpirl_mpc_differentiate(mpc, numbers, 0);
  kpirl_mpc_residuals(mpc, 0, scratch);
  return isfinite(scratch->residual) ? smaller(larger(scratch->residual, final), WARM) : WARM;
}

/* The iterate, its derivatives and a new filter; warm: with the multipliers of the guess. */
static void begin(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess, int warm) {
  kpirl_mpc_workspace *work = &mpc->work;
  const real barrier = mpc->settings.barrier;
  int i;
  if (warm) {
    work->tau = barrier > 0 ? barrier : warm_barrier(mpc, numbers, guess, &work->scratch);
    kpirl_mpc_warm_start(mpc, numbers, guess, work->tau);
  } else {
    kpirl_mpc_start(mpc, numbers, guess);
    if (barrier <= 0) kpirl_mpc_differentiate(mpc, numbers, 0);
    work->tau = barrier > 0 ? barrier : START * work->at.scale;
    for (i = 0; i < ROWS; ++i) work->iterate.z[i] = work->tau / work->iterate.y[i];
  }
  work->regularisation = 0;
  kpirl_mpc_differentiate(mpc, numbers, 1);
  kpirl_mpc_start_filter(&work->filter, work->at.violation);
}

/* A warm start that gets stuck begins again, cold, from the guess's trajectory. */
static kpirl_mpc_status plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess) {
  kpirl_mpc_solution *scratch = &mpc->work.scratch; /* its residuals alone */
  const int warm = guess && guess->dynamics;
  kpirl_mpc_status status;
  begin(mpc, numbers, guess, warm);
  if (mpc->settings.steps) return advance(mpc, numbers, scratch);
  status = converge(mpc, numbers, scratch);
  if (!warm || (status != KPIRL_MPC_STALLED && status != KPIRL_MPC_INFEASIBLE)) return status;
  begin(mpc, numbers, guess, 0);
  return converge(mpc, numbers, scratch);
}

void kpirl_mpc_run(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                   kpirl_mpc_solution *solution) {
  kpirl_mpc_workspace *work = &mpc->work;
  const real barrier = mpc->settings.barrier;
  kpirl_mpc_sort_bounds(mpc);
  work->tolerance = mpc->settings.tolerance;
  if (barrier > 0) work->tolerance = smaller(work->tolerance, larger((real)1e-6 * barrier, (real)1e-13));
  work->iterations = 0;
  solution->status = plan(mpc, numbers, guess);
  solution->iterations = work->iterations;
  kpirl_mpc_residuals(mpc, barrier, solution);
  kpirl_mpc_write(mpc, solution);
}
