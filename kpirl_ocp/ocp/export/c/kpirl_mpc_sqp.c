/* SPDX-License-Identifier: MIT
 *
 * Sequential quadratic programming. The solver itself is generated (CasADi's sqpmethod with qrqp); it does not say how it
 * ended, so the first-order conditions are measured where it stopped.
 */
#include "kpirl_mpc_memory.h"

#include <string.h>
#include <tgmath.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, NX = KPIRL_MPC_N_X, NH = KPIRL_MPC_N_PATH };
enum { T = KPIRL_MPC_HORIZON, NW = KPIRL_MPC_N_W, NP = KPIRL_MPC_N_PARAMETERS, NC = KPIRL_MPC_N_CONTEXT };

typedef kpirl_mpc_real real;

static real larger(real a, real b) { return a > b || isnan(a) ? a : b; }

/* Tolerance and iterations are compiled in, and there is no way to stop it. */
kpirl_mpc_status kpirl_mpc_check_settings(const kpirl_mpc_settings *settings) {
  const kpirl_mpc_settings *fixed = &kpirl_mpc_exported_settings;
  return settings->max_iterations == fixed->max_iterations && settings->steps == 0 && settings->barrier <= 0 &&
                 settings->time_limit <= 0
             ? KPIRL_MPC_CONVERGED
             : KPIRL_MPC_ERROR_UNSUPPORTED;
}

static real of_entry(const real *state, const real *action, int entry) {
  return entry < T * NS ? state[entry % NS] : action[(entry - T * NS) % NU];
}

/* Where no guess is given: the rollout of no action. */
static void roll_out(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, real *w) {
  const real *arguments[3];
  real *results[1];
  int t;
  memset(w, 0, NW * sizeof(real));
  for (t = 0; t < T; ++t) {
    arguments[0] = t ? w + (t - 1) * NS : numbers->state;
    arguments[1] = w + T * NS + t * NU;
    arguments[2] = numbers->psi;
    results[0] = w + t * NS;
    kpirl_mpc_call(mpc, kpirl_mpc_dynamics, 3, arguments, 1, results);
  }
}

static void fill_arguments(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess) {
  kpirl_mpc_workspace *work = &mpc->work;
  const kpirl_mpc_bounds *bounds = &mpc->bounds;
  int i;
  memset(work->guess_w, 0, sizeof work->guess_w);
  memset(work->guess_g, 0, sizeof work->guess_g);
  if (guess) {
    memcpy(work->guess, guess->states + NS, T * NS * sizeof(real));
    memcpy(work->guess + T * NS, guess->actions, T * NU * sizeof(real));
  } else {
    roll_out(mpc, numbers, work->guess);
  }
  if (guess && guess->dynamics) {
    memcpy(work->guess_w, guess->state_bounds, T * NS * sizeof(real));
    memcpy(work->guess_w + T * NS, guess->action_bounds, T * NU * sizeof(real));
    memcpy(work->guess_g, guess->dynamics, T * NS * sizeof(real));
    if (NH > 0) memcpy(work->guess_g + T * NS, guess->path, T * NH * sizeof(real));
  }
  for (i = 0; i < NW; ++i) {
    work->lower[i] = of_entry(bounds->state_lower, bounds->action_lower, i);
    work->upper[i] = of_entry(bounds->state_upper, bounds->action_upper, i);
  }
  for (i = 0; i < KPIRL_MPC_N_G; ++i) {
    work->lower_g[i] = i < T * NS ? 0 : -(real)INFINITY;
    work->upper_g[i] = 0;
  }
  memcpy(work->numbers, numbers->state, NS * sizeof(real));
  if (NP > 0) memcpy(work->numbers + NS, numbers->psi, NP * sizeof(real));
  if (NC > 0) memcpy(work->numbers + NS + NP, numbers->context, NC * sizeof(real));
}

/* The conditions of one bound with slack >= 0 and force >= 0. */
static void add_bound(real slack, real force, real *violation, real *product) {
  *violation = larger(-slack, *violation);
  *product = larger(larger(fabs(force * slack), -force), *product);
}

/* Stationarity, feasibility, complementarity (and signs of multipliers), scale. */
static void audit(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, kpirl_mpc_solution *solution) {
  kpirl_mpc_workspace *work = &mpc->work;
  const real *arguments[6], *w = work->point + NS;
  real *results[7], violation = 0, product = 0, stationarity = 0, scale = 1;
  int i;
  arguments[0] = work->point;
  arguments[1] = w + T * NS;
  arguments[2] = numbers->psi;
  arguments[3] = numbers->context;
  arguments[4] = work->lam_g;
  arguments[5] = work->lam_g + T * NS;
  results[0] = &solution->objective;
  results[1] = work->defects;
  results[2] = work->path;
  results[3] = work->cost;
  results[4] = work->cost_last;
  results[5] = work->slope;
  results[6] = work->slope_last;
  kpirl_mpc_call(mpc, kpirl_mpc_stage_first, 6, arguments, 7, results);
  for (i = 0; i < NW; ++i) {
    const int state = i < T * NS, t = state ? i / NS + 1 : (i - T * NS) / NU;
    const int place = state ? t * NX + i % NS : t * NX + NS + (i - T * NS) % NU, last = state && t == T;
    const real nu = work->lam_w[i], low = work->lower[i], high = work->upper[i];
    const int two = isfinite(low) && isfinite(high);
    stationarity = larger(fabs((last ? work->slope_last[i % NS] : work->slope[place]) + nu), stationarity);
    scale = larger(fabs(last ? work->cost_last[i % NS] : work->cost[place]), scale);
    if (low == high) {
      violation = larger(fabs(w[i] - low), violation);
      continue;
    }
    if (isfinite(low)) add_bound(w[i] - low, two ? larger(-nu, 0) : -nu, &violation, &product);
    if (isfinite(high)) add_bound(high - w[i], two ? larger(nu, 0) : nu, &violation, &product);
  }
  for (i = 0; i < T * NH; ++i) add_bound(-work->path[i], work->lam_g[T * NS + i], &violation, &product);
  violation = larger(kpirl_mpc_largest(work->defects, T * NS), violation);
  scale = larger(kpirl_mpc_largest(work->lam_g, KPIRL_MPC_N_G), scale);
  kpirl_mpc_set_residuals(solution, stationarity, violation, product, scale);
}

void kpirl_mpc_run(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                   kpirl_mpc_solution *solution) {
  kpirl_mpc_workspace *work = &mpc->work;
  const real *arguments[8];
  real *results[6] = {NULL, NULL, NULL, NULL, NULL, NULL};
  fill_arguments(mpc, numbers, guess);
  arguments[0] = work->guess;
  arguments[1] = work->numbers;
  arguments[2] = work->lower;
  arguments[3] = work->upper;
  arguments[4] = work->lower_g;
  arguments[5] = work->upper_g;
  arguments[6] = work->guess_w;
  arguments[7] = work->guess_g;
  memcpy(work->point, numbers->state, NS * sizeof(real));
  memset(work->point + NS, 0, NW * sizeof(real));
  memset(work->lam_w, 0, sizeof work->lam_w);
  memset(work->lam_g, 0, sizeof work->lam_g);
  results[0] = work->point + NS;
  results[3] = work->lam_w;
  results[4] = work->lam_g;
  kpirl_mpc_call(mpc, kpirl_mpc_sqp_program, 8, arguments, 6, results);
  audit(mpc, numbers, solution);
  memcpy(solution->states, work->point, sizeof solution->states);
  memcpy(solution->actions, work->point + NS + T * NS, sizeof solution->actions);
  memcpy(solution->dynamics, work->lam_g, sizeof solution->dynamics);
  memcpy(solution->state_bounds, work->lam_w, sizeof solution->state_bounds);
  memcpy(solution->action_bounds, work->lam_w + T * NS, sizeof solution->action_bounds);
  memset(solution->path, 0, sizeof solution->path);
  if (NH > 0) memcpy(solution->path, work->lam_g + T * NS, T * NH * sizeof(real));
  solution->iterations = -1; /* it does not say */
  if (!kpirl_mpc_all_finite(work->point, NS + NW) || !isfinite(solution->residual))
    solution->status = KPIRL_MPC_NOT_FINITE;
  else
    solution->status = solution->residual <= mpc->settings.tolerance ? KPIRL_MPC_CONVERGED : KPIRL_MPC_FAILED;
}

kpirl_mpc_status kpirl_mpc_differentiate_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers,
                                              const kpirl_mpc_guess *guess, const kpirl_mpc_solution *solution,
                                              const real *by_states, const real *by_actions,
                                              kpirl_mpc_gradients *gradients) {
  (void)mpc, (void)numbers, (void)guess, (void)solution, (void)by_states, (void)by_actions, (void)gradients;
  return KPIRL_MPC_ERROR_UNSUPPORTED;
}
