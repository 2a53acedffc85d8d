/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_controller.h"

#include <string.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, NX = NS + NU, T = KPIRL_MPC_HORIZON };

int kpirl_mpc_is_controller(const kpirl_mpc *mpc) { return mpc->self == (const void *)mpc; }

int kpirl_mpc_is_given(int entry) {
  int k;
  for (k = 0; k < KPIRL_MPC_N_FREE; ++k)
    if (kpirl_mpc_exported_free[k] == entry) return 0;
  return entry < NS;
}

real kpirl_mpc_relative_residual(real stationarity, real feasibility, real complementarity, real scale) {
  real residuals[3];
  residuals[0] = stationarity / scale;
  residuals[1] = complementarity / scale;
  residuals[2] = feasibility;
  return kpirl_mpc_norm_inf(residuals, 3);
}

void kpirl_mpc_set_residuals(kpirl_mpc_solution *solution, real stationarity, real feasibility, real complementarity,
                             real scale) {
  solution->stationarity = stationarity;
  solution->feasibility = feasibility;
  solution->complementarity = complementarity;
  solution->scale = scale;
  solution->residual = kpirl_mpc_relative_residual(stationarity, feasibility, complementarity, scale);
}

int kpirl_mpc_out_of_time(const kpirl_mpc *mpc) {
  const kpirl_mpc_settings *settings = &mpc->settings;
  return settings->now && settings->time_limit > 0 && !(settings->now(settings->clock) - mpc->started < settings->time_limit);
}

void kpirl_mpc_step_model(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, int t, const real *x, real *next) {
  kpirl_mpc_stage_arguments at = {0};
  kpirl_mpc_stage_results to = {0};
  at.x = x;
  at.psi = numbers->psi;
  at.context = numbers->context;
  at.schedule = numbers->schedule + t * KPIRL_MPC_N_SCHEDULE;
  to.successor = next;
  (void)KPIRL_MPC_TRANSITION(&mpc->scratch, &at, &to);
}

void kpirl_mpc_interleave(const real *states, const real *actions, real *x) {
  int t;
  for (t = 0; t <= T; ++t) {
    memcpy(x + t * NX, states + t * NS, NS * sizeof(real));
    if (NU > 0 && t < T) memcpy(x + t * NX + NS, actions + t * NU, NU * sizeof(real));
  }
}

void kpirl_mpc_separate(const real *x, real *states, real *actions) {
  int t;
  for (t = 0; t <= T; ++t) {
    memcpy(states + t * NS, x + t * NX, NS * sizeof(real));
    if (NU > 0 && t < T) memcpy(actions + t * NU, x + t * NX + NS, NU * sizeof(real));
  }
}
