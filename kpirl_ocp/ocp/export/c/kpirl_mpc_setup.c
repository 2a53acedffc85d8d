/* SPDX-License-Identifier: MIT
 *
 * A controller, whatever its solver: memory, bounds, settings and parameters. Nothing is written before everything has been
 * checked.
 */
#include "kpirl_mpc_controller.h"

#include <string.h>

#ifndef KPIRL_MPC_NO_HEAP
#include <stdlib.h>
#endif

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, NX = NS + NU, T = KPIRL_MPC_HORIZON };

/* Where C keeps a controller: the offset of a member behind a single byte is its alignment. */
struct alignment {
  char byte;
  kpirl_mpc controller;
};

int kpirl_mpc_ok(kpirl_mpc_status status) {
  return status == KPIRL_MPC_CONVERGED || status == KPIRL_MPC_STEPS_TAKEN || status == KPIRL_MPC_ACCEPTABLE;
}

const char *kpirl_mpc_message(kpirl_mpc_status status) {
  switch (status) {
    case KPIRL_MPC_CONVERGED: return "the KKT conditions hold to the solver's tolerance.";
    case KPIRL_MPC_STEPS_TAKEN: return "all steps were taken, short of stationarity: right for real-time iterations.";
    case KPIRL_MPC_ITERATION_LIMIT: return "the iteration limit was reached. Raise it, or pass a better guess.";
    case KPIRL_MPC_INFEASIBLE: return "no feasible point was found nearby. Relax the constraints, or pass another guess.";
    case KPIRL_MPC_STALLED: return "no further progress was possible. Rescale the problem, or pass another guess.";
    case KPIRL_MPC_DIVERGED: return "the iterates diverged. Add effort weight or bounds, or use a smaller step size.";
    case KPIRL_MPC_NOT_FINITE: return "a function returned NaN or infinity. Check dynamics and costs at the guess.";
    case KPIRL_MPC_FAILED: return "the solver could not go on. Pass another guess.";
    case KPIRL_MPC_TIME_LIMIT: return "the time limit was reached; the plan is as far as the solver got.";
    case KPIRL_MPC_NOT_SOLVED: return "the plan is not a solution, so this is not its gradient. Solve to a tighter tolerance.";
    case KPIRL_MPC_NOT_A_MINIMUM: return "the Hessian is not positive there: no minimum, and no gradient of one.";
    case KPIRL_MPC_ACCEPTABLE: return "the conditions hold as far as rounding lets them, short of the tolerance.";
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

/* ---- memory ------------------------------------------------------------------------------------------------- */

size_t kpirl_mpc_size(void) { return sizeof(kpirl_mpc); }

kpirl_mpc_status kpirl_mpc_init(kpirl_mpc **mpc, void *memory, size_t size) {
  kpirl_mpc *made = (kpirl_mpc *)memory;
  if (!mpc || !memory) return KPIRL_MPC_ERROR_NULL;
  if (size < sizeof(kpirl_mpc) || (size_t)memory % offsetof(struct alignment, controller)) return KPIRL_MPC_ERROR_MEMORY;
  memset(made, 0, sizeof *made);
  made->self = made;
  (void)kpirl_mpc_reset(made);
  if (!kpirl_mpc_begin(made)) return KPIRL_MPC_ERROR_MEMORY;
  *mpc = made;
  return KPIRL_MPC_CONVERGED;
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
  if (!kpirl_mpc_is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  mpc->settings = kpirl_mpc_exported_settings;
  memcpy(mpc->lower, kpirl_mpc_exported_lower, sizeof mpc->lower);
  memcpy(mpc->upper, kpirl_mpc_exported_upper, sizeof mpc->upper);
  memcpy(mpc->psi, kpirl_mpc_exported_psi, sizeof mpc->psi);
  return KPIRL_MPC_CONVERGED;
}

/* ---- what may change at run time ---------------------------------------------------------------------------- */

kpirl_mpc_status kpirl_mpc_get_settings(const kpirl_mpc *mpc, kpirl_mpc_settings *settings) {
  if (!mpc || !settings) return KPIRL_MPC_ERROR_NULL;
  if (!kpirl_mpc_is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  *settings = mpc->settings;
  return KPIRL_MPC_CONVERGED;
}

kpirl_mpc_status kpirl_mpc_set_settings(kpirl_mpc *mpc, const kpirl_mpc_settings *settings) {
  int valid;
  if (!mpc || !settings) return KPIRL_MPC_ERROR_NULL;
  if (!kpirl_mpc_is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  valid = settings->max_iterations >= 1 && settings->steps >= 0 && settings->tolerance > 0 &&
          isfinite(settings->tolerance) && settings->barrier >= 0 && isfinite(settings->barrier) &&
          settings->time_limit >= 0 && isfinite(settings->time_limit) && (settings->now || settings->time_limit <= 0);
  if (!valid) return KPIRL_MPC_ERROR_SETTINGS;
  if (!kpirl_mpc_knows(settings)) return KPIRL_MPC_ERROR_UNSUPPORTED;
  mpc->settings = *settings;
  return KPIRL_MPC_CONVERGED;
}

/* May a lower and an upper bound take the place of those that were exported? */
static int fit(real lower, real upper, real was_lower, real was_upper) {
  if (!(lower <= upper) || lower == (real)INFINITY || upper == -(real)INFINITY) return 0;
  return !isfinite(lower) == !isfinite(was_lower) && !isfinite(upper) == !isfinite(was_upper) &&
         (lower == upper) == (was_lower == was_upper);
}

/* New bounds: `states` holds those of s_0 when there are T+1 rows, and of s_1 alone when `rows` is 1. */
typedef struct new_bounds {
  const real *states, *actions; /* NULL: as they are */
  int rows;                     /* 1: the same for every stage */
} new_bounds;

static real new_bound(const new_bounds *bounds, int t, int entry, real current) {
  const int by_stage = bounds->rows > 1;
  if (entry < NS) {
    if (!bounds->states || (!by_stage && t == 0)) return current;
    return bounds->states[by_stage ? t * NS + entry : entry];
  }
  return bounds->actions ? bounds->actions[by_stage ? t * NU + entry - NS : entry - NS] : current;
}

/* Check all bounds, or write them. */
static int go_through(kpirl_mpc *mpc, const new_bounds *lower, const new_bounds *upper, int write) {
  int i;
  for (i = 0; i < KPIRL_MPC_N_POINT; ++i) {
    const real low = new_bound(lower, i / NX, i % NX, mpc->lower[i]), high = new_bound(upper, i / NX, i % NX, mpc->upper[i]);
    if (kpirl_mpc_is_given(i)) continue;
    if (write) {
      mpc->lower[i] = low;
      mpc->upper[i] = high;
    } else if (!fit(low, high, kpirl_mpc_exported_lower[i], kpirl_mpc_exported_upper[i])) {
      return 0;
    }
  }
  return 1;
}

static kpirl_mpc_status set_bounds(kpirl_mpc *mpc, const new_bounds *lower, const new_bounds *upper) {
  if (!mpc) return KPIRL_MPC_ERROR_NULL;
  if (!kpirl_mpc_is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  if (!go_through(mpc, lower, upper, 0)) return KPIRL_MPC_ERROR_BOUNDS;
  (void)go_through(mpc, lower, upper, 1);
  return KPIRL_MPC_CONVERGED;
}

kpirl_mpc_status kpirl_mpc_set_bounds(kpirl_mpc *mpc, const real *state_lower, const real *state_upper,
                                      const real *action_lower, const real *action_upper) {
  const new_bounds lower = {state_lower, action_lower, 1}, upper = {state_upper, action_upper, 1};
  return set_bounds(mpc, &lower, &upper);
}

kpirl_mpc_status kpirl_mpc_set_stage_bounds(kpirl_mpc *mpc, const real *state_lower, const real *state_upper,
                                            const real *action_lower, const real *action_upper) {
  const new_bounds lower = {state_lower, action_lower, T + 1}, upper = {state_upper, action_upper, T + 1};
  return set_bounds(mpc, &lower, &upper);
}

kpirl_mpc_status kpirl_mpc_set_parameters(kpirl_mpc *mpc, const real *psi) {
  if (!mpc || (KPIRL_MPC_N_PARAMETERS > 0 && !psi)) return KPIRL_MPC_ERROR_NULL;
  if (!kpirl_mpc_is_controller(mpc)) return KPIRL_MPC_ERROR_CONTROLLER;
  if (!kpirl_mpc_all_finite(psi, KPIRL_MPC_N_PARAMETERS)) return KPIRL_MPC_ERROR_INPUT;
  if (KPIRL_MPC_N_PARAMETERS > 0) memcpy(mpc->psi, psi, KPIRL_MPC_N_PARAMETERS * sizeof(real));
  return KPIRL_MPC_CONVERGED;
}
