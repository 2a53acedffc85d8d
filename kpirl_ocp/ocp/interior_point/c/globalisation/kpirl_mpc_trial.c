/* SPDX-License-Identifier: MIT
 *
 * Trial points of a line search, and what is made of the one that is taken.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real REMAINDER = (real)0.1;  /* a trial may end this much closer to the boundary than its linearisation */
static const real CENTRAL = (real)1e-3;   /* the smallest slack * multiplier, relative to tau */
static const real KNOWN = 25;             /* times rounding: the smallest slack of a bound of which digits are known */
static const real CENTRE = (real)1e10;    /* slack * multiplier stays within this factor of tau */
static const real STILL = (real)0.5;      /* change of a slack without interior, relative to it, that is rounding */
static const real NOTHING = (real)1e-3;   /* what a Newton step leaves of a slack, relative to it and to tau / z, where it leaves none */

/* Of a bounded entry of x; that of a value of h is not known. */
static real rounding(const kpirl_mpc_core *core, int row) {
  if (row >= kpirl_mpc_n_bounds(core)) return 0;
  return 4 * KPIRL_MPC_EPSILON * kpirl_mpc_abs(core->at.x[kpirl_mpc_bounded_entry(core, row)]);
}

/* Would the whole Newton step leave nothing, up to rounding, of a slack below the tolerance? One that decisions move stays near
 * tau / z. */
static int is_used_up(const kpirl_mpc_core *core, int row) {
  const real y = core->trial.y[row], z = core->trial.z[row]; /* before the step */
  const real left = kpirl_mpc_max(kpirl_mpc_abs(y + core->step.change.y[row]) - rounding(core, row), 0);
  return core->at.y[row] < (real)core->options.tolerance && left <= NOTHING * y && left * z <= NOTHING * core->step.tau;
}

/* The slack of a row where g is its value: as the linearisation leaves it, of h at least -g; one without interior stays. */
static real trial_slack(const kpirl_mpc_core *core, int row, real length, real g) {
  const real before = core->d.g[row], y = core->at.y[row], dy = core->step.change.y[row], room = kpirl_mpc_room(core, before, y);
  if (room > 0 && kpirl_mpc_abs(dy) <= STILL * y) return y;
  if (row >= kpirl_mpc_n_bounds(core)) return kpirl_mpc_max(y + length * dy, -g);
  return (1 - length) * (before + y - room) + room - g;
}

/* Lifted: x + length dx, as in multiple shooting, with the defects that the dynamics leave there. Else along the dynamics. Returns
 * the violation of the dynamics. */
static real move(kpirl_mpc_core *core, real length, int lifted, real *objective, real *path, real *equality) {
  const int T = DIM(core, horizon), n_w = kpirl_mpc_n_point(core);
  kpirl_mpc_iterate *trial = &core->trial;
  int i;
  if (!lifted) {
    kpirl_mpc_feedback_rollout(core, length, objective, path, equality);
    return (1 - length) * kpirl_mpc_norm_in_sizes(core, core->d.defects, T);
  }
  for (i = 0; i < n_w; ++i) trial->x[i] = core->at.x[i] + length * core->step.change.x[i];
  kpirl_mpc_evaluate_values(core, trial->x, objective, trial->costates, path, equality);
  return kpirl_mpc_norm_in_sizes(core, trial->costates, T);
}

/* Slacks where g are the values of inequalities. Returns whether one has come too close to zero. */
static int find_slacks(kpirl_mpc_core *core, real length, const real *g) {
  const int m = kpirl_mpc_n_inequalities(core);
  const real least = REMAINDER * (1 - core->step.share), *before = core->at.y;
  real *y = core->trial.y;
  int i, outside = 0;
  for (i = 0; i < m; ++i) {
    if (kpirl_mpc_is_elastic(core, i)) {
      y[i] = before[i];
      continue;
    }
    y[i] = trial_slack(core, i, length, g[i]);
    outside |= y[i] < least * before[i];
  }
  return outside;
}

void kpirl_mpc_trial_point(kpirl_mpc_core *core, real length, int lifted, kpirl_mpc_merit *merit) {
  const kpirl_mpc_iterate *at = &core->at, *change = &core->step.change;
  kpirl_mpc_iterate *trial = &core->trial;
  const int n_s = DIM(core, n_states), n_costates = DIM(core, horizon) * n_s, n_c = kpirl_mpc_n_equalities(core);
  real *path = core->force + kpirl_mpc_n_bounds(core), *equality = trial->nu + core->n_fixed, *g = trial->z;
  real objective, theta = move(core, length, lifted, &objective, path, equality), penalty;
  int i, outside;
  kpirl_mpc_gap(core, trial->x, core->start);
  theta += kpirl_mpc_norm_in_sizes(core, core->start, 1);
  kpirl_mpc_equalities(core, trial->x, equality, trial->nu);
  theta += kpirl_mpc_equality_violation(core, trial->nu);
  kpirl_mpc_inequalities(core, trial->x, path, g);
  penalty = core->penalty > 0 ? kpirl_mpc_penalty(core, g, trial->nu) : 0;
  outside = find_slacks(core, length, g);
  theta += kpirl_mpc_slack_violation(core, g, trial->y);
  if (core->failed) theta = (real)NAN; /* outside the domain of a function: no place to go */
  core->failed = 0;
  merit->theta = theta;
  merit->log_sum = kpirl_mpc_hard_log_sum(core, trial->y);
  merit->phi = outside ? (real)INFINITY : objective + penalty - core->step.tau * merit->log_sum;
  for (i = 0; i < n_costates; ++i) trial->costates[i] = at->costates[i] + length * change->costates[i];
  if (core->penalty <= 0)
    for (i = 0; i < n_c; ++i) trial->nu[i] = at->nu[i] + length * change->nu[i];
}

/* A shorter length: half of it, or more, up to what would have kept enough of the slacks that shrank too much. */
real kpirl_mpc_shortened(const kpirl_mpc_core *core, real length) {
  const int m = kpirl_mpc_n_inequalities(core);
  const real *before = core->at.y, *after = core->trial.y;
  const real share = core->step.share;
  real most = share;
  int i;
  for (i = 0; i < m; ++i) most = kpirl_mpc_max((before[i] - after[i]) / before[i], most);
  return length * (most > share ? kpirl_mpc_min(kpirl_mpc_max(share / most, (real)0.5), (real)0.95) : (real)0.5);
}

/* Of the logarithms of slacks of constraints that are not elastic. */
real kpirl_mpc_hard_log_sum(const kpirl_mpc_core *core, const real *y) {
  const int m = kpirl_mpc_n_inequalities(core);
  real sum = 0;
  int i;
  if (core->penalty <= 0) return kpirl_mpc_log_sum(y, m);
  for (i = 0; i < m; ++i)
    if (!kpirl_mpc_is_elastic(core, i)) sum += KPIRL_MPC_MATH(log)(y[i]);
  return sum;
}

/* The smallest slack. Far below central ones, weights z / y near 1 / rounding leave no digit of the rest; so slacks stay near them, as long
 * as that violates the constraint by less than is tolerated, and a bound by no more than rounding of x. */
static real least_slack(const kpirl_mpc_core *core, int row) {
  const real z = core->at.z[row], central = z > 0 ? CENTRAL * core->tau / z : 0;
  const real tolerated = (real)core->options.tolerance / 10;
  const real least = kpirl_mpc_min(central, tolerated);
  return row < kpirl_mpc_n_bounds(core) ? kpirl_mpc_min(least, KNOWN * rounding(core, row)) : least;
}

/* Slacks no smaller than what is left of the constraint, nor too close to zero, and multipliers near tau / y. */
void kpirl_mpc_centre(kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core);
  kpirl_mpc_iterate *at = &core->at;
  int i;
  for (i = 0; i < m; ++i) {
    const real g = core->d.g[i];
    real centred;
    if (kpirl_mpc_is_elastic(core, i)) continue;
    at->y[i] = isnan(g) ? g : kpirl_mpc_max(kpirl_mpc_max(at->y[i], -g), least_slack(core, i));
    if (is_used_up(core, i)) at->y[i] = (real)core->options.tolerance;
    centred = core->tau / at->y[i];
    if (at->z[i] < centred / CENTRE) at->z[i] = centred / CENTRE;
    if (at->z[i] > centred * CENTRE) at->z[i] = centred * CENTRE;
  }
}
