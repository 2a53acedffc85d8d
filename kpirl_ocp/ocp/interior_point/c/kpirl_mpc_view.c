/* SPDX-License-Identifier: MIT
 *
 * What a solve leaves behind, for its callers.
 */
#include "kpirl_mpc_core.h"

#include <string.h>

void kpirl_mpc_core_view(const kpirl_mpc_core *core, kpirl_mpc_view *view) {
  view->x = core->at.x;
  view->costates = core->at.costates;
  view->path_multipliers = core->at.z + kpirl_mpc_n_bounds(core);
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

void kpirl_mpc_core_gradient(const kpirl_mpc_core *core, real *r) {
  memcpy(r, core->d.unconstrained_gradient, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  kpirl_mpc_path_transposed_times(core, core->at.z + kpirl_mpc_n_bounds(core), r);
  kpirl_mpc_equality_transposed_times(core, core->at.nu + core->n_fixed, r);
}

int kpirl_mpc_put_derivatives(const kpirl_mpc_core *core, real *row) {
  const kpirl_mpc_derivatives *d = &core->d;
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const int n_h = DIM(core, n_path), n_e = DIM(core, n_equality), n_gT = DIM(core, n_terminal), n_eT = DIM(core, n_terminal_equality);
  const real *from[] = {&d->objective, d->defects, d->path, d->equality, d->F, d->G, d->E, d->H};
  const int counts[] = {1, T * n_s, T * n_h + n_gT, T * n_e + n_eT, T * n_s * n_x, T * n_x * n_h + n_s * n_gT,
                        T * n_x * n_e + n_s * n_eT, T * n_x * n_x + n_s * n_s};
  int i, end = kpirl_mpc_n_point(core);
  if (!d->matrices) return 0;
  for (i = 0; i < 8; ++i) {
    if (row && counts[i]) memcpy(row + end, from[i], (size_t)counts[i] * sizeof(real));
    end += counts[i];
  }
  if (row) kpirl_mpc_mirror_stages(T, n_s, n_x, row + end - counts[7]);
  return end;
}

static void set_point(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers, const kpirl_mpc_start *point) {
  const int bounds = kpirl_mpc_n_bounds(core), fixed = core->n_fixed;
  kpirl_mpc_set_numbers(core, numbers);
  memcpy(core->at.x, point->x, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  memcpy(core->at.costates, point->costates, (size_t)(DIM(core, horizon) * DIM(core, n_states)) * sizeof(real));
  memcpy(core->at.z + bounds, point->path, (size_t)(kpirl_mpc_n_inequalities(core) - bounds) * sizeof(real));
  memcpy(core->at.nu + fixed, point->equality, (size_t)(kpirl_mpc_n_equalities(core) - fixed) * sizeof(real));
}

int kpirl_mpc_core_evaluate_at(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers, const kpirl_mpc_start *point, int level) {
  set_point(core, numbers, point);
  core->d.matrices = level == KPIRL_MPC_SECOND;
  kpirl_mpc_evaluate(core, level);
  return core->failed;
}

int kpirl_mpc_core_evaluate_start(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers, const kpirl_mpc_start *point, int level) {
  set_point(core, numbers, point);
  core->d.matrices = 0;
  kpirl_mpc_evaluate_stage_0(core, level);
  return core->failed;
}
