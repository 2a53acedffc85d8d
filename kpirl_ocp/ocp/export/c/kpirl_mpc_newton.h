/* SPDX-License-Identifier: MIT
 *
 * The iterates of the interior-point method, and what is computed at them. All work in mpc->work.
 */
#ifndef KPIRL_MPC_NEWTON_H
#define KPIRL_MPC_NEWTON_H

#include "kpirl_mpc_memory.h"

/* Everything that a Newton step needs at the iterate, or without matrices what residuals need. */
void kpirl_mpc_differentiate(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, int matrices);

/* S, U, Lambda and M of the iterate, and defects, path, r, r_T, F, G, H and H_T of stage_second there; 0 if they are not
 * known. For programs that go on from them in the same memory. */
int kpirl_mpc_known(const kpirl_mpc *mpc, const kpirl_mpc_real **arguments, const kpirl_mpc_real **results);

/* The Newton step towards work.tau at an iterate whose derivatives are finite. */
void kpirl_mpc_find_step(kpirl_mpc *mpc, kpirl_mpc_real regularisation);

/* The same, towards a tau between least and most that it chooses, with Mehrotra's correction. */
void kpirl_mpc_find_corrected_step(kpirl_mpc *mpc, kpirl_mpc_real least, kpirl_mpc_real most);

/* work.trial: the point after a step of this length along the dynamics; its theta and phi. */
void kpirl_mpc_try(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, kpirl_mpc_real length, kpirl_mpc_real *theta,
                   kpirl_mpc_real *phi);

/* Slacks no smaller than what is left of the constraint, and multipliers near tau / y. */
void kpirl_mpc_centre(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers);

/* Half the length; or more, up to what would have kept the share 1 - BOUNDARY of slacks that shrank too much on the way to
 * work.trial. */
kpirl_mpc_real kpirl_mpc_shortened(const kpirl_mpc_workspace *work, kpirl_mpc_real length);

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
