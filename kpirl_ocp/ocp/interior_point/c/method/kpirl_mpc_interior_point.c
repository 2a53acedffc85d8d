/* SPDX-License-Identifier: MIT
 *
 * The interior-point method: predictor-corrector steps (Mehrotra, 1992) until the first-order conditions hold, as long as
 * a filter accepts (Waechter and Biegler, 2006, sections 2.3 and 3.1); or a fixed number of full Newton steps, the
 * real-time iteration (Diehl et al., 2005).
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real SHORTEST = (real)1e-10;  /* step off a point that is no minimum */
static const real FAR = (real)1e12;       /* |x| beyond which an iterate has diverged */
static const real TOO_SHORT = (real)1e-2; /* length of a step that leads nowhere if it is one of */
static const int TOO_MANY = 40;           /* so many, one after the other */

static int all_known(const kpirl_mpc_core *core) {
  const kpirl_mpc_derivatives *d = &core->d;
  const int n_w = kpirl_mpc_n_point(core);
  return !core->failed && isfinite(d->objective) && kpirl_mpc_all_finite(d->cost_gradient, n_w) &&
         kpirl_mpc_all_finite(d->gradient, n_w) &&
         kpirl_mpc_all_finite(d->defects, DIM(core, horizon) * DIM(core, n_states)) &&
         kpirl_mpc_all_finite(d->g, kpirl_mpc_n_inequalities(core)) &&
         kpirl_mpc_all_finite(d->c, kpirl_mpc_n_equalities(core));
}

static int matrices_finite(const kpirl_mpc_core *core) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const kpirl_mpc_derivatives *d = &core->d;
  return kpirl_mpc_all_finite(d->F, n_s * n_x * T) && kpirl_mpc_all_finite(d->H, n_x * n_x * T + n_s * n_s) &&
         kpirl_mpc_all_finite(d->G, T * n_x * DIM(core, n_path) + n_s * DIM(core, n_terminal)) &&
         kpirl_mpc_all_finite(d->E, T * n_x * DIM(core, n_equality) + n_s * DIM(core, n_terminal_equality));
}

/* Is the time over? */
int kpirl_mpc_core_out_of_time(const kpirl_mpc_core *core) {
  const kpirl_mpc_options *options = &core->options;
  return options->now && options->time_limit > 0 && options->now(options->clock) - core->started >= options->time_limit;
}

/* ---- one solve ---------------------------------------------------------------------------------------------- */

void kpirl_mpc_log_iteration(const kpirl_mpc_core *core) {
  const kpirl_mpc_step *step = &core->step;
  kpirl_mpc_residuals residuals;
  kpirl_mpc_iteration line;
  if (!core->options.log) return;
  kpirl_mpc_find_residuals(core, 0, &residuals);
  line.iteration = core->iterations;
  line.trials = core->trials;
  line.restoring = core->penalty > 0;
  line.objective = core->d.objective;
  line.infeasibility = kpirl_mpc_largest_violation(core);
  line.dual_infeasibility = residuals.stationarity;
  line.complementarity = residuals.complementarity;
  line.tau = core->tau;
  line.step = kpirl_mpc_norm_inf(step->change.x, kpirl_mpc_n_point(core));
  line.regularisation = step->regularisation;
  line.primal_length = step->primal_length;
  line.dual_length = step->dual_length;
  core->options.log(core->options.log_to, &line);
}

static kpirl_mpc_status why_stuck(kpirl_mpc_core *core) {
  if (!matrices_finite(core)) return KPIRL_MPC_NOT_FINITE;
  if (kpirl_mpc_acceptable(core)) return KPIRL_MPC_ACCEPTABLE;
  return KPIRL_MPC_STALLED;
}

/* A solution is no minimum where the Hessian is not positive. Newton steps that needed no regularisation know that it is. */
static int to_be_examined(const kpirl_mpc_core *core) { return !core->step.positive || core->step.regularisation > 0; }

/* Have multipliers grown without bound, and left the point far from feasible? So they do where linearised constraints contradict
 * each other, also from a few points in turn. Near feasible points of a set without interior they grow as well, and are right. */
static int multipliers_diverged(kpirl_mpc_core *core) {
  return core->d.violation > core->filter.small && kpirl_mpc_too_heavy(core, core->at.z, 0, kpirl_mpc_n_inequalities(core));
}

/* Has the method crept for long, far from feasible points? */
static int creeps(kpirl_mpc_core *core) {
  const int crept = core->step.primal_length < TOO_SHORT && core->d.violation > core->filter.small;
  core->creeping = crept ? core->creeping + 1 : 0;
  return core->creeping >= TOO_MANY;
}

kpirl_mpc_status kpirl_mpc_converge(kpirl_mpc_core *core) {
  for (;; ++core->iterations) {
    if (!all_known(core)) return KPIRL_MPC_NOT_FINITE;
    if (kpirl_mpc_solved(core)) {
      const int left = to_be_examined(core) ? kpirl_mpc_escape(core, SHORTEST) : 0;
      if (left <= 0) return left ? KPIRL_MPC_NOT_A_MINIMUM : KPIRL_MPC_CONVERGED;
      kpirl_mpc_begin_here(core, core->options.barrier > 0 ? core->tau : kpirl_mpc_max(core->tau, kpirl_mpc_start_tau(core)));
      continue;
    }
    if (core->iterations >= core->options.max_iterations) return KPIRL_MPC_ITERATION_LIMIT;
    if (kpirl_mpc_core_out_of_time(core)) return KPIRL_MPC_TIME_LIMIT;
    if (kpirl_mpc_norm_inf(core->at.x, kpirl_mpc_n_point(core)) > FAR) return KPIRL_MPC_DIVERGED;
    if (kpirl_mpc_idle(core) && kpirl_mpc_acceptable(core)) return KPIRL_MPC_ACCEPTABLE;
    if (multipliers_diverged(core) || creeps(core)) return why_stuck(core);
    if (!kpirl_mpc_iterate_once(core, kpirl_mpc_final_tau(core))) return why_stuck(core);
    kpirl_mpc_log_iteration(core);
  }
}

/* Full Newton steps, cut only where a slack or multiplier would become negative. */
kpirl_mpc_status kpirl_mpc_advance(kpirl_mpc_core *core) {
  const int n_w = kpirl_mpc_n_point(core), m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  const int n_costates = DIM(core, horizon) * DIM(core, n_states);
  int i;
  for (; core->iterations < core->options.steps; ++core->iterations) {
    const kpirl_mpc_iterate *at = &core->at, *change = &core->step.change;
    real length, objective;
    if (!all_known(core)) return KPIRL_MPC_NOT_FINITE;
    if (kpirl_mpc_core_out_of_time(core)) return KPIRL_MPC_TIME_LIMIT;
    if (!kpirl_mpc_find_positive_step(core, 0, 0)) return why_stuck(core);
    length = core->step.primal_length;
    for (i = 0; i < n_w; ++i) core->trial.x[i] = at->x[i] + length * change->x[i];
    for (i = 0; i < n_costates; ++i) core->trial.costates[i] = at->costates[i] + length * change->costates[i];
    for (i = 0; i < m; ++i) core->trial.y[i] = at->y[i] + length * change->y[i];
    for (i = 0; i < n_c; ++i) core->trial.nu[i] = at->nu[i] + length * change->nu[i];
    if (m > kpirl_mpc_n_bounds(core)) /* h, for the slacks */
      kpirl_mpc_evaluate_values(core, core->trial.x, &objective, core->d.defects,
                                core->force + kpirl_mpc_n_bounds(core), core->d.equality);
    kpirl_mpc_accept_trial(core, core->iterations == core->options.steps - 1 ? KPIRL_MPC_FIRST : KPIRL_MPC_SECOND);
    kpirl_mpc_log_iteration(core);
  }
  if (!all_known(core)) return KPIRL_MPC_NOT_FINITE;
  return kpirl_mpc_solved(core) ? KPIRL_MPC_CONVERGED : KPIRL_MPC_STEPS_TAKEN;
}

kpirl_mpc_status kpirl_mpc_core_solve(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers,
                                      const kpirl_mpc_options *options, const kpirl_mpc_start *start,
                                      kpirl_mpc_residuals *residuals) {
  const real barrier = (real)options->barrier, tolerance = (real)options->tolerance;
  kpirl_mpc_status status;
  kpirl_mpc_set_numbers(core, numbers);
  core->options = *options;
  core->tolerance = tolerance; /* bounds multiplier * slack - tau: it has to be small beside tau */
  if (barrier > 0) core->tolerance = kpirl_mpc_min(tolerance, kpirl_mpc_max((real)1e-6 * barrier, (real)1e-13));
  core->penalty = 0;
  core->iterations = core->trials = 0;
  core->started = options->now ? options->now(options->clock) : 0;
  status = kpirl_mpc_attempt(core, start);
  kpirl_mpc_find_residuals(core, barrier, residuals);
  return status;
}
