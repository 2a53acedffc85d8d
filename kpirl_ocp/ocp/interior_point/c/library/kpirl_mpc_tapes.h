/* SPDX-License-Identifier: MIT
 *
 * Functions of stages as tapes of operations, for problems that are not compiled.
 */
#ifndef KPIRL_MPC_TAPES_H
#define KPIRL_MPC_TAPES_H

#include "kpirl_mpc_model.h"

/* One operation on numbered slots; kinds and operands: see kpirl_mpc_tapes.c. */
typedef struct kpirl_mpc_operation {
  int kind, to, from, other;
} kpirl_mpc_operation;

/* A function of a stage as a list of operations, whose results go into dense arrays. */
typedef struct kpirl_mpc_tape {
  const kpirl_mpc_operation *operations;
  const real *constants;
  int n_operations;
} kpirl_mpc_tape;

/* Tapes of a stage and of the end, and their memory: slots of kpirl_mpc_lanes() numbers, and a cost for each stage. */
typedef struct kpirl_mpc_tapes {
  kpirl_mpc_tape stage, last;
  kpirl_mpc_dimensions dimensions;
  const real *schedule;
  real *slots, *costs;
} kpirl_mpc_tapes;

int kpirl_mpc_evaluate_tapes(void *self, const kpirl_mpc_horizon_arguments *arguments, const kpirl_mpc_horizon_results *results);

/* How many stages are evaluated side by side. */
int kpirl_mpc_lanes(void);

#endif
