/* SPDX-License-Identifier: MIT
 *
 * Tests of smoothness: at a kink (ReLU, max, norm) differences to either side disagree with derivatives, and derivatives jump.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

static const real DIFFERENCE = (real)1e-6; /* step of a difference quotient, relative: truncation 1e-12, rounding 1e-10 */
static const real WIDE = (real)1e-4;       /* over which most problems look straight */
static const real CLOSER = (real)0.1;      /* of two steps the shorter one; jumps do not shrink with it */
static const real ENOUGH = (real)1e-3;     /* disagreement above which the shorter step is tried, too */
static const real ROUNDING = (real)1e-12;  /* of the conditions, relative, with a margin by which kinks are told from it */
static const real SMALL = (real)1e-3;      /* share of the largest parameter that the others move by at least */
static const real FLOOR = (real)1e-9;      /* share of the whole gradient below which one of its entries may be rounding */

static int n_conditions(const kpirl_mpc_system *s) {
  return kpirl_mpc_system_n_point(s) + s->horizon * s->n_states + kpirl_mpc_system_n_rows(s) - s->n_bounds;
}

/* Gradient of the Lagrangian, defects, path constraints and equalities at x, with the forces of kkt->point; NaN where a function
 * failed. Returns the Lagrangian. */
static real conditions(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers, const real *x,
                       real *values) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, n_path = s->horizon * s->n_path + s->n_terminal;
  const int n = n_conditions(s);
  kpirl_mpc_start at = {0};
  kpirl_mpc_view view;
  int i, failed;
  at.x = x;
  at.costates = k->point.costates;
  at.path = k->point.forces + s->n_bounds;
  at.equality = at.path + n_path;
  failed = kpirl_mpc_core_evaluate_at(core, numbers, &at, KPIRL_MPC_FIRST);
  kpirl_mpc_core_view(core, &view);
  memcpy(values, view.gradient, (size_t)n_w * sizeof(real));
  memcpy(values + n_w, view.defects, (size_t)n_c * sizeof(real));
  memcpy(values + n_w + n_c, view.path, (size_t)n_path * sizeof(real));
  memcpy(values + n_w + n_c + n_path, view.equality, (size_t)(n - n_w - n_c - n_path) * sizeof(real));
  for (i = 0; failed && i < n; ++i) values[i] = (real)NAN;
  return view.objective + kpirl_mpc_dot(at.costates, view.defects, n_c) + kpirl_mpc_dot(at.path, view.path, n_path) +
         kpirl_mpc_dot(at.equality, view.equality, n - n_w - n_c - n_path);
}

/* ---- along x ---------------------------------------------------------------------------------------------------- */

/* What makes the conditions comparable: they are multiplied by it. */
static void find_units(const kpirl_mpc_kkt *k, real *units) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, n_s = s->n_states, n_x = n_s + s->n_actions;
  const int m = kpirl_mpc_system_n_rows(s);
  int i;
  memcpy(units, s->sizes, (size_t)n_w * sizeof(real));
  for (i = 0; i < n_c; ++i) units[n_w + i] = 1 / s->sizes[(i / n_s + 1) * n_x + i % n_s];
  for (i = s->n_bounds; i < m; ++i) units[n_w + n_c + i - s->n_bounds] = k->row_sizes[i] > 0 ? 1 / k->row_sizes[i] : 1;
}

static real largest_share(const kpirl_mpc_system *s, const real *x) {
  real most = 0;
  int i;
  for (i = 0; i < kpirl_mpc_system_n_point(s); ++i) {
    const real share = kpirl_mpc_abs(x[i] / s->sizes[i]);
    if (!(share <= most)) most = share;
    if (isnan(most)) break;
  }
  return most;
}

/* The largest distance of one side's difference from the slope, over `whole`, or over the longest of all where that is longer. */
static real disagreement(const real *left, const real *here, const real *right, const real *slope, const real *units, int n,
                         real whole, int relative) {
  real to_right = 0, to_left = 0, off_right = 0, off_left = 0, expected = 0;
  int i;
  for (i = 0; i < n; ++i) {
    const real after = units[i] * (right[i] - here[i]), before = units[i] * (here[i] - left[i]), known = units[i] * slope[i];
    to_right += after * after;
    to_left += before * before;
    expected += known * known;
    off_right += (after - known) * (after - known);
    off_left += (before - known) * (before - known);
  }
  if (relative) whole = kpirl_mpc_root(kpirl_mpc_worse(kpirl_mpc_worse(kpirl_mpc_worse(to_right, to_left), expected), whole * whole));
  return kpirl_mpc_over(kpirl_mpc_root(kpirl_mpc_worse(off_right, off_left)), whole);
}

/* A jump of the Lagrangian L, whose gradients to the left, here and to the right do not see it: what is left of its changes
 * beyond slope and curvature, relative to them, or to a share of its terms that may be rounding. */
static real value_jump(const kpirl_mpc_kkt *k, const real *L, const real *left, const real *here, const real *right,
                       const real *move) {
  const kpirl_mpc_system *s = &k->system;
  const int n_s = s->n_states, n_x = n_s + s->n_actions;
  real bend = 0, slope = 0, terms = kpirl_mpc_abs(L[1]), off;
  int i;
  for (i = 0; i < kpirl_mpc_system_n_point(s); ++i) {
    bend += kpirl_mpc_abs((right[i] - left[i]) * move[i]);
    slope += here[i] * move[i];
  }
  for (i = 0; i < s->horizon * n_s; ++i)
    terms += kpirl_mpc_abs(k->point.costates[i] * s->sizes[(i / n_s + 1) * n_x + i % n_s]);
  off = kpirl_mpc_worse(kpirl_mpc_abs(L[2] - L[1] - slope), kpirl_mpc_abs(L[1] - L[0] - slope)) - bend;
  return kpirl_mpc_over(kpirl_mpc_larger(off, 0), kpirl_mpc_worse(kpirl_mpc_worse(bend, kpirl_mpc_abs(slope)), FLOOR * terms));
}

static real kink(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, real lagrangian, const real *here, const real *units,
                 const real *move, real *work) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, n = n_conditions(s);
  real *left = work, *right = left + n, *slope = right + n, *x = slope + n, *zeros = x, *values = x, own = 0, whole, worst, L[3];
  int i;
  L[1] = lagrangian;
  for (i = 0; i < n_w; ++i) x[i] = k->point.x[i] - move[i];
  L[0] = conditions(k, core, &k->numbers, x, left);
  for (i = 0; i < n_w; ++i) x[i] = k->point.x[i] + move[i];
  L[2] = conditions(k, core, &k->numbers, x, right);
  memset(zeros, 0, (size_t)n_c * sizeof(real));
  kpirl_mpc_lagrangian_times(s, move, zeros, slope);
  kpirl_mpc_defects_times(s, move, slope + n_w);
  kpirl_mpc_rows_times(s, move, values);
  memcpy(slope + n_w + n_c, values + s->n_bounds, (size_t)(n - n_w - n_c) * sizeof(real));
  for (i = 0; i < n_w; ++i) {
    const real share = FLOOR * k->curvature[i] * move[i] * s->sizes[i];
    own += share * share;
  }
  whole = largest_share(s, move);
  worst = disagreement(left, here, right, slope, units, n_w, kpirl_mpc_root(own), 1);
  worst = kpirl_mpc_worse(worst, value_jump(k, L, left, here, right, move));
  worst = kpirl_mpc_worse(worst, disagreement(left + n_w, here + n_w, right + n_w, slope + n_w, units + n_w, n_c, whole, 0));
  i = n_w + n_c;
  return kpirl_mpc_worse(worst, disagreement(left + i, here + i, right + i, slope + i, units + i, n - i, whole, 0));
}

/* Of the difference: where a Newton step still moves the solution, long enough to reach a kink within its error, at which other
 * entries of x than the longest of the move may be. */
static real over_length(real error) {
  const real wide = kpirl_mpc_larger(10 * error, kpirl_mpc_smaller(100 * error, WIDE));
  return kpirl_mpc_larger(DIFFERENCE, wide);
}

real kpirl_mpc_kink_along(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const real *direction) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), n = n_conditions(s);
  const real size = largest_share(s, direction);
  real *here = k->work, *units = here + n, *move = units + n, *work = move + n_w, error = (real)INFINITY;
  real length = over_length(k->step), lagrangian;
  int i, j;
  if (size == 0) return 0;
  find_units(k, units);
  lagrangian = conditions(k, core, &k->numbers, k->point.x, here);
  for (j = length > DIFFERENCE; j < 2 && !(error <= ENOUGH); ++j, length *= CLOSER) {
    for (i = 0; i < n_w; ++i) move[i] = length / size * direction[i];
    error = kpirl_mpc_smaller(error, kink(k, core, lagrangian, here, units, move, work));
  }
  return error;
}

/* ---- along the parameters ------------------------------------------------------------------------------------------ */

real kpirl_mpc_jump(const real *values, int count, real whole) {
  real worst = 0;
  int i;
  for (i = 0; i < count; ++i) {
    const real here = values[i], *far = values + count + i, *near = far + 2 * count;
    const real left_over = kpirl_mpc_abs(near[0] - near[count] - CLOSER * (far[0] - far[count])) / (1 - CLOSER);
    const real all[5] = {here, far[0], far[count], near[0], near[count]};
    const real size = kpirl_mpc_larger(kpirl_mpc_largest(all, 5), FLOOR * whole);
    worst = kpirl_mpc_worse(worst, kpirl_mpc_over(left_over, size));
  }
  return worst;
}

int kpirl_mpc_weigh(const kpirl_mpc_kkt *k, const kpirl_mpc_weighted *function, const kpirl_mpc_triple *weights,
                    const real *psi, const real *context, real *by_psi, real *by_context) {
  const kpirl_mpc_system *s = &k->system;
  const int n_path = s->horizon * s->n_path + s->n_terminal;
  kpirl_mpc_weighted_arguments at;
  kpirl_mpc_weighted_results to;
  at.x = k->point.x;
  at.psi = psi;
  at.context = context;
  at.costates = k->point.costates;
  at.z = k->point.forces + s->n_bounds;
  at.nu = at.z + n_path;
  at.dx = weights->x;
  at.dcostates = weights->costates;
  at.dz = weights->forces + s->n_bounds;
  at.dnu = at.dz + n_path;
  to.by_psi = by_psi;
  to.by_context = by_context;
  return function->evaluate(function->self, &at, &to);
}

/* A random direction, in units of the numbers. */
static void find_moves(const kpirl_mpc_kkt *k, const real *numbers, int count, real *moves) {
  const real size = kpirl_mpc_largest(numbers, count);
  int i;
  for (i = 0; i < count; ++i) {
    const real own = size > 0 ? kpirl_mpc_larger(kpirl_mpc_abs(numbers[i]), SMALL * size) : 1;
    moves[i] = own * k->rows->uniform[i];
  }
}

static void moved(const real *from, const real *move, real length, int count, real *to) {
  int i;
  for (i = 0; i < count; ++i) to[i] = from[i] + length * move[i];
}

/* The sum of weights times the conditions, where the parameters and s_0 are moved; and the sum of the absolute values. */
static real weighted_conditions(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_triple *weights, const real *moves,
                                real length, real *sizes, real *work) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, n = n_conditions(s), n_s = s->n_states;
  const int n_psi = k->dimensions.n_parameters, n_context = k->dimensions.n_context;
  real *values = work, *x = values + n, *psi = x + n_w, *s0 = psi + n_psi, *context = s0 + n_s, sum = 0;
  kpirl_mpc_numbers numbers = k->numbers;
  int i;
  numbers.psi = psi;
  numbers.s0 = s0;
  numbers.context = context;
  moved(k->numbers.psi, moves, length, n_psi, psi);
  moved(k->numbers.s0, moves + n_psi, length, n_s, s0);
  moved(k->numbers.context, moves + n_psi + n_s, length, n_context, context);
  memcpy(x, k->point.x, (size_t)n_w * sizeof(real));
  moved(k->point.x, moves + n_psi, length, n_s, x);
  for (i = 0; i < s->n_free; ++i) x[s->free[i]] = k->point.x[s->free[i]];
  conditions(k, core, &numbers, x, values);
  *sizes = 0;
  for (i = 0; i < n; ++i) {
    const real weight = i < n_w ? weights->x[i]
                        : i < n_w + n_c ? weights->costates[i - n_w] : weights->forces[s->n_bounds + i - n_w - n_c];
    sum += weight * values[i];
    *sizes += kpirl_mpc_abs(weight * values[i]);
  }
  return sum;
}

/* The derivatives by psi and the context, times their moves, at steps 0, +h, -h, +h/10 and -h/10. */
static int weighted_slopes(const kpirl_mpc_kkt *k, const kpirl_mpc_weighted *function, const kpirl_mpc_triple *weights,
                           const kpirl_mpc_by_parameters *by, const real *moves, real *slopes, real *work) {
  static const real steps[] = {0, 1, -1, (real)0.1, (real)-0.1};
  const int n_psi = k->dimensions.n_parameters, n_context = k->dimensions.n_context, n = n_psi + n_context;
  const real *move_context = moves + n_psi + k->system.n_states;
  real *psi = work, *context = psi + n_psi;
  int i, j, failed = 0;
  for (j = 0; j < 5; ++j) {
    real *to = slopes + j * n;
    moved(k->numbers.psi, moves, steps[j] * DIFFERENCE, n_psi, psi);
    moved(k->numbers.context, move_context, steps[j] * DIFFERENCE, n_context, context);
    if (j > 0)
      failed |= kpirl_mpc_weigh(k, function, weights, psi, context, to, to + n_psi);
    else {
      memcpy(to, by->psi, (size_t)n_psi * sizeof(real));
      memcpy(to + n_psi, by->context, (size_t)n_context * sizeof(real));
    }
    for (i = 0; i < n_psi; ++i) to[i] *= moves[i];
    for (i = 0; i < n_context; ++i) to[n_psi + i] *= move_context[i];
  }
  return failed;
}

real kpirl_mpc_kink_in_parameters(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                                  const kpirl_mpc_triple *weights, const kpirl_mpc_by_parameters *by) {
  const int n_psi = k->dimensions.n_parameters, n_s = k->system.n_states, n_context = k->dimensions.n_context;
  real *moves = k->work, *slopes = moves + n_psi + n_s + n_context, *work = slopes + 5 * (n_psi + n_context);
  real expected = 0, total = 0, sides[3], sizes, ignored, noise, whole, off;
  int i;
  find_moves(k, k->numbers.psi, n_psi, moves);
  find_moves(k, k->numbers.s0, n_s, moves + n_psi);
  find_moves(k, k->numbers.context, n_context, moves + n_psi + n_s);
  for (i = 0; !by->s0 && i < n_s; ++i) moves[n_psi + i] = 0;
  for (i = 0; i < n_psi + n_s + n_context; ++i) {
    const real slope = i < n_psi ? by->psi[i] : i >= n_psi + n_s ? by->context[i - n_psi - n_s] : by->s0 ? by->s0[i - n_psi] : 0;
    expected += slope * moves[i];
    total += kpirl_mpc_abs(slope * moves[i]);
  }
  sides[0] = weighted_conditions(k, core, weights, moves, -DIFFERENCE, &ignored, work);
  sides[1] = weighted_conditions(k, core, weights, moves, 0, &sizes, work);
  sides[2] = weighted_conditions(k, core, weights, moves, DIFFERENCE, &ignored, work);
  sides[0] = (sides[1] - sides[0]) / DIFFERENCE;
  sides[2] = (sides[2] - sides[1]) / DIFFERENCE;
  noise = ROUNDING * sizes / DIFFERENCE;
  whole = kpirl_mpc_worse(kpirl_mpc_worse(total, noise), kpirl_mpc_worse(kpirl_mpc_abs(sides[0]), kpirl_mpc_abs(sides[2])));
  off = kpirl_mpc_worse(kpirl_mpc_abs(sides[0] - expected), kpirl_mpc_abs(sides[2] - expected));
  if (weighted_slopes(k, function, weights, by, moves, slopes, work)) return (real)INFINITY;
  return kpirl_mpc_worse(whole > 0 ? off / whole : 0, kpirl_mpc_jump(slopes, n_psi + n_context, whole));
}
