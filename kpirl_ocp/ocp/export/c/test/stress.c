/* SPDX-License-Identifier: MIT
 *
 * Random solves with valid and invalid inputs: an error must leave all outputs as they were, and a status that is ok must
 * come without NaN and infinity. Arguments: how many solves, and a seed. Best with -fsanitize=address,undefined; with
 * -DCOUNT_ALLOCATIONS and -Wl,--wrap=malloc,--wrap=calloc,--wrap=realloc,--wrap=free calls of the heap are counted.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "kpirl_mpc_controller.h"
#include "records.h"

#ifdef COUNT_ALLOCATIONS
static int allocations = 0;
void *__real_malloc(size_t size);
void *__real_calloc(size_t count, size_t size);
void *__real_realloc(void *memory, size_t size);
void __real_free(void *memory);
void *__wrap_malloc(size_t size);
void *__wrap_calloc(size_t count, size_t size);
void *__wrap_realloc(void *memory, size_t size);
void __wrap_free(void *memory);
void *__wrap_malloc(size_t size) { return ++allocations, __real_malloc(size); }
void *__wrap_calloc(size_t count, size_t size) { return ++allocations, __real_calloc(count, size); }
void *__wrap_realloc(void *memory, size_t size) { return ++allocations, __real_realloc(memory, size); }
void __wrap_free(void *memory) { ++allocations, __real_free(memory); }
#endif

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, T = KPIRL_MPC_HORIZON, NC = KPIRL_MPC_N_CONTEXT };
enum { NP = KPIRL_MPC_N_PARAMETERS, ND = (T + 1) * KPIRL_MPC_N_SCHEDULE, STATES = (T + 1) * NS, ACTIONS = T * NU };

static kpirl_mpc memory;
static kpirl_mpc_solution plan, before;
static kpirl_mpc_gradients gradients, gradients_before;
static real state[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_STATES)], context[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_CONTEXT)];
static real schedule[KPIRL_MPC_AT_LEAST_ONE((KPIRL_MPC_HORIZON + 1) * KPIRL_MPC_N_SCHEDULE)];
static real psi[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_PARAMETERS)];
static unsigned long long seed = 1;
static int failures = 0;

/* A whole number below n. */
static int below(int n) {
  seed = seed * 6364136223846793005ULL + 1442695040888963407ULL;
  return (int)((seed >> 33) % (unsigned long long)n);
}

/* In [-1, 1]. */
static real uniform(void) { return (real)(below(2000001) - 1000000) / (real)1e6; }

static void vary(const real *usual, real *values, int count, real size) {
  int i;
  for (i = 0; i < count; ++i) values[i] = usual[i] + size * uniform() * (1 + (real)fabs((double)usual[i]));
}

static void spoil(real *values, int count) {
  const int kind = below(3);
  if (count > 0) values[below(count)] = kind == 0 ? (real)NAN : kind == 1 ? (real)INFINITY : -(real)INFINITY;
}

static void expect(int holds, const char *what) {
  if (holds) return;
  ++failures;
  printf("FAILED: %s\n", what);
}

static int finite_plan(void) {
  int i, finite = isfinite(plan.objective) && isfinite(plan.residual) && isfinite(plan.scale);
  for (i = 0; i < STATES; ++i) finite = finite && isfinite(plan.states[i]);
  for (i = 0; i < ACTIONS; ++i) finite = finite && isfinite(plan.actions[i]);
  for (i = 0; i < T * NS; ++i) finite = finite && isfinite(plan.dynamics[i]);
  for (i = 0; i < STATES; ++i) finite = finite && isfinite(plan.state_bounds[i]);
  for (i = 0; i < ACTIONS; ++i) finite = finite && isfinite(plan.action_bounds[i]);
  return finite;
}

/* One solve, and perhaps a gradient; counts[status] or, for errors, the last one. */
static void solve(kpirl_mpc *mpc, int *counts) {
  const int record = below(KPIRL_MPC_RECORDS), trouble = below(12), warm = below(3);
  kpirl_mpc_input input = {.state = state, .context = context, .psi = psi};
  kpirl_mpc_guess guess = kpirl_mpc_resume(&plan);
  kpirl_mpc_status status;
  int expected = KPIRL_MPC_CONVERGED;
  vary(kpirl_mpc_record_state[record], state, NS, (real)0.1);
  vary(kpirl_mpc_record_context[record], context, NC, (real)0.1);
  vary(kpirl_mpc_exported_psi, psi, NP, (real)0.3);
  if (below(20) == 0) vary(state, state, NS, (real)1e6); /* far out, where anything may overflow */
  if (below(50) == 0) vary(state, state, NS, (real)1e30);
  if (trouble == 0) spoil(state, NS), expected = KPIRL_MPC_ERROR_INPUT;
  if (trouble == 1 && NC > 0) spoil(context, NC), expected = KPIRL_MPC_ERROR_INPUT;
  if (trouble == 2 && NP > 0) spoil(psi, NP), expected = KPIRL_MPC_ERROR_INPUT;
  if (trouble == 3) input.state = NULL, expected = KPIRL_MPC_ERROR_NULL;
  if (trouble == 4 && warm) guess.actions = NULL, expected = KPIRL_MPC_ERROR_NULL;
  if (trouble == 5 && warm) plan.states[below(STATES)] = (real)NAN, expected = KPIRL_MPC_ERROR_INPUT;
  if (trouble == 6) input.psi = NULL;
  if (trouble == 7 && ND > 0 && kpirl_mpc_follows_schedules()) {
    vary(kpirl_mpc_exported_schedule, schedule, ND, (real)0.1);
    input.schedule = schedule;
    if (below(2)) spoil(schedule, ND), expected = KPIRL_MPC_ERROR_INPUT;
  }
  if (warm == 2) guess = (kpirl_mpc_guess){.states = guess.states, .actions = guess.actions}; /* a cold start from there */
  before = plan;
  status = kpirl_mpc_solve(mpc, &input, warm ? &guess : NULL, &plan);
  if (expected < 0) expect(status == (kpirl_mpc_status)expected, "the expected error");
  if (status < 0) expect(memcmp(&plan, &before, sizeof plan) == 0, "an error touches nothing");
  if (kpirl_mpc_ok(status)) expect(finite_plan(), "ok means finite");
  ++counts[status < 0 ? 15 : (int)status];
  if (status >= 0 && finite_plan() && below(4) == 0) {
    gradients_before = gradients;
    status = kpirl_mpc_gradient(mpc, &input, warm ? &guess : NULL, &plan, plan.states, plan.actions, &gradients);
    if (status < 0) expect(memcmp(&gradients, &gradients_before, sizeof gradients) == 0, "an error touches no gradient");
    if (status == KPIRL_MPC_CONVERGED) expect(isfinite(gradients.state[0]), "a believed gradient is finite");
  }
  if (status < 0 || !finite_plan()) memset(&plan, 0, sizeof plan);
}

/* Bounds that fit, and bounds that do not; stage by stage. */
static void move_bounds(kpirl_mpc *mpc) {
  static real lower[ACTIONS > 0 ? ACTIONS : 1], upper[ACTIONS > 0 ? ACTIONS : 1];
  kpirl_mpc_status status;
  int t, i, sane = 1;
  for (t = 0; t < T; ++t)
    for (i = 0; i < NU; ++i) {
      const int of_x = t * (NS + NU) + NS + i, place = t * NU + i;
      lower[place] = kpirl_mpc_exported_lower[of_x] * (1 + uniform() / 10);
      upper[place] = kpirl_mpc_exported_upper[of_x] * (1 + uniform() / 10);
      sane = sane && lower[place] < upper[place];
    }
  if (!sane || NU == 0) return;
  expect(kpirl_mpc_set_stage_bounds(mpc, NULL, NULL, lower, upper) == KPIRL_MPC_CONVERGED, "bounds that fit are taken");
  i = below(ACTIONS);
  lower[i] = below(2) ? (real)NAN : upper[i] + 1;
  status = kpirl_mpc_set_stage_bounds(mpc, NULL, NULL, lower, upper);
  expect(status == KPIRL_MPC_ERROR_BOUNDS, "bounds that do not fit are refused");
}

int main(int argc, char **argv) {
  const int count = argc > 1 ? atoi(argv[1]) : 200;
  int counts[16] = {0}, i;
  kpirl_mpc *mpc = NULL;
  kpirl_mpc_settings settings;
  if (argc > 2) seed = (unsigned long long)atol(argv[2]);
  expect(kpirl_mpc_init(&mpc, &memory, sizeof memory - 1) == KPIRL_MPC_ERROR_MEMORY, "too little memory is refused");
  expect(kpirl_mpc_init(&mpc, (char *)&memory + 1, sizeof memory) == KPIRL_MPC_ERROR_MEMORY, "alignment is checked");
  expect(kpirl_mpc_init(&mpc, NULL, sizeof memory) == KPIRL_MPC_ERROR_NULL, "NULL is refused");
  if (kpirl_mpc_init(&mpc, &memory, sizeof memory) != KPIRL_MPC_CONVERGED) return 1;
  printf("%d solves\n", count); /* stdio takes its memory here */
#ifdef COUNT_ALLOCATIONS
  allocations = 0;
#endif
  for (i = 0; i < count; ++i) {
    if (i % 50 == 0) move_bounds(mpc);
    if (i % 100 == 0) {
      kpirl_mpc_reset(mpc);
      kpirl_mpc_get_settings(mpc, &settings);
      if (settings.max_iterations > 60) settings.max_iterations = 60;
      if (i % 200 == 0) settings.barrier = (real)1e-3;
      (void)kpirl_mpc_set_settings(mpc, &settings); /* not all solvers take all of them */
    }
    solve(mpc, counts);
  }
#ifdef COUNT_ALLOCATIONS
  expect(allocations == 0, "the heap is not used");
#endif
  for (i = 0; i < 16; ++i)
    if (counts[i]) printf("%6d  %s\n", counts[i], i < 15 ? kpirl_mpc_message((kpirl_mpc_status)i) : "errors");
  printf("%s\n", failures ? "FAILED" : "all hold");
  return failures != 0;
}
