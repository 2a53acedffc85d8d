/* SPDX-License-Identifier: MIT
 *
 * Elastic constraints (Gill, Murray and Saunders, SNOPT, 2005, section 1.2). In elastic mode inequalities but the bounds of
 * decisions, and equalities but the dynamics, are replaced by their l1 penalty with slacks,
 *
 *     phi(g) = min rho e - tau (log y + log e)        over y, e > 0,  y - e = -g,
 *     psi(c) = min rho (p + n) - tau (log p + log n)  over p, n > 0,  p - n = c,
 *
 * whose minimisers, slopes z and nu, and curvatures have closed forms:
 *
 *     y(g) = (2 tau - rho g + sqrt(rho^2 g^2 + 4 tau^2)) / (2 rho),  e = y(-g),  z = tau / y,            z' = tau / (y^2 + e^2)
 *     n(c) = (tau - rho c + sqrt(rho^2 c^2 + tau^2)) / (2 rho),      p = n(-c),  nu = (tau/n - tau/p)/2,  nu' = tau / (p^2 + n^2)
 */
#include "kpirl_mpc_core.h"

/* Can an inequality be violated? Bounds of decisions can not. */
static int can_be_elastic(const kpirl_mpc_core *core, int row) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions), low = core->n_lower;
  int entry;
  if (row >= kpirl_mpc_n_bounds(core)) return 1;
  entry = row < low ? core->lower[row] : core->upper[row - low];
  return entry >= n_s && entry % n_x < n_s;
}

int kpirl_mpc_is_elastic(const kpirl_mpc_core *core, int row) { return core->penalty > 0 && can_be_elastic(core, row); }

int kpirl_mpc_has_elastic(const kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core);
  int i;
  for (i = 0; i < m; ++i)
    if (can_be_elastic(core, i)) return 1;
  return kpirl_mpc_n_equalities(core) > 0;
}

/* (width - rho g + sqrt(rho^2 g^2 + width^2)) / (2 rho), without cancellation. */
static real slack(real rho, real width, real g) {
  const real a = width - rho * g, root = kpirl_mpc_root(rho * rho * g * g + width * width);
  return a > 0 ? (a + root) / (2 * rho) : width * g / (root - a);
}

/* phi, with the slope z and the curvature. */
static real penalise_inequality(const kpirl_mpc_core *core, real g, real *z, real *curvature) {
  const real rho = core->penalty, tau = core->tau, y = slack(rho, 2 * tau, g), e = slack(rho, 2 * tau, -g);
  *z = tau / y;
  *curvature = tau / (y * y + e * e);
  return rho * e - tau * KPIRL_MPC_MATH(log)(y * e);
}

/* psi, with the slope nu and the curvature. */
static real penalise_equality(const kpirl_mpc_core *core, real c, real *nu, real *curvature) {
  const real rho = core->penalty, tau = core->tau, n = slack(rho, tau, c), p = slack(rho, tau, -c);
  *nu = (tau / n - tau / p) / 2;
  *curvature = tau / (p * p + n * n);
  return rho * (p + n) - tau * KPIRL_MPC_MATH(log)(p * n);
}

real kpirl_mpc_penalty(const kpirl_mpc_core *core, const real *g, const real *c) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  real sum = 0, slope, curvature;
  int i;
  for (i = 0; i < m; ++i)
    if (kpirl_mpc_is_elastic(core, i)) sum += penalise_inequality(core, g[i], &slope, &curvature);
  for (i = 0; i < n_c; ++i) sum += penalise_equality(core, c[i], &slope, &curvature);
  return sum;
}

/* y and z of elastic rows, so that z / y is the curvature and the step's force is the slope, see kpirl_mpc_newton.c. */
void kpirl_mpc_relax(kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  real curvature;
  int i;
  for (i = 0; i < m; ++i) {
    if (!kpirl_mpc_is_elastic(core, i)) continue;
    penalise_inequality(core, core->d.g[i], &core->at.z[i], &curvature);
    core->at.y[i] = core->at.z[i] / curvature;
  }
  for (i = 0; i < n_c; ++i) penalise_equality(core, core->d.c[i], &core->at.nu[i], &core->stiffness[i]);
}

/* The derivative of the penalty along the step, of which elastic rows are no part: nothing limits its length for them. */
void kpirl_mpc_let_go(kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  const kpirl_mpc_iterate *at = &core->at;
  kpirl_mpc_step *step = &core->step;
  int i;
  step->penalty_slope = 0;
  for (i = 0; i < m; ++i) {
    if (!kpirl_mpc_is_elastic(core, i)) continue;
    step->penalty_slope -= at->z[i] * (core->d.g[i] + at->y[i] + step->change.y[i]);
    step->change.y[i] = step->change.z[i] = 0;
  }
  for (i = 0; i < n_c; ++i) {
    step->penalty_slope += at->nu[i] * (step->change.nu[i] / core->stiffness[i] - core->d.c[i]);
    step->change.nu[i] = 0;
  }
}

/* Slacks of a constraint that is hard again: what is left of it, or of its penalty's. */
void kpirl_mpc_harden(kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core);
  const real rho = core->penalty;
  int i;
  for (i = 0; i < m; ++i) {
    if (!kpirl_mpc_is_elastic(core, i)) continue;
    core->at.y[i] = kpirl_mpc_larger(-core->d.g[i], slack(rho, 2 * core->tau, core->d.g[i]));
    core->at.z[i] = 0;
  }
  core->penalty = 0;
}
