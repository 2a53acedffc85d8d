/* SPDX-License-Identifier: MIT
 *
 * Sequential quadratic programming. The solver itself is generated (CasADi's sqpmethod with qrqp) and asks when to stop; the
 * first-order conditions are measured where it stopped.
 */
#include "kpirl_mpc_controller.h"

#include <string.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON, NW = KPIRL_MPC_N_POINT };
enum { STATES = (T + 1) * NS, ROWS = KPIRL_MPC_N_ROWS, EQUALITIES = KPIRL_MPC_N_EQUALITIES };
enum { NP = KPIRL_MPC_N_PARAMETERS, NC = KPIRL_MPC_N_CONTEXT };

/* Where the multiplier of every row stands among all multipliers of the constraints, one array behind the other: dynamics,
 * path equalities, terminal equalities, path and terminal constraints. Rows that the schedule switches off are none. */
extern const int kpirl_mpc_exported_rows[ROWS];

static real larger(real a, real b) { return a > b || isnan(a) ? a : b; }

int kpirl_mpc_begin(kpirl_mpc *mpc) {
  (void)mpc;
  return 1;
}

int kpirl_mpc_knows(const kpirl_mpc_settings *settings) { return settings->steps == 0 && settings->barrier <= 0; }

int kpirl_mpc_follows_schedules(void) { return 0; }

/* ---- arguments ---------------------------------------------------------------------------------------------- */

/* The place of a row's multiplier in one of these arrays. */
static size_t find(int row, size_t *array) {
  static const size_t lengths[] = {T * NS, T * KPIRL_MPC_N_PATH_EQUALITY, KPIRL_MPC_N_TERMINAL_EQUALITY, T * KPIRL_MPC_N_PATH,
                                   KPIRL_MPC_N_TERMINAL};
  size_t place = (size_t)kpirl_mpc_exported_rows[row];
  for (*array = 0; place >= lengths[*array]; ++*array) place -= lengths[*array];
  return place;
}

static void take_multipliers(const kpirl_mpc_guess *guess, real *of_rows) {
  const real *const from[] = {guess->dynamics, guess->path_equality, guess->terminal_equality, guess->path, guess->terminal};
  size_t array, place;
  int i;
  for (i = 0; i < ROWS; ++i) {
    place = find(i, &array);
    of_rows[i] = from[array][place];
  }
}

static void give_multipliers(const real *of_rows, kpirl_mpc_solution *solution) {
  real *const to[] = {solution->dynamics, solution->path_equality, solution->terminal_equality, solution->path,
                      solution->terminal};
  size_t array, place;
  int i;
  for (i = 0; i < ROWS; ++i) {
    place = find(i, &array);
    to[array][place] = of_rows[i];
  }
}

static void copy(real *to, const real *from, int count) {
  if (count > 0) memcpy(to, from, (size_t)count * sizeof(real));
}

/* Where no guess is given: the rollout of no action. */
static void roll_out(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, real *w) {
  real x[NS + NU] = {0};
  int t;
  memset(w, 0, NW * sizeof(real));
  memcpy(w, numbers->s0, NS * sizeof(real));
  for (t = 0; t < T; ++t) {
    memcpy(x, w + t * NS, NS * sizeof(real));
    kpirl_mpc_step_model(mpc, numbers, t, x, w + (t + 1) * NS);
  }
}

static void fill_arguments(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess) {
  kpirl_mpc_workspace *work = &mpc->work;
  int i;
  memset(work->guess_w, 0, sizeof work->guess_w);
  memset(work->guess_rows, 0, sizeof work->guess_rows);
  if (guess) {
    copy(work->guess, guess->states, STATES);
    copy(work->guess + STATES, guess->actions, T * NU);
  } else {
    roll_out(mpc, numbers, work->guess);
  }
  if (guess && guess->dynamics) {
    copy(work->guess_w, guess->state_bounds, STATES);
    copy(work->guess_w + STATES, guess->action_bounds, T * NU);
    take_multipliers(guess, work->guess_rows);
  }
  kpirl_mpc_separate(mpc->lower, work->lower, work->lower + STATES);
  kpirl_mpc_separate(mpc->upper, work->upper, work->upper + STATES);
  for (i = 0; i < NS; ++i)
    if (kpirl_mpc_is_given(i)) work->guess[i] = work->lower[i] = work->upper[i] = numbers->s0[i];
  for (i = 0; i < ROWS; ++i) {
    work->lower_rows[i] = i < EQUALITIES ? 0 : -(real)INFINITY;
    work->upper_rows[i] = 0;
  }
  copy(work->numbers, numbers->psi, NP);
  copy(work->numbers + NP, numbers->context, NC);
}

/* ---- the first-order conditions ----------------------------------------------------------------------------- */

/* The conditions of one bound with slack >= 0 and force >= 0. */
static void add_bound(real slack, real force, real *violation, real *product) {
  *violation = larger(-slack, *violation);
  *product = larger(larger(kpirl_mpc_abs(force * slack), -force), *product);
}

/* Stationarity, feasibility, complementarity (and signs of multipliers), scale. */
static void audit(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, kpirl_mpc_solution *solution) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_audit_arguments at = {0};
  kpirl_mpc_audit_results to = {0};
  real violation = 0, product = 0, stationarity = 0, scale = 1;
  int i;
  at.w = work->w;
  at.psi = numbers->psi;
  at.context = numbers->context;
  at.multipliers = work->of_rows;
  to.cost = &solution->objective;
  to.rows = work->rows;
  to.cost_gradient = work->cost_gradient;
  to.gradient = work->gradient;
  (void)kpirl_mpc_audit(&mpc->scratch, &at, &to);
  for (i = 0; i < NW; ++i) {
    const real w = work->w[i], nu = work->of_w[i], low = work->lower[i], high = work->upper[i];
    const int two = isfinite(low) && isfinite(high);
    if (kpirl_mpc_is_given(i)) continue;
    stationarity = larger(kpirl_mpc_abs(work->gradient[i] + nu), stationarity);
    scale = larger(kpirl_mpc_abs(work->cost_gradient[i]), scale);
    if (low == high) {
      violation = larger(kpirl_mpc_abs(w - low), violation);
      continue;
    }
    if (isfinite(low)) add_bound(w - low, two ? larger(-nu, 0) : -nu, &violation, &product);
    if (isfinite(high)) add_bound(high - w, two ? larger(nu, 0) : nu, &violation, &product);
  }
  violation = larger(kpirl_mpc_norm_inf(work->rows, EQUALITIES), violation);
  for (i = EQUALITIES; i < ROWS; ++i) add_bound(-work->rows[i], work->of_rows[i], &violation, &product);
  scale = larger(kpirl_mpc_norm_inf(work->of_rows, ROWS), scale);
  kpirl_mpc_set_residuals(solution, stationarity, violation, product, scale);
}

/* ---- the solver --------------------------------------------------------------------------------------------- */

int kpirl_mpc_sqp_stops(void *watch, int iterations, real violation, real stationarity) {
  kpirl_mpc *mpc = (kpirl_mpc *)watch;
  const kpirl_mpc_settings *settings = &mpc->settings;
  mpc->work.iterations = iterations;
  if (violation < settings->tolerance && stationarity < settings->tolerance) return 1;
  mpc->work.out_of_time = kpirl_mpc_out_of_time(mpc);
  return mpc->work.out_of_time || iterations >= settings->max_iterations;
}

/* 0, unless it could not go on: then the guess is all there is. */
static int call_solver(kpirl_mpc *mpc) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_sqp_arguments at = {0};
  kpirl_mpc_sqp_results to = {0};
  at.x0 = work->guess;
  at.p = work->numbers;
  at.lbx = work->lower;
  at.ubx = work->upper;
  at.lbg = work->lower_rows;
  at.ubg = work->upper_rows;
  at.lam_x0 = work->guess_w;
  at.lam_g0 = work->guess_rows;
  at.watch = mpc;
  memcpy(work->w, work->guess, sizeof work->w);
  memset(work->of_w, 0, sizeof work->of_w);
  memset(work->of_rows, 0, sizeof work->of_rows);
  to.x = work->w;
  to.lam_x = work->of_w;
  to.lam_g = work->of_rows;
  work->iterations = work->out_of_time = 0;
  return kpirl_mpc_sqp(&mpc->scratch, &at, &to);
}

static kpirl_mpc_status end(const kpirl_mpc *mpc, const kpirl_mpc_solution *solution) {
  const kpirl_mpc_workspace *work = &mpc->work;
  const int finite = isfinite(solution->objective) && isfinite(solution->residual);
  if (!finite || !kpirl_mpc_all_finite(work->w, NW)) return KPIRL_MPC_NOT_FINITE;
  if (solution->residual <= mpc->settings.tolerance) return KPIRL_MPC_CONVERGED;
  if (work->out_of_time) return KPIRL_MPC_TIME_LIMIT;
  return work->iterations >= mpc->settings.max_iterations ? KPIRL_MPC_ITERATION_LIMIT : KPIRL_MPC_STALLED;
}

void kpirl_mpc_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, const kpirl_mpc_guess *guess,
                    kpirl_mpc_solution *solution) {
  kpirl_mpc_workspace *work = &mpc->work;
  int i, failed;
  fill_arguments(mpc, numbers, guess);
  failed = call_solver(mpc);
  memset(solution, 0, sizeof *solution);
  audit(mpc, numbers, solution);
  copy(solution->states, work->w, STATES);
  copy(solution->actions, work->w + STATES, T * NU);
  copy(solution->state_bounds, work->of_w, STATES);
  copy(solution->action_bounds, work->of_w + STATES, T * NU);
  for (i = 0; i < NS; ++i)
    if (kpirl_mpc_is_given(i)) solution->state_bounds[i] = 0;
  give_multipliers(work->of_rows, solution);
  solution->iterations = work->iterations;
  solution->status = failed ? KPIRL_MPC_FAILED : end(mpc, solution);
}

kpirl_mpc_status kpirl_mpc_differentiate_plan(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers,
                                              const kpirl_mpc_guess *guess, const kpirl_mpc_solution *solution,
                                              const real *by_states, const real *by_actions,
                                              kpirl_mpc_gradients *gradients) {
  (void)mpc, (void)numbers, (void)guess, (void)solution, (void)by_states, (void)by_actions, (void)gradients;
  return KPIRL_MPC_ERROR_UNSUPPORTED;
}
