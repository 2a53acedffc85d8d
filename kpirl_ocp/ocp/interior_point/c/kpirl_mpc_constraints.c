/* SPDX-License-Identifier: MIT
 *
 * All constraints but the dynamics: values, and products with their Jacobian.
 */
#include "kpirl_mpc_core.h"

#include <string.h>

int kpirl_mpc_n_point(const kpirl_mpc_core *core) {
  return DIM(core, horizon) * (DIM(core, n_states) + DIM(core, n_actions)) + DIM(core, n_states);
}

static int n_path(const kpirl_mpc_core *core) { return DIM(core, horizon) * DIM(core, n_path) + DIM(core, n_terminal); }

static int n_equality(const kpirl_mpc_core *core) {
  return DIM(core, horizon) * DIM(core, n_equality) + DIM(core, n_terminal_equality);
}

int kpirl_mpc_n_bounds(const kpirl_mpc_core *core) { return core->n_lower + core->n_upper; }

int kpirl_mpc_n_inequalities(const kpirl_mpc_core *core) { return kpirl_mpc_n_bounds(core) + n_path(core); }

int kpirl_mpc_n_equalities(const kpirl_mpc_core *core) { return core->n_fixed + n_equality(core); }

int kpirl_mpc_bounded_entry(const kpirl_mpc_core *core, int row) {
  return row < core->n_lower ? core->lower[row] : core->upper[row - core->n_lower];
}

void kpirl_mpc_inequalities(const kpirl_mpc_core *core, const real *x, const real *path, real *g) {
  const int low = core->n_lower, high = core->n_upper;
  int i;
  for (i = 0; i < low; ++i) g[i] = core->bounds.lower[core->lower[i]] - x[core->lower[i]];
  for (i = 0; i < high; ++i) g[low + i] = x[core->upper[i]] - core->bounds.upper[core->upper[i]];
  memcpy(g + low + high, path, (size_t)n_path(core) * sizeof(real));
}

void kpirl_mpc_equalities(const kpirl_mpc_core *core, const real *x, const real *equality, real *c) {
  int i;
  for (i = 0; i < core->n_fixed; ++i) c[i] = x[core->fixed[i]] - core->bounds.lower[core->fixed[i]];
  memcpy(c + core->n_fixed, equality, (size_t)n_equality(core) * sizeof(real));
}

void kpirl_mpc_gap(const kpirl_mpc_core *core, const real *x, real *gap) {
  int i;
  for (i = 0; i < DIM(core, n_states); ++i) gap[i] = core->numbers.s0[i] - x[i];
  for (i = 0; i < core->bounds.n_free; ++i) gap[core->bounds.free_entries[i]] = 0;
}

void kpirl_mpc_bounds_transposed_times(const kpirl_mpc_core *core, const real *z, const real *nu, real *product) {
  int i;
  for (i = 0; i < core->n_lower; ++i) product[core->lower[i]] -= z[i];
  for (i = 0; i < core->n_upper; ++i) product[core->upper[i]] += z[core->n_lower + i];
  for (i = 0; i < core->n_fixed; ++i) product[core->fixed[i]] += nu[i];
}

void kpirl_mpc_path_times(const kpirl_mpc_core *core, const real *x, real *values) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  kpirl_mpc_stage_rows_times(DIM(core, horizon), n_s, n_x, core->d.G, DIM(core, n_path), DIM(core, n_terminal), x, values);
}

void kpirl_mpc_path_transposed_times(const kpirl_mpc_core *core, const real *z, real *product) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  kpirl_mpc_stage_rows_transposed_times(DIM(core, horizon), n_s, n_x, core->d.G, DIM(core, n_path), DIM(core, n_terminal), z,
                                        product);
}

void kpirl_mpc_equality_times(const kpirl_mpc_core *core, const real *x, real *values) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  kpirl_mpc_stage_rows_times(DIM(core, horizon), n_s, n_x, core->d.E, DIM(core, n_equality), DIM(core, n_terminal_equality), x,
                             values);
}

void kpirl_mpc_equality_transposed_times(const kpirl_mpc_core *core, const real *nu, real *product) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  kpirl_mpc_stage_rows_transposed_times(DIM(core, horizon), n_s, n_x, core->d.E, DIM(core, n_equality),
                                        DIM(core, n_terminal_equality), nu, product);
}

void kpirl_mpc_inequalities_times(const kpirl_mpc_core *core, const real *x, real *values) {
  const int low = core->n_lower, bounds = kpirl_mpc_n_bounds(core);
  int i;
  for (i = 0; i < low; ++i) values[i] = -x[core->lower[i]];
  for (i = low; i < bounds; ++i) values[i] = x[core->upper[i - low]];
  memset(values + bounds, 0, (size_t)n_path(core) * sizeof(real));
  kpirl_mpc_path_times(core, x, values + bounds);
}

void kpirl_mpc_bound_multipliers(const kpirl_mpc_core *core, real *net) {
  const int n_s = DIM(core, n_states);
  int i, next = 0;
  memset(net, 0, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  kpirl_mpc_bounds_transposed_times(core, core->at.z, core->at.nu, net);
  for (i = 0; i < n_s; ++i) {
    if (next < core->bounds.n_free && core->bounds.free_entries[next] == i)
      ++next;
    else
      net[i] = core->d.start_gradient[i];
  }
}
