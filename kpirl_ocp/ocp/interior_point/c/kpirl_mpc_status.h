/* SPDX-License-Identifier: MIT */
#ifndef KPIRL_MPC_STATUS_H
#define KPIRL_MPC_STATUS_H

/* How a call ended. Not negative: what became of the solve, as in Python's Status. Negative: an error of the caller. */
typedef enum kpirl_mpc_status {
  KPIRL_MPC_CONVERGED = 0,       /* the KKT conditions hold to the solver's tolerance */
  KPIRL_MPC_STEPS_TAKEN = 1,     /* all steps were taken, short of stationarity: right for real-time iterations */
  KPIRL_MPC_ITERATION_LIMIT = 2, /* raise max_iterations, or pass a better guess */
  KPIRL_MPC_INFEASIBLE = 3,      /* no feasible point was found nearby: relax the constraints, or pass another guess */
  KPIRL_MPC_STALLED = 4,         /* no further progress was possible */
  KPIRL_MPC_DIVERGED = 5,        /* the iterates diverged, or left the domain of a function */
  KPIRL_MPC_NOT_FINITE = 6,      /* a function returned NaN or infinity */
  KPIRL_MPC_FAILED = 7,          /* the solver could not go on (SQP) */
  KPIRL_MPC_TIME_LIMIT = 8,      /* the caller's clock ran out; the plan is as far as the solver got */
  KPIRL_MPC_NOT_SOLVED = 9,      /* of a gradient: the plan is not a solution, do not believe it */
  KPIRL_MPC_NOT_A_MINIMUM = 10,  /* stationary, but not a minimum: the Hessian is not positive there */
  KPIRL_MPC_ACCEPTABLE = 11,     /* the conditions hold as far as rounding lets them, short of the tolerance */

  KPIRL_MPC_ERROR_NULL = -1,     /* a pointer that must be given is NULL */
  KPIRL_MPC_ERROR_INPUT = -2,    /* an input is NaN or infinite */
  KPIRL_MPC_ERROR_BOUNDS = -3,   /* lower above upper; or others are finite, or coincide, than when exported */
  KPIRL_MPC_ERROR_MEMORY = -4,   /* the memory is too small or not aligned */
  KPIRL_MPC_ERROR_SETTINGS = -5, /* a setting is out of its range */
  KPIRL_MPC_ERROR_CONTROLLER = -6, /* this is no initialised controller */
  KPIRL_MPC_ERROR_UNSUPPORTED = -7 /* the exported solver cannot do this */
} kpirl_mpc_status;

#endif
