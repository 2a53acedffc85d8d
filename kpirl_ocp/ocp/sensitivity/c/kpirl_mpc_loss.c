/* SPDX-License-Identifier: MIT
 *
 * A loss of a plan, its slopes, and whether it is smooth there.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

static const real DIFFERENCE = (real)1e-6; /* as in kpirl_mpc_kinks.c */
static const real ROUNDING = (real)1e-12;

static real absolute_dot(const real *a, const real *b, int count) {
  real sum = 0;
  int i;
  for (i = 0; i < count; ++i) sum += kpirl_mpc_abs(a[i] * b[i]);
  return sum;
}

/* Between x (n_w) and states with actions, either way. */
static void exchange(const kpirl_mpc_dimensions *of, real *x, real *states, real *actions, int to_x) {
  const int T = of->horizon, n_s = of->n_states, n_u = of->n_actions, n_x = n_s + n_u;
  int t;
  for (t = 0; t <= T; ++t) {
    real *s = x + t * n_x, *u = s + n_s;
    memcpy(to_x ? s : states + t * n_s, to_x ? states + t * n_s : s, (size_t)n_s * sizeof(real));
    if (t < T) memcpy(to_x ? u : actions + t * n_u, to_x ? actions + t * n_u : u, (size_t)n_u * sizeof(real));
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
  exchange(of, moved, states, actions, 0);
  at.states = states;
  at.actions = actions;
  at.data = data;
  to.value = value;
  to.by_states = moved;
  to.by_actions = moved + n_states;
  failed = loss->evaluate(loss->self, &at, &to);
  exchange(of, slopes, moved, moved + n_states, 1);
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
                            const real *data, const real *x, real *value, real *slopes, real *work) {
  static const real steps[] = {0, 1, -1, (real)0.1, (real)-0.1};
  const int n_w = of->horizon * (of->n_states + of->n_actions) + of->n_states;
  real values[5], *move = work, *moved = move + n_w, *own = moved + 5 * n_w, sides[2], expected, bend = 0, whole, off;
  int i, j, failed = 0;
  find_move(of, rows, x, move);
  for (j = 0; j < 5; ++j)
    failed |= evaluate(of, loss, data, x, move, steps[j] * DIFFERENCE, values + j, moved + j * n_w, own);
  *value = values[0];
  memcpy(slopes, moved, (size_t)n_w * sizeof(real));
  expected = kpirl_mpc_dot(slopes, move, n_w);
  for (i = 0; i < n_w; ++i) bend += kpirl_mpc_abs((moved[n_w + i] - moved[2 * n_w + i]) * move[i]);
  sides[0] = kpirl_mpc_abs((values[1] - values[0]) / DIFFERENCE - expected);
  sides[1] = kpirl_mpc_abs((values[0] - values[2]) / DIFFERENCE - expected);
  whole = kpirl_mpc_worse(kpirl_mpc_worse(absolute_dot(slopes, move, n_w), bend), ROUNDING * kpirl_mpc_abs(values[0]) / DIFFERENCE);
  off = kpirl_mpc_larger(kpirl_mpc_worse(sides[0], sides[1]) - bend, 0);
  for (j = 0; j < 5; ++j)
    for (i = 0; i < n_w; ++i) moved[j * n_w + i] *= kpirl_mpc_abs(move[i]);
  return failed ? (real)INFINITY : kpirl_mpc_worse(whole > 0 ? off / whole : off, kpirl_mpc_jump(moved, n_w, whole));
}
