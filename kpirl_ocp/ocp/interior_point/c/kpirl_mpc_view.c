/* SPDX-License-Identifier: MIT
 *
 * What a solve leaves behind, for its callers.
 */
#include "kpirl_mpc_core.h"

#include <string.h>

void kpirl_mpc_core_view(const kpirl_mpc_core *core, kpirl_mpc_view *view) {
  view->x = core->at.x;
  view->costates = core->at.costates;
  view->path_multipliers = core->at.z + core->n_lower + core->n_upper;
  view->equality_multipliers = core->at.nu + core->n_fixed;
  view->defects = core->d.defects;
  view->path = core->d.path;
  view->equality = core->d.equality;
  view->gradient = core->d.gradient;
  view->F = core->d.F;
  view->G = core->d.G;
  view->E = core->d.E;
  view->H = core->d.H;
  view->objective = core->d.objective;
  view->tau = core->tau;
  view->iterations = core->iterations;
  view->matrices = core->d.matrices;
}

/* Columns of stage t (n_x, rows), of s_T (n_s, last_rows), as rows. */
static void transpose_rows(const kpirl_mpc_core *core, const real *columns, int rows, int last_rows, real *transposed) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int t;
  for (t = 0; t < T; ++t) kpirl_mpc_transpose(columns + t * n_x * rows, n_x, rows, transposed + t * n_x * rows);
  kpirl_mpc_transpose(columns + T * n_x * rows, n_s, last_rows, transposed + T * n_x * rows);
}

void kpirl_mpc_core_derivatives(const kpirl_mpc_core *core, real *r, real *G, real *E, real *H) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const kpirl_mpc_derivatives *d = &core->d;
  int t;
  memcpy(r, d->slope, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  kpirl_mpc_path_push(core, d->G, DIM(core, n_path), DIM(core, n_terminal), core->at.z + core->n_lower + core->n_upper, r);
  kpirl_mpc_path_push(core, d->E, DIM(core, n_equality), DIM(core, n_terminal_equality), core->at.nu + core->n_fixed, r);
  transpose_rows(core, d->G, DIM(core, n_path), DIM(core, n_terminal), G);
  transpose_rows(core, d->E, DIM(core, n_equality), DIM(core, n_terminal_equality), E);
  memcpy(H, d->H, (size_t)(T * n_x * n_x + n_s * n_s) * sizeof(real));
  for (t = 0; t < T; ++t) kpirl_mpc_mirror(H + t * n_x * n_x, n_x);
  kpirl_mpc_mirror(H + T * n_x * n_x, n_s);
}
