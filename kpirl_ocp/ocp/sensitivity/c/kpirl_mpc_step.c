/* SPDX-License-Identifier: MIT
 *
 * Factors of the linearised KKT conditions, what they are conditioned by, and the Newton step.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

static const real KNOWN = (real)1e-9;   /* relative accuracy to which no solution is known better */
static const real ROUGHLY = (real)1e-6; /* relative residual of a Newton step, enough to tell how far the solution is */
static const real CLOSE = (real)1e-8;   /* a step that is no longer needs no other */
static const real FAR = (real)1e-2;     /* a longer one does not start at a solution */
static const real SHORT = (real)1e-5;   /* after a shorter one the factors still solve, with some refinement */
static const real SHORTER = (real)0.1;  /* share of a step that the next one has at most where the method converges */
enum { REFINEMENTS = 12, STEPS = 4 };

/* ---- factors ---------------------------------------------------------------------------------------------------- */

static int any_negative(const real *values, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (values[i] < 0) return 1;
  return 0;
}

static int count_active(const kpirl_mpc_system *s) {
  int i, count = 0;
  for (i = 0; i < kpirl_mpc_system_n_rows(s); ++i) count += s->active[i] != 0;
  return count;
}

/* Pivots know the signs of the eigenvalues, the Lanczos method the size of the lowest. Infinite when the active rows leave no
 * freedom; NaN if the Lanczos method did not find what the pivots know. */
static void find_lowest(kpirl_mpc_kkt *k, int n_active) {
  const kpirl_mpc_system *s = &k->system;
  int negative;
  real value;
  k->lowest = (real)INFINITY;
  memset(k->lowest_mode, 0, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
  if (n_active >= s->n_decisions) return;
  negative = any_negative(s->factors.pivots, s->horizon * s->n_actions) || any_negative(s->factors.free_pivots, s->n_free);
  value = kpirl_mpc_system_lowest_mode(s, negative, k->rows->normal, k->lowest_mode);
  k->lowest = !isfinite(value) ? 0 : negative != (value < 0) ? (real)NAN : 1 / value;
  if (!isfinite(value) || negative != (value < 0))
    memset(k->lowest_mode, 0, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
}

static real find_qualification(kpirl_mpc_kkt *k, int n_active) {
  kpirl_mpc_system other = k->system;
  if (!n_active) return (real)INFINITY;
  if (k->immovable || n_active > k->system.n_decisions) return 0;
  if (kpirl_mpc_system_other_rows(&k->system) <= KPIRL_MPC_FEW) return kpirl_mpc_system_few_rows(&k->system, k->rows->normal);
  other.factors = k->row_factors;
  return kpirl_mpc_system_qualification(&other, k->rows->normal);
}

void kpirl_mpc_kkt_factor(kpirl_mpc_kkt *k) {
  if (k->factored) return;
  k->immovable = kpirl_mpc_system_factor(&k->system, k->rows->normal);
  k->factored = 1;
  k->borrowed = 0;
}

void kpirl_mpc_kkt_condition(kpirl_mpc_kkt *k) {
  const int n_active = count_active(&k->system);
  kpirl_mpc_kkt_factor(k);
  if (k->conditioned) return;
  find_lowest(k, n_active);
  k->qualification = find_qualification(k, n_active);
  k->conditioned = 1;
}

real kpirl_mpc_kkt_refine(kpirl_mpc_kkt *k, const kpirl_mpc_triple *right, real enough, real needed, kpirl_mpc_triple *point) {
  real error;
  kpirl_mpc_kkt_factor(k);
  error = kpirl_mpc_system_solve(&k->system, right, enough, REFINEMENTS, point);
  if (error <= needed || !k->borrowed) return error;
  k->factored = 0;
  kpirl_mpc_kkt_factor(k);
  return kpirl_mpc_system_solve(&k->system, right, enough, REFINEMENTS, point);
}

/* Factors of the system itself leave an error where a row is relaxed or smoothed, else only rounding. */
void kpirl_mpc_kkt_solve_directly(kpirl_mpc_kkt *k, const kpirl_mpc_triple *right, real needed, kpirl_mpc_triple *point) {
  kpirl_mpc_kkt_factor(k);
  if (k->borrowed || k->barrier > 0 || kpirl_mpc_system_other_rows(&k->system) > 0)
    kpirl_mpc_kkt_refine(k, right, needed, needed, point);
  else
    kpirl_mpc_system_solve_once(&k->system, right, point);
}

/* ---- the Newton step ---------------------------------------------------------------------------------------------- */

/* From x, the costates and the forces that push. */
static void newton_right(const kpirl_mpc_kkt *k, kpirl_mpc_triple *right) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), m = kpirl_mpc_system_n_rows(s);
  real *missing = right->forces; /* the gradient holds the forces of path constraints and equalities */
  int i;
  for (i = 0; i < m; ++i) missing[i] = k->pushing[i] - (i < s->n_bounds ? 0 : k->point.forces[i]);
  memcpy(right->x, k->gradient, (size_t)n_w * sizeof(real));
  kpirl_mpc_rows_transposed_times(s, missing, right->x);
  for (i = 0; i < n_w; ++i) right->x[i] = -right->x[i];
  for (i = 0; i < s->horizon * s->n_states; ++i) right->costates[i] = -k->defects[i];
  for (i = 0; i < m; ++i) right->forces[i] = s->active[i] != 0 ? k->slack[i] : 0;
  memset(right->start, 0, (size_t)s->n_states * sizeof(real));
}

static real size_of_decisions(const kpirl_mpc_system *s) {
  const real whole = kpirl_mpc_decision_norm(s, s->sizes);
  return whole > 0 ? whole : 1;
}

void kpirl_mpc_kkt_step(kpirl_mpc_kkt *k) {
  kpirl_mpc_triple right;
  if (k->stepped) return;
  kpirl_mpc_place_triple(&k->system, k->work, &right);
  newton_right(k, &right);
  kpirl_mpc_kkt_solve_directly(k, &right, ROUGHLY, &k->move);
  k->step = kpirl_mpc_decision_norm(&k->system, k->move.x) / size_of_decisions(&k->system);
  k->stepped = 1;
}

/* The point after the step into `to`, where smoothed rows push with tau / slack and rows that are off keep their multiplier. */
static void after_step(const kpirl_mpc_kkt *k, kpirl_mpc_triple *to) {
  const kpirl_mpc_system *s = &k->system;
  int i;
  for (i = 0; i < kpirl_mpc_system_n_point(s); ++i) to->x[i] = k->point.x[i] + k->move.x[i];
  for (i = 0; i < s->horizon * s->n_states; ++i) to->costates[i] = k->point.costates[i] + k->move.costates[i];
  for (i = 0; i < kpirl_mpc_system_n_rows(s); ++i) {
    const int off = s->active[i] == 0 && !k->rows->inequality[i];
    to->forces[i] = off ? k->point.forces[i] : k->pushing[i] + k->move.forces[i];
  }
}

/* ---- polish -------------------------------------------------------------------------------------------------------- */

/* Are all inequalities that have a barrier still on their side of it? */
static int inside(const kpirl_mpc_kkt *k) {
  int i;
  for (i = 0; i < kpirl_mpc_system_n_rows(&k->system); ++i)
    if (k->barrier > 0 && k->rows->inequality[i] && !(k->slack[i] > 0)) return 0;
  return 1;
}

/* Stand at the point, with the same active rows, and with the same factors and units where it is `close` to the last, and without a
 * barrier the same matrices; returns whether that is a place to be. */
static int stand_again(kpirl_mpc_kkt *k, kpirl_mpc_core *core, int close) {
  int finite;
  if (close && !(k->barrier > 0))
    kpirl_mpc_kkt_update(k, core);
  else
    kpirl_mpc_kkt_evaluate(k, core);
  finite = close ? kpirl_mpc_kkt_select_again(k) : kpirl_mpc_kkt_select(k, k->system.active);
  k->factored = close;
  k->borrowed = close && !k->stale;
  return finite && inside(k);
}

void kpirl_mpc_kkt_renew(kpirl_mpc_kkt *k, kpirl_mpc_core *core) {
  if (!k->stale) return;
  kpirl_mpc_kkt_evaluate(k, core);
  k->factored = k->borrowed = 1;
}

/* Go along the step if the next one is much shorter, else stay; returns whether it went. */
static int follow_step(kpirl_mpc_kkt *k, kpirl_mpc_core *core) {
  const real step = k->step;
  kpirl_mpc_triple *before = &k->adjoint; /* of which none is known yet */
  int shorter = 0;
  kpirl_mpc_copy_triple(&k->system, &k->point, before);
  after_step(k, &k->point);
  if (stand_again(k, core, step <= SHORT)) {
    kpirl_mpc_kkt_step(k);
    shorter = k->step <= SHORTER * step;
  }
  if (!shorter) {
    kpirl_mpc_copy_triple(&k->system, before, &k->point);
    stand_again(k, core, 0);
    kpirl_mpc_kkt_step(k);
  }
  return shorter;
}

void kpirl_mpc_kkt_polish(kpirl_mpc_kkt *k, kpirl_mpc_core *core) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s);
  int i, count = 0;
  memcpy(k->origin, k->point.x, (size_t)n_w * sizeof(real));
  kpirl_mpc_kkt_step(k);
  if (!(k->step <= FAR)) return;
  while (k->step > CLOSE && count < STEPS && follow_step(k, core)) ++count;
  for (i = 0; i < n_w; ++i) k->origin[i] = k->point.x[i] - k->origin[i];
  k->distance = kpirl_mpc_decision_norm(s, k->origin) / size_of_decisions(s);
}

/* ---- nearby -------------------------------------------------------------------------------------------------------- */

/* The smallest of the relative forces of active and relative slacks of inactive inequalities; NaN if one is. */
static real smallest_margin(const kpirl_mpc_kkt *k, const real *forces, const real *slack, real *relative) {
  real least = (real)INFINITY;
  int i;
  if (k->barrier > 0) return least;
  kpirl_mpc_relative_forces(k, forces, relative);
  for (i = 0; i < kpirl_mpc_system_n_rows(&k->system); ++i) {
    const real own = k->system.active[i] != 0 ? relative[i] : kpirl_mpc_relative_slack(k, slack, i);
    if (k->rows->inequality[i] && !(own >= least)) least = own;
    if (isnan(least)) return least;
  }
  return least;
}

void kpirl_mpc_kkt_reach(kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby) {
  const kpirl_mpc_system *s = &k->system;
  const real size = size_of_decisions(s);
  const int m = kpirl_mpc_system_n_rows(s);
  real *slack = nearby->work, *relative = slack + m;
  int i;
  kpirl_mpc_kkt_condition(k);
  kpirl_mpc_kkt_step(k);
  after_step(k, &nearby->point);
  kpirl_mpc_rows_times(s, k->move.x, slack);
  for (i = 0; i < m; ++i) slack[i] = k->slack[i] - slack[i];
  k->margin = smallest_margin(k, nearby->point.forces, slack, relative);
  for (i = 0; i < kpirl_mpc_system_n_point(s); ++i) nearby->point.x[i] += KNOWN * size * k->lowest_mode[i];
  nearby->numbers = k->numbers;
  nearby->barrier = k->barrier;
  nearby->evaluated = 0;
  k->reached = 1;
}

real kpirl_mpc_kkt_change(const kpirl_mpc_kkt *k, kpirl_mpc_kkt *nearby, const real *r, kpirl_mpc_triple *point) {
  const kpirl_mpc_system *s = &k->system;
  kpirl_mpc_system there = nearby->system;
  kpirl_mpc_triple right;
  if (!inside(nearby)) return (real)INFINITY;
  kpirl_mpc_place_triple(s, nearby->work, &right);
  memset(right.x, 0, (size_t)kpirl_mpc_system_n_triple(s) * sizeof(real));
  memcpy(right.x, r, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
  there.lengths = s->lengths;
  there.stiffness = s->stiffness;
  there.roots = s->roots;
  return kpirl_mpc_system_change(s, &there, &right, point);
}
