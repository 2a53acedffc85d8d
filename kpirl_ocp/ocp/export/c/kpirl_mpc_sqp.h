/* SPDX-License-Identifier: MIT
 *
 * The arguments and results of the generated solver. w = (s_1 .. s_T, u_0 .. u_{T-1}); its constraints are the defects of
 * the dynamics, then the path constraints.
 */
#ifndef KPIRL_MPC_SQP_H
#define KPIRL_MPC_SQP_H

#include "kpirl_mpc.h"

#define KPIRL_MPC_N_X (KPIRL_MPC_N_STATES + KPIRL_MPC_N_ACTIONS)
#define KPIRL_MPC_N_W (KPIRL_MPC_HORIZON * KPIRL_MPC_N_X)
#define KPIRL_MPC_N_G (KPIRL_MPC_HORIZON * (KPIRL_MPC_N_STATES + KPIRL_MPC_N_PATH))
#define KPIRL_MPC_N_NUMBERS (KPIRL_MPC_N_STATES + KPIRL_MPC_N_PARAMETERS + KPIRL_MPC_N_CONTEXT)

typedef struct kpirl_mpc_workspace {
  kpirl_mpc_real guess[KPIRL_MPC_N_W], lower[KPIRL_MPC_N_W], upper[KPIRL_MPC_N_W], guess_w[KPIRL_MPC_N_W];
  kpirl_mpc_real lower_g[KPIRL_MPC_N_G], upper_g[KPIRL_MPC_N_G], guess_g[KPIRL_MPC_N_G];
  kpirl_mpc_real numbers[KPIRL_MPC_N_NUMBERS]; /* s_0, psi, c */
  kpirl_mpc_real point[KPIRL_MPC_N_STATES + KPIRL_MPC_N_W]; /* s_0, then w */
  kpirl_mpc_real lam_w[KPIRL_MPC_N_W], lam_g[KPIRL_MPC_N_G];
  kpirl_mpc_real defects[KPIRL_MPC_HORIZON * KPIRL_MPC_N_STATES];
  kpirl_mpc_real path[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_HORIZON * KPIRL_MPC_N_PATH)];
  kpirl_mpc_real cost[KPIRL_MPC_HORIZON * KPIRL_MPC_N_X], cost_last[KPIRL_MPC_N_STATES];
  kpirl_mpc_real slope[KPIRL_MPC_HORIZON * KPIRL_MPC_N_X], slope_last[KPIRL_MPC_N_STATES];
} kpirl_mpc_workspace;

#endif
