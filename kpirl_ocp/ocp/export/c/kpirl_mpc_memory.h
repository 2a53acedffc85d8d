/* SPDX-License-Identifier: MIT
 *
 * The controller as a complete type, for those who want it in static memory. Its members are private.
 */
#ifndef KPIRL_MPC_MEMORY_H
#define KPIRL_MPC_MEMORY_H

#include "kpirl_mpc.h"
#include "kpirl_mpc_functions.h"
#include KPIRL_MPC_WORKSPACE /* the type kpirl_mpc_workspace of the exported solver */

/* A bound per entry of a state and of an action. */
typedef struct kpirl_mpc_bounds {
  kpirl_mpc_real state_lower[KPIRL_MPC_N_STATES], state_upper[KPIRL_MPC_N_STATES];
  kpirl_mpc_real action_lower[KPIRL_MPC_N_ACTIONS], action_upper[KPIRL_MPC_N_ACTIONS];
} kpirl_mpc_bounds;

struct kpirl_mpc {
  const void *self; /* its own address: tells a controller from other memory, and from one that was moved */
  double started; /* what the clock said when solve was called */
  kpirl_mpc_settings settings;
  kpirl_mpc_bounds bounds;
  kpirl_mpc_real psi[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_PARAMETERS)];
  kpirl_mpc_workspace work;

  /* what generated functions work in */
  const kpirl_mpc_real *arguments[KPIRL_MPC_WORK_ARGUMENTS];
  kpirl_mpc_real *results[KPIRL_MPC_WORK_RESULTS];
  int integers[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_WORK_INTEGERS)];
  kpirl_mpc_real reals[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_WORK_REALS)];
};

/* A problem with its numbers: what every generated function is called with. */
typedef struct kpirl_mpc_numbers {
  const kpirl_mpc_real *state, *psi, *context;
} kpirl_mpc_numbers;

/* What was exported, in kpirl_mpc_data.c. */
extern const kpirl_mpc_settings kpirl_mpc_exported_settings;
extern const kpirl_mpc_bounds kpirl_mpc_exported_bounds;
extern const kpirl_mpc_real kpirl_mpc_exported_psi[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_PARAMETERS)];
extern const char kpirl_mpc_exported_version[];

/* Call a generated function with `mpc`'s work memory. */
void kpirl_mpc_call(kpirl_mpc *mpc, kpirl_mpc_function *function, int n_arguments, const kpirl_mpc_real *const *arguments,
                    int n_results, kpirl_mpc_real *const *results);

/* What a solver has to offer; inputs have been checked, and `settings`, `bounds` and psi are valid. */
kpirl_mpc_status kpirl_mpc_check_settings(const kpirl_mpc_settings *settings);
void kpirl_mpc_run(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                   kpirl_mpc_solution *solution);
kpirl_mpc_status kpirl_mpc_differentiate_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers,
                                              const kpirl_mpc_guess *guess, const kpirl_mpc_solution *solution,
                                              const kpirl_mpc_real *by_states, const kpirl_mpc_real *by_actions,
                                              kpirl_mpc_gradients *gradients);

/* Small helpers. largest: of the absolute values, 0 for none, NaN if there is one. */
int kpirl_mpc_all_finite(const kpirl_mpc_real *values, int count);
kpirl_mpc_real kpirl_mpc_largest(const kpirl_mpc_real *values, int count);
void kpirl_mpc_set_residuals(kpirl_mpc_solution *solution, kpirl_mpc_real stationarity, kpirl_mpc_real feasibility,
                             kpirl_mpc_real complementarity, kpirl_mpc_real scale);
/* Is the time of the settings over? `started` is what the clock said when solve was called. */
int kpirl_mpc_late(const kpirl_mpc *mpc);

#endif
