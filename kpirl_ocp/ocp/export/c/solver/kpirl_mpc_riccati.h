/* SPDX-License-Identifier: MIT
 *
 * The memory of the interior-point method.
 */
#ifndef KPIRL_MPC_RICCATI_H
#define KPIRL_MPC_RICCATI_H

#include "kpirl_mpc.h"

/* Arrays of the core begin at multiples of 64 bytes: at most so much is lost for every one. */
#define KPIRL_MPC_CORE_BYTES                                                                                      \
  (KPIRL_MPC_CORE_HEAD + KPIRL_MPC_CORE_REALS * sizeof(kpirl_mpc_real) + KPIRL_MPC_CORE_INTEGERS * sizeof(int) + \
   (KPIRL_MPC_CORE_ARRAYS + 2) * 64)

typedef struct kpirl_mpc_workspace {
  void *core; /* its head, in `memory` */
  kpirl_mpc_real x[KPIRL_MPC_N_POINT], bounds[KPIRL_MPC_N_POINT]; /* a trajectory, and multipliers of its bounds */
  kpirl_mpc_real path[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_HORIZON * KPIRL_MPC_N_PATH + KPIRL_MPC_N_TERMINAL)];
  kpirl_mpc_real equality[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_HORIZON * KPIRL_MPC_N_PATH_EQUALITY + KPIRL_MPC_N_TERMINAL_EQUALITY)];
  unsigned char memory[KPIRL_MPC_CORE_BYTES];
} kpirl_mpc_workspace;

#endif
