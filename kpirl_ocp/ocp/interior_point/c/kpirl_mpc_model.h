/* SPDX-License-Identifier: MIT
 *
 * A problem as the interior-point method sees it: dimensions, and functions that evaluate its stages.
 *
 *     minimise   sum_{t<T} l(s_t, u_t; psi, c, d_t)  +  l_T(s_T; psi, c, d_T)
 *     subject to s_{t+1} = f(s_t, u_t; psi, c, d_t),   s_0 given (or some of its entries free),   bounds on x_t = (s_t, u_t),
 *                h(x_t; ..) <= 0,  e(x_t; ..) = 0,     h_T(s_T; ..) <= 0,  e_T(s_T; ..) = 0
 *
 * Functions are pointers, so that the method does not know who evaluates: machine code, or an interpreter of expressions.
 */
#ifndef KPIRL_MPC_MODEL_H
#define KPIRL_MPC_MODEL_H

#include "kpirl_mpc_real.h"

typedef struct kpirl_mpc_dimensions {
  int horizon, n_states, n_actions;
  int n_path, n_equality;                  /* rows of h and of e, per stage */
  int n_terminal, n_terminal_equality;     /* rows of h_T and of e_T */
  int n_parameters, n_context, n_schedule; /* lengths of psi, c and d_t */
} kpirl_mpc_dimensions;

/* In an exported controller dimensions are constants. */
#ifdef KPIRL_MPC_FIXED
#include "kpirl_mpc_config.h"
#define DIM(core, name) KPIRL_MPC_FIXED_##name
#else
#define DIM(core, name) ((core)->dimensions.name)
#endif

/* Returns 0 when all went well. Results that are NULL are not wanted. */
typedef struct kpirl_mpc_function {
  int (*evaluate)(void *self, const real *const *arguments, real *const *results);
  void *self;
} kpirl_mpc_function;

/* Where the nonzeros of a result belong in a dense array; entries NULL: the result is dense. */
typedef struct kpirl_mpc_pattern {
  int count;
  const int *entries;
} kpirl_mpc_pattern;

enum { KPIRL_MPC_VALUES, KPIRL_MPC_FIRST, KPIRL_MPC_SECOND, KPIRL_MPC_LEVELS };

/* With z and nu the multipliers of h and e, and r the gradient of l + lambda . f + z . h + nu . e by x (of l_T + z . h_T +
 * nu . e_T by s_T):
 *
 * stage   (x, psi, c, d, lambda, z, nu)     -> l, f, h, e | gradient of l, r | F, G', E', lower triangle of H
 * last    (s, psi, c, d, z, nu)             -> l, h, e    | gradient of l, r | G', E', lower triangle of H
 * horizon (S, U, psi, c, Lambda, Z, N, z_T, nu_T), all stages side by side
 *         -> J, f, h, e, h_T, e_T | gradient of J by x_t, by s_T, r, r_T | F, G', E', H, G_T', E_T', H_T, dense
 * dynamics (x, psi, c, d)                   -> f, for rollouts where there is `horizon`
 *
 * "|" separates the results of values, first and second derivatives: each function has those of its level and before.
 * Either stage and last are given, or horizon and dynamics. */
typedef struct kpirl_mpc_model {
  int by_stage;
  kpirl_mpc_function stage[KPIRL_MPC_LEVELS], last[KPIRL_MPC_LEVELS], horizon[KPIRL_MPC_LEVELS], dynamics;
  kpirl_mpc_pattern F, G, E, H, G_last, E_last, H_last;
} kpirl_mpc_model;

/* The numbers of one solve. schedule: (T+1, n_d). */
typedef struct kpirl_mpc_numbers {
  const real *s0, *psi, *context, *schedule;
} kpirl_mpc_numbers;

#endif
