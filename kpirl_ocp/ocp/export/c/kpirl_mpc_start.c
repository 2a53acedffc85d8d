/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_start.h"
#include "kpirl_mpc_rows.h"

#include <string.h>
#include <tgmath.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON, STATES = (T + 1) * NS };
enum { LOWER = KPIRL_MPC_N_LOWER, UPPER = KPIRL_MPC_N_UPPER, FIXED = KPIRL_MPC_N_FIXED };
enum { BOUNDS = KPIRL_MPC_N_BOUNDS, FORCES = KPIRL_MPC_N_FORCES, ROWS = KPIRL_MPC_N_ROWS };

typedef kpirl_mpc_real real;

static const real PUSH = (real)1e-2; /* how far a cold start is moved inside its bounds, relative to size and distance */

static real larger(real a, real b) { return a > b ? a : b; }
static real smaller(real a, real b) { return a < b ? a : b; }

/* w moved inside its bounds (Waechter and Biegler, 2006, section 3.6), and onto them where they coincide. */
static void move_inside(const kpirl_mpc *mpc, real *w) {
  const kpirl_mpc_workspace *work = &mpc->work;
  const kpirl_mpc_bounds *bounds = &mpc->bounds;
  int side, i;
  for (side = 0; side < 2; ++side)
    for (i = 0; i < (side ? UPPER : LOWER); ++i) {
      const int entry = side ? work->upper[i] : work->lower[i];
      const real low = kpirl_mpc_bound_of(bounds->state_lower, bounds->action_lower, entry);
      const real high = kpirl_mpc_bound_of(bounds->state_upper, bounds->action_upper, entry);
      const real margin = PUSH * smaller(larger(1, fabs(side ? high : low)), high - low);
      w[entry] = side ? smaller(w[entry], high - margin) : larger(w[entry], low + margin);
    }
  for (i = 0; i < FIXED; ++i) w[work->fixed[i]] = work->values[i];
}

/* s_0 .. s_T of zero actions. */
static void roll_out(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, real *point) {
  const real *arguments[3];
  real *results[1];
  int t;
  memset(point, 0, KPIRL_MPC_N_POINT * sizeof(real));
  memcpy(point, numbers->state, NS * sizeof(real));
  for (t = 0; t < T; ++t) {
    arguments[0] = point + t * NS;
    arguments[1] = point + STATES + t * NU;
    arguments[2] = numbers->psi;
    results[0] = point + (t + 1) * NS;
    kpirl_mpc_call(mpc, kpirl_mpc_dynamics, 3, arguments, 1, results);
  }
}

static void copy_trajectory(const kpirl_mpc_guess *guess, real *point) {
  memmove(point, guess->states, STATES * sizeof(real));
  memmove(point + STATES, guess->actions, T * NU * sizeof(real));
}

void kpirl_mpc_start(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_iterate *at = &work->iterate;
  real g[KPIRL_MPC_ROOM(KPIRL_MPC_N_ROWS)] = {0};
  int i;
  memset(at, 0, sizeof *at);
  if (guess)
    copy_trajectory(guess, at->point);
  else
    roll_out(mpc, numbers, at->point);
  move_inside(mpc, at->point + NS);
  kpirl_mpc_evaluate_path(mpc, numbers, at->point);
  kpirl_mpc_evaluate_rows(work, at->point + NS, work->path, g);
  for (i = 0; i < BOUNDS; ++i) at->y[i] = -g[i];
  for (i = BOUNDS; i < ROWS; ++i) at->y[i] = larger(-g[i], PUSH);
}

void kpirl_mpc_warm_start(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess, real tau) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_iterate *at = &work->iterate;
  real g[KPIRL_MPC_ROOM(KPIRL_MPC_N_ROWS)] = {0}, pushing[KPIRL_MPC_N_POINT - KPIRL_MPC_N_STATES];
  int i;
  copy_trajectory(guess, at->point);
  memmove(at->costates, guess->dynamics, sizeof at->costates);
  memcpy(pushing, guess->state_bounds, T * NS * sizeof(real));
  memcpy(pushing + T * NS, guess->action_bounds, T * NU * sizeof(real));
  for (i = 0; i < FIXED; ++i) at->nu[i] = pushing[work->fixed[i]];
  for (i = 0; i < LOWER; ++i) at->z[i] = larger(-pushing[work->lower[i]], 0);
  for (i = 0; i < UPPER; ++i) at->z[LOWER + i] = larger(pushing[work->upper[i]], 0);
  for (i = 0; i < FORCES; ++i) at->z[BOUNDS + i] = larger(guess->path[i], 0);
  kpirl_mpc_evaluate_path(mpc, numbers, at->point);
  kpirl_mpc_evaluate_rows(work, at->point + NS, work->path, g);
  for (i = 0; i < ROWS; ++i) {
    const real least = at->z[i] > 0 ? smaller(tau / at->z[i], sqrt(tau)) : sqrt(tau);
    at->y[i] = larger(isnan(g[i]) ? g[i] : larger(-g[i], 0), least);
    at->z[i] = larger(at->z[i], tau / at->y[i]);
  }
}

void kpirl_mpc_stand_at(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess, real tau) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_iterate *at = &work->iterate;
  real g[KPIRL_MPC_ROOM(KPIRL_MPC_N_ROWS)] = {0};
  int i;
  kpirl_mpc_warm_start(mpc, numbers, guess, tau);
  kpirl_mpc_evaluate_rows(work, at->point + NS, work->path, g);
  for (i = 0; i < ROWS; ++i) {
    if (!(g[i] < 0)) continue;
    at->y[i] = -g[i];
    at->z[i] = i < BOUNDS ? tau / at->y[i] : larger(guess->path[i - BOUNDS], 0);
  }
}
