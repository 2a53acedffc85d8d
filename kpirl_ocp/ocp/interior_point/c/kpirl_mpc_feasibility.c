/* SPDX-License-Identifier: MIT
 *
 * Is a point infeasible, and stationary for its violation?
 */
#include "kpirl_mpc_core.h"

#include <string.h>

static const real SHARE = (real)0.1; /* of the violation: what no step within reach removes */

/* Gradient by x of half the square of the violations v of dynamics, inequalities and equalities; returns the square. */
static real violation_gradient(const kpirl_mpc_core *core, real *rows, real *gradient) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const int m = kpirl_mpc_n_inequalities(core), n_c = kpirl_mpc_n_equalities(core), bounds = kpirl_mpc_n_bounds(core);
  const kpirl_mpc_derivatives *d = &core->d;
  real *equalities = rows + m;
  int i, t;
  memset(gradient, 0, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  for (i = 0; i < m; ++i) rows[i] = kpirl_mpc_larger(d->g[i], 0);
  memcpy(equalities, d->c, (size_t)n_c * sizeof(real));
  for (t = 0; t < T; ++t) {
    const real *defect = d->defects + t * n_s;
    kpirl_mpc_transposed_times_vector(d->F + t * n_s * n_x, n_s, n_x, defect, gradient + t * n_x);
    kpirl_mpc_axpy(-1, defect, n_s, gradient + (t + 1) * n_x);
  }
  kpirl_mpc_push_bounds(core, rows, equalities, gradient);
  kpirl_mpc_path_push(core, d->G, DIM(core, n_path), DIM(core, n_terminal), rows + bounds, gradient);
  kpirl_mpc_path_push(core, d->E, DIM(core, n_equality), DIM(core, n_terminal_equality), equalities + core->n_fixed, gradient);
  return kpirl_mpc_dot(rows, rows, m + n_c) + kpirl_mpc_dot(d->defects, d->defects, T * n_s);
}

int kpirl_mpc_locally_infeasible(kpirl_mpc_core *core) {
  const int n_w = kpirl_mpc_n_point(core), n_s = DIM(core, n_states);
  real *gradient = core->right, decrease = 0;
  const real square = violation_gradient(core, core->scratch, gradient);
  int i, next = 0;
  if (!(square > core->tolerance)) return 0;
  for (i = 0; i < n_w; ++i) {
    const real x = core->at.x[i];
    const real room = gradient[i] > 0 ? x - core->bounds.lower[i] : core->bounds.upper[i] - x;
    if (i < n_s) { /* given */
      if (next == core->bounds.n_free || core->bounds.free_entries[next] != i) continue;
      ++next;
    }
    decrease += kpirl_mpc_abs(gradient[i]) * kpirl_mpc_smaller(kpirl_mpc_larger(room, 0), 1 + kpirl_mpc_abs(x));
  }
  return decrease <= SHARE * square;
}
