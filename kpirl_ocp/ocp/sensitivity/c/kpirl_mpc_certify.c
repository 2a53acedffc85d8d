/* SPDX-License-Identifier: MIT
 *
 * The gradients of a function of a solution, and the evidence for them.
 *
 * A solution is only known to some tolerance, so the active set was guessed, and second derivatives were taken beside the true
 * solution. One Newton step on the KKT conditions leads (quadratically) closer to it: the step itself must be small, and every
 * multiplier of an active row and slack of an inactive one positive after it; and the adjoint, solved again after it, must be
 * the same. The step is lengthened by 1e-9 along the lowest mode of the reduced Hessian, because no solution is known better than
 * that: at a fold or a flat minimum the adjoint then explodes.
 *
 * Where a short step has polished the point, second derivatives are stale, K(v_0) instead of K(v). Differences of first ones
 * are products with K(v), and one step of refinement, a += K(v_0)^{-1} (r - K(v) a), finds the adjoint there.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

static const real EXACT = (real)1e-13; /* relative residual at which refinement stops */
static const real NEARLY = (real)1e-11; /* and that is near enough to it */
static const real HARDLY = (real)1e-6;  /* change that first derivatives tell from none */
static const real CURVED = (real)0.1;      /* share of the terms of a slope that may be curvature, ... */
static const real BENT = (real)1e-3;       /* ... or of the terms that conditions are made of */
static const real STILL = (real)1e-3;      /* relative move of a plan that hardly moves */
static const real ROUNDING = (real)1e-14;  /* of these */
static const real TANGENT = (real)1e-11;    /* relative residual of a tangent: where nothing moves, more would look like a turn */

/* ---- gradients ----------------------------------------------------------------------------------------------------- */

real kpirl_mpc_kkt_solve(kpirl_mpc_kkt *k, const kpirl_mpc_triple *right, kpirl_mpc_triple *point) {
  return kpirl_mpc_kkt_refine(k, right, EXACT, NEARLY, point);
}

real kpirl_mpc_kkt_adjoint(kpirl_mpc_kkt *k, const real *slope) {
  const kpirl_mpc_system *s = &k->system;
  kpirl_mpc_triple right;
  kpirl_mpc_place_triple(s, k->work, &right);
  memset(right.x, 0, (size_t)kpirl_mpc_system_n_triple(s) * sizeof(real));
  memcpy(right.x, slope, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
  memset(k->adjoint.start, 0, (size_t)s->n_states * sizeof(real));
  return kpirl_mpc_kkt_solve(k, &right, &k->adjoint);
}

/* The derivative (n_s) of the weighted conditions by the given entries of s_0: H_0 x_0 + F_0' lambda_0 + C_0' mu, where mu holds the
 * forces of smoothed rows. of_stage: n_x numbers. */
static void by_start(const kpirl_mpc_system *s, const kpirl_mpc_triple *weights, real *of_stage, real *by) {
  const int n_s = s->n_states, n_x = n_s + s->n_actions;
  const real *path = weights->forces + s->n_bounds, *equality = path + s->horizon * s->n_path + s->n_terminal;
  int i;
  memset(of_stage, 0, (size_t)n_x * sizeof(real));
  kpirl_mpc_times_vector(s->H, n_x, n_x, weights->x, of_stage);
  kpirl_mpc_transposed_times_vector(s->F, n_s, n_x, weights->costates, of_stage);
  kpirl_mpc_times_vector(s->G, n_x, s->n_path, path, of_stage);
  kpirl_mpc_times_vector(s->E, n_x, s->n_equality, equality, of_stage);
  memcpy(by, of_stage, (size_t)n_s * sizeof(real));
  for (i = 0; i < s->n_free; ++i) by[s->free[i]] = 0; /* given entries have no bounds */
}

void kpirl_mpc_kkt_pull(const kpirl_mpc_kkt *k, const kpirl_mpc_weighted *function, kpirl_mpc_triple *adjoint,
                        const kpirl_mpc_by_parameters *by) {
  const kpirl_mpc_system *s = &k->system;
  real *values = k->work;
  int i;
  kpirl_mpc_rows_times(s, adjoint->x, values);
  for (i = 0; i < kpirl_mpc_system_n_rows(s); ++i) adjoint->forces[i] += s->sigma[i] * values[i];
  by_start(s, adjoint, k->work, by->s0);
  if (k->dimensions.n_parameters + k->dimensions.n_context == 0) return;
  if (!kpirl_mpc_weigh(k, function, adjoint, k->numbers.psi, k->numbers.context, by->psi, by->context)) return;
  for (i = 0; i < k->dimensions.n_parameters; ++i) by->psi[i] = (real)NAN;
  for (i = 0; i < k->dimensions.n_context; ++i) by->context[i] = (real)NAN;
}

static kpirl_mpc_by_parameters place_gradients(const kpirl_mpc_kkt *k, real *memory) {
  kpirl_mpc_by_parameters by;
  by.psi = memory;
  by.s0 = by.psi + k->dimensions.n_parameters;
  by.context = by.s0 + k->dimensions.n_states;
  return by;
}

/* Gradients of the function of k->slope, from derivatives of the weighted conditions; free entries of s_0 are decisions. */
static void add_slope(const kpirl_mpc_kkt *k, const kpirl_mpc_by_parameters *by) {
  int i;
  for (i = 0; i < k->dimensions.n_parameters; ++i) by->psi[i] = -by->psi[i];
  for (i = 0; i < k->dimensions.n_context; ++i) by->context[i] = -by->context[i];
  for (i = 0; i < k->system.n_states; ++i) by->s0[i] = k->slope[i] - by->s0[i] + k->adjoint.start[i];
  for (i = 0; i < k->system.n_free; ++i) by->s0[k->system.free[i]] = 0;
}

/* ---- along the predicted plan ------------------------------------------------------------------------------------ */

/* With v = (x, lambda, mu), p = (psi, s_0, context) and F(v; p) = 0, dv solves F_v dv = -F_p dp. What is left of F at
 * (v + h dv; p + h dp), weighted by the adjoint of a function, is h times the error of that function's slope to this side. Tests at
 * fixed v, or at fixed p, do not see all of it: the plan may run into a corner of the cost, or curvature vanish with psi. */

/* The right-hand side of the tangent, from conditions where parameters and given entries of s_0 have moved. */
static void tangent_right(const kpirl_mpc_system *s, const real *left, const real *right, kpirl_mpc_triple *to) {
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, m = kpirl_mpc_system_n_rows(s);
  int i;
  memset(to->x, 0, (size_t)kpirl_mpc_system_n_triple(s) * sizeof(real));
  for (i = 0; i < n_w; ++i) to->x[i] = (left[i] - right[i]) / (2 * KPIRL_MPC_DIFFERENCE);
  for (i = 0; i < n_c; ++i) to->costates[i] = (left[n_w + i] - right[n_w + i]) / (2 * KPIRL_MPC_DIFFERENCE);
  for (i = s->n_bounds; i < m; ++i) {
    const int j = n_w + n_c + i - s->n_bounds;
    to->forces[i] = s->active[i] != 0 ? (left[j] - right[j]) / (2 * KPIRL_MPC_DIFFERENCE) : 0;
  }
}

/* Terms that cancel in the weighted conditions, and round. */
static real cancelling(const kpirl_mpc_kkt *k, const kpirl_mpc_triple *weights) {
  const kpirl_mpc_system *s = &k->system;
  const int n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  real *balanced = s->scratch, sum;
  int i, t;
  for (i = 0; i < n_w; ++i) balanced[i] = k->curvature[i] * s->sizes[i];
  sum = kpirl_mpc_absolute_dot(weights->x, balanced, n_w);
  for (t = 0; t < s->horizon; ++t)
    sum += kpirl_mpc_absolute_dot(weights->x + (t + 1) * n_x, k->point.costates + t * n_s, n_s) +
           kpirl_mpc_absolute_dot(weights->costates + t * n_s, s->sizes + (t + 1) * n_x, n_s);
  return sum + kpirl_mpc_absolute_dot(weights->forces, k->row_sizes, kpirl_mpc_system_n_rows(s));
}

/* (w.F at step h - w.F here) / h, and F there. */
static real slope_left(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_triple *weights, const real *moves,
                       const kpirl_mpc_triple *tangent, real here, real length, real *values, real *work) {
  const kpirl_mpc_system *s = &k->system;
  const int count = kpirl_mpc_system_n_triple(s) - s->n_states;
  kpirl_mpc_kkt there = *k;
  there.evaluated = 0;
  work = kpirl_mpc_place_triple(s, work, &there.point);
  memcpy(there.point.x, k->point.x, (size_t)count * sizeof(real));
  kpirl_mpc_axpy(length, tangent->x, count, there.point.x);
  return (kpirl_mpc_moved_weighted_sum(&there, core, weights, moves, length, values, work) - here) / length;
}

/* The part of its move by which the plan, to first order, differs from the one predicted: the weights may not see it. */
static real plan_left(const kpirl_mpc_kkt *k, const kpirl_mpc_triple *tangent, const real *here, const real *there,
                      kpirl_mpc_triple *residual) {
  const kpirl_mpc_system *s = &k->system;
  const real move = kpirl_mpc_max(kpirl_mpc_point_norm(s, tangent->x), STILL * kpirl_mpc_point_norm(s, s->sizes));
  tangent_right(s, here, there, residual);
  return 2 * kpirl_mpc_system_reach(s, residual) / move;
}

real kpirl_mpc_kink_along_plan(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_triple *weights, const real *moves,
                               const real *left, const real *at, const real *right, real here, real total, real *work) {
  const real steps[] = {KPIRL_MPC_DIFFERENCE, -KPIRL_MPC_DIFFERENCE}, terms = cancelling(k, weights);
  kpirl_mpc_kkt with = *k;
  kpirl_mpc_triple of_tangent, tangent;
  real *values = work, worst = 0;
  int i;
  work = kpirl_mpc_place_triple(&k->system, work + kpirl_mpc_n_conditions(&k->system), &of_tangent);
  work = kpirl_mpc_place_triple(&k->system, work, &tangent);
  tangent_right(&k->system, left, right, &of_tangent);
  kpirl_mpc_kkt_solve_directly(&with, &of_tangent, TANGENT, &tangent);
  memcpy(k->tangent, tangent.x, (size_t)kpirl_mpc_system_n_point(&k->system) * sizeof(real));
  for (i = 0; i < 2; ++i) {
    const real far = slope_left(k, core, weights, moves, &tangent, here, steps[i], values, work);
    real whole = kpirl_mpc_worse(kpirl_mpc_worse(total, kpirl_mpc_abs(far)), ROUNDING * terms / KPIRL_MPC_DIFFERENCE);
    real off = kpirl_mpc_abs(far);
    const real turned = plan_left(k, &tangent, at, values, &of_tangent);
    if (!(turned <= CURVED)) return kpirl_mpc_worse(worst, turned);
    if (off > KPIRL_MPC_NO_KINK * whole && off <= CURVED * total + BENT * terms) {
      const real near = slope_left(k, core, weights, moves, &tangent, here, KPIRL_MPC_CLOSER * steps[i], values, work);
      whole = kpirl_mpc_worse(whole, ROUNDING * terms / (KPIRL_MPC_CLOSER * KPIRL_MPC_DIFFERENCE));
      off = kpirl_mpc_abs(near - KPIRL_MPC_CLOSER * far) / (1 - KPIRL_MPC_CLOSER);
    }
    worst = kpirl_mpc_worse(worst, whole > 0 ? off / whole : 0);
  }
  return worst;
}

/* ---- evidence ------------------------------------------------------------------------------------------------------- */

/* How the adjoint of k->slope changes where a Newton step leads to, by second derivatives there. */
static real find_change(const kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core) {
  if (!nearby->evaluated) {
    kpirl_mpc_kkt_evaluate(nearby, core);
    kpirl_mpc_kkt_select_nearby(nearby, k->system.active);
  }
  kpirl_mpc_copy_triple(&k->system, &k->adjoint, &nearby->adjoint);
  return kpirl_mpc_kkt_change(k, nearby, k->slope, &nearby->adjoint);
}

/* Both by first derivatives alone, which see small changes where there is no kink; returns whether these are. An adjoint of matrices
 * that are stale becomes the one nearby. */
static int find_both(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, kpirl_mpc_evidence *evidence) {
  kpirl_mpc_triple residual;
  kpirl_mpc_place_triple(&k->system, nearby->work, &residual);
  evidence->kink = kpirl_mpc_kink_nearby(k, nearby, core, &k->adjoint, &residual);
  if (!(evidence->kink <= KPIRL_MPC_NO_KINK)) return 0;
  if (k->stale) memcpy(k->adjoint.start, residual.x, (size_t)k->system.n_states * sizeof(real));
  evidence->change = k->stale ? kpirl_mpc_system_follow(&k->system, &residual, &k->adjoint)
                               : kpirl_mpc_system_first_change(&k->system, &residual, &k->adjoint);
  return evidence->change <= HARDLY;
}

/* Change, and kink along x. A quadratic program, whose system is the same everywhere, has none. */
static void look_around(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const real *direction,
                        kpirl_mpc_evidence *evidence) {
  const int smoothed = k->barrier > 0;
  if (!k->reached) kpirl_mpc_kkt_reach(k, nearby);
  evidence->change = evidence->kink = 0;
  if (k->rows->quadratic && !smoothed) return;
  if (!direction && !smoothed && find_both(k, nearby, core, evidence)) return;
  if (k->stale) {
    kpirl_mpc_kkt_renew(k, core);
    evidence->linear_residual = kpirl_mpc_kkt_adjoint(k, k->slope);
    look_around(k, nearby, core, direction, evidence);
    return;
  }
  evidence->change = find_change(k, nearby, core);
  evidence->kink = k->rows->quadratic ? 0 : kpirl_mpc_kink_along(k, core, direction ? direction : k->adjoint.x);
}

int kpirl_mpc_certify(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                      const real *slopes, const real *direction, real *answer) {
  const int n_w = kpirl_mpc_system_n_point(&k->system);
  const kpirl_mpc_by_parameters by = place_gradients(k, answer);
  kpirl_mpc_evidence *evidence = (kpirl_mpc_evidence *)(by.context + k->dimensions.n_context);
  kpirl_mpc_triple *adjoint = &k->adjoint;
  int finite;
  kpirl_mpc_by_stage(&k->dimensions, slopes, slopes + (k->dimensions.horizon + 1) * k->dimensions.n_states, k->slope);
  evidence->linear_residual = kpirl_mpc_kkt_adjoint(k, k->slope);
  kpirl_mpc_kkt_condition(k);
  evidence->distance = k->distance;
  evidence->step = evidence->change = evidence->kink = (real)INFINITY;
  evidence->margin = (real)NAN;
  finite = kpirl_mpc_all_finite(adjoint->x, n_w) && (!direction || kpirl_mpc_all_finite(direction, n_w));
  if (finite) {
    look_around(k, nearby, core, direction, evidence);
    evidence->step = k->step;
    evidence->margin = k->margin;
  }
  evidence->curvature = k->lowest;
  evidence->qualification = k->qualification;
  kpirl_mpc_kkt_pull(k, function, adjoint, &by);
  if (finite)
    evidence->kink = kpirl_mpc_worse(evidence->kink, kpirl_mpc_kink_in_parameters(k, core, function, adjoint, &by));
  add_slope(k, &by);
  return kpirl_mpc_all_finite(k->slope, n_w);
}

/* ---- several -------------------------------------------------------------------------------------------------------- */

/* Answers the first question; then both begin with the next. */
static void answer_next(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                        kpirl_mpc_questions *q, kpirl_mpc_answers *a) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), m = kpirl_mpc_system_n_rows(s);
  const int n_parameters = k->dimensions.n_parameters + k->dimensions.n_context;
  k->barrier = *q->barriers;
  *a->finite = kpirl_mpc_kkt_linearise(k, core, q->solutions, NULL) &&
               kpirl_mpc_certify(k, nearby, core, function, q->slopes, NULL, a->answers);
  memcpy(a->active, s->active, (size_t)m * sizeof(real));
  q->solutions += 2 * n_w + s->horizon * s->n_states + m - s->n_bounds + n_parameters;
  q->slopes += n_w;
  ++q->barriers;
  a->answers += n_parameters + s->n_states + sizeof(kpirl_mpc_evidence) / sizeof(real);
  a->active += m;
  ++a->finite;
}

void kpirl_mpc_certify_each(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                            int count, const kpirl_mpc_questions *questions, const kpirl_mpc_answers *answers) {
  kpirl_mpc_questions q = *questions;
  kpirl_mpc_answers a = *answers;
  while (count-- > 0) answer_next(k, nearby, core, function, &q, &a);
}
