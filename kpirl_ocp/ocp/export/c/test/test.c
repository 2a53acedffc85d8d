/* SPDX-License-Identifier: MIT
 *
 * Solves what was solved in Python when this folder was exported, and compares: a cold start, and from its solution a
 * warm start one step along the plan.
 */
#include <math.h>
#include <stdio.h>

#include "kpirl_mpc_memory.h"
#include "records.h"

#ifdef KPIRL_MPC_FLOAT
#define TOLERANCE 3e-2 /* of single precision, whose solves stop further inside the constraints */
#define COSTS_AS_MUCH 1e-3 /* relative: where the cost is flat, another plan is as good */
#else
#define TOLERANCE 1e-9
#define COSTS_AS_MUCH 0
#endif

enum { COUNT = KPIRL_MPC_HORIZON * KPIRL_MPC_N_ACTIONS };

static kpirl_mpc memory;

/* Do status and actions agree? Where rounding decides, iterations may differ. */
static int agrees(const char *what, int record, const kpirl_mpc_solution *plan, const int *expected, const double *actions,
                  double objective) {
  double error = 0, size = 1e-300, cost = fabs((double)plan->objective - objective);
  int i, same = (int)plan->status == expected[0];
  for (i = 0; i < COUNT; ++i) {
    error = fmax(error, fabs((double)plan->actions[i] - actions[i]));
    size = fmax(size, fabs(actions[i]));
    if (!(fabs((double)plan->actions[i]) <= 1e300)) error = INFINITY;
  }
#ifdef KPIRL_MPC_FLOAT
  if (!kpirl_mpc_ok((kpirl_mpc_status)expected[0])) return 1; /* where a solve that fails stops is up to rounding */
  same = kpirl_mpc_ok(plan->status);
#endif
  printf("record %d, %s: status %d (%d), iterations %d (%d), actions differ by %.1e of %.1e, objectives by %.1e of %.1e\n",
         record, what, plan->status, expected[0], plan->iterations, expected[1], error, size, cost, fabs(objective));
  return same && (error <= TOLERANCE * size || cost < COSTS_AS_MUCH * fabs(objective));
}

int main(void) {
  kpirl_mpc *mpc = NULL;
  static kpirl_mpc_solution plan;
  int record, failures = 0;
  if (kpirl_mpc_init(&mpc, &memory, sizeof memory) != KPIRL_MPC_CONVERGED) return 1;
  for (record = 0; record < KPIRL_MPC_RECORDS; ++record) {
    kpirl_mpc_input input = {.state = kpirl_mpc_record_state[record], .context = kpirl_mpc_record_context[record]};
    kpirl_mpc_guess guess;
    if (kpirl_mpc_solve(mpc, &input, NULL, &plan) < 0) return 1;
    failures += !agrees("cold", record, &plan, kpirl_mpc_record_cold[record], kpirl_mpc_record_cold_actions[record],
                        kpirl_mpc_record_cold_objective[record][0]);
    if (!kpirl_mpc_ok(plan.status)) continue;
    guess = kpirl_mpc_resume(&plan);
    input.state = kpirl_mpc_record_next[record];
    if (kpirl_mpc_solve(mpc, &input, &guess, &plan) < 0) return 1;
    failures += !agrees("warm", record, &plan, kpirl_mpc_record_warm[record], kpirl_mpc_record_warm_actions[record],
                        kpirl_mpc_record_warm_objective[record][0]);
  }
  printf("%s\n", failures ? "FAILED" : "all agree");
  return failures != 0;
}
