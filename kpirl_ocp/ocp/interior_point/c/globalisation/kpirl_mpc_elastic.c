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
 *
 * g and c are divided by the sizes of their gradients first, so that units of constraints change nothing.
 */
#include "kpirl_mpc_method.h"

static const real HEAVY = (real)1e6; /* forces of constraints that mean nothing any more, relative to the gradient of J, or 1 */

/* Can an inequality be violated? Bounds of decisions can not. */
static int can_be_elastic(const kpirl_mpc_core *core, int row) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int entry;
  if (row >= kpirl_mpc_n_bounds(core)) return 1;
  entry = kpirl_mpc_bounded_entry(core, row);
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
  const real a = width - rho * g, root = kpirl_mpc_sqrt(rho * rho * g * g + width * width);
  return a > 0 ? (a + root) / (2 * rho) : width * g / (root - a);
}

/* phi of inequality i, with the slope z and the curvature. */
static real penalise_inequality(const kpirl_mpc_core *core, int i, real g, real *z, real *curvature) {
  const real rho = core->penalty, tau = core->tau, size = core->row_sizes[i];
  const real y = slack(rho, 2 * tau, g / size), e = slack(rho, 2 * tau, -g / size);
  *z = tau / y / size;
  *curvature = tau / (y * y + e * e) / (size * size);
  return rho * e - tau * KPIRL_MPC_MATH(log)(y * e);
}

/* psi of equality i, with the slope nu and the curvature. */
static real penalise_equality(const kpirl_mpc_core *core, int i, real c, real *nu, real *curvature) {
  const real rho = core->penalty, tau = core->tau, size = core->row_sizes[kpirl_mpc_n_inequalities(core) + i];
  const real n = slack(rho, tau, c / size), p = slack(rho, tau, -c / size);
  *nu = (tau / n - tau / p) / 2 / size;
  *curvature = tau / (p * p + n * n) / (size * size);
  return rho * (p + n) - tau * KPIRL_MPC_MATH(log)(p * n);
}

/* The largest entry of columns of `stages` matrices (rows, .), `stride` numbers from one to the next; 1 where all are zero. */
static real size_of(const real *column, int rows, int stages, int stride) {
  real size = 0;
  int t;
  for (t = 0; t < stages; ++t) size = kpirl_mpc_max(kpirl_mpc_norm_inf(column + (size_t)t * stride, rows), size);
  return size > 0 ? size : 1;
}

/* Of rows of all stages, one size for each row; then of those of the end. */
static void sizes_of(const kpirl_mpc_core *core, const real *matrix, int rows, int last_rows, real *sizes) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int i;
  for (i = 0; i < T * rows; ++i) sizes[i] = i < rows ? size_of(matrix + i * n_x, n_x, T, n_x * rows) : sizes[i - rows];
  for (i = 0; i < last_rows; ++i) sizes[T * rows + i] = size_of(matrix + T * n_x * rows + i * n_s, n_s, 1, 0);
}

void kpirl_mpc_measure_rows(kpirl_mpc_core *core) {
  const int bounds = kpirl_mpc_n_bounds(core), m = kpirl_mpc_n_inequalities(core);
  real *of_equalities = core->row_sizes + m;
  int i;
  for (i = 0; i < bounds; ++i) core->row_sizes[i] = 1;
  for (i = 0; i < core->n_fixed; ++i) of_equalities[i] = 1;
  sizes_of(core, core->d.G, DIM(core, n_path), DIM(core, n_terminal), core->row_sizes + bounds);
  sizes_of(core, core->d.E, DIM(core, n_equality), DIM(core, n_terminal_equality), of_equalities + core->n_fixed);
}

/* A force of a constraint is its multiplier times the size of its row. */
int kpirl_mpc_too_heavy(kpirl_mpc_core *core, const real *multipliers, int first, int count) {
  const real most = HEAVY * kpirl_mpc_max(1, kpirl_mpc_norm_inf(core->d.cost_gradient, kpirl_mpc_n_point(core)));
  int i;
  kpirl_mpc_measure_rows(core);
  for (i = 0; i < count; ++i)
    if (kpirl_mpc_abs(multipliers[i]) * core->row_sizes[first + i] > most) return 1;
  return 0;
}

real kpirl_mpc_penalty(const kpirl_mpc_core *core, const real *g, const real *c) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  real sum = 0, slope, curvature;
  int i;
  for (i = 0; i < m; ++i)
    if (kpirl_mpc_is_elastic(core, i)) sum += penalise_inequality(core, i, g[i], &slope, &curvature);
  for (i = 0; i < n_c; ++i) sum += penalise_equality(core, i, c[i], &slope, &curvature);
  return sum;
}

/* y and z of elastic rows, so that z / y is the curvature and the step's force is the slope, see kpirl_mpc_newton.c. */
void kpirl_mpc_relax(kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  real curvature;
  int i;
  for (i = 0; i < m; ++i) {
    if (!kpirl_mpc_is_elastic(core, i)) continue;
    penalise_inequality(core, i, core->d.g[i], &core->at.z[i], &curvature);
    core->at.y[i] = core->at.z[i] / curvature;
  }
  for (i = 0; i < n_c; ++i) penalise_equality(core, i, core->d.c[i], &core->at.nu[i], &core->stiffness[i]);
}

/* The derivative of the penalty along the step, of which elastic rows are no part: nothing limits its length for them. */
void kpirl_mpc_elastic_step(kpirl_mpc_core *core) {
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
    const real size = core->row_sizes[i];
    if (!kpirl_mpc_is_elastic(core, i)) continue;
    core->at.y[i] = kpirl_mpc_max(-core->d.g[i], size * slack(rho, 2 * core->tau, core->d.g[i] / size));
    core->at.z[i] = 0;
  }
  core->penalty = 0;
}
