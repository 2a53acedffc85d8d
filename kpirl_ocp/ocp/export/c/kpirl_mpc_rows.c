/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_rows.h"

#include <tgmath.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON, NW = KPIRL_MPC_N_POINT - NS };
enum { LOWER = KPIRL_MPC_N_LOWER, UPPER = KPIRL_MPC_N_UPPER, FIXED = KPIRL_MPC_N_FIXED };
enum { BOUNDS = KPIRL_MPC_N_BOUNDS, FORCES = KPIRL_MPC_N_FORCES, STATES = (T + 1) * NS };

typedef kpirl_mpc_real real;

real kpirl_mpc_bound_of(const real *state, const real *action, int entry) {
  return entry < T * NS ? state[entry % NS] : action[(entry - T * NS) % NU];
}

void kpirl_mpc_sort_bounds(kpirl_mpc *mpc) {
  kpirl_mpc_workspace *work = &mpc->work;
  const kpirl_mpc_bounds *bounds = &mpc->bounds;
  int entry, low = 0, high = 0, fixed = 0;
  for (entry = 0; entry < NW; ++entry) {
    const real lower = kpirl_mpc_bound_of(bounds->state_lower, bounds->action_lower, entry);
    const real upper = kpirl_mpc_bound_of(bounds->state_upper, bounds->action_upper, entry);
    if (lower == upper) {
      work->values[fixed] = lower;
      work->fixed[fixed++] = entry;
      continue;
    }
    if (isfinite(lower)) {
      work->bounds[low] = lower;
      work->lower[low++] = entry;
    }
    if (isfinite(upper)) {
      work->bounds[LOWER + high] = upper;
      work->upper[high++] = entry;
    }
  }
}

void kpirl_mpc_evaluate_rows(const kpirl_mpc_workspace *work, const real *w, const real *path, real *g) {
  int i;
  for (i = 0; i < LOWER; ++i) g[i] = work->bounds[i] - w[work->lower[i]];
  for (i = 0; i < UPPER; ++i) g[LOWER + i] = w[work->upper[i]] - work->bounds[LOWER + i];
  for (i = 0; i < FORCES; ++i) g[BOUNDS + i] = path[i];
}

void kpirl_mpc_push(const kpirl_mpc_workspace *work, const kpirl_mpc_iterate *at, real *w) {
  int i;
  for (i = 0; i < LOWER; ++i) w[work->lower[i]] -= at->z[i];
  for (i = 0; i < UPPER; ++i) w[work->upper[i]] += at->z[LOWER + i];
  for (i = 0; i < FIXED; ++i) w[work->fixed[i]] += at->nu[i];
}

void kpirl_mpc_evaluate_path(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const real *point) {
  const real *arguments[4];
  real *results[3] = {NULL, NULL, NULL};
  if (FORCES == 0) return;
  arguments[0] = point;
  arguments[1] = point + STATES;
  arguments[2] = numbers->psi;
  arguments[3] = numbers->context;
  results[2] = mpc->work.path;
  kpirl_mpc_call(mpc, kpirl_mpc_stage_values, 4, arguments, 3, results);
}
