/* SPDX-License-Identifier: MIT
 *
 * Tests of smoothness by jumps of derivatives: of weighted conditions along the parameters, of a loss along the plan.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

static const real ROUNDING = (real)1e-12;  /* of the conditions, relative, with a margin by which kinks are told from it */
static const real SMOOTH = (real)1e-4;     /* a relative difference of derivatives that is no kink */
static const real SMALL = (real)1e-3;      /* share of the largest parameter that the others move by at least */

/* The largest absolute value of one of `count` functions at so many steps, or `least` where that is larger. */
static real largest_at(const real *values, int count, int steps, real least) {
  for (; steps > 0; --steps, values += count) least = kpirl_mpc_max(kpirl_mpc_abs(*values), least);
  return least;
}

/* The largest relative jump at 0 of `count` functions of a step, from their values at steps 0, +h, -h, +h/10 and -h/10, one after
 * the other; those much smaller than `whole` may be rounding. */
static real jump_of(const real *values, int count, real whole) {
  real worst = 0;
  int i;
  for (i = 0; i < count; ++i) {
    const real *far = values + count + i, *near = far + 2 * count;
    const real left_over =
        kpirl_mpc_abs(near[0] - near[count] - KPIRL_MPC_CLOSER * (far[0] - far[count])) / (1 - KPIRL_MPC_CLOSER);
    worst = kpirl_mpc_worse(worst, kpirl_mpc_over(left_over, largest_at(values + i, count, 5, KPIRL_MPC_FLOOR * whole)));
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
  const real size = kpirl_mpc_norm_inf(numbers, count);
  int i;
  for (i = 0; i < count; ++i) {
    const real own = size > 0 ? kpirl_mpc_max(kpirl_mpc_abs(numbers[i]), SMALL * size) : 1;
    moves[i] = own * k->rows->uniform[i];
  }
}

static void moved(const real *from, const real *move, real length, int count, real *to) {
  int i;
  for (i = 0; i < count; ++i) to[i] = from[i] + length * move[i];
}

real kpirl_mpc_weighted_sum(const kpirl_mpc_system *s, const kpirl_mpc_triple *weights, const real *values, real *sizes) {
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, n_rows = kpirl_mpc_n_conditions(s) - n_w - n_c;
  const real *forces = weights->forces + s->n_bounds, *rows = values + n_w + n_c;
  if (sizes)
    *sizes = kpirl_mpc_absolute_dot(weights->x, values, n_w) + kpirl_mpc_absolute_dot(weights->costates, values + n_w, n_c) +
             kpirl_mpc_absolute_dot(forces, rows, n_rows);
  return kpirl_mpc_dot(weights->x, values, n_w) + kpirl_mpc_dot(weights->costates, values + n_w, n_c) +
         kpirl_mpc_dot(forces, rows, n_rows);
}

real kpirl_mpc_moved_weighted_sum(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_triple *weights, const real *moves,
                                  real length, real *values, real *work) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), n_s = s->n_states;
  const int n_psi = k->dimensions.n_parameters, n_context = k->dimensions.n_context;
  real *x = work, *psi = x + n_w, *s0 = psi + n_psi, *context = s0 + n_s;
  kpirl_mpc_numbers numbers = k->numbers;
  int i;
  numbers.psi = psi;
  numbers.s0 = s0;
  numbers.context = context;
  moved(k->numbers.psi, moves, length, n_psi, psi);
  moved(k->numbers.s0, moves + n_psi, length, n_s, s0);
  moved(k->numbers.context, moves + n_psi + n_s, length, n_context, context);
  kpirl_mpc_triple point = k->point;
  point.x = x;
  memcpy(x, k->point.x, (size_t)n_w * sizeof(real));
  moved(k->point.x, moves + n_psi, length, n_s, x);
  for (i = 0; i < s->n_free; ++i) x[s->free[i]] = k->point.x[s->free[i]];
  if (k->evaluated && n_psi + n_context == 0 && core->model.by_stage)
    kpirl_mpc_start_conditions(k, core, &numbers, &point, values);
  else
    kpirl_mpc_conditions(k, core, &numbers, &point, values);
  return kpirl_mpc_weighted_sum(s, weights, values, NULL);
}

/* The same where they have not moved, with the sizes. */
static real weighted_here(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_triple *weights, real *sizes, real *work) {
  if (k->evaluated)
    kpirl_mpc_known_conditions(k, work);
  else
    kpirl_mpc_conditions(k, core, &k->numbers, &k->point, work);
  return kpirl_mpc_weighted_sum(&k->system, weights, work, sizes);
}

/* The derivatives by psi and the context, times their moves, where these are moved. */
static int weighted_slopes(const kpirl_mpc_kkt *k, const kpirl_mpc_weighted *function, const kpirl_mpc_triple *weights,
                           const real *moves, real length, real *slopes, real *work) {
  const int n_psi = k->dimensions.n_parameters, n_context = k->dimensions.n_context;
  const real *move_context = moves + n_psi + k->system.n_states;
  real *psi = work, *context = psi + n_psi;
  int i, failed;
  moved(k->numbers.psi, moves, length, n_psi, psi);
  moved(k->numbers.context, move_context, length, n_context, context);
  failed = kpirl_mpc_weigh(k, function, weights, psi, context, slopes, slopes + n_psi);
  for (i = 0; i < n_psi; ++i) slopes[i] *= moves[i];
  for (i = 0; i < n_context; ++i) slopes[n_psi + i] *= move_context[i];
  return failed;
}

/* The largest relative difference of what `count` functions are at +h and at -h: a jump in between is no larger. */
static real difference(const real *values, int count, real whole) {
  real worst = 0;
  int i;
  for (i = 0; i < count; ++i) {
    const real jump = kpirl_mpc_abs(values[count + i] - values[2 * count + i]);
    worst = kpirl_mpc_worse(worst, kpirl_mpc_over(jump, largest_at(values + i, count, 3, KPIRL_MPC_FLOOR * whole)));
  }
  return worst;
}

/* The relative jump of the derivatives by psi and the context; at steps 0, +h, -h, and where these differ +h/10 and -h/10. */
static real slope_jump(const kpirl_mpc_kkt *k, const kpirl_mpc_weighted *function, const kpirl_mpc_triple *weights,
                       const kpirl_mpc_by_parameters *by, const real *moves, real whole, real *work) {
  const real steps[] = {1, -1, KPIRL_MPC_CLOSER, -KPIRL_MPC_CLOSER};
  const int n_psi = k->dimensions.n_parameters, n_context = k->dimensions.n_context, n = n_psi + n_context;
  real *slopes = work, *rest = slopes + 5 * n;
  int i, j, failed = 0;
  if (n == 0) return 0;
  for (i = 0; i < n_psi; ++i) slopes[i] = by->psi[i] * moves[i];
  for (i = 0; i < n_context; ++i) slopes[n_psi + i] = by->context[i] * moves[n_psi + k->system.n_states + i];
  for (j = 0; j < 4; ++j) {
    failed |= weighted_slopes(k, function, weights, moves, steps[j] * KPIRL_MPC_DIFFERENCE, slopes + (j + 1) * n, rest);
    if (failed) return (real)INFINITY;
    if (j == 1 && difference(slopes, n, whole) <= SMOOTH) return difference(slopes, n, whole);
  }
  return jump_of(slopes, n, whole);
}

/* Without psi and context, the conditions of a quadratic program are affine in x, multipliers and s_0 together. */
static int is_affine(const kpirl_mpc_kkt *k) {
  return k->rows->quadratic && k->dimensions.n_parameters + k->dimensions.n_context == 0;
}

real kpirl_mpc_kink_in_parameters(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_weighted *function,
                                  const kpirl_mpc_triple *weights, const kpirl_mpc_by_parameters *by) {
  const int n_psi = k->dimensions.n_parameters, n_s = k->system.n_states, n_context = k->dimensions.n_context;
  const int n = kpirl_mpc_n_conditions(&k->system);
  real *moves = k->work, *left = moves + n_psi + n_s + n_context, *right = left + n, *at = right + n, *work = at + n;
  real expected = 0, total = 0, sides[2], sizes, here, noise, whole, off, along_plan = 0;
  int i;
  if (is_affine(k) || (n_psi + n_context == 0 && !by->s0)) return 0;
  find_moves(k, k->numbers.psi, n_psi, moves);
  find_moves(k, k->numbers.s0, n_s, moves + n_psi);
  find_moves(k, k->numbers.context, n_context, moves + n_psi + n_s);
  for (i = 0; !by->s0 && i < n_s; ++i) moves[n_psi + i] = 0;
  for (i = 0; i < n_psi + n_s + n_context; ++i) {
    const real slope = i < n_psi ? by->psi[i] : i >= n_psi + n_s ? by->context[i - n_psi - n_s] : by->s0 ? by->s0[i - n_psi] : 0;
    expected += slope * moves[i];
    total += kpirl_mpc_abs(slope * moves[i]);
  }
  sides[0] = kpirl_mpc_moved_weighted_sum(k, core, weights, moves, -KPIRL_MPC_DIFFERENCE, left, work);
  here = weighted_here(k, core, weights, &sizes, at);
  sides[1] = kpirl_mpc_moved_weighted_sum(k, core, weights, moves, KPIRL_MPC_DIFFERENCE, right, work);
  sides[0] = (here - sides[0]) / KPIRL_MPC_DIFFERENCE;
  sides[1] = (sides[1] - here) / KPIRL_MPC_DIFFERENCE;
  noise = ROUNDING * sizes / KPIRL_MPC_DIFFERENCE;
  whole = kpirl_mpc_worse(kpirl_mpc_worse(total, noise), kpirl_mpc_worse(kpirl_mpc_abs(sides[0]), kpirl_mpc_abs(sides[1])));
  off = kpirl_mpc_worse(kpirl_mpc_abs(sides[0] - expected), kpirl_mpc_abs(sides[1] - expected));
  if (k->factored && !(k->barrier > 0))
    along_plan = kpirl_mpc_kink_along_plan(k, core, weights, moves, left, at, right, here, total, work);
  return kpirl_mpc_worse(kpirl_mpc_worse(whole > 0 ? off / whole : 0, along_plan),
                         slope_jump(k, function, weights, by, moves, whole, work));
}

/* ---- of a loss --------------------------------------------------------------------------------------------------- */

/* S and U of x, the inverse of kpirl_mpc_by_stage. */
static void split(const kpirl_mpc_dimensions *of, const real *x, real *states, real *actions) {
  const int n_s = of->n_states, n_u = of->n_actions;
  int t;
  for (t = 0; t <= of->horizon; ++t, x += n_s + n_u) {
    memcpy(states + t * n_s, x, (size_t)n_s * sizeof(real));
    if (t < of->horizon) memcpy(actions + t * n_u, x + n_s, (size_t)n_u * sizeof(real));
  }
}

/* The loss and its slopes (n_w) at x + length move. work: 2 n_w numbers. */
static int evaluate(const kpirl_mpc_dimensions *of, const kpirl_mpc_loss *loss, const real *data, const real *x, const real *move,
                    real length, real *value, real *slopes, real *work) {
  const int n_states = (of->horizon + 1) * of->n_states, n_w = n_states + of->horizon * of->n_actions;
  kpirl_mpc_loss_arguments at;
  kpirl_mpc_loss_results to;
  real *states = work, *actions = states + n_states, *moved = work + n_w;
  int i, failed;
  for (i = 0; i < n_w; ++i) moved[i] = x[i] + length * move[i];
  split(of, moved, states, actions);
  at.states = states;
  at.actions = actions;
  at.data = data;
  to.value = value;
  to.by_states = moved;
  to.by_actions = moved + n_states;
  failed = loss->evaluate(loss->self, &at, &to);
  kpirl_mpc_by_stage(of, moved, moved + n_states, slopes);
  return failed;
}

/* A random direction in units of the plan, in which given entries of s_0 stay. */
static void find_move(const kpirl_mpc_dimensions *of, const kpirl_mpc_rows *rows, const real *x, real *move) {
  const int n_w = of->horizon * (of->n_states + of->n_actions) + of->n_states;
  int i, next = 0;
  kpirl_mpc_point_sizes(of, rows, x, move);
  for (i = 0; i < n_w; ++i) {
    const int is_free = next < rows->n_free && rows->free[next] == i;
    next += is_free;
    move[i] *= i < of->n_states && !is_free ? 0 : rows->spread[i];
  }
}

real kpirl_mpc_kink_of_loss(const kpirl_mpc_dimensions *of, const kpirl_mpc_rows *rows, const kpirl_mpc_loss *loss,
                            const real *data, const real *x, const real *along, real *value, real *slopes, real *work) {
  const real steps[] = {0, 1, -1, KPIRL_MPC_CLOSER, -KPIRL_MPC_CLOSER};
  const int n_w = of->horizon * (of->n_states + of->n_actions) + of->n_states;
  real values[5], *move = work, *moved = move + n_w, *own = moved + 5 * n_w, sides[2], expected, bend = 0, whole, off;
  int i, j, failed = 0;
  if (along)
    memcpy(move, along, (size_t)n_w * sizeof(real));
  else
    find_move(of, rows, x, move);
  for (j = 0; j < 5; ++j)
    failed |= evaluate(of, loss, data, x, move, steps[j] * KPIRL_MPC_DIFFERENCE, values + j, moved + j * n_w, own);
  *value = values[0];
  split(of, moved, slopes, slopes + (of->horizon + 1) * of->n_states);
  expected = kpirl_mpc_dot(moved, move, n_w);
  for (i = 0; i < n_w; ++i) bend += kpirl_mpc_abs((moved[n_w + i] - moved[2 * n_w + i]) * move[i]);
  sides[0] = kpirl_mpc_abs((values[1] - values[0]) / KPIRL_MPC_DIFFERENCE - expected);
  sides[1] = kpirl_mpc_abs((values[0] - values[2]) / KPIRL_MPC_DIFFERENCE - expected);
  whole = kpirl_mpc_worse(kpirl_mpc_worse(kpirl_mpc_absolute_dot(moved, move, n_w), bend),
                          ROUNDING * kpirl_mpc_abs(values[0]) / KPIRL_MPC_DIFFERENCE);
  off = kpirl_mpc_max(kpirl_mpc_worse(sides[0], sides[1]) - bend, 0);
  for (j = 0; j < 5; ++j)
    for (i = 0; i < n_w; ++i) moved[j * n_w + i] *= kpirl_mpc_abs(move[i]);
  return failed ? (real)INFINITY : kpirl_mpc_worse(whole > 0 ? off / whole : off, jump_of(moved, n_w, whole));
}
