/* SPDX-License-Identifier: MIT
 *
 * The controller as a complete type, for those who want it in static memory. Its members are private.
 */
#ifndef KPIRL_MPC_MEMORY_H
#define KPIRL_MPC_MEMORY_H

#include "kpirl_mpc.h"

/* Numbers in x = (s_0, u_0, s_1, .., u_{T-1}, s_T). */
#define KPIRL_MPC_N_POINT (KPIRL_MPC_HORIZON * (KPIRL_MPC_N_STATES + KPIRL_MPC_N_ACTIONS) + KPIRL_MPC_N_STATES)

#include KPIRL_MPC_WORKSPACE /* the type kpirl_mpc_workspace of the exported solver */

/* What generated functions work in. */
typedef struct kpirl_mpc_scratch {
  const kpirl_mpc_real *arguments[KPIRL_MPC_WORK_ARGUMENTS];
  kpirl_mpc_real *results[KPIRL_MPC_WORK_RESULTS];
  int integers[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_WORK_INTEGERS)];
  kpirl_mpc_real reals[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_WORK_REALS)];
} kpirl_mpc_scratch;

struct kpirl_mpc {
  const void *self; /* its own address: tells a controller from other memory, and from one that was moved */
  double started;   /* what the clock said when solve was called */
  kpirl_mpc_settings settings;
  kpirl_mpc_real lower[KPIRL_MPC_N_POINT], upper[KPIRL_MPC_N_POINT]; /* bounds of x */
  kpirl_mpc_real psi[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_PARAMETERS)];
  kpirl_mpc_scratch scratch;
  kpirl_mpc_workspace work;
};

#endif
