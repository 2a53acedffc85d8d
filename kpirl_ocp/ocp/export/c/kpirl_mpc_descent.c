/* SPDX-License-Identifier: MIT
 *
 * Gradient descent on the actions: U <- P(U - alpha dJ/dU(U)), P the projection onto the action bounds, a fixed number of
 * times; and its derivative, back through the same steps: w = P' v, v <- w - alpha (d2J/dU2) w.
 */
#include "kpirl_mpc_memory.h"

#include <string.h>
#include <tgmath.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON, N = KPIRL_MPC_N_U };
enum { NP = KPIRL_MPC_N_PARAMETERS, NC = KPIRL_MPC_N_CONTEXT };

typedef kpirl_mpc_real real;

static const real ALPHA = (real)KPIRL_MPC_STEP_SIZE;

kpirl_mpc_status kpirl_mpc_check_settings(const kpirl_mpc_settings *settings) {
  return settings->steps >= 1 && settings->steps <= KPIRL_MPC_MAX_ITERATIONS && settings->barrier <= 0
             ? KPIRL_MPC_CONVERGED
             : KPIRL_MPC_ERROR_UNSUPPORTED;
}

/* J and dJ/dU at U. */
static real evaluate(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const real *actions, real *states, real *costates) {
  const real *arguments[4];
  real *results[4], value = 0;
  arguments[0] = actions;
  arguments[1] = numbers->state;
  arguments[2] = numbers->psi;
  arguments[3] = numbers->context;
  results[0] = &value;
  results[1] = mpc->work.gradient;
  results[2] = states;
  results[3] = costates;
  kpirl_mpc_call(mpc, kpirl_mpc_descent_point, 4, arguments, 4, results);
  return value;
}

/* next = P(U - alpha g); written with comparisons, so that NaN stays. */
static void step(const kpirl_mpc *mpc, const real *actions, real *next) {
  const kpirl_mpc_bounds *bounds = &mpc->bounds;
  int i;
  for (i = 0; i < N; ++i) {
    next[i] = actions[i] - ALPHA * mpc->work.gradient[i];
    if (next[i] < bounds->action_lower[i % NU]) next[i] = bounds->action_lower[i % NU];
    if (next[i] > bounds->action_upper[i % NU]) next[i] = bounds->action_upper[i % NU];
  }
}

/* All steps; `initial` is the cost of the first actions. Returns how many were taken before the clock ran out. */
static int descend(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess, real *initial) {
  kpirl_mpc_workspace *work = &mpc->work;
  int k;
  if (guess)
    memmove(work->actions[0], guess->actions, sizeof work->actions[0]);
  else
    memset(work->actions[0], 0, sizeof work->actions[0]);
  for (k = 0; k < mpc->settings.steps; ++k) {
    const real cost = evaluate(mpc, numbers, work->actions[k], NULL, NULL);
    if (k == 0) *initial = cost;
    if (kpirl_mpc_late(mpc)) break;
    step(mpc, work->actions[k], work->actions[k + 1]);
  }
  return k;
}

/* Where an action lies on a bound and the slope pushes it outwards, the bound pushes back. */
static void find_multipliers(const kpirl_mpc *mpc, const real *actions, real *pushing) {
  const kpirl_mpc_bounds *bounds = &mpc->bounds;
  int i;
  for (i = 0; i < N; ++i) {
    const real slope = mpc->work.gradient[i];
    const int outwards = (actions[i] >= bounds->action_upper[i % NU] && slope < 0) ||
                         (actions[i] <= bounds->action_lower[i % NU] && slope > 0);
    pushing[i] = outwards ? -slope : 0;
  }
}

static kpirl_mpc_status status_of(const kpirl_mpc *mpc, const kpirl_mpc_solution *at, real initial) {
  const int finite = kpirl_mpc_all_finite(at->states, (T + 1) * NS) && kpirl_mpc_all_finite(at->actions, N) &&
                     isfinite(at->objective) && isfinite(at->residual);
  if (!finite) return isfinite(initial) ? KPIRL_MPC_DIVERGED : KPIRL_MPC_NOT_FINITE;
  if (at->iterations < mpc->settings.steps) return KPIRL_MPC_TIME_LIMIT;
  if (at->residual <= mpc->settings.tolerance) return KPIRL_MPC_CONVERGED;
  return at->objective <= initial ? KPIRL_MPC_STEPS_TAKEN : KPIRL_MPC_DIVERGED;
}

void kpirl_mpc_run(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                   kpirl_mpc_solution *solution) {
  kpirl_mpc_workspace *work = &mpc->work;
  real initial = 0, sizes[3], stationarity[KPIRL_MPC_N_U];
  const real *final;
  int i;
  solution->iterations = descend(mpc, numbers, guess, &initial);
  final = work->actions[solution->iterations];
  solution->objective = evaluate(mpc, numbers, final, work->states, work->costates);
  memcpy(solution->states, work->states, sizeof solution->states);
  memcpy(solution->actions, final, sizeof solution->actions);
  memcpy(solution->dynamics, work->costates, sizeof solution->dynamics);
  memset(solution->state_bounds, 0, sizeof solution->state_bounds);
  memset(solution->path, 0, sizeof solution->path);
  find_multipliers(mpc, final, solution->action_bounds);
  for (i = 0; i < N; ++i) stationarity[i] = work->gradient[i] + solution->action_bounds[i];
  sizes[0] = 1;
  sizes[1] = kpirl_mpc_largest(work->gradient, N);
  sizes[2] = kpirl_mpc_largest(work->costates, T * NS);
  kpirl_mpc_set_residuals(solution, kpirl_mpc_largest(stationarity, N), 0, 0, kpirl_mpc_largest(sizes, 3));
  solution->status = status_of(mpc, solution, initial);
}

/* ---- the derivative of the steps ---------------------------------------------------------------------------- */

/* dL/dU, and L by psi and s_0 at fixed U, at the last actions. */
static void start_back(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const real *actions, const real *by_states,
                       const real *by_actions, kpirl_mpc_gradients *gradients) {
  const real *arguments[6];
  real *results[3];
  arguments[0] = actions;
  arguments[1] = numbers->state;
  arguments[2] = numbers->psi;
  arguments[3] = numbers->context;
  arguments[4] = by_states;
  arguments[5] = by_actions;
  results[0] = mpc->work.adjoint;
  results[1] = gradients->psi;
  results[2] = gradients->state;
  kpirl_mpc_call(mpc, kpirl_mpc_descent_slope, 6, arguments, 3, results);
}

/* One step back from U_{k+1} to U_k. */
static void step_back(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const real *actions, kpirl_mpc_gradients *gradients) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_gradients share;
  const real *arguments[5];
  real *results[5];
  int i;
  evaluate(mpc, numbers, actions, NULL, NULL);
  for (i = 0; i < N; ++i) {
    const real free = actions[i] - ALPHA * work->gradient[i];
    const int outside = free < mpc->bounds.action_lower[i % NU] || free > mpc->bounds.action_upper[i % NU];
    work->masked[i] = outside ? 0 : work->adjoint[i];
  }
  arguments[0] = actions;
  arguments[1] = numbers->state;
  arguments[2] = numbers->psi;
  arguments[3] = numbers->context;
  arguments[4] = work->masked;
  results[0] = NULL;
  results[1] = work->product;
  results[2] = share.psi;
  results[3] = share.context;
  results[4] = share.state;
  kpirl_mpc_call(mpc, kpirl_mpc_descent_back, 5, arguments, 5, results);
  for (i = 0; i < N; ++i) work->adjoint[i] = work->masked[i] - ALPHA * work->product[i];
  for (i = 0; i < NP; ++i) gradients->psi[i] -= ALPHA * share.psi[i];
  for (i = 0; i < NC; ++i) gradients->context[i] -= ALPHA * share.context[i];
  for (i = 0; i < NS; ++i) gradients->state[i] -= ALPHA * share.state[i];
}

kpirl_mpc_status kpirl_mpc_differentiate_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers,
                                              const kpirl_mpc_guess *guess, const kpirl_mpc_solution *solution,
                                              const real *by_states, const real *by_actions,
                                              kpirl_mpc_gradients *gradients) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_gradients found;
  real initial = 0;
  int k, steps;
  memset(&found, 0, sizeof found);
  steps = descend(mpc, numbers, guess, &initial);
  if (!kpirl_mpc_all_finite(work->actions[steps], N)) return KPIRL_MPC_NOT_FINITE;
  start_back(mpc, numbers, work->actions[steps], by_states, by_actions, &found);
  for (k = steps; k-- > 0;) step_back(mpc, numbers, work->actions[k], &found);
  found.residual = solution->residual;
  *gradients = found;
  /* Other actions than these steps lead to have another derivative. */
  return memcmp(work->actions[steps], solution->actions, sizeof solution->actions) ? KPIRL_MPC_NOT_SOLVED
                                                                                   : KPIRL_MPC_CONVERGED;
}
