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

#include "kpirl_mpc_dimensions.h" /* DIM(core, name): a number of kpirl_mpc_dimensions */
#include "kpirl_mpc_real.h"

typedef struct kpirl_mpc_dimensions {
  int horizon, n_states, n_actions;
  int n_path, n_equality;                  /* rows of h and of e, per stage */
  int n_terminal, n_terminal_equality;     /* rows of h_T and of e_T */
  int n_parameters, n_context, n_schedule; /* lengths of psi, c and d_t */
} kpirl_mpc_dimensions;

/* Where the nonzeros of a result belong in a dense array; entries NULL: the result is dense. */
typedef struct kpirl_mpc_pattern {
  int count;
  const int *entries;
} kpirl_mpc_pattern;

/* A stage t < T, x = (s, u), with z and nu the multipliers of h and e; or the end, x = s_T, of h_T and e_T, where there are no
 * costates, no successor and no F. */
typedef struct kpirl_mpc_stage_arguments {
  const real *x, *psi, *context, *schedule;
  const real *costates, *z, *nu; /* for derivatives */
} kpirl_mpc_stage_arguments;

typedef struct kpirl_mpc_stage_results {
  real *cost, *successor, *path, *equality; /* l, f, h and e */
  real *cost_gradient, *gradient;           /* of l and of L = l + costates . f + z . h + nu . e, by x */
  real *F, *G, *E, *H;                      /* Jacobian of f, transposed ones of h and e; second derivative of L, its lower
                                               triangle */
} kpirl_mpc_stage_results;

/* All stages side by side. */
typedef struct kpirl_mpc_horizon_arguments {
  const real *states, *actions, *psi, *context;
  const real *costates, *z, *nu, *z_last, *nu_last;
} kpirl_mpc_horizon_arguments;

typedef struct kpirl_mpc_horizon_results {
  real *cost, *successor, *path, *equality, *path_last, *equality_last;
  real *cost_gradient, *cost_gradient_last, *gradient, *gradient_last;
  real *F, *G, *E, *H, *G_last, *E_last, *H_last; /* dense */
} kpirl_mpc_horizon_results;

/* Functions return 0 when all went well. Each gives the results of its level and of those before; results that are NULL are
 * not wanted, others overlap neither each other nor the arguments. */
typedef struct kpirl_mpc_stage_function {
  int (*evaluate)(void *self, const kpirl_mpc_stage_arguments *arguments, const kpirl_mpc_stage_results *results);
  void *self;
} kpirl_mpc_stage_function;

typedef struct kpirl_mpc_horizon_function {
  int (*evaluate)(void *self, const kpirl_mpc_horizon_arguments *arguments, const kpirl_mpc_horizon_results *results);
  void *self;
} kpirl_mpc_horizon_function;

enum { KPIRL_MPC_VALUES, KPIRL_MPC_FIRST, KPIRL_MPC_SECOND, KPIRL_MPC_LEVELS };

/* Either stage and last, with the patterns of their matrices; or horizon, and dynamics (successor alone) for rollouts. quadratic: is
 * this a quadratic program, whose matrices F, G, E and H are the same at every x and for all multipliers? */
typedef struct kpirl_mpc_model {
  int by_stage, quadratic;
  kpirl_mpc_stage_function stage[KPIRL_MPC_LEVELS], last[KPIRL_MPC_LEVELS];
  kpirl_mpc_horizon_function horizon[KPIRL_MPC_LEVELS];
  kpirl_mpc_stage_function dynamics;
  kpirl_mpc_pattern F, G, E, H, G_last, E_last, H_last;
} kpirl_mpc_model;

/* The numbers of one solve. schedule: (T+1, n_d). */
typedef struct kpirl_mpc_numbers {
  const real *s0, *psi, *context, *schedule;
} kpirl_mpc_numbers;

#endif
