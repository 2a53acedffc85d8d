/* SPDX-License-Identifier: MIT
 *
 * One block of memory for everything: laid out twice by the same function, first to count, then to hand out.
 */
#include "kpirl_mpc_core.h"

#include <string.h>

enum { ALIGNMENT = 64 };

typedef struct cursor {
  char *base; /* NULL: count only */
  size_t used, reals, integers, arrays;
} cursor;

static void *take(cursor *at, size_t bytes) {
  void *place = at->base ? at->base + at->used : NULL;
  at->used += (bytes + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
  return place;
}

static size_t at_least_one(int count) { return count > 0 ? (size_t)count : 1; }

static real *take_reals(cursor *at, int count) {
  at->reals += at_least_one(count);
  ++at->arrays;
  return (real *)take(at, at_least_one(count) * sizeof(real));
}

static int *take_integers(cursor *at, int count) {
  at->integers += at_least_one(count);
  ++at->arrays;
  return (int *)take(at, at_least_one(count) * sizeof(int));
}

static int most(int a, int b) { return a > b ? a : b; }

static void take_iterate(cursor *at, const kpirl_mpc_core *core, kpirl_mpc_iterate *iterate) {
  iterate->x = take_reals(at, kpirl_mpc_n_point(core));
  iterate->costates = take_reals(at, DIM(core, horizon) * DIM(core, n_states));
  iterate->y = take_reals(at, kpirl_mpc_n_inequalities(core));
  iterate->z = take_reals(at, kpirl_mpc_n_inequalities(core));
  iterate->nu = take_reals(at, kpirl_mpc_n_equalities(core));
}

static void take_derivatives(cursor *at, const kpirl_mpc_core *core, kpirl_mpc_derivatives *d) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_x = n_s + DIM(core, n_actions);
  d->defects = take_reals(at, T * n_s);
  d->gap = take_reals(at, n_s);
  d->path = take_reals(at, T * DIM(core, n_path) + DIM(core, n_terminal));
  d->equality = take_reals(at, T * DIM(core, n_equality) + DIM(core, n_terminal_equality));
  d->g = take_reals(at, kpirl_mpc_n_inequalities(core));
  d->c = take_reals(at, kpirl_mpc_n_equalities(core));
  d->cost_gradient = take_reals(at, kpirl_mpc_n_point(core));
  d->gradient = take_reals(at, kpirl_mpc_n_point(core));
  d->start_gradient = take_reals(at, n_s);
  d->unconstrained_gradient = take_reals(at, kpirl_mpc_n_point(core));
  d->F = take_reals(at, T * n_s * n_x);
  d->G = take_reals(at, T * n_x * DIM(core, n_path) + n_s * DIM(core, n_terminal));
  d->E = take_reals(at, T * n_x * DIM(core, n_equality) + n_s * DIM(core, n_terminal_equality));
  d->H = take_reals(at, T * n_x * n_x + n_s * n_s);
}

static void take_factors(cursor *at, const kpirl_mpc_core *core, kpirl_mpc_factors *factors) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_u = DIM(core, n_actions), n_free = core->bounds.n_free;
  factors->P = take_reals(at, (T + 1) * n_s * n_s);
  factors->W = take_reals(at, T * n_u * n_u);
  factors->Y = take_reals(at, T * n_u * n_s);
  factors->pivots = take_reals(at, T * n_u);
  factors->free_W = take_reals(at, n_free * n_free);
  factors->free_pivots = take_reals(at, n_free);
}

/* The longest result of a function that is scattered into a dense array. */
static int most_nonzeros(const kpirl_mpc_model *model) {
  const int counts[] = {model->F.count, model->G.count,      model->E.count,     model->H.count,
                        model->G_last.count, model->E_last.count, model->H_last.count};
  int sum = 0, i;
  for (i = 0; i < 7; ++i) sum += counts[i];
  return sum;
}

static void lay_out(cursor *at, kpirl_mpc_core *core) {
  const int T = DIM(core, horizon), n_s = DIM(core, n_states), n_u = DIM(core, n_actions), n_x = n_s + n_u;
  const int m = kpirl_mpc_n_inequalities(core);
  core->lower = take_integers(at, core->n_lower);
  core->upper = take_integers(at, core->n_upper);
  core->fixed = take_integers(at, core->n_fixed);
  take_iterate(at, core, &core->at);
  take_iterate(at, core, &core->trial);
  take_iterate(at, core, &core->step.change);
  take_iterate(at, core, &core->first.change);
  take_derivatives(at, core, &core->d);
  take_factors(at, core, &core->factors);
  core->M = take_reals(at, n_x * n_x);
  core->weights = take_reals(at, m);
  core->force = take_reals(at, m);
  core->target = take_reals(at, m);
  core->stiffness = take_reals(at, kpirl_mpc_n_equalities(core));
  core->sizes = take_reals(at, n_x);
  core->units = take_reals(at, m);
  core->row_sizes = take_reals(at, m + kpirl_mpc_n_equalities(core));
  core->right = take_reals(at, kpirl_mpc_n_point(core));
  core->start = take_reals(at, n_s);
  core->scratch = take_reals(at, most(most(kpirl_mpc_stage_scratch(n_s, n_u), kpirl_mpc_substitute_scratch(T, n_s, n_u)),
                                      most(core->bounds.n_free * core->bounds.n_free, m + kpirl_mpc_n_equalities(core))));
  core->nonzeros = take_reals(at, most_nonzeros(&core->model));
  core->states = take_reals(at, (T + 1) * n_s);
  core->actions = take_reals(at, T * n_u);
}

/* Finite bounds of x, and entries whose bounds coincide; into the lists where they are there. Given entries of s_0 have none. */
static void sort(kpirl_mpc_core *core) {
  const kpirl_mpc_bounds *bounds = &core->bounds;
  const int n_w = kpirl_mpc_n_point(core), n_s = DIM(core, n_states);
  int i, next = 0;
  core->n_lower = core->n_upper = core->n_fixed = 0;
  for (i = 0; i < n_w; ++i) {
    if (i < n_s) {
      if (next == bounds->n_free || bounds->free_entries[next] != i) continue;
      ++next;
    }
    if (bounds->lower[i] == bounds->upper[i]) {
      if (core->fixed) core->fixed[core->n_fixed] = i;
      ++core->n_fixed;
      continue;
    }
    if (isfinite(bounds->lower[i])) {
      if (core->lower) core->lower[core->n_lower] = i;
      ++core->n_lower;
    }
    if (isfinite(bounds->upper[i])) {
      if (core->upper) core->upper[core->n_upper] = i;
      ++core->n_upper;
    }
  }
}

static void describe(kpirl_mpc_core *core, const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_bounds *bounds,
                     const kpirl_mpc_model *model) {
  memset(core, 0, sizeof *core);
  core->dimensions = *dimensions;
  core->bounds = *bounds;
  core->model = *model;
  sort(core);
}

static cursor measure(const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_bounds *bounds, const kpirl_mpc_model *model) {
  kpirl_mpc_core core;
  cursor at = {NULL, 0, 0, 0, 0};
  describe(&core, dimensions, bounds, model);
  lay_out(&at, &core);
  return at;
}

void kpirl_mpc_count_core(const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_bounds *bounds,
                          const kpirl_mpc_model *model, kpirl_mpc_core_count *count) {
  const cursor at = measure(dimensions, bounds, model);
  count->head = sizeof(kpirl_mpc_core);
  count->reals = at.reals;
  count->integers = at.integers;
  count->arrays = at.arrays;
}

size_t kpirl_mpc_core_size(const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_bounds *bounds,
                           const kpirl_mpc_model *model) {
  const size_t head = (sizeof(kpirl_mpc_core) + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
  return measure(dimensions, bounds, model).used + head + ALIGNMENT;
}

kpirl_mpc_core *kpirl_mpc_core_init(const kpirl_mpc_dimensions *dimensions, const kpirl_mpc_bounds *bounds,
                                    const kpirl_mpc_model *model, void *memory) {
  const int n_x = dimensions->n_states + dimensions->n_actions;
  cursor at = {(char *)memory, (ALIGNMENT - (size_t)memory % ALIGNMENT) % ALIGNMENT, 0, 0, 0};
  kpirl_mpc_core *core = (kpirl_mpc_core *)take(&at, sizeof *core);
  const size_t size = kpirl_mpc_core_size(dimensions, bounds, model);
  int i;
  memset(memory, 0, size);
  describe(core, dimensions, bounds, model);
  lay_out(&at, core);
  sort(core);
  for (i = 0; i < n_x; ++i) core->sizes[i] = 1;
  for (i = 0; i < kpirl_mpc_n_inequalities(core); ++i) core->units[i] = 1;
  return core;
}

void kpirl_mpc_core_set_model(kpirl_mpc_core *core, const kpirl_mpc_model *model) { core->model = *model; }
