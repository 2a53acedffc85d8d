/* SPDX-License-Identifier: MIT */
#ifndef KPIRL_MPC_NUMBER_H
#define KPIRL_MPC_NUMBER_H

/* double; float in a build with KPIRL_MPC_FLOAT, which whoever includes this then has to define, too. */
#ifdef KPIRL_MPC_FLOAT
typedef float kpirl_mpc_real;
#else
typedef double kpirl_mpc_real;
#endif

#endif
