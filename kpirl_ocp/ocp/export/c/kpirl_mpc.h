/* SPDX-License-Identifier: MIT
 *
 * A model-predictive controller for one optimal-control problem, in C99, with nothing but libc and libm.
 *
 *     minimise   sum_{t=0}^{T-1} l(s_t, u_t; psi, c)  +  l_T(s_T; psi, c)
 *     subject to s_{t+1} = f(s_t, u_t; psi),  s_0 given,
 *                u_min <= u_t <= u_max,  s_min <= s_{t+1} <= s_max,  h(s_t, u_t; psi, c) <= 0,     t = 0 .. T-1
 *
 * f, l, l_T, h and the number of steps T are compiled in; s_0, the context c (a goal), the parameters psi and the
 * values of the bounds are given at run time. Arrays are dense, time first, one row after the other: states[t * n_s + i].
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

#ifdef __cplusplus
extern "C" {
#endif

/* double; float in a build with KPIRL_MPC_FLOAT, which the caller then has to define, too. */
#ifdef KPIRL_MPC_FLOAT
typedef float kpirl_mpc_real;
#else
typedef double kpirl_mpc_real;
#endif

#define KPIRL_MPC_AT_LEAST_ONE(n) ((n) > 0 ? (n) : 1) /* C has no empty arrays; an array without entries has one, 0 */

/* How a call ended. Not negative: what became of the solve, as in Python's Status. Negative: an error of the caller. */
typedef enum kpirl_mpc_status {
  KPIRL_MPC_CONVERGED = 0,       /* the KKT conditions hold to the solver's tolerance */
  KPIRL_MPC_STEPS_TAKEN = 1,     /* all steps were taken, short of stationarity: right for real-time iterations */
  KPIRL_MPC_ITERATION_LIMIT = 2, /* raise max_iterations, or pass a better guess */
  KPIRL_MPC_INFEASIBLE = 3,      /* no feasible point was found nearby: relax the constraints, or pass another guess */
  KPIRL_MPC_STALLED = 4,         /* no further progress was possible */
  KPIRL_MPC_DIVERGED = 5,        /* the iterates diverged, or left the domain of a function */
  KPIRL_MPC_NOT_FINITE = 6,      /* a function returned NaN or infinity */
  KPIRL_MPC_FAILED = 7,          /* the solver gave up, and does not say why (SQP) */
  KPIRL_MPC_TIME_LIMIT = 8,      /* the caller's clock ran out; the plan is as far as the solver got */
  KPIRL_MPC_NOT_SOLVED = 9,      /* of a gradient: the plan is not a solution, do not believe it */
  KPIRL_MPC_NOT_A_MINIMUM = 10,  /* of a gradient: the Hessian is not positive there, do not believe it */

  KPIRL_MPC_ERROR_NULL = -1,     /* a pointer that must be given is NULL */
  KPIRL_MPC_ERROR_INPUT = -2,    /* an input is NaN or infinite */
  KPIRL_MPC_ERROR_BOUNDS = -3,   /* lower above upper; or others are finite, or coincide, than when exported */
  KPIRL_MPC_ERROR_MEMORY = -4,   /* the memory is too small or not aligned */
  KPIRL_MPC_ERROR_SETTINGS = -5, /* a setting is out of its range */
  KPIRL_MPC_ERROR_CONTROLLER = -6, /* this is no initialised controller */
  KPIRL_MPC_ERROR_UNSUPPORTED = -7 /* the exported solver cannot do this */
} kpirl_mpc_status;

/* True when the solver did what it was asked to do: CONVERGED or STEPS_TAKEN. Then no output is NaN or infinite. */
int kpirl_mpc_ok(kpirl_mpc_status status);

/* A sentence that says what happened and what to do; never NULL. */
const char *kpirl_mpc_message(kpirl_mpc_status status);

/* "name of the exporter, its version; the solver; the problem's dimensions". */
const char *kpirl_mpc_version(void);

typedef struct kpirl_mpc kpirl_mpc;

/* ---- memory ------------------------------------------------------------------------------------------------- */

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

typedef struct kpirl_mpc_settings {
  int max_iterations;       /* before ITERATION_LIMIT; 1 .. KPIRL_MPC_MAX_ITERATIONS */
  int steps;                /* 0: iterate until the conditions hold; else take exactly so many Newton steps without line
                               search, the real-time iteration. Gradient descent: its number of steps, fixed. */
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

/* psi (n_psi) for all solves that bring none of their own. */
kpirl_mpc_status kpirl_mpc_set_parameters(kpirl_mpc *mpc, const kpirl_mpc_real *psi);

/* ---- solving ------------------------------------------------------------------------------------------------ */

typedef struct kpirl_mpc_input {
  const kpirl_mpc_real *state;   /* s_0 (n_s) */
  const kpirl_mpc_real *context; /* c (n_c), for example the goal; may be NULL when there is none */
  const kpirl_mpc_real *psi;     /* (n_psi); NULL: those of set_parameters */
} kpirl_mpc_input;

/* Where to start: all arrays may be NULL but states and actions. Without multipliers it is a cold start from there. */
typedef struct kpirl_mpc_guess {
  const kpirl_mpc_real *states;   /* (T+1, n_s) */
  const kpirl_mpc_real *actions;  /* (T, n_u) */
  const kpirl_mpc_real *dynamics; /* the multipliers of a kpirl_mpc_solution: all that are not empty, or none */
  const kpirl_mpc_real *state_bounds;
  const kpirl_mpc_real *action_bounds;
  const kpirl_mpc_real *path;
} kpirl_mpc_guess;

/* A plan, its multipliers, and the evidence of how good it is. Multipliers have the signs of
 * J + dynamics . (f(s, u) - s_next) + state_bounds . s + action_bounds . u + path . h. */
typedef struct kpirl_mpc_solution {
  kpirl_mpc_real states[(KPIRL_MPC_HORIZON + 1) * KPIRL_MPC_N_STATES]; /* (T+1, n_s), s_0 first */
  kpirl_mpc_real actions[KPIRL_MPC_HORIZON * KPIRL_MPC_N_ACTIONS];     /* (T, n_u): command the first row */
  kpirl_mpc_real dynamics[KPIRL_MPC_HORIZON * KPIRL_MPC_N_STATES];     /* (T, n_s) costates */
  kpirl_mpc_real state_bounds[KPIRL_MPC_HORIZON * KPIRL_MPC_N_STATES]; /* (T, n_s) of s_1 .. s_T */
  kpirl_mpc_real action_bounds[KPIRL_MPC_HORIZON * KPIRL_MPC_N_ACTIONS];                 /* (T, n_u) */
  kpirl_mpc_real path[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_HORIZON * KPIRL_MPC_N_PATH)]; /* (T, n_h) */
  kpirl_mpc_real objective;
  kpirl_mpc_real residual;        /* feasibility, or the largest of the other two over scale: "KKT residual" */
  kpirl_mpc_real stationarity;    /* largest entry of the Lagrangian's gradient */
  kpirl_mpc_real feasibility;     /* largest violation of dynamics and constraints */
  kpirl_mpc_real complementarity; /* largest |multiplier * slack - barrier| */
  kpirl_mpc_real scale;           /* max(1, gradient of the objective, multipliers) */
  double seconds;                 /* by the clock of the settings; -1 without one */
  int iterations;
  kpirl_mpc_status status;
} kpirl_mpc_solution;

/* Plan. Returns solution->status, or an error, and then the solution is as it was. guess: NULL starts from no action.
 * It may point into the solution that is written. */
kpirl_mpc_status kpirl_mpc_solve(kpirl_mpc *mpc, const kpirl_mpc_input *input, const kpirl_mpc_guess *guess,
                                 kpirl_mpc_solution *solution);

/* All arrays of a solution, as the guess that starts from it. */
kpirl_mpc_guess kpirl_mpc_resume(const kpirl_mpc_solution *solution);

/* The guess for the next period: everything one step earlier; the last action is taken again, the last multipliers stay.
 * Only the arrays change. psi: as in an input. */
kpirl_mpc_status kpirl_mpc_shift(kpirl_mpc *mpc, const kpirl_mpc_real *psi, kpirl_mpc_solution *solution);

/* next (n_s) = f(state, action; psi); psi as in an input. */
kpirl_mpc_status kpirl_mpc_predict(kpirl_mpc *mpc, const kpirl_mpc_real *state, const kpirl_mpc_real *action,
                                   const kpirl_mpc_real *psi, kpirl_mpc_real *next);

/* ---- learning ----------------------------------------------------------------------------------------------- */

/* Gradients of a function L of the plan. */
typedef struct kpirl_mpc_gradients {
  kpirl_mpc_real psi[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_PARAMETERS)];
  kpirl_mpc_real state[KPIRL_MPC_N_STATES]; /* by s_0 */
  kpirl_mpc_real context[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_CONTEXT)];
  kpirl_mpc_real residual; /* relative KKT residual of the plan: the gradient of a solution needs it to be small */
  kpirl_mpc_real pivot;    /* smallest pivot: the Hessian along the dynamics is positive when this is */
} kpirl_mpc_gradients;

/* dL/dpsi, dL/ds_0 and dL/dc of the plan that solve found for this input, from dL/dstates (T+1, n_s) and dL/dactions
 * (T, n_u). Returns CONVERGED when the gradient is to be believed, NOT_SOLVED or NOT_A_MINIMUM when it is not but was
 * computed all the same, NOT_FINITE when it could not be; or an error.
 * Interior-point method: one adjoint solve on the Newton system at the plan, with the barrier of the settings.
 * Gradient descent: the derivative of its steps; `guess` must be what solve was called with. */
kpirl_mpc_status kpirl_mpc_gradient(kpirl_mpc *mpc, const kpirl_mpc_input *input, const kpirl_mpc_guess *guess,
                                    const kpirl_mpc_solution *solution, const kpirl_mpc_real *by_states,
                                    const kpirl_mpc_real *by_actions, kpirl_mpc_gradients *gradients);

#ifdef __cplusplus
}
#endif
#endif
