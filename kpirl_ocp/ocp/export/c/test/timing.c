/* SPDX-License-Identifier: MIT
 *
 * How long a solve takes: a warm-started closed loop on the exported model, with a little noise and a goal that moves on a
 * circle. Arguments: how many steps, size of the noise, radius of the circle; and, to change the settings, steps of
 * the real-time iteration (0: until it converges), barrier and tolerance. Needs POSIX for its clock.
 */
#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "kpirl_mpc_memory.h"
#include "records.h"

static kpirl_mpc memory;

static double now(void *unused) {
  struct timespec time;
  (void)unused;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static int by_size(const void *a, const void *b) {
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static double noise(void) { return 2.0 * rand() / RAND_MAX - 1; }

int main(int argc, char **argv) {
  const int steps = argc > 1 ? atoi(argv[1]) : 10000, period = 50;
  const double disturbance = argc > 2 ? atof(argv[2]) : 1e-3, radius = argc > 3 ? atof(argv[3]) : 0.03;
  double *seconds = (double *)malloc((size_t)steps * sizeof(double)), iterations = 0;
  kpirl_mpc_real state[KPIRL_MPC_N_STATES], goal[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_CONTEXT)];
  kpirl_mpc_input input = {.state = state, .context = goal};
  kpirl_mpc_settings settings;
  kpirl_mpc_guess guess;
  static kpirl_mpc_solution plan;
  kpirl_mpc *mpc = NULL;
  int step, i, failed = 0;
  if (!seconds || kpirl_mpc_init(&mpc, &memory, sizeof memory) < 0) return 1;
  kpirl_mpc_get_settings(mpc, &settings);
  settings.now = now;
  if (argc > 6) {
    settings.steps = atoi(argv[4]);
    settings.barrier = (kpirl_mpc_real)atof(argv[5]);
    settings.tolerance = (kpirl_mpc_real)atof(argv[6]);
  }
  if (kpirl_mpc_set_settings(mpc, &settings) != KPIRL_MPC_CONVERGED) return 1;
  memcpy(state, kpirl_mpc_record_state[0], sizeof state);
  memset(goal, 0, sizeof goal);
  for (step = -10; step < steps; ++step) { /* the first ten warm up */
    for (i = 0; i < KPIRL_MPC_N_CONTEXT; ++i) {
      const double angle = 6.283185307179586 * step / period + (i % 2 ? -1.5707963267948966 : 0);
      goal[i] = kpirl_mpc_record_context[0][i] + (kpirl_mpc_real)(radius * cos(angle));
    }
    guess = kpirl_mpc_resume(&plan);
    if (kpirl_mpc_solve(mpc, &input, step > -10 ? &guess : NULL, &plan) < 0) return 1;
    failed += !kpirl_mpc_ok(plan.status);
    iterations += plan.iterations;
    if (step >= 0) seconds[step] = plan.seconds;
    if (kpirl_mpc_predict(mpc, &input, plan.actions, state) != KPIRL_MPC_CONVERGED) return 1;
    for (i = 0; i < KPIRL_MPC_N_CONTEXT && i < KPIRL_MPC_N_STATES; ++i)
      state[i] += (kpirl_mpc_real)(disturbance * noise());
  }
  qsort(seconds, (size_t)steps, sizeof(double), by_size);
  printf("{\"steps\": %d, \"median_ms\": %.6f, \"minimum_ms\": %.6f, \"p99_ms\": %.6f, \"worst_ms\": %.6f, "
         "\"iterations\": %.3f, \"failed\": %d, \"bytes\": %zu}\n",
         steps, 1e3 * seconds[steps / 2], 1e3 * seconds[0], 1e3 * seconds[(int)(0.99 * steps)], 1e3 * seconds[steps - 1],
         iterations / (steps + 10), failed, kpirl_mpc_size());
  free(seconds);
  return 0;
}
