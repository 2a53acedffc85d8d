/* SPDX-License-Identifier: MIT
 *
 * How far an iterate is from feasible: the sum of all violations, those of the dynamics in units of their states. Metres and
 * millimetres, and states of different units beside each other, count the same.
 */
#include "kpirl_mpc_method.h"

#include <string.h>

/* The largest of
 *     |x_i|  and, of a state,  sum_j |df_i / dx_j| |x_j|
 * over the stages. The second is what the linearised dynamics add up, also where that cancels: rounding is relative to it. */
void kpirl_mpc_measure(kpirl_mpc_core *core, const real *F) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions), n_w = kpirl_mpc_n_point(core);
  const real *x = core->at.x;
  real *sizes = core->sizes;
  int i, j, t;
  memset(sizes, 0, (size_t)n_x * sizeof(real));
  for (i = 0; i < n_w; ++i) sizes[i % n_x] = kpirl_mpc_max(kpirl_mpc_abs(x[i]), sizes[i % n_x]);
  for (t = 0; F && t < T; ++t)
    for (i = 0; i < n_s; ++i) {
      real sum = 0;
      for (j = 0; j < n_x; ++j) sum += kpirl_mpc_abs(F[(t * n_x + j) * n_s + i] * x[t * n_x + j]);
      sizes[i] = kpirl_mpc_max(sum, sizes[i]);
    }
  for (i = 0; i < n_x; ++i)
    if (!(sizes[i] > 0)) sizes[i] = 1;
}

real kpirl_mpc_norm_in_sizes(const kpirl_mpc_core *core, const real *states, int stages) {
  const int n_s = DIM(core, n_states);
  real sum = 0;
  int i;
  for (i = 0; i < stages * n_s; ++i) sum += kpirl_mpc_abs(states[i]) / core->sizes[i % n_s];
  return sum;
}

real kpirl_mpc_violation(const kpirl_mpc_core *core) {
  const kpirl_mpc_derivatives *d = &core->d;
  const int m = kpirl_mpc_n_inequalities(core);
  real sum = kpirl_mpc_norm_in_sizes(core, d->defects, DIM(core, horizon)) + kpirl_mpc_norm_in_sizes(core, d->gap, 1) +
             (core->penalty > 0 ? 0 : kpirl_mpc_norm_1(d->c, kpirl_mpc_n_equalities(core)));
  int i;
  for (i = 0; i < m; ++i)
    if (!kpirl_mpc_is_elastic(core, i)) sum += kpirl_mpc_abs(kpirl_mpc_slack_residual(core, d->g[i], core->at.y[i]));
  return sum;
}

/* Of the violation. */
real kpirl_mpc_violation_rounding(const kpirl_mpc_core *core) {
  const int bounds = kpirl_mpc_n_bounds(core);
  real sum = kpirl_mpc_n_point(core);
  int i;
  for (i = 0; i < bounds; ++i) sum += kpirl_mpc_abs(core->at.x[kpirl_mpc_bounded_entry(core, i)]);
  return 10 * KPIRL_MPC_EPSILON * sum;
}
