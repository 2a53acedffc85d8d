/* SPDX-License-Identifier: MIT
 *
 * Feasibility restoration (Waechter and Biegler, 2006, section 3.3): where linearised constraints leave no room for a step, the
 * problem with elastic constraints is solved until most of the violation is gone. What is left for the largest penalty is
 * stationary for the violation.
 */
#include "kpirl_mpc_core.h"

#include <string.h>

static const real FIRST = (real)1e3, LAST = (real)1e7; /* penalties, relative to the gradient of J */
static const real LEFT = (real)0.01;    /* share of the violation that is left where the method proper goes on */
static const real LOWERED = (real)0.1, LAST_TAU = (real)1e-4; /* factor of tau, and the last one relative to the first */

static void begin_barrier_problem(kpirl_mpc_core *core, real tau) {
  core->tau = tau;
  kpirl_mpc_relax(core);
  kpirl_mpc_differentiate(core, KPIRL_MPC_SECOND);
  kpirl_mpc_start_filter(core);
}

/* Solve barrier problems of falling tau, until no violation is larger than `enough`. */
static kpirl_mpc_restoration descend(kpirl_mpc_core *core, real enough) {
  const real first = core->tau;
  for (;;) {
    if (kpirl_mpc_largest_violation(core) <= enough) return KPIRL_MPC_RESTORED;
    if (kpirl_mpc_subproblem_solved(core)) {
      if (core->tau <= LAST_TAU * first) return KPIRL_MPC_SHOWN_INFEASIBLE;
      begin_barrier_problem(core, LOWERED * core->tau);
      continue;
    }
    if (core->iterations >= core->options.max_iterations || kpirl_mpc_core_late(core)) return KPIRL_MPC_NOT_RESTORED;
    core->trials = 0;
    if (!kpirl_mpc_newton_iterate(core)) return KPIRL_MPC_NOT_RESTORED;
    kpirl_mpc_log_iteration(core);
    ++core->iterations;
  }
}

static kpirl_mpc_restoration restore_with(kpirl_mpc_core *core, real penalty, real enough) {
  core->penalty = penalty;
  begin_barrier_problem(core, kpirl_mpc_larger(core->start_tau, penalty * kpirl_mpc_largest_violation(core)));
  return descend(core, enough);
}

kpirl_mpc_restoration kpirl_mpc_restore(kpirl_mpc_core *core) {
  const real before = kpirl_mpc_largest_violation(core);
  const real gradient = kpirl_mpc_largest(core->d.cost_gradient, kpirl_mpc_n_point(core));
  const real scale = gradient > 0 ? gradient : 1;
  kpirl_mpc_restoration result;
  if (!kpirl_mpc_has_elastic(core) || !(before > core->tolerance)) return KPIRL_MPC_NOT_RESTORED;
  core->regularisation = 0;
  memset(core->at.costates, 0, (size_t)(DIM(core, horizon) * DIM(core, n_states)) * sizeof(real));
  result = restore_with(core, FIRST * scale, LEFT * before);
  if (result != KPIRL_MPC_RESTORED) result = restore_with(core, LAST * scale, LEFT * before);
  kpirl_mpc_harden(core);
  return result;
}
