/* SPDX-License-Identifier: MIT
 *
 * Evaluation of the model at a trajectory, stage by stage or all stages in one call.
 */
#include "kpirl_mpc_core.h"

#include <string.h>

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

/* Stage t, or the end for t = T. The second derivatives go into core->d. */
static void call_stage(kpirl_mpc_core *core, int level, int t, const kpirl_mpc_stage_arguments *at,
                       const kpirl_mpc_stage_results *first) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions), n_h = DIM(core, n_path), n_e = DIM(core, n_equality);
  const kpirl_mpc_model *model = &core->model;
  const int last = t == DIM(core, horizon);
  const kpirl_mpc_stage_function *function = last ? &model->last[level] : &model->stage[level];
  const kpirl_mpc_pattern *of_G = last ? &model->G_last : &model->G, *of_E = last ? &model->E_last : &model->E;
  const kpirl_mpc_pattern *of_H = last ? &model->H_last : &model->H;
  kpirl_mpc_derivatives *d = &core->d;
  real *F = d->F + t * n_s * n_x, *G = d->G + t * n_x * n_h, *E = d->E + t * n_x * n_e, *H = d->H + t * n_x * n_x;
  real *nonzeros = core->nonzeros;
  kpirl_mpc_stage_results to = *first;
  if (level == KPIRL_MPC_SECOND) {
    if (!last) to.F = destination(&model->F, F, &nonzeros);
    to.G = destination(of_G, G, &nonzeros);
    to.E = destination(of_E, E, &nonzeros);
    to.H = destination(of_H, H, &nonzeros);
  }
  if (function->evaluate(function->self, at, &to)) core->failed = 1;
  if (level == KPIRL_MPC_SECOND) {
    if (!last) scatter(&model->F, to.F, F);
    scatter(of_G, to.G, G);
    scatter(of_E, to.E, E);
    scatter(of_H, to.H, H);
  }
}

/* The arguments that belong to x at stage t, or at the end. */
static void set_arguments(const kpirl_mpc_core *core, int t, const real *x, kpirl_mpc_stage_arguments *at) {
  memset(at, 0, sizeof *at);
  at->x = x + t * (DIM(core, n_states) + DIM(core, n_actions));
  at->psi = core->numbers.psi;
  at->context = core->numbers.context;
  at->schedule = core->numbers.schedule + t * DIM(core, n_schedule);
}

/* Values of stage t, or of the end, into arrays of all stages; the cost is added to `objective`. */
static void stage_values(kpirl_mpc_core *core, int t, const real *x, real *objective, real *successor, real *path,
                         real *equality) {
  kpirl_mpc_stage_arguments at;
  kpirl_mpc_stage_results to = {0};
  real cost = 0;
  set_arguments(core, t, x, &at);
  to.cost = &cost;
  to.successor = successor;
  to.path = path + t * DIM(core, n_path);
  to.equality = equality + t * DIM(core, n_equality);
  call_stage(core, KPIRL_MPC_VALUES, t, &at, &to);
  *objective += cost;
}

/* Everything about stage t, or the end, of core->at, into core->d. */
static void differentiate_stage(kpirl_mpc_core *core, int level, int t) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions), last = t == DIM(core, horizon);
  kpirl_mpc_derivatives *d = &core->d;
  kpirl_mpc_stage_arguments at;
  kpirl_mpc_stage_results to = {0};
  real cost = 0;
  set_arguments(core, t, core->at.x, &at);
  at.costates = core->at.costates + t * n_s;
  at.z = core->at.z + kpirl_mpc_n_bounds(core) + t * DIM(core, n_path);
  at.nu = core->at.nu + core->n_fixed + t * DIM(core, n_equality);
  to.cost = &cost;
  to.successor = last ? NULL : d->defects + t * n_s;
  to.path = d->path + t * DIM(core, n_path);
  to.equality = d->equality + t * DIM(core, n_equality);
  to.cost_gradient = d->cost_gradient + t * n_x;
  to.gradient = d->gradient + t * n_x;
  call_stage(core, level, t, &at, &to);
  d->objective += cost;
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

static void call_horizon(kpirl_mpc_core *core, int level, const real *x, real *cost, real *successor, real *path,
                         real *equality) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  const int n_h = DIM(core, n_path), n_e = DIM(core, n_equality);
  const kpirl_mpc_horizon_function *function = &core->model.horizon[level];
  kpirl_mpc_derivatives *d = &core->d;
  kpirl_mpc_horizon_arguments at;
  kpirl_mpc_horizon_results to;
  gather(core, x);
  at.states = core->states;
  at.actions = core->actions;
  at.psi = core->numbers.psi;
  at.context = core->numbers.context;
  at.costates = core->at.costates;
  at.z = core->at.z + kpirl_mpc_n_bounds(core);
  at.nu = core->at.nu + core->n_fixed;
  at.z_last = at.z + T * n_h;
  at.nu_last = at.nu + T * n_e;
  to.cost = cost;
  to.successor = successor;
  to.path = path;
  to.equality = equality;
  to.path_last = path + T * n_h;
  to.equality_last = equality + T * n_e;
  to.cost_gradient = d->cost_gradient;
  to.cost_gradient_last = d->cost_gradient + T * n_x;
  to.gradient = d->gradient;
  to.gradient_last = d->gradient + T * n_x;
  to.F = d->F;
  to.G = d->G;
  to.E = d->E;
  to.H = d->H;
  to.G_last = d->G + T * n_x * n_h;
  to.E_last = d->E + T * n_x * n_e;
  to.H_last = d->H + T * n_x * n_x;
  if (function->evaluate(function->self, &at, &to)) core->failed = 1;
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
  int t;
  *objective = 0;
  if (core->model.by_stage)
    for (t = 0; t <= T; ++t) stage_values(core, t, x, objective, t < T ? defects + t * n_s : NULL, path, equality);
  else
    call_horizon(core, KPIRL_MPC_VALUES, x, objective, defects, path, equality);
  subtract_states(core, x, defects);
}

/* Stages give the gradients of their own terms; of costates . (f - s_next), s_t is the successor of stage t-1, too. */
static void subtract_costates(const kpirl_mpc_core *core, real *gradient) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int t, i;
  for (t = 1; t <= T; ++t)
    for (i = 0; i < n_s; ++i) gradient[t * n_x + i] -= core->at.costates[(t - 1) * n_s + i];
}

void kpirl_mpc_set_numbers(kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers) {
  core->numbers = *numbers;
  core->settled = core->failed = 0;
}

/* Matrices of a quadratic program are evaluated once for its numbers. */
void kpirl_mpc_evaluate(kpirl_mpc_core *core, int level) {
  const int T = DIM(core, horizon), matrices = level == KPIRL_MPC_SECOND && !core->settled;
  kpirl_mpc_derivatives *d = &core->d;
  int t;
  d->objective = 0;
  if (level == KPIRL_MPC_SECOND && !matrices) level = KPIRL_MPC_FIRST;
  if (core->model.by_stage)
    for (t = 0; t <= T; ++t) differentiate_stage(core, level, t);
  else
    call_horizon(core, level, core->at.x, &d->objective, d->defects, d->path, d->equality);
  subtract_states(core, core->at.x, d->defects);
  subtract_costates(core, d->gradient);
  if (matrices) core->settled = core->model.quadratic;
}

void kpirl_mpc_evaluate_stage_0(kpirl_mpc_core *core, int level) {
  const int n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  int i;
  differentiate_stage(core, level, 0);
  for (i = 0; i < n_s; ++i) core->d.defects[i] -= core->at.x[n_x + i];
}

static void step_dynamics(kpirl_mpc_core *core, int t, const real *x, real *successor) {
  const kpirl_mpc_model *model = &core->model;
  const kpirl_mpc_stage_function *function = model->by_stage ? &model->stage[KPIRL_MPC_VALUES] : &model->dynamics;
  kpirl_mpc_stage_arguments at;
  kpirl_mpc_stage_results to = {0};
  set_arguments(core, t, x, &at);
  to.successor = successor;
  if (function->evaluate(function->self, &at, &to)) core->failed = 1;
}

void kpirl_mpc_roll_out(kpirl_mpc_core *core, real *x) {
  const int n_x = DIM(core, n_states) + DIM(core, n_actions);
  int t;
  for (t = 0; t < DIM(core, horizon); ++t) step_dynamics(core, t, x, x + (t + 1) * n_x);
}

/* u' = u + a du + K (s' - s - a ds),  s'_next = f(s', u') - (1 - a) d  from core->at along core->step, into core->trial:
 * defects shrink by exactly 1 - a, and once they are zero every iterate is a rollout. */
void kpirl_mpc_feedback_rollout(kpirl_mpc_core *core, real length, real *objective, real *path, real *equality) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_u = DIM(core, n_actions), n_x = n_s + n_u;
  const real *x = core->at.x, *dx = core->step.change.x;
  real *to = core->trial.x, *off = core->start;
  int t, i;
  *objective = 0;
  for (i = 0; i < n_s; ++i) to[i] = x[i] + length * dx[i];
  for (t = 0; t < T; ++t) {
    real *here = to + t * n_x, *next = here + n_x;
    const int offset = t * n_x;
    for (i = 0; i < n_s; ++i) off[i] = here[i] - x[offset + i] - length * dx[offset + i];
    for (i = n_s; i < n_x; ++i) here[i] = x[offset + i] + length * dx[offset + i];
    if (n_u > 0 && t > 0) kpirl_mpc_feedback(n_s, n_u, &core->factors, t, off, core->scratch, here + n_s);
    if (core->model.by_stage)
      stage_values(core, t, to, objective, next, path, equality);
    else
      step_dynamics(core, t, to, next);
    for (i = 0; i < n_s; ++i) next[i] -= (1 - length) * core->d.defects[t * n_s + i];
  }
  if (core->model.by_stage)
    stage_values(core, T, to, objective, NULL, path, equality);
  else
    call_horizon(core, KPIRL_MPC_VALUES, to, objective, core->trial.costates, path, equality);
}
