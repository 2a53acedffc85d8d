/* SPDX-License-Identifier: MIT
 *
 * The interior-point method: Newton steps until the first-order conditions hold, lowering tau on the way, along which a
 * filter accepts (Waechter and Biegler, 2006, sections 2.3 and 3.1); or a fixed number of full steps, the real-time
 * iteration (Diehl et al., 2005). Where pivots of the recursion are not positive, weight on the actions is added.
 */
#include "kpirl_mpc_newton.h"

#include <float.h>
#include <string.h>
#include <tgmath.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON, NW = KPIRL_MPC_N_POINT - NS };
enum { ROWS = KPIRL_MPC_N_ROWS, FORCES = KPIRL_MPC_N_FORCES, FIXED = KPIRL_MPC_N_FIXED };

typedef kpirl_mpc_real real;

static const real START = (real)0.3;      /* barrier of a cold start, relative to the gradient of the objective there */
static const real WARM = (real)1e-6;      /* largest one of a warm start */
static const real SOLVED = (real)30;      /* a barrier problem is solved when its residual is below this times tau / scale */
static const real LARGE = (real)100;      /* multipliers above this count as large */
static const real SHORTEST = (real)1e-10; /* step length below which a line search gives up */
static const real TINY = (real)1e-14;     /* relative step below which rounding decides, so that it is taken as it is */
static const real FAR = (real)1e12;       /* |w| beyond which an iterate has diverged */
static const int ATTEMPTS = 6;            /* line searches at one iterate, each with a stronger regularisation */
static const real KKT_RESIDUAL = (real)1e-6; /* of a plan whose gradient is to be believed */

#ifdef KPIRL_MPC_FLOAT
static const real ROUNDING = 10 * FLT_EPSILON;
#else
static const real ROUNDING = 10 * DBL_EPSILON;
#endif

static real larger(real a, real b) { return a > b ? a : b; }
static real smaller(real a, real b) { return a < b ? a : b; }

kpirl_mpc_status kpirl_mpc_check_settings(const kpirl_mpc_settings *settings) {
  (void)settings;
  return KPIRL_MPC_CONVERGED;
}

/* ---- filter: a step must reduce the objective or the violation of the constraints, and never cycle ---------- */

typedef struct merit {
  real theta, phi; /* violation, and J - tau sum log y */
} merit;

static void start_filter(kpirl_mpc_filter *filter, real theta) {
  filter->largest = (real)1e4 * larger(1, theta);
  filter->small = (real)1e-4 * larger(1, theta);
  filter->count = 0;
}

/* Is a step of `length` from `before`, with directional derivative `slope` of phi, to `trial` good enough? Adds the
 * point it leaves to the filter, unless the objective alone decided. */
static int accepts(kpirl_mpc_filter *filter, merit before, real slope, real length, merit trial) {
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

/* ---- one solve ---------------------------------------------------------------------------------------------- */

/* The barrier to stop at: a tenth of the tolerance, in units of the multipliers where these are large. */
static real final_tau(const kpirl_mpc *mpc) {
  if (mpc->settings.barrier > 0) return mpc->settings.barrier;
  return mpc->settings.tolerance / 10 * larger(1, mpc->work.at.scale / LARGE);
}

/* Do the conditions hold, and complementarity as if multipliers were at most LARGE? Relative to larger multipliers alone,
 * the weakest of the active constraints would stay too far from its bound. */
static int solved(const kpirl_mpc *mpc, kpirl_mpc_solution *scratch) {
  kpirl_mpc_residuals(mpc, mpc->settings.barrier, scratch);
  return scratch->residual <= mpc->work.tolerance && scratch->complementarity <= 10 * final_tau(mpc);
}

/* Lower tau when its own problem is solved (Waechter and Biegler, eq. 7). */
static void tighten(kpirl_mpc *mpc, kpirl_mpc_solution *scratch) {
  kpirl_mpc_workspace *work = &mpc->work;
  const real before = work->tau, final = final_tau(mpc);
  while (work->tau > final) {
    kpirl_mpc_residuals(mpc, work->tau, scratch);
    if (!(scratch->residual <= SOLVED * work->tau / work->at.scale)) break;
    work->tau = larger(final, smaller((real)0.2 * work->tau, work->tau * sqrt(work->tau)));
  }
  if (work->tau != before) start_filter(&work->filter, work->at.violation);
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
  return slope - work->tau * barrier;
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

/* Move along a Newton step as the filter allows; shorten the step by regularisation if it never does. */
static int search(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers) {
  kpirl_mpc_workspace *work = &mpc->work;
  real rho = 0;
  int attempt;
  for (attempt = 0; attempt < ATTEMPTS; ++attempt) {
    merit before, trial;
    real length, slope;
    int tiny;
    if (!find_positive_step(mpc, rho)) return 0;
    length = work->step.primal_length;
    before.theta = work->at.violation;
    before.phi = work->at.objective - work->tau * kpirl_mpc_log_slacks(work->iterate.y);
    slope = slope_of(work);
    tiny = kpirl_mpc_largest(work->step.change.point + NS, NW) <=
           TINY * (1 + kpirl_mpc_largest(work->iterate.point + NS, NW));
    for (; length >= SHORTEST; length /= 2) {
      kpirl_mpc_try(mpc, numbers, length, &trial.theta, &trial.phi);
      if ((tiny && isfinite(trial.phi)) || accepts(&work->filter, before, slope, length, trial)) {
        arrive(mpc, numbers, 0);
        return 1;
      }
    }
    rho = larger(100 * work->step.regularisation, (real)1e-4);
  }
  return 0;
}

static int matrices_finite(const kpirl_mpc_derivatives *d) {
  return kpirl_mpc_all_finite(d->F, NS * KPIRL_MPC_N_X * T) && kpirl_mpc_all_finite(d->G, KPIRL_MPC_N_PATH * KPIRL_MPC_N_X * T) &&
         kpirl_mpc_all_finite(d->H, KPIRL_MPC_N_X * KPIRL_MPC_N_X * T) && kpirl_mpc_all_finite(d->H_last, NS * NS);
}

static kpirl_mpc_status why_stuck(const kpirl_mpc *mpc, kpirl_mpc_solution *scratch) {
  if (!matrices_finite(&mpc->work.at)) return KPIRL_MPC_NOT_FINITE;
  /* Without bounds on states every rollout is feasible: then only this iterate is not. */
  kpirl_mpc_residuals(mpc, mpc->settings.barrier, scratch);
  return KPIRL_MPC_STATE_CONSTRAINTS && scratch->feasibility > sqrt(mpc->work.tolerance) ? KPIRL_MPC_INFEASIBLE
                                                                                        : KPIRL_MPC_STALLED;
}

static kpirl_mpc_status converge(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, kpirl_mpc_solution *scratch) {
  kpirl_mpc_workspace *work = &mpc->work;
  for (;; ++work->iterations) {
    if (!kpirl_mpc_finite(mpc)) return KPIRL_MPC_NOT_FINITE;
    tighten(mpc, scratch);
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

void kpirl_mpc_run(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                   kpirl_mpc_solution *solution) {
  kpirl_mpc_workspace *work = &mpc->work;
  const real barrier = mpc->settings.barrier;
  kpirl_mpc_solution *scratch = &work->scratch; /* its residuals alone */
  int i;
  kpirl_mpc_sort_bounds(mpc);
  if (guess && guess->dynamics) {
    work->tau = barrier > 0 ? barrier : warm_barrier(mpc, numbers, guess, scratch);
    kpirl_mpc_warm_start(mpc, numbers, guess, work->tau);
  } else {
    kpirl_mpc_start(mpc, numbers, guess);
    if (barrier <= 0) kpirl_mpc_differentiate(mpc, numbers, 0);
    work->tau = barrier > 0 ? barrier : START * work->at.scale;
    for (i = 0; i < ROWS; ++i) work->iterate.z[i] = work->tau / work->iterate.y[i];
  }
  work->tolerance = mpc->settings.tolerance;
  if (barrier > 0) work->tolerance = smaller(work->tolerance, larger((real)1e-6 * barrier, (real)1e-13));
  work->regularisation = 0;
  work->iterations = 0;
  kpirl_mpc_differentiate(mpc, numbers, 1);
  start_filter(&work->filter, work->at.violation);
  solution->status = mpc->settings.steps ? advance(mpc, numbers, scratch) : converge(mpc, numbers, scratch);
  solution->iterations = work->iterations;
  kpirl_mpc_residuals(mpc, barrier, solution);
  kpirl_mpc_write(mpc, solution);
}

/* ---- the derivative of a solution --------------------------------------------------------------------------- */

/* Solve the Newton system K v = (slope, 0): the step of newton_step for the gradient r = -slope, without defects, and with
 * g, tau such that no force is left in it. Where bounds coincide, nu is found in two proximal steps. */
static void solve_adjoint(kpirl_mpc *mpc, const real *by_states, const real *by_actions) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_derivatives *d = &work->at;
  real nu[KPIRL_MPC_ROOM(KPIRL_MPC_N_FIXED)] = {0};
  const real tau = work->tau;
  int t, i, round;
  for (t = 0; t < T; ++t) {
    for (i = 0; i < NS; ++i) d->r[t * KPIRL_MPC_N_X + i] = t ? -by_states[t * NS + i] : 0;
    for (i = 0; i < NU; ++i) d->r[t * KPIRL_MPC_N_X + NS + i] = -by_actions[t * NU + i];
  }
  for (i = 0; i < NS; ++i) d->r_last[i] = -by_states[T * NS + i];
  memset(d->defects, 0, sizeof d->defects);
  memset(d->gap, 0, sizeof d->gap);
  memset(d->off, 0, sizeof d->off);
  for (i = 0; i < ROWS; ++i) d->rows[i] = i < ROWS - FORCES ? -work->iterate.y[i] : 0; /* force 0; or z, which r lacks */
  work->tau = 0;
  for (round = 0; round < (FIXED ? 2 : 1); ++round) {
    memcpy(work->iterate.nu, nu, sizeof nu);
    kpirl_mpc_find_step(mpc, 0);
    for (i = 0; i < FIXED; ++i) nu[i] += work->step.change.nu[i];
  }
  work->tau = tau;
}

/* by_start = the s_0 part of H_0 x_0 + F_0' lambda_1 + G_0' mu_0 with x_0 = (0, u_0). */
static void gradient_of_start(const kpirl_mpc_workspace *work, const real *direct, real *gradient) {
  const kpirl_mpc_derivatives *d = &work->at;
  const kpirl_mpc_iterate *v = &work->step.change;
  int i, j;
  for (i = 0; i < NS; ++i) {
    real sum = 0;
    for (j = 0; j < NU; ++j) sum += d->H[i + (NS + j) * KPIRL_MPC_N_X] * v->point[(T + 1) * NS + j];
    for (j = 0; j < NS; ++j) sum += d->F[j + i * NS] * v->costates[j];
    for (j = 0; j < KPIRL_MPC_N_PATH; ++j) sum += d->G[j + i * KPIRL_MPC_N_PATH] * v->z[KPIRL_MPC_N_BOUNDS + j];
    gradient[i] = direct[i] - sum;
  }
}

/* How psi and the context enter the conditions, weighted with the adjoint. */
static void pull_back(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, kpirl_mpc_gradients *gradients) {
  kpirl_mpc_workspace *work = &mpc->work;
  const kpirl_mpc_iterate *at = &work->iterate, *v = &work->step.change;
  const real *arguments[10];
  real *results[2];
  int t, i;
  for (t = 0; t < T; ++t) {
    memcpy(work->columns + t * KPIRL_MPC_N_X, v->point + t * NS, NS * sizeof(real));
    memcpy(work->columns + t * KPIRL_MPC_N_X + NS, v->point + (T + 1) * NS + t * NU, NU * sizeof(real));
  }
  arguments[0] = at->point;
  arguments[1] = at->point + (T + 1) * NS;
  arguments[2] = numbers->psi;
  arguments[3] = numbers->context;
  arguments[4] = at->costates;
  arguments[5] = at->z + KPIRL_MPC_N_BOUNDS;
  arguments[6] = work->columns;
  arguments[7] = v->point + T * NS;
  arguments[8] = v->costates;
  arguments[9] = v->z + KPIRL_MPC_N_BOUNDS;
  results[0] = gradients->psi;
  results[1] = gradients->context;
  kpirl_mpc_call(mpc, kpirl_mpc_pull, 10, arguments, 2, results);
  for (i = 0; i < KPIRL_MPC_N_PARAMETERS; ++i) gradients->psi[i] = -gradients->psi[i];
  for (i = 0; i < KPIRL_MPC_N_CONTEXT; ++i) gradients->context[i] = -gradients->context[i];
}

kpirl_mpc_status kpirl_mpc_differentiate_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers,
                                              const kpirl_mpc_guess *guess, const kpirl_mpc_solution *solution,
                                              const real *by_states, const real *by_actions,
                                              kpirl_mpc_gradients *gradients) {
  kpirl_mpc_workspace *work = &mpc->work;
  const kpirl_mpc_guess plan = kpirl_mpc_resume(solution);
  kpirl_mpc_gradients found;
  int i;
  (void)guess;
  memset(&found, 0, sizeof found);
  kpirl_mpc_sort_bounds(mpc);
  work->tau = mpc->settings.barrier > 0 ? mpc->settings.barrier : mpc->settings.tolerance / 10;
  kpirl_mpc_warm_start(mpc, numbers, &plan, work->tau);
  kpirl_mpc_differentiate(mpc, numbers, 1);
  if (!kpirl_mpc_finite(mpc) || !matrices_finite(&work->at)) return KPIRL_MPC_NOT_FINITE;
  kpirl_mpc_residuals(mpc, mpc->settings.barrier, &work->scratch);
  found.residual = work->scratch.residual;
  solve_adjoint(mpc, by_states, by_actions);
  gradient_of_start(work, by_states, found.state);
  pull_back(mpc, numbers, &found);
  found.pivot = work->step.pivots[0];
  for (i = 1; i < T * NU; ++i) found.pivot = smaller(work->step.pivots[i], found.pivot);
  *gradients = found;
  if (!work->step.positive) return KPIRL_MPC_NOT_A_MINIMUM;
  return found.residual <= KKT_RESIDUAL ? KPIRL_MPC_CONVERGED : KPIRL_MPC_NOT_SOLVED;
}
