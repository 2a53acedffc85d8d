/* SPDX-License-Identifier: MIT
 *
 * What slacks, forces and steps of a linearised KKT system are compared with, so that no unit counts.
 */
#include "kpirl_mpc_system.h"

#include <string.h>

static const real LEAST = (real)1e-3; /* share of the largest force, in units of the cost, that every force is compared with */

void kpirl_mpc_system_curvature(const kpirl_mpc_system *s, real *curvature) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions;
  int t, i, j, k;
  for (t = 0; t <= T; ++t) {
    const int n = t < T ? n_x : n_s, after = t + 1 < T ? n_x : n_s;
    const real *H = s->H + (size_t)t * n_x * n_x, *F = s->F + (size_t)t * n_s * n_x, *next = H + n_x * n_x;
    for (i = 0; i < n; ++i) {
      real sum = kpirl_mpc_abs(H[i + i * n]);
      for (j = 0; t < T && j < n_s; ++j) {
        real row = 0;
        if (F[j + i * n_s] == 0) continue;
        for (k = 0; k < n_s; ++k)
          row += kpirl_mpc_abs(j > k ? next[j + k * after] : next[k + j * after]) * kpirl_mpc_abs(F[k + i * n_s]);
        sum += kpirl_mpc_abs(F[j + i * n_s]) * row;
      }
      curvature[t * n_x + i] = sum;
    }
  }
}

/* |columns|' values over the stages; or the largest |entry| * value, where `largest`. */
static void measure_rows(const kpirl_mpc_system *s, const real *columns, int rows, int last_rows, const real *values,
                         int largest, real *result) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions;
  int t, r, i;
  for (t = 0; t <= T; ++t) {
    const int n = t < T ? n_x : n_s, count = t < T ? rows : last_rows;
    for (r = 0; r < count; ++r) {
      const real *column = columns + (size_t)t * n_x * rows + r * n;
      real sum = 0;
      for (i = 0; i < n; ++i) {
        const real part = column[i] != 0 ? kpirl_mpc_abs(column[i]) * values[t * n_x + i] : 0;
        sum = !largest ? sum + part : part > sum || isnan(part) ? part : sum;
      }
      result[t * rows + r] = sum;
    }
  }
}

static void measure(const kpirl_mpc_system *s, const real *values, int largest, real *result) {
  const int path = s->n_bounds + s->horizon * s->n_path + s->n_terminal;
  int i;
  for (i = 0; i < s->n_bounds; ++i) result[i] = values[s->entries[i]];
  measure_rows(s, s->G, s->n_path, s->n_terminal, values, largest, result + s->n_bounds);
  measure_rows(s, s->E, s->n_equality, s->n_terminal_equality, values, largest, result + path);
}

void kpirl_mpc_row_sizes(const kpirl_mpc_system *s, real *row_sizes) { measure(s, s->sizes, 0, row_sizes); }

void kpirl_mpc_force_shares(const kpirl_mpc_system *s, const real *costates, const real *curvature, real *shares) {
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  real *balanced = s->scratch, most = 0;
  int t, i, j;
  for (i = 0; i < n_w; ++i) balanced[i] = curvature[i] * s->sizes[i];
  for (t = 0; t < T; ++t)
    for (i = 0; i < n_x; ++i)
      for (j = 0; j < n_s; ++j)
        balanced[t * n_x + i] += kpirl_mpc_abs(s->F[(size_t)t * n_s * n_x + i * n_s + j] * costates[t * n_s + j]);
  for (t = 0; t < T; ++t)
    for (i = 0; i < n_s; ++i) balanced[(t + 1) * n_x + i] += kpirl_mpc_abs(costates[t * n_s + i]);
  for (i = 0; i < n_w; ++i) most = kpirl_mpc_larger(most, balanced[i] * s->sizes[i]);
  for (i = 0; i < n_w; ++i) balanced[i] = 1 / kpirl_mpc_larger(balanced[i], LEAST * most / s->sizes[i]);
  measure(s, balanced, 1, shares);
}
