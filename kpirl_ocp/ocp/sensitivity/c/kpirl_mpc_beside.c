/* SPDX-License-Identifier: MIT
 *
 * A test of smoothness along the plan that derivatives predict where the parameters move.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

static const real DIFFERENCE = (real)1e-6; /* step of a difference quotient, as in kpirl_mpc_kinks.c */
static const real CLOSER = (real)0.1;      /* of two steps the shorter one; what is left of jumps does not shrink with it */
static const real CURVED = (real)0.1;      /* share of the terms of a slope that may be curvature, ... */
static const real BENT = (real)1e-3;       /* ... or of the terms that conditions are made of */
static const real ROUNDING = (real)1e-14;  /* of these */
static const real NEARLY = (real)1e-11;    /* relative residual of a tangent */

/* With v = (x, lambda, mu), p = (psi, s_0, context) and F(v; p) = 0, dv solves F_v dv = -F_p dp. What is left of F at
 * (v + h dv; p + h dp), weighted by the adjoint of a function, is h times the error of that function's slope to this side. Tests at
 * fixed v, or at fixed p, do not see all of it: the plan may run into a corner of the cost, or curvature vanish with psi. */

/* The right-hand side of the tangent, from conditions where parameters and given entries of s_0 have moved. */
static void tangent_right(const kpirl_mpc_system *s, const real *left, const real *right, kpirl_mpc_triple *to) {
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, m = kpirl_mpc_system_n_rows(s);
  int i;
  memset(to->x, 0, (size_t)kpirl_mpc_system_n_triple(s) * sizeof(real));
  for (i = 0; i < n_w; ++i) to->x[i] = (left[i] - right[i]) / (2 * DIFFERENCE);
  for (i = 0; i < n_c; ++i) to->costates[i] = (left[n_w + i] - right[n_w + i]) / (2 * DIFFERENCE);
  for (i = s->n_bounds; i < m; ++i) {
    const int j = n_w + n_c + i - s->n_bounds;
    to->forces[i] = s->active[i] != 0 ? (left[j] - right[j]) / (2 * DIFFERENCE) : 0;
  }
}

/* Terms that cancel in the weighted conditions, and round. */
static real cancelling(const kpirl_mpc_kkt *k, const kpirl_mpc_triple *weights) {
  const kpirl_mpc_system *s = &k->system;
  const int n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  real sum = 0;
  int i;
  for (i = 0; i < n_w; ++i) sum += kpirl_mpc_abs(weights->x[i]) * k->curvature[i] * s->sizes[i];
  for (i = 0; i < s->horizon * n_s; ++i) {
    const int next = (i / n_s + 1) * n_x + i % n_s;
    sum += kpirl_mpc_abs(weights->x[next] * k->point.costates[i]) + kpirl_mpc_abs(weights->costates[i]) * s->sizes[next];
  }
  for (i = s->n_bounds; i < kpirl_mpc_system_n_rows(s); ++i) sum += kpirl_mpc_abs(weights->forces[i]) * k->row_sizes[i];
  return sum;
}

/* (w.F at step h - w.F here) / h. */
static real slope_left(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_triple *weights, const real *moves,
                       const kpirl_mpc_triple *tangent, real here, real length, real *work) {
  const kpirl_mpc_system *s = &k->system;
  kpirl_mpc_kkt there = *k;
  real *values = kpirl_mpc_place_triple(s, work, &there.point);
  int i;
  for (i = 0; i < kpirl_mpc_system_n_triple(s); ++i) there.point.x[i] = k->point.x[i] + length * tangent->x[i];
  work = values + kpirl_mpc_n_conditions(s);
  return (kpirl_mpc_weighted_beside(&there, core, weights, moves, length, values, work) - here) / length;
}

real kpirl_mpc_kink_beside(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_triple *weights, const real *moves,
                           const real *left, const real *right, real here, real total, real *work) {
  const real steps[] = {DIFFERENCE, -DIFFERENCE}, terms = cancelling(k, weights);
  kpirl_mpc_kkt with = *k;
  kpirl_mpc_triple of_tangent, tangent;
  real worst = 0;
  int i;
  work = kpirl_mpc_place_triple(&k->system, work, &of_tangent);
  work = kpirl_mpc_place_triple(&k->system, work, &tangent);
  memset(tangent.x, 0, (size_t)kpirl_mpc_system_n_triple(&k->system) * sizeof(real));
  tangent_right(&k->system, left, right, &of_tangent);
  kpirl_mpc_kkt_refine(&with, &of_tangent, NEARLY, NEARLY, &tangent);
  for (i = 0; i < 2; ++i) {
    const real far = slope_left(k, core, weights, moves, &tangent, here, steps[i], work);
    real whole = kpirl_mpc_worse(kpirl_mpc_worse(total, kpirl_mpc_abs(far)), ROUNDING * terms / DIFFERENCE);
    real off = kpirl_mpc_abs(far);
    if (off > KPIRL_MPC_NO_KINK * whole && off <= CURVED * total + BENT * terms) {
      const real near = slope_left(k, core, weights, moves, &tangent, here, CLOSER * steps[i], work);
      whole = kpirl_mpc_worse(whole, ROUNDING * terms / (CLOSER * DIFFERENCE));
      off = kpirl_mpc_abs(near - CLOSER * far) / (1 - CLOSER);
    }
    worst = kpirl_mpc_worse(worst, whole > 0 ? off / whole : 0);
  }
  return worst;
}
