/* SPDX-License-Identifier: MIT
 *
 * Between a controller and the core of the interior-point method.
 */
#ifndef KPIRL_MPC_INTERFACE_H
#define KPIRL_MPC_INTERFACE_H

#include "kpirl_mpc_controller.h"
#include "kpirl_mpc_core.h"

/* The generated functions, and the patterns of their results; in kpirl_mpc_data.c. `self` of the functions is left open. */
extern const kpirl_mpc_model kpirl_mpc_exported_model;

/* A guess, which may be NULL, as the core takes it; most of it is copied into mpc->work. */
kpirl_mpc_start kpirl_mpc_take_guess(kpirl_mpc *mpc, const kpirl_mpc_guess *guess);

kpirl_mpc_options kpirl_mpc_options_of(const kpirl_mpc *mpc);

#endif
