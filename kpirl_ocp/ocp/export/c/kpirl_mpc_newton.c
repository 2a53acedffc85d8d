/* SPDX-License-Identifier: MIT
 *
 * Newton steps of the primal-dual interior-point method. With g(w) + y = 0, y z = tau and the Lagrangian
 *
 *     J + lambda . (f(s, u) - s_next) + z . g + nu . w_fixed,
 *
 * the step on these conditions is condensed onto the stages and found by one Riccati recursion, in the generated function
 * newton_step. A step follows the dynamics (follow): u' = u + alpha du + K (s' - s - alpha ds), s'_next = f(s', u') - (1 - alpha) d.
 */
#include "kpirl_mpc_newton.h"
#include "kpirl_mpc_rows.h"

#include <string.h>
#include <tgmath.h>

enum { NS = KPIRL_MPC_N_STATES, NU = KPIRL_MPC_N_ACTIONS, NX = KPIRL_MPC_N_X, NH = KPIRL_MPC_N_PATH };
enum { T = KPIRL_MPC_HORIZON, NW = KPIRL_MPC_N_POINT - NS, STATES = (T + 1) * NS };
enum { FIXED = KPIRL_MPC_N_FIXED };
enum { BOUNDS = KPIRL_MPC_N_BOUNDS, FORCES = KPIRL_MPC_N_FORCES, ROWS = KPIRL_MPC_N_ROWS };

typedef kpirl_mpc_real real;

static const real REMAINDER = (real)0.1;  /* a step along the dynamics may end this much closer to the boundary */
static const real BOUNDARY = (real)0.99;  /* share of the way to the boundary that a step of slacks may go; of multipliers, the
                                           * smallest share */
static const real CENTRE = (real)1e10;    /* slack * multiplier stays within this factor of tau */

static real larger(real a, real b) { return a > b ? a : b; }
static real smaller(real a, real b) { return a < b ? a : b; }

/* ---- what is known at an iterate ---------------------------------------------------------------------------- */

/* Columns x_t (n_x, T) and s_T as a point s_0 .. s_T, u_0 .. . */
static void by_time(const real *columns, const real *last, real *point) {
  int t;
  for (t = 0; t < T; ++t) {
    memcpy(point + t * NS, columns + t * NX, NS * sizeof(real));
    memcpy(point + STATES + t * NU, columns + t * NX + NS, NU * sizeof(real));
  }
  memcpy(point + T * NS, last, NS * sizeof(real));
}

static real absolute_sum(const real *values, int count) {
  real sum = 0;
  int i;
  for (i = 0; i < count; ++i) sum += fabs(values[i]);
  return sum;
}

/* What the constraints at a point are off: gap, off and rows. */
static void evaluate_constraints(kpirl_mpc_workspace *work, const kpirl_mpc_numbers *numbers, const real *point,
                                 real *gap, real *off, real *rows) {
  int i;
  for (i = 0; i < NS; ++i) gap[i] = numbers->state[i] - point[i];
  for (i = 0; i < FIXED; ++i) off[i] = point[NS + work->fixed[i]] - work->values[i];
  kpirl_mpc_evaluate_rows(work, point + NS, work->path, rows);
}

/* The largest of the gradient of the objective, the costates, the path multipliers, and 1. */
static real scale_of(const kpirl_mpc_derivatives *d, const kpirl_mpc_iterate *at) {
  real sizes[4];
  sizes[0] = 1;
  sizes[1] = kpirl_mpc_largest(d->cost_gradient + NS, NW);
  sizes[2] = kpirl_mpc_largest(at->costates, T * NS);
  sizes[3] = kpirl_mpc_largest(at->z + BOUNDS, FORCES);
  return kpirl_mpc_largest(sizes, 4);
}

void kpirl_mpc_differentiate(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, int matrices) {
  kpirl_mpc_workspace *work = &mpc->work;
  const kpirl_mpc_iterate *at = &work->iterate;
  kpirl_mpc_derivatives *d = &work->at;
  const real *arguments[6];
  real *results[11];
  int i;
  arguments[0] = at->point;
  arguments[1] = at->point + STATES;
  arguments[2] = numbers->psi;
  arguments[3] = numbers->context;
  arguments[4] = at->costates;
  arguments[5] = at->z + BOUNDS;
  results[0] = &d->objective;
  results[1] = d->defects;
  results[2] = work->path;
  results[3] = work->columns;
  results[4] = work->last;
  results[5] = d->r;
  results[6] = d->r_last;
  results[7] = d->F;
  results[8] = d->G;
  results[9] = d->H;
  results[10] = d->H_last;
  if (matrices)
    kpirl_mpc_call(mpc, kpirl_mpc_stage_second, 6, arguments, 11, results);
  else
    kpirl_mpc_call(mpc, kpirl_mpc_stage_first, 6, arguments, 7, results);
  work->matrices = matrices;
  by_time(work->columns, work->last, d->cost_gradient);
  by_time(d->r, d->r_last, d->gradient);
  kpirl_mpc_push(work, at, d->gradient + NS);
  evaluate_constraints(work, numbers, at->point, d->gap, d->off, d->rows);
  d->scale = scale_of(d, at);
  d->violation = absolute_sum(d->defects, T * NS) + absolute_sum(d->gap, NS) + absolute_sum(d->off, FIXED);
  for (i = 0; i < ROWS; ++i) d->violation += fabs(d->rows[i] + at->y[i]);
}

int kpirl_mpc_known(const kpirl_mpc *mpc, const real **arguments, const real **results) {
  const kpirl_mpc_iterate *at = &mpc->work.iterate;
  const kpirl_mpc_derivatives *d = &mpc->work.at;
  arguments[0] = at->point;
  arguments[1] = at->point + STATES;
  arguments[2] = at->costates;
  arguments[3] = at->z + BOUNDS;
  results[0] = d->defects;
  results[1] = mpc->work.path;
  results[2] = d->r;
  results[3] = d->r_last;
  results[4] = d->F;
  results[5] = d->G;
  results[6] = d->H;
  results[7] = d->H_last;
  return mpc->work.matrices;
}

int kpirl_mpc_finite(const kpirl_mpc *mpc) {
  const kpirl_mpc_derivatives *d = &mpc->work.at;
  return isfinite(d->objective) && kpirl_mpc_all_finite(d->cost_gradient, NS + NW) &&
         kpirl_mpc_all_finite(d->gradient + NS, NW) && kpirl_mpc_all_finite(d->defects, T * NS) &&
         kpirl_mpc_all_finite(d->rows, ROWS);
}

int kpirl_mpc_matrices_finite(const kpirl_mpc *mpc) {
  const kpirl_mpc_derivatives *d = &mpc->work.at;
  return kpirl_mpc_all_finite(d->F, NS * NX * T) && kpirl_mpc_all_finite(d->G, NH * NX * T) &&
         kpirl_mpc_all_finite(d->H, NX * NX * T) && kpirl_mpc_all_finite(d->H_last, NS * NS);
}

void kpirl_mpc_residuals(const kpirl_mpc *mpc, real tau, kpirl_mpc_solution *solution) {
  const kpirl_mpc_derivatives *d = &mpc->work.at;
  const real *z = mpc->work.iterate.z;
  real parts[4] = {0, 0, 0, 0}, complementarity = 0;
  int i;
  parts[0] = kpirl_mpc_largest(d->defects, T * NS);
  parts[1] = kpirl_mpc_largest(d->gap, NS);
  parts[2] = kpirl_mpc_largest(d->off, FIXED);
  for (i = 0; i < ROWS; ++i) {
    real pair[2];
    pair[0] = complementarity;
    pair[1] = -d->rows[i] * z[i] - tau;
    complementarity = kpirl_mpc_largest(pair, 2);
    if (!(d->rows[i] <= parts[3]) && !isnan(parts[3])) parts[3] = d->rows[i];
  }
  kpirl_mpc_set_residuals(solution, kpirl_mpc_largest(d->gradient + NS, NW), kpirl_mpc_largest(parts, 4), complementarity,
                          d->scale);
}

/* ---- steps -------------------------------------------------------------------------------------------------- */

/* The longest step in (0, 1] that keeps value + length * change at least (1 - share) value; value > 0. */
static real longest(const real *value, const real *change, int count, real share) {
  real most = share;
  int i;
  for (i = 0; i < count; ++i) most = larger(-change[i] / value[i], most);
  return smaller(1, share / most);
}

/* The inputs and outputs that newton_step and corrected_step have in common. */
static void hand_over(kpirl_mpc_workspace *work, const real **arguments, real **results) {
  const kpirl_mpc_iterate *at = &work->iterate;
  const kpirl_mpc_derivatives *d = &work->at;
  kpirl_mpc_step *step = &work->step;
  kpirl_mpc_iterate *change = &step->change;
  arguments[0] = d->r;
  arguments[1] = d->r_last;
  arguments[2] = d->defects;
  arguments[3] = d->F;
  arguments[4] = d->G;
  arguments[5] = d->H;
  arguments[6] = d->H_last;
  arguments[7] = d->rows;
  arguments[8] = d->off;
  arguments[9] = d->gap;
  arguments[10] = at->y;
  arguments[11] = at->z;
  arguments[12] = at->nu;
  results[0] = change->point;
  results[1] = change->point + STATES;
  results[2] = change->costates;
  results[3] = change->y;
  results[4] = change->z;
  results[5] = change->nu;
  results[6] = step->pivots;
  results[7] = step->gains;
}

/* How far it may go, and whether it leads to a minimum. */
static void judge(kpirl_mpc_workspace *work, real regularisation) {
  const kpirl_mpc_iterate *at = &work->iterate, *change = &work->step.change;
  kpirl_mpc_step *step = &work->step;
  int i;
  step->primal_length = longest(at->y, change->y, ROWS, BOUNDARY);
  step->dual_length = longest(at->z, change->z, ROWS, larger(BOUNDARY, 1 - step->tau));
  step->regularisation = regularisation;
  step->positive = kpirl_mpc_all_finite(change->point + STATES, T * NU);
  for (i = 0; i < T * NU; ++i) step->positive = step->positive && step->pivots[i] > 0 && isfinite(step->pivots[i]);
}

void kpirl_mpc_find_step(kpirl_mpc *mpc, real regularisation) {
  const real *arguments[15];
  real *results[8];
  mpc->work.step.tau = mpc->work.tau;
  hand_over(&mpc->work, arguments, results);
  arguments[13] = &mpc->work.tau;
  arguments[14] = &regularisation;
  kpirl_mpc_call(mpc, kpirl_mpc_newton_step, 15, arguments, 8, results);
  judge(&mpc->work, regularisation);
}

void kpirl_mpc_find_corrected_step(kpirl_mpc *mpc, real least, real most) {
  const real *arguments[15];
  real *results[9];
  hand_over(&mpc->work, arguments, results);
  arguments[13] = &least;
  arguments[14] = &most;
  results[8] = &mpc->work.step.tau;
  kpirl_mpc_call(mpc, kpirl_mpc_corrected_step, 15, arguments, 9, results);
  judge(&mpc->work, 0);
}

real kpirl_mpc_shortened(const kpirl_mpc_workspace *work, real length) {
  const real *before = work->iterate.y, *after = work->trial.y;
  real most = BOUNDARY;
  int i;
  for (i = 0; i < ROWS; ++i) most = larger((before[i] - after[i]) / before[i], most);
  return length * (most > BOUNDARY ? smaller(larger(BOUNDARY / most, (real)0.5), (real)0.95) : (real)0.5);
}

real kpirl_mpc_log_slacks(const real *y) {
  real sum = 0;
  int i;
  for (i = 0; i < ROWS; ++i) sum += log(y[i]);
  return sum;
}

/* trial: linear in everything but the point, which follows the dynamics. */
static void move_linearly(kpirl_mpc_workspace *work, real length) {
  const kpirl_mpc_iterate *at = &work->iterate, *change = &work->step.change;
  kpirl_mpc_iterate *trial = &work->trial;
  int i;
  for (i = 0; i < T * NS; ++i) trial->costates[i] = at->costates[i] + length * change->costates[i];
  for (i = 0; i < ROWS; ++i) trial->y[i] = at->y[i] + length * change->y[i];
  for (i = 0; i < FIXED; ++i) trial->nu[i] = at->nu[i] + length * change->nu[i];
  memcpy(trial->z, at->z, sizeof trial->z);
}

/* Bounds keep the share 1 - length of their residual: one that holds holds on. Where that leaves too little of a slack,
 * phi is infinite. */
void kpirl_mpc_try(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers, real length, real *theta, real *phi) {
  kpirl_mpc_workspace *work = &mpc->work;
  const kpirl_mpc_derivatives *d = &work->at;
  const kpirl_mpc_iterate *at = &work->iterate;
  kpirl_mpc_iterate *trial = &work->trial;
  real gap[NS] = {0}, off[KPIRL_MPC_ROOM(KPIRL_MPC_N_FIXED)] = {0}, g[KPIRL_MPC_ROOM(KPIRL_MPC_N_ROWS)] = {0};
  real objective = 0;
  const real *arguments[9], least = REMAINDER * (1 - BOUNDARY);
  real *results[4];
  int i, outside = 0;
  move_linearly(work, length);
  arguments[0] = at->point;
  arguments[1] = at->point + STATES;
  arguments[2] = work->step.change.point;
  arguments[3] = work->step.change.point + STATES;
  arguments[4] = work->step.gains;
  arguments[5] = d->defects;
  arguments[6] = &length;
  arguments[7] = numbers->psi;
  arguments[8] = numbers->context;
  results[0] = trial->point;
  results[1] = trial->point + STATES;
  results[2] = &objective;
  results[3] = work->path;
  kpirl_mpc_call(mpc, kpirl_mpc_follow, 9, arguments, 4, results);
  evaluate_constraints(work, numbers, trial->point, gap, off, g);
  *theta = (1 - length) * absolute_sum(d->defects, T * NS) + absolute_sum(gap, NS) + absolute_sum(off, FIXED);
  for (i = 0; i < ROWS; ++i) {
    trial->y[i] = i < BOUNDS ? (1 - length) * (d->rows[i] + at->y[i]) - g[i] : larger(trial->y[i], -g[i]);
    *theta += fabs(g[i] + trial->y[i]);
    outside = outside || trial->y[i] < least * at->y[i];
  }
  *phi = outside ? (real)INFINITY : objective - work->step.tau * kpirl_mpc_log_slacks(trial->y);
}

void kpirl_mpc_centre(kpirl_mpc *mpc, const kpirl_mpc_numbers *numbers) {
  kpirl_mpc_workspace *work = &mpc->work;
  kpirl_mpc_iterate *at = &work->iterate;
  real g[KPIRL_MPC_ROOM(KPIRL_MPC_N_ROWS)] = {0};
  int i;
  kpirl_mpc_evaluate_path(mpc, numbers, at->point);
  kpirl_mpc_evaluate_rows(work, at->point + NS, work->path, g);
  for (i = 0; i < ROWS; ++i) {
    real centred;
    at->y[i] = isnan(g[i]) ? g[i] : larger(at->y[i], -g[i]);
    centred = work->tau / at->y[i];
    if (at->z[i] < centred / CENTRE) at->z[i] = centred / CENTRE;
    if (at->z[i] > centred * CENTRE) at->z[i] = centred * CENTRE;
  }
}

void kpirl_mpc_write(const kpirl_mpc *mpc, kpirl_mpc_solution *solution) {
  const kpirl_mpc_iterate *at = &mpc->work.iterate;
  real pushing[KPIRL_MPC_N_POINT - KPIRL_MPC_N_STATES] = {0};
  kpirl_mpc_push(&mpc->work, at, pushing);
  memcpy(solution->states, at->point, sizeof solution->states);
  memcpy(solution->actions, at->point + STATES, sizeof solution->actions);
  memcpy(solution->dynamics, at->costates, sizeof solution->dynamics);
  memcpy(solution->state_bounds, pushing, sizeof solution->state_bounds);
  memcpy(solution->action_bounds, pushing + T * NS, sizeof solution->action_bounds);
  memset(solution->path, 0, sizeof solution->path);
  if (FORCES > 0) memcpy(solution->path, at->z + BOUNDS, FORCES * sizeof(real));
  solution->objective = mpc->work.at.objective;
}
