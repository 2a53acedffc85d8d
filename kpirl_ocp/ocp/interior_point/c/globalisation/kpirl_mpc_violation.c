/* SPDX-License-Identifier: MIT
 *
 * How far an iterate is from feasible: the sum of all violations. Those of the dynamics and of bounds are in units of states and
 * actions, so that metres and millimetres count the same, and states of different units beside each other.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

static const real GROWN = 10;          /* |x| relative to a size that was measured before */
static const real LEAST = (real)0.1;  /* size in violations: what is small where the filter begins may grow */

/* sizes (n_s) = at least sum_j |F_ij x_j|. sums: n_s numbers. */
static void enlarge(int n_s, int n_x, const real *restrict F, const real *x, real *restrict sums, real *sizes) {
  int i, j;
  memset(sums, 0, (size_t)n_s * sizeof(real));
  for (j = 0; j < n_x; ++j)
    for (i = 0; i < n_s; ++i) sums[i] += kpirl_mpc_abs(F[i + j * n_s] * x[j]);
  for (i = 0; i < n_s; ++i) sizes[i] = kpirl_mpc_max(sums[i], sizes[i]);
}

/* Sizes of states and actions: the largest of
 *     |x_i|  and, of a state,  sum_j |df_i / dx_j| |x_j|
 * over the stages. The second is what the linearised dynamics add up, also where that cancels: rounding is relative to it. Without
 * F, for a start, there is no least size. */
void kpirl_mpc_measure(kpirl_mpc_core *core, const real *F) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const int bounds = kpirl_mpc_n_bounds(core), m = kpirl_mpc_n_inequalities(core);
  const real *x = core->at.x;
  real *sizes = core->sizes;
  int i, t;
  memset(sizes, 0, (size_t)n_x * sizeof(real));
  for (t = 0; t <= T; ++t)
    for (i = 0; i < (t < T ? n_x : n_s); ++i) sizes[i] = kpirl_mpc_max(kpirl_mpc_abs(x[t * n_x + i]), sizes[i]);
  for (t = 0; F && t < T; ++t) enlarge(n_s, n_x, F + t * n_s * n_x, x + t * n_x, core->scratch, sizes);
  for (i = 0; i < n_x; ++i)
    sizes[i] = sizes[i] > 0 ? kpirl_mpc_max(F ? LEAST : 0, sizes[i]) : 1;
  for (i = 0; i < m; ++i) core->units[i] = i < bounds ? sizes[kpirl_mpc_bounded_entry(core, i) % n_x] : 1;
}

/* Has a state outgrown its size, because the filter began where it was small? */
int kpirl_mpc_outgrown(const kpirl_mpc_core *core) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int i, t;
  for (t = 0; t <= T; ++t)
    for (i = 0; i < n_s; ++i)
      if (kpirl_mpc_abs(core->at.x[t * n_x + i]) > GROWN * core->sizes[i]) return 1;
  return 0;
}

real kpirl_mpc_norm_in_sizes(const kpirl_mpc_core *core, const real *states, int stages) {
  const int n_s = DIM(core, n_states);
  real sum = 0;
  int i, t;
  for (t = 0; t < stages; ++t)
    for (i = 0; i < n_s; ++i) sum += kpirl_mpc_abs(states[t * n_s + i]) / core->sizes[i];
  return sum;
}

/* What a unit of the violation of the dynamics costs at most: the largest costate, in units of its state. */
real kpirl_mpc_price(const kpirl_mpc_core *core, const real *costates) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states);
  real price = 0;
  int i, t;
  for (t = 0; t < T; ++t)
    for (i = 0; i < n_s; ++i) price = kpirl_mpc_max(kpirl_mpc_abs(costates[t * n_s + i]) * core->sizes[i], price);
  return price;
}

real kpirl_mpc_slack_violation(const kpirl_mpc_core *core, const real *g, const real *y) {
  const int m = kpirl_mpc_n_inequalities(core);
  real sum = 0;
  int i;
  for (i = 0; i < m; ++i)
    if (!kpirl_mpc_is_elastic(core, i))
      sum += kpirl_mpc_abs(kpirl_mpc_slack_residual(core, g[i], y[i])) / core->units[i];
  return sum;
}

real kpirl_mpc_equality_violation(const kpirl_mpc_core *core, const real *c) {
  const int n_x = DIM(core, n_states) + DIM(core, n_actions), n_fixed = core->n_fixed;
  real sum = kpirl_mpc_norm_1(c + n_fixed, kpirl_mpc_n_equalities(core) - n_fixed);
  int i;
  if (core->penalty > 0) return 0;
  for (i = 0; i < n_fixed; ++i) sum += kpirl_mpc_abs(c[i]) / core->sizes[core->fixed[i] % n_x];
  return sum;
}

real kpirl_mpc_violation(const kpirl_mpc_core *core) {
  const kpirl_mpc_derivatives *d = &core->d;
  return kpirl_mpc_norm_in_sizes(core, d->defects, DIM(core, horizon)) + kpirl_mpc_norm_in_sizes(core, d->gap, 1) +
         kpirl_mpc_equality_violation(core, d->c) + kpirl_mpc_slack_violation(core, d->g, core->at.y);
}

/* Of the violation, whose terms are at most about one. */
real kpirl_mpc_violation_rounding(const kpirl_mpc_core *core) {
  return KPIRL_MPC_EPSILON * (real)kpirl_mpc_n_point(core);
}
