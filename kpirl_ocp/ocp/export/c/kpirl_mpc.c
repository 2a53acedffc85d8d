/* SPDX-License-Identifier: MIT
 *
 * The interface, whatever the solver: memory, checks of what callers hand over, bounds, settings and parameters.
 * Nothing is written before everything has been checked.
 */
#include "kpirl_mpc_memory.h"

#include <string.h>
#include <tgmath.h>

#ifndef KPIRL_MPC_NO_HEAP
#include <stdlib.h>
#endif

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON };
enum { NP = KPIRL_MPC_N_PARAMETERS, NC = KPIRL_MPC_N_CONTEXT, NH = KPIRL_MPC_N_PATH };

typedef kpirl_mpc_real real;

/* Where C keeps a controller: the offset of a member behind a single byte is its alignment. */
struct alignment {
  char byte;
  kpirl_mpc controller;
};

int kpirl_mpc_ok(kpirl_mpc_status status) {
  return status == KPIRL_MPC_CONVERGED || status == KPIRL_MPC_STEPS_TAKEN;
}

const char *kpirl_mpc_message(kpirl_mpc_status status) {
  switch (status) {
    case KPIRL_MPC_CONVERGED: return "the KKT conditions hold to the solver's tolerance.";
    case KPIRL_MPC_STEPS_TAKEN: return "all steps were taken, short of stationarity: right for real-time iterations.";
    case KPIRL_MPC_ITERATION_LIMIT: return "the iteration limit was reached. Raise it, or pass a better guess.";
    case KPIRL_MPC_INFEASIBLE: return "no feasible point was found nearby. Relax the constraints, or pass another guess.";
    case KPIRL_MPC_STALLED: return "no further progress was possible. Rescale the problem, or pass another guess.";
    case KPIRL_MPC_DIVERGED: return "the iterates diverged. Use a smaller step size, or add effort weight.";
    case KPIRL_MPC_NOT_FINITE: return "a function returned NaN or infinity. Check dynamics and costs at the guess.";
    case KPIRL_MPC_FAILED: return "the solver gave up: too many iterations, or a subproblem without a solution. Pass another guess.";
    case KPIRL_MPC_TIME_LIMIT: return "the time limit was reached; the plan is as far as the solver got.";
    case KPIRL_MPC_NOT_SOLVED: return "the plan is not a solution, so this is not its gradient. Solve to a tighter tolerance.";
    case KPIRL_MPC_NOT_A_MINIMUM: return "the Hessian is not positive there, so this is no gradient of a minimum.";
    case KPIRL_MPC_ERROR_NULL: return "a pointer that must be given is NULL.";
    case KPIRL_MPC_ERROR_INPUT: return "an input is NaN or infinite.";
    case KPIRL_MPC_ERROR_BOUNDS:
      return "a lower bound is above its upper bound, or other bounds are finite, or coincide, than when exported.";
    case KPIRL_MPC_ERROR_MEMORY: return "the memory is too small or not aligned: see kpirl_mpc_size and kpirl_mpc_init.";
    case KPIRL_MPC_ERROR_SETTINGS: return "a setting is out of its range.";
    case KPIRL_MPC_ERROR_CONTROLLER: return "this is no controller that kpirl_mpc_init made, or it was moved.";
    case KPIRL_MPC_ERROR_UNSUPPORTED: return "the exported solver cannot do this.";
  }
  return "unknown status.";
}

const char *kpirl_mpc_version(void) { return kpirl_mpc_exported_version; }

/* ---- helpers ------------------------------------------------------------------------------------------------ */

int kpirl_mpc_all_finite(const real *values, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (!isfinite(values[i])) return 0;
  return 1;
}

real kpirl_mpc_largest(const real *values, int count) {
  real most = 0;
  int i;
  for (i = 0; i < count; ++i) {
    const real size = fabs(values[i]);
    if (size > most || isnan(size)) most = size; /* a NaN stays: nothing is greater */
  }
  return most;
}

void kpirl_mpc_set_residuals(kpirl_mpc_solution *solution, real stationarity, real feasibility, real complementarity,
                             real scale) {
  real residuals[3];
  residuals[0] = stationarity / scale;
  residuals[1] = complementarity / scale;
  residuals[2] = feasibility;
  solution->stationarity = stationarity;
  solution->feasibility = feasibility;
  solution->complementarity = complementarity;
  solution->scale = scale;
  solution->residual = kpirl_mpc_largest(residuals, 3);
}

int kpirl_mpc_late(const kpirl_mpc *mpc) {
  const kpirl_mpc_settings *settings = &mpc->settings;
  return settings->now && settings->time_limit > 0 && !(settings->now(settings->clock) - mpc->started < settings->time_limit);
}

void kpirl_mpc_call(kpirl_mpc *mpc, kpirl_mpc_function *function, int n_arguments, const real *const *arguments,
                    int n_results, real *const *results) {
  int i;
  for (i = 0; i < n_arguments; ++i) mpc->arguments[i] = arguments[i];
  for (i = 0; i < n_results; ++i) mpc->results[i] = results[i];
  function(mpc->arguments, mpc->results, mpc->integers, mpc->reals, 0);
}

static int is_controller(const kpirl_mpc *mpc) { return mpc->self == (const void *)mpc; }

/* ---- memory ------------------------------------------------------------------------------------------------- */

size_t kpirl_mpc_size(void) { return sizeof(kpirl_mpc); }

kpirl_mpc_status kpirl_mpc_init(kpirl_mpc **mpc, void *memory, size_t size) {
  kpirl_mpc *made = (kpirl_mpc *)memory;
  if (!mpc || !memory) return KPIRL_MPC_ERROR_NULL;
  if (size < sizeof(kpirl_mpc) || (size_t)memory % offsetof(struct alignment, controller)) return KPIRL_MPC_ERROR_MEMORY;
  memset(made, 0, sizeof *made);
  made->self = made;
  *mpc = made;
  return kpirl_mpc_reset(made);
}

#ifndef KPIRL_MPC_NO_HEAP
kpirl_mpc *kpirl_mpc_create(void) {
  kpirl_mpc *mpc = NULL;
  void *memory = malloc(sizeof(kpirl_mpc));
  if (memory) (void)kpirl_mpc_init(&mpc, memory, sizeof(kpirl_mpc));
  return mpc;
}

void kpirl_mpc_destroy(kpirl_mpc *mpc) { free(mpc); }
#endif

kpirl_mpc_status kpirl_mpc_reset(kpirl_mpc *mpc) {
  if (!mpc) return KPIRL_MPC_ERROR_NULL;
  if (!is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  mpc->settings = kpirl_mpc_exported_settings;
  mpc->bounds = kpirl_mpc_exported_bounds;
  memcpy(mpc->psi, kpirl_mpc_exported_psi, sizeof mpc->psi);
  return KPIRL_MPC_CONVERGED;
}

/* ---- what may change at run time ---------------------------------------------------------------------------- */

kpirl_mpc_status kpirl_mpc_get_settings(const kpirl_mpc *mpc, kpirl_mpc_settings *settings) {
  if (!mpc || !settings) return KPIRL_MPC_ERROR_NULL;
  if (!is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  *settings = mpc->settings;
  return KPIRL_MPC_CONVERGED;
}

kpirl_mpc_status kpirl_mpc_set_settings(kpirl_mpc *mpc, const kpirl_mpc_settings *settings) {
  int valid;
  if (!mpc || !settings) return KPIRL_MPC_ERROR_NULL;
  if (!is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  valid = settings->max_iterations >= 1 && settings->max_iterations <= KPIRL_MPC_MAX_ITERATIONS && settings->steps >= 0 &&
          settings->tolerance > 0 && isfinite(settings->tolerance) && settings->barrier >= 0 &&
          isfinite(settings->barrier) && settings->time_limit >= 0 && isfinite(settings->time_limit) &&
          (settings->now || settings->time_limit <= 0);
  if (!valid) return KPIRL_MPC_ERROR_SETTINGS;
  if (kpirl_mpc_check_settings(settings) != KPIRL_MPC_CONVERGED) return KPIRL_MPC_ERROR_UNSUPPORTED;
  mpc->settings = *settings;
  return KPIRL_MPC_CONVERGED;
}

/* May lower and upper (n) take the place of those that were exported? */
static int fit(const real *lower, const real *upper, const real *was_lower, const real *was_upper, int n) {
  int i;
  for (i = 0; i < n; ++i) {
    if (!(lower[i] <= upper[i]) || lower[i] == (real)INFINITY || upper[i] == -(real)INFINITY) return 0;
    if (!isfinite(lower[i]) != !isfinite(was_lower[i]) || !isfinite(upper[i]) != !isfinite(was_upper[i])) return 0;
    if ((lower[i] == upper[i]) != (was_lower[i] == was_upper[i])) return 0;
  }
  return 1;
}

kpirl_mpc_status kpirl_mpc_set_bounds(kpirl_mpc *mpc, const real *state_lower, const real *state_upper,
                                      const real *action_lower, const real *action_upper) {
  const kpirl_mpc_bounds *was = &kpirl_mpc_exported_bounds;
  kpirl_mpc_bounds next;
  if (!mpc) return KPIRL_MPC_ERROR_NULL;
  if (!is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  next = mpc->bounds;
  if (state_lower) memcpy(next.state_lower, state_lower, sizeof next.state_lower);
  if (state_upper) memcpy(next.state_upper, state_upper, sizeof next.state_upper);
  if (action_lower) memcpy(next.action_lower, action_lower, sizeof next.action_lower);
  if (action_upper) memcpy(next.action_upper, action_upper, sizeof next.action_upper);
  if (!fit(next.state_lower, next.state_upper, was->state_lower, was->state_upper, NS) ||
      !fit(next.action_lower, next.action_upper, was->action_lower, was->action_upper, NU))
    return KPIRL_MPC_ERROR_BOUNDS;
  mpc->bounds = next;
  return KPIRL_MPC_CONVERGED;
}

kpirl_mpc_status kpirl_mpc_set_parameters(kpirl_mpc *mpc, const real *psi) {
  if (!mpc || (NP > 0 && !psi)) return KPIRL_MPC_ERROR_NULL;
  if (!is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  if (!kpirl_mpc_all_finite(psi, NP)) return KPIRL_MPC_ERROR_INPUT;
  if (NP > 0) memcpy(mpc->psi, psi, NP * sizeof(real));
  return KPIRL_MPC_CONVERGED;
}

/* ---- solving ------------------------------------------------------------------------------------------------ */

static kpirl_mpc_status check_input(const kpirl_mpc *mpc, const kpirl_mpc_input *input, kpirl_mpc_numbers *numbers) {
  if (!mpc || !input || !input->state || (NC > 0 && !input->context)) return KPIRL_MPC_ERROR_NULL;
  if (!is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  numbers->state = input->state;
  numbers->context = input->context;
  numbers->psi = input->psi ? input->psi : mpc->psi;
  return kpirl_mpc_all_finite(numbers->state, NS) && kpirl_mpc_all_finite(numbers->context, NC) &&
                 kpirl_mpc_all_finite(numbers->psi, NP)
             ? KPIRL_MPC_CONVERGED
             : KPIRL_MPC_ERROR_INPUT;
}

static int has_multipliers(const kpirl_mpc_guess *guess) {
  return guess->dynamics || guess->state_bounds || guess->action_bounds || guess->path;
}

static kpirl_mpc_status check_guess(const kpirl_mpc_guess *guess) {
  if (!guess) return KPIRL_MPC_CONVERGED;
  if (!guess->states || !guess->actions) return KPIRL_MPC_ERROR_NULL;
  if (!kpirl_mpc_all_finite(guess->states, (T + 1) * NS) || !kpirl_mpc_all_finite(guess->actions, T * NU))
    return KPIRL_MPC_ERROR_INPUT;
  if (!has_multipliers(guess)) return KPIRL_MPC_CONVERGED;
  if (!guess->dynamics || !guess->state_bounds || !guess->action_bounds || (NH > 0 && !guess->path))
    return KPIRL_MPC_ERROR_NULL;
  return kpirl_mpc_all_finite(guess->dynamics, T * NS) && kpirl_mpc_all_finite(guess->state_bounds, T * NS) &&
                 kpirl_mpc_all_finite(guess->action_bounds, T * NU) && kpirl_mpc_all_finite(guess->path, T * NH)
             ? KPIRL_MPC_CONVERGED
             : KPIRL_MPC_ERROR_INPUT;
}

/* Is every number of a solution finite? */
static int all_finite(const kpirl_mpc_solution *at) {
  const real numbers[] = {at->objective, at->residual, at->stationarity, at->feasibility, at->complementarity, at->scale};
  return kpirl_mpc_all_finite(at->states, (T + 1) * NS) && kpirl_mpc_all_finite(at->actions, T * NU) &&
         kpirl_mpc_all_finite(at->dynamics, T * NS) && kpirl_mpc_all_finite(at->state_bounds, T * NS) &&
         kpirl_mpc_all_finite(at->action_bounds, T * NU) && kpirl_mpc_all_finite(at->path, T * NH) &&
         kpirl_mpc_all_finite(numbers, (int)(sizeof numbers / sizeof *numbers));
}

kpirl_mpc_status kpirl_mpc_solve(kpirl_mpc *mpc, const kpirl_mpc_input *input, const kpirl_mpc_guess *guess,
                                 kpirl_mpc_solution *solution) {
  kpirl_mpc_numbers numbers;
  kpirl_mpc_status status = check_input(mpc, input, &numbers);
  if (status == KPIRL_MPC_CONVERGED) status = check_guess(guess);
  if (status == KPIRL_MPC_CONVERGED && !solution) status = KPIRL_MPC_ERROR_NULL;
  if (status != KPIRL_MPC_CONVERGED) return status;
  if (mpc->settings.now) mpc->started = mpc->settings.now(mpc->settings.clock);
  kpirl_mpc_run(mpc, &numbers, guess, solution);
  solution->seconds = mpc->settings.now ? mpc->settings.now(mpc->settings.clock) - mpc->started : -1;
  if (kpirl_mpc_ok(solution->status) && !all_finite(solution)) solution->status = KPIRL_MPC_NOT_FINITE;
  return solution->status;
}

kpirl_mpc_guess kpirl_mpc_resume(const kpirl_mpc_solution *solution) {
  kpirl_mpc_guess guess;
  guess.states = solution->states;
  guess.actions = solution->actions;
  guess.dynamics = solution->dynamics;
  guess.state_bounds = solution->state_bounds;
  guess.action_bounds = solution->action_bounds;
  guess.path = solution->path;
  return guess;
}

/* Rows 1, 2 .. of an array (rows, n) become 0, 1 ..; the last one stays. */
static void move_up(real *array, int rows, int n) { memmove(array, array + n, (size_t)((rows - 1) * n) * sizeof(real)); }

kpirl_mpc_status kpirl_mpc_shift(kpirl_mpc *mpc, const real *psi, kpirl_mpc_solution *solution) {
  real next[NS];
  kpirl_mpc_status status;
  if (!solution) return KPIRL_MPC_ERROR_NULL;
  status = kpirl_mpc_predict(mpc, solution->states + T * NS, solution->actions + (T - 1) * NU, psi, next);
  if (status != KPIRL_MPC_CONVERGED) return status;
  move_up(solution->states, T + 1, NS);
  memcpy(solution->states + T * NS, next, sizeof next);
  move_up(solution->actions, T, NU);
  move_up(solution->dynamics, T, NS);
  move_up(solution->state_bounds, T, NS);
  move_up(solution->action_bounds, T, NU);
  move_up(solution->path, NH > 0 ? T : 1, NH);
  return KPIRL_MPC_CONVERGED;
}

kpirl_mpc_status kpirl_mpc_predict(kpirl_mpc *mpc, const real *state, const real *action, const real *psi, real *next) {
  const real *arguments[3];
  real result[NS], *results[1];
  if (!mpc || !state || !action || !next) return KPIRL_MPC_ERROR_NULL;
  if (!is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  if (!psi) psi = mpc->psi;
  if (!kpirl_mpc_all_finite(state, NS) || !kpirl_mpc_all_finite(action, NU) || !kpirl_mpc_all_finite(psi, NP))
    return KPIRL_MPC_ERROR_INPUT;
  arguments[0] = state;
  arguments[1] = action;
  arguments[2] = psi;
  results[0] = result;
  kpirl_mpc_call(mpc, kpirl_mpc_dynamics, 3, arguments, 1, results);
  if (!kpirl_mpc_all_finite(result, NS)) return KPIRL_MPC_NOT_FINITE;
  memcpy(next, result, sizeof result);
  return KPIRL_MPC_CONVERGED;
}

/* ---- learning ----------------------------------------------------------------------------------------------- */

kpirl_mpc_status kpirl_mpc_gradient(kpirl_mpc *mpc, const kpirl_mpc_input *input, const kpirl_mpc_guess *guess,
                                    const kpirl_mpc_solution *solution, const real *by_states, const real *by_actions,
                                    kpirl_mpc_gradients *gradients) {
  kpirl_mpc_numbers numbers;
  kpirl_mpc_guess plan;
  kpirl_mpc_status status = check_input(mpc, input, &numbers);
  if (status == KPIRL_MPC_CONVERGED) status = check_guess(guess);
  if (status != KPIRL_MPC_CONVERGED) return status;
  if (!solution || !by_states || !by_actions || !gradients) return KPIRL_MPC_ERROR_NULL;
  plan = kpirl_mpc_resume(solution);
  status = check_guess(&plan);
  if (status != KPIRL_MPC_CONVERGED) return status;
  if (!kpirl_mpc_all_finite(by_states, (T + 1) * NS) || !kpirl_mpc_all_finite(by_actions, T * NU))
    return KPIRL_MPC_ERROR_INPUT;
  status = kpirl_mpc_differentiate_plan(mpc, &numbers, guess, solution, by_states, by_actions, gradients);
  if (status == KPIRL_MPC_CONVERGED &&
      !(kpirl_mpc_all_finite(gradients->psi, NP) && kpirl_mpc_all_finite(gradients->state, NS) &&
        kpirl_mpc_all_finite(gradients->context, NC)))
    return KPIRL_MPC_NOT_FINITE;
  return status;
}
