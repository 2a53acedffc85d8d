/* SPDX-License-Identifier: MIT
 *
 * What the interface needs of a solver, and a solver of the interface.
 */
#ifndef KPIRL_MPC_CONTROLLER_H
#define KPIRL_MPC_CONTROLLER_H

#include "kpirl_mpc_functions.h"
#include "kpirl_mpc_memory.h"
#include "kpirl_mpc_model.h"

/* What was exported, in kpirl_mpc_data.c. Bounds are of x; a given entry of s_0 has none. */
extern const kpirl_mpc_settings kpirl_mpc_exported_settings;
extern const kpirl_mpc_real kpirl_mpc_exported_lower[KPIRL_MPC_N_POINT], kpirl_mpc_exported_upper[KPIRL_MPC_N_POINT];
extern const int kpirl_mpc_exported_free[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_FREE)]; /* entries of s_0 */
extern const kpirl_mpc_real kpirl_mpc_exported_psi[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_PARAMETERS)];
extern const kpirl_mpc_real
    kpirl_mpc_exported_schedule[KPIRL_MPC_AT_LEAST_ONE((KPIRL_MPC_HORIZON + 1) * KPIRL_MPC_N_SCHEDULE)];
extern const char kpirl_mpc_exported_version[];

/* ---- a solver: inputs have been checked, and settings, bounds and psi of the controller are valid ---------------- */

/* Make its part of a new controller; 0 if it does not fit. */
int kpirl_mpc_begin(kpirl_mpc *mpc);

/* Does it know these settings? They are in their ranges. */
int kpirl_mpc_knows(const kpirl_mpc_settings *settings);

/* Does it take another schedule than the exported one? */
int kpirl_mpc_follows_schedules(void);

void kpirl_mpc_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                    kpirl_mpc_solution *solution);

kpirl_mpc_status kpirl_mpc_differentiate_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers,
                                              const kpirl_mpc_guess *guess, const kpirl_mpc_solution *solution,
                                              const kpirl_mpc_real *by_states, const kpirl_mpc_real *by_actions,
                                              kpirl_mpc_gradients *gradients);

/* ---- for solvers ------------------------------------------------------------------------------------------------- */

/* Has this memory been through kpirl_mpc_init? */
int kpirl_mpc_is_controller(const kpirl_mpc *mpc);

/* Is this entry of x a given entry of s_0, which is not bounded? */
int kpirl_mpc_is_given(int entry);

/* Feasibility, or the largest of the other two over scale. */
kpirl_mpc_real kpirl_mpc_relative_residual(kpirl_mpc_real stationarity, kpirl_mpc_real feasibility,
                                           kpirl_mpc_real complementarity, kpirl_mpc_real scale);

/* All five. */
void kpirl_mpc_set_residuals(kpirl_mpc_solution *solution, kpirl_mpc_real stationarity, kpirl_mpc_real feasibility,
                             kpirl_mpc_real complementarity, kpirl_mpc_real scale);

/* Is the time of the settings over? `started` is what the clock said when solve was called. */
int kpirl_mpc_out_of_time(const kpirl_mpc *mpc);

/* s_{t+1} = f of x = (s, u) at stage t. */
void kpirl_mpc_step_model(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, int t, const kpirl_mpc_real *x,
                          kpirl_mpc_real *next);

/* x from states and actions, and back. */
void kpirl_mpc_interleave(const kpirl_mpc_real *states, const kpirl_mpc_real *actions, kpirl_mpc_real *x);
void kpirl_mpc_separate(const kpirl_mpc_real *x, kpirl_mpc_real *states, kpirl_mpc_real *actions);

#endif
