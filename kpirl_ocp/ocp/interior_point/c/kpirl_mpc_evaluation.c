/* SPDX-License-Identifier: MIT
 *
 * Evaluation of the model at a trajectory, stage by stage or all stages in one call.
 */
#include "kpirl_mpc_core.h"

#include <string.h>

static void call(kpirl_mpc_core *core, const kpirl_mpc_function *function, const real *const *arguments,
                 real *const *results) {
  if (function->evaluate(function->self, arguments, results)) core->failed = 1;
}

/* Where a result goes: straight into the dense array, or into nonzeros that are scattered afterwards. */
static real *destination(const kpirl_mpc_pattern *pattern, real *dense, real **nonzeros) {
  real *place = *nonzeros;
  if (!pattern->entries) return dense;
  *nonzeros += pattern->count;
  return place;
}

static void scatter(const kpirl_mpc_pattern *pattern, const real *from, real *dense) {
  int i;
  if (!pattern->entries) return;
  for (i = 0; i < pattern->count; ++i) dense[pattern->entries[i]] = from[i];
}

static void call_stage(kpirl_mpc_core *core, int level, int t, const real *x, const real *costates, const real *z,
                       const real *nu, real *value, real *successor, real *path, real *equality) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions), n_h = DIM(core, n_path), n_e = DIM(core, n_equality);
  const kpirl_mpc_model *model = &core->model;
  kpirl_mpc_derivatives *d = &core->d;
  real *nonzeros = core->nonzeros;
  real *F = d->F + t * n_s * n_x, *G = d->G + t * n_x * n_h, *E = d->E + t * n_x * n_e, *H = d->H + t * n_x * n_x;
  const real *arguments[7];
  real *results[10];
  arguments[0] = x + t * n_x;
  arguments[1] = core->numbers.psi;
  arguments[2] = core->numbers.context;
  arguments[3] = core->numbers.schedule + t * DIM(core, n_schedule);
  results[0] = value;
  results[1] = successor;
  results[2] = path + t * n_h;
  results[3] = equality + t * n_e;
  if (level > KPIRL_MPC_VALUES) {
    arguments[4] = costates + t * n_s;
    arguments[5] = z + t * n_h;
    arguments[6] = nu + t * n_e;
    results[4] = d->cost_gradient + t * n_x;
    results[5] = d->gradient + t * n_x;
  }
  if (level == KPIRL_MPC_SECOND) {
    results[6] = destination(&model->F, F, &nonzeros);
    results[7] = destination(&model->G, G, &nonzeros);
    results[8] = destination(&model->E, E, &nonzeros);
    results[9] = destination(&model->H, H, &nonzeros);
  }
  call(core, &model->stage[level], arguments, results);
  if (level == KPIRL_MPC_SECOND) {
    scatter(&model->F, results[6], F);
    scatter(&model->G, results[7], G);
    scatter(&model->E, results[8], E);
    scatter(&model->H, results[9], H);
  }
}

static void call_last(kpirl_mpc_core *core, int level, const real *x, const real *z, const real *nu, real *value, real *path,
                      real *equality) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const int n_h = DIM(core, n_path), n_e = DIM(core, n_equality);
  const kpirl_mpc_model *model = &core->model;
  kpirl_mpc_derivatives *d = &core->d;
  real *nonzeros = core->nonzeros, *G = d->G + T * n_x * n_h, *E = d->E + T * n_x * n_e, *H = d->H + T * n_x * n_x;
  const real *arguments[6];
  real *results[8];
  arguments[0] = x + T * n_x;
  arguments[1] = core->numbers.psi;
  arguments[2] = core->numbers.context;
  arguments[3] = core->numbers.schedule + T * DIM(core, n_schedule);
  results[0] = value;
  results[1] = path + T * n_h;
  results[2] = equality + T * n_e;
  if (level > KPIRL_MPC_VALUES) {
    arguments[4] = z + T * n_h;
    arguments[5] = nu + T * n_e;
    results[3] = d->cost_gradient + T * n_x;
    results[4] = d->gradient + T * n_x;
  }
  if (level == KPIRL_MPC_SECOND) {
    results[5] = destination(&model->G_last, G, &nonzeros);
    results[6] = destination(&model->E_last, E, &nonzeros);
    results[7] = destination(&model->H_last, H, &nonzeros);
  }
  call(core, &model->last[level], arguments, results);
  if (level == KPIRL_MPC_SECOND) {
    scatter(&model->G_last, results[5], G);
    scatter(&model->E_last, results[6], E);
    scatter(&model->H_last, results[7], H);
  }
}

/* x as states and actions, as functions of the whole horizon take them. */
static void gather(kpirl_mpc_core *core, const real *x) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_u = DIM(core, n_actions), n_x = n_s + n_u;
  int t;
  for (t = 0; t < T; ++t) {
    memcpy(core->states + t * n_s, x + t * n_x, (size_t)n_s * sizeof(real));
    memcpy(core->actions + t * n_u, x + t * n_x + n_s, (size_t)n_u * sizeof(real));
  }
  memcpy(core->states + T * n_s, x + T * n_x, (size_t)n_s * sizeof(real));
}

static void call_horizon(kpirl_mpc_core *core, int level, const real *x, real *value, real *successors, real *path,
                         real *equality) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const int n_h = DIM(core, n_path), n_e = DIM(core, n_equality);
  kpirl_mpc_derivatives *d = &core->d;
  const real *z = core->at.z + core->n_lower + core->n_upper, *nu = core->at.nu + core->n_fixed;
  const real *arguments[9];
  real *results[17];
  gather(core, x);
  arguments[0] = core->states;
  arguments[1] = core->actions;
  arguments[2] = core->numbers.psi;
  arguments[3] = core->numbers.context;
  arguments[4] = core->at.costates;
  arguments[5] = z;
  arguments[6] = nu;
  arguments[7] = z + T * n_h;
  arguments[8] = nu + T * n_e;
  results[0] = value;
  results[1] = successors;
  results[2] = path;
  results[3] = equality;
  results[4] = path + T * n_h;
  results[5] = equality + T * n_e;
  results[6] = d->cost_gradient;
  results[7] = d->cost_gradient + T * n_x;
  results[8] = d->gradient;
  results[9] = d->gradient + T * n_x;
  results[10] = d->F;
  results[11] = d->G;
  results[12] = d->E;
  results[13] = d->H;
  results[14] = d->G + T * n_x * n_h;
  results[15] = d->E + T * n_x * n_e;
  results[16] = d->H + T * n_x * n_x;
  call(core, &core->model.horizon[level], arguments, results);
}

/* successors - s_next, in the place of the successors. */
static void subtract_states(const kpirl_mpc_core *core, const real *x, real *successors) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int t, i;
  for (t = 0; t < T; ++t)
    for (i = 0; i < n_s; ++i) successors[t * n_s + i] -= x[(t + 1) * n_x + i];
}

void kpirl_mpc_evaluate_values(kpirl_mpc_core *core, const real *x, real *objective, real *defects, real *path,
                               real *equality) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states);
  if (core->model.by_stage) {
    real value = 0;
    int t;
    *objective = 0;
    for (t = 0; t < T; ++t) {
      call_stage(core, KPIRL_MPC_VALUES, t, x, NULL, NULL, NULL, &value, defects + t * n_s, path, equality);
      *objective += value;
    }
    call_last(core, KPIRL_MPC_VALUES, x, NULL, NULL, &value, path, equality);
    *objective += value;
  } else {
    call_horizon(core, KPIRL_MPC_VALUES, x, objective, defects, path, equality);
  }
  subtract_states(core, x, defects);
}

/* r is the gradient of what is local to a stage; s_t is also where stage t-1 arrives. */
static void subtract_costates(const kpirl_mpc_core *core, real *gradient) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int t, i;
  for (t = 1; t <= T; ++t)
    for (i = 0; i < n_s; ++i) gradient[t * n_x + i] -= core->at.costates[(t - 1) * n_s + i];
}

void kpirl_mpc_evaluate(kpirl_mpc_core *core, int level) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states);
  const kpirl_mpc_iterate *at = &core->at;
  kpirl_mpc_derivatives *d = &core->d;
  if (core->model.by_stage) {
    const real *z = at->z + core->n_lower + core->n_upper, *nu = at->nu + core->n_fixed;
    real value = 0;
    int t;
    d->objective = 0;
    for (t = 0; t < T; ++t) {
      call_stage(core, level, t, at->x, at->costates, z, nu, &value, d->defects + t * n_s, d->path, d->equality);
      d->objective += value;
    }
    call_last(core, level, at->x, z, nu, &value, d->path, d->equality);
    d->objective += value;
  } else {
    call_horizon(core, level, at->x, &d->objective, d->defects, d->path, d->equality);
  }
  subtract_states(core, at->x, d->defects);
  subtract_costates(core, d->gradient);
}

static void step_dynamics(kpirl_mpc_core *core, int t, const real *x, real *successor) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const real *arguments[4];
  real *results[4] = {NULL, NULL, NULL, NULL};
  arguments[0] = x + t * n_x;
  arguments[1] = core->numbers.psi;
  arguments[2] = core->numbers.context;
  arguments[3] = core->numbers.schedule + t * DIM(core, n_schedule);
  if (core->model.by_stage) {
    results[1] = successor;
    call(core, &core->model.stage[KPIRL_MPC_VALUES], arguments, results);
  } else {
    results[0] = successor;
    call(core, &core->model.dynamics, arguments, results);
  }
}

void kpirl_mpc_roll_out(kpirl_mpc_core *core, real *x) {
  const int n_x = DIM(core, n_states) + DIM(core, n_actions);
  int t;
  for (t = 0; t < DIM(core, horizon); ++t) step_dynamics(core, t, x, x + (t + 1) * n_x);
}

/* u' = u + a du + K (s' - s - a ds),  s'_next = f(s', u') - (1 - a) d  from core->at along core->step, into core->trial:
 * defects shrink by exactly 1 - a, and once they are zero every iterate is a rollout. */
void kpirl_mpc_follow(kpirl_mpc_core *core, real length, real *objective, real *path, real *equality) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_u = DIM(core, n_actions), n_x = n_s + n_u;
  const kpirl_mpc_factors *factors = &core->factors;
  const real *x = core->at.x, *dx = core->step.change.x;
  real *to = core->trial.x, *off = core->start, value = 0;
  int t, i;
  *objective = 0;
  for (i = 0; i < n_s; ++i) to[i] = x[i] + length * dx[i];
  for (t = 0; t < T; ++t) {
    real *here = to + t * n_x, *next = here + n_x;
    const int offset = t * n_x;
    for (i = 0; i < n_s; ++i) off[i] = here[i] - x[offset + i] - length * dx[offset + i];
    for (i = n_s; i < n_x; ++i) here[i] = x[offset + i] + length * dx[offset + i];
    if (n_u > 0 && t > 0) {
      kpirl_mpc_gain(n_s, n_u, factors->W + t * n_u * n_u, factors->Y + t * n_u * n_s, factors->pivots + t * n_u,
                     core->K + n_u * n_s, core->K);
      kpirl_mpc_times_vector(core->K, n_u, n_s, off, here + n_s);
    }
    if (core->model.by_stage) {
      call_stage(core, KPIRL_MPC_VALUES, t, to, NULL, NULL, NULL, &value, next, path, equality);
      *objective += value;
    } else {
      step_dynamics(core, t, to, next);
    }
    for (i = 0; i < n_s; ++i) next[i] -= (1 - length) * core->d.defects[t * n_s + i];
  }
  if (core->model.by_stage) {
    call_last(core, KPIRL_MPC_VALUES, to, NULL, NULL, &value, path, equality);
    *objective += value;
  } else {
    call_horizon(core, KPIRL_MPC_VALUES, to, objective, core->trial.costates, path, equality);
  }
}
