/* SPDX-License-Identifier: MIT
 *
 * A libFuzzer target (clang): any bytes as state, context, psi, bounds, settings and guess. Nothing may crash, and no
 * NaN or infinity may come out with a status that is ok.
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "kpirl_mpc_controller.h"
#include "records.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static kpirl_mpc memory;

typedef struct stream {
  const uint8_t *data;
  size_t left;
} stream;

static int byte(stream *from) {
  if (!from->left) return 0;
  --from->left;
  return *from->data++;
}

/* A number near `usual`; or, when the stream says so, any bits at all. */
static kpirl_mpc_real number(stream *from, kpirl_mpc_real usual) {
  const int choice = byte(from);
  kpirl_mpc_real any = usual;
  if (choice == 255 && from->left >= sizeof any) {
    memcpy(&any, from->data, sizeof any);
    from->data += sizeof any;
    from->left -= sizeof any;
    return any;
  }
  return usual + (kpirl_mpc_real)(choice % 16) / 64;
}

static void fill(stream *from, const kpirl_mpc_real *usual, kpirl_mpc_real *values, int count) {
  int i;
  for (i = 0; i < count; ++i) values[i] = number(from, usual ? usual[i] : 0);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
  static kpirl_mpc_solution plan, next;
  static kpirl_mpc_gradients gradients;
  static kpirl_mpc_real lower[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_ACTIONS)], upper[KPIRL_MPC_N_STATES];
  kpirl_mpc_real state[KPIRL_MPC_N_STATES], context[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_CONTEXT)];
  kpirl_mpc_real psi[KPIRL_MPC_AT_LEAST_ONE(KPIRL_MPC_N_PARAMETERS)];
  kpirl_mpc_input input = {.state = state, .context = context, .psi = psi};
  kpirl_mpc_settings settings;
  kpirl_mpc_guess guess;
  kpirl_mpc *mpc = NULL;
  stream from = {data, size};
  int i;

  if (kpirl_mpc_init(&mpc, &memory, sizeof memory) != KPIRL_MPC_CONVERGED) abort();
  fill(&from, kpirl_mpc_record_state[0], state, KPIRL_MPC_N_STATES);
  fill(&from, kpirl_mpc_record_context[0], context, KPIRL_MPC_N_CONTEXT);
  fill(&from, kpirl_mpc_exported_psi, psi, KPIRL_MPC_N_PARAMETERS);
  kpirl_mpc_get_settings(mpc, &settings);
  settings.max_iterations = byte(&from) % 32;
  if (settings.max_iterations > KPIRL_MPC_MAX_ITERATIONS) settings.max_iterations = KPIRL_MPC_MAX_ITERATIONS;
  if (byte(&from) % 4 == 3) settings.barrier = number(&from, (kpirl_mpc_real)1e-3);
  kpirl_mpc_set_settings(mpc, &settings);
  if (byte(&from) % 4 == 3) {
    fill(&from, kpirl_mpc_exported_lower + KPIRL_MPC_N_STATES, lower, KPIRL_MPC_N_ACTIONS);
    fill(&from, kpirl_mpc_exported_upper + KPIRL_MPC_N_STATES + KPIRL_MPC_N_ACTIONS, upper, KPIRL_MPC_N_STATES);
    kpirl_mpc_set_bounds(mpc, NULL, upper, lower, NULL);
  }

  if (kpirl_mpc_solve(mpc, &input, NULL, &plan) < 0) return 0;
  guess = kpirl_mpc_resume(&plan);
  next = plan;
  if (byte(&from) % 2) fill(&from, plan.actions, plan.actions, KPIRL_MPC_HORIZON * KPIRL_MPC_N_ACTIONS);
  if (kpirl_mpc_solve(mpc, &input, &guess, &next) >= 0 && kpirl_mpc_ok(next.status)) {
    for (i = 0; i < KPIRL_MPC_HORIZON * KPIRL_MPC_N_ACTIONS; ++i)
      if (!isfinite(next.actions[i])) abort();
    if (!isfinite(next.residual) || !isfinite(next.objective)) abort();
  }
  if (kpirl_mpc_gradient(mpc, &input, NULL, &next, next.states, next.actions, &gradients) == KPIRL_MPC_CONVERGED)
    for (i = 0; i < KPIRL_MPC_N_PARAMETERS; ++i)
      if (!isfinite(gradients.psi[i])) abort();
  return 0;
}
