/* SPDX-License-Identifier: MIT
 *
 * The interior-point method as the solver of a controller.
 */
#include "kpirl_mpc_interface.h"

#include <string.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON };
enum { PATH = T * KPIRL_MPC_N_PATH, TERMINAL = KPIRL_MPC_N_TERMINAL };
enum { EQUALITY = T * KPIRL_MPC_N_PATH_EQUALITY, TERMINAL_EQUALITY = KPIRL_MPC_N_TERMINAL_EQUALITY };

int kpirl_mpc_begin(kpirl_mpc *mpc) {
  static const kpirl_mpc_dimensions dimensions = {
      T, NS, NU, KPIRL_MPC_N_PATH, KPIRL_MPC_N_PATH_EQUALITY, TERMINAL, TERMINAL_EQUALITY, KPIRL_MPC_N_PARAMETERS,
      KPIRL_MPC_N_CONTEXT, KPIRL_MPC_N_SCHEDULE};
  kpirl_mpc_model model = kpirl_mpc_exported_model;
  kpirl_mpc_bounds bounds;
  int level;
  for (level = 0; level < KPIRL_MPC_LEVELS; ++level) model.stage[level].self = model.last[level].self = &mpc->scratch;
  bounds.lower = mpc->lower;
  bounds.upper = mpc->upper;
  bounds.free_entries = kpirl_mpc_exported_free;
  bounds.n_free = KPIRL_MPC_N_FREE;
  if (kpirl_mpc_core_size(&dimensions, &bounds, &model) > sizeof mpc->work.memory) return 0;
  mpc->work.core = kpirl_mpc_core_init(&dimensions, &bounds, &model, mpc->work.memory);
  return 1;
}

int kpirl_mpc_knows(const kpirl_mpc_settings *settings) {
  (void)settings;
  return 1;
}

int kpirl_mpc_follows_schedules(void) { return 1; }

static void copy(real *to, const real *from, int count) {
  if (count > 0) memcpy(to, from, (size_t)count * sizeof(real));
}

kpirl_mpc_start kpirl_mpc_take_guess(kpirl_mpc *mpc, const kpirl_mpc_guess *guess) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_start start = {NULL, NULL, NULL, NULL, NULL};
  if (!guess) return start;
  kpirl_mpc_interleave(guess->states, guess->actions, work->x);
  start.x = work->x;
  if (!guess->dynamics) return start;
  kpirl_mpc_interleave(guess->state_bounds, guess->action_bounds, work->bounds);
  copy(work->path, guess->path, PATH);
  copy(work->path + PATH, guess->terminal, TERMINAL);
  copy(work->equality, guess->path_equality, EQUALITY);
  copy(work->equality + EQUALITY, guess->terminal_equality, TERMINAL_EQUALITY);
  start.costates = guess->dynamics;
  start.bounds = work->bounds;
  start.path = work->path;
  start.equality = work->equality;
  return start;
}

kpirl_mpc_options kpirl_mpc_options_of(const kpirl_mpc *mpc) {
  const kpirl_mpc_settings *settings = &mpc->settings;
  kpirl_mpc_options options = {0, 0, 0, 0, 0, NULL, NULL, NULL, NULL};
  options.max_iterations = settings->max_iterations;
  options.steps = settings->steps;
  options.tolerance = (double)settings->tolerance;
  options.barrier = (double)settings->barrier;
  options.time_limit = settings->time_limit;
  options.now = settings->now;
  options.clock = settings->clock;
  return options;
}

static void write_solution(kpirl_mpc *mpc, kpirl_mpc_solution *solution) {
  const kpirl_mpc_core *core = (const kpirl_mpc_core *)mpc->work.core;
  kpirl_mpc_view view;
  int i;
  kpirl_mpc_core_view(core, &view);
  kpirl_mpc_bound_multipliers(core, mpc->work.bounds);
  for (i = 0; i < NS; ++i)
    if (kpirl_mpc_is_given(i)) mpc->work.bounds[i] = 0;
  kpirl_mpc_separate(view.x, solution->states, solution->actions);
  kpirl_mpc_separate(mpc->work.bounds, solution->state_bounds, solution->action_bounds);
  copy(solution->dynamics, view.costates, T * NS);
  copy(solution->path, view.path_multipliers, PATH);
  copy(solution->terminal, view.path_multipliers + PATH, TERMINAL);
  copy(solution->path_equality, view.equality_multipliers, EQUALITY);
  copy(solution->terminal_equality, view.equality_multipliers + EQUALITY, TERMINAL_EQUALITY);
  solution->objective = view.objective;
  solution->iterations = view.iterations;
}

void kpirl_mpc_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                    kpirl_mpc_solution *solution) {
  const kpirl_mpc_start start = kpirl_mpc_take_guess(mpc, guess);
  const kpirl_mpc_options options = kpirl_mpc_options_of(mpc);
  kpirl_mpc_residuals residuals;
  solution->status =
      kpirl_mpc_core_solve((kpirl_mpc_core *)mpc->work.core, numbers, &options, &start, &residuals);
  write_solution(mpc, solution);
  kpirl_mpc_set_residuals(solution, residuals.stationarity, residuals.feasibility, residuals.complementarity,
                          residuals.scale);
}
