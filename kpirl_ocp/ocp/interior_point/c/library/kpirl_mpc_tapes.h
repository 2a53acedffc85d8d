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

/* A vector of integers as it is in C++ libraries for Linux and macOS. */
typedef struct kpirl_mpc_vector {
  long long *begin, *end, *capacity;
} kpirl_mpc_vector;

/* Members of casadi::Function that tell about operation k of a function in scalar operations, and what frees their vectors. */
typedef struct kpirl_mpc_members {
  long long (*kind)(const void *function, long long k);
  double (*constant)(const void *function, long long k);
  kpirl_mpc_vector (*output)(const void *function, long long k), (*input)(const void *function, long long k);
  void (*release)(void *memory);
} kpirl_mpc_members;

/* The first `count` operations, as rows (kind, first and last number of the output, first and last of the input), 0 where there are
 * none; and the constants of those whose kind is `constant`. */
void kpirl_mpc_read_operations(const kpirl_mpc_members *members, const void *function, int count, int constant, int *rows,
                               real *constants);

#endif
