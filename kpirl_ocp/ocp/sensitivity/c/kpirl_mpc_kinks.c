/* SPDX-License-Identifier: MIT
 *
 * Tests of smoothness: at a kink (ReLU, max, norm) differences to either side disagree with derivatives, and derivatives jump.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

static const real WIDE = (real)1e-4;       /* over which most problems look straight */

int kpirl_mpc_n_conditions(const kpirl_mpc_system *s) {
  return kpirl_mpc_system_n_point(s) + s->horizon * s->n_states + kpirl_mpc_system_n_rows(s) - s->n_bounds;
}

static real lagrangian_of(const kpirl_mpc_kkt *k, real objective, const real *defects, const real *rows) {
  const kpirl_mpc_system *s = &k->system;
  const int m = kpirl_mpc_system_n_rows(s) - s->n_bounds, n_c = s->horizon * s->n_states;
  return objective + kpirl_mpc_dot(k->point.costates, defects, n_c) + kpirl_mpc_dot(k->point.forces + s->n_bounds, rows, m);
}

real kpirl_mpc_conditions(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers,
                          const kpirl_mpc_triple *point, real *values) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, n_path = s->horizon * s->n_path + s->n_terminal;
  const int n = kpirl_mpc_n_conditions(s);
  const kpirl_mpc_start at = kpirl_mpc_start_at(s, point);
  kpirl_mpc_view view;
  const int failed = kpirl_mpc_core_evaluate_at(core, numbers, &at, KPIRL_MPC_FIRST);
  int i;
  kpirl_mpc_core_view(core, &view);
  memcpy(values, view.gradient, (size_t)n_w * sizeof(real));
  memcpy(values + n_w, view.defects, (size_t)n_c * sizeof(real));
  memcpy(values + n_w + n_c, view.path, (size_t)n_path * sizeof(real));
  memcpy(values + n_w + n_c + n_path, view.equality, (size_t)(n - n_w - n_c - n_path) * sizeof(real));
  for (i = 0; failed && i < n; ++i) values[i] = (real)NAN;
  return lagrangian_of(k, view.objective, values + n_w, values + n_w + n_c);
}

void kpirl_mpc_start_conditions(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_numbers *numbers,
                                const kpirl_mpc_triple *point, real *values) {
  const kpirl_mpc_system *s = &k->system;
  const int n_s = s->n_states, n_x = n_s + s->n_actions;
  const kpirl_mpc_start at = kpirl_mpc_start_at(s, point);
  real *defects = values + kpirl_mpc_system_n_point(s), *path = defects + s->horizon * n_s;
  real *equality = path + s->horizon * s->n_path + s->n_terminal;
  kpirl_mpc_view view;
  const int failed = kpirl_mpc_core_evaluate_start(core, numbers, &at, KPIRL_MPC_FIRST);
  kpirl_mpc_core_view(core, &view);
  kpirl_mpc_known_conditions(k, values);
  memcpy(values, view.gradient, (size_t)n_x * sizeof(real));
  memcpy(defects, view.defects, (size_t)n_s * sizeof(real));
  memcpy(path, view.path, (size_t)s->n_path * sizeof(real));
  memcpy(equality, view.equality, (size_t)s->n_equality * sizeof(real));
  if (failed) values[0] = (real)NAN;
}

real kpirl_mpc_known_conditions(const kpirl_mpc_kkt *k, real *values) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, m = kpirl_mpc_system_n_rows(s);
  real *rows = values + n_w + n_c;
  int i;
  memcpy(values, k->gradient, (size_t)n_w * sizeof(real));
  memcpy(values + n_w, k->defects, (size_t)n_c * sizeof(real));
  for (i = s->n_bounds; i < m; ++i) rows[i - s->n_bounds] = -k->slack[i];
  return lagrangian_of(k, k->objective, k->defects, rows);
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
  real *shares = s->scratch;
  int i;
  for (i = 0; i < kpirl_mpc_system_n_point(s); ++i) shares[i] = x[i] / s->sizes[i];
  return kpirl_mpc_norm_inf(shares, kpirl_mpc_system_n_point(s));
}

/* A jump of the Lagrangian L, whose gradients to the left, here and to the right do not see it: what is left of its changes
 * beyond slope and curvature, relative to them, or to a share of its terms that may be rounding. */
static real value_jump(const kpirl_mpc_kkt *k, const real *L, const real *left, const real *here, const real *right,
                       const real *move) {
  const kpirl_mpc_system *s = &k->system;
  const int n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  const real slope = kpirl_mpc_dot(here, move, n_w);
  real *bends = s->scratch, bend, terms = kpirl_mpc_abs(L[1]), off;
  int i, t;
  for (i = 0; i < n_w; ++i) bends[i] = (right[i] - left[i]) * move[i];
  bend = kpirl_mpc_norm_1(bends, n_w);
  for (t = 0; t < s->horizon; ++t)
    terms += kpirl_mpc_absolute_dot(k->point.costates + t * n_s, s->sizes + (t + 1) * n_x, n_s);
  off = kpirl_mpc_worse(kpirl_mpc_abs(L[2] - L[1] - slope), kpirl_mpc_abs(L[1] - L[0] - slope)) - bend;
  return kpirl_mpc_over(kpirl_mpc_max(off, 0),
                        kpirl_mpc_worse(kpirl_mpc_worse(bend, kpirl_mpc_abs(slope)), KPIRL_MPC_FLOOR * terms));
}

/* ---- a search ---------------------------------------------------------------------------------------------------- */

/* The conditions at a point and where a move of x and multipliers leads to from it, and back; the Lagrangian there; derivatives. */
typedef struct search {
  kpirl_mpc_triple move, moved;
  real *left, *here, *right;
  real *slope, *pushed; /* (n) times the move of x, and (n_w) times that of the multipliers */
  real *units, *rows, lagrangian[3];
} search;

static int count_all(const kpirl_mpc_system *s) { return kpirl_mpc_system_n_triple(s) - s->n_states; }

static void begin(const kpirl_mpc_kkt *k, search *at) {
  const kpirl_mpc_system *s = &k->system;
  const int n = kpirl_mpc_n_conditions(s);
  at->left = kpirl_mpc_place_triple(s, kpirl_mpc_place_triple(s, k->work, &at->move), &at->moved);
  at->here = at->left + n;
  at->right = at->here + n;
  at->slope = at->right + n;
  at->units = at->slope + n;
  at->pushed = at->units + n;
  at->rows = at->pushed + kpirl_mpc_system_n_point(s);
  find_units(k, at->units);
}

/* move = length times the first `count` numbers of a direction */
static void set_move(const kpirl_mpc_system *s, real length, const real *direction, int count, search *at) {
  memset(at->move.x, 0, (size_t)count_all(s) * sizeof(real));
  kpirl_mpc_axpy(length, direction, count, at->move.x);
}

static void find_derivatives(const kpirl_mpc_system *s, search *at) {
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, m = kpirl_mpc_system_n_rows(s);
  kpirl_mpc_hessian_times(s, at->move.x, at->slope);
  kpirl_mpc_defects_times(s, at->move.x, at->slope + n_w);
  kpirl_mpc_rows_times(s, at->move.x, at->rows);
  memcpy(at->slope + n_w + n_c, at->rows + s->n_bounds, (size_t)(m - s->n_bounds) * sizeof(real));
  memcpy(at->rows, at->move.forces, (size_t)m * sizeof(real));
  memset(at->rows, 0, (size_t)s->n_bounds * sizeof(real)); /* forces of bounds are not in the conditions */
  memset(at->pushed, 0, (size_t)n_w * sizeof(real));
  kpirl_mpc_defects_transposed_times(s, at->move.costates, at->pushed);
  kpirl_mpc_rows_transposed_times(s, at->rows, at->pushed);
}

/* What the multipliers change by themselves is taken away. */
static void find_sides(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const kpirl_mpc_triple *from, search *at) {
  const kpirl_mpc_system *s = &k->system;
  const int count = count_all(s), n_w = kpirl_mpc_system_n_point(s);
  memcpy(at->moved.x, from->x, (size_t)count * sizeof(real));
  kpirl_mpc_axpy(-1, at->move.x, count, at->moved.x);
  at->lagrangian[0] = kpirl_mpc_conditions(k, core, &k->numbers, &at->moved, at->left);
  kpirl_mpc_axpy(2, at->move.x, count, at->moved.x);
  at->lagrangian[2] = kpirl_mpc_conditions(k, core, &k->numbers, &at->moved, at->right);
  find_derivatives(s, at);
  kpirl_mpc_axpy(1, at->pushed, n_w, at->left);
  kpirl_mpc_axpy(-1, at->pushed, n_w, at->right);
}

/* The largest distance of one side's difference from the slope, of `n` conditions from the first on, over `whole`, or over the longest
 * of all where that is longer. The conditions to the sides become these distances. */
static real disagreement(search *at, int first, int n, real whole, int relative) {
  real *left = at->left + first, *right = at->right + first, *slope = at->slope + first;
  const real *here = at->here + first, *units = at->units + first;
  int i;
  for (i = 0; i < n; ++i) {
    right[i] = units[i] * (right[i] - here[i]);
    left[i] = units[i] * (here[i] - left[i]);
    slope[i] *= units[i];
  }
  if (relative)
    whole = kpirl_mpc_worse(kpirl_mpc_worse(kpirl_mpc_norm_2(right, n), kpirl_mpc_norm_2(left, n)),
                            kpirl_mpc_worse(kpirl_mpc_norm_2(slope, n), whole));
  kpirl_mpc_axpy(-1, slope, n, right);
  kpirl_mpc_axpy(-1, slope, n, left);
  return kpirl_mpc_over(kpirl_mpc_worse(kpirl_mpc_norm_2(right, n), kpirl_mpc_norm_2(left, n)), whole);
}

static real kink(const kpirl_mpc_kkt *k, search *at) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s), n_c = s->horizon * s->n_states, n = kpirl_mpc_n_conditions(s);
  const real *move = at->move.x, whole = largest_share(s, move);
  real worst = value_jump(k, at->lagrangian, at->left, at->here, at->right, move), *own = s->scratch;
  int i;
  for (i = 0; i < n_w; ++i) own[i] = KPIRL_MPC_FLOOR * k->curvature[i] * move[i] * s->sizes[i];
  worst = kpirl_mpc_worse(worst, disagreement(at, 0, n_w, kpirl_mpc_norm_2(own, n_w), 1));
  worst = kpirl_mpc_worse(worst, disagreement(at, n_w, n_c, whole, 0));
  return kpirl_mpc_worse(worst, disagreement(at, n_w + n_c, n - n_w - n_c, whole, 0));
}

/* Of the difference: where a Newton step still moves the solution, long enough to reach a kink within its error, at which other
 * entries of x than the longest of the move may be. */
static real over_length(real error) {
  const real wide = kpirl_mpc_max(10 * error, kpirl_mpc_min(100 * error, WIDE));
  return kpirl_mpc_max(KPIRL_MPC_DIFFERENCE, wide);
}

/* By the conditions `here`, whose Lagrangian is known. */
static real kink_from(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const real *direction, search *at) {
  const kpirl_mpc_system *s = &k->system;
  const real size = largest_share(s, direction);
  real error = (real)INFINITY, length = over_length(k->step);
  int j;
  for (j = length > KPIRL_MPC_DIFFERENCE; j < 2 && !(error <= KPIRL_MPC_NO_KINK); ++j, length *= KPIRL_MPC_CLOSER) {
    set_move(s, length / size, direction, kpirl_mpc_system_n_point(s), at);
    find_sides(k, core, &k->point, at);
    error = kpirl_mpc_min(error, kink(k, at));
  }
  return error;
}

/* First from the values that came with second derivatives; where these round in another way than the neighbours', from new ones. */
real kpirl_mpc_kink_along(const kpirl_mpc_kkt *k, kpirl_mpc_core *core, const real *direction) {
  search at;
  real error;
  if (largest_share(&k->system, direction) == 0) return 0;
  begin(k, &at);
  at.lagrangian[1] = kpirl_mpc_known_conditions(k, at.here);
  error = kink_from(k, core, direction, &at);
  if (error <= KPIRL_MPC_NO_KINK) return error;
  at.lagrangian[1] = kpirl_mpc_conditions(k, core, &k->numbers, &k->point, at.here);
  return kink_from(k, core, direction, &at);
}

/* here = what the conditions are nearby, to first order; differences over a move that is longer do not feel the second one. */
static void predict(const kpirl_mpc_kkt *k, const kpirl_mpc_triple *nearby, search *at) {
  const kpirl_mpc_system *s = &k->system;
  const int n_w = kpirl_mpc_system_n_point(s);
  set_move(s, 1, nearby->x, count_all(s), at);
  kpirl_mpc_axpy(-1, k->point.x, count_all(s), at->move.x);
  find_derivatives(s, at);
  at->lagrangian[1] = kpirl_mpc_known_conditions(k, at->here) + kpirl_mpc_dot(k->gradient, at->move.x, n_w);
  kpirl_mpc_axpy(1, at->slope, kpirl_mpc_n_conditions(s), at->here);
  kpirl_mpc_axpy(1, at->pushed, n_w, at->here);
}

/* Differences that are to correct an adjoint, where matrices are stale, round the least over the WIDE length. */
real kpirl_mpc_kink_nearby(const kpirl_mpc_kkt *k, const kpirl_mpc_kkt *nearby, kpirl_mpc_core *core,
                           const kpirl_mpc_triple *adjoint, kpirl_mpc_triple *residual) {
  const kpirl_mpc_system *s = &k->system;
  const int n = kpirl_mpc_n_conditions(s), first = kpirl_mpc_system_n_point(s) + s->horizon * s->n_states;
  const real length = (k->stale ? WIDE : over_length(k->step)) / largest_share(s, adjoint->x);
  search at;
  int i;
  if (!isfinite(length)) return (real)INFINITY;
  begin(k, &at);
  predict(k, &nearby->point, &at);
  set_move(s, length, adjoint->x, count_all(s), &at);
  find_sides(k, core, &nearby->point, &at);
  memset(residual->x, 0, (size_t)count_all(s) * sizeof(real));
  for (i = 0; i < n; ++i) /* those of bounds do not change */
    residual->x[i < first ? i : i + s->n_bounds] = (at.slope[i] - (at.right[i] - at.left[i]) / 2) / length;
  return kink(k, &at);
}
