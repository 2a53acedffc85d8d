/* SPDX-License-Identifier: MIT
 *
 * The constraints other than the dynamics, as rows g(w) <= 0 and fixed entries of w = (s_1 .. s_T, u_0 .. u_{T-1}).
 * Rows: finite lower bounds of w, finite upper bounds, path constraints.
 */
#ifndef KPIRL_MPC_ROWS_H
#define KPIRL_MPC_ROWS_H

#include "kpirl_mpc_memory.h"

/* Sort the bounds into inequalities and fixed entries of w. */
void kpirl_mpc_sort_bounds(kpirl_mpc *mpc);

/* A bound of an entry of w, from those of a state and of an action. */
kpirl_mpc_real kpirl_mpc_bound_of(const kpirl_mpc_real *state, const kpirl_mpc_real *action, int entry);

/* g at w with path constraints h (T n_h). */
void kpirl_mpc_evaluate_rows(const kpirl_mpc_workspace *work, const kpirl_mpc_real *w, const kpirl_mpc_real *path,
                             kpirl_mpc_real *g);

/* Add the gradient of z . g over the bounds, and of nu . w_fixed. */
void kpirl_mpc_push(const kpirl_mpc_workspace *work, const kpirl_mpc_iterate *at, kpirl_mpc_real *w);

/* work.path: the path constraints at a point. */
void kpirl_mpc_evaluate_path(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_real *point);

#endif
