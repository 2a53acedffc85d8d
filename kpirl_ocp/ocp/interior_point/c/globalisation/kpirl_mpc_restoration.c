/* SPDX-License-Identifier: MIT
 *
 * Feasibility restoration (Waechter and Biegler, 2006, section 3.3): where linearised constraints leave no room for a step, the
 * problem with elastic constraints is solved until most of the violation is gone. What is left for the largest penalty is
 * stationary for the violation.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real FIRST = (real)1e3, LAST = (real)1e7; /* penalties, relative to the gradient of J */
static const real LEFT = (real)0.01;    /* share of the violation that is left where the method proper goes on */
static const real SOLVED = 10;          /* products of slacks and multipliers of a barrier problem that is, relative to tau */
static const real LITTLE = (real)0.1;   /* share of the violation of a convex problem that may be unproved */
static const real LOWERED = (real)0.035, CAUTIOUS = (real)0.07; /* factors of tau: as long as every Hessian was positive; then */
static const real LAST_TAU = (real)1e-4; /* the last tau relative to the first */

/* The largest violation of a constraint, in units of core->row_sizes. */
static real violation(const kpirl_mpc_core *core) {
  const kpirl_mpc_derivatives *d = &core->d;
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core), n_s = DIM(core, n_states);
  real most = kpirl_mpc_norm_inf(d->defects, DIM(core, horizon) * n_s);
  int i;
  most = kpirl_mpc_max(kpirl_mpc_norm_inf(d->gap, n_s), most);
  for (i = 0; i < m; ++i) most = kpirl_mpc_max(d->g[i] / core->row_sizes[i], most);
  for (i = 0; i < n_c; ++i) most = kpirl_mpc_max(kpirl_mpc_abs(d->c[i]) / core->row_sizes[m + i], most);
  return most;
}

/* Another tau, with the multipliers of the last one. */
static void begin_barrier_problem(kpirl_mpc_core *core, real tau) {
  core->tau = tau;
  kpirl_mpc_weigh_elastic(core);
  kpirl_mpc_differentiate(core, KPIRL_MPC_SECOND);
  kpirl_mpc_start_filter(core);
}

/* Where the barrier problem is solved: do all its logarithms together, of which each leaves at most tau of a convex problem's penalty,
 * leave little of it? Then most of the violation cannot go. */
static int beyond_duality_gap(const kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  real sum = 0;
  int logarithms = 2 * n_c, i;
  for (i = 0; i < m; ++i) {
    const int elastic = kpirl_mpc_is_elastic(core, i);
    if (elastic) sum += kpirl_mpc_max(core->d.g[i] / core->row_sizes[i], 0);
    logarithms += elastic ? 2 : 1;
  }
  for (i = 0; i < n_c; ++i) sum += kpirl_mpc_abs(core->d.c[i]) / core->row_sizes[m + i];
  return logarithms * core->tau < LITTLE * core->penalty * sum;
}

static int barrier_problem_solved(const kpirl_mpc_core *core) {
  return kpirl_mpc_subproblem_solved(core) && kpirl_mpc_elastic_complementarity(core) <= SOLVED * core->tau;
}

/* Was the last step a whole one, which promised less than tau? Residuals alone depend on the units of x. */
static int settled(const kpirl_mpc_core *core) { return core->step.primal_length == 1 && -core->step.slope <= core->tau; }

/* Solve barrier problems of falling tau, down to the last, until no violation is larger than `enough`. In the first, tau weighs as much as
 * the violation: its solution is of no use. */
static kpirl_mpc_restoration descend(kpirl_mpc_core *core, real last, real enough) {
  int first = 1, solved = 0;
  for (;;) {
    if (violation(core) <= enough) return KPIRL_MPC_RESTORED;
    if (barrier_problem_solved(core)) {
      const int final = core->tau <= last || (!core->indefinite && beyond_duality_gap(core));
      if (final && solved) return KPIRL_MPC_SHOWN_INFEASIBLE;
      if (!final && (solved || first)) {
        begin_barrier_problem(core, (core->indefinite ? CAUTIOUS : LOWERED) * core->tau);
        first = solved = 0;
        continue;
      }
    }
    if (core->iterations >= core->options.max_iterations || kpirl_mpc_core_out_of_time(core)) return KPIRL_MPC_NOT_RESTORED;
    core->trials = 0;
    if (!kpirl_mpc_newton_iterate(core, 0)) return KPIRL_MPC_NOT_RESTORED;
    solved = settled(core);
    kpirl_mpc_log_iteration(core);
    ++core->iterations;
  }
}

/* Multipliers of bounds begin at tau / y or more, as far as that is no more than the penalty: tau is another one now, and without
 * a multiplier a small slack would make a step as long as tau / z. */
static kpirl_mpc_restoration restore_with(kpirl_mpc_core *core, real penalty, real enough) {
  const int bounds = kpirl_mpc_n_bounds(core);
  const real tau = kpirl_mpc_max(core->start_tau, penalty * violation(core));
  kpirl_mpc_iterate *at = &core->at;
  int i;
  for (i = 0; i < bounds; ++i) at->z[i] = kpirl_mpc_max(at->z[i], kpirl_mpc_min(tau / at->y[i], penalty));
  core->penalty = penalty;
  core->tau = tau;
  kpirl_mpc_penalty_slopes(core, at->z, at->nu);
  begin_barrier_problem(core, tau);
  return descend(core, LAST_TAU * tau, enough);
}

/* With a larger penalty from a minimum for a smaller one: with the same slacks it nearly is one, too. */
static kpirl_mpc_restoration raise_penalty(kpirl_mpc_core *core, real factor, real enough) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  int i;
  for (i = 0; i < m; ++i) core->at.z[i] *= factor;
  for (i = 0; i < n_c; ++i) core->at.nu[i] *= factor;
  core->penalty *= factor;
  begin_barrier_problem(core, factor * core->tau);
  return descend(core, core->tau, enough);
}

/* The gradient of J, for penalties. Begin without costates: those of J are none of a penalty's. */
static real begin(kpirl_mpc_core *core) {
  const real gradient = kpirl_mpc_norm_inf(core->d.cost_gradient, kpirl_mpc_n_point(core));
  core->regularisation = 0;
  core->indefinite = 0;
  memset(core->at.costates, 0, (size_t)(DIM(core, horizon) * DIM(core, n_states)) * sizeof(real));
  return gradient > 0 ? gradient : 1;
}

/* With a first and a last penalty for these sizes of rows, from where the iterate is. */
static kpirl_mpc_restoration restore_scaled(kpirl_mpc_core *core) {
  const real scale = begin(core), enough = LEFT * violation(core);
  const kpirl_mpc_restoration result = restore_with(core, FIRST * scale, enough);
  if (result == KPIRL_MPC_RESTORED) return result;
  if (result == KPIRL_MPC_SHOWN_INFEASIBLE && !core->indefinite) return raise_penalty(core, LAST / FIRST, enough);
  return restore_with(core, LAST * scale, enough);
}

static int all_ones(const real *values, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (values[i] != 1) return 0;
  return 1;
}

/* What is stationary for violations in units of their gradients may not be for violations as they were stated: both have to say
 * so before a problem is called infeasible. */
kpirl_mpc_restoration kpirl_mpc_restore(kpirl_mpc_core *core) {
  const int rows = kpirl_mpc_n_inequalities(core) + kpirl_mpc_n_equalities(core);
  kpirl_mpc_restoration result;
  int i;
  kpirl_mpc_measure_rows(core);
  if (!kpirl_mpc_has_elastic(core) || !(violation(core) > core->tolerance)) return KPIRL_MPC_NOT_RESTORED;
  result = restore_scaled(core);
  if (result == KPIRL_MPC_SHOWN_INFEASIBLE && !all_ones(core->row_sizes, rows)) {
    for (i = 0; i < rows; ++i) core->row_sizes[i] = 1;
    result = core->indefinite ? restore_scaled(core) : restore_with(core, LAST * begin(core), LEFT * violation(core));
  }
  kpirl_mpc_harden(core);
  return result;
}
