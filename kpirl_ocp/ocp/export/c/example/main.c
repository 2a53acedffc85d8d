/* SPDX-License-Identifier: MIT
 *
 * Closed loop on the exported model: plan, command the first action, see where the model goes, plan again from there.
 */
#include <stdio.h>
#include <string.h>

#include "../test/records.h"
#include "kpirl_mpc_memory.h"

static kpirl_mpc memory; /* no heap: the controller is in static memory */

int main(void) {
  kpirl_mpc *mpc = NULL;
  static kpirl_mpc_solution plan;
  kpirl_mpc_real state[KPIRL_MPC_N_STATES];
  kpirl_mpc_input input = {.state = state, .context = kpirl_mpc_record_context[0]};
  kpirl_mpc_guess guess;
  int period, i;
  const int follows = (int)(sizeof kpirl_mpc_record_schedule / sizeof *kpirl_mpc_record_schedule) - KPIRL_MPC_HORIZON - 1;

  if (kpirl_mpc_init(&mpc, &memory, sizeof memory) < 0) return 1;
  printf("%s\n%zu bytes of memory\n\nstep  status      iterations  objective      actions\n", kpirl_mpc_version(),
         kpirl_mpc_size());
  memcpy(state, kpirl_mpc_record_state[0], sizeof state);
  for (period = 0; period < KPIRL_MPC_HORIZON; ++period) {
    kpirl_mpc_status status;
    if (follows > 0) input.schedule = kpirl_mpc_record_schedule[period < follows ? period : follows];
    if (period > 0) {
      if (kpirl_mpc_shift(mpc, &input, &plan) != KPIRL_MPC_CONVERGED) return 1;
      guess = kpirl_mpc_resume(&plan);
    }
    status = kpirl_mpc_solve(mpc, &input, period > 0 ? &guess : NULL, &plan);
    printf("%4d  %-10s  %10d  %13.6e ", period, kpirl_mpc_ok(status) ? "ok" : "not ok", plan.iterations,
           (double)plan.objective);
    for (i = 0; i < KPIRL_MPC_N_ACTIONS; ++i) printf(" %8.4f", (double)plan.actions[i]);
    printf("\n");
    if (!kpirl_mpc_ok(status)) {
      printf("%s\n", kpirl_mpc_message(status));
      return 1;
    }
    if (kpirl_mpc_predict(mpc, &input, plan.actions, state) != KPIRL_MPC_CONVERGED) return 1;
  }
  return 0;
}
