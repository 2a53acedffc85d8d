/* SPDX-License-Identifier: MIT
 *
 * Where the interior-point method starts: all set work.iterate.
 */
#ifndef KPIRL_MPC_START_H
#define KPIRL_MPC_START_H

#include "kpirl_mpc_memory.h"

/* A cold start at a trajectory, or at the rollout of no action: inside the bounds, without multipliers. */
void kpirl_mpc_start(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess);

/* A warm start: slacks and multipliers of the guess, lifted until their products are at least tau. */
void kpirl_mpc_warm_start(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                          kpirl_mpc_real tau);

/* The solution of the problem smoothed with tau > 0: slacks as they are, multipliers tau / y. Only the difference of the
 * multipliers of two bounds on one entry is in a solution, which is too little to tell both. */
void kpirl_mpc_stand_at(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                        kpirl_mpc_real tau);

#endif
