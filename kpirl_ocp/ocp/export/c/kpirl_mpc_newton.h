/* SPDX-License-Identifier: MIT
 *
 * The iterates of the interior-point method, and what is computed at them. All work in mpc->work.
 */
#ifndef KPIRL_MPC_NEWTON_H
#define KPIRL_MPC_NEWTON_H

#include "kpirl_mpc_memory.h"

/* Sort the bounds into inequalities and fixed entries of w. */
void kpirl_mpc_sort_bounds(kpirl_mpc *mpc);

/* A cold start at a trajectory, or at the rollout of no action: inside the bounds, without multipliers. */
void kpirl_mpc_start(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess);

/* A warm start: slacks and multipliers of the guess, lifted until their products are at least tau. */
void kpirl_mpc_warm_start(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                          kpirl_mpc_real tau);

/* The solution of the problem smoothed with tau > 0: slacks as they are, multipliers tau / y. Only the difference of the
 * multipliers of two bounds on one entry is in a solution, which is too little to tell both. */
void kpirl_mpc_stand_at(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                        kpirl_mpc_real tau);

/* Everything that a Newton step needs at the iterate, or without matrices what residuals need. */
void kpirl_mpc_differentiate(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, int matrices);

/* The Newton step at an iterate whose derivatives are finite. */
void kpirl_mpc_find_step(kpirl_mpc *mpc, kpirl_mpc_real regularisation);

/* work.trial: the point after a step of this length along the dynamics; its theta and phi. */
void kpirl_mpc_try(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, kpirl_mpc_real length, kpirl_mpc_real *theta,
                   kpirl_mpc_real *phi);

/* Slacks no smaller than what is left of the constraint, and multipliers near tau / y. */
void kpirl_mpc_centre(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers);

/* sum of log y. */
kpirl_mpc_real kpirl_mpc_log_slacks(const kpirl_mpc_real *y);

/* Is no value and no first derivative NaN or infinite? */
int kpirl_mpc_finite(const kpirl_mpc *mpc);

/* Are the matrices? */
int kpirl_mpc_matrices_finite(const kpirl_mpc *mpc);

/* The first-order conditions at the iterate, with complementarity tau. */
void kpirl_mpc_residuals(const kpirl_mpc *mpc, kpirl_mpc_real tau, kpirl_mpc_solution *solution);

/* Trajectory and multipliers of the iterate. */
void kpirl_mpc_write(const kpirl_mpc *mpc, kpirl_mpc_solution *solution);

#endif
