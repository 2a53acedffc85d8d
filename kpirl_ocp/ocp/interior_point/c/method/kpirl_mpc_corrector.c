/* SPDX-License-Identifier: MIT
 *
 * Steps of several orders with the factors of one: Mehrotra's predictor and corrector (1992), the centrality correctors of
 * Gondzio (1996), and a repeated one (Carpenter, Lustig, Mulvey and Shanno, 1993). A right-hand side costs far less than factors
 * and derivatives.
 */
#include "kpirl_mpc_method.h"

static const real GROWTH = 10;           /* of tau beyond the mean of y z: a step that multiplies them by more has no meaning */
static const real CORRECTED = (real)0.5; /* length of a step from which its second order is believed */
/* Gondzio's: how many correctors; how much longer a step each aims at; the least that it has to gain; products y z between
 * NEAR tau and FAR tau count as central. */
static const int CORRECTORS = 3;
static const real LONGER = (real)0.1, GAIN = (real)0.01, NEAR = (real)0.1, FAR = 10;
static const real ROUNDING = (real)1e-3; /* of products, relative to tau: where a step ends at the boundary, one is zero */

typedef struct { real primal, dual; } lengths;

static lengths to_the_boundary(const kpirl_mpc_core *core, const kpirl_mpc_iterate *change) {
  const int m = kpirl_mpc_n_inequalities(core);
  lengths most;
  most.primal = kpirl_mpc_longest(core->at.y, change->y, m, 1);
  most.dual = kpirl_mpc_longest(core->at.z, change->z, m, 1);
  return most;
}

/* y z of one row after a step of these lengths. */
static real product_after(const kpirl_mpc_core *core, const kpirl_mpc_iterate *change, lengths length, int row) {
  return (core->at.y[row] + length.primal * change->y[row]) * (core->at.z[row] + length.dual * change->z[row]);
}

/* Of products y z after a step of these lengths: mu, their mean, and the smallest. */
typedef struct { real mean, least; } products;

static products products_after(const kpirl_mpc_core *core, const kpirl_mpc_iterate *change, lengths length) {
  const int m = kpirl_mpc_n_inequalities(core);
  products after = {0, (real)INFINITY};
  int i;
  for (i = 0; i < m; ++i) {
    const real product = product_after(core, change, length, i);
    after.mean += product / m;
    after.least = kpirl_mpc_min(product, after.least);
  }
  return after;
}

/* y dz + z dy = tau - y z - the second order of a step */
static void aim_at_second_order(kpirl_mpc_core *core, const kpirl_mpc_iterate *step) {
  const int m = kpirl_mpc_n_inequalities(core);
  int i;
  for (i = 0; i < m; ++i) core->target[i] = core->step.tau - step->y[i] * step->z[i];
}

/* A first step towards tau = least shows how small mu can become while y and z stay positive; then tau = mu (mu_first / mu)^3 or
 * `least`, more than before where products would grow; a tau that the problem is solved for stays. And
 * y dz + z dy + dy_first dz_first = tau - y z with the same factors. The correction supposes that most of the first step can be
 * taken, and is left out where the latter is not so. */
static void predict(kpirl_mpc_core *core, real least) {
  static const lengths none = {0, 0};
  const int m = kpirl_mpc_n_inequalities(core);
  const kpirl_mpc_iterate *first = &core->first.change;
  lengths length;
  real mu, share;
  int i;
  kpirl_mpc_step_to_target(core, &core->first.change);
  length = to_the_boundary(core, first);
  mu = products_after(core, first, none).mean;
  share = products_after(core, first, length).mean / mu;
  core->step.tau = core->options.barrier > 0 ? least : kpirl_mpc_max(least, mu * kpirl_mpc_min(share * share * share, GROWTH));
  for (i = 0; i < m; ++i) core->target[i] = core->step.tau;
  if (kpirl_mpc_min(length.primal, length.dual) > CORRECTED) aim_at_second_order(core, first);
}

/* Aim at a step that is LONGER: products that it would leave off centre are to come back. */
static void recentre(kpirl_mpc_core *core, lengths length) {
  const int m = kpirl_mpc_n_inequalities(core);
  const real tau = core->step.tau;
  int i;
  length.primal = kpirl_mpc_min(1, length.primal + LONGER);
  length.dual = kpirl_mpc_min(1, length.dual + LONGER);
  for (i = 0; i < m; ++i) {
    const real product = product_after(core, &core->step.change, length, i);
    const real central = kpirl_mpc_max(NEAR * tau, kpirl_mpc_min(product, FAR * tau));
    core->target[i] += kpirl_mpc_max(central - product, -FAR * tau);
  }
}

static int gains(lengths before, lengths after) {
  const real primal = after.primal - before.primal, dual = after.dual - before.dual;
  return kpirl_mpc_min(primal, dual) >= 0 && kpirl_mpc_max(primal, dual) >= GAIN;
}

/* Centrality correctors, for as long as one makes the step longer. */
static void correct_centrality(kpirl_mpc_core *core) {
  lengths before = to_the_boundary(core, &core->step.change);
  int i;
  for (i = 0; i < CORRECTORS && kpirl_mpc_min(before.primal, before.dual) < 1 - LONGER; ++i) {
    const kpirl_mpc_iterate change = core->step.change;
    lengths after;
    recentre(core, before);
    kpirl_mpc_step_to_target(core, &core->first.change);
    after = to_the_boundary(core, &core->first.change);
    if (!gains(before, after) || !kpirl_mpc_all_finite(core->first.change.x, kpirl_mpc_n_point(core))) return;
    core->step.change = core->first.change;
    core->first.change = change;
    before = after;
  }
}

/* Where most of the step can be taken: once more, with its own second order in place of the first one's, if that makes mu smaller
 * and leaves no product far behind tau, unless one was before. */
static void correct_again(kpirl_mpc_core *core) {
  const kpirl_mpc_iterate change = core->step.change;
  const lengths length = to_the_boundary(core, &change);
  const products before = products_after(core, &change, length);
  const real tau = core->step.tau;
  products after;
  if (kpirl_mpc_min(length.primal, length.dual) <= CORRECTED) return;
  aim_at_second_order(core, &change);
  kpirl_mpc_step_to_target(core, &core->first.change);
  after = products_after(core, &core->first.change, to_the_boundary(core, &core->first.change));
  if (!(after.mean < before.mean && after.least > kpirl_mpc_min(NEAR * tau, before.least) - ROUNDING * tau)) return;
  core->step.change = core->first.change;
  core->first.change = change;
}

void kpirl_mpc_corrected_step(kpirl_mpc_core *core, real least) {
  const int m = kpirl_mpc_n_inequalities(core);
  int i;
  core->step.tau = least;
  core->step.positive = core->factored || kpirl_mpc_factorise(core, 0);
  if (!core->step.positive) return;
  core->step.regularisation = 0;
  for (i = 0; i < m; ++i) core->target[i] = least;
  if (m > 0) predict(core, least);
  kpirl_mpc_step_to_target(core, &core->step.change);
  if (m > 0) {
    correct_centrality(core);
    correct_again(core);
  }
  kpirl_mpc_limit_lengths(core);
}

/* Centrality correctors for a Newton step. What limits steps with elastic constraints has none. */
void kpirl_mpc_correct_newton_step(kpirl_mpc_core *core) {
  if (kpirl_mpc_n_inequalities(core) == 0 || core->penalty > 0) return;
  correct_centrality(core);
  kpirl_mpc_limit_lengths(core);
}
