/* SPDX-License-Identifier: MIT
 *
 * The calls of every period: their inputs are checked here, and the solver does the work.
 */
#include "kpirl_mpc_controller.h"

#include <string.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON };
enum { NP = KPIRL_MPC_N_PARAMETERS, NC = KPIRL_MPC_N_CONTEXT, ND = KPIRL_MPC_N_SCHEDULE };
enum { NH = KPIRL_MPC_N_PATH, NE = KPIRL_MPC_N_PATH_EQUALITY };
enum { NHT = KPIRL_MPC_N_TERMINAL, NET = KPIRL_MPC_N_TERMINAL_EQUALITY };

/* ---- checks ------------------------------------------------------------------------------------------------- */

/* The numbers of an input; s0 may be NULL. */
static kpirl_mpc_status take_numbers(const kpirl_mpc *mpc, const kpirl_mpc_input *input, kpirl_mpc_numbers *numbers) {
  if (!mpc || !input || (NC > 0 && !input->context)) return KPIRL_MPC_ERROR_NULL;
  if (!kpirl_mpc_is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  numbers->s0 = input->state;
  numbers->context = input->context;
  numbers->psi = input->psi ? input->psi : mpc->psi;
  numbers->schedule = input->schedule ? input->schedule : kpirl_mpc_exported_schedule;
  if (input->schedule && !kpirl_mpc_follows_schedules()) return KPIRL_MPC_ERROR_UNSUPPORTED;
  return kpirl_mpc_all_finite(numbers->s0, numbers->s0 ? NS : 0) && kpirl_mpc_all_finite(numbers->context, NC) &&
                 kpirl_mpc_all_finite(numbers->psi, NP) && kpirl_mpc_all_finite(numbers->schedule, (T + 1) * ND)
             ? KPIRL_MPC_CONVERGED
             : KPIRL_MPC_ERROR_INPUT;
}

static kpirl_mpc_status check_input(const kpirl_mpc *mpc, const kpirl_mpc_input *input, kpirl_mpc_numbers *numbers) {
  if (input && !input->state) return KPIRL_MPC_ERROR_NULL;
  return take_numbers(mpc, input, numbers);
}

/* The multipliers of a guess and their lengths. */
enum { MULTIPLIERS = 7 };

static void list_multipliers(const kpirl_mpc_guess *guess, const real **arrays, int *lengths) {
  const real *const all[MULTIPLIERS] = {guess->dynamics, guess->state_bounds,  guess->action_bounds,    guess->path,
                                        guess->path_equality, guess->terminal, guess->terminal_equality};
  const int sizes[MULTIPLIERS] = {T * NS, (T + 1) * NS, T * NU, T * NH, T * NE, NHT, NET};
  memcpy(arrays, all, sizeof all);
  memcpy(lengths, sizes, sizeof sizes);
}

static kpirl_mpc_status check_guess(const kpirl_mpc_guess *guess) {
  const real *arrays[MULTIPLIERS];
  int lengths[MULTIPLIERS], i, given = 0;
  if (!guess) return KPIRL_MPC_CONVERGED;
  if (!guess->states || (NU > 0 && !guess->actions)) return KPIRL_MPC_ERROR_NULL;
  if (!kpirl_mpc_all_finite(guess->states, (T + 1) * NS) || !kpirl_mpc_all_finite(guess->actions, T * NU))
    return KPIRL_MPC_ERROR_INPUT;
  list_multipliers(guess, arrays, lengths);
  for (i = 0; i < MULTIPLIERS; ++i) given |= arrays[i] != NULL;
  for (i = 0; i < MULTIPLIERS && given; ++i)
    if (lengths[i] > 0 && !arrays[i]) return KPIRL_MPC_ERROR_NULL;
  for (i = 0; i < MULTIPLIERS && given; ++i)
    if (!kpirl_mpc_all_finite(arrays[i], lengths[i])) return KPIRL_MPC_ERROR_INPUT;
  return KPIRL_MPC_CONVERGED;
}

/* Is every number of a solution finite? */
static int all_finite(const kpirl_mpc_solution *at) {
  const kpirl_mpc_guess all = kpirl_mpc_resume(at);
  const real numbers[] = {at->objective, at->residual, at->stationarity, at->feasibility, at->complementarity, at->scale};
  return check_guess(&all) == KPIRL_MPC_CONVERGED &&
         kpirl_mpc_all_finite(numbers, (int)(sizeof numbers / sizeof *numbers));
}

/* ---- calls -------------------------------------------------------------------------------------------------- */

kpirl_mpc_status kpirl_mpc_solve(kpirl_mpc *mpc, const kpirl_mpc_input *input, const kpirl_mpc_guess *guess,
                                 kpirl_mpc_solution *solution) {
  kpirl_mpc_numbers numbers;
  kpirl_mpc_status status = check_input(mpc, input, &numbers);
  if (status == KPIRL_MPC_CONVERGED) status = check_guess(guess);
  if (status == KPIRL_MPC_CONVERGED && !solution) status = KPIRL_MPC_ERROR_NULL;
  if (status != KPIRL_MPC_CONVERGED) return status;
  if (mpc->settings.now) mpc->started = mpc->settings.now(mpc->settings.clock);
  kpirl_mpc_plan(mpc, &numbers, guess, solution);
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
  guess.path_equality = solution->path_equality;
  guess.terminal = solution->terminal;
  guess.terminal_equality = solution->terminal_equality;
  return guess;
}

/* Rows 1, 2 .. of an array (rows, n) become 0, 1 ..; the last one stays. */
static void move_up(real *array, int rows, int n) {
  if (n > 0) memmove(array, array + n, (size_t)((rows - 1) * n) * sizeof(real));
}

static kpirl_mpc_status step_model(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, int t, const real *state,
                                   const real *action, real *next) {
  real x[NS + NU], result[NS];
  if (!kpirl_mpc_all_finite(state, NS) || !kpirl_mpc_all_finite(action, NU)) return KPIRL_MPC_ERROR_INPUT;
  memcpy(x, state, sizeof result);
  if (NU > 0) memcpy(x + NS, action, NU * sizeof(real));
  kpirl_mpc_step_model(mpc, numbers, t, x, result);
  if (!kpirl_mpc_all_finite(result, NS)) return KPIRL_MPC_NOT_FINITE;
  memcpy(next, result, sizeof result);
  return KPIRL_MPC_CONVERGED;
}

kpirl_mpc_status kpirl_mpc_shift(kpirl_mpc *mpc, const kpirl_mpc_input *input, kpirl_mpc_solution *solution) {
  real next[NS];
  int i;
  kpirl_mpc_numbers numbers;
  kpirl_mpc_status status = take_numbers(mpc, input, &numbers);
  if (status == KPIRL_MPC_CONVERGED && !solution) status = KPIRL_MPC_ERROR_NULL;
  if (status != KPIRL_MPC_CONVERGED) return status;
  status = step_model(mpc, &numbers, T - 1, solution->states + T * NS, solution->actions + (T - 1) * NU, next);
  if (status != KPIRL_MPC_CONVERGED) return status;
  move_up(solution->states, T + 1, NS);
  memcpy(solution->states + T * NS, next, sizeof next);
  move_up(solution->actions, T, NU);
  move_up(solution->dynamics, T, NS);
  move_up(solution->state_bounds, T + 1, NS);
  for (i = 0; i < NS; ++i)
    if (kpirl_mpc_is_given(i)) solution->state_bounds[i] = 0;
  move_up(solution->action_bounds, T, NU);
  move_up(solution->path, T, NH);
  move_up(solution->path_equality, T, NE);
  return KPIRL_MPC_CONVERGED;
}

kpirl_mpc_status kpirl_mpc_predict(kpirl_mpc *mpc, const kpirl_mpc_input *input, const real *action, real *next) {
  kpirl_mpc_numbers numbers;
  const kpirl_mpc_status status = check_input(mpc, input, &numbers);
  if (status != KPIRL_MPC_CONVERGED) return status;
  if ((NU > 0 && !action) || !next) return KPIRL_MPC_ERROR_NULL;
  return step_model(mpc, &numbers, 0, input->state, action, next);
}

kpirl_mpc_status kpirl_mpc_gradient(kpirl_mpc *mpc, const kpirl_mpc_input *input, const kpirl_mpc_guess *guess,
                                    const kpirl_mpc_solution *solution, const real *by_states, const real *by_actions,
                                    kpirl_mpc_gradients *gradients) {
  kpirl_mpc_numbers numbers;
  kpirl_mpc_guess plan;
  kpirl_mpc_status status = check_input(mpc, input, &numbers);
  if (status == KPIRL_MPC_CONVERGED) status = check_guess(guess);
  if (status != KPIRL_MPC_CONVERGED) return status;
  if (!solution || !by_states || (NU > 0 && !by_actions) || !gradients) return KPIRL_MPC_ERROR_NULL;
  plan = kpirl_mpc_resume(solution);
  status = check_guess(&plan);
  if (status != KPIRL_MPC_CONVERGED) return status;
  if (!kpirl_mpc_all_finite(by_states, (T + 1) * NS) || !kpirl_mpc_all_finite(by_actions, T * NU))
    return KPIRL_MPC_ERROR_INPUT;
  return kpirl_mpc_differentiate_plan(mpc, &numbers, guess, solution, by_states, by_actions, gradients);
}
