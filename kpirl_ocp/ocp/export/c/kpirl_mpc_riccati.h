/* SPDX-License-Identifier: MIT
 *
 * The memory of the interior-point method. Points are s_0 .. s_T, u_0 .. u_{T-1} in one array; w is all of it but s_0.
 * Inequalities are the finite lower bounds of w, its finite upper bounds, then path constraints, as g(w) <= 0 with slacks
 * y > 0 and multipliers z > 0. Entries of w whose bounds coincide are equalities with multipliers nu.
 */
#ifndef KPIRL_MPC_RICCATI_H
#define KPIRL_MPC_RICCATI_H

#include "kpirl_mpc.h"

#define KPIRL_MPC_N_X (KPIRL_MPC_N_STATES + KPIRL_MPC_N_ACTIONS)
#define KPIRL_MPC_N_POINT (KPIRL_MPC_N_STATES + KPIRL_MPC_HORIZON * KPIRL_MPC_N_X)
#define KPIRL_MPC_N_COSTATES (KPIRL_MPC_HORIZON * KPIRL_MPC_N_STATES)
#define KPIRL_MPC_N_BOUNDS (KPIRL_MPC_N_LOWER + KPIRL_MPC_N_UPPER)
#define KPIRL_MPC_N_FORCES (KPIRL_MPC_HORIZON * KPIRL_MPC_N_PATH)
#define KPIRL_MPC_N_ROWS (KPIRL_MPC_N_BOUNDS + KPIRL_MPC_N_FORCES)

/* Room for n numbers. */
#define KPIRL_MPC_ROOM(n) KPIRL_MPC_AT_LEAST_ONE(n)

typedef struct kpirl_mpc_iterate {
  kpirl_mpc_real point[KPIRL_MPC_N_POINT];
  kpirl_mpc_real costates[KPIRL_MPC_N_COSTATES];
  kpirl_mpc_real y[KPIRL_MPC_ROOM(KPIRL_MPC_N_ROWS)], z[KPIRL_MPC_ROOM(KPIRL_MPC_N_ROWS)];
  kpirl_mpc_real nu[KPIRL_MPC_ROOM(KPIRL_MPC_N_FIXED)];
} kpirl_mpc_iterate;

/* A Newton step, and the longest lengths that keep y and z positive. */
typedef struct kpirl_mpc_step {
  kpirl_mpc_iterate change;
  kpirl_mpc_real pivots[KPIRL_MPC_HORIZON * KPIRL_MPC_N_ACTIONS];
  kpirl_mpc_real gains[KPIRL_MPC_N_ACTIONS * KPIRL_MPC_N_STATES * KPIRL_MPC_HORIZON]; /* du = .. + K ds */
  kpirl_mpc_real tau, primal_length, dual_length, regularisation; /* tau: that it leads towards */
  int positive;
} kpirl_mpc_step;

/* What is known at an iterate. Matrices of all stages lie side by side, by columns: F (n_s, n_x T), G (n_h, n_x T),
 * H (n_x, n_x T). r and r_last are the gradient of the Lagrangian of dynamics and path constraints, by stage. */
typedef struct kpirl_mpc_derivatives {
  kpirl_mpc_real objective, violation, scale;
  kpirl_mpc_real cost_gradient[KPIRL_MPC_N_POINT];
  kpirl_mpc_real gradient[KPIRL_MPC_N_POINT]; /* of the Lagrangian, bounds included; s_0 does not count */
  kpirl_mpc_real defects[KPIRL_MPC_N_COSTATES];
  kpirl_mpc_real gap[KPIRL_MPC_N_STATES]; /* the given s_0 minus that of the iterate */
  kpirl_mpc_real off[KPIRL_MPC_ROOM(KPIRL_MPC_N_FIXED)];
  kpirl_mpc_real rows[KPIRL_MPC_ROOM(KPIRL_MPC_N_ROWS)]; /* g */
  kpirl_mpc_real r[KPIRL_MPC_HORIZON * KPIRL_MPC_N_X], r_last[KPIRL_MPC_N_STATES];
  kpirl_mpc_real F[KPIRL_MPC_N_STATES * KPIRL_MPC_N_X * KPIRL_MPC_HORIZON];
  kpirl_mpc_real G[KPIRL_MPC_ROOM(KPIRL_MPC_N_PATH * KPIRL_MPC_N_X * KPIRL_MPC_HORIZON)];
  kpirl_mpc_real H[KPIRL_MPC_N_X * KPIRL_MPC_N_X * KPIRL_MPC_HORIZON];
  kpirl_mpc_real H_last[KPIRL_MPC_N_STATES * KPIRL_MPC_N_STATES];
} kpirl_mpc_derivatives;

/* Pairs (theta, phi) of violation and objective that no later iterate may be worse than in both; at most one is added
 * in an iteration. largest: theta above which nothing is accepted. small: theta below which the objective decides. */
typedef struct kpirl_mpc_filter {
  kpirl_mpc_real largest, small;
  kpirl_mpc_real theta[KPIRL_MPC_MAX_ITERATIONS], phi[KPIRL_MPC_MAX_ITERATIONS];
  int count;
} kpirl_mpc_filter;

typedef struct kpirl_mpc_workspace {
  int lower[KPIRL_MPC_ROOM(KPIRL_MPC_N_LOWER)], upper[KPIRL_MPC_ROOM(KPIRL_MPC_N_UPPER)]; /* entries of w */
  int fixed[KPIRL_MPC_ROOM(KPIRL_MPC_N_FIXED)];
  kpirl_mpc_real bounds[KPIRL_MPC_ROOM(KPIRL_MPC_N_BOUNDS)]; /* of lower, then upper */
  kpirl_mpc_real values[KPIRL_MPC_ROOM(KPIRL_MPC_N_FIXED)];
  kpirl_mpc_iterate iterate, trial;
  kpirl_mpc_derivatives at;
  kpirl_mpc_step step;
  kpirl_mpc_filter filter;
  kpirl_mpc_solution scratch; /* for its residuals */
  kpirl_mpc_real path[KPIRL_MPC_ROOM(KPIRL_MPC_N_FORCES)];
  kpirl_mpc_real columns[KPIRL_MPC_HORIZON * KPIRL_MPC_N_X];
  kpirl_mpc_real last[KPIRL_MPC_N_STATES];
  kpirl_mpc_real tau, tolerance, regularisation;
  int iterations;
  int matrices; /* are those in `at` of this iterate? */
} kpirl_mpc_workspace;

#endif
