/* SPDX-License-Identifier: MIT
 *
 * The arguments and results of the generated solver. w = (s_0 .. s_T, u_0 .. u_{T-1}). Its rows are equalities, first the
 * defects of the dynamics, then inequalities; there are KPIRL_MPC_N_ROWS, of which KPIRL_MPC_N_EQUALITIES.
 */
#ifndef KPIRL_MPC_SQP_H
#define KPIRL_MPC_SQP_H

#include "kpirl_mpc.h"

typedef struct kpirl_mpc_workspace {
  kpirl_mpc_real guess[KPIRL_MPC_N_POINT], lower[KPIRL_MPC_N_POINT], upper[KPIRL_MPC_N_POINT], guess_w[KPIRL_MPC_N_POINT];
  kpirl_mpc_real lower_rows[KPIRL_MPC_N_ROWS], upper_rows[KPIRL_MPC_N_ROWS], guess_rows[KPIRL_MPC_N_ROWS];
  kpirl_mpc_real numbers[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_PARAMETERS + KPIRL_MPC_N_CONTEXT)]; /* psi, c */
  kpirl_mpc_real w[KPIRL_MPC_N_POINT], of_w[KPIRL_MPC_N_POINT], of_rows[KPIRL_MPC_N_ROWS]; /* found, with multipliers */
  kpirl_mpc_real rows[KPIRL_MPC_N_ROWS], cost_gradient[KPIRL_MPC_N_POINT], gradient[KPIRL_MPC_N_POINT];
  int iterations, out_of_time; /* quadratic programs solved; was it the clock that stopped it? */
} kpirl_mpc_workspace;

#endif
