/* SPDX-License-Identifier: MIT
 *
 * The derivative of a solution by the implicit function theorem. With v = (x, costates, y, z, nu), p = (psi, s_0, c) and the
 * conditions F(v; p) = 0 of kpirl_mpc_newton.c at a fixed tau,
 *
 *     dL/dp = -vbar . dF/dp,    (dF/dv)' vbar = dL/dv:
 *
 * one solve of the same linear-quadratic problem, with the gradient of L in the place of the right-hand side.
 */
#include "kpirl_mpc_interface.h"
#include "kpirl_mpc_method.h"

#include <string.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, NX = NS + NU, T = KPIRL_MPC_HORIZON };
enum { NH = KPIRL_MPC_N_PATH, NE = KPIRL_MPC_N_PATH_EQUALITY, NW = KPIRL_MPC_N_POINT };
enum { NHT = KPIRL_MPC_N_TERMINAL };
enum { NP = KPIRL_MPC_N_PARAMETERS, NC = KPIRL_MPC_N_CONTEXT };
enum { ROUNDS = 2 }; /* proximal steps, each of which leaves a share of about PROXIMAL of the equalities' multipliers */

static const real KKT_RESIDUAL = (real)1e-6; /* of a plan whose gradient is to be believed */

/* At a barrier, slacks and multipliers as they are at the plan; of bounds on both sides only the difference is known. */
static void set_central_multipliers(kpirl_mpc_core *core) {
  kpirl_mpc_iterate *at = &core->at;
  const int bounds = kpirl_mpc_n_bounds(core), m = kpirl_mpc_n_inequalities(core);
  int i;
  for (i = 0; i < m; ++i) {
    if (!(core->d.g[i] < 0)) continue;
    at->y[i] = -core->d.g[i];
    at->z[i] = i < bounds ? core->tau / at->y[i] : kpirl_mpc_max(at->z[i], 0);
  }
}

/* Make a plan the core's iterate, with second derivatives there. */
static void linearise_at(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_solution *solution) {
  kpirl_mpc_core *core = (kpirl_mpc_core *)mpc->work.core;
  const kpirl_mpc_guess plan = kpirl_mpc_resume(solution);
  const kpirl_mpc_start start = kpirl_mpc_take_guess(mpc, &plan);
  const real barrier = mpc->settings.barrier;
  const int bounds = kpirl_mpc_n_bounds(core);
  kpirl_mpc_set_numbers(core, numbers);
  core->options = kpirl_mpc_options_of(mpc);
  core->tau = barrier > 0 ? barrier : mpc->settings.tolerance / 10; /* the smoothed problem's gradient is off by O(tau) */
  kpirl_mpc_warm_start(core, &start, core->tau);
  if (barrier > 0) {
    memcpy(core->at.z + bounds, start.path, (size_t)(T * NH + NHT) * sizeof(real));
    set_central_multipliers(core);
  }
  kpirl_mpc_differentiate(core, KPIRL_MPC_SECOND);
}

/* vbar in core->step.change, but y, from the factors; slope: dL/dx. Equalities by proximal steps, from nu = 0. */
static void solve_adjoint(kpirl_mpc_core *core, const real *slope) {
  const kpirl_mpc_derivatives *d = &core->d;
  kpirl_mpc_iterate *v = &core->step.change;
  const int bounds = kpirl_mpc_n_bounds(core), m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  int i, round;
  memset(core->force, 0, (size_t)m * sizeof(real));
  memset(core->trial.costates, 0, T * NS * sizeof(real)); /* no defects */
  memset(core->start, 0, NS * sizeof(real));
  memset(v->nu, 0, (size_t)n_c * sizeof(real));
  for (round = 0; round < (n_c > 0 ? ROUNDS : 1); ++round) {
    for (i = 0; i < NW; ++i) core->right[i] = -slope[i];
    kpirl_mpc_bounds_transposed_times(core, core->force, v->nu, core->right);
    kpirl_mpc_equality_transposed_times(core, v->nu + core->n_fixed, core->right);
    kpirl_mpc_substitute(T, NS, NU, KPIRL_MPC_N_FREE, kpirl_mpc_exported_free, d->F, &core->factors, core->right,
                         core->trial.costates, core->start, core->scratch, v->x, v->costates);
    memset(core->trial.nu, 0, (size_t)n_c * sizeof(real));
    for (i = 0; i < core->n_fixed; ++i) core->trial.nu[i] = v->x[core->fixed[i]];
    kpirl_mpc_equality_times(core, v->x, core->trial.nu + core->n_fixed);
    kpirl_mpc_axpy(1 / KPIRL_MPC_PROXIMAL, core->trial.nu, n_c, v->nu);
  }
  memset(v->z, 0, (size_t)m * sizeof(real));
  kpirl_mpc_path_times(core, v->x, v->z + bounds);
  for (i = bounds; i < m; ++i) v->z[i] *= core->weights[i];
}

/* by_start = the s_0 part of H_0 x_0 + F_0' lambda_1 + G_0' z_0 + E_0' nu_0, for the given entries. */
static void gradient_of_start(kpirl_mpc_core *core, const real *direct, real *gradient) {
  const kpirl_mpc_derivatives *d = &core->d;
  const kpirl_mpc_iterate *v = &core->step.change;
  real sum[NX] = {0};
  int i;
  kpirl_mpc_symmetric_times_vector(d->H, NX, v->x, sum);
  kpirl_mpc_transposed_times_vector(d->F, NS, NX, v->costates, sum);
  if (NH > 0) kpirl_mpc_times_vector(d->G, NX, NH, v->z + kpirl_mpc_n_bounds(core), sum);
  if (NE > 0) kpirl_mpc_times_vector(d->E, NX, NE, v->nu + core->n_fixed, sum);
  for (i = 0; i < NS; ++i) gradient[i] = kpirl_mpc_is_given(i) ? direct[i] - sum[i] : 0;
}

/* gradients -= how psi and the context enter the conditions, weighted with the adjoint. */
static void pull_back(kpirl_mpc *mpc, kpirl_mpc_gradients *gradients) {
  const kpirl_mpc_core *core = (const kpirl_mpc_core *)mpc->work.core;
  const kpirl_mpc_iterate *at = &core->at, *v = &core->step.change;
  const int bounds = kpirl_mpc_n_bounds(core), fixed = core->n_fixed;
  real by_psi[KPIRL_MPC_AT_LEAST_ONE(NP)] = {0}, by_context[KPIRL_MPC_AT_LEAST_ONE(NC)] = {0};
  int t;
  for (t = 0; t <= T; ++t) {
    kpirl_mpc_pull_arguments from = {0};
    kpirl_mpc_pull_results to = {0};
    from.x = at->x + t * NX;
    from.psi = core->numbers.psi;
    from.context = core->numbers.context;
    from.schedule = core->numbers.schedule + t * KPIRL_MPC_N_SCHEDULE;
    from.costates = at->costates + t * NS;
    from.z = at->z + bounds + t * NH;
    from.nu = at->nu + fixed + t * NE;
    from.dx = v->x + t * NX;
    from.dcostates = v->costates + t * NS;
    from.dz = v->z + bounds + t * NH;
    from.dnu = v->nu + fixed + t * NE;
    to.by_psi = by_psi;
    to.by_context = by_context;
    (void)(t < T ? kpirl_mpc_stage_pull : kpirl_mpc_last_pull)(&mpc->scratch, &from, &to);
    kpirl_mpc_axpy(-1, by_psi, NP, gradients->psi);
    kpirl_mpc_axpy(-1, by_context, NC, gradients->context);
  }
}

kpirl_mpc_status kpirl_mpc_differentiate_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers,
                                              const kpirl_mpc_guess *guess, const kpirl_mpc_solution *solution,
                                              const real *by_states, const real *by_actions,
                                              kpirl_mpc_gradients *gradients) {
  kpirl_mpc_core *core = (kpirl_mpc_core *)mpc->work.core;
  const int n_pivots = T * NU, n_free = KPIRL_MPC_N_FREE;
  kpirl_mpc_gradients found;
  kpirl_mpc_residuals residuals;
  int positive, i;
  (void)guess;
  memset(&found, 0, sizeof found);
  linearise_at(mpc, numbers, solution);
  kpirl_mpc_find_residuals(core, mpc->settings.barrier, &residuals);
  found.residual = kpirl_mpc_relative_residual(residuals.stationarity, residuals.feasibility, residuals.complementarity,
                                               residuals.scale);
  positive = kpirl_mpc_factorise(core, 0);
  kpirl_mpc_interleave(by_states, by_actions, mpc->work.x);
  solve_adjoint(core, mpc->work.x);
  gradient_of_start(core, by_states, found.state);
  pull_back(mpc, &found);
  found.pivot = (real)INFINITY;
  for (i = 0; i < n_pivots; ++i) found.pivot = kpirl_mpc_min(core->factors.pivots[i], found.pivot);
  for (i = 0; i < n_free; ++i) found.pivot = kpirl_mpc_min(core->factors.free_pivots[i], found.pivot);
  if (core->failed || !isfinite(found.residual) || !kpirl_mpc_all_finite(found.psi, NP) ||
      !kpirl_mpc_all_finite(found.state, NS) || !kpirl_mpc_all_finite(found.context, NC))
    return KPIRL_MPC_NOT_FINITE;
  *gradients = found;
  if (!positive) return KPIRL_MPC_NOT_A_MINIMUM;
  return found.residual <= kpirl_mpc_max(KKT_RESIDUAL, mpc->settings.tolerance) ? KPIRL_MPC_CONVERGED
                                                                                   : KPIRL_MPC_NOT_SOLVED;
}
