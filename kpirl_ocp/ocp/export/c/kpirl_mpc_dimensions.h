/* SPDX-License-Identifier: MIT
 *
 * The dimensions of the problem are constants.
 */
#ifndef KPIRL_MPC_DIMENSIONS_H
#define KPIRL_MPC_DIMENSIONS_H

#include "kpirl_mpc_config.h"

#define DIM(core, name) ((void)(core), KPIRL_MPC_DIM_##name)

#define KPIRL_MPC_DIM_horizon KPIRL_MPC_HORIZON
#define KPIRL_MPC_DIM_n_states KPIRL_MPC_N_STATES
#define KPIRL_MPC_DIM_n_actions KPIRL_MPC_N_ACTIONS
#define KPIRL_MPC_DIM_n_path KPIRL_MPC_N_PATH
#define KPIRL_MPC_DIM_n_equality KPIRL_MPC_N_PATH_EQUALITY
#define KPIRL_MPC_DIM_n_terminal KPIRL_MPC_N_TERMINAL
#define KPIRL_MPC_DIM_n_terminal_equality KPIRL_MPC_N_TERMINAL_EQUALITY
#define KPIRL_MPC_DIM_n_parameters KPIRL_MPC_N_PARAMETERS
#define KPIRL_MPC_DIM_n_context KPIRL_MPC_N_CONTEXT
#define KPIRL_MPC_DIM_n_schedule KPIRL_MPC_N_SCHEDULE

#endif
