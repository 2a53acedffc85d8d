/* SPDX-License-Identifier: MIT
 *
 * The linearised KKT conditions of a point: memory, derivatives, active rows.
 */
#include "kpirl_mpc_kkt.h"

#include <string.h>

enum { VECTORS = 12, OF_PARAMETERS = 8 };

/* ---- memory -------------------------------------------------------------------------------------------------- */

typedef struct arena {
  real *base;
  size_t used;
} arena;

static real *take(arena *from, size_t count) {
  real *place = from->base ? from->base + from->used : NULL;
  from->used += count;
  return place;
}

static void take_triple(arena *from, const kpirl_mpc_system *s, kpirl_mpc_triple *triple) {
  real *place = take(from, (size_t)kpirl_mpc_system_n_triple(s));
  if (place) kpirl_mpc_place_triple(s, place, triple);
}

static void take_factors(arena *from, const kpirl_mpc_system *s, kpirl_mpc_factors *factors) {
  const size_t T = (size_t)s->horizon, n_s = (size_t)s->n_states, n_u = (size_t)s->n_actions, n_free = (size_t)s->n_free;
  factors->P = take(from, (T + 1) * n_s * n_s);
  factors->W = take(from, T * n_u * n_u);
  factors->Y = take(from, T * n_u * n_s);
  factors->pivots = take(from, T * n_u);
  factors->free_W = take(from, n_free * n_free);
  factors->free_pivots = take(from, n_free);
}

static void set_sizes(kpirl_mpc_system *s, const kpirl_mpc_dimensions *of, const kpirl_mpc_rows *rows) {
  s->horizon = of->horizon;
  s->n_states = of->n_states;
  s->n_actions = of->n_actions;
  s->n_path = of->n_path;
  s->n_equality = of->n_equality;
  s->n_terminal = of->n_terminal;
  s->n_terminal_equality = of->n_terminal_equality;
  s->n_free = rows->n_free;
  s->n_bounds = rows->n_bounds;
  s->n_decisions = rows->n_decisions;
  s->free = rows->free;
  s->entries = rows->entries;
  s->decisions = rows->decisions;
  s->signs = rows->signs;
}

/* Of kpirl_mpc_put_derivatives. */
static size_t n_derivatives(const kpirl_mpc_system *s) {
  const size_t T = (size_t)s->horizon, n_s = (size_t)s->n_states, n_x = n_s + (size_t)s->n_actions;
  const size_t rows = (size_t)(s->n_path + s->n_equality), last_rows = (size_t)(s->n_terminal + s->n_terminal_equality);
  return 1 + T * n_x + n_s + T * (n_s + rows) + last_rows + T * n_x * (n_s + rows + n_x) + n_s * (last_rows + n_s);
}

size_t kpirl_mpc_kkt_init(kpirl_mpc_kkt *k, const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_rows *rows, real *memory) {
  kpirl_mpc_system *s = &k->system;
  size_t n_w, m, n_p = (size_t)(dimensions->n_parameters + dimensions->n_context + dimensions->n_states);
  arena from = {NULL, 0};
  from.base = memory;
  memset(k, 0, sizeof *k);
  k->dimensions = *dimensions;
  k->rows = rows;
  set_sizes(s, dimensions, rows);
  n_w = (size_t)kpirl_mpc_system_n_point(s);
  m = (size_t)kpirl_mpc_system_n_rows(s);
  s->sigma = take(&from, m);
  s->active = take(&from, m);
  s->sizes = take(&from, n_w);
  s->roots = take(&from, (size_t)s->n_decisions);
  s->lengths = take(&from, m);
  s->moved = take(&from, KPIRL_MPC_FEW * (size_t)s->n_decisions);
  s->stiffness = take(&from, m);
  s->scratch = take(&from, (size_t)kpirl_mpc_system_scratch(s));
  take_factors(&from, s, &s->factors);
  take_factors(&from, s, &k->row_factors);
  take_triple(&from, s, &k->point);
  take_triple(&from, s, &k->adjoint);
  take_triple(&from, s, &k->move);
  k->gradient = take(&from, n_w);
  k->defects = take(&from, (size_t)(s->horizon * s->n_states));
  k->slack = take(&from, m);
  k->pushing = take(&from, m);
  k->curvature = take(&from, n_w);
  k->row_sizes = take(&from, m);
  k->shares = take(&from, m);
  k->lowest_mode = take(&from, n_w);
  k->origin = take(&from, n_w);
  k->slope = take(&from, n_w);
  k->tangent = take(&from, n_w);
  k->derivatives = take(&from, n_derivatives(s));
  k->work = take(&from, VECTORS * (size_t)kpirl_mpc_system_n_triple(s) + OF_PARAMETERS * n_p);
  return from.used;
}

/* ---- derivatives --------------------------------------------------------------------------------------------- */

static void forget(kpirl_mpc_kkt *k) { k->factored = k->borrowed = k->stale = k->conditioned = k->stepped = k->reached = 0; }

static void take_values(kpirl_mpc_kkt *k, const kpirl_mpc_view *from) {
  const kpirl_mpc_system *s = &k->system;
  const int n_path = s->horizon * s->n_path + s->n_terminal, m = kpirl_mpc_system_n_rows(s);
  int i;
  k->objective = from->objective;
  memcpy(k->gradient, from->gradient, (size_t)kpirl_mpc_system_n_point(s) * sizeof(real));
  memcpy(k->defects, from->defects, (size_t)(s->horizon * s->n_states) * sizeof(real));
  for (i = 0; i < s->n_bounds; ++i) k->slack[i] = s->signs[i] * (k->rows->limits[i] - k->point.x[s->entries[i]]);
  for (i = 0; i < n_path; ++i) k->slack[s->n_bounds + i] = -from->path[i];
  for (i = s->n_bounds + n_path; i < m; ++i) k->slack[i] = -from->equality[i - s->n_bounds - n_path];
  k->evaluated = 1;
}

void kpirl_mpc_kkt_set_derivatives(kpirl_mpc_kkt *k, const real *derivatives) {
  kpirl_mpc_system *s = &k->system;
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions;
  kpirl_mpc_view view;
  view.gradient = derivatives;
  view.objective = derivatives[kpirl_mpc_system_n_point(s)];
  view.defects = derivatives + kpirl_mpc_system_n_point(s) + 1;
  view.path = view.defects + T * n_s;
  view.equality = view.path + T * s->n_path + s->n_terminal;
  s->F = view.equality + T * s->n_equality + s->n_terminal_equality;
  s->G = s->F + (size_t)T * n_s * n_x;
  s->E = s->G + (size_t)T * n_x * s->n_path + n_s * s->n_terminal;
  s->H = s->E + (size_t)T * n_x * s->n_equality + n_s * s->n_terminal_equality;
  take_values(k, &view);
  forget(k);
}

kpirl_mpc_start kpirl_mpc_start_at(const kpirl_mpc_system *s, const kpirl_mpc_triple *point) {
  kpirl_mpc_start at = {0};
  at.x = point->x;
  at.costates = point->costates;
  at.path = point->forces + s->n_bounds;
  at.equality = at.path + s->horizon * s->n_path + s->n_terminal;
  return at;
}

void kpirl_mpc_kkt_evaluate(kpirl_mpc_kkt *k, kpirl_mpc_core *core) {
  const kpirl_mpc_start at = kpirl_mpc_start_at(&k->system, &k->point);
  const int failed = kpirl_mpc_core_evaluate_at(core, &k->numbers, &at, KPIRL_MPC_SECOND);
  const int count = kpirl_mpc_put_derivatives(core, k->derivatives);
  int i;
  memcpy(k->derivatives, core->d.gradient, (size_t)kpirl_mpc_system_n_point(&k->system) * sizeof(real));
  for (i = 0; failed && i < count; ++i) k->derivatives[i] = (real)NAN;
  kpirl_mpc_kkt_set_derivatives(k, k->derivatives);
}

void kpirl_mpc_kkt_update(kpirl_mpc_kkt *k, kpirl_mpc_core *core) {
  const kpirl_mpc_start at = kpirl_mpc_start_at(&k->system, &k->point);
  const int failed = kpirl_mpc_core_evaluate_at(core, &k->numbers, &at, KPIRL_MPC_FIRST);
  kpirl_mpc_view view;
  kpirl_mpc_core_view(core, &view);
  take_values(k, &view);
  if (failed) k->gradient[0] = (real)NAN;
  forget(k);
  k->stale = !k->rows->quadratic;
}

/* ---- active rows ------------------------------------------------------------------------------------------------ */

/* Equalities, and inequalities whose multiplier is above their slack, both relative. Comparing the two, rather than either with a
 * threshold, follows mu slack -> 0: an inactive row with a tiny multiplier stays inactive, an active row with a tiny slack
 * stays active. Near a change of the active set the guess may be wrong; the margin after a Newton step finds out. */
static void guess_active(kpirl_mpc_kkt *k) {
  const int m = kpirl_mpc_system_n_rows(&k->system);
  real *pushing = k->work;
  int i;
  kpirl_mpc_relative_forces(k, k->point.forces, pushing);
  for (i = 0; i < m; ++i) {
    const int pushes = pushing[i] > 0 && pushing[i] > kpirl_mpc_relative_slack(k, k->slack, i);
    k->system.active[i] = k->rows->inequality[i] ? pushes && !(k->barrier > 0) : k->rows->equality[i];
  }
}

static int all_finite(const kpirl_mpc_kkt *k) {
  const kpirl_mpc_system *s = &k->system;
  const int T = s->horizon, n_s = s->n_states, n_x = n_s + s->n_actions, n_w = kpirl_mpc_system_n_point(s);
  return kpirl_mpc_all_finite(s->F, T * n_s * n_x) && kpirl_mpc_all_finite(s->H, T * n_x * n_x + n_s * n_s) &&
         kpirl_mpc_all_finite(s->G, T * n_x * s->n_path + n_s * s->n_terminal) &&
         kpirl_mpc_all_finite(s->E, T * n_x * s->n_equality + n_s * s->n_terminal_equality) &&
         kpirl_mpc_all_finite(k->gradient, n_w) && kpirl_mpc_all_finite(k->point.x, n_w) &&
         kpirl_mpc_all_finite(s->sigma, kpirl_mpc_system_n_rows(s));
}

/* Stiffness of smoothed rows. */
static void smooth(kpirl_mpc_kkt *k) {
  int i;
  for (i = 0; i < kpirl_mpc_system_n_rows(&k->system); ++i)
    k->system.sigma[i] = k->barrier > 0 && k->rows->inequality[i] ? k->barrier / (k->slack[i] * k->slack[i]) : 0;
}

static void find_pushing(kpirl_mpc_kkt *k) {
  int i;
  for (i = 0; i < kpirl_mpc_system_n_rows(&k->system); ++i) {
    const int smoothed = k->barrier > 0 && k->rows->inequality[i];
    k->pushing[i] = smoothed ? k->barrier / k->slack[i] : k->system.active[i] != 0 ? k->point.forces[i] : 0;
  }
}

int kpirl_mpc_kkt_select(kpirl_mpc_kkt *k, const real *active) {
  kpirl_mpc_system *s = &k->system;
  kpirl_mpc_point_sizes(&k->dimensions, k->rows, k->point.x, s->sizes);
  kpirl_mpc_system_curvature(s, k->curvature);
  kpirl_mpc_row_sizes(s, k->row_sizes);
  kpirl_mpc_force_shares(s, k->point.costates, k->curvature, k->shares);
  if (active)
    memmove(s->active, active, (size_t)kpirl_mpc_system_n_rows(s) * sizeof(real));
  else
    guess_active(k);
  smooth(k);
  find_pushing(k);
  kpirl_mpc_find_roots(k);
  return all_finite(k);
}

int kpirl_mpc_kkt_select_again(kpirl_mpc_kkt *k) {
  smooth(k);
  find_pushing(k);
  return all_finite(k);
}

void kpirl_mpc_kkt_select_nearby(kpirl_mpc_kkt *k, const real *active) {
  kpirl_mpc_point_sizes(&k->dimensions, k->rows, k->point.x, k->system.sizes);
  memcpy(k->system.active, active, (size_t)kpirl_mpc_system_n_rows(&k->system) * sizeof(real));
  smooth(k);
}

/* ---- of a solution ------------------------------------------------------------------------------------------------ */

void kpirl_mpc_by_stage(const kpirl_mpc_dimensions *of, const real *states, const real *actions, real *x) {
  const int n_s = of->n_states, n_u = of->n_actions;
  int t;
  for (t = 0; t <= of->horizon; ++t) {
    memcpy(x + t * (n_s + n_u), states + t * n_s, (size_t)n_s * sizeof(real));
    if (t < of->horizon) memcpy(x + t * (n_s + n_u) + n_s, actions + t * n_u, (size_t)n_u * sizeof(real));
  }
}

static void find_bound_forces(kpirl_mpc_kkt *k, const real *net) {
  const kpirl_mpc_system *s = &k->system;
  int i;
  for (i = 0; i < s->n_bounds; ++i) {
    const real own = s->signs[i] * net[s->entries[i]];
    k->point.forces[i] = k->rows->other[i] != i && own < 0 ? 0 : own;
  }
}

void kpirl_mpc_kkt_set_solution(kpirl_mpc_kkt *k, const real *solution) {
  const kpirl_mpc_system *s = &k->system;
  const int T = s->horizon, n_states = (T + 1) * s->n_states, n_actions = T * s->n_actions, n_c = T * s->n_states;
  const real *actions = solution + n_states, *costates = actions + n_actions, *of_states = costates + n_c;
  const real *of_actions = of_states + n_states, *of_rows = of_actions + n_actions;
  real *net = k->work;
  k->numbers.s0 = solution;
  k->numbers.psi = of_rows + kpirl_mpc_system_n_rows(s) - s->n_bounds;
  k->numbers.context = k->numbers.psi + k->dimensions.n_parameters;
  k->evaluated = 0;
  kpirl_mpc_by_stage(&k->dimensions, solution, actions, k->point.x);
  memcpy(k->point.costates, costates, (size_t)n_c * sizeof(real));
  kpirl_mpc_by_stage(&k->dimensions, of_states, of_actions, net);
  find_bound_forces(k, net);
  memcpy(k->point.forces + s->n_bounds, of_rows, (size_t)(kpirl_mpc_system_n_rows(s) - s->n_bounds) * sizeof(real));
}

int kpirl_mpc_kkt_linearise(kpirl_mpc_kkt *k, kpirl_mpc_core *core, const real *solution, const real *derivatives) {
  kpirl_mpc_kkt_set_solution(k, solution);
  if (derivatives)
    kpirl_mpc_kkt_set_derivatives(k, derivatives);
  else
    kpirl_mpc_kkt_evaluate(k, core);
  k->distance = 0;
  memset(k->tangent, 0, (size_t)kpirl_mpc_system_n_point(&k->system) * sizeof(real));
  if (!kpirl_mpc_kkt_select(k, NULL)) return 0;
  kpirl_mpc_kkt_polish(k, core);
  return 1;
}
