/* SPDX-License-Identifier: MIT
 *
 * The gradients of a function of a solution, and the evidence for them.
 *
 * A solution is only known to some tolerance, so the active set was guessed, and second derivatives were taken beside the true
 * solution. One Newton step on the KKT conditions leads (quadratically) closer to it: the step itself must be small, and every
 * multiplier of an active row and slack of an inactive one positive after it; and the adjoint, solved again after it, must be
 * the same. The step is lengthened by 1e-9 along the softest direction, because no solution is known better than
 * that: at a fold or a flat minimum the adjoint then explodes.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

static const real EXACT = (real)1e-13; /* relative residual at which refinement stops */
static const real NEARLY = (real)1e-11; /* and that is near enough to it */
static const real HARDLY = (real)1e-6;  /* change that first derivatives tell from none */

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
  return kpirl_mpc_kkt_solve(k, &right, &k->adjoint);
}

/* The derivative (n_s) of the weighted conditions by the given entries of s_0. */
static void by_start(const kpirl_mpc_system *s, const kpirl_mpc_triple *weights, real *balance, real *by) {
  int i;
  kpirl_mpc_system_balance(s, weights, balance);
  memcpy(by, balance, (size_t)s->n_states * sizeof(real));
  for (i = 0; i < s->n_free; ++i) by[s->free[i]] = 0;
}

void kpirl_mpc_kkt_pull(const kpirl_mpc_kkt *k, const kpirl_mpc_weighted *function, kpirl_mpc_triple *adjoint,
                        const kpirl_mpc_by_parameters *by) {
  const kpirl_mpc_system *s = &k->system;
  real *values = k->work;
  int i;
  by_start(s, adjoint, k->work, by->s0);
  kpirl_mpc_rows_times(s, adjoint->x, values);
  for (i = 0; i < kpirl_mpc_system_n_rows(s); ++i) adjoint->forces[i] += s->sigma[i] * values[i];
  if (k->dimensions.n_parameters + k->dimensions.n_context == 0) return;
  if (!kpirl_mpc_weigh(k, function, adjoint, k->numbers.psi, k->numbers.context, by->psi, by->context)) return;
  for (i = 0; i < k->dimensions.n_parameters; ++i) by->psi[i] = (real)NAN;
  for (i = 0; i < k->dimensions.n_context; ++i) by->context[i] = (real)NAN;
}

static void negate(real *values, int count) {
  int i;
  for (i = 0; i < count; ++i) values[i] = -values[i];
}

/* ---- evidence ------------------------------------------------------------------------------------------------------- */

/* How the adjoint of a slope changes where a Newton step leads to, by second derivatives there. */
static real find_change(const kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const real *slope) {
  if (!nearby->evaluated) {
    kpirl_mpc_kkt_evaluate(nearby, core);
    kpirl_mpc_kkt_select_nearby(nearby, k->system.active);
  }
  kpirl_mpc_copy_triple(&k->system, &k->adjoint, &nearby->adjoint);
  return kpirl_mpc_kkt_change(k, nearby, slope, &nearby->adjoint);
}

/* Both by first derivatives alone, which see small changes where there is no kink; returns whether these are. */
static int find_both(const kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, kpirl_mpc_evidence *evidence) {
  kpirl_mpc_triple residual;
  kpirl_mpc_place_triple(&k->system, nearby->work, &residual);
  evidence->kink = kpirl_mpc_kink_nearby(k, nearby, core, &k->adjoint, &residual);
  if (!(evidence->kink <= KPIRL_MPC_NO_KINK)) return 0;
  evidence->change = kpirl_mpc_system_first_change(&k->system, &residual, &k->adjoint);
  return evidence->change <= HARDLY;
}

/* Change, and kink along x. A quadratic program, whose system is the same everywhere, has none. */
static void look_around(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const real *slope, const real *direction,
                        kpirl_mpc_evidence *evidence) {
  const int smoothed = k->barrier > 0;
  if (!k->reached) kpirl_mpc_kkt_reach(k, nearby);
  evidence->change = evidence->kink = 0;
  if (k->rows->quadratic && !smoothed) return;
  if (!direction && !smoothed && find_both(k, nearby, core, evidence)) return;
  evidence->change = find_change(k, nearby, core, slope);
  evidence->kink = k->rows->quadratic ? 0 : kpirl_mpc_kink_along(k, core, direction ? direction : k->adjoint.x);
}

void kpirl_mpc_certify(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                       const real *slope, const real *direction, const kpirl_mpc_by_parameters *by,
                       kpirl_mpc_evidence *evidence) {
  const int n_w = kpirl_mpc_system_n_point(&k->system);
  kpirl_mpc_triple *adjoint = &k->adjoint;
  int finite;
  evidence->linear_residual = kpirl_mpc_kkt_adjoint(k, slope);
  kpirl_mpc_kkt_condition(k);
  evidence->distance = k->distance;
  evidence->curvature = k->lowest;
  evidence->qualification = k->qualification;
  evidence->step = evidence->change = evidence->kink = (real)INFINITY;
  evidence->margin = (real)NAN;
  finite = kpirl_mpc_all_finite(adjoint->x, n_w) && (!direction || kpirl_mpc_all_finite(direction, n_w));
  if (finite) {
    look_around(k, nearby, core, slope, direction, evidence);
    evidence->step = k->step;
    evidence->margin = k->margin;
  }
  kpirl_mpc_kkt_pull(k, function, adjoint, by);
  if (finite)
    evidence->kink = kpirl_mpc_worse(evidence->kink, kpirl_mpc_kink_in_parameters(k, core, function, adjoint, by));
  negate(by->psi, k->dimensions.n_parameters);
  negate(by->s0, k->system.n_states);
  negate(by->context, k->dimensions.n_context);
}

/* ---- several -------------------------------------------------------------------------------------------------------- */

static void answer_one(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                       const kpirl_mpc_question *question, kpirl_mpc_answer *answer) {
  const kpirl_mpc_system *s = &k->system;
  k->numbers = question->numbers;
  k->barrier = question->barrier;
  answer->finite = kpirl_mpc_kkt_linearise(k, core, &question->solution, NULL);
  answer->finite = answer->finite && kpirl_mpc_all_finite(question->slope, kpirl_mpc_system_n_point(s));
  memcpy(answer->active, s->active, (size_t)kpirl_mpc_system_n_rows(s) * sizeof(real));
  if (!answer->finite) return;
  kpirl_mpc_certify(k, nearby, core, function, question->slope, NULL, &answer->gradients, &answer->evidence);
}

void kpirl_mpc_certify_each(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                            int count, const kpirl_mpc_question *questions, kpirl_mpc_answer *answers) {
  int i;
  for (i = 0; i < count; ++i) answer_one(k, nearby, core, function, questions + i, answers + i);
}
