/* SPDX-License-Identifier: MIT */
#include "kpirl_mpc_library.h"

#include "kpirl_mpc_kkt.h"

#include <string.h>

int kpirl_mpc_evaluate_buffered(void *self, const void *arguments, const void *results) {
  const kpirl_mpc_buffered *function = (const kpirl_mpc_buffered *)self;
  const real *const *from = (const real *const *)arguments;
  real *const *to = (real *const *)results;
  int i;
  for (i = 0; i < function->n_in; ++i)
    if (function->size_in[i])
      memcpy(function->arguments[i], from[function->in[i]], (size_t)function->size_in[i] * sizeof(real));
  function->evaluate(function->buffer);
  for (i = 0; i < function->n_out; ++i)
    if (to[function->out[i]] && function->size_out[i])
      memcpy(to[function->out[i]], function->results[i], (size_t)function->size_out[i] * sizeof(real));
  return function->status(function->buffer);
}

int kpirl_mpc_evaluate_compiled(void *self, const void *arguments, const void *results) {
  const kpirl_mpc_compiled *function = (const kpirl_mpc_compiled *)self;
  const real *const *from = (const real *const *)arguments;
  real *const *to = (real *const *)results;
  int i;
  for (i = 0; i < function->n_in; ++i) function->arguments[i] = from[function->in[i]];
  for (i = 0; i < function->n_out; ++i) function->results[i] = to[function->out[i]];
  return function->evaluate(function->arguments, function->results, function->integers, function->reals, 0);
}

static void copy(real *to, const real *from, int count) {
  if (count) memcpy(to, from, (size_t)count * sizeof(real));
}

static void read_result(const kpirl_mpc_core *core, kpirl_mpc_result *result) {
  const int bounds = kpirl_mpc_n_bounds(core);
  copy(result->x, core->at.x, kpirl_mpc_n_point(core));
  copy(result->costates, core->at.costates, core->dimensions.horizon * core->dimensions.n_states);
  copy(result->path, core->at.z + bounds, kpirl_mpc_n_inequalities(core) - bounds);
  copy(result->equality, core->at.nu + core->n_fixed, kpirl_mpc_n_equalities(core) - core->n_fixed);
  kpirl_mpc_bound_multipliers(core, result->bounds);
  result->objective = core->d.objective;
  result->iterations = core->iterations;
}

void kpirl_mpc_solve_each(kpirl_mpc_core *core, int count, const kpirl_mpc_numbers *numbers, const kpirl_mpc_options *options,
                          const kpirl_mpc_start *starts, kpirl_mpc_result *results) {
  int i;
  for (i = 0; i < count; ++i) {
    results[i].status = kpirl_mpc_core_solve(core, numbers + i, options, starts + i, &results[i].residuals);
    read_result(core, results + i);
  }
}

int kpirl_mpc_layout(void) {
  static const size_t sizes[] = {sizeof(kpirl_mpc_dimensions), sizeof(kpirl_mpc_model),     sizeof(kpirl_mpc_bounds),
                                 sizeof(kpirl_mpc_numbers),    sizeof(kpirl_mpc_options),   sizeof(kpirl_mpc_start),
                                 sizeof(kpirl_mpc_view),       sizeof(kpirl_mpc_residuals), sizeof(kpirl_mpc_iteration),
                                 sizeof(kpirl_mpc_buffered),   sizeof(kpirl_mpc_compiled),  sizeof(kpirl_mpc_system),
                                 sizeof(kpirl_mpc_triple),     sizeof(kpirl_mpc_rows),      sizeof(kpirl_mpc_kkt),
                                 sizeof(kpirl_mpc_evidence),   sizeof(kpirl_mpc_by_parameters),
                                 sizeof(kpirl_mpc_solution),   sizeof(kpirl_mpc_result),    sizeof(kpirl_mpc_question),
                                 sizeof(kpirl_mpc_answer)};
  size_t sum = 0, i;
  for (i = 0; i < sizeof sizes / sizeof *sizes; ++i) sum += (i + 1) * sizes[i];
  return (int)sum;
}
