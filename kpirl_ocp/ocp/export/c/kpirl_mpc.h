/* SPDX-License-Identifier: MIT
 *
 * A model-predictive controller for one optimal-control problem, in C99, with nothing but libc and libm.
 *
 *     minimise   sum_{t=0}^{T-1} l(s_t, u_t; psi, c, d_t)  +  l_T(s_T; psi, c, d_T)
 *     subject to s_{t+1} = f(s_t, u_t; psi, c, d_t),    s_0 given, or some of its entries free,
 *                u_min,t <= u_t <= u_max,t,   h(s_t, u_t; psi, c, d_t) <= 0,   e(s_t, u_t; psi, c, d_t) = 0,   t = 0 .. T-1,
 *                s_min,t <= s_t <= s_max,t,   h_T(s_T; psi, c, d_T) <= 0,      e_T(s_T; psi, c, d_T) = 0.
 *
 * The functions and the number of steps T are compiled in; s_0, the context c (a goal), the parameters psi, the schedule d_t
 * (references, forecasts) and the values of the bounds are given at run time. Rows of h that do not depend on u are among
 * those of h_T, too. Arrays are dense, time first, one row after the other: states[t * n_s + i].
 *
 *     kpirl_mpc *mpc = NULL;
 *     kpirl_mpc_solution plan;
 *     kpirl_mpc_init(&mpc, memory, size);                                    (at least kpirl_mpc_size() bytes)
 *     kpirl_mpc_status status = kpirl_mpc_solve(mpc, &(kpirl_mpc_input){.state = s0, .context = goal}, NULL, &plan);
 *     if (kpirl_mpc_ok(status)) command(plan.actions);
 *
 * Every function is re-entrant: all memory is in the controller, and there are no globals. One controller serves one
 * thread at a time; two controllers never meet. A function that returns an error (a negative status) has touched nothing.
 */
#ifndef KPIRL_MPC_H
#define KPIRL_MPC_H

#include <stddef.h>

#include "kpirl_mpc_config.h" /* the dimensions, KPIRL_MPC_N_STATES and so on */
#include "kpirl_mpc_number.h" /* kpirl_mpc_real: double; float in a build with KPIRL_MPC_FLOAT */
#include "kpirl_mpc_status.h" /* how a call ended */

#ifdef __cplusplus
extern "C" {
#endif

#define KPIRL_MPC_AT_LEAST_ONE(n) ((n) > 0 ? (n) : 1) /* C has no empty arrays; an array without entries has one, 0 */

/* True when the solver did what it was asked to do: CONVERGED, STEPS_TAKEN or ACCEPTABLE. Then no output is NaN or
 * infinite. */
int kpirl_mpc_ok(kpirl_mpc_status status);

/* A sentence that says what happened and what to do; never NULL. */
const char *kpirl_mpc_message(kpirl_mpc_status status);

/* "name of the exporter, its version; the solver; the problem's dimensions". */
const char *kpirl_mpc_version(void);

typedef struct kpirl_mpc kpirl_mpc;

/* ---- memory ------------------------------------------------------------------------------------------------- */

/* A library of one precision and a program of the other do not link: what makes a controller has two names. */
#ifdef KPIRL_MPC_FLOAT
#define kpirl_mpc_init kpirl_mpc_init_single
#define kpirl_mpc_create kpirl_mpc_create_single
#endif

/* Bytes that a controller needs. For static memory include kpirl_mpc_memory.h, which defines the type:
 *     static kpirl_mpc memory;    ...    kpirl_mpc_init(&mpc, &memory, sizeof memory); */
size_t kpirl_mpc_size(void);

/* Make a controller in memory of the caller, of at least kpirl_mpc_size() bytes, aligned for double, pointers and long
 * long, as memory from malloc is. It must stay, and must not be moved; there is nothing to release. Bounds, settings
 * and psi are those that were exported. */
kpirl_mpc_status kpirl_mpc_init(kpirl_mpc **mpc, void *memory, size_t size);

#ifndef KPIRL_MPC_NO_HEAP
/* The same in memory from malloc, to be given back to destroy; NULL when there is none. Nothing else uses the heap. */
kpirl_mpc *kpirl_mpc_create(void);
void kpirl_mpc_destroy(kpirl_mpc *mpc);
#endif

/* Back to the bounds, settings and psi that were exported. */
kpirl_mpc_status kpirl_mpc_reset(kpirl_mpc *mpc);

/* ---- what may change at run time ---------------------------------------------------------------------------- */

/* SQP takes neither steps nor a barrier. */
typedef struct kpirl_mpc_settings {
  int max_iterations;       /* >= 1, before ITERATION_LIMIT */
  int steps;                /* 0: iterate until the conditions hold; else take exactly so many Newton steps without line
                               search, the real-time iteration. Gradient descent: its number of steps, fixed, from 1 to
                               KPIRL_MPC_MAX_ITERATIONS. */
  kpirl_mpc_real tolerance; /* > 0, of the relative KKT residual */
  kpirl_mpc_real barrier;   /* >= 0; above zero: min J - barrier sum log(slack), a smooth function of psi */
  double time_limit;        /* > 0 [s], from when solve is called, looked at before every iteration; 0: none */
  double (*now)(void *);    /* the caller's clock [s]; NULL: none, then time_limit must be 0 */
  void *clock;              /* what `now` is called with */
} kpirl_mpc_settings;

kpirl_mpc_status kpirl_mpc_get_settings(const kpirl_mpc *mpc, kpirl_mpc_settings *settings);
kpirl_mpc_status kpirl_mpc_set_settings(kpirl_mpc *mpc, const kpirl_mpc_settings *settings);

/* Bounds on every s_1 .. s_T (n_s) and u_0 .. u_{T-1} (n_u); NULL leaves one as it is. Which of them are infinite, and
 * which coincide, must be as when exported. */
kpirl_mpc_status kpirl_mpc_set_bounds(kpirl_mpc *mpc, const kpirl_mpc_real *state_lower, const kpirl_mpc_real *state_upper,
                                      const kpirl_mpc_real *action_lower, const kpirl_mpc_real *action_upper);

/* The same stage by stage: states (T+1, n_s), of which row 0 counts for free entries of s_0; actions (T, n_u). */
kpirl_mpc_status kpirl_mpc_set_stage_bounds(kpirl_mpc *mpc, const kpirl_mpc_real *state_lower,
                                            const kpirl_mpc_real *state_upper, const kpirl_mpc_real *action_lower,
                                            const kpirl_mpc_real *action_upper);

/* psi (n_psi) for all solves that bring none of their own. */
kpirl_mpc_status kpirl_mpc_set_parameters(kpirl_mpc *mpc, const kpirl_mpc_real *psi);

/* ---- solving ------------------------------------------------------------------------------------------------ */

typedef struct kpirl_mpc_input {
  const kpirl_mpc_real *state;    /* s_0 (n_s); without a guess, free entries are where the solve begins */
  const kpirl_mpc_real *context;  /* c (n_c), for example the goal; may be NULL when there is none */
  const kpirl_mpc_real *psi;      /* (n_psi); NULL: those of set_parameters */
  const kpirl_mpc_real *schedule; /* d (T+1, n_d); NULL: the exported one. Interior-point method alone. */
} kpirl_mpc_input;

/* Where to start: all arrays may be NULL but states and actions. Without multipliers it is a cold start from there. */
typedef struct kpirl_mpc_guess {
  const kpirl_mpc_real *states;   /* (T+1, n_s) */
  const kpirl_mpc_real *actions;  /* (T, n_u) */
  const kpirl_mpc_real *dynamics; /* the multipliers of a kpirl_mpc_solution: all that are not empty, or none */
  const kpirl_mpc_real *state_bounds;
  const kpirl_mpc_real *action_bounds;
  const kpirl_mpc_real *path;
  const kpirl_mpc_real *path_equality;
  const kpirl_mpc_real *terminal;
  const kpirl_mpc_real *terminal_equality;
} kpirl_mpc_guess;

/* A plan, its multipliers, and the evidence of how good it is. Multipliers have the signs of
 * J + dynamics . (f - s_next) + state_bounds . s + action_bounds . u + path . h + path_equality . e
 *   + terminal . h_T + terminal_equality . e_T. */
typedef struct kpirl_mpc_solution {
  kpirl_mpc_real states[(KPIRL_MPC_HORIZON + 1) * KPIRL_MPC_N_STATES];                        /* (T+1, n_s), s_0 first */
  kpirl_mpc_real actions[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_HORIZON * KPIRL_MPC_N_ACTIONS)];            /* (T, n_u) */
  kpirl_mpc_real dynamics[KPIRL_MPC_HORIZON * KPIRL_MPC_N_STATES];                            /* (T, n_s) costates */
  kpirl_mpc_real state_bounds[(KPIRL_MPC_HORIZON + 1) * KPIRL_MPC_N_STATES];                  /* (T+1, n_s); 0 for given s_0 */
  kpirl_mpc_real action_bounds[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_HORIZON * KPIRL_MPC_N_ACTIONS)];      /* (T, n_u) */
  kpirl_mpc_real path[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_HORIZON * KPIRL_MPC_N_PATH)];                  /* (T, n_h) */
  kpirl_mpc_real path_equality[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_HORIZON * KPIRL_MPC_N_PATH_EQUALITY)]; /* (T, n_e) */
  kpirl_mpc_real terminal[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_TERMINAL)];                              /* of h_T */
  kpirl_mpc_real terminal_equality[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_TERMINAL_EQUALITY)];            /* of e_T */
  kpirl_mpc_real objective;
  kpirl_mpc_real residual;        /* feasibility, or the largest of the other two over scale: "KKT residual" */
  kpirl_mpc_real stationarity;    /* largest entry of the Lagrangian's gradient */
  kpirl_mpc_real feasibility;     /* largest violation of dynamics and constraints */
  kpirl_mpc_real complementarity; /* largest |multiplier * slack - barrier| */
  kpirl_mpc_real scale;           /* max(1, gradient of the objective, multipliers) */
  double seconds;                 /* by the clock of the settings; -1 without one */
  int iterations;                 /* of SQP: quadratic programs */
  kpirl_mpc_status status;
} kpirl_mpc_solution;

/* Plan. Returns solution->status, or an error, and then the solution is as it was. guess: NULL starts from no action.
 * It may point into the solution that is written. */
kpirl_mpc_status kpirl_mpc_solve(kpirl_mpc *mpc, const kpirl_mpc_input *input, const kpirl_mpc_guess *guess,
                                 kpirl_mpc_solution *solution);

/* All arrays of a solution, as the guess that starts from it. */
kpirl_mpc_guess kpirl_mpc_resume(const kpirl_mpc_solution *solution);

/* The guess for the next period: everything one step earlier; the last action is taken again from s_T, with the input's
 * numbers of the last step, and the last multipliers stay. Only the arrays change. input->state may be NULL. */
kpirl_mpc_status kpirl_mpc_shift(kpirl_mpc *mpc, const kpirl_mpc_input *input, kpirl_mpc_solution *solution);

/* next (n_s) = f(s_0, action; ..), with the state and all other numbers of an input; `next` may be where its state is. */
kpirl_mpc_status kpirl_mpc_predict(kpirl_mpc *mpc, const kpirl_mpc_input *input, const kpirl_mpc_real *action,
                                   kpirl_mpc_real *next);

/* ---- learning ----------------------------------------------------------------------------------------------- */

/* Gradients of a function L of the plan. */
typedef struct kpirl_mpc_gradients {
  kpirl_mpc_real psi[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_PARAMETERS)];
  kpirl_mpc_real state[KPIRL_MPC_N_STATES]; /* by the given entries of s_0; 0 for free ones */
  kpirl_mpc_real context[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_CONTEXT)];
  kpirl_mpc_real residual; /* relative KKT residual of the plan: the gradient of a solution needs it to be small */
  kpirl_mpc_real pivot;    /* smallest pivot: the Hessian along the dynamics is positive when this is */
} kpirl_mpc_gradients;

/* dL/dpsi, dL/ds_0 and dL/dc of the plan that solve found for this input, from dL/dstates (T+1, n_s) and dL/dactions
 * (T, n_u). Returns CONVERGED when the gradient is to be believed, NOT_SOLVED or NOT_A_MINIMUM when it is not but was
 * computed all the same, NOT_FINITE when it could not be; or an error.
 * Interior-point method: one adjoint solve on the Newton system at the plan, with the barrier of the settings.
 * Gradient descent: the derivative of its steps; `guess` must be what solve was called with. SQP has none. */
kpirl_mpc_status kpirl_mpc_gradient(kpirl_mpc *mpc, const kpirl_mpc_input *input, const kpirl_mpc_guess *guess,
                                    const kpirl_mpc_solution *solution, const kpirl_mpc_real *by_states,
                                    const kpirl_mpc_real *by_actions, kpirl_mpc_gradients *gradients);

#ifdef __cplusplus
}
#endif
#endif
