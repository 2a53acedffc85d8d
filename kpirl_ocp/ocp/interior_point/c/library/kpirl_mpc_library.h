/* SPDX-License-Identifier: MIT
 *
 * What the method's shared library adds for its user in Python: functions that are evaluated by CasADi, and many solves in a call.
 */
#ifndef KPIRL_MPC_LIBRARY_H
#define KPIRL_MPC_LIBRARY_H

#include "kpirl_mpc_core.h"

/* Functions are called with structures of pointers, see kpirl_mpc_model.h. What is evaluated takes arrays of pointers, in an
 * order of its own: `in` and `out` say which pointer of the structure belongs to every argument and result. */

/* An expression that CasADi's virtual machine evaluates on fixed arrays: `evaluate(buffer)`, then `status(buffer)`. */
typedef struct kpirl_mpc_buffered {
  void (*evaluate)(void *buffer);
  int (*status)(void *buffer);
  void *buffer;
  int n_in, n_out;
  const int *in, *out, *size_in, *size_out;
  real *const *arguments, *const *results;
} kpirl_mpc_buffered;

int kpirl_mpc_evaluate_buffered(void *self, const void *arguments, const void *results);

/* Machine code with CasADi's calling convention, and the memory that it works in. */
typedef struct kpirl_mpc_compiled {
  int (*evaluate)(const real **arguments, real **results, long long *integers, real *reals, int memory);
  int n_in, n_out;
  const int *in, *out;
  const real **arguments;
  real **results;
  long long *integers;
  real *reals;
} kpirl_mpc_compiled;

int kpirl_mpc_evaluate_compiled(void *self, const void *arguments, const void *results);

/* What a solve found, besides its solution. */
typedef struct kpirl_mpc_result {
  kpirl_mpc_residuals residuals;
  real objective;
  int iterations, status;
} kpirl_mpc_result;

/* Solve a problem for several numbers, one after the other. Arrays hold one row for each: s_0, psi and contexts, and the solutions,
 * whose rows are the arrays of kpirl_mpc_solution one behind the other. starts NULL: all from no action. */
void kpirl_mpc_solve_each(kpirl_mpc_core *core, int count, const kpirl_mpc_numbers *numbers, const kpirl_mpc_options *options,
                          const kpirl_mpc_start *starts, real *solutions, kpirl_mpc_result *results);

/* A number that changes with the sizes of the structures: does a library belong to its user? */
int kpirl_mpc_layout(void);

#endif
