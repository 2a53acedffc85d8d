/* SPDX-License-Identifier: MIT
 *
 * The memory of gradient descent: the actions of all steps, which the derivative walks back along.
 */
#ifndef KPIRL_MPC_DESCENT_H
#define KPIRL_MPC_DESCENT_H

#include "kpirl_mpc.h"

#define KPIRL_MPC_N_U (KPIRL_MPC_HORIZON * KPIRL_MPC_N_ACTIONS)

typedef struct kpirl_mpc_workspace {
  kpirl_mpc_real actions[KPIRL_MPC_MAX_ITERATIONS + 1][KPIRL_MPC_N_U]; /* U_0 .. U_N */
  kpirl_mpc_real gradient[KPIRL_MPC_N_U];                              /* dJ/dU */
  kpirl_mpc_real adjoint[KPIRL_MPC_N_U], masked[KPIRL_MPC_N_U], product[KPIRL_MPC_N_U];
  kpirl_mpc_real states[(KPIRL_MPC_HORIZON + 1) * KPIRL_MPC_N_STATES];
  kpirl_mpc_real costates[KPIRL_MPC_HORIZON * KPIRL_MPC_N_STATES];
} kpirl_mpc_workspace;

#endif
