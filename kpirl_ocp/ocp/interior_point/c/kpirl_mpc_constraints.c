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

int kpirl_mpc_n_inequalities(const kpirl_mpc_core *core) { return core->n_lower + core->n_upper + n_path(core); }

int kpirl_mpc_n_equalities(const kpirl_mpc_core *core) { return core->n_fixed + n_equality(core); }

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

void kpirl_mpc_push_bounds(const kpirl_mpc_core *core, const real *forces, const real *fixing, real *pushed) {
  int i;
  for (i = 0; i < core->n_lower; ++i) pushed[core->lower[i]] -= forces[i];
  for (i = 0; i < core->n_upper; ++i) pushed[core->upper[i]] += forces[core->n_lower + i];
  for (i = 0; i < core->n_fixed; ++i) pushed[core->fixed[i]] += fixing[i];
}

void kpirl_mpc_path_times(const kpirl_mpc_core *core, const real *matrix, int rows, int last_rows, const real *x,
                          real *values) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int t;
  for (t = 0; rows > 0 && t < T; ++t)
    kpirl_mpc_transposed_times_vector(matrix + t * n_x * rows, n_x, rows, x + t * n_x, values + t * rows);
  if (last_rows > 0)
    kpirl_mpc_transposed_times_vector(matrix + T * n_x * rows, n_s, last_rows, x + T * n_x, values + T * rows);
}

void kpirl_mpc_path_push(const kpirl_mpc_core *core, const real *matrix, int rows, int last_rows, const real *forces,
                         real *pushed) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int t;
  for (t = 0; rows > 0 && t < T; ++t)
    kpirl_mpc_times_vector(matrix + t * n_x * rows, n_x, rows, forces + t * rows, pushed + t * n_x);
  if (last_rows > 0)
    kpirl_mpc_times_vector(matrix + T * n_x * rows, n_s, last_rows, forces + T * rows, pushed + T * n_x);
}

void kpirl_mpc_bound_multipliers(const kpirl_mpc_core *core, real *net) {
  const int n_s = DIM(core, n_states);
  int i, next = 0;
  memset(net, 0, (size_t)kpirl_mpc_n_point(core) * sizeof(real));
  kpirl_mpc_push_bounds(core, core->at.z, core->at.nu, net);
  for (i = 0; i < n_s; ++i) {
    if (next < core->bounds.n_free && core->bounds.free_entries[next] == i)
      ++next;
    else
      net[i] = core->d.start_gradient[i];
  }
}
