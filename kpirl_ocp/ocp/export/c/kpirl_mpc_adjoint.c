/* SPDX-License-Identifier: MIT
 *
 * The derivative of a solution by the implicit function theorem. With v = (w, lambda, y, z, nu), p = (psi, s_0, c) and the
 * conditions F(v; p) = 0 of kpirl_mpc_newton.c at a fixed tau,
 *
 *     dL/dp = -vbar . dF/dp,    (dF/dv)' vbar = dL/dv:
 *
 * one step of the same Newton system, whose right-hand side is the gradient of L.
 */
#include "kpirl_mpc_newton.h"

#include <string.h>
#include <tgmath.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON };
enum { ROWS = KPIRL_MPC_N_ROWS, FORCES = KPIRL_MPC_N_FORCES, FIXED = KPIRL_MPC_N_FIXED };

typedef kpirl_mpc_real real;

static const real KKT_RESIDUAL = (real)1e-6; /* of a plan whose gradient is to be believed */

static real larger(real a, real b) { return a > b ? a : b; }
static real smaller(real a, real b) { return a < b ? a : b; }

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
  for (round = 0; round < (FIXED > 0 ? 2 : 1); ++round) {
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
  if (mpc->settings.barrier > 0) {
    work->tau = mpc->settings.barrier;
    kpirl_mpc_stand_at(mpc, numbers, &plan, work->tau);
  } else {
    work->tau = mpc->settings.tolerance / 10; /* the smoothed problem's gradient is off by O(tau) */
    kpirl_mpc_warm_start(mpc, numbers, &plan, work->tau);
  }
  kpirl_mpc_differentiate(mpc, numbers, 1);
  if (!kpirl_mpc_finite(mpc) || !kpirl_mpc_matrices_finite(mpc)) return KPIRL_MPC_NOT_FINITE;
  kpirl_mpc_residuals(mpc, mpc->settings.barrier, &work->scratch);
  found.residual = work->scratch.residual;
  solve_adjoint(mpc, by_states, by_actions);
  gradient_of_start(work, by_states, found.state);
  pull_back(mpc, numbers, &found);
  found.pivot = work->step.pivots[0];
  for (i = 1; i < T * NU; ++i) found.pivot = smaller(work->step.pivots[i], found.pivot);
  *gradients = found;
  if (!work->step.positive) return KPIRL_MPC_NOT_A_MINIMUM;
  return found.residual <= larger(KKT_RESIDUAL, mpc->settings.tolerance) ? KPIRL_MPC_CONVERGED : KPIRL_MPC_NOT_SOLVED;
}
