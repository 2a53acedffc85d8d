/* SPDX-License-Identifier: MIT
 *
 * Gradient descent on the actions: U <- P(U - alpha dJ/dU(U)), P the projection onto the action bounds, a fixed number of
 * times; and its derivative, back through the same steps: w = P' v, v <- w - alpha (d2J/dU2) w.
 */
#include "kpirl_mpc_controller.h"

#include <string.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON, N = KPIRL_MPC_N_U };
enum { NP = KPIRL_MPC_N_PARAMETERS, NC = KPIRL_MPC_N_CONTEXT };

static const real ALPHA = (real)KPIRL_MPC_STEP_SIZE;

int kpirl_mpc_begin(kpirl_mpc *mpc) {
  (void)mpc;
  return 1;
}

int kpirl_mpc_knows(const kpirl_mpc_settings *settings) {
  return settings->steps >= 1 && settings->steps <= KPIRL_MPC_MAX_ITERATIONS && settings->barrier <= 0;
}

int kpirl_mpc_follows_schedules(void) { return 0; }

/* The bound of entry i of U. */
static real bound(const real *bounds, int i) { return bounds[i / NU * (NS + NU) + NS + i % NU]; }

/* J and dJ/dU at U. */
static real evaluate(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const real *actions, real *states, real *costates) {
  kpirl_mpc_descent_point_arguments at = {0};
  kpirl_mpc_descent_point_results to = {0};
  real cost = 0;
  at.actions = actions;
  at.state = numbers->s0;
  at.psi = numbers->psi;
  at.context = numbers->context;
  to.cost = &cost;
  to.gradient = mpc->work.gradient;
  to.states = states;
  to.costates = costates;
  (void)kpirl_mpc_descent_point(&mpc->scratch, &at, &to);
  return cost;
}

/* next = P(U - alpha g); written with comparisons, so that NaN stays. */
static void step(const kpirl_mpc *mpc, const real *actions, real *next) {
  int i;
  for (i = 0; i < N; ++i) {
    const real low = bound(mpc->lower, i), high = bound(mpc->upper, i);
    next[i] = actions[i] - ALPHA * mpc->work.gradient[i];
    if (next[i] < low) next[i] = low;
    if (next[i] > high) next[i] = high;
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
    if (kpirl_mpc_out_of_time(mpc)) break;
    step(mpc, work->actions[k], work->actions[k + 1]);
  }
  return k;
}

/* Where an action lies on a bound and the slope pushes it outwards, the bound pushes back. */
static void find_multipliers(const kpirl_mpc *mpc, const real *actions, real *pushing) {
  int i;
  for (i = 0; i < N; ++i) {
    const real slope = mpc->work.gradient[i];
    const int outwards = (actions[i] >= bound(mpc->upper, i) && slope < 0) || (actions[i] <= bound(mpc->lower, i) && slope > 0);
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

void kpirl_mpc_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                    kpirl_mpc_solution *solution) {
  kpirl_mpc_workspace *work = &mpc->work;
  real initial = 0, sizes[3], stationarity[N];
  const real *final;
  int i;
  const int taken = descend(mpc, numbers, guess, &initial);
  memset(solution, 0, sizeof *solution);
  solution->iterations = taken;
  final = work->actions[taken];
  solution->objective = evaluate(mpc, numbers, final, work->states, work->costates);
  memcpy(solution->states, work->states, sizeof solution->states);
  memcpy(solution->actions, final, sizeof solution->actions);
  memcpy(solution->dynamics, work->costates, sizeof solution->dynamics);
  find_multipliers(mpc, final, solution->action_bounds);
  for (i = 0; i < N; ++i) stationarity[i] = work->gradient[i] + solution->action_bounds[i];
  sizes[0] = 1;
  sizes[1] = kpirl_mpc_norm_inf(work->gradient, N);
  sizes[2] = kpirl_mpc_norm_inf(work->costates, T * NS);
  kpirl_mpc_set_residuals(solution, kpirl_mpc_norm_inf(stationarity, N), 0, 0, kpirl_mpc_norm_inf(sizes, 3));
  solution->status = status_of(mpc, solution, initial);
}

/* ---- the derivative of the steps ---------------------------------------------------------------------------- */

/* dL/dU, and L by psi and s_0 at fixed U, at the last actions. */
static void start_back(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const real *actions, const real *by_states,
                       const real *by_actions, kpirl_mpc_gradients *gradients) {
  kpirl_mpc_descent_slope_arguments at = {0};
  kpirl_mpc_descent_slope_results to = {0};
  at.actions = actions;
  at.state = numbers->s0;
  at.psi = numbers->psi;
  at.context = numbers->context;
  at.by_states = by_states;
  at.by_actions = by_actions;
  to.slope = mpc->work.adjoint;
  to.by_psi = gradients->psi;
  to.by_state = gradients->state;
  (void)kpirl_mpc_descent_slope(&mpc->scratch, &at, &to);
}

/* One step back from U_{k+1} to U_k. */
static void step_back(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const real *actions, kpirl_mpc_gradients *gradients) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_descent_back_arguments at = {0};
  kpirl_mpc_descent_back_results to = {0};
  kpirl_mpc_gradients share;
  int i;
  (void)evaluate(mpc, numbers, actions, NULL, NULL);
  for (i = 0; i < N; ++i) {
    const real free = actions[i] - ALPHA * work->gradient[i];
    const int outside = free < bound(mpc->lower, i) || free > bound(mpc->upper, i);
    work->masked[i] = outside ? 0 : work->adjoint[i];
  }
  at.actions = actions;
  at.state = numbers->s0;
  at.psi = numbers->psi;
  at.context = numbers->context;
  at.direction = work->masked;
  to.product = work->product;
  to.by_psi = share.psi;
  to.by_context = share.context;
  to.by_state = share.state;
  (void)kpirl_mpc_descent_back(&mpc->scratch, &at, &to);
  for (i = 0; i < N; ++i) work->adjoint[i] = work->masked[i] - ALPHA * work->product[i];
  kpirl_mpc_axpy(-ALPHA, share.psi, NP, gradients->psi);
  kpirl_mpc_axpy(-ALPHA, share.context, NC, gradients->context);
  kpirl_mpc_axpy(-ALPHA, share.state, NS, gradients->state);
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
  if (!kpirl_mpc_all_finite(found.psi, NP) || !kpirl_mpc_all_finite(found.state, NS) ||
      !kpirl_mpc_all_finite(found.context, NC))
    return KPIRL_MPC_NOT_FINITE;
  *gradients = found;
  /* Other actions than these steps lead to have another derivative. */
  return memcmp(work->actions[steps], solution->actions, sizeof solution->actions) ? KPIRL_MPC_NOT_SOLVED
                                                                                   : KPIRL_MPC_CONVERGED;
}
