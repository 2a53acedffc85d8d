/* SPDX-License-Identifier: MIT
 *
 * Where the method begins, and where it begins again when it gets stuck.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real WARM = (real)1e-3; /* largest tau of a warm start */
static const real FAR_OFF = 10;      /* violation, relative to that of the guess */
static const int RESTORATIONS = 5;   /* in one attempt */
static const real MUCH = 10;         /* regularisation, in units of the Hessian where it is small, of one that is far from positive */
static const real ALIKE = 4;         /* times as much is about as much */

/* As small as the guess is good, so that a solution stays one; at most WARM, so that a guess counts. */
static real warm_barrier(kpirl_mpc_core *core, const kpirl_mpc_start *start) {
  const real final = (real)core->options.tolerance / 10;
  kpirl_mpc_residuals residuals;
  real error;
  kpirl_mpc_warm_start(core, start, final);
  kpirl_mpc_differentiate(core, KPIRL_MPC_FIRST);
  kpirl_mpc_find_residuals(core, 0, &residuals);
  error = kpirl_mpc_worst(&residuals);
  return isfinite(error) ? kpirl_mpc_min(kpirl_mpc_max(error, final), WARM) : WARM;
}

/* The sum of all violations, as they were stated. */
static real stated_violation(const kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core), n_s = DIM(core, n_states);
  const int n_d = DIM(core, horizon) * n_s;
  real sum = 0;
  int i;
  for (i = 0; i < m; ++i) sum += kpirl_mpc_max(core->d.g[i], 0);
  for (i = 0; i < n_c; ++i) sum += kpirl_mpc_abs(core->d.c[i]);
  for (i = 0; i < n_d; ++i) sum += kpirl_mpc_abs(core->d.defects[i]);
  for (i = 0; i < n_s; ++i) sum += kpirl_mpc_abs(core->d.gap[i]);
  return sum;
}

/* With the multipliers of the start. */
static void begin_warm(kpirl_mpc_core *core, const kpirl_mpc_start *start) {
  const real barrier = (real)core->options.barrier, tau = barrier > 0 ? barrier : warm_barrier(core, start);
  kpirl_mpc_warm_start(core, start, tau);
  core->no_costates = 0;
  kpirl_mpc_begin_here(core, tau);
}

/* For the start of tau: with F where something is free at the start. */
static void differentiate_at_start(kpirl_mpc_core *core) {
  kpirl_mpc_differentiate(core, core->bounds.n_free > 0 ? KPIRL_MPC_SECOND : KPIRL_MPC_FIRST);
}

/* From the trajectory of the start, without costates; with light multipliers, see kpirl_mpc_begin_lightly. */
static void begin_cold(kpirl_mpc_core *core, const kpirl_mpc_start *start) {
  const real barrier = (real)core->options.barrier;
  kpirl_mpc_cold_start(core, start->x);
  core->no_costates = 1;
  if (barrier > 0) {
    kpirl_mpc_begin_here(core, barrier);
    return;
  }
  differentiate_at_start(core);
  kpirl_mpc_begin_lightly(core, kpirl_mpc_start_tau(core));
}

/* The same with the costates that are stationary there: the Hessian is that of the problem, and steps are short where it is not
 * positive. */
static void begin_with_costates(kpirl_mpc_core *core, const kpirl_mpc_start *start) {
  begin_cold(core, start);
  kpirl_mpc_estimate_costates(core);
  core->no_costates = 0;
  kpirl_mpc_differentiate(core, KPIRL_MPC_SECOND);
}

static int stuck(kpirl_mpc_status status) {
  return status == KPIRL_MPC_STALLED || status == KPIRL_MPC_INFEASIBLE || status == KPIRL_MPC_DIVERGED ||
         status == KPIRL_MPC_NOT_FINITE;
}

/* Stuck, but neither because there is no solution nor at the start. */
static int given_up(const kpirl_mpc_core *core, kpirl_mpc_status status) {
  return stuck(status) && status != KPIRL_MPC_INFEASIBLE && (status != KPIRL_MPC_NOT_FINITE || core->iterations > 0);
}

int kpirl_mpc_lifts(const kpirl_mpc_core *core) { return core->lifted && !core->options.steps && core->penalty <= 0; }

int kpirl_mpc_off_dynamics(const kpirl_mpc_core *core) {
  return kpirl_mpc_lifts(core) &&
         kpirl_mpc_norm_in_sizes(core, core->d.defects, DIM(core, horizon)) > core->filter.small;
}

/* Are constraints violated far more than where the method began? What is stationary there says nothing of the problem. */
static int far_off(const kpirl_mpc_core *core) { return stated_violation(core) > FAR_OFF * core->first_violation; }

/* With feasibility restoration where the method gets stuck. A point off the dynamics would show nothing of others. */
static kpirl_mpc_status converge_restoring(kpirl_mpc_core *core) {
  kpirl_mpc_status status = kpirl_mpc_converge(core);
  int i;
  for (i = 0; i < RESTORATIONS && stuck(status); ++i) {
    const kpirl_mpc_restoration restoration = kpirl_mpc_restore(core);
    if (restoration == KPIRL_MPC_SHOWN_INFEASIBLE) return far_off(core) ? KPIRL_MPC_STALLED : KPIRL_MPC_INFEASIBLE;
    if (core->iterations >= core->options.max_iterations) return KPIRL_MPC_ITERATION_LIMIT;
    if (kpirl_mpc_core_out_of_time(core)) return KPIRL_MPC_TIME_LIMIT;
    if (restoration == KPIRL_MPC_NOT_RESTORED) return status;
    kpirl_mpc_begin_here(core, kpirl_mpc_min(core->tau, kpirl_mpc_start_tau(core)));
    status = kpirl_mpc_converge(core);
  }
  return status;
}

/* Replace states of the guess by those that its actions lead to; 0 where that changes nothing or they are not finite. */
static int roll_guess_out(kpirl_mpc_core *core, const kpirl_mpc_start *guess, kpirl_mpc_start *rolled) {
  const size_t size = (size_t)kpirl_mpc_n_point(core) * sizeof(real);
  real *x = core->trial.x;
  *rolled = *guess;
  rolled->x = x;
  if (!guess->x) return 0;
  memcpy(x, guess->x, size);
  kpirl_mpc_roll_out(core, x);
  return kpirl_mpc_all_finite(x, kpirl_mpc_n_point(core)) && memcmp(x, guess->x, size) != 0;
}

/* Begin again from where the method stands, without its costates and multipliers. */
static void begin_again(kpirl_mpc_core *core) {
  memset(core->at.costates, 0, (size_t)(DIM(core, horizon) * DIM(core, n_states)) * sizeof(real));
  core->no_costates = 1;
  differentiate_at_start(core);
  kpirl_mpc_begin_here(core, kpirl_mpc_start_tau(core));
}

/* The first iteration; KPIRL_MPC_ITERATION_LIMIT where it is not the last. */
static kpirl_mpc_status take_one(kpirl_mpc_core *core) {
  const int most = core->options.max_iterations;
  kpirl_mpc_status status;
  if (core->iterations < most) core->options.max_iterations = core->iterations + 1;
  status = kpirl_mpc_converge(core);
  core->options.max_iterations = most;
  return status;
}

/* After a first step without costates: is the Hessian with those that it led to far from positive, and would about its regularisation be
 * enough at the guess, with costates that are stationary there? Then what the step left out decides, and it is taken back: begin there.
 * Else the method goes on from where it is. Returns whether it was taken back. */
static int take_back(kpirl_mpc_core *core, const kpirl_mpc_start *guess) {
  const real tau = core->tau, violation = core->most_violation, gradient = core->most_gradient;
  const kpirl_mpc_iterate reached = core->at;
  real enough;
  core->factored = kpirl_mpc_factorise(core, 0);
  if (core->factored) return 0;
  enough = kpirl_mpc_find_positive_step(core, 0, 1) ? core->step.regularisation : (real)INFINITY;
  core->regularisation = 0;
  if (enough <= MUCH * kpirl_mpc_unit_weight(core)) return 0;
  core->at = core->first.change; /* no step needs it before the next */
  core->first.change = reached;
  begin_with_costates(core, guess);
  if (isinf(enough) || kpirl_mpc_factorise(core, ALIKE * enough)) return 1;
  core->first.change = core->at;
  core->at = reached;
  core->tau = tau;
  core->most_violation = violation;
  core->most_gradient = gradient;
  kpirl_mpc_differentiate(core, KPIRL_MPC_SECOND);
  kpirl_mpc_start_filter(core);
  return 0;
}

/* Would begin_with_costates begin elsewhere than begin_cold, after which this is asked? Not where the costates would be of no use. */
static int has_costates(kpirl_mpc_core *core) {
  real *costates = core->at.costates;
  const int count = DIM(core, horizon) * DIM(core, n_states);
  int has;
  kpirl_mpc_estimate_costates(core);
  has = kpirl_mpc_norm_inf(costates, count) > 0;
  memset(costates, 0, (size_t)count * sizeof(real));
  return has;
}

/* Lifted from the guess, without costates, unless the Hessian is not positive then (see kpirl_mpc_iterate_once), or what it lacks
 * decides; where that gets stuck, once more with them, but not where no Hessian on the way lacked anything. */
static kpirl_mpc_status lift(kpirl_mpc_core *core, const kpirl_mpc_start *guess) {
  kpirl_mpc_status status;
  int bare;
  core->lifted = 1;
  begin_cold(core, guess);
  core->first_violation = stated_violation(core);
  core->factored = core->factored || kpirl_mpc_factorise(core, 0);
  bare = core->factored && has_costates(core);
  status = take_one(core);
  if (status == KPIRL_MPC_ITERATION_LIMIT && core->iterations < core->options.max_iterations) {
    if (bare && take_back(core, guess)) bare = 0;
    status = kpirl_mpc_converge(core);
  }
  if (!bare || !given_up(core, status)) return status;
  if (status == KPIRL_MPC_STALLED && !core->indefinite) return status;
  begin_with_costates(core, guess);
  return kpirl_mpc_converge(core);
}

/* Along the dynamics from where lifted steps got stuck, for half of the iterations that are left. */
static kpirl_mpc_status go_on(kpirl_mpc_core *core) {
  const int most = core->options.max_iterations;
  kpirl_mpc_status status;
  begin_again(core);
  core->options.max_iterations = core->iterations + (most - core->iterations) / 2;
  status = converge_restoring(core);
  core->options.max_iterations = most;
  return status;
}

/* Along the dynamics: from where lifted steps got stuck if no length of a step was accepted there, unless that shows a point to be
 * infeasible, which says nothing of others of a problem that does not look convex; then with costates, from the guess and from where its
 * actions lead. */
static kpirl_mpc_status follow(kpirl_mpc_core *core, const kpirl_mpc_start *guess, kpirl_mpc_status status) {
  kpirl_mpc_start rolled;
  core->lifted = 0;
  if (status == KPIRL_MPC_STALLED && core->step.positive) {
    status = go_on(core);
    if (status == KPIRL_MPC_INFEASIBLE && !core->indefinite) return status;
    if (!stuck(status) && (status != KPIRL_MPC_ITERATION_LIMIT || core->iterations >= core->options.max_iterations)) return status;
  }
  begin_with_costates(core, guess);
  status = converge_restoring(core);
  if (!given_up(core, status) || !roll_guess_out(core, guess, &rolled)) return status;
  begin_with_costates(core, &rolled);
  return converge_restoring(core);
}

/* With lifted steps; where they get stuck, along the dynamics. A warm start that gets stuck begins again first, cold, from its
 * trajectory. */
kpirl_mpc_status kpirl_mpc_attempt(kpirl_mpc_core *core, const kpirl_mpc_start *start) {
  kpirl_mpc_status status;
  core->lifted = 1;
  if (start->costates)
    begin_warm(core, start);
  else if (core->options.steps)
    begin_cold(core, start);
  if (core->options.steps) return kpirl_mpc_advance(core);
  if (start->costates) {
    status = kpirl_mpc_converge(core);
    if (!stuck(status)) return status;
  }
  status = lift(core, start);
  return given_up(core, status) ? follow(core, start, status) : status;
}
