/* SPDX-License-Identifier: MIT
 *
 * Elastic constraints (Gill, Murray and Saunders, SNOPT, 2005, section 1.2). In elastic mode inequalities but the bounds of
 * decisions, and equalities but the dynamics, are replaced by their l1 penalty with slacks,
 *
 *     phi(g) = min rho e - tau (log y + log e)        over y, e > 0,  y - e = -g,
 *     psi(c) = min rho (p + n) - tau (log p + log n)  over p, n > 0,  p - n = c,
 *
 * whose minimisers and slopes have closed forms:
 *
 *     y(g) = (2 tau - rho g + sqrt(rho^2 g^2 + 4 tau^2)) / (2 rho),  e = y(-g),  phi' = tau / y,
 *     n(c) = (tau - rho c + sqrt(rho^2 c^2 + tau^2)) / (2 rho),      p = n(-c),  psi' = (tau/n - tau/p) / 2.
 *
 * Multipliers z in (0, rho) and nu in (-rho, rho) are iterates beside x. Newton's method on
 *
 *     y z = tau,  e (rho - z) = tau        and        n (rho + nu) = tau,  p (rho - nu) = tau
 *
 * has the curvatures 1 / (y/z + e/(rho - z)) and 1 / (n/(rho + nu) + p/(rho - nu)). They are phi'' and psi'' where z and nu are the
 * slopes; elsewhere, as where tau has just fallen, steps with phi'' itself would be short ones. But where the Hessian was not positive,
 * z and nu stay the slopes: multipliers that lag hold the method in front of an obstacle more often than not.
 *
 * g and c are divided by the sizes of their gradients first, so that units of constraints change nothing.
 */
#include "kpirl_mpc_method.h"

static const real CENTRE = (real)1e10; /* products of slacks and multipliers are no farther from tau than by this factor */
static const real HEAVY = (real)1e6; /* forces of constraints that mean nothing any more, relative to the gradient of J, or 1 */

/* Can an inequality be violated? Bounds of decisions can not. */
int kpirl_mpc_can_be_elastic(const kpirl_mpc_core *core, int row) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int entry;
  if (row >= kpirl_mpc_n_bounds(core)) return 1;
  entry = kpirl_mpc_bounded_entry(core, row);
  return entry >= n_s && entry % n_x < n_s;
}

int kpirl_mpc_has_elastic(const kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core);
  int i;
  for (i = 0; i < m; ++i)
    if (kpirl_mpc_can_be_elastic(core, i)) return 1;
  return kpirl_mpc_n_equalities(core) > 0;
}

/* (width - rho g + sqrt(rho^2 g^2 + width^2)) / (2 rho), without cancellation. */
static real slack(real rho, real width, real g) {
  const real a = width - rho * g, root = kpirl_mpc_sqrt(rho * rho * g * g + width * width);
  return a > 0 ? (a + root) / (2 * rho) : width * g / (root - a);
}

/* y and e of inequality i where g is its value, and the size of its gradient; n and p of equality i. */
typedef struct { real y, e, size; } inequality_slacks;
typedef struct { real n, p, size; } equality_slacks;

static inequality_slacks slacks_of_inequality(const kpirl_mpc_core *core, int i, real g) {
  const real rho = core->penalty, width = 2 * core->tau, size = core->row_sizes[i];
  const inequality_slacks s = {slack(rho, width, g / size), slack(rho, width, -g / size), size};
  return s;
}

static equality_slacks slacks_of_equality(const kpirl_mpc_core *core, int i, real c) {
  const real rho = core->penalty, width = core->tau, size = core->row_sizes[kpirl_mpc_n_inequalities(core) + i];
  const equality_slacks s = {slack(rho, width, c / size), slack(rho, width, -c / size), size};
  return s;
}

static real slope_of_inequality(const kpirl_mpc_core *core, int i) {
  const inequality_slacks s = slacks_of_inequality(core, i, core->d.g[i]);
  return core->tau / s.y / s.size;
}

static real slope_of_equality(const kpirl_mpc_core *core, int i) {
  const equality_slacks s = slacks_of_equality(core, i, core->d.c[i]);
  return (core->tau / s.n - core->tau / s.p) / 2 / s.size;
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
  real sum = 0;
  int i;
  for (i = 0; i < m; ++i) {
    const inequality_slacks s = slacks_of_inequality(core, i, g[i]);
    if (kpirl_mpc_is_elastic(core, i)) sum += core->penalty * s.e - core->tau * KPIRL_MPC_MATH(log)(s.y * s.e);
  }
  for (i = 0; i < n_c; ++i) {
    const equality_slacks s = slacks_of_equality(core, i, c[i]);
    sum += core->penalty * (s.n + s.p) - core->tau * KPIRL_MPC_MATH(log)(s.n * s.p);
  }
  return sum;
}

/* The slopes of the penalty at the iterate, in place of z of elastic rows and of nu. */
void kpirl_mpc_penalty_slopes(const kpirl_mpc_core *core, real *z, real *nu) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  int i;
  for (i = 0; i < m; ++i)
    if (kpirl_mpc_is_elastic(core, i)) z[i] = slope_of_inequality(core, i);
  for (i = 0; i < n_c; ++i) nu[i] = slope_of_equality(core, i);
}

/* A multiplier between bounds; NaN stays. */
static real within(real z, real least, real most) { return z < least ? least : z > most ? most : z; }

/* The curvatures: stiffness of equalities, and y of elastic rows so that z / y is theirs, see kpirl_mpc_newton.c; of slopes, where these
 * take the place of multipliers. */
void kpirl_mpc_weigh_elastic(kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  const real rho = core->penalty;
  int i;
  if (core->indefinite) kpirl_mpc_penalty_slopes(core, core->at.z, core->at.nu);
  for (i = 0; i < m; ++i) {
    const inequality_slacks s = slacks_of_inequality(core, i, core->d.g[i]);
    const real share = core->tau / CENTRE, z = within(core->at.z[i] * s.size, share / s.y, rho - share / s.e);
    if (!kpirl_mpc_is_elastic(core, i)) continue;
    core->at.z[i] = z / s.size;
    core->at.y[i] = (s.y / z + s.e / (rho - z)) * z * s.size;
  }
  for (i = 0; i < n_c; ++i) {
    const equality_slacks s = slacks_of_equality(core, i, core->d.c[i]);
    const real nu = core->at.nu[i] * s.size;
    core->stiffness[i] = 1 / (s.n / (rho + nu) + s.p / (rho - nu)) / (s.size * s.size);
  }
}

/* How far products of slacks and multipliers are from tau. */
real kpirl_mpc_elastic_complementarity(const kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  const real rho = core->penalty, tau = core->tau;
  real off = 0;
  int i;
  for (i = 0; i < m; ++i) {
    const inequality_slacks s = slacks_of_inequality(core, i, core->d.g[i]);
    const real z = core->at.z[i] * s.size;
    if (!kpirl_mpc_is_elastic(core, i)) continue;
    off = kpirl_mpc_max(kpirl_mpc_max(kpirl_mpc_abs(s.y * z - tau), kpirl_mpc_abs(s.e * (rho - z) - tau)), off);
  }
  for (i = 0; i < n_c; ++i) {
    const equality_slacks s = slacks_of_equality(core, i, core->d.c[i]);
    const real nu = core->at.nu[i] * s.size;
    off = kpirl_mpc_max(kpirl_mpc_max(kpirl_mpc_abs(s.n * (rho + nu) - tau), kpirl_mpc_abs(s.p * (rho - nu) - tau)), off);
  }
  return off;
}

/* The change of a multiplier between `least` and `most` towards a value, no farther than the fraction to the boundary. */
static real change_within(real from, real to, real least, real most) {
  const real lowest = from - KPIRL_MPC_BOUNDARY * (from - least), highest = from + KPIRL_MPC_BOUNDARY * (most - from);
  return kpirl_mpc_max(lowest, kpirl_mpc_min(to, highest)) - from;
}

/* Elastic rows limit no step: their slacks follow x, and each multiplier goes as far as it can. Also the derivative of the penalty along
 * the step. */
void kpirl_mpc_elastic_step(kpirl_mpc_core *core) {
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core);
  const kpirl_mpc_iterate *at = &core->at;
  kpirl_mpc_iterate *change = &core->step.change;
  int i;
  core->step.penalty_slope = 0;
  for (i = 0; i < m; ++i) {
    const real dg = -(core->d.g[i] + at->y[i] + change->y[i]);
    if (!kpirl_mpc_is_elastic(core, i)) continue;
    core->step.penalty_slope += slope_of_inequality(core, i) * dg;
    change->y[i] = 0;
    change->z[i] = change_within(at->z[i], at->z[i] + change->z[i], 0, core->penalty / core->row_sizes[i]);
  }
  for (i = 0; i < n_c; ++i) {
    const real most = core->penalty / core->row_sizes[m + i], slope = slope_of_equality(core, i);
    const real dc = change->nu[i] / core->stiffness[i] - core->d.c[i];
    core->step.penalty_slope += slope * dc;
    change->nu[i] = change_within(at->nu[i], slope + core->stiffness[i] * dc, -most, most);
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
