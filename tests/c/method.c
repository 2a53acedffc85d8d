/* Parts of the interior-point method that only the method calls, at the iterate of a core. Linked with the core's library. */
#include "kpirl_mpc_method.h"

static real barrier_function(kpirl_mpc_core *core, real length) {
  kpirl_mpc_merit merit;
  kpirl_mpc_trial_point(core, length, 0, &merit);
  return merit.phi;
}

/* The derivative of the barrier function along a Newton step, as the line search takes it, and as differences over +-h give it; with
 * elastic constraints of this penalty where it is positive. */
void slopes(kpirl_mpc_core *core, real penalty, real tau, real h, real *known, real *found) {
  core->penalty = penalty;
  core->tau = tau;
  if (penalty > 0) {
    kpirl_mpc_measure_rows(core);
    kpirl_mpc_penalty_slopes(core, core->at.z, core->at.nu);
    kpirl_mpc_weigh_elastic(core);
  }
  kpirl_mpc_differentiate(core, KPIRL_MPC_SECOND);
  kpirl_mpc_find_positive_step(core, 0, 0);
  *known = kpirl_mpc_slope(core);
  *found = (barrier_function(core, h) - barrier_function(core, -h)) / (2 * h);
  core->penalty = 0;
}

/* The costates of a cold start with these actions and states x, into `costates` (T n_s), and the gradient (n_w) that they leave. */
void first_costates(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers, const real *x, real *costates, real *gradient) {
  const int n_costates = core->dimensions.horizon * core->dimensions.n_states, n_w = kpirl_mpc_n_point(core);
  int i;
  kpirl_mpc_set_numbers(core, numbers);
  kpirl_mpc_cold_start(core, x);
  kpirl_mpc_differentiate(core, KPIRL_MPC_SECOND);
  kpirl_mpc_estimate_costates(core);
  kpirl_mpc_differentiate(core, KPIRL_MPC_FIRST);
  for (i = 0; i < n_costates; ++i) costates[i] = core->at.costates[i];
  for (i = 0; i < n_w; ++i) gradient[i] = core->d.gradient[i];
}

/* After how many iterations at one point it counts as one without progress; 0 for more than 20. */
int iterations_until_idle(kpirl_mpc_core *core, real regularisation) {
  int i;
  core->idle = 0;
  for (i = 0; i < 3; ++i) core->best[i] = (real)INFINITY;
  core->step.regularisation = regularisation;
  for (i = 1; i <= 20; ++i)
    if (kpirl_mpc_idle(core)) return i;
  return 0;
}
