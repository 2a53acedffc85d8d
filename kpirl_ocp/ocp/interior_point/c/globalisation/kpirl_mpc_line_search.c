/* SPDX-License-Identifier: MIT
 *
 * One iteration: a direction, and how far to go along it.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real SHORTEST = (real)1e-10; /* step length below which a line search gives up */
static const real TINY = (real)1e-12;     /* relative Newton step below which rounding decides, so that it is taken as it is */
static const real LEFT = (real)0.5;        /* share of equalities that a step leaves where they contradict each other */
static const real USEFUL = (real)0.01;     /* fraction of a corrected step below which plain Newton steps do better */
static const real CREEPING = (real)1e-4;  /* fraction of a Newton step below which a regularised one does better */
static const real ROUNDING = 10 * KPIRL_MPC_EPSILON;
static const real SMALL = (real)1e-3;      /* violation that counts as little */
static const real KEPT = (real)1e-4;       /* share of its start above which tau stays until violation and gradient fall */
static const real STATIONARY = (real)0.1; /* share of its largest that the gradient has near a saddle */
static const real WORTHWHILE = (real)0.05; /* shortest step off a saddle of a barrier problem */
static const real RISE = 10;             /* of the objective along the dynamics, in units of what the violation costs that is gone */
static const real WORTH = 3;             /* of what the objective gains, what it may cost to leave feasible points */
static const real SLOWER = (real)0.2;     /* by which tau falls at least from one barrier problem to the next */
static const int RISES = 24;              /* of tau, each with a new filter */
static const int ATTEMPTS = 6;            /* line searches at one iterate, each with a stronger regularisation */

/* Derivative of J - tau sum log y along the step. */
real kpirl_mpc_slope(const kpirl_mpc_core *core) {
  const kpirl_mpc_iterate *change = &core->step.change;
  const int m = kpirl_mpc_n_inequalities(core);
  real barrier = 0;
  int i;
  for (i = 0; i < m; ++i) barrier += change->y[i] / core->at.y[i];
  return kpirl_mpc_dot(core->d.cost_gradient, change->x, kpirl_mpc_n_point(core)) - core->step.tau * barrier +
         (core->penalty > 0 ? core->step.penalty_slope : 0);
}

/* The decrease that a step promises: the derivative, but where a slack grows by more than itself, which its logarithm does not follow, it
 * counts as if it doubled. */
static real promised(const kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core);
  real beyond = 0;
  int i;
  for (i = 0; i < m; ++i) beyond += kpirl_mpc_max(core->step.change.y[i] / core->at.y[i] - 1, 0);
  return kpirl_mpc_slope(core) + core->step.tau * beyond;
}

static void swap(kpirl_mpc_iterate *a, kpirl_mpc_iterate *b) {
  const kpirl_mpc_iterate other = *a;
  *a = *b;
  *b = other;
}

/* Go to the trial point; `level` says how much to find out about it. */
void kpirl_mpc_accept_trial(kpirl_mpc_core *core, int level) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  const real length = core->step.dual_length;
  int i;
  for (i = 0; i < m; ++i) core->trial.z[i] = core->at.z[i] + length * core->step.change.z[i];
  if (core->penalty > 0) {
    memcpy(core->d.c, core->trial.nu, (size_t)n_c * sizeof(real));
    for (i = 0; i < n_c; ++i) core->trial.nu[i] = core->at.nu[i] + length * core->step.change.nu[i];
  }
  swap(&core->at, &core->trial);
  kpirl_mpc_inequalities(core, core->at.x, core->force + kpirl_mpc_n_bounds(core), core->d.g);
  kpirl_mpc_centre(core);
  if (core->penalty > 0) kpirl_mpc_weigh_elastic(core);
  kpirl_mpc_differentiate(core, level);
}

/* Do linearised equalities contradict each other? Then the whole step, which leaves delta times the change of their multipliers,
 * leaves most of them. */
static int contradictory(const kpirl_mpc_core *core) {
  const int n_c = kpirl_mpc_n_equalities(core);
  const real violation = kpirl_mpc_norm_inf(core->d.c, n_c);
  return core->penalty <= 0 && violation > core->tolerance &&
         KPIRL_MPC_PROXIMAL * kpirl_mpc_norm_inf(core->step.change.nu, n_c) > LEFT * violation;
}

/* Where linearised equalities contradict each other, what a step leaves of them, over delta, becomes their multipliers. Those say
 * nothing of the problem: go on without them, as at a start. */
static void forget_heavy_multipliers(kpirl_mpc_core *core) {
  const int n_c = kpirl_mpc_n_equalities(core);
  if (core->penalty > 0 || core->d.violation <= core->filter.small) return;
  if (!kpirl_mpc_too_heavy(core, core->trial.nu, kpirl_mpc_n_inequalities(core), n_c)) return;
  memset(core->trial.costates, 0, (size_t)(DIM(core, horizon) * DIM(core, n_states)) * sizeof(real));
  memset(core->trial.nu, 0, (size_t)n_c * sizeof(real));
  core->no_costates = 1;
}

/* The lifted trial violates the constraints more, to second order. One along the dynamics leaves (1 - length) of their defects, as the
 * linearised step would. */
static int corrected_fits(kpirl_mpc_core *core, kpirl_mpc_merit before, real slope, real length, real price) {
  kpirl_mpc_merit trial;
  ++core->trials;
  kpirl_mpc_trial_point(core, length, 0, &trial);
  return trial.phi + price * trial.theta <= before.phi + RISE * price * before.theta &&
         kpirl_mpc_filter_accepts(&core->filter, before, slope, length, price, trial);
}

/* The largest multiplier of a constraint that theta counts as equality. */
static real heaviest(const kpirl_mpc_core *core, const kpirl_mpc_iterate *at) {
  const real costate = kpirl_mpc_price(core, at->costates);
  return core->penalty > 0 ? costate : kpirl_mpc_max(costate, kpirl_mpc_norm_inf(at->nu, kpirl_mpc_n_equalities(core)));
}

/* Does the objective rise by no more than what is violated is worth, with the multipliers before the step and after it? Near feasible
 * points the filter would take what violates constraints less at any cost: also where a nearly singular Hessian makes steps a billion
 * times too long. */
static int worth_its_cost(const kpirl_mpc_core *core, kpirl_mpc_merit before, kpirl_mpc_merit trial) {
  const kpirl_mpc_iterate *at = &core->at, *change = &core->step.change;
  const int m = kpirl_mpc_n_inequalities(core);
  const real price = heaviest(core, at) + heaviest(core, change) + kpirl_mpc_norm_inf(at->z, m) + kpirl_mpc_norm_inf(change->z, m);
  return trial.phi - before.phi <= RISE * price * before.theta + ROUNDING * kpirl_mpc_abs(before.phi);
}

/* Does the objective fall by what leaving feasible points costs, with the multipliers before the step? Else the filter would take what
 * costs less at any violation. */
static int worth_leaving(kpirl_mpc_merit before, real price, kpirl_mpc_merit trial) {
  return price * (trial.theta - before.theta) <= WORTH * (before.phi - trial.phi);
}

/* Does the filter accept the trial, and is it worth what it costs where little is violated? */
static int fits(kpirl_mpc_core *core, kpirl_mpc_merit before, real slope, real length, real price, kpirl_mpc_merit trial) {
  const real small = core->filter.small, theta = before.theta;
  if (theta <= small && trial.theta > small && !worth_leaving(before, price, trial)) return 0;
  if (theta <= small && theta > core->filter.feasible && !worth_its_cost(core, before, trial)) return 0;
  return kpirl_mpc_filter_accepts(&core->filter, before, slope, length, price, trial);
}

/* Move by the longest length that the filter accepts, if there is one above a fraction `least` of the whole step; far from
 * feasible points also above rounding, which comes no nearer. */
static int move_along(kpirl_mpc_core *core, real least) {
  const kpirl_mpc_step *step = &core->step;
  const int n_w = kpirl_mpc_n_point(core);
  const real largest = kpirl_mpc_norm_inf(step->change.x, n_w);
  const real size = 1 + kpirl_mpc_norm_inf(core->at.x, n_w);
  const int tiny = step->regularisation == 0 && largest <= TINY * size && !contradictory(core);
  const real slope = promised(core);
  const real rounding = !tiny && core->d.violation > core->filter.small ? ROUNDING * size / largest : 0;
  const real shortest = kpirl_mpc_max(kpirl_mpc_max(SHORTEST, rounding), least * step->primal_length);
  real length = step->primal_length;
  const real price = heaviest(core, &core->at);
  kpirl_mpc_merit before, trial;
  before.theta = core->d.violation;
  before.log_sum = kpirl_mpc_hard_log_sum(core, core->at.y);
  before.phi = core->d.objective - step->tau * before.log_sum;
  if (core->penalty > 0) before.phi += kpirl_mpc_penalty(core, core->d.g, core->d.c);
  while (length >= shortest) {
    ++core->trials;
    kpirl_mpc_trial_point(core, length, core->lifted, &trial);
    if ((tiny && isfinite(trial.phi)) || fits(core, before, slope, length, price, trial) ||
        (isfinite(trial.phi) && trial.theta >= before.theta && kpirl_mpc_lifts(core) &&
         corrected_fits(core, before, slope, length, price))) {
      core->step.primal_length = length;
      core->step.slope = slope;
      forget_heavy_multipliers(core);
      kpirl_mpc_accept_trial(core, KPIRL_MPC_SECOND);
      return 1;
    }
    length = isinf(trial.phi) ? kpirl_mpc_shortened(core, length) : length / 2;
  }
  return 0;
}

/* Another barrier function has another filter; without inequalities there is none. But where tau rises again and again, the method may take
 * turns between points for ever: then the filter keeps its pairs. */
static void set_tau(kpirl_mpc_core *core, real tau) {
  const real before = core->tau;
  core->tau = tau;
  if (tau == before || kpirl_mpc_n_inequalities(core) == 0) return;
  if (tau > before) ++core->rises;
  if (core->rises > RISES)
    kpirl_mpc_shift_filter(&core->filter, before, tau);
  else
    kpirl_mpc_start_filter(core);
}

/* tau for Newton steps where the Hessian is not positive: back to where it was when that began, or would start here. A tau that
 * a predictor chose on the way leaves no room to turn. Less far back each time: else the method could take turns for ever. */
static void hold_tau(kpirl_mpc_core *core) {
  if (!core->held) core->indefinite_tau = kpirl_mpc_max(kpirl_mpc_start_tau(core), core->indefinite_tau);
  else if (core->tau < core->indefinite_tau) core->indefinite_tau = kpirl_mpc_max(core->tau, SLOWER * core->indefinite_tau);
  core->held = 1;
  set_tau(core, kpirl_mpc_max(core->tau, core->indefinite_tau));
}

/* Where the barrier problem is solved though its Hessian is not positive: off this point, once for each tau, if the gradient is
 * small, too; else to the next tau (Waechter and Biegler, 2006, section 2.1). Returns whether it moved. */
static int leave_saddle(kpirl_mpc_core *core, real least) {
  const real tau = core->tau, lower = kpirl_mpc_min(SLOWER * tau, kpirl_mpc_pow(tau, (real)1.5));
  const real gradient = kpirl_mpc_norm_inf(core->d.gradient, kpirl_mpc_n_point(core));
  if (tau < core->escaped_tau && gradient <= STATIONARY * core->most_gradient && kpirl_mpc_escape(core, WORTHWHILE) > 0) {
    core->escaped_tau = tau;
    return 1;
  }
  core->indefinite_tau = kpirl_mpc_max(least, lower);
  set_tau(core, core->indefinite_tau);
  return 0;
}

/* The smallest tau for now: a share of its start, in proportion to what is left of violation and gradient of the Lagrangian. Else
 * a first step that seems to solve everything would leave tau far behind the conditions where constraints are curved. Nothing is left where
 * there is nothing to decide. */
static real kept_tau(kpirl_mpc_core *core, real least) {
  const int n_w = kpirl_mpc_n_point(core);
  const real violation = kpirl_mpc_max(core->d.violation - kpirl_mpc_max(kpirl_mpc_violation_rounding(core), core->tolerance), 0);
  const real gradient = kpirl_mpc_norm_inf(core->d.gradient, n_w);
  const real cost_gradient = kpirl_mpc_norm_inf(core->d.cost_gradient, n_w);
  real left;
  core->most_violation = kpirl_mpc_max(kpirl_mpc_max(violation, SMALL), core->most_violation);
  core->most_gradient = kpirl_mpc_max(kpirl_mpc_max(gradient, cost_gradient), core->most_gradient);
  if (core->options.barrier > 0 || DIM(core, n_actions) + core->bounds.n_free == 0) return least;
  left = violation / core->most_violation;
  if (core->most_gradient > 0) left = kpirl_mpc_max(gradient / core->most_gradient, left);
  return kpirl_mpc_max(least, kpirl_mpc_min(KEPT * core->start_tau * left, core->tau));
}

/* Move along a Newton step, regularised until the filter accepts more than a creeping length of it, or any in the end; from the first
 * where the Hessian is known to be `indefinite`. Returns whether it moved. */
int kpirl_mpc_newton_iterate(kpirl_mpc_core *core, int indefinite) {
  real rho = 0;
  int attempt;
  for (attempt = 0; attempt < ATTEMPTS; ++attempt) {
    if (!kpirl_mpc_find_positive_step(core, rho, indefinite && attempt == 0)) return 0;
    kpirl_mpc_correct_newton_step(core);
    if (move_along(core, attempt < ATTEMPTS - 1 ? CREEPING : 0)) return 1;
    rho = kpirl_mpc_stronger(core);
  }
  return 0;
}

/* Move along the corrected step where it is one to a minimum; else along Newton steps, regularised. Returns whether it moved. */
int kpirl_mpc_iterate_once(kpirl_mpc_core *core, real least) {
  core->trials = 0;
  if (kpirl_mpc_outgrown(core)) kpirl_mpc_start_filter(core);
  least = kept_tau(core, least);
  kpirl_mpc_corrected_step(core, least);
  if (core->no_costates && !core->step.positive) {
    kpirl_mpc_estimate_costates(core);
    kpirl_mpc_differentiate(core, KPIRL_MPC_SECOND);
    kpirl_mpc_corrected_step(core, least);
  }
  core->no_costates = 0;
  if (core->step.positive) {
    set_tau(core, core->step.tau);
    return move_along(core, USEFUL) || kpirl_mpc_newton_iterate(core, 0);
  }
  hold_tau(core);
  if (kpirl_mpc_subproblem_solved(core) && leave_saddle(core, least)) return 1;
  return kpirl_mpc_newton_iterate(core, 1);
}
